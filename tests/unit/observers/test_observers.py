"""Observers: gains against the published ones and the characteristic polynomial, exact estimates stay exact, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from trainctl.observers import asymptotic, intermediate
from trainctl.observers.asymptotic import STATIC, UNCOMPENSATED, V_RATE, W_DRIFT, X_RATE
from trainctl.plants import actuated_units as plant
from trainctl.plants.faults import Fault
from trainctl.signals import FORCE, POSITION, SPEED, Bounds, Consists, Links, Reference, Scene

INF = math.inf
PAPER_POLES = -3.0


def scene(sub_step=0.01):
    """One train of three unlike units."""
    one = np.ones(3)
    c = Consists(
        first=np.array([0, 3]), length=np.array([26.0, 24.0, 20.0]), mass=np.array([8e4, 6e4, 7e4]), rotating=np.array([1.1, 1.0, 1.05]),
        davis=np.tile([0.01176, 0.00077616, 1.6e-5], (3, 1)), stiffness=np.array([1.6e5, 2e5, 0.0]), damping=np.array([600.0, 900.0, 0.0]),
        traction=INF * one, traction_power=INF * one, braking=INF * one, braking_power=INF * one,
        actuator_rate=np.array([50.0, 40.0, 50.0]),
    )  # fmt: skip
    none, b = np.zeros(0), np.full(1, INF)
    links = Links(none.astype(int), none.astype(int), np.zeros(2, int), none, none, none, none, none > 0, np.zeros(1), np.arange(1))
    own = np.array([[1000.0, 40.0, 5e4], [973.7, 40.3, -2e4], [950.1, 39.8, 1e4]])
    return Scene(
        ("1",), c, own, links, Bounds(-b, b, -b, b), Reference(np.array([0.0, INF]), np.zeros((1, 2))), 0.0, 1.0, 1.0, 0.5, sub_step
    )


def plant_rate(constants, own, applied, t=0.0):
    out, power = np.zeros_like(own), np.zeros(6)
    plant.rate(0, constants, t, t, own, applied, out, power)
    return out


FREE = np.zeros(3, bool)


def observed(observer, constants, own, estimate, applied, held=FREE):
    correction, out = np.zeros((len(own), observer.CORRECTIONS)), np.zeros_like(estimate)
    observer.correction(0, constants, own, estimate, held, correction)
    observer.rate(0, constants, own, estimate, held, correction, applied, out)
    return correction, out


def test_gains_of_the_paper():
    k1, k2, k3, k4 = asymptotic.gains([2.5, 0.0, 2.5], [1.0], -3.0)
    assert (k1, k2, k3) == (3.0, -15.0, -89.0)
    np.testing.assert_allclose(k4, [-97.2, 126.4, -4.8], rtol=1e-13)


@pytest.mark.parametrize("omega", [[], [1.0], [0.5, 2.0], [0.3, 1.0, 4.0]])
def test_all_poles_are_where_they_were_put(omega):
    C = [2.5, *[x for k in range(len(omega)) for x in (0.0, 1.0 + k)]]
    _, k2, k3, k4 = asymptotic.gains(C, omega, -2.0)
    n = 3 + 2 * len(omega)
    np.testing.assert_allclose(np.poly(error_matrix(k2, k3, k4, C, omega)), np.poly(np.full(n, -2.0)), rtol=1e-9)


def error_matrix(k2, k3, k4, C, omega):
    """Matrix of eq. (28) for xi = (e_v, zeta, e_f)."""
    n = 2 + len(C)
    A = np.zeros((n, n))
    A[0, :2], A[1, 0], A[1, 2:], A[2:, 0] = (k2, 1.0), k3, C, k4
    for q, w in enumerate(omega):
        A[3 + 2 * q, 4 + 2 * q], A[4 + 2 * q, 3 + 2 * q] = w, -w
    return A


def test_printed_D1_moves_two_poles_into_the_right_half_plane():
    """(17) without -r v is the corrected observer with k2 - r: (s + 3)^5 + 50 s^2 (s^2 + 1)."""
    _, k2, k3, k4 = asymptotic.gains([2.5, 0.0, 2.5], [1.0], -3.0)
    A = error_matrix(k2, k3, k4, [2.5, 0.0, 2.5], [1.0])
    A[1, :2] -= 50.0 * np.array([k2, 1.0])  # zeta' gains -r (zeta + k2 e_v)
    roots = np.sort_complex(np.linalg.eigvals(A))
    np.testing.assert_allclose(roots[[0, 1, 3]], [-63.66, -0.752 - 0.570j, 0.0838 - 2.069j], atol=6e-3)
    assert roots[-1].real > 0.08
    assert max(np.linalg.eigvals(error_matrix(k2, k3, k4, [2.5, 0.0, 2.5], [1.0])).real) < -2.98


@pytest.mark.parametrize("observer", [asymptotic, intermediate])
def test_exact_estimates_follow_the_train_exactly(observer):
    s = scene()
    constants = observer.constants(observer.Params(), s)
    truth = plant.constants(plant.Params(), s.consists)
    applied = np.array([6e4, -1e4, 3e4])
    rate = plant_rate(truth, s.own, applied)
    estimate = observer.initial(observer.Params(), s.own)
    estimate[:, 2] = rate[:, SPEED]
    if observer is intermediate:
        estimate[:, intermediate.XI] = -50.0 * rate[:, SPEED]
    correction, out = observed(observer, constants, s.own, estimate, applied)
    np.testing.assert_allclose(out[:, :2], np.stack([s.own[:, SPEED], rate[:, SPEED]], 1), rtol=1e-12)
    eps = 1e-6  # central difference of the plant's acceleration along its motion: the true jerk
    ahead, behind = (plant_rate(truth, s.own + e * rate, applied)[:, SPEED] for e in (eps, -eps))
    np.testing.assert_allclose(out[:, 2], (ahead - behind) / (2.0 * eps), rtol=1e-5)
    np.testing.assert_allclose(observer.fault_estimate(constants, estimate), 0.0, atol=1e-12)
    np.testing.assert_array_equal(correction[:, UNCOMPENSATED], 0.0)


def test_static_force_is_the_demand_without_input():
    """u = (demand - static) r / m is the jerk the demand adds: eq. (5)."""
    s = scene()
    constants = asymptotic.constants(asymptotic.Params(), s)
    estimate = asymptotic.initial(asymptotic.Params(), s.own)
    correction, out = observed(asymptotic, constants, s.own, estimate, np.zeros(3))
    _, at_static = observed(asymptotic, constants, s.own, estimate, correction[:, STATIC])
    np.testing.assert_allclose(at_static[:, 2], correction[:, W_DRIFT], rtol=1e-13)
    np.testing.assert_allclose(at_static[:, :2], correction[:, [X_RATE, V_RATE]])
    m = s.consists.mass * s.consists.rotating
    np.testing.assert_allclose(at_static[:, 2] - out[:, 2], correction[:, STATIC] * s.consists.actuator_rate / m, rtol=1e-12)


def test_error_obeys_the_matrix_exponential():
    """Eq. (28) on the non-linear train: with faults, wrong speeds and no knowledge of fault and acceleration at the start."""
    s = scene()
    params = asymptotic.Params(start_offset_speed_mps=0.2, start_offset_position_m=-1.5)
    constants = asymptotic.constants(params, s)
    faults = [Fault(train=1, unit=2, kind="constant", amplitude_n_per_s=2e5)]
    faults += [Fault(train=1, unit=2, kind="sinusoid", amplitude_n_per_s=1e5, omega_rad_per_s=1.0, phase_rad=0.4)]
    truth = plant.constants(plant.Params(), s.consists, faults=faults, trains=("1",))
    own, estimate, h = s.own.copy(), asymptotic.initial(params, s.own), 0.002

    def rates(t, own, estimate):
        applied = np.array([6e4, -1e4, 3e4]) * math.cos(0.7 * t)
        return plant_rate(truth, own, applied, t), observed(asymptotic, constants, own, estimate, applied)[1]

    def errors(t, own, estimate):
        rate = rates(t, own, estimate)[0]
        correction = observed(asymptotic, constants, own, estimate, np.zeros(3))[0]
        ev = estimate[:, 1] - own[:, SPEED]
        zeta = correction[:, V_RATE] - rate[:, SPEED] - constants.k2 * ev  # e_w + mu2 - k2 e_v
        f = np.zeros((3, 3))
        f[1] = 1.0, 0.5 * math.sin(t + 0.4), 0.5 * math.cos(t + 0.4)
        return np.column_stack([ev, zeta, estimate[:, 3:6] - f]), estimate[:, 0] - own[:, POSITION]

    xi0, ex0 = errors(0.0, own, estimate)
    for k in range(500):
        t = k * h
        a = rates(t, own, estimate)
        b = rates(t + h / 2, own + h / 2 * a[0], estimate + h / 2 * a[1])
        c = rates(t + h / 2, own + h / 2 * b[0], estimate + h / 2 * b[1])
        d = rates(t + h, own + h * c[0], estimate + h * c[1])
        own = own + h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
        estimate = estimate + h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
    xi, ex = errors(1.0, own, estimate)
    np.testing.assert_allclose(ex, ex0 * math.exp(-3.0), rtol=1e-8)
    for u in range(3):
        A = error_matrix(constants.k2[u], constants.k3[u], constants.k4[u], constants.C[u], [1.0])
        expected = expm(A) @ xi0[u]
        np.testing.assert_allclose(xi[u], expected, atol=1e-7 * np.abs(xi0[u]).max())


def test_without_compensation_only_the_control_forgets_the_fault():
    s = scene()
    estimate = asymptotic.initial(asymptotic.Params(), s.own)
    estimate[:, 3:] = 0.7
    found = []
    for compensate in (True, False):
        constants = asymptotic.constants(asymptotic.Params(compensate=compensate), s)
        found.append(observed(asymptotic, constants, s.own, estimate, np.zeros(3)))
    np.testing.assert_array_equal(found[0][1], found[1][1])
    m = s.consists.mass * s.consists.rotating
    np.testing.assert_allclose(found[1][0][:, UNCOMPENSATED], 0.7 * 4e5 / m)
    np.testing.assert_allclose(asymptotic.fault_estimate(constants, estimate), 0.7 * 4e5 / m)
    np.testing.assert_array_equal(found[0][0][:, UNCOMPENSATED], 0.0)


def test_a_train_that_creeps_by_short_pulls_keeps_its_estimates():
    """Let go for 0.7 s and held for 1.3 s, over and over: the observer has no time to learn, and must not unlearn."""
    s = scene()
    own = s.own.copy()
    own[:, SPEED] = 0.0
    constants = asymptotic.constants(asymptotic.Params(), s)
    estimate, h = asymptotic.initial(asymptotic.Params(), own), 0.01
    estimate[:, 3:6] = estimate[:, 6:] = 0.1
    largest = 0.0
    for k in range(200 * 60):
        held = np.full(3, k % 200 >= 70)
        correction, rate = np.zeros((3, asymptotic.CORRECTIONS)), np.zeros_like(estimate)
        asymptotic.correction(0, constants, own, estimate, held, correction)
        asymptotic.rate(0, constants, own, estimate, held, correction, correction[:, STATIC], rate)
        estimate += h * rate
        largest = max(largest, float(np.abs(estimate[:, 3:]).max()))
    assert largest < 2.0
    np.testing.assert_allclose(np.abs(estimate[:, 6]), 0.1)  # nothing new is remembered of a train that never ran


def test_width_follows_the_fault_model():
    for sinusoids in ((), ((1.0, 2e5),), ((1.0, 2e5), (2.0, 1e5))):
        params = asymptotic.Params(fault_sinusoids=sinusoids)
        assert asymptotic.initial(params, scene().own).shape == (3, asymptotic.width(params)) == (3, 5 + 4 * len(sinusoids))
        constants = asymptotic.constants(params, scene())
        assert np.isfinite(
            observed(asymptotic, constants, scene().own, asymptotic.initial(params, scene().own), np.zeros(3))[1]
        ).all()


@pytest.mark.parametrize(
    "keys, words",
    [
        ({"fault_constant_n_per_s": 0.0}, ["constant fault is unobservable"]),
        ({"fault_sinusoids": [[0.0, 2e5], [1.0, 0.0]]}, ["neither may be 0", "neither may be 0"]),
        ({"fault_sinusoids": [[-1.0, 2e5]]}, ["omega must be above 0"]),
        ({"fault_sinusoids": [[1.0, 2e5], [1.0, 1e5]]}, ["this omega appears twice"]),
        ({"pole_per_s": -60.0}, ["too fast for a sub-step of 0.01 s"]),
        ({}, []),
    ],
)
def test_asymptotic_refuses(keys, words):
    found = asymptotic.violations(asymptotic.Params.model_validate(keys), scene())
    assert len(found) == len(words)
    for line, word in zip(found, words, strict=True):
        assert word in line


def test_start_offsets_above_what_is_tolerated_are_refused():
    for observer in (asymptotic, intermediate):
        most = observer.tolerated_speed_offset(observer.Params(), scene())
        assert observer.violations(observer.Params(start_offset_speed_mps=0.99 * most), scene()) == []
        (line,) = observer.violations(observer.Params(start_offset_speed_mps=-1.01 * most), scene())
        assert f"at most {most:g} m/s" in line


def test_intermediate_refuses_what_the_step_cannot_carry():
    assert "too fast" in intermediate.violations(intermediate.Params(kappa_per_s=300.0), scene())[0]
    assert intermediate.violations(intermediate.Params(), scene()) == []
    assert intermediate.width(intermediate.Params()) == intermediate.initial(intermediate.Params(), scene().own).shape[1]


def test_own_and_estimate_are_left_alone():
    s = scene()
    for observer in (asymptotic, intermediate):
        constants, estimate = observer.constants(observer.Params(), s), observer.initial(observer.Params(), s.own)
        before = s.own.copy(), estimate.copy()
        observed(observer, constants, s.own, estimate, np.full(3, 1e4))
        np.testing.assert_array_equal(s.own, before[0])
        np.testing.assert_array_equal(estimate, before[1])
        assert s.own[0, FORCE] == 5e4
