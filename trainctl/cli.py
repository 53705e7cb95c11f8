"""The command line. Heavy modules are imported inside the commands: ``trainctl --help`` answers at once."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from trainctl import cli_diff, cli_extend, cli_golden, cli_import, cli_report, cli_resume, cli_sweep
from trainctl.errors import InputError, TrainctlError

if TYPE_CHECKING:
    from rich.table import Table

    from trainctl.prepare import Prepared
    from trainctl.record.run import Run

DEFAULT_SCENARIO = "three_tracks"

app = typer.Typer(
    name="trainctl",
    help="Closed-loop testbed for cooperative train control on SUMO rail networks.\n\n"
    "Try `trainctl run`, then `trainctl plot runs/three_tracks`. Scenarios are TOML files: `trainctl list` names those that come "
    "with the package, `trainctl schema` describes every key.\n\n"
    "Exit codes: 0 done, 1 a check failed, 2 bad input, 3 the run failed, 130 interrupted.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
net = typer.Typer(help="Rail networks: list, build, show.", no_args_is_help=True)
app.add_typer(net, name="net")

ScenarioName = Annotated[str, typer.Argument(help="Name of a shipped scenario (see `trainctl list`) or path of a scenario TOML.")]
RunFolder = Annotated[Path, typer.Argument(help="Run folder, as `trainctl run` made it.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key, e.g. --set run.duration_s=60. Repeatable.")
]


def _scenario(name: str, settings: list[str] | None) -> Prepared:
    from trainctl.prepare import open_scenario

    return open_scenario(name, dict(map(_setting, settings or [])))


def _setting(text: str) -> tuple[str, Any]:
    import tomllib

    key, equals, value = text.partition("=")
    if not equals or not key:
        raise InputError(f"--set {text}: must be KEY=VALUE")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value  # a bare word is text


def _table(title: str | None, *columns: str) -> Table:
    from rich import box
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for k, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=k == 0)
    return table


def _print(*things: Any) -> None:
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 120, highlight=False).print(*things)


def _print_json(value: Any) -> None:
    from trainctl.record.folder import plain

    print(json.dumps(plain(value), indent=2))


@app.command()
def run(
    name: ScenarioName = DEFAULT_SCENARIO,
    out: Annotated[Path | None, typer.Option(help="Run folder; default runs/NAME. A run of ours there is replaced.")] = None,
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
    strict: Annotated[bool, typer.Option("--strict", help="Exit 1 if any bound was broken.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress bar, no summary.")] = False,
    as_json: Json = False,
) -> None:
    """Run a scenario into a run folder: logs, metrics, SUMO's own logs."""
    from trainctl import runner

    if gui and backend == "numeric":
        raise InputError("--gui: shows SUMO; leave out --backend numeric")
    if record_every is not None:
        settings = [*(settings or []), f"run.record_every_s={record_every!r}"]
    prepared = _scenario(name, settings)
    folder = out if out is not None else Path("runs") / Path(name).stem
    shown = not (quiet or as_json)
    with _progress(f"{Path(name).stem}", shown and sys.stderr.isatty()) as advance:
        done = runner.run(prepared, folder, backend, force, sys.argv, advance, gui_program if gui else None, checkpoint_every)
    if as_json:
        _print_json({"folder": str(folder), **done.info, "metrics": done.metrics})
    elif shown:
        _summary(done, prepared)
    if strict and done.info["violations"]:
        raise typer.Exit(1)


class _progress:
    """A progress bar on stderr, or nothing."""

    def __init__(self, title: str, shown: bool) -> None:
        self.title, self.shown = title, shown

    def __enter__(self) -> Callable[[int, int], None]:
        if not self.shown:
            return lambda done, steps: None
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn(self.title), BarColumn(), MofNCompleteColumn(), TextColumn("steps"), TimeRemainingColumn())
        self.bar = Progress(*columns, console=Console(stderr=True), transient=True)
        self.bar.start()
        task = self.bar.add_task("", total=None)
        return lambda done, steps: self.bar.update(task, completed=done, total=steps)

    def __exit__(self, *_: object) -> None:
        if self.shown:
            self.bar.stop()


