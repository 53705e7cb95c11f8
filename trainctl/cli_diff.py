"""``trainctl diff``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from trainctl.errors import InputError

if TYPE_CHECKING:
    from trainctl.diff.runs import Report, Tolerances

Log = Annotated[
    Path, typer.Argument(help="Run folder, or a log of SUMO's: fcd, tripinfo, summary, statistics, collisions, vehroute.")
]


def register(app: typer.Typer) -> None:
    """Add the command."""

    @app.command()
    def diff(
        a: Log,
        b: Log,
        tolerances: Annotated[
            Path | None, typer.Option(metavar="FILE", help="TOML: absolute, relative, and [columns] with their own.")
        ] = None,
        tolerance: Annotated[float | None, typer.Option(metavar="X", help="Absolute tolerance of every column.")] = None,
        zero: Annotated[bool, typer.Option("--zero", help="No tolerance: --tolerance 0.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")] = False,
    ) -> None:
        """Compare two runs or two of SUMO's logs (XML, CSV, Parquet, gzipped or not): exit 1 if they differ.

        Rows are matched by time and train. Versions are told but are no difference; SUMO's headers, clocks and durations are not
        compared. Without options values may differ by 1e-6, or by one in the last decimal of a log.
        """
        from trainctl.diff.runs import diff as compare

        report = compare(a, b, _chosen(tolerances, 0.0 if zero else tolerance))
        if as_json:
            from trainctl.cli import _print_json

            _print_json(report.as_dict())
        else:
            _show(report)
        if not report.same:
            raise typer.Exit(1)


def _chosen(file: Path | None, absolute: float | None) -> Tolerances:
    from trainctl.diff.runs import Tolerance, Tolerances, read_tolerances

    read = read_tolerances(file) if file is not None else Tolerances()
    if absolute is None:
        return read
    if not 0 <= absolute < float("inf"):
        raise InputError(f"--tolerance {absolute}: must be a number, at least 0")
    return Tolerances(Tolerance(absolute, stated=True), read.columns)


def _show(report: Report) -> None:
    from trainctl.cli import _print, _table
    from trainctl.diff.runs import at, told

    for note in report.notes:
        print(f"note: {note}")
    rows = sum(t.rows for t in report.tables)
    if report.same:
        print(f"no difference in {rows} rows of {', '.join(t.table for t in report.tables)}")
        return
    if report.first:
        print(f"first difference: {report.first}")
    for key, x, y in report.settings:
        print(f"{key}: {x} -> {y}")
    for old, new in report.renamed.items():
        print(f"renamed: {old} -> {new}")
    for line in report.files:
        print(line)
    for t in report.tables:
        for found, side in ((t.missing, "A"), (t.extra, "B")):
            if found.count:
                print(f"{t.table}: {found.count} rows only in {side}, first {at(found.first_time_s, found.first_who)}")
        for name in t.lost_columns:
            print(f"{t.table}.{name}: column only in A")
    table = _table(None, "column", "rows", "first at", "most at", "A -> B")
    for t in report.tables:
        for c in t.columns.values():
            most, first = c.largest or c.first, c.first
            if most is None or first is None:
                continue
            table.add_row(
                f"{t.table}.{c.column}", f"{c.differing} of {t.rows}", at(first.time_s, first.who),
                at(most.time_s, most.who), told(most),
            )  # fmt: skip
    if table.row_count:
        _print(table)
