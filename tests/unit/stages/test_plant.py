"""One step of every plant by itself: what it is ordered, what it remembers, how late it acts, and a train that turns round."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from staged import started

from trainctl.scenario.build import open_scenario
from trainctl.signals import FORCE, POSITION, SPEED, Disturbed
from trainctl.stages import plant

PLANTS = {"point": "robust_constrained", "coupled_units": "emu_finite_time", "actuated_units": "fault_tolerant"}


class Driven:
    """The plant of a scenario, ready to be asked for one step."""

    def __init__(self, scenario):
        self.loop, _ = started(open_scenario(scenario, {"supervisor.mode": "on"}))
        self.loop.step()  # who hears whom
        s, self.p = self.loop.state, self.loop.p
        self.own, self.state, self.plant = s.own.copy(), s.plant, self.loop.plant
        self.n = len(self.p.scenario.ids)
        zero = np.zeros(self.n)
        self.calm = Disturbed(zero, zero, zero, zero + 1.0, zero)

    def step(self, ordered=None):
        s = self.loop.state
        orders = np.full(self.n, np.nan) if ordered is None else np.full(self.n, ordered)
        return self.plant.step(
            s.k, self.loop.time, self.own, s.demand, orders, s.formed, s.messages, plant.copied(self.state), self.calm, calm=True
        )


@pytest.fixture(scope="module", params=PLANTS.values(), ids=PLANTS)
def driven(request):
    return Driven(request.param)


def test_a_step_that_is_tried_leaves_everything_as_it_was(driven):
    own, estimate = driven.own.copy(), driven.state.estimate.copy()
    first, second = driven.step(), driven.step()
    np.testing.assert_array_equal(first.own, second.own)
    np.testing.assert_array_equal(driven.own, own)
    np.testing.assert_array_equal(driven.state.estimate, estimate)
    heads = driven.p.leading
    np.testing.assert_allclose(first.own[heads, POSITION] - own[heads, POSITION], first.motion.displacement, atol=1e-9)


def test_an_order_stands_for_what_the_law_demands(driven):
    c, step_s, moves = driven.p.consists, driven.p.scenario.run.step_s, driven.own[driven.p.leading, SPEED] > 1.0
    free, braked = driven.step(), driven.step(-0.05)

    def mean(own):
        return np.add.reduceat(c.mass * own[:, SPEED], c.first[:-1]) / c.train_mass()

    gained = (mean(braked.own) - mean(driven.own)) / step_s
    late = driven.p.plant.STATES > FORCE
    np.testing.assert_allclose(gained[moves], -0.05, atol=0.1 if late else 2e-4)
    other = np.abs((mean(free.own) - mean(driven.own)) / step_s + 0.05) > 10.0 * np.abs(gained + 0.05)
    assert moves.sum() > 1 and other[moves].all()


def test_only_actuators_make_a_train_run_on(driven):
    late = driven.plant.overrun(driven.own, 0.5)
    if driven.p.plant.STATES <= FORCE:
        assert (late == 0.0).all() and (driven.plant.acceleration(driven.own) == 0.0).all()
        return
    a, v = driven.plant.acceleration(driven.own), driven.own[driven.p.leading, SPEED]
    np.testing.assert_allclose(late, driven.p.assumed.lag * v * np.maximum(a + 0.5, 0.0) / 0.5)
    pulling = driven.own.copy()
    pulling[:, FORCE] += 1e4
    assert (driven.plant.overrun(pulling, 0.5) >= late).all() and (driven.plant.overrun(pulling, 0.5) > 0.0).any()


def test_couplers_under_load_may_speed_up_a_head(driven):
    if not driven.p.has_units:
        assert (driven.plant.swing(driven.own) == 0.0).all()
        return
    own, first, length = driven.own.copy(), driven.p.consists.first, driven.p.consists.length
    for a, b in pairwise(first):  # every coupler at rest
        own[a:b, POSITION] = own[a, POSITION] - np.concatenate([[0.0], np.cumsum(length[a : b - 1])])
        own[a:b, SPEED] = 50.0
    np.testing.assert_allclose(driven.plant.swing(own), 0.0, atol=1e-6)
    own[driven.p.leading + 1, POSITION] += 0.002
    assert (driven.plant.swing(own) > 1e-3).all()


def test_a_train_that_turns_round_twice_is_as_before(driven):
    own, i = driven.own.copy(), 1
    first = driven.p.consists.first
    rows = slice(first[i], first[i + 1])
    if driven.p.plant.STATES > FORCE:
        own[rows, FORCE] = -np.abs(own[rows, FORCE])  # traction is let go
    own[rows, SPEED] = 0.0
    front = float(own[first[i], POSITION])
    once, state = driven.plant.turned(i, own, 7000.0, driven.state)
    assert once[first[i], POSITION] == 7000.0 and (np.diff(once[rows, POSITION]) < 0.0).all()
    twice, _ = driven.plant.turned(i, once, front, state)
    np.testing.assert_allclose(twice, own, atol=1e-9)
    others = np.ones(len(own), bool)
    others[rows] = False
    np.testing.assert_array_equal(once[others], own[others])


def test_messages_and_noise_cut_a_step_into_pieces():
    p = open_scenario("fault_tolerant")
    whole = plant.Units(p, started(p)[0].plant.radio)
    assert whole._pieces(3.0) == [(3.0, p.scenario.run.sub_steps)]
    often = replace(p, scenario=p.scenario.model_copy(
        update={"topology": p.scenario.topology.model_copy(update={"communication_period_s": 0.25})}
    ))  # fmt: skip
    cut = plant.Units(often, whole.radio)._pieces(3.0)
    assert [t for t, _ in cut] == [3.0, 3.25, 3.5, 3.75] and {n for _, n in cut} == {p.scenario.run.sub_steps // 4}
