"""What is watched while a run goes on is found, located, and silent when nothing is wrong."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from trainctl.controllers import emu_finite_time, fault_tolerant
from trainctl.monitors.bounds import Alarms
from trainctl.monitors.energy import Balance
from trainctl.plants.coupled_units import PER_INERTIA
from trainctl.railway.ways import ways
from trainctl.record import checkpoint
from trainctl.runner import opened
from trainctl.scenario.build import open_scenario
from trainctl.signals import POSITION, SPEED, Extremes, Motion, Row, Seen


def row_of(p, t=0.0, watched=0, **changes):
    """One quiet instant of a scenario's start."""
    n = len(p.scenario.train)
    own = p.own.copy()
    leading = own[p.leading]
    given = {
        "time": t, "seen": Seen(leading[:, POSITION].copy(), np.zeros(n, np.int64), np.zeros(n, np.int64), np.ones(n, bool)), "track": p.start_track, "own": own,
        "speed": leading[:, SPEED].copy(), "ahead": np.full(n, -1), "links": p.first_links,
        "motion": Motion(*np.zeros((4, n)), np.zeros(n, bool), np.zeros(n, bool), None, {}),
        "led": np.ones(n, bool), "saturated": np.zeros(n, bool), "extremes": Extremes.fresh(n, len(own), watched), "disturbed": None,
    }  # fmt: skip
    return Row(**{**given, **changes})


class Watched:
    """The alarms of a scenario, and their state."""

    def __init__(self, p):
        self.alarms = Alarms(p)
        self.state = self.alarms.initial()

    @property
    def tally(self):
        return self.state.tally


def told(watched, row, laid=None):
    """What is violated; bodies and limits only where it is said which ways the trains have."""
    seen = row.seen if laid else row.seen._replace(present=np.zeros(len(row.speed), bool))
    return [(a["bound"], a["who"], a["value"], a["limit"]) for a in watched.alarms.new(row, laid or NO_WAYS, seen, watched.state)]


def told_of_links(watched, *arguments):
    """What is violated as links change."""
    return list(watched.alarms.relinked(*arguments, watched.state))


NO_WAYS = ways([], np.zeros(1), np.zeros(1))


@pytest.fixture(scope="module")
def emu():
    return open_scenario("emu_finite_time")


@pytest.fixture(scope="module")
def units():
    return open_scenario("three_tracks")


@pytest.fixture(scope="module")
def tolerant():
    return open_scenario("fault_tolerant")


def test_a_quiet_row_is_silent(units):
    watched = Watched(units)
    assert told(watched, row_of(units)) == []
    assert (watched.tally.violated, watched.tally.first) == ({}, {})


def test_the_first_violation_is_located_and_told_once(units):
    watched = Watched(units)
    fast = row_of(units).speed.copy()
    fast[1] = 86.5
    assert told(watched, row_of(units, 7.0, speed=fast)) == [("speed_upper_mps", "2", 86.5, 85.0)]
    assert told(watched, row_of(units, 8.0, speed=fast)) == []
    slow = fast.copy()
    slow[4] = 70.0
    assert told(watched, row_of(units, 9.0, speed=slow)) == [("speed_lower_mps", "5", 70.0, 79.0)]
    assert watched.tally.first == {"time_s": 7.0, "bound": "speed_upper_mps", "who": "2", "value": 86.5, "limit": 85.0}
    assert watched.tally.violated == {"speed_upper_mps": {"2": 3}, "speed_lower_mps": {"5": 1}}


def test_spacing_and_collision(units):
    watched = Watched(units)
    place = row_of(units).seen.position.copy()
    place[2] = place[3] + 300.0  # 420 m is the minimum, the train 320 m long
    line = units.line
    laid = ways(
        [[line.index[e] for e in line.route(t.track, t.position_m)] for t in units.scenario.train], line.start_m, line.length_m
    )
    rows = [int(np.searchsorted(laid.begin[a:b], x) - 1 + a) for a, b, x in zip(laid.first, laid.first[1:], place, strict=False)]
    found = told(watched, row_of(units, seen=Seen(place, laid.edge[rows], np.array(rows), np.ones(6, bool))), laid)
    assert ("gap_m", "3-4", pytest.approx(-20.0), 0.0) in found
    assert ("spacing_lower_m", "3-4", pytest.approx(300.0), 420.0) in found
    outcome = watched.alarms.outcome(0, watched.state)
    assert outcome["collisions"] == 1 and outcome["checks_failed"] == ["collision"]


