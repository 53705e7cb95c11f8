"""What is checked before SUMO starts: versions and options that would silently spoil the run."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version

import numpy as np

from sumo_net import Line


def objections(line: Line, step: float) -> list[str]:
    """Every reason why SUMO would not do what is commanded; empty if there is none."""
    found = []
    versions = {}
    for package in ("libsumo", "eclipse-sumo"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            found.append(f"{package} is not installed")
    if len(set(versions.values())) > 1:
        both = ", ".join(f"{p} {v}" for p, v in versions.items())
        found.append(f"{both}: netconvert and libsumo must be of one version, or logs cannot be compared")
    if np.any(line.start_m < 0.0):
        found.append(f"kilometrage begins at {line.start_m.min():g} m: SUMO reads a negative one as decreasing along the edge")
    if abs(step * 1000.0 - round(step * 1000.0)) > 1e-9:
        found.append(f"step_s = {step:g}: SUMO counts time in whole milliseconds")
    return found
