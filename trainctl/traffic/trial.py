"""What is in doubt is tried by the ``sumo`` program: nets and files that SUMO refuses may kill the process that loads them."""

from __future__ import annotations

import subprocess
import tempfile
from functools import cache
from pathlib import Path

from sumo_net.build import program
from sumo_net.netfile import NetFile, content
from trainctl.errors import InputError
from trainctl.traffic.files import parse
from trainctl.traffic.known import NET_CONNECTION, NET_EDGE, NET_LANE

#: Seconds after which SUMO is taken for stuck.
PATIENCE_S = 120.0

#: Attributes whose values may be empty.
_MAY_BE_EMPTY = {"name", "type", "shape", "allow", "disallow", "tl", "key", "value"}


def in_doubt(net: Path, file: NetFile) -> bool:
    """Whether a net is none that SUMO's own programs wrote: by its head, an attribute that they do not know, or an empty one."""
    if not any(maker in content(net)[:2000] for maker in (b"netconvert", b"netedit", b"netgenerate")):
        return True
    rows = [(e.attributes, NET_EDGE) for e in file.edges] + [(c, NET_CONNECTION) for c in file.connections]
    rows += [(lane, NET_LANE) for e in file.edges for lane in e.lanes]
    return any(key not in known or (not value and key not in _MAY_BE_EMPTY) for row, known in rows for key, value in row.items())


def tried(net: Path) -> None:
    """Let the ``sumo`` program load a net.

    Raises
    ------
    InputError
        SUMO refuses it, in its words.
    """
    _loaded(str(net), "-n", str(net), "--end", "0")


def tried_as_a_whole(configuration: Path, begin_s: float, called: str) -> None:
    """The same of a configuration with all its trains, which is ``called`` so where SUMO refuses it."""
    _loaded(called, "-c", str(configuration), "--end", f"{begin_s:.3f}", "--route-steps", "0")


@cache
def options_of_sumo() -> frozenset[str]:
    """Every option that the ``sumo`` program has."""
    sumo, environment = program("sumo")
    with tempfile.TemporaryDirectory(prefix="options.") as folder:
        template = Path(folder) / "all.sumocfg"
        command = [str(sumo), "--save-template", str(template)]
        subprocess.run(command, env=environment, capture_output=True, check=False, timeout=PATIENCE_S)
        return frozenset(e.tag for e in parse(template).iter() if "value" in e.attrib)


def _loaded(called: str, *options: str) -> None:
    sumo, environment = program("sumo")
    try:
        command = [str(sumo), *options, "--no-step-log"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        raise InputError(f"{called}: SUMO does not load it within {PATIENCE_S:g} s") from None
    if done.returncode != 0:
        said = [line.removeprefix("Error: ") for line in done.stderr.splitlines() if line.startswith("Error: ")]
        raise InputError([f"{called}: SUMO refuses it: {line}" for line in said[:5]] or [f"{called}: SUMO crashes on it"])
