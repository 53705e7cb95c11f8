"""Every law that is evaluated once per control period keeps the same contract, whoever wrote it.

A module in ``trainctl.controllers`` with ``CLOCK = "sampled"`` is found by itself; one that has required keys or weights its links
adds them to ``EXAMPLES``.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

import numpy as np
import pytest

from trainctl import controllers
from trainctl.plants import point
from trainctl.signals import Bounds, Consists, Demand, Floats, Links, Reference, Scene, Trains

#: Keys of [controller] and the weight of all links, where they are not none and 1.
EXAMPLES: dict[str, tuple[dict[str, Any], float]] = {"robust_constrained": ({"h_per_s": 0.3}, 0.01)}

SLOT = np.array([0.0, -5000.0, -10000.0, -15000.0, -20000.0, -25000.0])
EDGES = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 2)]  # train 5 hears nobody
LEADER = np.array([30000.0, 80.0, 0.0, 0.0])
DAVIS = (1.176e-2, 7.7616e-4, 1.6e-5)
N = len(SLOT)


def sampled() -> list[str]:
    names = [m.name for m in pkgutil.iter_modules(controllers.__path__)]
    modules = {name: importlib.import_module(f"{controllers.__name__}.{name}") for name in names}
    return [name for name, module in modules.items() if getattr(module, "CLOCK", None) == "sampled"]


@pytest.fixture(params=sampled())
def law(request: pytest.FixtureRequest) -> Any:
    return importlib.import_module(f"{controllers.__name__}.{request.param}")


def example(law: Any) -> tuple[dict[str, Any], float]:
    return EXAMPLES.get(law.__name__.rsplit(".", 1)[1], ({}, 1.0))


def params(law: Any) -> Any:
    return law.Params.model_validate(example(law)[0])


def links(law: Any) -> Links:
    rows = np.array(sorted([(b, a) for a, b in EDGES] + EDGES))
    receiver, sender = rows[:, 0].copy(), rows[:, 1].copy()
    desired = SLOT[sender] - SLOT[receiver]
    ahead = desired > 0
    lower, upper = np.where(ahead, 100.0, desired * 2.0), np.where(ahead, desired * 2.0, -100.0)
    return Links(
        sender, receiver, np.searchsorted(receiver, np.arange(N + 1)), desired, lower, upper,
        np.full(len(rows), example(law)[1]), np.ones(len(rows), bool), SLOT, np.arange(N),
    )  # fmt: skip


def scene(law: Any, own: Floats) -> Scene:
    o, inf = np.zeros(N), np.full(N, np.inf)
    return Scene(
        trains=[str(i + 1) for i in range(N)],
        consists=Consists(np.arange(N + 1), o, o + 1, o + 1, np.tile(DAVIS, (N, 1)), o, o, inf, inf, inf, inf, o),
        own=own, links=links(law), bounds=Bounds(*(np.full(N, b) for b in (70.0, 90.0, -11.0, 11.0))),
        reference=Reference(np.array([0.0, 1e4]), np.array([[LEADER[0], LEADER[1]]])), time=0.0, step=1.0, control_period=1.0,
        lead=0.0, sub_step=1.0,
    )  # fmt: skip


def trains(own: Floats) -> Trains:
    return Trains(own[:, 0].copy(), own[:, 1].copy(), point.resistance(own[:, 1], np.tile(DAVIS, (len(own), 1))))


def at_rest() -> Floats:
    return np.column_stack((LEADER[0] + SLOT, np.full(N, LEADER[1])))


def disturbed(seed: int = 0) -> Floats:
    rng = np.random.default_rng(seed)
    return at_rest() + np.column_stack((rng.normal(0.0, 3.0, N), rng.uniform(-1.0, 1.0, N)))


def heard(law: Any, constants: Any, own: Floats, hearing: Links) -> Floats:
    return np.ascontiguousarray(law.message(constants, trains(own), LEADER)[hearing.sender])


def leader(k: int) -> Floats:
    return np.array([LEADER[0] + LEADER[1] * k, LEADER[1], 0.0, 0.0])


def run(law: Any, own: Floats, periods: int) -> Floats:
    """State of the point plant, shape (n, 2), after so many periods of 1 s."""
    sc = scene(law, own)
    constants, plant = law.constants(params(law), sc), point.constants(point.Params(), sc.consists)
    for k in range(periods):
        sent = law.message(constants, trains(own), leader(k))[sc.links.sender]
        asked = law.demand(constants, trains(own), leader(k), sc.links, sent)
        own = point.advance(plant, own, asked.acceleration, 1.0, point.Kick.none(N)).own
    return own


def demand(law: Any, own: Floats, sent: Floats | None = None) -> Demand:
    hearing = links(law)
    constants = law.constants(params(law), scene(law, own))
    return law.demand(constants, trains(own), LEADER, hearing, heard(law, constants, own, hearing) if sent is None else sent)


def test_there_are_sampled_laws() -> None:
    assert {"fully_distributed", "robust_constrained"} <= set(sampled())


def test_violations_are_lines_of_text(law: Any) -> None:
    found = law.violations(params(law), scene(law, disturbed()))
    assert isinstance(found, list)
    assert all(isinstance(line, str) and line and "\n" not in line for line in found)


def test_shapes_and_types(law: Any) -> None:
    own = disturbed()
    sent = law.message(law.constants(params(law), scene(law, own)), trains(own), LEADER)
    assert sent.ndim == 2
    assert len(sent) == N
    assert sent.dtype == np.float64
    found = demand(law, own)
    assert found.acceleration.shape == found.saturated.shape == (N,)
    assert found.acceleration.dtype == np.float64
    assert found.saturated.dtype == np.bool_


def test_finite_even_far_out_and_on_stale_messages(law: Any) -> None:
    own = disturbed() + np.column_stack((np.linspace(-1e5, 1e5, N), np.zeros(N)))
    assert np.isfinite(demand(law, own).acceleration).all()
    hearing = links(law)
    constants = law.constants(params(law), scene(law, own))
    sent = heard(law, constants, own, hearing)
    for missing in range(len(hearing.sender)):
        some = hearing._replace(heard=np.arange(len(hearing.sender)) != missing)
        assert np.isfinite(law.demand(constants, trains(own), LEADER, some, sent).acceleration).all()


def test_repeatable_and_inputs_untouched(law: Any) -> None:
    own, hearing = disturbed(), links(law)
    constants = law.constants(params(law), scene(law, own))
    sent = heard(law, constants, own, hearing)
    arguments = (trains(own), LEADER, hearing, sent)
    copies = tuple(type(a)(*(x.copy() for x in a)) if isinstance(a, tuple) else a.copy() for a in arguments)
    first = law.demand(constants, *arguments)
    second = law.demand(constants, *arguments)
    for one, two in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, two)
    for now, then in zip(arguments, copies, strict=True):
        for a, b in zip(now, then, strict=True) if isinstance(now, tuple) else [(now, then)]:
            np.testing.assert_array_equal(a, b)


def test_local_a_strangers_state_leaves_the_demand_bit_identical(law: Any) -> None:
    """With the messages frozen no other train's state matters at all; with live ones only the neighbours' does."""
    own, hearing = disturbed(), links(law)
    constants = law.constants(params(law), scene(law, own))
    sent = heard(law, constants, own, hearing)
    before = demand(law, own)
    for other in range(N):
        moved = own.copy()
        moved[other] += (-777.0, 3.3)
        frozen = law.demand(constants, trains(moved), LEADER, hearing, sent)
        live = law.demand(constants, trains(moved), LEADER, hearing, heard(law, constants, moved, hearing))
        strangers = np.arange(N) != other
        neighbours = np.isin(np.arange(N), hearing.receiver[hearing.sender == other])
        for after, same in ((frozen, strangers), (live, strangers & ~neighbours)):
            np.testing.assert_array_equal(after.acceleration[same], before.acceleration[same])
            np.testing.assert_array_equal(after.saturated[same], before.saturated[same])
        assert frozen.acceleration[other] != before.acceleration[other]
        assert not np.array_equal(live.acceleration[neighbours], before.acceleration[neighbours]) or not neighbours.any()


def test_numbering_of_the_trains_does_not_matter(law: Any) -> None:
    """A train's demand depends on what it hears, not on its row."""
    own, hearing = disturbed(), links(law)
    expected = demand(law, own).acceleration
    back = np.arange(N)[::-1]
    receiver, sender = back[hearing.receiver], back[hearing.sender]
    k = np.lexsort((sender, receiver))
    turned = hearing._replace(
        sender=sender[k], receiver=receiver[k], first=np.searchsorted(receiver[k], np.arange(N + 1)), desired=hearing.desired[k],
        lower=hearing.lower[k], upper=hearing.upper[k], slot=SLOT[::-1].copy(), order=back.copy(),
    )  # fmt: skip
    mirrored = np.ascontiguousarray(own[::-1])
    sc = scene(law, mirrored)._replace(links=turned)
    constants = law.constants(params(law), sc)
    found = law.demand(constants, trains(mirrored), LEADER, turned, heard(law, constants, mirrored, turned))
    np.testing.assert_allclose(found.acceleration[::-1], expected, atol=1e-12)


def test_equilibrium_is_held(law: Any) -> None:
    """At its slot and at the reference's speed a train is asked for nothing, and the point plant then stays there."""
    still = demand(law, at_rest())
    np.testing.assert_allclose(still.acceleration, 0.0, atol=1e-9)
    assert not still.saturated.any()
    travelled = run(law, at_rest(), 100) - at_rest()
    np.testing.assert_allclose(travelled[:, 0], 8000.0, atol=1e-8)
    np.testing.assert_allclose(travelled[:, 1], 0.0, atol=1e-9)


def test_formation_is_taken_up_from_a_disturbed_start(law: Any) -> None:
    own, hearing = run(law, disturbed(), 1500), links(law)
    spacing = own[hearing.sender, 0] - own[hearing.receiver, 0]
    np.testing.assert_allclose(spacing, hearing.desired, atol=1e-3)
    np.testing.assert_allclose(own[:, 1], LEADER[1], atol=1e-6)
