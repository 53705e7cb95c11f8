"""Checks that every sampled law must pass, for the author of one: what the contract in ``trainctl.signals`` says, as assertions.

``check_sampled_law(my_law)`` runs all; ``CHECKS`` lists them for ``pytest.mark.parametrize``. Six point trains on one track receive
from their neighbours, with one link more and one train that receives nothing; the reference runs at 80 m/s.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np

from trainctl.plants import point
from trainctl.signals import Bounds, Consists, Demand, Floats, Links, Reference, Scene, Trains

SPACING = 5000.0
SLOT = -SPACING * np.arange(6.0)
EDGES = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 2)]  # the last train receives nothing
LEADER = np.array([30000.0, 80.0, 0.0, 0.0])
DAVIS = (1.176e-2, 7.7616e-4, 1.6e-5)
N = len(SLOT)


class Example(NamedTuple):
    """A law in the scene of the checks."""

    law: Any  # the module
    params: Any  # its Params
    weight: float  # of all links


def check_sampled_law(law: Any, controller: dict[str, Any] | None = None, weight: float = 1.0) -> None:
    """Run all checks.

    Parameters
    ----------
    law : module
        What ``[controller] law`` would name, see ``trainctl.contracts.SampledLaw``.
    controller : dict, optional
        Keys of ``[controller]``; default those of the law.
    weight : float
        Weight of all links.

    Raises
    ------
    AssertionError
        The law breaks the contract.
    """
    example = Example(law, law.Params.model_validate(controller or {}), weight)
    for check in CHECKS:
        check(example)


def check_violations_are_lines_of_text(x: Example) -> None:
    """Objections are a list of single lines."""
    found = x.law.violations(x.params, scene(x, disturbed()))
    assert isinstance(found, list)
    assert all(isinstance(line, str) and line and "\n" not in line for line in found)


def check_shapes_and_types(x: Example) -> None:
    """Messages (n, w), demands (n,)."""
    own = disturbed()
    sent = said(x, x.law.constants(x.params, scene(x, own)), own)
    assert sent.ndim == 2
    assert len(sent) == N
    assert sent.dtype == np.float64
    found = demand(x, own)
    assert found.acceleration.shape == found.saturated.shape == (N,)
    assert found.acceleration.dtype == np.float64
    assert found.saturated.dtype == np.bool_


def check_finite_even_far_out_and_on_stale_messages(x: Example) -> None:
    """No NaN, 100 km beside the slots or with a message missing."""
    own = disturbed() + np.column_stack((np.linspace(-1e5, 1e5, N), np.zeros(N)))
    assert np.isfinite(demand(x, own).acceleration).all()
    hearing = links(x)
    constants = x.law.constants(x.params, scene(x, own))
    sent = heard(x, constants, own, hearing)
    for missing in range(len(hearing.sender)):
        some = hearing._replace(heard=np.arange(len(hearing.sender)) != missing)
        assert np.isfinite(asked(x, constants, trains(own), LEADER, some, sent).acceleration).all()


def check_repeatable_and_inputs_untouched(x: Example) -> None:
    """The same arguments give the same bits, and are left as they were."""
    own, hearing = disturbed(), links(x)
    constants = x.law.constants(x.params, scene(x, own))
    sent = heard(x, constants, own, hearing)
    arguments: tuple[Any, ...] = (trains(own), LEADER, hearing, sent)
    copies = deepcopy(arguments)
    first = asked(x, constants, *arguments)
    second = asked(x, constants, *arguments)
    for one, two in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, two)
    for now, then in zip(arguments, copies, strict=True):
        for a, b in zip(now, then, strict=True) if isinstance(now, tuple) else [(now, then)]:
            np.testing.assert_array_equal(a, b)


def check_local(x: Example) -> None:
    """A stranger's state leaves the demand bit-identical.

    With the messages frozen no other train's state matters at all; with live ones only the neighbours' does, and only that of the
    nearest one ahead under a law that says ``FOLLOWS``.
    """
    own, hearing = disturbed(), links(x)
    listens = hearing.desired == SPACING if getattr(x.law, "FOLLOWS", False) else np.ones(len(hearing.sender), bool)
    constants = x.law.constants(x.params, scene(x, own))
    sent = heard(x, constants, own, hearing)
    before = demand(x, own)
    for other in range(N):
        moved = own.copy()
        moved[other] += (-777.0, 3.3)
        frozen = asked(x, constants, trains(moved), LEADER, hearing, sent)
        live = asked(x, constants, trains(moved), LEADER, hearing, heard(x, constants, moved, hearing))
        strangers = np.arange(N) != other
        neighbours = np.isin(np.arange(N), hearing.receiver[listens & (hearing.sender == other)])
        for after, same in ((frozen, strangers), (live, strangers & ~neighbours)):
            np.testing.assert_array_equal(after.acceleration[same], before.acceleration[same])
            np.testing.assert_array_equal(after.saturated[same], before.saturated[same])
        assert frozen.acceleration[other] != before.acceleration[other]
        assert not np.array_equal(live.acceleration[neighbours], before.acceleration[neighbours]) or not neighbours.any()


def check_numbering_of_the_trains_does_not_matter(x: Example) -> None:
    """A train's demand depends on what it receives, not on its row."""
    own, hearing = disturbed(), links(x)
    expected = demand(x, own).acceleration
    back = np.arange(N)[::-1]
    receiver, sender = back[hearing.receiver], back[hearing.sender]
    k = np.lexsort((sender, receiver))
    turned = hearing._replace(
        sender=sender[k], receiver=receiver[k], first=np.searchsorted(receiver[k], np.arange(N + 1)), desired=hearing.desired[k],
        lower=hearing.lower[k], upper=hearing.upper[k], slot=SLOT[::-1].copy(), order=back.copy(),
    )  # fmt: skip
    mirrored = np.ascontiguousarray(own[::-1])
    sc = scene(x, mirrored)._replace(links=turned)
    constants = x.law.constants(x.params, sc)
    found = asked(x, constants, trains(mirrored), LEADER, turned, heard(x, constants, mirrored, turned))
    np.testing.assert_allclose(found.acceleration[::-1], expected, atol=1e-12)


