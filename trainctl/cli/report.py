"""Commands that show results: ``report``, ``film``, ``compare``, ``claims``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainctl.cli.console import fill, number, say
from trainctl.errors import InputError

if TYPE_CHECKING:
    from trainctl.runs.run import Run


CAPACITY, SPACING, SUITE = "compare capacity", "compare spacing", "compare suite"


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command()(report)
    app.command()(film)
    app.command()(compare)
    app.command()(claims)


def report(
    folder: Annotated[Path, typer.Argument(help="Run folder, as `trainctl run` made it.")],
    out: Annotated[Path | None, typer.Option(help="The page; default FOLDER/report.html.")] = None,
    clock: Annotated[bool, typer.Option("--clock", help="Time in hours and minutes of the run.")] = False,
    kmh: Annotated[bool, typer.Option("--kmh", help="Speeds in km/h.")] = False,
) -> None:
    """Write one self-contained page about a run: verdicts, the trains on their tracks, linked plots."""
    from trainctl.report.page import report as write
    from trainctl.runs.run import Run

    say(write(Run(folder), out, clock=clock, kmh=kmh))


def film(
    folder: Annotated[Path, typer.Argument(help="Run folder, as `trainctl run` made it.")],
    out: Annotated[Path | None, typer.Option(help="The file, .gif or .webp; default FOLDER/film.gif.")] = None,
    seconds: Annotated[float, typer.Option(min=0.2, max=120.0, help="How long the animation lasts [s].")] = 15.0,
    from_s: Annotated[float | None, typer.Option(help="Begin at this time of the run in s.")] = None,
    until_s: Annotated[float | None, typer.Option(help="End at this time of the run in s.")] = None,
) -> None:
    """Write an animation of the trains on their tracks, for slides: GIF or WebP."""
    from trainctl.report.film import film as write
    from trainctl.runs.run import Run

    say(write(Run(folder), out or folder / "film.gif", seconds=seconds, from_s=from_s, until_s=until_s))


def compare(
    names: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN...",
            help="Run folders; with --controllers all one scenario; or capacity, spacing or suite (./suite is a folder).",
        ),
    ],
    controllers: Annotated[
        Literal["all"] | None, typer.Option(help="all: run the scenario under every law that can drive its traffic, and compare.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Where figures and runs go; default runs/compare, with a word runs/WORD.")
    ] = None,
    further: Annotated[
        list[str] | None, typer.Option("--law", metavar="FILE", help="With --controllers: a law in a file, too; repeatable.")
    ] = None,
    backend: Annotated[Literal["sumo", "numeric"], typer.Option(help="With --controllers: SUMO, or the loop without it.")] = "sumo",
    formats: Annotated[list[str] | None, typer.Option("--format", help="png, svg, pdf; repeatable; default png.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="With --controllers: override a key of the scenario.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")] = False,
    trains: Annotated[int | None, typer.Option(help="Trains; default 40, with spacing 6.", rich_help_panel=CAPACITY)] = None,
    length_km: Annotated[float | None, typer.Option(help="Measured stretch in km; default 100.", rich_help_panel=CAPACITY)] = None,
    speed_mps: Annotated[float | None, typer.Option(help="Line speed in m/s; default 83.333.", rich_help_panel=CAPACITY)] = None,
    signals_m: Annotated[float | None, typer.Option(help="Blocks in m; default 2000.", rich_help_panel=CAPACITY)] = None,
    spacing_m: Annotated[
        float | None, typer.Option(help="Desired spacing of the formations in m; default 3000.", rich_help_panel=CAPACITY)
    ] = None,
    spacings: Annotated[
        Path | None,
        typer.Option(
            help="spacing.json of `trainctl compare spacing`: each law keeps the spacing found there.", rich_help_panel=CAPACITY
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Rows at a time; default one per core.", rich_help_panel=CAPACITY)
    ] = None,
    rows_: Annotated[
        str | None, typer.Option("--rows", metavar="ROW,...", help="Only these rows; also with suite.", rich_help_panel=SPACING)
    ] = None,
    stops: Annotated[int | None, typer.Option(help="Emergency stops; default 200.", rich_help_panel=SPACING)] = None,
    searched: Annotated[
        int | None, typer.Option(help="How many of them, the first ones, the search uses; default 20.", rich_help_panel=SPACING)
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of everything random in them; default 1.", rich_help_panel=SPACING)] = None,
    loss: Annotated[
        float | None, typer.Option(help="Share of messages lost in good times; default 0.02.", rich_help_panel=SPACING)
    ] = None,
    delay_s: Annotated[float | None, typer.Option(help="Age of messages in s; default 1.", rich_help_panel=SPACING)] = None,
    bad_s: Annotated[
        float | None,
        typer.Option(
            help="Mean length of times in which no message arrives, in s; default 3; 0: there are none.", rich_help_panel=SPACING
        ),
    ] = None,
    brake_scatter: Annotated[
        float | None, typer.Option(help="Share by which brakes scatter, either way; default 0.05.", rich_help_panel=SPACING)
    ] = None,
    runs_: Annotated[int | None, typer.Option("--runs", help="Runs of each cell; default 20.", rich_help_panel=SUITE)] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue what is in --out; also with spacing.", rich_help_panel=SUITE)
    ] = False,
    in_sumo: Annotated[
        bool, typer.Option("--in-sumo", help="Check the spacings that were found in SUMO as well.", rich_help_panel=SPACING)
    ] = False,
) -> None:
    """Compare runs: one table, also in LaTeX, and figures that show all of them on common axes.

    `trainctl compare capacity` runs the same trains on the same line under SUMO's fixed block and moving block and under every law:
    headway, trains per hour, journey time, energy, collisions.

    `trainctl compare spacing` finds for every law the smallest spacing at which no trains touch when the first train makes an
    emergency stop, in all of many stops with late and lost messages and brakes that scatter.

    `trainctl compare suite` runs every law in every situation (join, leave, stop, emergency stop, outage, bursts, gradient, unit
    lost), 20 times each, into one table and one page.

    Of finished runs nothing is executed. With --controllers laws run: A law that is a file is a program: it is executed.
    """
    from trainctl.cli.console import listing, show, show_json
    from trainctl.runs.run import Run
    from trainctl.studies import compare as comparing

    wanted = tuple(formats or ("png",))
    wrong = [f for f in wanted if f not in ("png", "svg", "pdf")]
    if wrong:
        raise InputError([f"--format {f}: must be one of png, svg, pdf" for f in wrong])
    plan = {
        "trains": trains, "length_m": None if length_km is None else 1000.0 * length_km, "speed_mps": speed_mps,
        "signals_m": signals_m, "spacing_m": spacing_m,
    }  # fmt: skip
    of_spacing = {
        "stops": stops, "searched": searched, "seed": seed, "loss": loss, "delay_s": delay_s, "bad_s": bad_s,
        "brake_scatter": brake_scatter,
    }  # fmt: skip
    if names == ["spacing"] and controllers is None:
        from trainctl.cli.spacing import spacing

        others = {
            "runs": runs_, "length-km": length_km, "signals-m": signals_m, "spacing-m": spacing_m,
            "spacings": spacings, "set": settings,
        }  # fmt: skip
        idle = [f"--{key}" for key, value in others.items() if value is not None] + ["--backend"] * (backend != "sumo")
        if idle:
            raise InputError([f"{option}: not with `trainctl compare spacing`" for option in idle])
        asked = {**of_spacing, "trains": trains, "speed_mps": speed_mps}
        asked = {key: value for key, value in asked.items() if value is not None}
        spacing(asked, rows_, out or Path("runs/spacing"), wanted, workers, as_json, in_sumo, resume)
        return
    if names == ["suite"] and controllers is None:
        from trainctl.cli.suite import suite

        options = {
            **of_spacing, "trains": trains, "length-km": length_km, "speed-mps": speed_mps, "signals-m": signals_m,
            "spacings": spacings, "set": settings, "in-sumo": in_sumo or None,
        }  # fmt: skip
        if idle := [f"--{key.replace('_', '-')}" for key, value in options.items() if value is not None]:
            raise InputError([f"{option}: not with `trainctl compare suite`" for option in idle])
        suite(runs_, spacing_m, rows_, out or Path("runs/suite"), workers, resume, as_json)
        return
    if runs_ is not None or resume:
        option = "--runs: only" if runs_ is not None else "--resume: only with `trainctl compare spacing` or"
        raise InputError(f"{option} with `trainctl compare suite`")
    given: dict[str, Any] = {key.replace("_", "-"): value for key, value in of_spacing.items()}
    given |= {"rows": rows_, "in-sumo": in_sumo or None}
    if idle := [f"--{key}: only with `trainctl compare spacing`" for key, value in given.items() if value is not None]:
        raise InputError(idle)
    if names == ["capacity"] and controllers is None:
        if settings or backend != "sumo":
            raise InputError("capacity: takes no --set and no --backend; its scenarios lie in --out afterwards")
        chosen: dict[str, Any] = {key: value for key, value in plan.items() if value is not None}
        if spacings is not None:
            from trainctl.studies.capacity import found_in

            chosen["found"] = found_in(spacings)
        _capacity(chosen, out or Path("runs/capacity"), wanted, workers, as_json)
        return
    given = {"workers": workers, "trains": trains, "length-km": length_km, "speed-mps": speed_mps, "signals-m": signals_m}
    given |= {"spacing-m": spacing_m, "spacings": spacings}
    if idle := [f"--{key}: only with `trainctl compare capacity`" for key, value in given.items() if value is not None]:
        raise InputError(idle)
    out = out or Path("runs/compare")
    left_out: dict[str, list[str]] = {}
    if controllers is None:
        if settings or further:
            option = "--set" if settings else "--law"
            raise InputError(f"{option}: only with --controllers all, which runs something")
        runs = [Run(Path(name)) for name in names]
        labels = comparing.names(runs)
    else:
        if len(names) != 1:
            raise InputError("--controllers all: give exactly one scenario")
        runs, labels, left_out = _under_all(names[0], out, backend, settings, further or [])
    rows = comparing.table(runs)
    figures = comparing.figures(runs, labels, out, wanted)
    tex = out / "compare.tex"
    tex.write_text(comparing.latex(rows, labels), encoding="utf-8")
    if as_json:
        controllers_ = {label: run.scenario["controller"] for label, run in zip(labels, runs, strict=True)}
        told = {"runs": labels, "controllers": controllers_, "rows": rows, "left_out": left_out}
        show_json({**told, "figures": figures, "latex": tex})
        return
    table = listing(None, "metric", *(label.replace("_", " ") for label in labels), "unit")
    for row in rows:
        fill(table, row["metric"], *(number(value) for value in row["values"]), row["unit"])
    show(table)
    for label, run in zip(labels, runs, strict=True) if controllers is not None else ():
        say(f"{label}: {_gains(run)}")
    for name, reasons in left_out.items():
        for reason in reasons:
            say(f"{name} is left out: {reason}")
    for path in [*figures, tex]:
        say(path)


def _gains(run: Run) -> str:
    """The keys of a run's law, its plant and periods, in words."""
    tables = run.scenario
    keys = {key: value for key, value in tables["controller"].items() if key != "law"}
    keys |= {key: tables["run"][key] for key in ("control_period_s", "sub_step_s") if key in tables["run"]}
    words = ", ".join(f"{key} = {number(value)}" for key, value in keys.items())
    return f"{tables['controller']['law']} on {tables.get('plant', {}).get('kind', 'point')}: {words}"


