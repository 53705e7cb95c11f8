"""``trainctl golden``: baselines of runs and logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainctl.cli.diff import (
    Absolute,
    AsJson,
    Form,
    Html,
    InTime,
    Junit,
    Rows,
    TolerancesFile,
    Zero,
    chosen_form,
    chosen_tolerances,
    compared,
)

Source = Annotated[Path, typer.Argument(help="Run folder, log of SUMO's or folder of these.")]
Golden = Annotated[Path, typer.Argument(help="Folder of the golden.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    golden = typer.Typer(help="Keep a run or logs as a golden, and compare later ones with it.", no_args_is_help=True)
    app.add_typer(golden, name="golden")

    @golden.command()
    def make(
        source: Source, golden: Golden, every_s: Annotated[float, typer.Option(help="Time between kept instants [s].")] = 60.0
    ) -> None:
        """Keep a run or SUMO's logs as a golden: thinned in time, without clocks and paths, compressed.

        A golden that is there is replaced without a comparison; `trainctl golden update` shows what moves.
        """
        from trainctl.diff.golden import make_golden

        place = make_golden(source, golden, every_s)
        size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file())
        print(f"{place}: {size / 1000:.0f} kB")

    @golden.command()
    def check(
        source: Source,
        golden: Golden,
        tolerances: TolerancesFile = None,
        tolerance: Absolute = None,
        time_tolerance: InTime = None,
        zero: Zero = False,
        form: Form = None,
        as_json: AsJson = False,
        rows: Rows = False,
        junit: Junit = None,
        html: Html = None,
    ) -> None:
        """Compare a run or logs with their golden: the same as `trainctl diff GOLDEN SOURCE`; exit 1 if they differ."""
        chosen = chosen_tolerances(tolerances, tolerance, time_tolerance, zero)
        compared(golden, source, chosen, chosen_form(form, as_json, rows), rows, junit, html, False)

    @golden.command()
    def update(
        source: Source,
        golden: Golden,
        tolerances: TolerancesFile = None,
        tolerance: Absolute = None,
        time_tolerance: InTime = None,
        zero: Zero = False,
    ) -> None:
        """Show what moves, and renew the golden: the same as `trainctl diff GOLDEN SOURCE --accept`."""
        chosen = chosen_tolerances(tolerances, tolerance, time_tolerance, zero)
        compared(golden, source, chosen, "text", False, None, None, True)
