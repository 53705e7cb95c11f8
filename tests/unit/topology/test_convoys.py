"""Formations as chains of coupled trains."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trainctl.topology import convoys

SPACING = convoys.Spacing(1000.0, 400.0, 1600.0, 1.0)


@st.composite
def chains(draw: st.DrawFn) -> np.ndarray:
    """Trains in some order, cut into chains."""
    order = draw(st.permutations(range(draw(st.integers(1, 12)))))
    ahead = np.full(len(order), -1)
    for a, b in pairwise(order):
        if draw(st.booleans()):
            ahead[b] = a
    return ahead


@given(chains())
def test_chains_have_one_front_and_stand_in_order(ahead):
    front, order = convoys.fronts(ahead), convoys.front_to_rear(ahead)
    assert sorted(order.tolist()) == list(range(len(ahead)))
    place = np.argsort(order)
    for i, j in enumerate(ahead.tolist()):
        if j < 0:
            assert front[i] == i
        else:
            assert front[i] == front[j]
            assert place[i] == place[j] + 1


@given(chains())
def test_links_go_both_ways_and_agree_with_the_slots(ahead):
    order = convoys.front_to_rear(ahead)
    slot = convoys.slots(ahead, order, SPACING.desired, np.zeros(len(ahead)))
    links = convoys.links(ahead, order, slot, SPACING)
    pairs = {(s, r): k for k, (s, r) in enumerate(zip(links.sender.tolist(), links.receiver.tolist(), strict=True))}
    assert len(pairs) == 2 * np.sum(ahead >= 0)
    for (s, r), k in pairs.items():
        back = pairs[r, s]
        assert (links.desired[k], links.lower[k], links.upper[k]) == (-links.desired[back], -links.upper[back], -links.lower[back])
        assert links.desired[k] == slot[s] - slot[r]
        assert links.first[r] <= k < links.first[r + 1]


def test_a_train_uncouples_when_another_is_ahead_or_one_of_the_two_is_not_willing():
    ahead, willing = np.array([-1, 0, 1, 2]), np.ones(4, bool)
    assert convoys.broken(ahead, ahead, willing).tolist() == []
    assert convoys.broken(ahead, np.array([-1, 0, 0, 2]), willing).tolist() == [2]
    assert convoys.broken(ahead, ahead, np.array([True, False, True, True])).tolist() == [1, 2]


def test_a_train_may_couple_to_the_next_ahead_if_nobody_is_nearer_to_that_one():
    alone, willing = np.full(3, -1), np.ones(3, bool)
    behind_both = np.array([-1, 0, 0])  # 1 and 2 come over two tracks, 1 is nearer
    assert convoys.candidates(alone, behind_both, np.array([1, -1, -1]), willing).tolist() == [1]
    assert convoys.candidates(alone, behind_both, np.array([1, -1, -1]), np.array([True, False, True])).tolist() == []


def test_a_ring_is_never_closed():
    ahead = np.array([-1, 0, 1])
    assert convoys.candidates(ahead, np.array([2, 0, 1]), np.array([1, 2, 0]), np.ones(3, bool)).tolist() == []


@given(st.floats(-5000.0, 5000.0))
def test_closing_in_can_be_braked_with_the_deceleration_it_is_made_for(error):
    speed = float(convoys.closing_speed(np.array([error]))[0])
    assert speed * error >= 0.0
    assert speed**2 <= 2.0 * convoys.APPROACH_MPS2 * abs(error) + 1e-9
