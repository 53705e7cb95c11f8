from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import namedtuple
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from scenes import coupled_trains

from trainctl.controllers import emu_finite_time as law
from trainctl.observers import none
from trainctl.plants import coupled_units, integrate, shared
from trainctl.signals import POWERS, Extremes, Floats, Reference, References, Scene

JUMP = 0.0137  # s, where the reference below changes its speed: within a sub-step


def scene() -> Scene:
    """Two trains of three units in formation behind a leader whose speed jumps."""
    reference = Reference(np.array([0.0, JUMP, 1e4]), np.array([[10e3, 80.0], [10e3 + 80.0 * JUMP, 85.0]]))
    return coupled_trains((10e3, 6760.0), 3, reference)


class Rig:
    """A closed loop to be advanced."""

    def __init__(self, s: Scene, part: Any, constants: Any, live: bool = True, breaks: tuple[float, ...] = (JUMP,)) -> None:
        self.scene, self.part = s, part
        self.own, self.estimate = s.own.copy(), np.zeros((len(s.own), 0))
        plant = coupled_units.constants(coupled_units.Params(), s.consists)
        self.loop = integrate.Inner(constants, none.Constants(), plant)
        self.received = integrate.Received(np.zeros((len(s.links.sender), part.MESSAGE)), live, False, 0.0)
        self.work = integrate.scratch(self.own, self.estimate, len(s.trains), none.CORRECTIONS, part.MESSAGE)
        self.extremes = Extremes.fresh(len(s.trains), len(s.own), len(part.WATCHED))
        self.breaks = np.array(breaks)
        self.parts = integrate.compiled(part, none, coupled_units, self._arguments(0.0, 0.01, 1))

    def _arguments(self, t: float, h: float, n: int) -> tuple[Any, ...]:
        c = self.scene.consists
        return (
            self.loop, c.first, c.length, self.scene.links, References.one(self.scene.reference, len(self.scene.trains)), self.received, t, h, n, self.breaks, self.own,
            self.estimate, self.work, self.extremes,
        )  # fmt: skip

    def advance(self, t: float, h: float, n: int) -> Floats:
        return integrate.advance(self.parts, *self._arguments(t, h, n))

    def exchange(self, t: float) -> None:
        c = self.scene.consists
        integrate.exchange(
            self.parts,
            self.loop,
            c.first,
            self.scene.links,
            References.one(self.scene.reference, len(self.scene.trains)),
            self.received,
            t,
            self.own,
            self.estimate,
            self.work,
        )


def cruising(**options: Any) -> Rig:
    """The finite-time law."""
    s = scene()
    return Rig(s, law, law.constants(law.Params(), s), **options)


def holding(acceleration: float, s: Scene | None = None) -> Rig:
    """A held acceleration shared out to the units."""
    s = s or scene()
    constants = shared.constants(coupled_units.Params(), s.consists)
    constants.acceleration[:] = acceleration
    return Rig(s, shared, constants, live=False)


def test_a_held_acceleration_moves_the_head_exactly() -> None:
    """x + v T + a T**2 / 2: theta = 1/2, whatever the sub-steps."""
    for n, h in ((800, 0.01), (80, 0.1)):
        rig = holding(0.37)
        start = rig.own.copy()
        rig.advance(0.0, h, n)
        moved = rig.own - start
        assert moved[:, 0] == pytest.approx(80.0 * 8.0 + 0.5 * 0.37 * 64.0, abs=1e-9)
        assert moved[:, 1] == pytest.approx(0.37 * 8.0, abs=1e-11)


def ordered(acceleration: tuple[float, float]) -> Rig:
    """The finite-time law, where trains are told what acceleration to hold: NaN leaves them to their law."""
    rig = cruising(live=False)  # else the other would hear of it
    held = shared.constants(coupled_units.Params(), rig.scene.consists)
    held.acceleration[:] = acceleration
    rig.loop = rig.loop._replace(orders=integrate.NO_ORDERS._replace(held=held))
    return rig


def test_an_ordered_train_moves_as_under_a_train_level_law() -> None:
    """Its couplers, too: they come to rest. The other train does what its law says."""
    told, left, shares = ordered((-0.4, np.nan)), cruising(live=False), holding(-0.4)
    for rig in (told, left, shares):
        rig.own[1, 0] += 0.05
        for t in range(6):
            rig.advance(float(t), 0.01, 100)
    assert (told.own[:3] == shares.own[:3]).all()
    assert (told.own[3:] == left.own[3:]).all()
    stretch = told.own[:2, 0] - told.own[1:3, 0] - told.scene.consists.length[:2]
    assert np.abs(stretch).max() < 1e-4
    assert told.extremes.coupler_min[:2].min() > -0.0501
    assert told.extremes.coupler_max[:2].max() < 0.0501


