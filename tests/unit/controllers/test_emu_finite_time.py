from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scenes import coupled_trains

from trainctl.controllers import emu_finite_time as law
from trainctl.controllers.emu_finite_time import Params, coupler_weight, train_weight
from trainctl.signals import Floats, Reference, Scene

COUPLER = (0.1, 0.1, 0.05, 0.03)  # h1, h2, delta1, delta2
TRAINS = (3000.0, 1500.0, 10000.0, 1000.0, 600.0)  # ls, le, beta, gamma1, gamma2


def scene(positions: tuple[float, ...] = (10e3, 6680.0, 3360.0), units: int = 4, **consist: Any) -> Scene:
    """Trains of four units in formation behind a leader at 10 km and 80 m/s; ``consist`` replaces fields of ``Consists``."""
    return coupled_trains(positions, units, Reference(np.array([0.0, 1e4]), np.array([[10e3, 80.0]])), **consist)


def accelerations(s: Scene, params: Params | None = None) -> Floats:
    """u_hat - R of all units: what the law asks for beyond the running resistance."""
    params = params or Params()
    constants, leader = law.constants(params, s), np.array([10e3, 80.0, 0.0, 0.0])
    first, table = s.consists.first, np.zeros((0, 0))
    sent, out = np.empty((len(s.trains), law.MESSAGE)), np.empty(len(s.own))
    for i in range(len(s.trains)):
        law.message(i, constants, leader, s.links.slot[i], s.own[first[i] : first[i + 1]], table, table, sent[i])
    for i in range(len(s.trains)):
        rows, links = slice(first[i], first[i + 1]), slice(s.links.first[i], s.links.first[i + 1])
        heard = np.ascontiguousarray(sent[s.links.sender[links]])
        law.demand(i, constants, leader, 0.0, s.links.slot[i], s.own[rows], table, table, s.links.desired[links], heard, out[rows])
    v = s.own[:, 1]
    return out / s.consists.mass - (0.01176 + 7.7616e-4 * v + 1.6e-5 * v**2)


@pytest.mark.parametrize(
    ("e", "w"),
    [
        (0.0, 1.0), (0.05, 1.0), (-0.07, 1.0), (-0.05, 1.0),
        (0.06, 0.0075 / 0.0064), (0.09, 0.0075 / 0.0019), (-0.08, 0.0009 / 0.0004), (-0.09, 9.0),
        (0.099, 37.688), (0.1, 37.688), (5.0, 37.688), (-0.099, 900.0), (-0.1, 900.0), (-5.0, 900.0),
    ],
)  # fmt: skip
def test_coupler_weight_is_a_barrier_capped_1_mm_inside(e: float, w: float) -> None:
    assert coupler_weight(e, *COUPLER) == pytest.approx(w, rel=1e-4)


@pytest.mark.parametrize(
    ("z", "b"),
    [
        (0.0, 1.0), (6000.0, 1.0), (6500.0, 0.5), (7000.0, 0.0), (9000.0, 0.0),
        (-900.0, 1.0), (-1200.0, 1.44e6 / 0.81e6), (-1499.0, 1.44e6 / 2999.0), (-1500.0, 1.44e6 / 2999.0),
        (-4000.0, 1.44e6 / 2999.0),
    ],
)  # fmt: skip
def test_train_weight_fades_with_range_and_guards_the_emergency_distance(z: float, b: float) -> None:
    assert train_weight(z, *TRAINS) == pytest.approx(b, rel=1e-9)


@pytest.mark.parametrize("edge", [0.05, -0.07])
def test_coupler_weight_is_continuous(edge: float) -> None:
    assert coupler_weight(edge + 1e-9, *COUPLER) == pytest.approx(coupler_weight(edge - 1e-9, *COUPLER), abs=1e-6)


@pytest.mark.parametrize("edge", [-900.0, 6000.0, 7000.0])
def test_train_weight_is_continuous(edge: float) -> None:
    assert train_weight(edge + 1e-6, *TRAINS) == pytest.approx(train_weight(edge - 1e-6, *TRAINS), abs=1e-6)


def test_formation_asks_for_the_running_resistance_only() -> None:
    assert np.abs(accelerations(scene())).max() < 1e-12


