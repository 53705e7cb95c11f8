"""``trainctl net import``: lines and trains of other projects as our TOML."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from trainctl.errors import InputError


def register(net: typer.Typer) -> None:
    """Add the command to the group ``net``."""
    net.command("import")(net_import)


def net_import(
    file: Annotated[Path, typer.Argument(help="TTOBench track or train (JSON), railtoolkit running path or rolling stock (YAML).")],
    out: Annotated[Path, typer.Option(help="Folder for NAME.toml.")] = Path(),
    name: Annotated[str | None, typer.Option(help="Name of the line or train type; default its id in the file.")] = None,
    item: Annotated[str | None, typer.Option(help="Id of the path or train, where the file has several.")] = None,
    tracks: Annotated[int, typer.Option(min=1, max=20, help="Lines: number of parallel tracks.")] = 1,
    length_m: Annotated[
        float | None, typer.Option(min=0.1, help="Length of the line, or of the train, where the file does not tell it [m].")
    ] = None,
    before_m: Annotated[float, typer.Option(min=0.0, help="Lines: level track added before the beginning [m].")] = 0.0,
    after_m: Annotated[float, typer.Option(min=0.0, help="Lines: level track added beyond the end [m].")] = 0.0,
    units: Annotated[int, typer.Option(min=1, max=64, help="TTOBench trains: number of equal units.")] = 1,
    load_share: Annotated[float, typer.Option(min=0.0, max=1.0, help="railtoolkit trains: share of the load limit.")] = 1.0,
    deceleration_mps2: Annotated[
        float | None,
        typer.Option(min=0.01, max=5.0, help="railtoolkit trains: braking, where the file has none [m/s2]."),
    ] = None,
    coupler_stiffness_n_per_m: Annotated[
        float | None, typer.Option(min=0.0, help="Trains of several units: stiffness of their couplers [N/m].")
    ] = None,
    coupler_damping_ns_per_m: Annotated[
        float | None, typer.Option(min=0.0, help="Trains of several units: damping of their couplers [N s/m].")
    ] = None,
) -> None:
    """Read a line or a train of another project into a TOML file: a line description, or the table of a train type."""
    from sumo_net import LineError
    from sumo_net.importing import Options, convert

    options = Options(
        name, item, length_m, tracks, before_m, after_m, units, load_share, deceleration_mps2,
        coupler_stiffness_n_per_m, coupler_damping_ns_per_m,
    )  # fmt: skip
    try:
        found = convert(file, options)
    except LineError as error:
        raise InputError(error.mistakes) from None
    try:
        out.mkdir(parents=True, exist_ok=True)
        path = out / f"{found.name}.toml"
        path.write_text(found.toml, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written: {error.strerror}") from None
    print(path)
    for note in found.notes:
        print(f"note: {note}")
