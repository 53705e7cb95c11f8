"""Rail networks for SUMO: line descriptions, the builder, the line coordinate."""

from __future__ import annotations

from pathlib import Path

from sumo_net.build import build
from sumo_net.layout import Gradient
from sumo_net.line import Line, LineCrossover
from sumo_net.rails import Rails
from sumo_net.spec import Crossover, LineError, LineSpec, RegularCrossovers, parse_spec, read_spec

__all__ = [
    "Crossover", "Gradient", "Line", "LineCrossover", "LineError", "LineSpec", "Rails", "RegularCrossovers",
    "build", "parse_spec", "read_spec", "shipped",
]  # fmt: skip


def shipped() -> dict[str, Path]:
    """The line descriptions that come with the package: name to file."""
    from importlib.resources import files  # only here: a tenth of the package's import time

    folder = Path(str(files("sumo_net"))) / "lines"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}
