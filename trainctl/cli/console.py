"""What all commands share: the application, its options in common, and printing. Heavy modules are imported where they are used."""

from __future__ import annotations

import glob
import json
import math
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trainctl.errors import InputError, visible

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from trainctl.scenario.model import Model

DEFAULT_SCENARIO = "three_tracks"

#: Columns that a table may take where it is not read on a screen: what it needs, no cell is wrapped.
PIPED = 1000

#: Smaller numbers are shown as 0.
ROUNDING = 1e-9


app = typer.Typer(
    name="trainctl",
    help="Closed-loop testbed for cooperative train control on SUMO rail networks.\n\n"
    "Try `trainctl run`, then `trainctl plot runs/three_tracks`. Scenarios are TOML files: `trainctl list` names those that come "
    "with the package, `trainctl schema` describes every key.\n\n"
    "Exit codes: 0 done, 1 a check failed, 2 bad input, 3 the run failed, 130 interrupted.",
    no_args_is_help=True,
    rich_markup_mode="markdown",  # units in brackets are no markup
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
networks = typer.Typer(help="Rail networks: list, build, show, import.", no_args_is_help=True)
app.add_typer(networks, name="net")


def scenario_names(typed: str) -> list[str]:
    """Scenarios that begin like that: shipped ones, and files here."""
    from trainctl.scenario.reading import shipped

    return [name for name in shipped() if name.startswith(typed)] + paths(typed, ".toml")


def run_folders(typed: str) -> list[str]:
    """Run folders that begin like that."""
    from trainctl.record.folder import INFO

    places = [*Path(".").glob("*/"), *Path("runs").glob("*/"), *Path(".").glob(f"{typed}*/")]
    return sorted({str(place) for place in places if str(place).startswith(typed) and (place / INFO).is_file()})


def paths(typed: str, suffix: str) -> list[str]:
    """Files that begin like that, and folders to look in."""
    found = sorted(Path(".").glob(f"{glob.escape(typed)}*"))
    return [f"{path}/" if path.is_dir() else str(path) for path in found if path.is_dir() or path.suffix == suffix]


def settable(typed: str) -> list[str]:
    """Keys of a scenario that begin like that, as ``--set`` takes them."""
    from trainctl.scenario.tables import Scenario

    tables = Scenario.model_json_schema()
    found = []
    for table, about in tables["properties"].items():
        named = [part.get("$ref", "") for part in (about, *about.get("anyOf", ()))]
        keys = [key for ref in named if ref for key in tables["$defs"][ref.rpartition("/")[2]].get("properties", {})]
        found += [f"{table}.{key}=" for key in keys]
    return [key for key in found if key.startswith(typed)]


ScenarioName = Annotated[
    str,
    typer.Argument(
        help="Name of a shipped scenario (see `trainctl list`) or path of a scenario TOML.", autocompletion=scenario_names
    ),
]
RunFolder = Annotated[Path, typer.Argument(help="Run folder, as `trainctl run` made it.", autocompletion=run_folders)]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines instead of a table.")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Override a key, e.g. --set run.duration_s=60. Repeatable.", autocompletion=settable
    ),
]


def named(name: str, settings: list[str] | None) -> Model:
    """The scenario of that name, with these settings."""
    from trainctl.scenario.build import open_scenario

    return open_scenario(name, dict(map(setting, settings or [])))


def setting(text: str) -> tuple[str, Any]:
    """Key and value of a ``--set``."""
    import tomllib

    key, equals, value = text.partition("=")
    if not equals or not key:
        raise InputError(f"--set {text}: must be KEY=VALUE")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value  # a bare word is text


def listing(title: str | None, *columns: str) -> Table:
    """An empty table."""
    from rich import box
    from rich.table import Table

    table = Table(title=title and visible(title), title_justify="left", box=box.SIMPLE_HEAD)
    for k, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=k == 0)
    return table


def number(value: Any) -> str:
    """A number for people: four significant digits, 0 for what is rounding (``--json`` has all); text as it is, "-" for nothing."""
    if value is None:
        return "-"
    if not isinstance(value, float) or not math.isfinite(value):
        return str(value)
    if abs(value) < ROUNDING:
        return "0"
    digits = 3 - math.floor(math.log10(abs(value)))
    if not -4 <= digits <= 7:
        return f"{value:.3e}"
    text = f"{round(value, digits):.{max(digits, 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def fill(table: Table, *cells: RenderableType) -> None:
    """Add a row to a table."""
    table.add_row(*(visible(cell) if isinstance(cell, str) else cell for cell in cells))


def say(*words: Any, error: bool = False) -> None:
    """Print a line of text, to standard error if it is one."""
    print(visible(" ".join(map(str, words))), file=sys.stderr if error else sys.stdout)


def show(table: Table) -> None:
    """Print a table. What stands in its cells is text, not markup."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else PIPED
    Console(width=width, highlight=False, markup=False, emoji=False).print(table)


def show_json(value: Any) -> None:
    """Print for machines."""
    from trainctl.record.folder import plain

    print(json.dumps(plain(value), indent=2))


class Progress:
    """A progress bar on stderr, or nothing; either says when something is compiled first."""

    def __init__(self, title: str, shown: bool, quiet: bool = False) -> None:
        self.title, self.shown, self.quiet = title, shown, quiet

    def __enter__(self) -> Callable[[int, int], None]:
        from trainctl.compiling import compiling

        self.inside = ExitStack()
        self.inside.enter_context(compiling(None if self.quiet else self._tell))
        if not self.shown:
            return lambda done, steps: None
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        columns = (TextColumn(self.title), BarColumn(), MofNCompleteColumn(), TextColumn("steps"), TimeRemainingColumn())
        self.bar = Bar(*columns, console=Console(stderr=True), transient=True)
        self.bar.start()
        self.inside.callback(self.bar.stop)
        task = self.bar.add_task("", total=None)
        return lambda done, steps: self.bar.update(task, completed=done, total=steps)

    def __exit__(self, *_: object) -> None:
        self.inside.close()

    def _tell(self, words: str) -> None:
        """Above the bar, or as a line."""
        if self.shown:
            self.bar.console.print(words)
        else:
            say(words, error=True)