def test_it_is_of_fourth_order() -> None:
    errors = []
    for n in (10, 20, 400):
        rig = holding(0.0)
        rig.own[1, 0] += 0.05
        rig.advance(0.0, 1.0 / n, n)
        errors.append(rig.own.copy())
    coarse, fine = (np.abs(e - errors[2]).max() for e in errors[:2])
    assert np.log2(coarse / fine) == pytest.approx(4.0, abs=0.4)


def test_steps_are_split_where_the_reference_jumps() -> None:
    def after(h: float, n: int, breaks: tuple[float, ...]) -> Floats:
        rig = cruising(breaks=breaks)
        rig.advance(0.0, h, n)
        return rig.own

    exact = after(0.0004, 250, (JUMP,))
    assert np.abs(after(0.005, 20, (JUMP,)) - exact).max() < 1e-7
    assert np.abs(after(0.005, 20, ()) - exact).max() > 1e-4


def test_a_break_on_the_grid_splits_nothing() -> None:
    a, b = cruising(breaks=(JUMP,)), cruising(breaks=(JUMP, 0.02, 0.03, 0.05 + 5e-10))
    a.advance(0.0, 0.01, 10)
    b.advance(0.0, 0.01, 10)
    assert np.array_equal(a.own, b.own)


def test_two_calls_are_one() -> None:
    a, b = cruising(), cruising()
    a.advance(0.0, 0.01, 100)
    b.advance(0.0, 0.01, 50)
    b.advance(0.5, 0.01, 50)
    assert np.abs(a.own - b.own).max() < 1e-11


def test_it_returns_the_forces_at_the_beginning() -> None:
    rig = cruising()
    s = rig.scene
    drag = 8e4 * (0.01176 + (7.7616e-4 + 1.6e-5 * 80.0) * 80.0)
    first = rig.advance(0.0, 0.01, 10)
    assert first == pytest.approx(np.full(6, drag))  # in formation until the leader jumps
    kept = first.copy()
    later = rig.advance(0.1, 0.01, 10)
    assert np.array_equal(first, kept)
    assert later[s.consists.first[0]] > drag + 1e3


def test_extremes_see_every_sub_step() -> None:
    rig = cruising()
    start = rig.own.copy()
    seen = []
    for k in range(100):
        seen.append((rig.own[0, 0] - rig.own[1, 0] - 80.0, rig.advance(0.01 * k, 0.01, 1)[0]))
    once = cruising()
    once.advance(0.0, 0.01, 100)
    e = once.extremes
    assert e.coupler_max[0] == pytest.approx(max(s for s, _ in seen), abs=1e-9)
    assert e.coupler_min[0] == pytest.approx(min(s for s, _ in seen), abs=1e-9)
    assert e.force_max[0] > max(f for _, f in seen) + 1e3  # just after the jump, where the step is split
    assert max(f for _, f in seen) > seen[-1][1] + 1e3
    assert np.isinf(e.coupler_max[[2, 5]]).all()  # nothing behind the last unit
    assert e.watched_min[1, 0] < 3000.0 + 1e-6
    assert np.isinf(e.watched_min[0, 0])  # nobody ahead of the first: NaN widens nothing
    assert np.array_equal(start, once.scene.own)


def test_energy_is_the_integral_of_the_powers() -> None:
    rig = holding(0.2)
    rig.advance(0.0, 1.0, 10)  # the powers are cubic in time: exact
    supplied = dict(zip(POWERS, rig.extremes.energy.sum(axis=0), strict=True))
    kinetic = 0.5 * 8e4 * 6 * (82.0**2 - 80.0**2)
    assert supplied["traction"] - supplied["resistance"] == pytest.approx(kinetic, rel=1e-11)
    v = np.polynomial.Polynomial([80.0, 0.2])
    drag = (8e4 * 6 * (0.01176 + (7.7616e-4 + 1.6e-5 * v) * v) * v).integ()
    assert supplied["resistance"] == pytest.approx(drag(10.0) - drag(0.0), rel=1e-11)
    assert supplied["damping"] < 1e-9 * kinetic
    assert supplied["braking"] == supplied["gradient"] == supplied["disturbance"] == 0.0


def test_time_at_a_limit_is_counted_per_train() -> None:
    s = scene()
    traction = s.consists.traction.copy()
    traction[4] = 5e3
    rig = holding(0.2, s._replace(consists=s.consists._replace(traction=traction)))
    rig.advance(0.0, 0.01, 150)
    assert rig.extremes.limited == pytest.approx([0.0, 1.5])
    assert rig.extremes.force_max[4] == 5e3