def test_couplers_are_watched_between_rows(units):
    x = Extremes.fresh(6, 24, 0)
    x.coupler_max[5], x.coupler_min[5] = 0.12, -0.02
    assert told(Watched(units), row_of(units, extremes=x)) == [("coupler_upper_m", "2.2", 0.12, 0.1)]


def linked(p):
    watched = Watched(p)
    groups = [list(range(len(p.scenario.train)))]
    assert told_of_links(watched, 0.0, groups, np.zeros(len(p.scenario.train), np.int64), p.first_scene) == []
    assert told(watched, row_of(p, watched=len(p.law.WATCHED))) == []  # extremes are those since the first links
    return watched


def test_the_emergency_distance_of_the_finite_time_law(emu):
    watched = linked(emu)
    x = Extremes.fresh(len(emu.scenario.train), len(emu.own), 1)
    x.watched_min[2], x.watched_max[2] = 1499.0, 3000.0
    assert told(watched, row_of(emu, 1.0, extremes=x)) == [("interval_lower_m", "3", 1499.0, 1500.0)]


def test_all_three_restrictions_of_the_fault_tolerant_law(tolerant):
    lower, upper = fault_tolerant.watched_bounds(tolerant.params, tolerant.first_scene)
    assert lower.shape == upper.shape == (len(tolerant.scenario.train), 3)
    assert np.all(lower < 0) and np.all(upper > 0)
    # Remark 2.1
    assert np.allclose(upper[:, 2], tolerant.params.speed_error_upper_mps + tolerant.params.head_l1_per_s * lower[:, 0])
    watched = linked(tolerant)
    x = Extremes.fresh(len(tolerant.scenario.train), len(tolerant.own), 3)
    x.watched_min[:], x.watched_max[:] = 0.5 * lower, 0.5 * upper
    x.watched_min[1, 0], x.watched_max[1, 1], x.watched_max[1, 2] = lower[1, 0] - 1, upper[1, 1] + 1, upper[1, 2] + 1
    found = told(watched, row_of(tolerant, 1.0, extremes=x))
    assert [(bound, who) for bound, who, _, _ in found] == [
        ("spacing_error_lower_m", "2"), ("speed_error_upper_mps", "2"), ("q_error_upper_mps", "2"),
    ]  # fmt: skip


def test_extremes_are_held_against_the_bounds_of_their_own_time(emu):
    """A change of links in the middle of a recorded interval: what was seen before is not judged by what came after."""
    watched = linked(emu)
    n = len(emu.scenario.train)
    wider = replace(emu, params=emu.params.model_copy(update={"emergency_distance_m": 2000.0}))
    watched.alarms.p = wider
    assert told_of_links(watched, 1.0, [list(range(n))], np.zeros(n, np.int64), emu.first_scene) == []
    x = Extremes.fresh(n, len(emu.own), 1)
    x.watched_min[2], x.watched_max[2] = 1800.0, 3000.0
    assert told(watched, row_of(emu, 1.0, extremes=x)) == []  # of before
    assert told(watched, row_of(emu, 2.0, extremes=x)) == [("interval_lower_m", "3", 1800.0, 2000.0)]


def test_a_formation_in_pieces(units):
    watched = Watched(units)
    formation = np.array([0, 0, 0, 0, 1, 0])
    assert told_of_links(watched, 0.0, [[0, 1, 2, 3, 5], [4]], formation, units.first_scene) == []
    found = told_of_links(watched, 5.0, [[0, 1], [2, 3, 5], [4]], formation, units.first_scene)
    assert found == [{"bound": "connected_pieces", "who": "1,2,3,4,6", "value": 2.0, "limit": 1.0}]
    assert watched.tally.first["time_s"] == 5.0


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("three_tracks", {"run.duration_s": 200, "run.record_every_s": 5}),
        ("fault_tolerant", {"run.duration_s": 15}),
        ("emu_finite_time", {"run.duration_s": 5}),
        ("robust_three_tracks", {"run.duration_s": 60}),
    ],
)
def test_energies_balance_far_better_than_demanded(name, settings, tmp_path):
    with opened(open_scenario(name, settings), tmp_path / "run", "numeric") as simulation:
        simulation.run()
        watched = simulation.state.watch.alarms
        balance = watched.energy
        assert np.all(balance.turnover > 1e6)
        assert np.max(np.abs(balance.drift) / balance.turnover) < 1e-5
        assert "energy_balance_share" not in watched.tally.violated


