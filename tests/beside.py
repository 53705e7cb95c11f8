"""Runs of a SUMO configuration on both backends, and plain SUMO on the same files."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import nets
import numpy as np
import tomli_w

from sumo_net.build import program
from trainctl.runner import run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario

OPEN = "<configuration>"


def followed(
    folder: Path, body: str, duration: float, options: str = "", backends: tuple[str, ...] = ("sumo", "numeric"),
    types: str = nets.EMU,
) -> Run:  # fmt: skip
    """The run of one demand, which has the same positions without a simulator."""
    nets.traffic(folder, body, types)
    configuration = folder / "a.sumocfg"
    configuration.write_text(configuration.read_text().replace(OPEN, f"{OPEN}{options}"))
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", duration)))
    p = open_scenario(str(folder / "s.toml"))
    runs = [run(p, folder / f"out_{backend}", backend) for backend in backends]  # type: ignore[arg-type]
    for other in runs[1:]:
        assert len(runs[0].trains) == len(other.trains)
        assert np.max(np.abs(runs[0].trains.position_m - other.trains.position_m)) < 1e-6
    assert not [e for e in runs[0].events if e["kind"] in ("violation", "sumo_warning")]
    return runs[0]


def plain(folder: Path, rows: str, *options: str) -> list[dict[str, str]]:
    """Rows of an output of plain SUMO on the same files."""
    sumo, environment = program("sumo")
    subprocess.run([sumo, "-c", "a.sumocfg", f"--{rows}-output", "plain.xml", "--no-step-log", *options], cwd=folder, env=environment,
                   check=True, capture_output=True)  # fmt: skip
    tag = {"stop": "stopinfo"}.get(rows, rows)
    return [dict(re.findall(r'(\w+)="([^"]*)"', row)) for row in re.findall(rf"<{tag} [^>]*>", (folder / "plain.xml").read_text())]
