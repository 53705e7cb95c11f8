"""Sliding mode with an extended state observer: what it finds out, what it does without, what is refused."""

from __future__ import annotations

import numpy as np
from strings import LENGTH_M, String, first_brakes, scene

from trainctl.controllers import sliding_mode as law

PUSH = -0.05  # m/s2, an acceleration that the model leaves out


def test_the_observer_finds_what_the_model_leaves_out() -> None:
    string = String(law, law.Params(), scene(3, 500.0))
    for _ in range(200):
        string.step(push=PUSH)
    np.testing.assert_allclose(string.memory[0].z2, PUSH, atol=1e-6)
    np.testing.assert_allclose(string.memory[0].z1, string.own[:, 1], atol=1e-6)
    np.testing.assert_allclose(string.spacing, 500.0, atol=1e-3)


def test_without_the_observer_the_speed_is_wrong() -> None:
    """The same with an observer that knows next to nothing: the first train, which has no place to keep, runs too slowly."""
    string = String(law, law.Params(observer_per_s=1e-9), scene(3, 500.0))
    for _ in range(400):
        string.step(push=PUSH)
    assert string.own[0, 1] < 39.6


def test_a_limit_the_law_does_not_know_of_does_not_wind_it_up() -> None:
    """Half a minute in which nothing that is asked for comes: the observer holds it for a force, up to its bound and not beyond."""
    string = String(law, law.Params(), scene(2, 500.0))
    string.own[1, 0] -= 100.0  # it closes up, in vain
    for _ in range(30):
        speed = string.own[:, 1].copy()
        string.step()
        string.own[:, 1] = np.minimum(string.own[:, 1], speed)
    assert string.memory[0].z2[1] == -0.15
    fast = []
    for _ in range(120):
        string.step()
        fast.append(float(string.own[1, 1]))
    assert max(fast) < 43.0 + 0.01  # the reference, and faster_mps


def test_on_the_surface_the_spacing_error_decays_as_it_says() -> None:
    """e' = -c e once S = 0: from 20 m too far, e falls by exp(-c) each second."""
    string = String(law, law.Params(surface_per_s=0.05, reach_mps2=0.5, layer_mps=1.0), scene(2, 500.0))
    string.own[1, 0] -= 20.0
    errors = []
    for _ in range(120):
        string.step()
        errors.append(float(string.spacing[0]) - 500.0)
    late = np.array(errors[30:60])
    np.testing.assert_allclose(late[1:] / late[:-1], np.exp(-0.05), atol=5e-3)


def test_behind_a_first_train_that_stops_nobody_is_touched() -> None:
    string = String(law, law.Params(), scene(4, 300.0))
    least = string.spacing
    for _ in range(300):
        string.step(first_brakes(4, 0.6))
        least = np.minimum(least, string.spacing)
    assert np.all(least > LENGTH_M)
    np.testing.assert_allclose(string.spacing, 300.0, atol=1.0)


def test_what_is_refused() -> None:
    sc = scene(2, 500.0)
    assert law.violations(law.Params(), sc) == []
    assert law.violations(law.Params(observer_per_s=1.0), sc) == [
        "controller.observer_per_s = 1: omega T = 1 with a control period of 1 s; must be below 1"
    ]
    (line,) = law.violations(law.Params(reach_mps2=3.0), sc)
    assert line.startswith(
        "controller.reach_mps2 = 3: unstable with surface_per_s = 0.1, layer_mps = 1 and a control period of 1 s"
    )
    assert law.violations(law.Params(), scene(2, 200.0)) == [
        "link[1,2].desired_m = 200: must be above 200, the length of the train ahead"
    ]