def _summary(done: Run, prepared: Prepared) -> None:
    """Where the results lie, and whether the bounds held."""
    info, metrics = done.info, done.metrics
    print(prepared.scenario.title)
    table = _table(None, "", "")
    table.show_header = False
    law = prepared.scenario.controller.law
    table.add_row(
        "law, plant", f"{law} on {prepared.scenario.plant.kind}, {len(prepared.scenario.train)} trains, backend {info['backend']}"
    )
    table.add_row("steps", f"{info['steps']} of {prepared.scenario.run.step_s:g} s in {info['wall_time_s']:.1f} s")
    for key, words, unit in (
        ("bounds.spacing_lower_margin_m", "least spacing above its lower bound", "m"),
        ("bounds.spacing_upper_margin_m", "least room below the upper spacing bound", "m"),
        ("bounds.speed_lower_margin_mps", "least speed above its lower bound", "m/s"),
        ("bounds.speed_upper_margin_mps", "least room below the upper speed bound", "m/s"),
        ("bounds.input_lower_margin_mps2", "least input above its lower bound", "m/s2"),
        ("bounds.input_upper_margin_mps2", "least room below the upper input bound", "m/s2"),
        ("formation.settling_s", "all links within 1 m from", "s"),
        ("formation.final_error_m", "largest spacing error at the end", "m"),
    ):
        if isinstance(metrics.get(key), int | float):
            table.add_row(words, f"{metrics[key]:.6g} {unit}")
    broken = info["violations"]
    where = ""
    if first := info.get("first_violation"):
        where = f", first {first['bound']} of {first['who']} at {first['time_s']:g} s"
    table.add_row("bounds", "all held" if not broken else f"{broken} broken{where}: see kind = violation in events.jsonl")
    table.add_row("results", f"{done.folder}/  (trainctl plot {done.folder}; trainctl metrics {done.folder})")
    _print(table)
    for note in () if prepared.roster is None else prepared.roster.notes:
        print(f"warning: {note}")


@app.command("list")
def list_(as_json: Json = False) -> None:
    """List the scenarios that come with the package."""
    from trainctl.reading import read, shipped

    rows = []
    for name in shipped():
        data, path = read(name)
        rows.append({"name": name, "law": data["controller"]["law"], "title": data["title"], "file": str(path)})
    if as_json:
        _print_json(rows)
        return
    table = _table(None, "name", "law", "title")
    for row in rows:
        table.add_row(row["name"], row["law"], row["title"])
    _print(table)


@app.command()
def check(name: ScenarioName = DEFAULT_SCENARIO, settings: Settings = None, as_json: Json = False) -> None:
    """Check a scenario without running it: every mistake, every assumption of its law, and what follows from them."""
    prepared = _scenario(name, settings)
    from trainctl.facts import facts

    found = facts(prepared)
    if as_json:
        _print_json(found)
        return
    print(f"{prepared.file}: no mistakes, no start condition of {prepared.scenario.controller.law} broken")
    table = _table(None, "", "")
    table.show_header = False
    for key, value in found.items():
        if key not in ("warnings", "report", "analysis"):
            table.add_row(key, str(value))
    _print(table)
    for line in found["report"]:
        print(line)
    for line in found["warnings"]:
        print(f"warning: {line}")


@app.command()
def metrics(
    folder: Annotated[
        Path | None, typer.Argument(help="Run folder, or an FCD file of SUMO's (.xml, .xml.gz, .csv, .parquet).")
    ] = None,
    band_m: Annotated[float, typer.Option(help="Band for settling of spacings [m].")] = 1.0,
    section_m: Annotated[float | None, typer.Option(help="Kilometrage at which trains are counted [m].")] = None,
    everything: Annotated[bool, typer.Option("--all", help="Also the values of each train, link and unit.")] = False,
    names: Annotated[bool, typer.Option("--list", help="List all metrics with units and definitions.")] = False,
    as_json: Json = False,
) -> None:
    """Compute the metrics of a run, or of any SUMO FCD file."""
    from trainctl.record import metrics as measured

    if names:
        if as_json:
            _print_json({key: {"unit": unit, "definition": text} for key, (unit, text) in measured.DEFINITIONS.items()})
            return
        table = _table(None, "metric", "unit", "definition")
        for key, (unit, text) in measured.DEFINITIONS.items():
            table.add_row(key, unit, text)
        _print(table)
        return
    if folder is None:
        raise InputError("metrics: give a run folder or an FCD file, or --list")
    if folder.is_dir():
        from trainctl.record.run import Run

        values = measured.metrics(Run(folder), band_m=band_m, section_m=section_m)
    else:
        from trainctl.record.traffic import metrics_of_fcd

        values = metrics_of_fcd(folder)
    if as_json:
        _print_json(values)
        return
    table = _table(str(folder), "metric", "value", "unit")
    for key, value in values.items():
        if everything or "/" not in key:
            unit = measured.DEFINITIONS.get(key.partition("/")[0], ("", ""))[0]
            table.add_row(key, f"{value:.6g}" if isinstance(value, float) else str(value), unit)
    _print(table)


