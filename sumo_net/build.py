"""Write a line as SUMO plain XML and let netconvert make the net."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from sumo_net import kept
from sumo_net.layout import Edge, Floats, Gradient, edges, gradient
from sumo_net.spec import TRACK_SPACING_M, LineError, LineSpec, text

_RAIL = "rail_urban rail rail_electric rail_fast"
_HEADER = re.compile(r"<!--.*?-->", re.DOTALL)


def build(spec: LineSpec, folder: str | Path) -> Path:
    """Write ``NAME.nod.xml``, ``NAME.edg.xml``, ``NAME.con.xml`` and ``NAME.net.xml`` into ``folder``; the path of the last.

    The files depend on the line and the version of netconvert alone. Nothing is written if netconvert fails.

    Raises
    ------
    LineError
        If the folder cannot be written, netconvert is missing, or it refuses the line.
    """
    folder = Path(folder)
    pieces, slopes = edges(spec), gradient(spec)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{spec.name}.", dir=folder) as scratch:
            made = Path(scratch)
            (made / f"{spec.name}.nod.xml").write_text(_nodes(spec, pieces, slopes), encoding="utf-8")
            (made / f"{spec.name}.edg.xml").write_text(_edges(spec, pieces, slopes), encoding="utf-8")
            (made / f"{spec.name}.con.xml").write_text(_connections(pieces), encoding="utf-8")
            _convert(spec.name, made)
            for file in sorted(made.iterdir()):
                file.replace(folder / file.name)
    except OSError as error:
        raise LineError([f"{folder}: the net cannot be built here: {error.strerror}"]) from None
    return folder / f"{spec.name}.net.xml"


def netconvert() -> tuple[Path, dict[str, str]]:
    """SUMO's net builder and the environment it needs."""
    return program("netconvert")


def program(name: str) -> tuple[Path, dict[str, str]]:
    """One of SUMO's programs and the environment it needs: that of the eclipse-sumo wheel, else that of the PATH.

    Raises
    ------
    LineError
        If there is none.
    """
    try:
        from sumo import SUMO_HOME
    except ImportError:
        found = shutil.which(name)
        if found is None:
            raise LineError([f"{name}: not found; install eclipse-sumo, or put SUMO's bin folder on the PATH"]) from None
        return Path(found), dict(os.environ)
    return Path(SUMO_HOME) / "bin" / name, os.environ | {"SUMO_HOME": SUMO_HOME}