def test_held_messages_are_those_of_the_last_exchange() -> None:
    rig = cruising(live=False)
    rig.exchange(0.0)
    message = np.empty((2, law.MESSAGE))
    for i in range(2):
        rows = slice(3 * i, 3 * i + 3)
        table = np.zeros((0, 0))
        law.message(i, rig.loop.law, np.array([10e3, 80.0, 0.0, 0.0]), 0.0, rig.own[rows], table, table, message[i])
    assert np.array_equal(rig.work.sent, message)
    rig.received.heard[:] = rig.work.sent[rig.scene.links.sender]
    rig.received.heard[:, law.TAIL_SPEED] -= 3.0  # what was heard is not what is
    rig.own[:3, 1] += 1.0
    kept = rig.received.heard.copy()
    applied = rig.advance(0.0, 0.005, 2)
    assert np.array_equal(rig.received.heard, kept)
    drag = 8e4 * (0.01176 + (7.7616e-4 + 1.6e-5 * 80.0) * 80.0)
    assert applied[3] == pytest.approx(drag - 8e4 * 3.0 ** (2 * 0.9 / 1.9))


def test_live_messages_are_those_of_this_instant() -> None:
    rig = cruising()
    rig.received.heard[:] = np.nan
    rig.own[:3, 1] += 1.0
    applied = rig.advance(0.0, 0.005, 1)
    drag = 8e4 * (0.01176 + (7.7616e-4 + 1.6e-5 * 80.0) * 80.0)
    assert applied[3] == pytest.approx(drag + 8e4)  # p_4 sig(1)
    assert np.isfinite(rig.own).all()


compiles = pytest.mark.skipif(bool(integrate.config.DISABLE_JIT), reason="NUMBA_DISABLE_JIT: nothing is compiled")

REPORT = """
import importlib.util, json, sys
spec = importlib.util.spec_from_file_location("rig", sys.argv[1])
rig = importlib.util.module_from_spec(spec)
spec.loader.exec_module(rig)
loop = rig.cruising()
loop.advance(0.0, 0.01, 5)
if sys.argv[2] == "state":
    print(json.dumps(loop.own.tolist()))
else:
    used = (rig.integrate.advance_kernel, rig.integrate.exchange_kernel, rig.law.demand, rig.coupled_units.rate)
    print(json.dumps([sum(f.stats.cache_misses.values()) for f in used]))
"""


def elsewhere(what: str, **environment: str) -> Any:
    """Run ``REPORT`` in a process of its own."""
    command = [sys.executable, "-c", REPORT, __file__, what]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_interpreted_and_compiled_code_agree() -> None:
    rig = cruising()
    rig.advance(0.0, 0.01, 5)
    assert np.abs(np.array(elsewhere("state", NUMBA_DISABLE_JIT="1")) - rig.own).max() < 1e-11


@compiles
def test_another_process_finds_everything_compiled() -> None:
    cruising()
    assert elsewhere("cache") == [0, 0, 0, 0]


def first_of(constants: Any) -> float:
    return constants[0]  # type: ignore[no-any-return]


@compiles
def test_an_exchange_that_nobody_makes_is_not_compiled() -> None:
    rig = cruising()
    spared = integrate.compiled(rig.part, none, coupled_units, rig._arguments(0.0, 0.01, 1), exchanges=False)
    assert spared.exchange is integrate.exchange_kernel
    assert rig.parts.exchange is not integrate.exchange_kernel


def test_a_law_that_is_gone_costs_nobody_else_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Types are kept by name: an index that names a module which cannot be imported any more is lost as a whole."""
    monkeypatch.setattr(integrate.config, "CACHE_DIR", str(tmp_path))
    gone = ModuleType("gone_law")
    gone.Constants = namedtuple("Constants", "x", module="gone_law")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gone_law", gone)

    def from_cache(place: str, constants: Any) -> tuple[float, int]:
        """What comes out, and how often it was found compiled."""
        kernel = numba.njit(cache=True)(first_of)
        value = integrate.from_cache(kernel, place, (numba.typeof(constants),))(constants)
        return value, sum(kernel.stats.cache_hits.values())  # type: ignore[return-value]

    theirs, ours = gone.Constants(3.0), none.Constants(4.0)
    assert [from_cache("a", theirs), from_cache("b", ours)] == [(3.0, 0), (4.0, 0)]
    assert [from_cache("a", theirs), from_cache("b", ours)] == [(3.0, 1), (4.0, 1)]
    monkeypatch.delitem(sys.modules, "gone_law")
    assert from_cache("b", ours) == (4.0, 1)
    assert [from_cache("a", ours), from_cache("a", ours)] == [(4.0, 0), (4.0, 1)]
    assert str(tmp_path) == integrate.config.CACHE_DIR
