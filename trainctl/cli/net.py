"""``trainctl net``: rail networks, and lines and trains of other projects as our TOML."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from trainctl.cli.console import fill, listing, say, show
from trainctl.errors import InputError


def register(group: typer.Typer) -> None:
    """Add the commands to the group ``net``."""
    group.command("list")(net_list)
    group.command("build")(net_build)
    group.command("show")(net_show)
    group.command("import")(net_import)


def net_import(
    file: Annotated[Path, typer.Argument(help="TTOBench track or train (JSON), railtoolkit running path or rolling stock (YAML).")],
    out: Annotated[Path, typer.Option(help="Folder for NAME.toml.")] = Path(),
    name: Annotated[str | None, typer.Option(help="Name of the line or train type; default its id in the file.")] = None,
    item: Annotated[str | None, typer.Option(help="Id of the path or train, where the file has several.")] = None,
    tracks: Annotated[int, typer.Option(min=1, max=20, help="Lines: number of parallel tracks.")] = 1,
    length_m: Annotated[
        float | None, typer.Option(min=0.1, help="Length of the line, or of the train, where the file does not state it [m].")
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
    say(path)
    for note in found.notes:
        say(f"note: {note}")


def net_list() -> None:
    """List the lines that come with the package."""
    import sumo_net

    table = listing(None, "name", "tracks", "kilometrage", "crossovers")
    for name, path in sumo_net.shipped().items():
        line = sumo_net.Line.of(spec_of(str(path)))
        fill(
            table,
            name,
            ", ".join(line.track_ids),
            f"{line.begin_m / 1000:g} .. {line.end_m / 1000:g} km",
            str(len(line.crossovers)),
        )
    show(table)


def net_build(
    name: Annotated[str, typer.Argument(help="Name of a shipped line or path of a line TOML.")],
    out: Annotated[Path, typer.Option(help="Folder for the SUMO sources and the net.")] = Path(),
) -> None:
    """Build a line's SUMO net: plain XML and, through netconvert, NAME.net.xml."""
    import sumo_net

    out.mkdir(parents=True, exist_ok=True)
    say(asked(lambda: sumo_net.build(spec_of(name), out)))


def net_show(
    name: Annotated[str, typer.Argument(help="Name of a shipped line, path of a line TOML or of any SUMO rail net.")],
    out: Annotated[Path | None, typer.Option(help="Picture file (.png, .svg, .pdf); default NAME.png.")] = None,
    from_m: Annotated[float | None, typer.Option(help="Show from this kilometrage on [m].")] = None,
    to_m: Annotated[float | None, typer.Option(help="Show up to this kilometrage [m].")] = None,
) -> None:
    """Draw tracks and crossovers of a line, or a map of any SUMO rail net."""
    import sumo_net
    from sumo_net.picture import show as draw
    from sumo_net.picture import show_net
    from sumo_net.shapes import built_here

    path = out or Path(f"{Path(name).name.split('.')[0]}.png")
    net = name.endswith((".xml", ".xml.gz"))
    if net and not asked(lambda: built_here(Path(name))):
        if from_m is not None or to_m is not None:
            raise InputError(f"--from-m, --to-m: {name} has no kilometrage; only lines built by `trainctl net build` have one")
        say(asked(lambda: show_net(name, path)))
        return
    line = asked(lambda: sumo_net.Line.read(name) if net else sumo_net.Line.of(spec_of(name)))
    asked(lambda: draw(line, path, from_m=from_m, to_m=to_m))
    say(path)


def spec_of(name: str) -> Any:
    """The description of a line, by name or path."""
    import sumo_net

    known = sumo_net.shipped()
    if name not in known and not name.endswith(".toml"):
        raise InputError(f"{name}: no such line; known: {', '.join(known)}, or the path of a line .toml")
    return asked(lambda: sumo_net.read_spec(known.get(name, Path(name))))


def asked(action: Callable[[], Any]) -> Any:
    """Do something with a net; its mistakes are those of the input."""
    from sumo_net import LineError

    try:
        return action()
    except LineError as error:
        raise InputError(error.mistakes) from None
