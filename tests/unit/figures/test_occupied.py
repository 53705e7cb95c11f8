"""What trains occupy in a train graph: blocking times against those worked out by hand, bodies and braking distances."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import nets
import numpy as np
import pytest
import tomli_w

from trainctl.figures import catalogue
from trainctl.figures.corridors import corridors
from trainctl.figures.occupied import Travelled, along, braking, fixed_block, occupied
from trainctl.figures.trains import drawable
from trainctl.report.panels import panels
from trainctl.runner import run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario

SUMO = """
schema_version = 1
title = "two"
[run]
duration_s = 400
[network]
line = "three_tracks"
[controller]
law = "sumo"
block = "BLOCK"
signals_m = 4000.0
top_speed_mps = 40.0
[reference]
speed_mps = 40.0
[topology]
spacing_m = 8000.0
lower_m = 1000.0
upper_m = 30000.0
[train_type.t]
unit_length_m = 200.0
unit_mass_kg = 4e5
c0_n_per_kg = 0.01
c1_ns_per_m_kg = 0.0
c2_ns2_per_m2_kg = 0.0
[[train]]
id = "a"
type = "t"
track = 1
position_m = 9000.0
speed_mps = 40.0
[[train]]
id = "b"
type = "t"
track = 1
position_m = 1000.0
speed_mps = 40.0
"""


@pytest.fixture(scope="module")
def blocked(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    found = {}
    for block in ("fixed", "moving"):
        folder = tmp_path_factory.mktemp(block)
        (folder / "s.toml").write_text(SUMO.replace("BLOCK", block))
        found[block] = run(open_scenario(str(folder / "s.toml")), folder / "r")
    return found


def test_a_train_that_waits_holds_the_next_block_from_when_it_moves_off() -> None:
    time = np.arange(8.0)
    front = np.array([0.0, 50.0, 90.0, 90.0, 90.0, 120.0, 220.0, 320.0])  # stands before the signal at 100 m
    reach = front + np.array([20.0, 20.0, 0.0, 0.0, 0.0, 30.0, 20.0, 20.0])
    train = Travelled(time, front, reach, np.array([-10.0, 100.0, 200.0, 400.0]), 25.0)
    first, second, third = train.on(1000.0 + front)
    assert first == (0.0, 6.0, 990.0, 1100.0)  # the rear has passed 100 m at 6 s
    assert second == (5.0, 7.0, 1100.0, 1200.0)
    assert (third.begin_s, third.from_m, third.to_m) == (6.0, 1200.0, 1400.0)
    back = train.on(5000.0 - front)  # on an axis against its way
    assert [(block.from_m, block.to_m) for block in back] == [(5010.0, 4900.0), (4900.0, 4800.0), (4800.0, 4600.0)]


def test_a_train_from_elsewhere_holds_nothing_before_it_came() -> None:
    front = np.array([0.0, 50.0, 100.0, 150.0, 200.0, 230.0])
    train = Travelled(np.arange(6.0), front, front, np.array([0.0, 80.0, 160.0, 240.0]), 10.0)
    somewhere = np.where(front < 100.0, np.nan, front)
    assert [(round(b.from_m), round(b.to_m)) for b in train.on(somewhere)] == [(100, 160), (160, 240)]


def test_stairs_stand_at_the_signals_and_never_two_trains_in_one_block(blocked: dict[str, Run]) -> None:
    drawn = drawable(blocked["fixed"])
    assert fixed_block(drawn) and not fixed_block(drawable(blocked["moving"]))
    held = {name: train.on(drawn.trains.column("position_m")[rows]) for (name, rows), train in zip(
        drawn.trains.slices(), occupied(drawn).blocks.values(), strict=True
    )}  # fmt: skip
    inner = {round(at, 3) for blocks in held.values() for b in blocks[1:-1] for at in (b.from_m, b.to_m)}
    assert inner and all(at % 4000.0 == 0.0 for at in inner), inner
    b = held["b"]
    assert b[1].begin_s == pytest.approx((4000.0 - 1000.0 - 40.0**2 / (2 * 0.5)) / 40.0, abs=2.0)
    assert b[0].end_s == pytest.approx((4000.0 + 200.0 - 1000.0) / 40.0, abs=2.0)
    for one in held["a"]:
        for other in b:
            if (one.from_m, one.to_m) == (other.from_m, other.to_m):
                assert one.end_s <= other.begin_s
    shown = catalogue.figure(blocked["fixed"], "train_graph").axes[0]
    gids = {str(c.get_gid()): c for c in shown.collections}
    assert len(gids["blocks b"].get_paths()) == len(b)
    panel = next(p for p in panels(drawn) if p["id"] == "graph")
    assert [t["name"] for t in panel["traces"] if t.get("fill") == "self"] == ["blocks, train a", "blocks, train b"]
    assert "blocks that trains hold" in panel["note"]


def test_moving_block_has_bodies_and_braking_distances(blocked: dict[str, Run]) -> None:
    run = blocked["moving"]
    assert braking(drawable(run)) == {"a": 0.5, "b": 0.5}
    shown = catalogue.figure(run, "train_graph").axes[-1]
    shade = {str(c.get_gid()): c.get_paths()[0].vertices[:, 1] for c in shown.collections}
    assert set(shade) == {"body a", "body b", "braking a", "braking b"}
    front = float(run.trains[run.trains.train == "a"].position_m.iloc[0]) - 9000.0
    assert shade["body a"].min() >= front / 1000 - 0.2 - 1e-6
    assert shade["braking a"].max() == pytest.approx(front / 1000 + 40.0**2 / (2 * 0.5) / 1000, abs=0.4)
    traces = {t["name"] for p in panels(drawable(run)) for t in p["traces"]}
    assert {"rear, train a", "braking distance, train a"} <= traces


def test_what_a_train_surely_brakes_with(finished: Callable[..., Run]) -> None:
    for name, rate in (("three_tracks", 64e3 / 80e3), ("merging", 0.7)):
        known = drawable(finished(name, "numeric", **{"run.duration_s": 60}))
        assert set(braking(known).values()) == {rate}


def test_which_way_a_front_runs() -> None:
    assert along(np.array([np.nan, 3.0, 3.0, 4.0, 4.0, 3.0, 3.0])).tolist() == [1, 1, 1, 1, 1, -1, -1]
    assert along(np.array([2.0, 2.0])).tolist() == [1, 1]


def test_trains_that_obey_signals_hold_the_blocks_of_a_net(tmp_path: Path) -> None:
    places = {"w0": (-3000, 0), "w": (0, 0), "s0": (-3000, -3000), "s": (0, -3000), "m": (4000, 0), "x": (6000, 0), "e": (12000, 0)}
    edges = {
        "west0": ("w0", "w"), "west": ("w", "m"), "south0": ("s0", "s"), "south": ("s", "m"), "main": ("m", "x"), "east": ("x", "e"),
    }  # fmt: skip
    nets.net(tmp_path, places, edges, signals="wsmx")
    nets.traffic(tmp_path, nets.train("a", "west0 west main east", 0) + nets.train("b", "south0 south main east", 30))
    made = nets.scenario("robust_constrained", 500, traffic={"cooperate": [], "signals": "obey"})
    (tmp_path / "s.toml").write_text(tomli_w.dumps(made))
    drawn = drawable(run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "r"))
    assert fixed_block(drawn)
    found, _ = corridors(drawn.run, drawn.trains)
    west = next(corridor for corridor in found if "a" in corridor.distance and len(corridor.places))
    at = {place.name: place.at_m for place in west.places}
    held = {name: occupied(drawn).blocks[name].on(west.distance[name]) for name in west.distance}
    main = {name: next(b for b in blocks if abs(b.from_m - at["m"]) < 60.0) for name, blocks in held.items()}
    assert all(block.to_m - block.from_m == pytest.approx(2000.0, abs=40.0) for block in main.values())
    assert main["a"].end_s <= main["b"].begin_s + 2.0  # SUMO gives it free in the step in which the rear has left
    words = next(p["note"] for p in panels(drawn) if p["id"] == "graph")
    assert "blocks that trains hold, from when a braking distance at 0.7 m/s² before their signal" in words
