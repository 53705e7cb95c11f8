from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from trainctl.scenario.reference import obeying, table
from trainctl.signals import leader_at

RATES = (0.3, 0.5)


@st.composite
def lines(draw):
    lengths = draw(st.lists(st.integers(50, 4000), min_size=1, max_size=8))
    speeds = draw(st.lists(st.integers(4, 40), min_size=len(lengths), max_size=len(lengths)))
    starts = np.concatenate([[0.0], np.cumsum(lengths)[:-1]])
    return [(float(a), float(v)) for a, v in zip(starts, speeds, strict=True)]


@settings(max_examples=80)
@given(
    lines(),
    st.lists(st.integers(150, 2500), max_size=4),
    st.integers(1, 140),
    st.integers(0, 30),
    st.sampled_from([None, 9000.0, 300.0]),
)
def test_no_member_is_ever_above_a_limit_and_the_reference_is_never_needlessly_slow(limits, spacings, length, start, stop):
    slots = -np.concatenate([[0.0], np.cumsum(spacings)])
    reach = (slots[-1] - length, 0.0)
    try:
        points = obeying(limits, 0.0, float(start), reach, RATES, stop=stop)
    except ValueError:
        assume(False)
    reference, at = table(points, 0.0), np.array([a for a, _ in limits])
    v = np.array([v for _, v in limits])
    out = np.empty(4)
    times = np.unique(np.concatenate([[t for t, _ in points], np.linspace(0.0, points[-1][0] + 60.0, 400)]))
    for t in times:
        leader_at(reference, t, t, out)
        for slot in slots:
            front, rear = out[0] + slot, out[0] + slot - length
            inside = v[(np.append(at[1:], np.inf) > rear + 1e-6) & (np.concatenate([[-np.inf], at[1:]]) < front - 1e-6)]
            assert out[1] <= inside.min() + 1e-6
    assert stop is None or (out[1] == 0.0 and abs(out[0] - stop) < 1e-6)
    for (t, a), (u, b) in pairwise(points):
        rate = (b - a) / (u - t)
        if abs(rate) > 1e-9:
            assert min(abs(rate - RATES[0]), abs(rate + RATES[1])) < 1e-6
        else:  # at one speed only where it is the limit of some place under the formation
            leader_at(reference, 0.5 * (t + u), 0.5 * (t + u), out)
            under = v[(np.append(at[1:], np.inf) > out[0] + reach[0]) & (np.concatenate([[-np.inf], at[1:]]) < out[0])]
            assert abs(a - under.min()) < 1e-6