def test_a_stretched_coupler_pulls_both_units_alike() -> None:
    s = scene()
    s.own[2:4, 0] -= 0.02  # coupler behind unit 2 of train 1
    weight = 1.0 - 2.0 / 20.0
    expected = np.zeros(12)
    expected[1], expected[2] = -20.0 * weight * 0.02**0.9, 20.0 * weight * 0.02**0.9
    found = accelerations(s)
    # the tail is 2 cm back, too, and the head behind sees that
    assert found[[0, 1, 2, 3]] == pytest.approx(expected[:4] + [0, 0, 0, 1e-4 * 0.02**0.9], abs=1e-9)
    assert found[4] == pytest.approx(-1e-4 * 0.02**0.9, abs=1e-9)
    assert np.abs(found[5:]).max() < 1e-12


def test_heads_answer_to_the_leader_and_ends_to_the_next_train() -> None:
    s = scene()
    s.own[4:8, 0] += 30.0
    s.own[4:8, 1] += 2.0
    a2 = 1.8 / 1.9
    found = accelerations(s)
    between = 1e-4 * 30.0**0.9 + 2.0**a2
    assert found[3] == pytest.approx(between)  # tail of train 1
    assert found[4] == pytest.approx(-0.05 * 30.0**0.9 - 0.1 * 2.0**a2 - between)  # head of train 2: leader, train ahead
    assert found[7] == pytest.approx(-between)  # its tail: train behind
    assert found[8] == pytest.approx(between)
    assert np.abs(found[[0, 1, 2, 5, 6, 9, 10, 11]]).max() < 1e-12


def test_alpha_1_makes_it_linear() -> None:
    s = scene()
    s.own[4:8, 0] += 30.0
    s.own[4:8, 1] += 2.0
    found = accelerations(s, Params(alpha_1=1.0))
    assert found[4] == pytest.approx(-0.05 * 30.0 - 0.1 * 2.0 - 1e-4 * 30.0 - 2.0)


def test_a_train_alone_is_pinned_only() -> None:
    s = scene((9970.0,))
    assert accelerations(s)[0] == pytest.approx(0.05 * 30.0**0.9)


def test_out_of_range_trains_do_not_act_on_each_other() -> None:
    s = scene((10e3, 10e3 - 320.0 - 10001.0))
    s.own[4:, 1] += 2.0
    assert np.abs(accelerations(s)[3]) < 1e-12


def test_a_longer_link_has_a_longer_wanted_interval() -> None:
    """Where a train left and its slot is kept: interval 6320 m, emergency distance and range as before."""
    s = scene((10e3, 3360.0))
    links = s.links._replace(desired=2.0 * s.links.desired, slot=2.0 * s.links.slot)
    assert np.abs(accelerations(s._replace(links=links))).max() < 1e-12
    near = scene((10e3, 10e3 - 320.0 - 1600.0))  # 100 m above the emergency distance: zeta = 4820, z = -4720
    weight = (2 * 4820.0 - 600.0) * 600.0 / (4820.0**2 - 4720.0**2)
    assert accelerations(near._replace(links=links))[3] == pytest.approx(weight * 1e-4 * 4720.0**0.9)


def test_rotating_mass_leaves_the_closed_loop_as_it_is() -> None:
    """Inertia takes the place of mass, so m u_hat / inertia - m R / inertia is what it was; k_hat is stiffness over inertia."""
    light, heavy = scene(), scene(rotating=np.full(12, 1.25), stiffness=1.25 * scene().consists.stiffness)
    for s in (light, heavy):
        s.own[2:4, 0] -= 0.02
        s.own[4:8, 1] += 2.0
    assert accelerations(heavy) / 1.25 == pytest.approx(accelerations(light), abs=1e-12)


def test_message_is_relative_to_the_leader() -> None:
    s, table = scene(), np.zeros((0, 0))
    s.own[7] += [0.03, 0.5]
    out = np.empty(law.MESSAGE)
    law.message(1, law.constants(Params(), s), np.array([10e3, 79.0, 0.0, 0.0]), -3320.0, s.own[4:8], table, table, out)
    assert out == pytest.approx([-3320.0, 1.0, -3319.97, 1.5, 320.0])