def _capacity(given: dict[str, Any], out: Path, formats: tuple[str, ...], workers: int | None, as_json: bool) -> None:
    """Run, measure and show how much a line carries; rows that failed are reported and make the exit code 3."""
    import sys

    from trainctl.cli.console import Progress, listing, show, show_json
    from trainctl.studies import capacity

    plan = capacity.CapacityPlan(**given)
    with Progress("capacity", sys.stderr.isatty()) as advance:
        table = capacity.compare(plan, out, workers=workers, progress=advance)
    pictures = capacity.figure(table, plan, out / "capacity", formats)
    if as_json:
        show_json(table)
    else:
        km, kmh = plan.length_m / 1000.0, 3.6 * plan.speed_mps
        shown = listing(f"{plan.trains} trains over {km:g} km at {kmh:.3g} km/h at most", *capacity.COLUMNS)
        for row in table:
            fill(shown, row["row"].replace("_", " "), *(number(row[key]) for key in list(capacity.COLUMNS.values())[1:]))
        show(shown)
        for name in capacity.LAW_ROWS if plan.found else ():
            if plan.found_of(name) is None:
                say(f"{name}: no safe spacing was found; it runs at {plan.spacing_m:g} m")
        for path in pictures:
            say(path)
    failed = [f"{row['row']}: {row['error']}" for row in table if row["error"]]
    for line in failed:
        say(line, error=True)
    if failed:
        raise typer.Exit(3)