@app.command()
def plot(
    folder: RunFolder,
    out: Annotated[Path | None, typer.Option(help="Where the figures go; default FOLDER/figures.")] = None,
    formats: Annotated[list[str] | None, typer.Option("--format", help="png, svg, pdf; repeatable; default png.")] = None,
    width: Annotated[Literal["single", "double"], typer.Option(help="A column of print (85 mm) or a page (178 mm).")] = "double",
) -> None:
    """Draw all figures that apply to a run."""
    from trainctl.record.figures import plot as draw
    from trainctl.record.run import Run

    wanted = tuple(formats or ("png",))
    wrong = [f for f in wanted if f not in ("png", "svg", "pdf")]
    if wrong:
        raise InputError([f"--format {f}: must be one of png, svg, pdf" for f in wrong])
    for path in draw(Run(folder), out or folder / "figures", wanted, width):
        print(path)


@app.command()
def schema(
    law: Annotated[str | None, typer.Option(help="Also the keys of this law's [controller] table.")] = None,
) -> None:
    """Print the JSON Schema of scenario files."""
    from trainctl.laws import find_law, laws
    from trainctl.scenario import Scenario

    if law is not None:
        _print_json(find_law(law).Params.model_json_schema())
        return
    found = Scenario.model_json_schema()
    found["x-laws"] = {name: find_law(name).Params.model_json_schema() for name in laws()}
    _print_json(found)


@net.command("list")
def net_list() -> None:
    """List the lines that come with the package."""
    import sumo_net

    table = _table(None, "name", "tracks", "kilometrage", "crossovers")
    for name, path in sumo_net.shipped().items():
        line = sumo_net.Line.of(_line_spec(str(path)))
        table.add_row(
            name, ", ".join(line.track_ids), f"{line.begin_m / 1000:g} .. {line.end_m / 1000:g} km", str(len(line.crossovers))
        )
    _print(table)


@net.command("build")
def net_build(
    name: Annotated[str, typer.Argument(help="Name of a shipped line or path of a line TOML.")],
    out: Annotated[Path, typer.Option(help="Folder for the SUMO sources and the net.")] = Path(),
) -> None:
    """Build a line's SUMO net: plain XML and, through netconvert, NAME.net.xml."""
    import sumo_net

    out.mkdir(parents=True, exist_ok=True)
    print(_net(lambda: sumo_net.build(_line_spec(name), out)))


@net.command("show")
def net_show(
    name: Annotated[str, typer.Argument(help="Name of a shipped line, path of a line TOML or of any SUMO rail net.")],
    out: Annotated[Path | None, typer.Option(help="Picture file (.png, .svg, .pdf); default NAME.png.")] = None,
    from_m: Annotated[float | None, typer.Option(help="Show from this kilometrage on [m].")] = None,
    to_m: Annotated[float | None, typer.Option(help="Show up to this kilometrage [m].")] = None,
) -> None:
    """Draw tracks and crossovers of a line, or any SUMO rail net as it lies."""
    import sumo_net
    from sumo_net.picture import show, show_net
    from sumo_net.shapes import built_here

    path = out or Path(f"{Path(name).name.split('.')[0]}.png")
    net = name.endswith((".xml", ".xml.gz"))
    if net and not _net(lambda: built_here(Path(name))):
        if from_m is not None or to_m is not None:
            raise InputError(f"--from-m, --to-m: {name} has no kilometrage; only lines built by `trainctl net build` have one")
        print(_net(lambda: show_net(name, path)))
        return
    line = _net(lambda: sumo_net.Line.read(name) if net else sumo_net.Line.of(_line_spec(name)))
    _net(lambda: show(line, path, from_m=from_m, to_m=to_m))
    print(path)


def _line_spec(name: str) -> Any:
    import sumo_net

    known = sumo_net.shipped()
    if name not in known and not name.endswith(".toml"):
        raise InputError(f"{name}: no such line; known: {', '.join(known)}, or the path of a line .toml")
    return _net(lambda: sumo_net.read_spec(known.get(name, Path(name))))


def _net(action: Callable[[], Any]) -> Any:
    from sumo_net import LineError

    try:
        return action()
    except LineError as error:
        raise InputError(error.mistakes) from None


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"trainctl {version('trainctl')}, SUMO {version('libsumo')}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Versions of trainctl and SUMO.")
    ] = False,
) -> None:
    """Closed-loop testbed for cooperative train control on SUMO rail networks."""


cli_diff.register(app)
cli_extend.register(app)
cli_golden.register(app)
cli_import.register(net)
cli_report.register(app)
cli_resume.register(app)
cli_sweep.register(app)


def _tell(lines: Iterable[str]) -> None:
    for line in lines:
        print(line, file=sys.stderr)


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