def test_watched_interval_is_the_clear_distance_to_the_nearest_train_ahead() -> None:
    s = scene()
    constants, out = law.constants(Params(), s), np.empty(1)
    for i, expected in enumerate((np.nan, 3000.0, 3000.0)):
        law.watch(i, constants, np.zeros(4), s.consists.first, s.own, s.links, out)
        assert out[0] == pytest.approx(expected, nan_ok=True)
    desired = np.array([-3320.0, 3320.0, -3320.0, 6640.0])
    both = s.links._replace(sender=np.array([1, 0, 2, 0]), receiver=np.array([0, 1, 1, 2]), desired=desired)
    law.watch(2, constants, np.zeros(4), s.consists.first, s.own, both, out)
    assert out[0] == 6320.0


def test_nothing_is_wrong_with_the_formation() -> None:
    assert law.violations(Params(), scene()) == []


def only(found: list[str]) -> str:
    """The single violation."""
    assert len(found) == 1, found
    return found[0]


def test_coupler_out_of_range_is_told() -> None:
    s = scene()
    s.own[2:4, 0] -= 0.1
    s.own[5:8, 0] += 0.11
    first, second = law.violations(Params(), s)[:2]
    assert first == "train 1: coupler 2 = 0.1 m: must start inside (-0.1, 0.1) m (Theorem 1)"
    assert second == "train 2: coupler 1 = -0.11 m: must start inside (-0.1, 0.1) m (Theorem 1)"


def test_trains_too_near_are_told_once() -> None:
    near = scene((10e3, 10e3 - 320.0 - 1500.0, 3360.0))._replace(sub_step=1e-3)
    found = only(law.violations(Params(), near))
    assert found == "trains 1 and 2: interval = 1500.0 m: must start above emergency_distance_m = 1500 (Theorem 1)"


def test_soft_gain_is_told() -> None:
    found = law.violations(Params(p_1=2.0), scene((10e3,)))
    assert found[0] == "controller.p_1 = 2: must exceed coupler stiffness over mass, 2 1/s2 in train 1, or units repel each other"


def test_unequal_units_are_told() -> None:
    mass = np.array([8e4, 8e4, 8e4, 9e4] + 8 * [8e4])
    assert "train 1: unit_mass_kg times rotating_mass_factor = 80000 to 90000" in law.violations(Params(), scene(mass=mass))[0]
    trains = np.repeat([8e4, 9e4, 1e5], 4)
    assert law.violations(Params(), scene(mass=trains)) == []  # only units of one train need be alike


def test_missing_slots_and_one_way_links_are_told() -> None:
    s = scene()
    slot = s.links.slot.copy()
    slot[1] = np.nan
    assert 'train 2 has no slot: the law needs one for every train; use desired = "slots"' in only(
        law.violations(Params(), s._replace(links=s.links._replace(slot=slot)))
    )
    one_way = s.links._replace(
        sender=np.array([0, 1]), receiver=np.array([1, 2]), first=np.array([0, 0, 1, 2]), desired=np.array([3320.0, 3320.0])
    )
    assert law.violations(Params(), s._replace(links=one_way)) == [
        "link 1 to 2: train 1 must receive from train 2, too (the graph is undirected)",
        "link 2 to 3: train 2 must receive from train 3, too (the graph is undirected)",
    ]


def test_links_that_contradict_the_slots_are_told() -> None:
    s = scene((10e3, 6680.0))
    links = s.links._replace(desired=s.links.desired + np.array([-50.0, 50.0]))
    found = only(law.violations(Params(), s._replace(links=links)))
    assert found == "trains 1 and 2: desired_m = 3370: differs by 50 m from what their slots say"
    nobody_ahead = s.links._replace(desired=np.zeros(2))
    assert "one of the two must be ahead" in law.violations(Params(), s._replace(links=nobody_ahead))[0]


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"stretch_zone_m": 0.1}, "controller.stretch_zone_m = 0.1: must be below coupler_stretch_m = 0.1"),
        ({"compression_zone_m": 0.2}, "controller.compression_zone_m = 0.2: must be below coupler_compression_m = 0.1"),
        (
            {"emergency_zone_m": 1500.0},
            "trains 1 and 2: desired interval = 3000 m: must exceed emergency_distance_m + emergency_zone_m = 3000",
        ),
        ({"range_m": 4000.0}, "trains 1 and 2: desired interval = 3000 m: must be below range_m - range_zone_m = 3000"),
    ],
)
def test_zones_that_do_not_fit_are_told(keys: dict[str, float], words: str) -> None:
    assert only(law.violations(Params(**keys), scene((10e3, 6680.0)))) == words


