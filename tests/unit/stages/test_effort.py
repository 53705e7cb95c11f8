"""Force and work of a motion that was not ours."""

from __future__ import annotations

import numpy as np
import pytest

from trainctl.davis import resistance
from trainctl.scenario.build import open_scenario
from trainctl.signals import POWERS, Observed, Seen
from trainctl.stages.effort import Effort


@pytest.fixture(scope="module")
def model():
    return open_scenario("three_tracks")


def moved(p, v, after):
    """Trains that go from speeds ``v`` to ``after`` over a step, and the energies told of it."""
    n = len(p.scenario.ids)
    seen = Seen(p.own[p.leading, 0], np.zeros(n, int), np.zeros(n, int), np.ones(n, bool))
    there = seen._replace(position=seen.position + np.full(n, after) * p.scenario.run.step_s)
    nobody = np.full(n, -1)
    now, later = (Observed(x, np.full(n, u), nobody, np.full(n, np.nan)) for x, u in ((seen, v), (there, after)))
    motion, energy = Effort(p).step(now, later)
    return motion, dict(zip(POWERS, energy.T, strict=True))


@pytest.mark.parametrize(("v", "after"), [(20.0, 20.5), (20.5, 20.0), (30.0, 30.0), (0.0, 0.4), (5.0, 0.0)])
def test_work_balances_with_the_kinetic_energy(model, v, after):
    motion, energy = moved(model, v, after)
    c = model.consists
    inertia = np.add.reduceat(c.mass * c.rotating, c.first[:-1])
    gained = 0.5 * inertia * (after**2 - v**2)
    np.testing.assert_allclose(
        energy["traction"] - energy["braking"] - energy["resistance"] - energy["gradient"], gained, rtol=1e-12
    )
    assert (np.minimum(energy["traction"], energy["braking"]) == 0.0).all()
    np.testing.assert_allclose(motion.displacement, after * model.scenario.run.step_s, atol=1e-9)


def test_at_constant_speed_the_force_is_the_running_resistance(model):
    motion, energy = moved(model, 50.0, 50.0)
    c = model.consists
    expected = np.add.reduceat(c.mass * resistance(np.repeat(50.0, len(c.mass)), c.davis), c.first[:-1])
    np.testing.assert_allclose(motion.input * Effort(model).mass, energy["traction"] / 50.0 / model.scenario.run.step_s)
    np.testing.assert_allclose(energy["traction"], expected * 50.0 * model.scenario.run.step_s, rtol=1e-12)
