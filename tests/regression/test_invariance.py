"""What must not matter to any law: where the line begins, how trains are called, when it happens, how finely it is integrated."""

from __future__ import annotations

import copy
import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from trainctl.runner import run
from trainctl.scenario.build import open_scenario

LAWS = ("fully_distributed", "robust_constrained", "emu_finite_time", "fault_tolerant")
LENGTH_M, SHIFT_M, SHIFT_S = 400_000.0, 1e6, 40.0
DURATION_S = {"fully_distributed": 60.0, "robust_constrained": 64.0, "emu_finite_time": 40.0, "fault_tolerant": 40.0}


def tables(name: str) -> dict[str, Any]:
    """The paper's example of a law on one straight track, for a short while, with nothing but what the law needs."""
    data = tomllib.loads(open_scenario(name).scenario.toml())
    data["train"] = [t for t in data["train"] if t["track"] == "1"][:4]
    ids = {t["id"] for t in data["train"]}
    data["link"] = [link for link in data.get("link", []) if ids.issuperset(link["between"])]
    for key in ("event", "fault", "disturbance"):
        data.pop(key, None)
    data["run"] |= {"duration_s": DURATION_S[name]}
    return data


def trajectories(data: dict[str, Any], folder: Path, begin_m: float = 0.0, line: bool = True) -> dict[str, Any]:
    """Positions and speeds (instants, 2) of every train, by its name."""
    folder.mkdir()
    if line:
        spec = {"name": "straight", "tracks": ["1"], "length_m": LENGTH_M, "start_m": begin_m, "speed": [[begin_m, 200.0]]}
        (folder / "straight.toml").write_text(tomli_w.dumps(spec))
        data = {**data, "network": {"line": "straight.toml"}}
    (folder / "s.toml").write_text(tomli_w.dumps(data))
    done = run(open_scenario(str(folder / "s.toml")), folder / "out", "numeric").trains
    return {str(name): rows[["position_m", "speed_mps"]].to_numpy(copy=True) for name, rows in done.groupby("train", observed=True)}


def apart(one: dict[str, Any], other: dict[str, Any]) -> float:
    """Maximum difference of positions [m] and speeds [m/s]."""
    assert one.keys() == other.keys()
    return max(float(np.abs(one[name] - other[name]).max()) for name in one)


@pytest.mark.parametrize("name", LAWS)
def test_where_the_line_begins(name: str, tmp_path: Path) -> None:
    data = tables(name)
    moved = copy.deepcopy(data)
    for train in moved["train"]:
        train["position_m"] += SHIFT_M
    if "position_m" in moved["reference"]:
        moved["reference"]["position_m"] += SHIFT_M
    for place in moved["reference"].get("speed_by_position", []):
        place[0] += SHIFT_M
    here, there = trajectories(data, tmp_path / "here"), trajectories(moved, tmp_path / "there", SHIFT_M)
    for rows in there.values():
        rows[:, 0] -= SHIFT_M
    assert apart(here, there) < 1e-6  # a position of 1e6 m is rounded to 1e-10, the finite-time law has slopes of 1e3


@pytest.mark.parametrize("name", LAWS)
def test_how_trains_are_called(name: str, tmp_path: Path) -> None:
    data = tables(name)
    renamed = copy.deepcopy(data)
    for train in renamed["train"]:
        train["id"] = f"x{train['id']}"
    for link in renamed.get("link", []):
        link["between"] = [f"x{i}" for i in link["between"]]
    one, other = trajectories(data, tmp_path / "one"), trajectories(renamed, tmp_path / "other")
    assert apart({f"x{k}": v for k, v in one.items()}, other) == 0.0