def _under_all(
    name: str, out: Path, backend: Literal["sumo", "numeric"], settings: list[str] | None, files: list[str]
) -> tuple[list[Run], list[str], dict[str, list[str]]]:
    """Run one scenario under every law, its own and those in files too; the runs, their names, and who could not and why."""
    import sys

    from trainctl import runner
    from trainctl.cli.console import Progress, setting
    from trainctl.errors import TrainctlError
    from trainctl.laws import laws
    from trainctl.scenario.build import model_of
    from trainctl.scenario.reading import examine, read
    from trainctl.studies import compare as comparing

    data, path = read(name, dict(map(setting, settings or [])))
    more, left_out = comparing.others(data, laws(), path.parent, files)
    tables = {**comparing.alternatives(data, laws()), **more}
    if strange := comparing.strange(data, list(tables)):
        raise InputError([f"{path.name}: {line}" for line in strange])
    runs, labels = [], []
    for law, changed in tables.items():
        try:
            scenario, found = examine(changed)
            if scenario is None:
                raise InputError(found)
            model = model_of(scenario, path.name, path.parent, found)
            with Progress(law, sys.stderr.isatty()) as advance:
                runs.append(runner.run(model, out / law, backend, False, sys.argv, advance))
            labels.append(law)
        except InputError as error:
            left_out[law] = list(error.mistakes)
        except TrainctlError as error:
            left_out[law] = [f"the run failed: {error}"]
    if not runs:
        raise InputError([f"{law}: {reason}" for law, reasons in left_out.items() for reason in reasons])
    return runs, labels, left_out


