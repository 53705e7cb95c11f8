"""Commands for work outside of the package: a new law, logs for other programs, a run replayed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from trainctl.cli.console import say
from trainctl.errors import InputError

RunFolder = Annotated[Path, typer.Argument(help="Run folder, as `trainctl run` made it.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    new = typer.Typer(help="Start something of your own: a control law, a scenario.", no_args_is_help=True)
    app.add_typer(new, name="new")
    new.command("controller")(new_controller)
    new.command("scenario")(new_scenario)
    app.command("export")(export)
    app.command("replay")(replay)


def new_controller(
    name: Annotated[str, typer.Argument(help="Name of the law: a Python identifier, e.g. my_law.")],
    out: Annotated[Path | None, typer.Option(help="Folder to make; default NAME.")] = None,
) -> None:
    """Write a control law, its scenario on three_tracks and its tests into a folder of yours."""
    from trainctl.new import controller

    folder = out or Path(name)
    for path in controller(name, folder):
        say(path)
    say(f"\nNext:\n  trainctl run {folder / name}.toml\n  python -m pytest {folder}")


def new_scenario(
    sumocfg: Annotated[Path, typer.Argument(help="SUMO configuration with rail traffic.")],
    out: Annotated[Path | None, typer.Option(help="File to make; default NAME.toml in the folder you are in.")] = None,
) -> None:
    """Write a scenario for the trains of a SUMO configuration: law, bounds and spacing fit the speeds found."""
    from trainctl.scenario.build import open_scenario
    from trainctl.scenario.starter import starter

    file = out or Path(f"{sumocfg.stem}.toml")
    if file.exists():
        raise InputError(f"{file}: exists: choose another --out")
    text = starter(sumocfg, file.parent)
    file.write_text(text, encoding="utf-8")
    open_scenario(str(file))
    say(f"{file}\n\nNext:\n  trainctl check {file}\n  trainctl run {file}")


def export(
    folder: RunFolder,
    form: Annotated[
        Literal["csv", "mat"], typer.Option("--format", help="csv: a file per table; mat: one file for MATLAB.")
    ] = "csv",
    out: Annotated[
        Path | None, typer.Option(help="csv: folder, default RUN/export; mat: file, default RUN/export/RUN.mat.")
    ] = None,
) -> None:
    """Write the tables of a run for other programs; units are in the names of the columns."""
    from trainctl.runs.export import to_csv, to_mat
    from trainctl.runs.run import Run

    run = Run(folder)
    if form == "csv":
        for path in to_csv(run, out or folder / "export"):
            say(path)
    else:
        say(to_mat(run, out or folder / "export" / f"{folder.resolve().name}.mat"))


def replay(
    folder: RunFolder,
    from_s: Annotated[float, typer.Option(help="Begin at this time of the run [s].")] = 0.0,
    delay_ms: Annotated[float, typer.Option(help="Minimum time of a step on the screen [ms].")] = 20.0,
    gui_program: Annotated[str, typer.Option(help="The program to start; sumo is the same without a window.")] = "sumo-gui",
) -> None:
    """Replay a run in sumo-gui, as it was recorded."""
    from trainctl.runs.run import Run
    from trainctl.sumo.replay import replay as show

    if from_s < 0.0 or delay_ms < 0.0:
        raise InputError("--from-s and --delay-ms: must not be negative")
    say(f"{show(Run(folder), gui_program, from_s, delay_ms)} steps shown")
