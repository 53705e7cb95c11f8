"""Same scenario, same seed: the same bytes, in fresh processes."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

BIN = Path(sys.executable).parent / "trainctl"

#: Attributes of SUMO's logs that tell clocks and durations of the computer.
CLOCKS = r'<performance [^>]*/>|<!--.*?-->|\bduration="\d+"(?=\s*/>)'


def fresh(name: str, folder: Path, *settings: str) -> Path:
    arguments = [str(BIN), "run", name, "-q", "--out", str(folder), *(x for s in settings for x in ("--set", s))]
    subprocess.run(arguments, check=True)
    return folder


def content(folder: Path) -> dict[str, object]:
    """Every file of a run, less what may differ."""
    info = json.loads((folder / "run.json").read_text())
    found: dict[str, object] = {"run.json": {k: v for k, v in info.items() if k not in ("wall_time_s", "command_line")}}
    for path in sorted(p for p in folder.iterdir() if p.is_file() and p.name != "run.json"):
        found[path.name] = path.read_bytes()
    for path in sorted((folder / "sumo").glob("*.xml")):
        found[path.name] = re.sub(CLOCKS, "", path.read_text(), flags=re.DOTALL)
    found["fcd"] = pd.read_parquet(folder / "sumo" / "fcd.parquet").to_csv()
    return found


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("three_tracks", ("run.duration_s=150",)),
        ("emu_finite_time", ("run.duration_s=4",)),
        ("fault_tolerant_noise", ("run.duration_s=20",)),
    ],
)
def test_two_processes_write_the_same_bytes(name, settings, tmp_path):
    one, two = (content(fresh(name, tmp_path / word, *settings)) for word in ("one", "two"))
    assert one.keys() == two.keys()
    assert {"trains.parquet", "units.parquet", "links.parquet", "events.jsonl", "metrics.json", "summary.xml", "fcd"} <= one.keys()
    assert [file for file in one if one[file] != two[file]] == []


def test_another_seed_is_another_run(tmp_path):
    files = [
        content(fresh("fault_tolerant_noise", tmp_path / str(seed), "run.duration_s=5", f"run.seed={seed}"))["units.parquet"]
        for seed in (1, 2)
    ]
    assert files[0] != files[1]