def claims(
    paper: Annotated[str | None, typer.Option(help="Only this paper (see the first column).")] = None,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON: paper, claim, paper_value, measured, unit, verdict, note.")
    ] = False,
) -> None:
    """Measure every claim of the papers: what they state, what comes out here, the verdict and the correction."""
    import os
    import sys

    from trainctl.citation import PAPERS
    from trainctl.claims import BEYOND, NOT, REPRODUCED, VERDICTS, WITH_CORRECTION, as_markdown, counts, measure
    from trainctl.cli.console import Progress, listing, show, show_json

    if paper is not None and paper not in PAPERS:
        raise InputError(f"--paper {paper}: not known; there are: {', '.join(PAPERS)}")
    with Progress("claims", sys.stderr.isatty()) as advance:
        found = measure([paper] if paper else list(PAPERS), advance, os.cpu_count() or 1)
    if as_json:
        show_json([claim._asdict() for claim in found])
    elif markdown:
        say(as_markdown(found))
    else:
        from rich.text import Text

        colours = {REPRODUCED: "green", WITH_CORRECTION: "yellow", NOT: "red", BEYOND: "blue"}
        for name in dict.fromkeys(claim.paper for claim in found):
            table = listing(f"{name}: {PAPERS[name].text()}")
            for column, share in (("claim", 5), ("paper", 2), ("measured", 2), ("unit", None), ("verdict", None), ("note", 5)):
                table.add_column(column, ratio=share, overflow="fold")
            for claim in found:
                if claim.paper == name:
                    cells = [Text(number(value)) for value in claim[1:]]
                    cells[4].stylize(colours[claim.verdict])
                    fill(table, *cells)
            show(table)
        for verdict, words in VERDICTS.items():
            say(f"{verdict}: {words}")
        say(f"{len(found)} claims: {counts(found)}")
