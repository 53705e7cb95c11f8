"""Commands that show results: ``report``, ``compare``, ``claims``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainctl.errors import InputError

if TYPE_CHECKING:
    from trainctl.record.run import Run


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(report)
    app.command()(compare)
    app.command()(claims)


def report(
    folder: Annotated[Path, typer.Argument(help="Run folder, as `trainctl run` made it.")],
    out: Annotated[Path | None, typer.Option(help="The page; default FOLDER/report.html.")] = None,
) -> None:
    """Write one self-contained page about a run: verdicts, the trains on their tracks, linked plots."""
    from trainctl.record.report import report as write
    from trainctl.record.run import Run

    print(write(Run(folder), out))


def compare(
    names: Annotated[list[str], typer.Argument(metavar="RUN...", help="Run folders; with --controllers all one scenario.")],
    controllers: Annotated[
        Literal["all"] | None, typer.Option(help="all: run the scenario under every law that can drive its traffic, and compare.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Where the figures (and with --controllers the runs) go.")] = Path("runs/compare"),
    backend: Annotated[Literal["sumo", "numeric"], typer.Option(help="With --controllers: SUMO, or the loop without it.")] = "sumo",
    formats: Annotated[list[str] | None, typer.Option("--format", help="png, svg, pdf; repeatable; default png.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="With --controllers: override a key of the scenario.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")] = False,
) -> None:
    """Compare runs: one table, figures side by side."""
    from trainctl.cli import _print, _print_json, _table
    from trainctl.record import compare as comparing
    from trainctl.record.run import Run

    wanted = tuple(formats or ("png",))
    wrong = [f for f in wanted if f not in ("png", "svg", "pdf")]
    if wrong:
        raise InputError([f"--format {f}: must be one of png, svg, pdf" for f in wrong])
    left_out: dict[str, list[str]] = {}
    if controllers is None:
        if settings:
            raise InputError("--set: only with --controllers all, which runs something")
        runs = [Run(Path(name)) for name in names]
        labels = comparing.names(runs)
    else:
        if len(names) != 1:
            raise InputError("--controllers all: give exactly one scenario")
        runs, labels, left_out = _under_all(names[0], out, backend, settings)
    rows = comparing.table(runs)
    figures = comparing.figures(runs, labels, out, wanted)
    if as_json:
        _print_json({"runs": labels, "rows": rows, "left_out": left_out, "figures": figures})
        return
    table = _table(None, "metric", *(label.replace("_", " ") for label in labels), "unit")
    for row in rows:
        table.add_row(row["metric"], *(_shown(value) for value in row["values"]), row["unit"])
    _print(table)
    for name, reasons in left_out.items():
        for reason in reasons:
            print(f"{name} is left out: {reason}")
    for path in figures:
        print(path)


def _under_all(
    name: str, out: Path, backend: Literal["sumo", "numeric"], settings: list[str] | None
) -> tuple[list[Run], list[str], dict[str, list[str]]]:
    """Run one scenario under every law; the runs, their names, and who could not and why."""
    import sys

    from trainctl import runner
    from trainctl.cli import _progress, _setting
    from trainctl.errors import TrainctlError
    from trainctl.prepare import laws, prepare
    from trainctl.reading import examine, read
    from trainctl.record import compare as comparing

    data, path = read(name, dict(map(_setting, settings or [])))
    runs, labels, left_out = [], [], {}
    there = laws()
    for law, changed in comparing.alternatives(data, there).items():
        try:
            scenario, found = examine(changed)
            if scenario is None:
                raise InputError(found)
            prepared = prepare(scenario, path.name, path.parent, found)
            with _progress(law, sys.stderr.isatty()) as advance:
                runs.append(runner.run(prepared, out / law, backend, False, sys.argv, advance))
            labels.append(law)
        except InputError as error:
            left_out[law] = list(error.mistakes)
        except TrainctlError as error:
            left_out[law] = [f"the run failed: {error}"]
    if "sumo" not in there:
        left_out["sumo"] = ["there is no controller sumo"]
    if not runs:
        raise InputError([f"{law}: {reason}" for law, reasons in left_out.items() for reason in reasons])
    return runs, labels, left_out


def _shown(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def claims(
    paper: Annotated[str | None, typer.Option(help="Only this paper (see the first column).")] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON: paper, claim, paper_value, measured, unit, verdict, note.")
    ] = False,
) -> None:
    """Measure every claim of the papers: what they state, what comes out here, the verdict and the correction."""
    import sys

    from trainctl.claims import NOT, PAPERS, REPRODUCED, WITH_CORRECTION, as_markdown, measure
    from trainctl.cli import _print, _print_json, _progress, _table

    if paper is not None and paper not in PAPERS:
        raise InputError(f"--paper {paper}: not known; there are: {', '.join(PAPERS)}")
    with _progress("claims", sys.stderr.isatty()) as advance:
        found = measure([paper] if paper else list(PAPERS), advance)
    if as_json:
        _print_json([claim._asdict() for claim in found])
    elif markdown:
        print(as_markdown(found))
    else:
        from rich.text import Text

        colours = {REPRODUCED: "green", WITH_CORRECTION: "yellow", NOT: "red"}
        for name in dict.fromkeys(claim.paper for claim in found):
            table = _table(f"{name}: {PAPERS[name]}")
            for column, share in (("claim", 5), ("paper", 2), ("measured", 2), ("unit", None), ("verdict", None), ("note", 5)):
                table.add_column(column, ratio=share, overflow="fold")
            for claim in found:
                if claim.paper == name:
                    cells = [Text(_shown(value)) for value in claim[1:]]
                    cells[4].stylize(colours[claim.verdict])
                    table.add_row(*cells)
            _print(table)
        counts = [f"{sum(c.verdict == verdict for c in found)} {verdict}" for verdict in (REPRODUCED, WITH_CORRECTION, NOT)]
        print(f"{len(found)} claims: {', '.join(counts)}")