@pytest.mark.parametrize(
    ("name", "most"), [("three_tracks", 1e-6), ("robust_three_tracks", 1e-6), ("emu_finite_time", 1e-3), ("fault_tolerant", 1e-6)]
)
def test_how_finely_it_is_integrated(name: str, most: float, tmp_path: Path) -> None:
    """The finite-time law has no derivative where speeds meet: there Runge-Kutta steps lose their order."""
    data = tomllib.loads(open_scenario(name).scenario.toml())
    data["run"] |= {"duration_s": 40.0}
    halved = copy.deepcopy(data)
    halved["run"]["sub_step_s"] = 0.5 * data["run"]["sub_step_s"]
    one, other = (trajectories(d, tmp_path / place, line=False) for d, place in ((data, "one"), (halved, "other")))
    assert 0.0 < apart(one, other) < most


def in_formation(name: str) -> dict[str, Any]:
    """Everybody in its place at the speed of the reference, which stays what it is."""
    data = tables(name)
    speed = {"fully_distributed": 80.0, "robust_constrained": 80.0, "emu_finite_time": 85.0, "fault_tolerant": 20.0}[name]
    data["topology"] |= {"first_slot_m": 0.0}
    data["reference"] = {"speed_mps": speed}
    front, spacing = 100_000.0, float(data["topology"]["spacing_m"])
    for k, train in enumerate(data["train"]):
        train |= {"position_m": front - k * spacing, "speed_mps": speed}
        train.pop("unit_speed_mps", None)
    return data


@pytest.mark.parametrize("name", LAWS)
def test_when_it_happens(name: str, tmp_path: Path) -> None:
    """From formation, a force that pushes one train for 10 s: 40 s later all happens 40 s later."""
    data = in_formation(name)
    push = {"on": "input", "train": "2", "shape": "constant", "amplitude_mps2": 0.1}
    found = []
    for place, begin in (("early", 8.0), ("late", 8.0 + SHIFT_S)):
        data["disturbance"] = [{**push, "from_s": begin, "to_s": begin + 8.0}]
        data["run"]["duration_s"] = DURATION_S[name] + begin - 8.0
        found.append(trajectories(data, tmp_path / place))
    early, late = found
    speed, later = data["reference"]["speed_mps"], round(SHIFT_S / data["run"]["step_s"])
    assert max(float(np.abs(rows[:, 1] - speed).max()) for rows in early.values()) > 1e-3  # something happens
    moved = {k: rows[later:] - [SHIFT_S * speed, 0.0] for k, rows in late.items()}
    assert apart(early, {k: rows[: len(early[k])] for k, rows in moved.items()}) < 1e-6


@pytest.mark.parametrize("name", LAWS)
def test_the_order_of_the_tables_where_links_are_stated(name: str, tmp_path: Path) -> None:
    data = tables(name)
    ids = [train["id"] for train in data["train"]]
    data["topology"]["rule"] = "links"
    known = {key: data["topology"][f"{key}_m"] for key in ("lower", "upper") if f"{key}_m" in data["topology"]}
    stated = {"desired_m": data["topology"]["spacing_m"], **{f"{key}_m": value for key, value in known.items()}}
    data["link"] = [{"between": [a, b], **stated} for a, b in pairwise(ids)]
    turned = copy.deepcopy(data)
    turned["train"] = [data["train"][k] for k in np.roll(np.arange(len(ids))[::-1], 1)]
    assert apart(trajectories(data, tmp_path / "one"), trajectories(turned, tmp_path / "other")) < 1e-9


@pytest.mark.parametrize("name", ["fully_distributed", "robust_three_tracks", "emu_group_reroute", "fault_tolerant_reroute"])
def test_the_order_of_tables_of_different_tracks(name: str, tmp_path: Path) -> None:
    data = tomllib.loads(open_scenario(name).scenario.toml())
    data["run"] |= {"duration_s": 40.0}
    turned = copy.deepcopy(data)
    turned["train"] = sorted(data["train"], key=lambda train: -int(train["track"]))  # those beside first
    assert [t["id"] for t in turned["train"]] != [t["id"] for t in data["train"]]
    one, other = (trajectories(d, tmp_path / place, line=False) for d, place in ((data, "one"), (turned, "other")))
    assert apart(one, other) < 1e-9
