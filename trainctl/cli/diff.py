"""``trainctl diff``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from trainctl.errors import InputError, printable

if TYPE_CHECKING:
    from trainctl.diff.runs import Report, Tolerances

#: Rows behind a finding that ``--rows`` shows.
ROWS = 20

Reference = Annotated[Path, typer.Argument(help="The reference: a run folder, a golden, a log of SUMO's or a folder of these.")]
Other = Annotated[Path, typer.Argument(help="What is compared with it, of the same kind.")]
TolerancesFile = Annotated[
    Path | None,
    typer.Option("--tolerances", metavar="FILE", help="TOML: tolerances in value and time, of all and of single columns."),
]
Absolute = Annotated[float | None, typer.Option("--tolerance", metavar="X", help="Absolute tolerance of every column.")]
InTime = Annotated[
    float | None, typer.Option("--time-tolerance", metavar="S", help="Tolerance in time of every column and of rows, in seconds.")
]
Zero = Annotated[bool, typer.Option("--zero", help="No tolerance: --tolerance 0.")]
Form = Annotated[
    Literal["text", "json", "github"] | None, typer.Option("--format", help="Text (the default), JSON, or annotations for GitHub.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for machines: --format json.")]
Rows = Annotated[bool, typer.Option("--rows", help=f"Also the rows behind each finding ({ROWS} each), and every column.")]
Junit = Annotated[Path | None, typer.Option(metavar="FILE", help="Also write JUnit XML: a test case for every column.")]
Html = Annotated[Path | None, typer.Option(metavar="FILE", help="Also write one page with the curves and their tubes.")]


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command()
    def diff(
        a: Reference,
        b: Other,
        tolerances: TolerancesFile = None,
        tolerance: Absolute = None,
        time_tolerance: InTime = None,
        zero: Zero = False,
        form: Form = None,
        as_json: AsJson = False,
        rows: Rows = False,
        junit: Junit = None,
        html: Html = None,
        accept: Annotated[bool, typer.Option("--accept", help="Put B in the place of A, after showing what moves.")] = False,
    ) -> None:
        """Compare two runs or two of SUMO's logs (XML and CSV, gzipped or not, and Parquet): exit 1 if they differ.

        Differences are grouped by train and cause. Rows are matched by time and train; with a tolerance in time a value must lie in
        the tube round the reference. Versions are noted but are no difference; SUMO's headers, clocks and durations are not
        compared. Without options values may differ by 1e-6, or by one in the last decimal of a log.
        """
        chosen = chosen_tolerances(tolerances, tolerance, time_tolerance, zero)
        compared(a, b, chosen, chosen_form(form, as_json, rows), rows, junit, html, accept)


def compared(
    a: Path, b: Path, tolerances: Tolerances, form: str, rows: bool, junit: Path | None, html: Path | None, accept: bool
) -> None:
    """Compare, show, write what was asked for, and end with the exit code."""
    from trainctl.diff.golden import accept as put
    from trainctl.diff.results import github, write
    from trainctl.diff.results import junit as results
    from trainctl.diff.runs import diff as compare

    report = compare(a, b, tolerances)
    if form == "json":
        from trainctl.cli.console import show_json
        from trainctl.diff.behind import rows_behind
        from trainctl.record.folder import plain

        found = report.as_dict()
        for finding, shown in zip(report.findings, found["findings"], strict=True):
            behind = rows_behind(finding, report.tables, report.tolerances, ROWS) if rows else []
            shown.update({"behind": [plain(row._asdict()) for row in behind]} if rows else {})
        show_json(found)
    elif form == "github":
        print("\n".join(github(report)))
    else:
        _show(report, rows)
    if junit is not None:
        write(junit, results(report))
    if html is not None:
        from trainctl.diff.page import page

        write(html, page(report))
    if accept:
        if not report.same:
            put(a, b)
        if form == "text":
            print(f"nothing to accept: {a} stays" if report.same else f"accepted: {a} is what {b} was")
    elif not report.same:
        raise typer.Exit(1)


def chosen_form(form: str | None, as_json: bool, rows: bool) -> str:
    """The form that was asked for."""
    if rows and form == "github":
        raise InputError("--rows, --format github: give one of them: annotations hold no rows")
    if as_json and form not in (None, "json"):
        raise InputError(f"--json, --format {form}: give one of them")
    return "json" if as_json else form or "text"


def chosen_tolerances(file: Path | None, absolute: float | None, time_s: float | None, zero: bool) -> Tolerances:
    """Tolerances of a file, and what the options say instead."""
    from dataclasses import replace

    from trainctl.diff.tolerance import TIMES, Tolerance, Tolerances, read_tolerances

    found = read_tolerances(file) if file is not None else Tolerances()
    wrong = [
        f"{name} {value}: must be a number, at least 0"
        for name, value in (("--tolerance", absolute), ("--time-tolerance", time_s))
        if value is not None and not 0 <= value < float("inf")
    ]
    if zero and absolute is not None:
        wrong.append("--zero, --tolerance: give one of them")
    if wrong:
        raise InputError(wrong)
    absolute = 0.0 if zero else absolute
    if time_s is not None:
        old, new = ({name: getattr(time, name) for name in TIMES} for time in (found.time, Tolerance(0.0, time_s=time_s)))
        # columns with a word of their own on time keep it
        columns = {
            name: t._replace(**new) if old == {key: getattr(t, key) for key in TIMES} else t for name, t in found.columns.items()
        }
        found = replace(found, time=Tolerance(0.0, time_s=time_s), columns=columns)
    if absolute is not None:
        found = replace(found, everywhere=Tolerance(absolute, stated=True))
    return found


def _show(report: Report, rows: bool) -> None:
    for line in _lines(report, rows):
        print(printable(line))
    if rows:
        _columns(report)


def _lines(report: Report, rows: bool) -> Iterator[str]:
    from trainctl.diff.behind import rows_behind
    from trainctl.diff.findings import counted
    from trainctl.diff.runs import at, told, value_told

    yield from (f"note: {note}" for note in report.notes)
    count = sum(t.rows for t in report.tables)
    if report.same:
        yield f"no difference in {counted(count, 'row')} of {', '.join(t.table for t in report.tables)}"
        return
    if report.first:
        yield f"first difference: {report.first}"
    yield f"{counted(len(report.findings), 'finding')} in {count} compared rows:"
    for number, f in enumerate(report.findings, 1):
        yield f"{number:3}. {f.words}{f'  [{f.where}]' if f.where else ''}"
        for label, d in (("first", f.first), ("most", f.largest)):
            if d is not None:
                yield f"       {label}: {at(d.place.time_s, d.place.who)}: {d.column} {told(d.place)}"
        for row in rows_behind(f, report.tables, report.tolerances, ROWS) if rows else ():
            values = f"{row.column} {value_told(row.a)} -> {value_told(row.b)}"
            what = values if row.column else f"row only in {'A' if row.a else 'B'}"
            yield f"       {row.table}: {at(row.time_s, row.who)}: {what}"


def _columns(report: Report) -> None:
    from trainctl.cli.console import listing, show
    from trainctl.diff.runs import at, told

    table = listing(None, "column", "rows", "tolerance", "first at", "most at", "A -> B")
    for t in report.tables:
        for c in t.columns.values():
            most, first = c.largest or c.first, c.first
            if most is None or first is None:
                continue
            table.add_row(
                f"{t.table}.{c.column}", f"{c.differing} of {t.rows}", c.tolerance.told(), at(first.time_s, first.who),
                at(most.time_s, most.who), told(most),
            )  # fmt: skip
    if table.row_count:
        show(table)
