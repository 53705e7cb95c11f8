"""Every observer keeps the same contract; a module in ``trainctl.observers`` with ``CORRECTIONS`` is found by itself."""

from __future__ import annotations

from copy import deepcopy
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from units import FREE, ROWS, TRAINS, arrays, at_rest, disturbed, modules, moved, others, rows

from trainctl import observers
from trainctl.signals import FORCE, SPEED, Floats, Scene

OBSERVERS = modules(observers, "CORRECTIONS")


@pytest.fixture(params=sorted(OBSERVERS))
def observer(request: pytest.FixtureRequest) -> Any:
    return OBSERVERS[request.param]


def observed(observer: Any, scene: Scene, estimate: Floats, applied: Floats) -> tuple[Floats, Floats]:
    """Corrections and rates of the estimates of all trains."""
    constants = observer.constants(observer.Params(), scene)
    correction, rate = np.zeros((ROWS, observer.CORRECTIONS)), np.zeros_like(estimate)
    for i in range(TRAINS):
        part = scene.own[rows(i)], estimate[rows(i)], FREE[rows(i)], correction[rows(i)]
        observer.correction(i, constants, *part)
        observer.rate(i, constants, *part, applied[rows(i)], rate[rows(i)])
    return correction, rate


def case(observer: Any) -> tuple[Scene, Floats, Floats]:
    """A disturbed scene, estimates a little off, forces."""
    scene, rng = disturbed(at_rest(3)), np.random.default_rng(1)
    estimate = observer.initial(observer.Params(), scene.own)
    return scene, estimate + rng.normal(0.0, 0.1, estimate.shape), scene.own[:, FORCE] + rng.normal(0.0, 1e3, ROWS)


def test_there_are_observers() -> None:
    assert {"none", "asymptotic", "intermediate"} <= set(OBSERVERS)


def test_shapes_finite_and_no_objections(observer: Any) -> None:
    scene, estimate, applied = case(observer)
    params = observer.Params()
    assert observer.violations(params, scene) == []
    assert estimate.shape == (ROWS, observer.width(params)) and estimate.dtype == np.float64
    assert all(np.isfinite(a).all() for a in observed(observer, scene, estimate, applied))
    for logged in (observer.fault_estimate, observer.acceleration_estimate):
        found = logged(observer.constants(params, scene), estimate)
        assert found.shape == (ROWS,) and (np.isfinite(found) if observer.CORRECTIONS else np.isnan(found)).all()


def test_repeatable_and_inputs_untouched(observer: Any) -> None:
    given = case(observer)
    kept = deepcopy(given)
    one, two = observed(observer, *given), observed(observer, *given)
    for a, b in (*zip(arrays(one), arrays(two), strict=True), *zip(arrays(given), arrays(kept), strict=True)):
        assert a.tobytes() == b.tobytes()


def test_local(observer: Any) -> None:
    """Another train's state, mass and estimates leave those of a train bit-identical."""
    scene, estimate, applied = case(observer)
    before = observed(observer, scene, estimate, applied)
    for i in range(TRAINS):
        other = estimate.copy()
        other[rows(i)] += 0.5
        after = observed(observer, moved(scene, i), other, applied)
        for a, b in zip(after, before, strict=True):
            assert a[others(i)].tobytes() == b[others(i)].tobytes()
            assert not a.size or (a[rows(i)] != b[rows(i)]).any()


def test_exact_estimates_at_an_equilibrium_stay(observer: Any) -> None:
    scene = at_rest(3)
    estimate = observer.initial(observer.Params(), scene.own)
    _, rate = observed(observer, scene, estimate, scene.own[:, FORCE])
    if rate.shape[1]:
        np.testing.assert_allclose(rate[:, 0], scene.own[:, SPEED], atol=1e-12)
        np.testing.assert_allclose(rate[:, 1:], 0.0, atol=1e-9)


def test_a_train_that_turns_twice_is_estimated_as_before(observer: Any) -> None:
    """Estimates of a train that turns are mirrored with it; the fault stays, since an actuator's fault runs with its train."""
    scene, estimate, _ = case(observer)
    params, kept = observer.Params(), estimate.copy()
    before, after = scene.own[rows(0), 0], 5000.0 - scene.own[rows(0), 0]
    turned = observer.turned(params, estimate[rows(0)], before, after)
    again = observer.turned(params, turned, after, before)
    assert (estimate == kept).all() and again == pytest.approx(estimate[rows(0)], abs=1e-9)
    if turned.shape[1]:
        errors = estimate[rows(0), 0] - before
        assert turned[:, 0] - after == pytest.approx(-errors, abs=1e-9) and (turned[:, 1] == -estimate[rows(0), 1]).all()
        constants, whole = observer.constants(params, scene), estimate.copy()
        whole[rows(0)] = turned
        faults = (observer.fault_estimate(constants, one)[rows(0)] for one in (estimate, whole))
        assert next(faults) == pytest.approx(next(faults), abs=1e-9)


def test_an_observer_that_breaks_the_contract_is_found_out() -> None:
    good = OBSERVERS["intermediate"]

    def reads_all(i: int, constants: Any, own: Any, estimate: Any, held: Any, correction: Any, applied: Any, out: Any) -> None:
        good.rate(i, constants, own, estimate, held, correction, applied, out)
        out[0, 2] += 1e-9 * constants.train.units[:, 1].sum()

    def writes(i: int, constants: Any, own: Any, estimate: Any, held: Any, correction: Any, applied: Any, out: Any) -> None:
        good.rate(i, constants, own, estimate, held, correction, applied, out)
        applied[0] += 1.0

    checks = (
        (reads_all, test_local),
        (reads_all, test_exact_estimates_at_an_equilibrium_stay),
        (writes, test_repeatable_and_inputs_untouched),
    )
    for rate, check in checks:
        with pytest.raises(AssertionError):
            check(SimpleNamespace(**{**vars(good), "rate": rate}))