@pytest.mark.parametrize(
    "keys", [{"alpha_1": 0.0}, {"alpha_1": 1.1}, {"p_3": 0.0}, {"mu_1": -1.0}, {"p_5": 1.0}, {"p_1": float("nan")}]
)
def test_keys_out_of_their_range_are_refused(keys: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        Params(**keys)


def test_settled_start_bears_long_steps_and_says_which() -> None:
    """RK4 was measured clean to 50 ms from a settled start, chattering at 80 ms."""
    largest = law.largest_sub_step(Params(), scene())
    assert largest == pytest.approx(0.0539, abs=1e-4)
    assert law.violations(Params(), scene()._replace(sub_step=0.05)) == []
    assert only(law.violations(Params(), scene()._replace(sub_step=0.08))).startswith("run.sub_step_s = 0.08: at most 0.0539 s")


def test_single_units_bear_any_step() -> None:
    assert law.largest_sub_step(Params(), scene((10e3,), units=1)) == np.inf


def test_an_eager_start_bears_short_steps_only_unless_forces_are_limited() -> None:
    far = (10e3 - 680.0,)
    free, limited = scene(far), scene(far, traction=np.full(4, 4e4), braking=np.full(4, 6e4))
    assert law.largest_sub_step(Params(), free) < 0.015
    assert law.largest_sub_step(Params(), limited) == pytest.approx(0.02)


def test_rehearsal_ends_with_the_weights_the_couplers_reached() -> None:
    """One unit pulled by its leader stretches the coupler behind it most; nothing moves in formation."""
    calm, eager = scene((10e3,)), scene((10e3 - 680.0,))
    for s, reached in ((calm, False), (eager, True)):
        n, endless = len(s.own), np.full((len(s.own), 4), np.inf)
        w = law.rehearse(
            law.constants(Params(), s), endless, np.array([10e3, 80.0, 0.0, 0.0]), s.links.slot, s.links.sender, s.links.first,
            s.links.desired, s.own, 2e-3, 2000,
        )  # fmt: skip
        assert len(w) == n
        assert (w[0] > 3.0) == reached
        assert w[0] >= w[1] >= w[2] >= w[3] == 1.0


MASSES = np.tile([9e4, 6e4, 8e4, 5e4], 3)


def test_units_of_unequal_mass_are_refused_without_the_repair() -> None:
    s = scene(mass=MASSES)
    (first, *_) = law.violations(Params(), s)
    assert "must be equally heavy" in first and "weighted_by_mass = true" in first
    assert law.violations(Params(weighted_by_mass=True), s) == []


def test_a_coupler_pulls_units_of_unequal_mass_with_one_force() -> None:
    """The relative acceleration is that of equal units; no force is left over inside a train."""
    equal, unequal = scene(), scene(mass=MASSES)
    for s in (equal, unequal):
        s.own[2:4, 0] -= 0.02  # the coupler behind unit 2 of train 1
        s.own[8:, 1] += 0.0
    forces = accelerations(unequal, Params(weighted_by_mass=True)) * MASSES
    assert abs(forces[1] + forces[2]) < 1e-6 * abs(forces[1])
    k = unequal.consists.stiffness[1]
    pair = 2.0 / (1.0 / MASSES[1] + 1.0 / MASSES[2])
    weight = 1.0 - k / pair / 20.0
    assert forces[2] == pytest.approx(pair * weight * 20.0 * 0.02**0.9, rel=1e-9)
    total = forces[2] + k * 0.02  # with the spring, which the term in k / p1 makes up for where alpha_1 = 1
    assert total * (1.0 / MASSES[1] + 1.0 / MASSES[2]) == pytest.approx(
        2.0 * (weight * 20.0 * 0.02**0.9 + k / pair * 0.02), rel=1e-9
    )


def test_heads_and_tails_pull_trains_of_equal_mass_alike() -> None:
    """What two trains do to each other is one force where their mean masses are equal, whatever head and tail weigh."""
    s = scene(positions=(10e3, 6600.0), mass=MASSES[:8])
    s.own[4:, 1] += 1.0
    slots, leader = accelerations(s, Params(weighted_by_mass=True, mu_1=1e-12, mu_2=1e-12)) * MASSES[:8], 7e4
    assert slots[3] == pytest.approx(-slots[4], rel=1e-6) and abs(slots[3]) > 0.01 * leader
