"""No gridlock on single track: random lines, stations and branches, where only the interlocking decides."""

from __future__ import annotations

import numpy as np
import pytest
from decisions import Plan, at_random, played, railway


@pytest.mark.parametrize(
    "seed", [*range(12), 22, 46, 517, 546, 554, 598, 611, 674]
)  # the named ones stood still by the older rules
def test_everybody_gets_out(seed):
    played(at_random(seed), seed)


@pytest.mark.campaign
def test_campaign_ten_thousand_nets():
    for seed in range(10_000):
        played(at_random(seed), seed)


def shuttle(siding: float, lengths: list[float], ups: int) -> Plan:
    """A single track with one passing loop of two tracks; the first ``ups`` trains go up, the others down, all due at once."""
    made = railway(
        {"l": 2000.0, "-l": 2000.0, "p": siding, "q": siding, "r": 2000.0, "-r": 2000.0},
        [("l", "p"), ("p", "r"), ("-r", "q"), ("q", "-l")], [("l", "-l"), ("r", "-r")],
    )  # fmt: skip
    paths = [["l", "p", "r"] if k < ups else ["-r", "q", "-l"] for k in range(len(lengths))]
    return Plan(made, [[made.number[e] for e in path] for path in paths], np.array(lengths), np.zeros(len(lengths), int))


@pytest.mark.parametrize("siding", [600.0, 150.0])
@pytest.mark.parametrize("seed", range(3))
def test_trains_pass_at_a_siding_and_one_by_one_where_it_is_shorter_than_they_are(siding, seed):
    played(shuttle(siding, [300.0, 320.0, 250.0, 300.0, 280.0, 310.0], 3), seed)