def _convert(name: str, folder: Path) -> None:
    program, environment = netconvert()
    options = {
        "node-files": f"{name}.nod.xml", "edge-files": f"{name}.edg.xml", "connection-files": f"{name}.con.xml",
        "output-file": f"{name}.net.xml", "precision": "9", "no-internal-links": "true", "no-turnarounds": "true",
        "offset.disable-normalization": "true", "junctions.minimal-shape": "true", "xml-validation": "never",
    }  # fmt: skip
    command = [word for key, value in options.items() for word in (f"--{key}", value)]
    net, known = folder / f"{name}.net.xml", kept.key(program, command, sorted(folder.iterdir()))
    if (content := kept.find(known)) is not None:
        net.write_bytes(content)
        return
    done = subprocess.run([str(program), *command], cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0 or not net.exists():
        words = done.stderr.splitlines()
        said = [line for line in words if line.startswith("Error")] or words[-1:] or ["it does not say why"]
        raise LineError([f"{name}: netconvert refused the line: {line}" for line in said])
    made = net.read_text(encoding="utf-8")
    # The header has the date and the folder in it: the same line must give the same file.
    version = re.search(r"netconvert ([\w.+-]+)", made)
    header = f"<!-- line {name.replace('--', '- -')}, built by sumo_net with netconvert {version[1] if version else ''} -->"
    content = _HEADER.sub(lambda _: header, made, count=1).encode()
    net.write_bytes(content)
    kept.keep(known, content)


def _node(track: str, position: float) -> str:
    return f"n{track}_{text(position)}"


def _ends(edge: Edge) -> tuple[str, str]:
    """The nodes an edge leads from and to."""
    here = edge.track if edge.crossover is None else edge.crossover.from_track
    return _node(here, edge.start_m), _node(edge.track, edge.end_m)


def _in_space(position: Floats, slopes: Gradient) -> tuple[Floats, Floats]:
    """Horizontal coordinate and height at a kilometrage [m].

    The kilometrage is measured along the rail, so that a shape is exactly as long as its edge and SUMO finds a change of
    gradient where it is.
    """
    angle = np.arctan(slopes.slope)
    stretch = np.diff(slopes.breaks)
    k = np.searchsorted(slopes.breaks, position, side="right") - 1
    behind = position - slopes.breaks[k]
    x = slopes.breaks[0] + np.concatenate(([0.0], np.cumsum(stretch * np.cos(angle[:-1]))))
    z = np.concatenate(([0.0], np.cumsum(stretch * np.sin(angle[:-1]))))
    return x[k] + behind * np.cos(angle[k]), z[k] + behind * np.sin(angle[k])


def _lateral(spec: LineSpec) -> dict[str, float]:
    """Coordinate to the left of the leftmost track, which lies at 0 [m]."""
    return {track: -TRACK_SPACING_M * k for k, track in enumerate(spec.tracks)}


def _number(value: float) -> str:
    """Nine decimals, without the trailing zeros."""
    return f"{value:.9f}".rstrip("0").rstrip(".")


def _nodes(spec: LineSpec, pieces: list[Edge], slopes: Gradient) -> str:
    places: dict[str, tuple[float, str]] = {}
    for e in pieces:
        if e.crossover is None:
            places[_node(e.track, e.start_m)] = (e.start_m, e.track)
            places[_node(e.track, e.end_m)] = (e.end_m, e.track)
    x, z = _in_space(np.array([at for at, _ in places.values()]), slopes)
    y = _lateral(spec)
    signal = dict.fromkeys(spec.signals(), ' type="rail_signal"')
    lines = [
        f'    <node id="{node}" x="{_number(x[k])}" y="{_number(y[track])}" z="{_number(z[k])}" radius="0"{signal.get(at, "")}/>'
        for k, (node, (at, track)) in enumerate(places.items())
    ]
    return "\n".join(["<nodes>", *lines, "</nodes>", ""])


def _edges(spec: LineSpec, pieces: list[Edge], slopes: Gradient) -> str:
    y = _lateral(spec)
    lines = ["<edges>"]
    for e in pieces:
        here, there = _ends(e)
        side = y[e.track if e.crossover is None else e.crossover.from_track]
        inside = slopes.breaks[(slopes.breaks > e.start_m) & (slopes.breaks < e.end_m)]
        at = np.concatenate(([e.start_m], inside, [e.end_m]))
        x, z = _in_space(at, slopes)
        across = side + (y[e.track] - side) * (at - e.start_m) / (e.end_m - e.start_m)
        shape = " ".join(f"{_number(a)},{_number(b)},{_number(c)}" for a, b, c in zip(x, across, z, strict=True))
        lines.append(
            f'    <edge id="{e.id}" from="{here}" to="{there}" priority="{1 if e.crossover else 2}" numLanes="1"'
            f' speed="{_number(e.speed_mps)}" length="{text(e.length_m)}" distance="{text(e.start_m)}"'
            f' allow="{_RAIL}" spreadType="center" shape="{shape}">'
        )
        lines += [f'        <param key="{key}" value="{value}"/>' for key, value in _params(e, slopes).items()]
        lines.append("    </edge>")
    return "\n".join([*lines, "</edges>", ""])


def _params(edge: Edge, slopes: Gradient) -> dict[str, str]:
    """What the line coordinate needs to know of an edge and SUMO has no attribute for."""
    params = {"track": edge.track}
    if edge.crossover is not None:
        return params | {"crossover": edge.crossover.name, "from_track": edge.crossover.from_track}
    k = int(np.searchsorted(slopes.breaks, edge.start_m, side="right")) - 1
    here = [(edge.start_m, slopes.slope[k])]
    here += [(at, slope) for at, slope in zip(slopes.breaks, slopes.slope, strict=True) if edge.start_m < at < edge.end_m]
    if slopes.slope.any():
        params["slope"] = " ".join(f"{text(at)}:{float(slope)!r}" for at, slope in here)
    return params


def _connections(pieces: list[Edge]) -> str:
    """Every edge that ends at a node leads into every edge that begins there: straight on, off the track, onto the track."""
    begin: dict[str, list[str]] = {}
    for e in pieces:
        begin.setdefault(_ends(e)[0], []).append(e.id)
    lines = [
        f'    <connection from="{e.id}" to="{onward}" fromLane="0" toLane="0"/>'
        for e in pieces
        for onward in begin.get(_ends(e)[1], [])
    ]
    return "\n".join(["<connections>", *lines, "</connections>", ""])
