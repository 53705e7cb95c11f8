"""No gridlock on single track: random lines, stations and branches, where only the interlocking decides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from decisions import Plan, at_random, played, railway


@pytest.mark.parametrize(
    "seed", [*range(12), 22, 46, 517, 546, 554, 598, 611, 674]
)  # the named ones stood still by the older rules
def test_everybody_gets_out(seed):
    played(at_random(seed), seed)


@pytest.mark.parametrize("seed", [2003, 5159, 8009, 9181, 9434, 10019])
def test_trains_that_ask_far_ahead_get_out_too(seed):
    """Turns behind one that was due where it passed; let in before others that stood ahead; two that came kept each other out.

    2003, 9434: a turn far ahead was taken by a train behind one that had yet to come to the same join, over another track.
    """
    played(at_random(seed), seed, 1200.0)


@pytest.mark.campaign
@pytest.mark.parametrize("thousand", range(10))
def test_campaign_ten_thousand_nets(thousand):
    """Trains ask for what lies 300, 600 and 1200 m ahead in turn. Some three minutes of one core for a thousand."""
    for seed in range(1000 * thousand, 1000 * (thousand + 1)):
        played(at_random(seed), seed, (300.0, 600.0, 1200.0)[seed % 3])


def shuttle(siding: float, lengths: list[float], ups: int, orders: Sequence[tuple[str, int, int]] = ()) -> Plan:
    """A single track with one passing loop of two tracks; the first ``ups`` trains go up, the others down, all due at once."""
    made = railway(
        {"l": 2000.0, "-l": 2000.0, "p": siding, "q": siding, "r": 2000.0, "-r": 2000.0},
        [("l", "p"), ("p", "r"), ("-r", "q"), ("q", "-l")], [("l", "-l"), ("r", "-r")],
    )  # fmt: skip
    paths = [["l", "p", "r"] if k < ups else ["-r", "q", "-l"] for k in range(len(lengths))]
    return Plan(made, [[made.number[e] for e in path] for path in paths], np.array(lengths), np.zeros(len(lengths), int), orders)


@pytest.mark.parametrize("siding", [600.0, 150.0])
@pytest.mark.parametrize("seed", range(3))
def test_trains_pass_at_a_siding_and_one_by_one_where_it_is_shorter_than_they_are(siding, seed):
    played(shuttle(siding, [300.0, 320.0, 250.0, 300.0, 280.0, 310.0], 3), seed)


@pytest.mark.parametrize("seed", range(3))
def test_trains_meet_at_a_siding_where_orders_say_so(seed):
    """Each going up is to be first on the left, the next one coming down first on the right."""
    orders = [(edge, up, down) if edge == "l" else (edge, down, up) for up, down in ((0, 3), (1, 4), (2, 5)) for edge in "lr"]
    played(shuttle(600.0, [300.0, 320.0, 250.0, 300.0, 280.0, 310.0], 3, orders), seed)
