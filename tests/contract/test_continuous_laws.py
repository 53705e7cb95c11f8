"""Every law that is evaluated in each stage of the integrator keeps the same contract, whoever wrote it.

A module in ``trainctl.controllers`` with ``CLOCK = "continuous"`` is found by itself, and runs on the first plant and with the first
observer it names.
"""

from __future__ import annotations

from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from units import LEADER, ROWS, TRAINS, arrays, at_rest, disturbed, evaluate, modules, moved, others, rows

from trainctl import controllers, observers, plants
from trainctl.signals import SPEED, Scene

LAWS = {name: law for name, law in modules(controllers, "CLOCK").items() if law.CLOCK == "continuous"}


class Rig:
    """A law with what it runs with."""

    def __init__(self, law: Any) -> None:
        self.law, self.params = law, law.Params()
        self.plant = modules(plants, "STATES")[getattr(law, "PLANTS", ("coupled_units",))[0]]
        self.observer = modules(observers, "CORRECTIONS")[getattr(law, "OBSERVERS", ("none",))[0]]

    def at_rest(self) -> Scene:
        return at_rest(self.plant.STATES)

    def disturbed(self) -> Scene:
        return disturbed(self.at_rest())

    def __call__(self, scene: Scene, **more: Any) -> Any:
        return evaluate(self.law, self.observer, self.plant, scene, self.params, **more)


@pytest.fixture(params=sorted(LAWS))
def rig(request: pytest.FixtureRequest) -> Rig:
    return Rig(LAWS[request.param])


def test_there_are_continuous_laws() -> None:
    assert {"emu_finite_time", "fault_tolerant"} <= set(LAWS)


def test_objections_are_lines_of_text_and_there_are_none_to_the_formation(rig: Rig) -> None:
    assert rig.law.violations(rig.params, rig.at_rest()) == []
    far = rig.at_rest()
    far.own[rows(1), 0] += 2500.0  # nearly on the train ahead
    found = rig.law.violations(rig.params, far)
    assert found and all(isinstance(line, str) and line and "\n" not in line for line in found)


def test_shapes(rig: Rig) -> None:
    law, scene = rig.law, rig.disturbed()
    assert law.ORDER in ("parallel", "chain") and law.MESSAGE >= 0
    low, high = law.watched_bounds(rig.params, scene)
    assert low.shape == high.shape == (TRAINS, len(law.WATCHED))
    assert (low < high).all()
    seen = np.full(len(law.WATCHED), np.inf)
    for i in range(TRAINS):
        law.watch(i, law.constants(rig.params, scene), LEADER, scene.consists.first, scene.own, scene.links, seen)
        assert ((low[i] < seen) & (seen < high[i]) | np.isnan(seen)).all(), "a sound scene keeps what is watched"
    assert all(a.flags.c_contiguous for a in arrays(law.constants(rig.params, scene)))


@pytest.mark.parametrize("metres", [0.0, 1e5])
def test_finite_even_far_out_and_on_old_messages(rig: Rig, metres: float) -> None:
    scene = rig.disturbed()
    scene.own[:, 0] += np.repeat(np.linspace(-metres, metres, TRAINS), ROWS // TRAINS)
    live = rig(scene)
    assert np.isfinite(live.force).all() and np.isfinite(live.sent).all()
    old = np.ascontiguousarray(live.sent[scene.links.sender])
    for age in (0.0, 5.0):
        assert np.isfinite(rig(scene, heard=old, age=age).force).all()


def test_repeatable_and_inputs_untouched(rig: Rig) -> None:
    scene = rig.disturbed()
    kept, leader = deepcopy(scene), LEADER.copy()
    one, two = rig(scene), rig(scene)
    for a, b in zip(arrays(one), arrays(two), strict=True):
        assert a.tobytes() == b.tobytes()
    for a, b in zip(arrays(scene), arrays(kept), strict=True):
        assert a.tobytes() == b.tobytes()
    assert LEADER.tobytes() == leader.tobytes()


def test_local(rig: Rig) -> None:
    """A stranger's state and mass leave the forces bit-identical: with the messages frozen those of all other trains."""
    scene = rig.disturbed()
    before, links = rig(scene), scene.links
    frozen = np.ascontiguousarray(before.sent[links.sender])
    for i in range(TRAINS):
        held, live = rig(moved(scene, i), heard=frozen), rig(moved(scene, i))
        assert held.force[others(i)].tobytes() == before.force[others(i)].tobytes()
        assert (held.force[rows(i)] != before.force[rows(i)]).any()
        # In a chain a message goes by the demand of its sender: a train answers to all that are ahead, too.
        hears = (
            {int(r) for s, r in zip(links.sender, links.receiver, strict=True) if s == i}
            if rig.law.ORDER == "parallel"
            else set(range(i + 1, TRAINS))
        )
        strangers = [j for j in range(TRAINS) if j != i and j not in hears]
        for j in strangers:
            assert live.force[rows(j)].tobytes() == before.force[rows(j)].tobytes(), (i, j)
        assert all((live.force[rows(j)] != before.force[rows(j)]).any() for j in hears if abs(j - i) == 1 and j > i)


def test_equilibrium_is_held(rig: Rig) -> None:
    """At its slot and at the reference's speed no unit is accelerated, and what is estimated stays as it is."""
    scene = rig.at_rest()
    now = rig(scene)
    np.testing.assert_allclose(now.own_rate[:, 0], scene.own[:, SPEED], rtol=0.0, atol=0.0)
    np.testing.assert_allclose(now.own_rate[:, SPEED], 0.0, atol=1e-9)
    inertia = scene.consists.mass * scene.consists.rotating
    np.testing.assert_allclose(now.own_rate[:, 2:] / inertia[:, None], 0.0, atol=1e-6)  # m/s3
    if now.estimate_rate.shape[1]:
        np.testing.assert_allclose(now.estimate_rate[:, 1:], 0.0, atol=1e-6)
    assert not np.any(now.sent[:, :1] - now.sent[:1, :1] - scene.links.slot[:, None] + scene.links.slot[0] > 1e-6)


def test_a_law_that_breaks_the_contract_is_found_out() -> None:
    law = LAWS["emu_finite_time"]

    def reads_all(i: int, constants: Any, *rest: Any) -> None:
        law.demand(i, constants, *rest)
        rest[-1][0] += 1e-3 * constants.units[:, 0].sum()

    def writes(i: int, constants: Any, leader: Any, age: float, slot: float, own: Any, *rest: Any) -> None:
        law.demand(i, constants, leader, age, slot, own, *rest)
        own[0, 0] += 1e-9 * own[0, 0]

    for demand, check in (
        (reads_all, test_local),
        (writes, test_repeatable_and_inputs_untouched),
        (reads_all, test_equilibrium_is_held),
    ):
        with pytest.raises(AssertionError):
            check(Rig(SimpleNamespace(**{**vars(law), "demand": demand})))
