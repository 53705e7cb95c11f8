"""The robust constrained law alone: eq. (6), lost messages, what it refuses and what it warns of."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl.controllers import robust_constrained as law
from trainctl.controllers import robust_gain
from trainctl.errors import InputError
from trainctl.plants import disturbance
from trainctl.scenario.reference import constant, table
from trainctl.signals import Bounds, Consists, Links, Scene, Trains

LINE = [(0, 1), (1, 0), (1, 2), (2, 1), (2, 3), (3, 2)]
SLOT = -8000.0 * np.arange(4)


def links_of(edges: list[tuple[int, int]], n: int = 4, weight: float = 0.01) -> Links:
    pairs = np.array(sorted(edges, key=lambda e: (e[1], e[0])), np.int64).reshape(-1, 2)
    sender, receiver, count = pairs[:, 0].copy(), pairs[:, 1].copy(), len(pairs)
    slot = -8000.0 * np.arange(n)
    return Links(
        sender, receiver, np.searchsorted(receiver, np.arange(n + 1)), slot[sender] - slot[receiver],
        np.full(count, -np.inf), np.full(count, np.inf), np.full(count, weight), np.ones(count, bool), slot, np.arange(n),
    )  # fmt: skip


def scene(edges: list[tuple[int, int]] | None = None, n: int = 4, **changes: Any) -> Scene:
    one, free = np.ones(n), np.full(n, np.inf)
    consists = Consists(
        np.arange(n + 1), 0 * one, 8e4 * one, one, np.tile([1.176e-2, 7.7616e-4, 1.6e-5], (n, 1)), 0 * one, 0 * one,
        free, free, free, free, 0 * one,
    )  # fmt: skip
    start = Scene(
        [str(i + 1) for i in range(n)], consists, np.column_stack((27000.0 - 8000.0 * np.arange(n), 80.0 * one)),
        links_of(LINE if edges is None else edges, n), Bounds(0 * one, 85 * one, -2 * one, 2 * one), constant(80.0, 27000.0),
        0.0, 0.8, 0.8, 0.0, 0.8,
    )  # fmt: skip
    return start._replace(**changes)


PARAMS = law.Params(h_per_s=0.3)
LEADER = np.array([1e5, 80.0, 0.0, 0.0])


def state(position: list[float], speed: list[float]) -> Trains:
    return Trains(np.array(position), np.array(speed), np.zeros(len(speed)))


def test_demand_is_equation_6() -> None:
    edges, weights = [(1, 0), (0, 1), (2, 1), (1, 2), (0, 3)], [0.01, 0.02, 0.03, 0.04, 0.05]
    links = links_of(edges)
    rank = [edges.index(e) for e in zip(links.sender.tolist(), links.receiver.tolist(), strict=True)]
    links = links._replace(weight=np.array(weights)[rank])
    p, v = [1e5, 9.15e4, 8.05e4, 7.3e4], [80.0, 70.0, 85.0, 0.0]
    own = state(p, v)
    constants = law.Constants(h=np.array([0.3, 0.2, 0.3, 0.1]))
    heard = law.message(constants, own, LEADER)[links.sender]
    d = [-8000.0 * i for i in range(4)]
    wanted = [-constants.h[i] * (v[i] - 80.0) for i in range(4)]
    for (j, i), a in zip(edges, weights, strict=True):
        wanted[i] += a * (p[j] - p[i] + d[i] - d[j])
    demand = law.demand(constants, own, LEADER, links, heard)
    np.testing.assert_allclose(demand.acceleration, wanted, rtol=1e-12)
    assert not demand.saturated.any()


def test_old_messages_do_not_lag_behind_the_reference() -> None:
    """In formation, a message of one period before gives no demand; with positions as such it would be off by v0 T = 64 m."""
    links = links_of(LINE)
    constants = law.constants(PARAMS, scene())
    before = LEADER - [64.0, 0.0, 0.0, 0.0]
    old = law.message(constants, state((before[0] + SLOT).tolist(), [80.0] * 4), before)[links.sender]
    demand = law.demand(constants, state((LEADER[0] + SLOT).tolist(), [80.0] * 4), LEADER, links, old)
    np.testing.assert_allclose(demand.acceleration, 0.0, atol=1e-12)


def test_a_lost_message_keeps_the_last_one() -> None:
    links = links_of(LINE)._replace(heard=np.zeros(6, bool))
    constants = law.constants(PARAMS, scene())
    heard = np.column_stack((SLOT[links.sender], np.ones(6)))
    own = state((LEADER[0] + SLOT - [0.0, 10.0, 0.0, 0.0]).tolist(), [80.0] * 4)
    demand = law.demand(constants, own, LEADER, links, heard)
    np.testing.assert_allclose(demand.acceleration, [0.0, 0.2, 0.0, 0.0], atol=1e-12)


def test_a_train_that_never_heard_a_neighbour_does_not_accelerate_but_brakes() -> None:
    links = links_of(LINE)
    constants = law.constants(PARAMS, scene())
    heard = np.column_stack((SLOT[links.sender], np.ones(6)))
    heard[(links.receiver == 1) & (links.sender == 0)] = 0.0  # as the exchange leaves it
    p = (LEADER[0] + SLOT).tolist()
    assert law.demand(constants, state(p, [80.0, 60.0, 80.0, 80.0]), LEADER, links, heard).acceleration[1] == 0.0
    assert law.demand(constants, state(p, [80.0, 84.0, 80.0, 80.0]), LEADER, links, heard).acceleration[1] == pytest.approx(-1.2)


def test_demand_is_local() -> None:
    rng = np.random.default_rng(0)
    links = links_of(LINE)
    constants = law.constants(PARAMS, scene())
    p, v = 1e5 + SLOT + rng.normal(0, 300, 4), rng.uniform(0, 85, 4)
    heard = rng.normal(0, 1e4, (6, 1)) * [1.0, 0.0] + [0.0, 1.0]
    first = law.demand(constants, state(p.tolist(), v.tolist()), LEADER, links, heard).acceleration
    p[3], v[3] = 0.0, 0.0
    np.testing.assert_array_equal(
        law.demand(constants, state(p.tolist(), v.tolist()), LEADER, links, heard).acceleration[:3], first[:3]
    )


# --- what it refuses ---


def test_the_example_breaks_nothing() -> None:
    assert law.violations(PARAMS, scene()) == []
    assert law.warnings(PARAMS, scene()) == []


BOUNDS = scene().bounds
BENT = np.array([-8000.0, 8000.0, -8000.0, 8000.0, -9000.0, 8000.0])
NEGATIVE = np.array([0.01, -0.02, 0.01, 0.01, 0.01, 0.01])

REFUSED: list[tuple[law.Params, dict[str, Any], list[str]]] = [
    (law.Params(h_per_s=1.25), {}, ["controller.h_per_s = 1.25", "h T = 1 with T = 0.8 s"]),
    (law.Params(h_per_s=0.0), {}, ["controller.h_per_s = 0: must be above 0"]),
    (law.Params(h_per_s=(0.3, 0.3)), {}, ["2 values for 4 trains"]),
    (law.Params(h_per_s=(0.3, 1.5, 0.3, 0.3)), {}, ["controller.h_per_s[2] = 1.5", "1.2"]),
    (PARAMS, {"links": links_of(LINE)._replace(weight=NEGATIVE)}, ["link[1 > 2].weight = -0.02: must be above 0"]),
    (PARAMS, {"links": links_of(LINE, weight=1.0)}, ["topology.weight = 1", "unstable", "0.0225"]),
    (
        PARAMS,
        {"links": links_of([(0, 1), (1, 2), (2, 3)])},
        ["strongly connected", "train 2 sends does not reach train 1", "train 4 sends does not reach train 1, train 2, train 3"],
    ),
    (PARAMS, {"links": links_of(LINE)._replace(desired=BENT)}, ["link[3 > 4].desired_m = 8000", "9000 m", "around every cycle"]),
    (PARAMS, {"reference": constant(90.0, 0.0)}, ["reference.speed_mps = 90", "below the maximum speed 85 m/s (all trains)"]),
    (PARAMS, {"reference": constant(85.0, 0.0)}, ["must be below the maximum speed 85"]),
    (PARAMS, {"reference": constant(0.0, 0.0)}, ["must be above the minimum speed 0"]),
    (
        PARAMS,
        {"bounds": BOUNDS._replace(input_upper=np.array([2.0, 1.9, 2.0, np.inf]))},
        ["bounds.input_upper_mps2 = inf: must be given", "train 4"],
    ),
    (PARAMS, {"bounds": BOUNDS._replace(input_lower=np.full(4, 0.5))}, ["input_lower_mps2 = 0.5: must be below 0"]),
    (PARAMS, {"bounds": BOUNDS._replace(speed_upper=np.full(4, np.inf))}, ["bounds.speed_upper_mps = inf: must be given"]),
    (PARAMS, {"bounds": BOUNDS._replace(speed_lower=np.full(4, -5.0))}, ["bounds.speed_lower_mps = -5: must not be negative"]),
    (PARAMS, {"own": scene().own + np.array([0.0, 6.0])}, ["train.speed_mps = 86: outside the admissible speeds (all trains)"]),
]


@pytest.mark.parametrize(("params", "changes", "words"), REFUSED)
def test_what_is_refused(params: law.Params, changes: dict[str, Any], words: list[str]) -> None:
    text = "\n".join(law.violations(params, scene(**changes)))
    for word in words:
        assert word in text


def test_all_violations_come_at_once() -> None:
    wrong = scene(links=links_of([(0, 1), (1, 2), (2, 3)], weight=-1.0), reference=constant(90.0, 0.0))
    found = law.violations(law.Params(h_per_s=2.0), wrong)
    assert len([f for f in found if ".weight = -1" in f]) == 3
    for word in ("h_per_s = 2", "strongly connected", "reference.speed_mps = 90"):
        assert any(word in f for f in found)


def test_trains_on_other_tracks_are_formations_of_their_own() -> None:
    apart = [(0, 1), (1, 0), (2, 3), (3, 2)]
    assert law.violations(PARAMS, scene(apart)) == []
    steady = disturbance.Disturbance(on="speed", shape="constant", amplitude_mps=(0.1, 0.2, 0.3, 0.4))
    found = law.analysis(PARAMS, scene([(0, 1), (1, 0), (1, 2), (2, 1)]), [steady])
    assert found.steady is not None
    assert found.steady.pairs == [("1", "2"), ("1", "3"), ("2", "3")]
    assert "2 separate formations" in found.notes[-1]
    signs = law.worst(PARAMS, scene(apart), 2, 3, 50)
    assert not signs[:, :, :2].any()
    assert np.all(np.abs(signs[0, :, 2:]) == 1.0)
    with pytest.raises(InputError, match="not in one formation"):
        law.worst(PARAMS, scene(apart), 0, 3, 50)


def test_warns_of_followers_that_do_not_hear_their_predecessor() -> None:
    against = [(1, 0), (2, 1), (3, 2), (0, 3)]
    (found,) = law.warnings(PARAMS, scene(against))
    assert "2 does not receive from 1; 3 does not receive from 2; 4 does not receive from 3" in found
    assert "no spacing constraint" in found
    assert law.warnings(PARAMS, scene([(0, 1), (1, 2), (2, 3), (3, 0)])) == []
    assert law.warnings(PARAMS, scene([(0, 1), (1, 0), (2, 3), (3, 2)]), tracks=[1, 1, 2, 2]) == []


def test_warns_of_a_reference_that_changes() -> None:
    (found,) = law.warnings(PARAMS, scene(reference=table([(0.0, 80.0), (10.0, 80.0), (20.0, 70.0)], 0.0)))
    assert "70 to 80 m/s" in found


def test_warns_of_an_input_below_ten_times_the_resistance() -> None:
    short = BOUNDS._replace(input_upper=np.array([2.0, 1.9, 2.0, 2.0]))
    assert law.violations(PARAMS, scene(bounds=short)) == []
    (found,) = law.warnings(PARAMS, scene(bounds=short))
    assert "input_upper_mps2: 9.83 times the running resistance" in found
    assert "(train 2)" in found


def test_params_refuse_unknown_keys() -> None:
    with pytest.raises(ValidationError):
        law.Params.model_validate_json('{"h_per_s": 0.3, "weight": 1}')


def test_large_formations_are_checked() -> None:
    n = 3000
    edges = [e for i in range(n - 1) for e in ((i, i + 1), (i + 1, i))]
    assert law.violations(PARAMS, scene(edges, n)) == []


# --- the analysis ---


def test_analysis_of_kinds_of_disturbances() -> None:
    """Constant: everything; changing: no steady state; unbounded: no bound; none: neither."""
    kinds: dict[str, list[dict[str, Any]]] = {
        "constant": [{"on": "speed", "shape": "constant", "amplitude_mps": 0.1}],
        "changing": [{"on": "speed", "shape": "sine", "amplitude_mps": 0.1, "period_s": 9.0}],
        "unbounded": [{"on": "speed", "shape": "gaussian", "std_mps": 0.1}],
        "none": [],
    }
    found = {name: law.analysis(PARAMS, scene(), [disturbance.Disturbance(**t) for t in tables]) for name, tables in kinds.items()}
    assert {name: (r.gain is not None, r.steady is not None) for name, r in found.items()} == {
        "constant": (True, True), "changing": (True, False), "unbounded": (False, False), "none": (False, False),
    }  # fmt: skip
    assert "Gaussian" in found["unbounded"].notes[0]
    for r in found.values():
        assert all(isinstance(line, str) for line in r.lines())
        json.dumps(r.as_dict(), allow_nan=False)
    assert law.report(PARAMS, scene(), []) == found["none"].lines()


def test_resistance_and_measurement_count_in_the_l1_bound() -> None:
    def worst(**table: Any) -> float:
        gain = law.analysis(PARAMS, scene(), [disturbance.Disturbance(shape="constant", **table)]).gain
        assert gain is not None
        return gain.worst_m

    r_max = 0.1933336
    assert worst(on="resistance", error_percent=10.0) == pytest.approx(worst(on="input", amplitude_mps2=0.1 * r_max), rel=1e-6)
    assert worst(on="measurement", amplitude_m=1.0) == pytest.approx(2 * worst(on="measurement", amplitude_m=0.5), rel=1e-6)
    assert worst(on="measurement", amplitude_m=1.0) > 1.0


def test_l1_bounds_are_the_plain_sums_over_impulse_responses() -> None:
    """Long-hand, one impulse at a time through the unsaturated map (9): error of the ends, speeds and inputs."""
    start, T = scene(), 0.8
    big = robust_gain.laplacian(4, start.links)
    error, speed, asked = 0.0, np.zeros(4), np.full(4, 0.01)  # w3 itself is part of the input
    for channel, size in ((0, 0.1), (1, 0.2), (2, 0.01)):
        for i in range(4):
            p, v = np.zeros(4), np.zeros(4)
            if channel == 0:
                p[i] = size
            else:
                v[i] = size if channel == 1 else size * T
            for _ in range(2000):
                u = -0.3 * v - big @ p
                error, speed, asked = error + abs(p[0] - p[3]), speed + abs(v), asked + abs(u)
                p, v = p + v * T, v + u * T
    amplitude = np.zeros((5, 4))
    amplitude[:3] = [[0.1] * 4, [0.2] * 4, [0.01] * 4]
    h = np.full(4, 0.3)
    bound, tail = robust_gain.l1_gain(robust_gain.loop(h, start), robust_gain.pair_row(4, 0, 3)[None], amplitude[[0, 1, 2, 4]])
    assert error <= bound[0] <= error * (1 + 1e-6)
    assert 0.0 < tail[0] < 1e-6 * error
    gain = robust_gain.gain(h, start, amplitude)
    assert gain.worst_m == pytest.approx(bound[0], rel=1e-12)
    assert gain.speed_mps == pytest.approx(speed.max(), rel=2e-6)
    assert gain.input_mps2 == pytest.approx(asked.max(), rel=2e-6)
    assert gain.unsaturated
    assert not robust_gain.gain(h, start, 6 * amplitude).unsaturated


@pytest.mark.parametrize("steps", [1, 3])
def test_loop_matrices_are_those_of_a_held_acceleration(steps: int) -> None:
    """A plant that integrates exactly: theta = 1/2 whatever the number of steps."""
    start, T = scene(step=0.8 / steps, lead=0.5), 0.8 / steps
    closed = robust_gain.loop(np.full(4, 0.3), start)
    rng = np.random.default_rng(1)
    p, v, w = rng.normal(size=4), rng.normal(size=4), rng.normal(size=(3, 4))
    measured = rng.normal(size=4)
    x = np.concatenate((p[1:] - p[0], v, np.zeros(4)))
    u = -0.3 * v - robust_gain.laplacian(4, start.links) @ (p + measured)
    for k in range(steps):
        x = (closed.hold if k else closed.law) @ x + closed.kick @ w.reshape(-1) + (0.0 if k else closed.noise @ measured)
        change = u * T + w[1] + w[2] * T
        p, v = p + v * T + 0.5 * change * T + w[0], v + change
    np.testing.assert_allclose(x, np.concatenate((p[1:] - p[0], v, u)), atol=1e-12)