def test_energy_from_nowhere_is_found(tmp_path):
    """A plant that accelerates train 3 by a tenth more than its forces allow."""
    with opened(open_scenario("three_tracks", {"run.duration_s": 30}), tmp_path / "run", "numeric") as simulation:
        for _ in range(20):
            simulation.step()
        simulation.plant.plant.units[8:12, PER_INERTIA] *= 1.1
        simulation.run()
        tally = simulation.state.watch.alarms.tally
        assert list(tally.violated["energy_balance_share"]) == ["3"]
        assert tally.first["time_s"] > 20


def test_a_kick_is_accounted_for(units):
    balance = Balance(units)
    state = balance.initial()
    own = units.own.copy()
    kick = np.array([0.5, 0, 0, 0, 0, 0])
    assert list(balance.violated(row_of(units, disturbed=SimpleNamespace(speed=kick)), state)) == []
    own[:4, SPEED] += 0.5
    assert list(balance.violated(row_of(units, own=own), state)) == []
    assert abs(state.drift[0]) < 1.0
    own[4:8, SPEED] += 0.5  # nobody kicked train 2
    assert [i for i, _ in balance.violated(row_of(units, own=own), state)] == [1]


def test_what_alarms_remember_survives(units):
    """A state that a checkpoint has kept as arrays and plain JSON, taken over by the alarms of another process."""
    watched, other = Watched(units), Watched(units)
    told(watched, row_of(units, 3.0, speed=np.full(6, 90.0)))
    arrays, values = dict(checkpoint.leaves("alarms", watched.state)), dict(checkpoint.plain("alarms", watched.state))
    other.state = checkpoint.again("alarms", other.state, arrays, json.loads(json.dumps(values)))
    assert other.tally == watched.tally
    assert told(other, row_of(units, 4.0, speed=np.full(6, 90.0))) == []


def test_ten_thousand_trains_are_watched_in_milliseconds(units):
    """Quiet rows of 10 000 trains of four units: 20 ms of a step of 1 s would be too much at a real-time factor of 10."""
    n = 10_000
    c = units.consists._replace(
        first=np.arange(0, 4 * n + 1, 4),
        **{
            f: np.tile(getattr(units.consists, f)[:4], (n, 1) if f == "davis" else n)
            for f in units.consists._fields
            if f != "first"
        },
    )
    place = np.arange(n, 0, -1) * 5000.0
    own = np.stack([np.repeat(place, 4) - np.tile(np.arange(4) * 80.0, n), np.full(4 * n, 80.0)], axis=1)
    ids = tuple(map(str, range(n)))
    scenario = SimpleNamespace(ids=ids, train=ids, plant=units.scenario.plant, bounds=units.scenario.bounds)
    bounds = type(units.bounds)(*(np.full(n, b[0]) for b in units.bounds))
    p = SimpleNamespace(
        scenario=scenario, consists=c, bounds=bounds, law=units.law, sampled=True, own=own, leading=c.first[:-1],
        roster=SimpleNamespace(speed_factor=np.ones(n), driven=np.zeros(n, bool)), placed=True, has_units=True, driving=units.driving, line=units.line,
        signs=units.signs, rails=replace(units.rails, length_m=1e8 * np.ones_like(units.rails.length_m)),
    )  # fmt: skip
    k = np.arange(n - 1)
    links = units.first_links._replace(
        sender=k, receiver=k + 1, desired=np.full(n - 1, 5000.0), lower=np.full(n - 1, 420.0), upper=np.full(n - 1, 1e4)
    )
    watched = Watched(p)
    row = row_of(SimpleNamespace(**vars(p), start_track=np.zeros(n, np.int64), first_links=links))
    laid = ways([[0]] * n, np.zeros(1), np.array([1e8]))
    row = row._replace(seen=row.seen._replace(row=laid.first[:-1]))
    spent = []
    for _ in range(7):
        began = time.process_time()
        assert told(watched, row, laid) == []
        spent.append(time.process_time() - began)
    assert min(spent) < 0.02, f"{1e3 * min(spent):.1f} ms"


def test_the_laws_state_bounds_for_all_they_watch(emu):
    low, high = emu_finite_time.watched_bounds(emu.params, emu.first_scene)
    assert low.shape == high.shape == (len(emu.scenario.train), len(emu_finite_time.WATCHED))
    assert np.all(low == 1500.0) and np.all(np.isinf(high))
