"""Fault-tolerant law: barrier, conversions, locality, held messages, joining rule, what is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl.controllers import fault_tolerant as law
from trainctl.observers import asymptotic
from trainctl.plants import actuated_units as plant
from trainctl.scenario.reference import constant, table
from trainctl.signals import Bounds, Consists, Links, Scene

INF = math.inf
FIRST = np.array([0, 2, 5, 6])
OFFSET = [26.0, 50.0, 0.0]  # head to tail of the three trains at rest


def scene(spacing_error=(0.0, 100.0, -300.0), speed_error=(0.0, 2.0, -3.0), **changes):
    """Trains of two, three and one unlike units; desired spacing 7000 m front to front."""
    one = np.ones(6)
    c = Consists(
        first=FIRST, length=np.array([26.0, 24.0, 20.0, 30.0, 20.0, 20.0]), mass=np.array([8e4, 6e4, 7e4, 5e4, 8e4, 9e4]),
        rotating=np.array([1.1, 1.0, 1.05, 1.0, 1.08, 1.0]), davis=np.tile([0.01176, 0.00077616, 1.6e-5], (6, 1)),
        stiffness=np.array([1.6e5, 0.0, 1.6e5, 2e5, 0.0, 0.0]), damping=np.array([600.0, 0.0, 600.0, 900.0, 0.0, 0.0]),
        traction=INF * one, traction_power=INF * one, braking=INF * one, braking_power=INF * one,
        actuator_rate=np.array([50.0, 40.0, 50.0, 45.0, 50.0, 50.0]),
    )  # fmt: skip
    own, x, v = np.zeros((6, 2)), 50000.0, 30.0
    for i in range(3):
        x -= spacing_error[i] + (7000.0 if i else 0.0)
        v -= speed_error[i]
        a, b = FIRST[i], FIRST[i + 1]
        own[a:b, 0] = x - np.concatenate([[0.0], np.cumsum(c.length[a : b - 1])])
        own[a:b, 1] = v
    links = Links(
        sender=np.array([1, 0, 2, 1]), receiver=np.array([0, 1, 1, 2]), first=np.array([0, 1, 3, 4]),
        desired=np.array([-7000.0, 7000.0, -7000.0, 7000.0]), lower=np.array([-9000.0, 5000.0, -9000.0, 5000.0]),
        upper=np.array([-5000.0, 9000.0, -5000.0, 9000.0]), weight=np.ones(4), heard=np.ones(4, bool),
        slot=np.array([-500.0, -7500.0, -14500.0]), order=np.array([0, 1, 2]),
    )  # fmt: skip
    b = np.full(3, INF)
    made = Scene(
        ("a", "b", "c"), c, plant.balanced(own, c), links, Bounds(-b, b, -b, b), constant(30.0, 50500.0), 0.0, 1.0, 1.0, 0.5, 0.01
    )
    return made._replace(**changes)


class Evaluated:
    """One evaluation of the chain, front to rear, as the integrator does it."""

    def __init__(self, s, params=None, estimate=None, age=0.0, heard=None, leader=None):
        params = params or law.Params()
        self.constants, observer = law.constants(params, s), asymptotic.constants(asymptotic.Params(), s)
        leader = np.array([50500.0, 30.0, 0.0, 0.0]) if leader is None else leader
        estimate = asymptotic.initial(asymptotic.Params(), s.own) if estimate is None else estimate
        self.out, self.sent, self.correction = np.zeros(len(s.own)), np.zeros((3, law.MESSAGE)), np.zeros((len(s.own), 5))
        self.estimate_rate = np.zeros_like(estimate)
        for i in s.links.order:
            rows, hears = slice(FIRST[i], FIRST[i + 1]), slice(s.links.first[i], s.links.first[i + 1])
            own, est = np.ascontiguousarray(s.own[rows]), np.ascontiguousarray(estimate[rows])
            free = np.zeros(len(own), bool)
            asymptotic.correction(i, observer, own, est, free, self.correction[rows])
            brought = np.ascontiguousarray(self.sent[s.links.sender[hears]]) if heard is None else heard[hears]
            law.demand(
                i, self.constants, leader, age, s.links.slot[i], own, est, self.correction[rows], s.links.desired[hears], brought,
                self.out[rows],
            )  # fmt: skip
            asymptotic.rate(i, observer, own, est, free, self.correction[rows], self.out[rows], self.estimate_rate[rows])
            law.message(i, self.constants, leader, s.links.slot[i], own, est, self.estimate_rate[rows], self.sent[i])


def test_barrier_is_the_printed_one_and_its_derivative():
    """(34), (35): ln((1 + x / rho2) / (1 - x / rho1)) times its own derivative."""
    bounds = np.array([-2351.0, 1947.0, -2300.0, 1900.0])
    for x in (-2290.0, -500.0, 0.0, 1.0, 1800.0):
        value, slope = law.barrier(x, bounds)
        assert value == pytest.approx(math.log((1 + x / 2351) / (1 - x / 1947)) * (1 / (2351 + x) + 1 / (1947 - x)), rel=1e-12)
        assert slope == pytest.approx((law.barrier(x + 1e-3, bounds)[0] - law.barrier(x - 1e-3, bounds)[0]) / 2e-3, rel=1e-5)


def test_barrier_goes_on_straight_where_the_step_cannot_resolve_it():
    lower, upper = law.mixed_bounds(law.Params(), -2351.0, 1947.0)
    kept = {h: law.resolved(law.Params(), lower, upper, h) for h in (0.01, 0.001)}
    assert lower < kept[0.001][0] < kept[0.01][0] < -0.9 * 26 and 0.9 * 26 < kept[0.01][1] < kept[0.001][1] < upper
    bounds = np.array([lower, upper, *kept[0.01]])
    edge, slope = law.barrier(kept[0.01][1], bounds)
    assert (2.1 + 4.3 * slope) ** 2 * 0.01 == pytest.approx(2.0, rel=1e-6)
    for q in (26.0, 30.0, 1e4):
        assert law.barrier(q, bounds) == pytest.approx((edge + slope * (q - kept[0.01][1]), slope))


def test_remark_2_1_bounds_of_q_for_the_paper():
    lower, upper = law.mixed_bounds(law.Params(), -2351.0, 1947.0)  # printed swapped and rounded: 26.5, 30.55
    assert (upper, -lower) == pytest.approx((26.49, 30.53))


def test_at_the_desired_spacing_and_speed_the_demand_holds_speed():
    s = scene(spacing_error=(0.0, 0.0, 0.0), speed_error=(0.0, 0.0, 0.0))
    made = Evaluated(s)
    np.testing.assert_allclose(made.out, s.own[:, 2], atol=1e-6)
    np.testing.assert_allclose(made.sent, [[-500.0, 0, 0, 0], [-7500.0, 0, 0, 0], [-14500.0, 0, 0, 0]], atol=1e-9)


def test_watched_errors_are_measured_from_tail_to_head():
    s = scene()
    s.own[1, :2] += 3.0, 0.5  # the tail of the first train
    found = law.errors(law.constants(law.Params(), s), s)
    np.testing.assert_allclose(found[:, 0], [0.0, 103.0, -300.0], atol=1e-9)
    np.testing.assert_allclose(found[:, 1], [0.0, 2.5, -3.0], atol=1e-12)
    np.testing.assert_allclose(found[:, 2], found[:, 1] + 0.01 * found[:, 0])
    np.testing.assert_allclose(law.constants(law.Params(), s).offset, OFFSET)


def test_head_jerk_is_that_of_equation_37():
    """With E2's sign: w_hat' = G + ... + q + ell4 beta2, evaluated term by term."""
    s = scene()
    made = Evaluated(s)
    p, w = law.Params(), asymptotic.W
    lower, upper = law.mixed_bounds(p, -2000.0, 2000.0)
    for i in (1, 2):
        xt, vt, qt = law.errors(made.constants, s)[i]
        wt = 0.0
        phi, dphi = law.barrier(xt, np.array([-2000.0, 2000.0, -1999.0, 1999.0]))
        psi, dpsi = law.barrier(qt, np.array([lower, upper, lower, upper]))
        beta1 = -phi - p.head_l2 * qt - p.head_l3 * psi
        b_v = -p.head_l2 - p.head_l3 * dpsi
        b_x = -dphi + p.head_l1_per_s * b_v
        beta2 = wt + p.head_l1_per_s * vt - beta1
        G = made.estimate_rate[FIRST[i] - 1, w]
        expected = G + p.head_l1_per_s**2 * beta2 - b_x * vt + b_v**2 * beta2 + qt + p.head_l4 * beta2
        assert made.estimate_rate[FIRST[i], w] == pytest.approx(expected, rel=1e-12)


def test_old_messages_are_carried_on_in_the_moving_frame():
    """A sender whose acceleration relative to the leader has been constant: its old message is as good as a new one."""
    s = scene()
    rng = np.random.default_rng(2)
    fresh, age = np.column_stack([rng.normal(0.0, 5.0, (4, 3)), np.zeros(4)]), 0.7
    fresh[:, 0] += s.links.slot[s.links.sender]
    old = fresh.copy()
    old[:, 1] -= age * fresh[:, 2]
    old[:, 0] -= age * fresh[:, 1] - age**2 / 2 * fresh[:, 2]
    np.testing.assert_allclose(Evaluated(s, age=age, heard=old).out, Evaluated(s, heard=fresh).out, rtol=1e-9)


def test_the_jerk_of_an_old_message_fades():
    """Far enough in the past only the acceleration it has left behind remains, FADE times the jerk."""
    s = scene()
    heard = np.zeros((4, 4))
    heard[:, 0] = s.links.slot[s.links.sender]
    left = heard.copy()
    heard[:, 3], left[:, 2] = 3.0, 3.0 * law.FADE
    later, now = Evaluated(s, age=50.0, heard=heard).out, Evaluated(s, heard=left).out
    np.testing.assert_allclose(later, now, rtol=1e-9)
    assert abs(Evaluated(s, heard=heard).out[2] - now[2]) > 1e3  # at once, the jerk itself counts


def test_only_the_train_ahead_counts():
    s = scene()
    before = Evaluated(s).out
    s.own[5, :2] += 50.0, 1.0
    np.testing.assert_array_equal(Evaluated(s).out[:5], before[:5])
    heard = np.random.default_rng(1).normal(size=(4, 4))
    frozen = Evaluated(s, heard=heard).out
    s.own[:2, 1] += 1.0
    changed = Evaluated(s, heard=heard).out
    np.testing.assert_array_equal(changed[2:], frozen[2:])
    assert (changed[:2] != frozen[:2]).all()
    heard[[0, 2]] += 1.0  # what followers say
    np.testing.assert_array_equal(Evaluated(s, heard=heard).out, changed)


def test_outside_the_barrier_the_demand_stays_finite():
    for x, v in ((3000.0, 0.0), (-3000.0, 0.0), (0.0, 80.0), (0.0, -80.0)):
        assert np.isfinite(Evaluated(scene(spacing_error=(0.0, x, 0.0), speed_error=(0.0, v, 0.0))).out).all()


def test_joining_rule_is_the_start_condition():
    p = law.Params()
    assert law.admissible(p, -2000.0, 0.8, -2351.0, 1947.0)  # the paper's third train, q = -19.2
    assert not law.admissible(p, -2351.0, 0.0, -2351.0, 1947.0)
    (line,) = law.inadmissible(p, 1900.0, 8.0, -2351.0, 1947.0)
    assert "q = 8 m/s + 0.01/s * 1900 m = 27 m/s is not between -30.53 and 26.49" in line
    assert len(law.inadmissible(p, 3000.0, 50.0, -2351.0, 1947.0)) == 2


def test_a_sound_scene_has_no_violations():
    assert law.violations(law.Params(), scene()) == []


@pytest.mark.parametrize(
    "keys, words",
    [
        ({"head_l2": 2.0}, ["head_l2 = 2: must be above 2"]),
        ({"head_l3": 4.2}, ["head_l3 = 4.2: must be above 2 + head_l2^2 / 2 = 4.205"]),
        (
            {"head_l2": 3.0, "head_l4": 0.5},
            ["head_l3 = 4.3: must be above 2 + head_l2^2 / 2 = 6.5", "head_l4 = 0.5: must be above 1/2"],
        ),
        ({"speed_error_upper_mps": 20.0}, ["head_l1_per_s = 0.01: must be below min(sigma2 / rho1, sigma1 / rho2) = 0.008507"]),
    ],
)
def test_gains_outside_38_are_refused(keys, words):
    found = law.violations(law.Params(**keys), scene(spacing_error=(0.0, 0.0, 0.0), speed_error=(0.0, 0.0, 0.0)))
    for word in words:
        assert any(word in line for line in found), found


@pytest.mark.parametrize("key", ["carriage_l1", "head_l1_per_s", "leader_error_upper_m"])
def test_gains_and_bounds_have_signs(key):
    with pytest.raises(ValidationError, match="greater than 0"):
        law.Params(**{key: 0.0})


def test_violations_of_the_scene():
    assert "start condition (39)" in law.violations(law.Params(), scene(spacing_error=(0.0, 2500.0, 0.0)))[0]
    s = scene()
    links = s.links
    assert "must be finite" in law.violations(law.Params(), s._replace(links=links._replace(upper=np.full(4, INF))))[0]
    assert "needs a slot" in law.violations(law.Params(), s._replace(links=links._replace(slot=np.full(3, np.nan))))[0]
    stepped = table([(0.0, 30.0), (50.0, 30.0), (50.0, 40.0)], 50500.0)
    assert "speed steps by 10 m/s at 50 s" in law.violations(law.Params(), s._replace(reference=stepped))[0]
    none = s.consists._replace(actuator_rate=np.zeros(6))
    with np.errstate(divide="ignore"):
        assert "act through" not in law.violations(law.Params(), s)
        assert "must be above 0" in law.violations(law.Params(), s._replace(consists=none))[0]


def test_step_too_large_for_an_active_limit_is_refused():
    limited = scene().consists._replace(traction=np.full(6, 8e4))
    assert law.violations(law.Params(), scene(consists=limited, sub_step=0.05)) == []
    (line,) = law.violations(law.Params(), scene(consists=limited, sub_step=0.1))
    assert "run.sub_step_s = 0.1" in line and "r h = 50 * 0.1 = 5" in line and "at most 0.05 s" in line
    assert law.violations(law.Params(), scene(sub_step=0.1)) == []
    assert "too large for this start" in law.violations(law.Params(), scene(sub_step=0.5))[0]


@pytest.mark.parametrize(
    ("keys", "rate"), [({"carriage_l3": 1000.0}, "1e+03"), ({"carriage_l1": (0.1, 30.0, 0.1, 0.1, 0.1, 0.1)}, "962")]
)
def test_step_too_large_for_the_gains_of_a_carriage_is_refused(keys, rate):
    """They diverge at once; of the list, only the second carriage is too fast."""
    assert law.violations(law.Params(**keys), scene(sub_step=1e-3)) == []
    (line,) = law.violations(law.Params(**keys), scene(sub_step=0.01))
    assert f"whose loop has {rate} 1/s" in line and "step at most 0.002" in line