def check_equilibrium_is_held(x: Example) -> None:
    """At its slot and at the reference's speed a train is asked for nothing, and the point plant then stays there."""
    still = demand(x, at_rest())
    np.testing.assert_allclose(still.acceleration, 0.0, atol=1e-9)
    assert not still.saturated.any()
    travelled = run(x, at_rest(), 100) - at_rest()
    np.testing.assert_allclose(travelled[:, 0], 8000.0, atol=1e-8)
    np.testing.assert_allclose(travelled[:, 1], 0.0, atol=1e-9)


def check_formation_is_taken_up(x: Example) -> None:
    """From a few metres beside the slots every spacing is right to 1 mm after 1500 s."""
    own, hearing = run(x, disturbed(), 1500), links(x)
    spacing = own[hearing.sender, 0] - own[hearing.receiver, 0]
    np.testing.assert_allclose(spacing, hearing.desired, atol=1e-3)
    np.testing.assert_allclose(own[:, 1], LEADER[1], atol=1e-6)


CHECKS: tuple[Callable[[Example], None], ...] = (
    check_violations_are_lines_of_text,
    check_shapes_and_types,
    check_finite_even_far_out_and_on_stale_messages,
    check_repeatable_and_inputs_untouched,
    check_local,
    check_numbering_of_the_trains_does_not_matter,
    check_equilibrium_is_held,
    check_formation_is_taken_up,
)


