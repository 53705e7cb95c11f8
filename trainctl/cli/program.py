"""The command line. Heavy modules are imported inside the commands: ``trainctl --help`` answers at once."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainctl.cli import cite, diff, extend, golden, net, report, resume, sweep, tune
from trainctl.cli.console import (
    DEFAULT_SCENARIO,
    Json,
    Progress,
    RunFolder,
    ScenarioName,
    Settings,
    app,
    fill,
    listing,
    named,
    networks,
    number,
    say,
    show,
    show_json,
)
from trainctl.errors import InputError, TrainctlError, left_out

if TYPE_CHECKING:
    from trainctl.runs.run import Run
    from trainctl.scenario.model import Model


@app.command()
def run(
    name: ScenarioName = DEFAULT_SCENARIO,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Run folder; default runs/NAME, with --set runs/NAME+KEY=VALUE. An earlier run is replaced, unless more than a run"
            " lies there: then it goes to NAME-2."
        ),
    ] = None,
    backend: Annotated[Literal["sumo", "numeric"], typer.Option(help="SUMO, or the same loop without a simulator.")] = "sumo",
    gui: Annotated[bool, typer.Option("--gui", help="Watch the run in sumo-gui: tracks, trains by role, links.")] = False,
    gui_program: Annotated[str, typer.Option(help="The program --gui starts; sumo is the same without a window.")] = "sumo-gui",
    checkpoint_every: Annotated[
        float | None, typer.Option(help="Scenario time between two checkpoints [s]; `trainctl resume` goes on from the last one.")
    ] = None,
    record_every: Annotated[
        float | None,
        typer.Option(help="Time between recorded rows [s], SUMO's FCD included; default every step."),
    ] = None,
    settings: Settings = None,
    force: Annotated[bool, typer.Option("--force", help="Replace whatever lies at the run folder.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit 1 if any bound was violated.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no summary.")] = False,
    as_json: Json = False,
) -> None:
    """Run a scenario into a run folder: logs, metrics, SUMO's own logs.

    Exit 1 if trains collided or waited for each other in a circle, and with the supervisor on also if one was too fast for its
    line.
    A law that is a file is a program: it is executed.
    """
    from trainctl import runner
    from trainctl.record.folder import place_for, run_name

    if gui and backend == "numeric":
        raise InputError("--gui: shows SUMO; leave out --backend numeric")
    if record_every is not None:
        settings = [*(settings or []), f"run.record_every_s={record_every!r}"]
    model = named(name, settings)
    folder, elsewhere = (out, "") if out is not None else place_for(Path("runs") / run_name(name, settings or []))
    if elsewhere:
        say(elsewhere, error=True)
    shown = not (quiet or as_json)
    with Progress(f"{Path(name).stem}", shown and sys.stderr.isatty(), not shown) as advance:
        done = runner.run(model, folder, backend, force, sys.argv, advance, gui_program if gui else None, checkpoint_every)
    if as_json:
        show_json({"folder": str(folder), **done.info, "metrics": done.metrics})
    elif shown:
        _summary(done, model)
    if not done.ok or (strict and done.info["violations"]):
        raise typer.Exit(1)


def settling(metrics: Mapping[str, Any]) -> str:
    """From when on all links were within their band, in words, as times of the run; "" where there were none."""
    last = metrics.get("formation.last_link_s")
    if not isinstance(last, int | float):
        return ""
    since = metrics.get("formation.settling_s")
    words = "not by the end" if since is None else f"from {number(since)} s"
    return words if last > float(metrics["run.duration_s"]) - 1e-6 else f"{words}, last link at {number(last)} s"


def _summary(done: Run, model: Model) -> None:
    """Where the results lie, and whether the bounds held."""
    from trainctl.runs.outcome import summary

    info, metrics = done.info, done.metrics
    say(model.scenario.title)
    table = listing(None, "", "")
    table.show_header = False
    law = model.scenario.controller.law
    fill(
        table, "law, plant", f"{law} on {model.scenario.plant.kind}, {len(model.scenario.train)} trains, backend {info['backend']}"
    )
    fill(table, "steps", f"{info['steps']} of {model.scenario.run.step_s:g} s in {info['wall_time_s']:.1f} s")
    for key, words, unit in (
        ("bounds.spacing_lower_margin_m", "minimum spacing above its lower bound", "m"),
        ("bounds.spacing_upper_margin_m", "minimum room below the upper spacing bound", "m"),
        ("bounds.speed_lower_margin_mps", "minimum speed above its lower bound", "m/s"),
        ("bounds.speed_upper_margin_mps", "minimum room below the upper speed bound", "m/s"),
        ("bounds.input_lower_margin_mps2", "minimum input above its lower bound", "m/s2"),
        ("bounds.input_upper_margin_mps2", "minimum room below the upper input bound", "m/s2"),
        ("formation.final_error_m", "largest spacing error at the end", "m"),
    ):
        if isinstance(metrics.get(key), int | float):
            fill(table, words, f"{number(metrics[key])} {unit}")
    if words := settling(metrics):
        fill(table, "all links within 1 m", words)
    for line in summary(done):
        fill(table, line.title, f"FAILED: {line.text}" if line.failed else line.text)
    show(table)
    say(f"  results in {done.folder}/\n  trainctl plot {done.folder}\n  trainctl metrics {done.folder}\n")
    for note in model.roster.notes:
        say(f"warning: {note}")


@app.command("list")
def list_(as_json: Json = False) -> None:
    """List the scenarios that come with the package."""
    from trainctl.scenario.reading import read, shipped

    rows = []
    for name in shipped():
        data, path = read(name)
        rows.append({"name": name, "law": data["controller"]["law"], "title": data["title"], "file": str(path)})
    if as_json:
        show_json(rows)
        return
    table = listing(None, "name", "law", "title")
    for row in rows:
        fill(table, row["name"], row["law"], row["title"])
    show(table)


@app.command()
def check(name: ScenarioName = DEFAULT_SCENARIO, settings: Settings = None, as_json: Json = False) -> None:
    """Check a scenario without running it: every mistake, every assumption of its law, and what follows from them.

    A law that is a file is a program: it is executed.
    """
    model = named(name, settings)
    from trainctl.scenario.check import facts, in_words

    found = facts(model)
    if as_json:
        show_json(found)
        return
    say(f"{model.file}: no mistakes, no start condition of {model.scenario.controller.law} violated")
    table = listing(None, "", "")
    table.show_header = False
    for row in in_words(found):
        fill(table, *row)
    show(table)
    for title, lines in (("protection", found.get("promise", ())), ("followed of SUMO's files", found["followed"])):
        for k, line in enumerate(lines):
            say(f"  - {line}" if k else f"{title}: {line}")
    for line in found["report"]:
        say(line)
    for line in found["warnings"]:
        say(f"warning: {line}")


@app.command()
def metrics(
    folder: Annotated[
        Path | None, typer.Argument(help="Run folder, or an FCD file of SUMO's (.xml, .xml.gz, .csv, .parquet).")
    ] = None,
    band_m: Annotated[float, typer.Option(help="Band for settling of spacings [m].")] = 1.0,
    section_m: Annotated[float | None, typer.Option(help="Kilometrage at which trains are counted [m].")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Also the values of each train, link and unit.")] = False,
    only: Annotated[str | None, typer.Option(help="Only metrics whose names begin like this: bounds, energy, traffic.gap.")] = None,
    names: Annotated[bool, typer.Option("--list", help="List all metrics with units and definitions.")] = False,
    as_json: Json = False,
) -> None:
    """Compute the metrics of a run, or of any SUMO FCD file."""
    from trainctl.metrics import run as measured

    if names:
        if as_json:
            show_json({key: {"unit": unit, "definition": text} for key, (unit, text) in measured.DEFINITIONS.items()})
            return
        table = listing(None, "metric", "unit", "definition")
        for key, (unit, text) in measured.DEFINITIONS.items():
            fill(table, key, unit, text)
        show(table)
        return
    if folder is None:
        raise InputError("metrics: give a run folder or an FCD file, or --list")
    if folder.is_dir():
        from trainctl.runs.run import Run

        values = measured.metrics(Run(folder), band_m=band_m, section_m=section_m)
    else:
        from trainctl.metrics.traffic import metrics_of_fcd

        values = metrics_of_fcd(folder)
    if only is not None:
        kept = {key: value for key, value in values.items() if key.startswith(only)}
        if not kept:
            groups = dict.fromkeys(key.partition(".")[0] for key in values)
            raise InputError(f"--only {only}: no metric begins like this; there are: {', '.join(groups)}")
        values = kept
    if as_json:
        show_json(values)
        return
    table = listing(str(folder), "metric", "value", "unit")
    group = ""
    for key, value in values.items():
        if everything or "/" not in key:
            if group and group != key.partition(".")[0]:
                table.add_section()
            group = key.partition(".")[0]
            unit = measured.DEFINITIONS.get(key.partition("/")[0], ("", ""))[0]
            fill(table, key, number(value), unit)
    show(table)


@app.command()
def plot(
    folder: RunFolder,
    out: Annotated[Path | None, typer.Option(help="Where the figures go; default FOLDER/figures.")] = None,
    formats: Annotated[list[str] | None, typer.Option("--format", help="png, svg, pdf; repeatable; default png.")] = None,
    width: Annotated[Literal["single", "double"], typer.Option(help="A column of print (85 mm) or a page (178 mm).")] = "double",
    clock: Annotated[bool, typer.Option("--clock", help="Time in hours and minutes of the run.")] = False,
    kmh: Annotated[bool, typer.Option("--kmh", help="Speeds in km/h.")] = False,
    caption: Annotated[bool, typer.Option("--caption", help="Title, law, version and seed below every figure.")] = False,
) -> None:
    """Draw all figures that apply to a run."""
    from trainctl.figures.catalogue import plot as draw
    from trainctl.runs.run import Run

    wanted = tuple(formats or ("png",))
    wrong = [f for f in wanted if f not in ("png", "svg", "pdf")]
    if wrong:
        raise InputError([f"--format {f}: must be one of png, svg, pdf" for f in wrong])
    for path in draw(Run(folder), out or folder / "figures", wanted, width, clock=clock, kmh=kmh, caption=caption):
        say(path)


@app.command()
def schema(
    law: Annotated[str | None, typer.Option(help="Also the keys of this law's [controller] table.")] = None,
) -> None:
    """Print the JSON Schema of scenario files.

    A law that is a file is a program: it is executed.
    """
    from trainctl.laws import find_law, laws
    from trainctl.scenario.tables import Scenario

    if law is not None:
        show_json(find_law(law).Params.model_json_schema())
        return
    found = Scenario.model_json_schema()
    found["x-laws"] = {name: find_law(name).Params.model_json_schema() for name in laws()}
    show_json(found)


def _version(wanted: bool) -> None:
    if wanted:
        from trainctl.record.folder import installed

        say(f"trainctl {installed('trainctl')}, SUMO {installed('libsumo') or 'not installed'}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Versions of trainctl and SUMO.")
    ] = False,
) -> None:
    """Closed-loop testbed for cooperative train control on SUMO rail networks."""


cite.register(app)
diff.register(app)
extend.register(app)
golden.register(app)
net.register(networks)
report.register(app)
resume.register(app)
sweep.register(app)
tune.register(app)


def _tell(lines: Iterable[str]) -> None:
    for line in lines:
        say(line, error=True)


def main() -> None:
    """Entry point: every error of ours is one line per mistake and an exit code, never a traceback."""
    try:
        code = app(standalone_mode=False)
        if code == 130:  # the command line parser has swallowed the interrupt
            _tell(["trainctl: interrupted"])
        sys.exit(code if isinstance(code, int) else 0)
    except SystemExit as end:
        if isinstance(end.__context__, BrokenPipeError):  # which the parser turns into 1
            sys.exit(3)
        raise
    except InputError as error:
        _tell(error.mistakes)
        sys.exit(error.exit_code)
    except TrainctlError as error:
        _tell([f"trainctl: {error}"])
        sys.exit(error.exit_code)
    except ImportError as error:
        if not (words := left_out(error.name or "")):
            raise
        _tell([f"trainctl: {words}"])
        sys.exit(2)
    except (KeyboardInterrupt, typer.Abort):
        _tell(["trainctl: interrupted"])
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(3)
    except OSError as error:
        _tell([f"trainctl: {error}"])
        sys.exit(3)
    except Exception as error:
        if not hasattr(error, "format_message"):  # not one of the command line parser's own
            raise
        error.show()  # type: ignore[attr-defined]
        sys.exit(2)
