"""Fully distributed law: the printed sums written out train by train, options, and every violation in words and numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl.controllers import fully_distributed as law
from trainctl.plants import point
from trainctl.signals import Bounds, Consists, Floats, Links, Reference, Scene, Trains

DAVIS = np.array([1.176e-2, 7.7616e-4, 1.6e-5])
LEADER = np.array([20000.0, 80.0, 0.0, 0.0])

Edge = tuple[int, int, float, float, float]  # ahead, behind, desired, lower, upper


def links_of(n: int, edges: Sequence[Edge]) -> Links:
    rows = [(b, a, d, lo, hi) for a, b, d, lo, hi in edges] + [(a, b, -d, -hi, -lo) for a, b, d, lo, hi in edges]
    table = np.array(sorted(rows), float).reshape(-1, 5)
    receiver = table[:, 0].astype(np.int64)
    return Links(
        table[:, 1].astype(np.int64), receiver, np.searchsorted(receiver, np.arange(n + 1)), table[:, 2].copy(), table[:, 3].copy(),
        table[:, 4].copy(), np.ones(len(table)), np.ones(len(table), bool), np.full(n, np.nan), np.arange(n),
    )  # fmt: skip


def scene(
    own: Sequence[tuple[float, float]], edges: Sequence[Edge], *, speeds: tuple[float, float] = (75.0, 85.0),
    inputs: tuple[float, float] = (-11.0, 11.0), period: float = 1.0, lead: float = 0.0, time: float = 0.0, length: float = 0.0,
) -> Scene:  # fmt: skip
    n = len(own)
    o, inf = np.zeros(n), np.full(n, np.inf)
    return Scene(
        trains=[str(i + 1) for i in range(n)],
        consists=Consists(np.arange(n + 1), o + length, o + 1e5, o + 1, np.tile(DAVIS, (n, 1)), o, o, inf, inf, inf, inf, o),
        own=np.array(own), links=links_of(n, edges), bounds=Bounds(*(np.full(n, b) for b in (*speeds, *inputs))),
        reference=Reference(np.array([0.0, 2400.0]), np.array([[20000.0, 80.0]])), time=time, step=1.0, control_period=period,
        lead=lead, sub_step=1.0,
    )  # fmt: skip


PAIR: list[Edge] = [(0, 1, 5000.0, 100.0, 10000.0)]
LEGAL = [(24000.0, 85.0), (21000.0, 82.0)]
TRIANGLE: list[Edge] = [*PAIR, (1, 2, 5000.0, 100.0, 10000.0), (0, 2, 10000.0, 5100.0, 15000.0)]


def sense(sc: Scene) -> Trains:
    return Trains(sc.own[:, 0].copy(), sc.own[:, 1].copy(), point.resistance(sc.own[:, 1], sc.consists.davis))


def demand(sc: Scene, params: law.Params | None = None, links: Links | None = None, heard: Floats | None = None) -> law.Demand:
    constants, links = law.constants(params or law.Params(), sc), links or sc.links
    trains = sense(sc)
    if heard is None:
        heard = law.message(constants, trains, LEADER)[links.sender]
    return law.demand(constants, trains, LEADER, links, heard)


def printed(sc: Scene) -> list[float]:
    """Accelerations by (10) and (11) as printed, in the coordinates of the paper, for theta = 0."""
    T, v_r, links, bounds = sc.control_period, LEADER[1], sc.links, sc.bounds
    x, v = sc.own.T
    found = []
    for i in range(len(x)):
        rho, Rho, mu, Mu = (b[i] for b in bounds)
        f, F = (DAVIS @ [1.0, s, s**2] for s in (rho, Rho))
        alpha, Alpha, total, neighbours = -np.inf, np.inf, 0.0, 0
        for k in range(len(links.sender)):
            if links.receiver[k] != i:
                continue
            j = links.sender[k]
            d, gamma, Gamma = -links.desired[k], -links.upper[k], -links.lower[k]  # of x_ij, receiver minus sender
            ybar = (x[i] + v[i] * T) - (x[j] + v[j] * T) - d
            alpha = max(alpha, -(ybar - (gamma - d)) / 2)
            Alpha = min(Alpha, (Gamma - d - ybar) / 2)
            total, neighbours = total + ybar, neighbours + 1
        delta = max(alpha, (rho - v_r) * T, Rho * T + (mu - f) * T**2 - v_r * T)
        Delta = min(Alpha, (Rho - v_r) * T, rho * T + (Mu - F) * T**2 - v_r * T)
        G = -total / (2 * neighbours) if neighbours else 0.0
        s = Delta if Delta <= G else G if delta < G else delta
        found.append(-(v[i] - v_r) / T + s / T**2)
    return found


@pytest.mark.parametrize("inputs", [(-11.0, 11.0), (-5.5, 5.4), (-2.0, 1.0)])  # the last breaks Assumption 2.4: delta > Delta
def test_demand_is_the_printed_sum_train_by_train(inputs: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        n = int(rng.integers(1, 7))
        slot = rng.uniform(0.0, 3e4, n)
        pairs = [(i, j, slot[i] - slot[j]) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.5]
        edges = [(i, j, d, d - 10.0 ** rng.uniform(-1, 3), d + 10.0 ** rng.uniform(-1, 3)) for i, j, d in pairs]
        own = list(zip(slot + rng.normal(size=n) * 10.0 ** rng.uniform(-1, 3), rng.uniform(75.0, 85.0, n), strict=True))
        sc = scene(own, edges, inputs=inputs)
        np.testing.assert_allclose(demand(sc, law.Params(join="strict")).acceleration, printed(sc), atol=1e-9)


def test_message_is_where_the_train_will_be_relative_to_the_leader() -> None:
    sc = scene(LEGAL, PAIR, lead=0.25, period=2.0)
    np.testing.assert_allclose(law.message(law.constants(law.Params(), sc), sense(sc), LEADER), [[4127.5], [1123.0]])


def test_train_without_links_takes_up_the_reference_speed_within_one_period() -> None:
    sc = scene([(0.0, 85.0), (24000.0, 85.0), (21000.0, 82.0), (9000.0, 76.0)], [(1, 2, 5000.0, 100.0, 10000.0)])
    d = demand(sc)
    assert d.acceleration[[0, 3]].tolist() == [-5.0, 4.0]
    assert d.acceleration[1] != -5.0
    assert not d.saturated[[0, 3]].any()
    alone = scene([(0.0, 85.0)], [])
    assert demand(alone).acceleration.tolist() == [-5.0]
    assert law.violations(law.Params(), alone) == []


def test_train_that_misses_any_message_holds_the_reference_speed() -> None:
    sc = scene([*LEGAL, (13000.0, 81.0)], TRIANGLE)
    everything = demand(sc)
    row = int(np.flatnonzero((sc.links.receiver == 1) & (sc.links.sender == 2))[0])
    links = sc.links._replace(heard=np.arange(len(sc.links.sender)) != row)
    heard = law.message(law.constants(law.Params(), sc), sense(sc), LEADER)[links.sender]
    for stale in (np.nan, 1e9):
        heard[row] = stale
        some = demand(sc, links=links, heard=heard)
        assert some.acceleration[1] == -2.0  # v_2 = 82 back to 80
        assert not some.saturated[1]
        assert some.acceleration[[0, 2]].tolist() == everything.acceleration[[0, 2]].tolist()


def test_saturated_says_whether_a_bound_acted() -> None:
    at_slots = scene([(24000.0, 80.0), (19001.0, 80.0)], PAIR)
    assert demand(at_slots).saturated.tolist() == [False, False]
    assert demand(at_slots).acceleration.tolist() == [0.5, -0.5]  # each takes half of the error of 1 m
    assert demand(scene(LEGAL, PAIR)).saturated.tolist() == [True, True]  # 1997 m of error: the speed band acts


def test_ratchet_keeps_standing_still_admissible_where_the_printed_law_turns_round() -> None:
    # train 2 is 50 m too far behind train 1, though both its links together want it to fall back
    edges: list[Edge] = [(0, 1, 990.0, 100.0, 1000.0), (1, 2, 1000.0, 100.0, 3000.0)]
    torn = scene([(24000.0, 80.0), (22950.0, 80.0), (20950.0, 80.0)], edges)
    ratchet, strict = (demand(torn, law.Params(join=j)).acceleration for j in ("ratchet", "strict"))
    assert ratchet[1] == 0.0
    assert strict[1] == 25.0, "half of the 50 m at once, as if there were no speed bound of 85"
    legal = scene(LEGAL, PAIR)
    np.testing.assert_array_equal(demand(legal).acceleration, demand(legal, law.Params(join="strict")).acceleration)


def test_own_speed_room_is_never_smaller_than_the_printed_one() -> None:
    sc = scene([(24000.0, 78.0), (21000.0, 82.0)], PAIR, inputs=(-5.5, 5.4))
    printed_, own = (demand(sc, law.Params(eta=e)).acceleration for e in ("printed", "own_speed"))
    f = point.resistance(sc.own[:, 1], sc.consists.davis)
    assert own[0] > printed_[0]  # train 1 is too close ahead: forward, s = +5 instead of what is left at 75 m/s
    assert own[1] < printed_[1]
    assert np.all(own + f <= 5.4 + 1e-12)
    assert np.all(own + f >= -5.5 - 1e-12)
    assert law.violations(law.Params(), sc) == []


def test_reference_speed_now_is_what_counts() -> None:
    sc = scene(LEGAL, [])
    constants = law.constants(law.Params(), sc)
    leader = np.array([20000.0, 78.0, 0.0, 0.0])
    d = law.demand(constants, sense(sc), leader, sc.links, np.zeros((0, 1)))
    np.testing.assert_allclose(sc.own[:, 1] + d.acceleration, 78.0)


def test_paper_start_violates_nothing() -> None:
    assert law.violations(law.Params(), scene([*LEGAL, (13000.0, 81.0)], TRIANGLE)) == []


def said(sc: Scene, **params: str) -> str:
    return "\n".join(law.violations(law.Params.model_validate(params), sc))


@pytest.mark.parametrize(
    ("sc", "line"),
    [
        (scene([(24000.0, 85.0), (21000.0, 91.0)], PAIR), "train[2].speed_mps = 91: above speed_upper_mps = 85"),
        (scene([(24000.0, 70.0), (21000.0, 82.0)], PAIR), "train[1].speed_mps = 70: below speed_lower_mps = 75"),
        (scene(LEGAL, PAIR, speeds=(80.0, 85.0)),
         "bounds.speed_lower_mps = 80: must be below the reference speed 80 m/s (Assumption 2.3)"),
        (scene(LEGAL, PAIR, speeds=(75.0, np.inf)), "bounds.speed_upper_mps = inf: needs a finite bound (Assumption 2.3)"),
        (scene(LEGAL, PAIR, inputs=(0.2, 11.0)), "bounds.input_lower_mps2 = 0.2: must be below the minimum running resistance, "
         "0.159972 m/s2 at 75 m/s (Assumption 2.4)"),
        (scene(LEGAL, PAIR, inputs=(-11.0, 0.1)), "bounds.input_upper_mps2 = 0.1: must be above the maximum running resistance, "
         "0.193334 m/s2 at 85 m/s (Assumption 2.4)"),
        (scene(LEGAL, PAIR, inputs=(-0.7, 11.0)),
         "bounds.input_lower_mps2 = -0.7: must be below -4.84003 to brake from 85 to 80 m/s "
         "within one control period of 1 s, or run.control_period_s above 5.81414 (Assumption 2.4)"),
        (scene(LEGAL, PAIR, inputs=(-11.0, 0.7)),
         "bounds.input_upper_mps2 = 0.7: must be above 5.19333 to speed up from 75 to 80 m/s "
         "within one control period of 1 s, or run.control_period_s above 9.86843 (Assumption 2.4)"),
        (scene(LEGAL, [(0, 1, 5000.0, 100.0, 1000.0)]),
         "link[1,2].upper_m = 1000: must be above desired_m = 5000 (Assumption 2.2)"),
        (scene(LEGAL, [(0, 1, 5000.0, 5000.0, 1e4)]), "link[1,2].lower_m = 5000: must be below desired_m = 5000 (Assumption 2.2)"),
        (scene([*LEGAL, (13000.0, 81.0)], [*TRIANGLE[:2], (0, 2, 11000.0, 5100.0, 15000.0)]),
         "desired distances around the cycle 3-2-1-3 sum to -1000 m, must be 0 (Assumption 2.2)"),
        (scene(LEGAL, PAIR, length=320.0), "link[1,2].lower_m = 100: spacing is front to front, and train 1 is 320 m"),
        (scene([(91.0, 85.0), (0.0, 75.0)], PAIR), "link[1,2].lower_m = 100: spacing at the start is 91 m, too small"),
        (scene([(105.0, 75.0), (0.0, 85.0)], PAIR),
         "link[1,2].lower_m = 100: spacing one period ahead, eq. (13), is 95 m, too small"),
        (scene([(10050.0, 85.0), (0.0, 75.0)], PAIR), "link[1,2].upper_m = 10000: spacing at the start is 10050 m, too large"),
    ],
)  # fmt: skip
def test_violation_is_named_in_words_and_numbers(sc: Scene, line: str) -> None:
    assert line in said(sc)


def test_reading_6_start_is_refused_though_13_holds() -> None:
    """x_12(0) = 91 below gamma = 100, x_12(1) = 101 above it: (13) is content, O1 is broken at k = 0."""
    assert said(scene([(91.0, 85.0), (0.0, 75.0)], PAIR)) == "link[1,2].lower_m = 100: spacing at the start is 91 m, too small"


def test_all_violations_come_at_once_and_trains_alike_share_a_line() -> None:
    sc = scene([(91.0, 91.0), (0.0, 70.0)], PAIR, inputs=(-0.7, 0.7))
    assert len(law.violations(law.Params(), sc)) == 5
    own = sc._replace(bounds=sc.bounds._replace(input_lower=np.array([-0.7, -11.0])))
    assert "train[1].input_lower_mps2 = -0.7" in said(own)
    assert "train[2].input_lower_mps2" not in said(own)


def test_the_period_named_would_do() -> None:
    short = scene(LEGAL, PAIR, inputs=(-0.7, 0.7))
    assert "control_period_s above 9.86843" in said(short)
    assert said(short._replace(control_period=9.8685)) == ""
    assert said(short._replace(control_period=9.8684)) != ""


def test_every_cycle_counts_not_triangles_alone() -> None:
    """A chordless cycle of four: no triangle, yet no d_i exist."""
    four: list[Edge] = [
        (0, 1, 5000.0, 1.0, 1e4), (1, 2, 5000.0, 1.0, 1e4), (2, 3, 5000.0, 1.0, 1e4), (0, 3, 16000.0, 1.0, 2e4),
    ]  # fmt: skip
    own = [(15000.0, 80.0), (10000.0, 80.0), (5000.0, 80.0), (0.0, 80.0)]
    (only,) = law.violations(law.Params(), scene(own, four))
    assert "sum to" in only
    assert "1000 m" in only
    assert law.violations(law.Params(), scene(own, [*four[:3], (0, 3, 15000.0, 1.0, 2e4)])) == []


def test_links_must_go_both_ways_alike_and_have_no_weights() -> None:
    sc = scene(LEGAL, PAIR)
    one_way = sc.links._replace(
        first=np.array([0, 0, 1]), **{k: getattr(sc.links, k)[1:] for k in ("sender", "receiver", "desired", "lower", "upper")},
        weight=np.ones(1), heard=np.ones(1, bool),
    )  # fmt: skip
    assert said(sc._replace(links=one_way)) == "link[1,2]: train 1 must receive from train 2 too, this law needs links both ways"
    odd = sc.links._replace(upper=sc.links.upper + np.array([0.0, 1.0]))
    assert "the same both ways" in said(sc._replace(links=odd))
    assert "weight = 0.5" in said(sc._replace(links=sc.links._replace(weight=np.full(2, 0.5))))


def test_later_starts_outside_the_bounds_are_joins_which_only_the_ratchet_admits() -> None:
    late = scene([(91.0, 85.0), (0.0, 75.0)], PAIR, time=1000.0)
    assert said(late) == ""
    assert "91 m, too small" in said(late, join="strict")
    assert "above speed_upper_mps" in said(scene([(24000.0, 86.0), (21000.0, 82.0)], PAIR, time=1000.0))


def test_a_reference_that_will_leave_the_band_is_seen_at_the_start() -> None:
    slowing = Reference(np.array([0.0, 100.0, 200.0]), np.array([[20000.0, 80.0, 0.0], [28000.0, 80.0, -0.05]]))
    sc = scene(LEGAL, PAIR)._replace(reference=slowing)
    assert "bounds.speed_lower_mps = 75: must be below the reference speed 70 m/s (Assumption 2.3)" in said(sc)


@pytest.mark.parametrize("keys", [{"eta": "own"}, {"join": "Ratchet"}, {"gain": 1.0}])
def test_keys_are_checked(keys: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        law.Params.model_validate(keys)


@pytest.mark.parametrize("known", ["position", "speed", "resistance"])
def test_what_is_no_number_does_not_pass_for_one(known: str) -> None:
    """A train that does not know its resistance must not go on as if its input had no bounds: who checks the demand stops the run."""
    sc = scene(LEGAL, PAIR)
    trains, constants = sense(sc), law.constants(law.Params(eta="own_speed"), sc)
    getattr(trains, known)[1] = np.nan
    heard = law.message(constants, trains, LEADER)[sc.links.sender]
    assert np.isnan(law.demand(constants, trains, LEADER, sc.links, heard).acceleration[1])