def links(x: Example) -> Links:
    """The graph of the checks."""
    rows = np.array(sorted([(b, a) for a, b in EDGES] + EDGES))
    receiver, sender = rows[:, 0].copy(), rows[:, 1].copy()
    desired = SLOT[sender] - SLOT[receiver]
    ahead = desired > 0
    lower, upper = np.where(ahead, 100.0, desired * 2.0), np.where(ahead, desired * 2.0, -100.0)
    return Links(
        sender, receiver, np.searchsorted(receiver, np.arange(N + 1)), desired, lower, upper,
        np.full(len(rows), x.weight), np.ones(len(rows), bool), SLOT, np.arange(N),
    )  # fmt: skip


def scene(x: Example, own: Floats) -> Scene:
    """Six point trains, control period and step 1 s."""
    o, inf = np.zeros(N), np.full(N, np.inf)
    return Scene(
        trains=[str(i + 1) for i in range(N)],
        consists=Consists(np.arange(N + 1), o, o + 1, o + 1, np.tile(DAVIS, (N, 1)), o, o, inf, inf, inf, inf, o),
        own=own, links=links(x), bounds=Bounds(*(np.full(N, b) for b in (70.0, 90.0, -11.0, 11.0))),
        reference=Reference(np.array([0.0, 1e4]), np.array([[LEADER[0], LEADER[1]]])), time=0.0, step=1.0, control_period=1.0,
        lead=0.0, sub_step=1.0,
    )  # fmt: skip


def trains(own: Floats) -> Trains:
    """What the trains know of themselves."""
    return Trains(own[:, 0].copy(), own[:, 1].copy(), point.resistance(own[:, 1], np.tile(DAVIS, (len(own), 1))))


def at_rest() -> Floats:
    """Every train at its slot and at the reference's speed, shape (n, 2)."""
    return np.column_stack((LEADER[0] + SLOT, np.full(N, LEADER[1])))


def disturbed(seed: int = 0) -> Floats:
    """A few metres and up to 1 m/s beside that."""
    rng = np.random.default_rng(seed)
    return at_rest() + np.column_stack((rng.normal(0.0, 3.0, N), rng.uniform(-1.0, 1.0, N)))


def heard(x: Example, constants: Any, own: Floats, hearing: Links) -> Floats:
    """What the links bring if all messages arrive, shape (L, w)."""
    return np.ascontiguousarray(said(x, constants, own)[hearing.sender])


def said(x: Example, constants: Any, own: Floats) -> Floats:
    """What every train sends, shape (n, w)."""
    sent: Floats = x.law.message(constants, trains(own), LEADER, *first_state(x, own))
    return sent


def first_state(x: Example, own: Floats) -> list[Any]:
    """The state of a law that keeps one, at its first instant; none of others."""
    return [x.law.initial(x.params, scene(x, own))] if hasattr(x.law, "initial") else []


def demand(x: Example, own: Floats) -> Demand:
    """What the law asks for in this state, all messages fresh."""
    hearing = links(x)
    constants = x.law.constants(x.params, scene(x, own))
    return asked(x, constants, trains(own), LEADER, hearing, heard(x, constants, own, hearing))


def asked(x: Example, constants: Any, own: Trains, leader: Floats, hearing: Links, sent: Floats) -> Demand:
    """What the law asks for; one that keeps a state of its own, at its first instant."""
    state = first_state(x, np.column_stack((own.position, own.speed)))
    found = x.law.demand(constants, own, leader, hearing, sent, *state)
    demanded: Demand = found[0] if state else found
    return demanded


def run(x: Example, own: Floats, periods: int) -> Floats:
    """State of the point plant, shape (n, 2), after so many periods of 1 s."""
    sc = scene(x, own)
    constants, plant = x.law.constants(x.params, sc), point.constants(point.Params(), sc.consists)
    state = first_state(x, own)
    for k in range(periods):
        leader = np.array([LEADER[0] + LEADER[1] * k, LEADER[1], 0.0, 0.0])
        sent = x.law.message(constants, trains(own), leader, *state)[sc.links.sender]
        found = x.law.demand(constants, trains(own), leader, sc.links, sent, *state)
        if state:
            found, *state = found
        own = point.advance(plant, own, found.acceleration, 1.0, point.Kick.none(N)).own
    return own
