"""Reference profiles: exact positions, speeds and breaks, and what the ``[reference]`` table refuses."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl.scenario.reference import Profile, by_position, constant, s_curves, table
from trainctl.signals import Reference, leader_at

#: Fault-tolerant paper, sheet section 7: start, end, final speed.
PAPER = [
    (60.0, 240.0, 55.0), (400.0, 540.0, 80.0), (700.0, 800.0, 92.0), (1060.0, 1200.0, 65.0),
    (1360.0, 1480.0, 85.0), (1700.0, 1880.0, 50.0), (2020.0, 2140.0, 72.0), (2280.0, 2440.0, 40.0),
]  # fmt: skip


def at(reference: Reference, t: float, inside: float | None = None) -> np.ndarray:
    out = np.empty(4)
    leader_at(reference, t, t if inside is None else inside, out)
    return out


def test_constant_speed_runs_on_for_ever():
    np.testing.assert_allclose(at(constant(80.0, 500.0), 1e4), [800500.0, 80.0, 0.0, 0.0])


def test_speed_steps_where_the_reference_passes_the_kilometrage():
    r = by_position([(109000.0, 80.0), (161000.0, 60.0), (294000.0, 70.0)], 109000.0)
    np.testing.assert_allclose(r.breaks[:-1], [0.0, 52000.0 / 80.0, 52000.0 / 80.0 + 133000.0 / 60.0])
    for t, inside, v in ((650.0, 649.0, 80.0), (650.0, 651.0, 60.0)):
        np.testing.assert_allclose(at(r, t, inside)[:2], [161000.0, v])
    np.testing.assert_allclose(at(r, r.breaks[2] + 10.0)[:2], [294700.0, 70.0])


@pytest.mark.parametrize("position, speed, pieces", [(0.0, 80.0, 3), (150.0, 80.0, 2), (200.0, 60.0, 1), (999.0, 60.0, 1)])
def test_steps_already_passed_are_not_repeated(position, speed, pieces):
    r = by_position([(100.0, 80.0), (200.0, 60.0)] if pieces < 3 else [(100.0, 80.0), (200.0, 60.0), (300.0, 50.0)], position)
    assert len(r.position) == pieces
    assert at(r, 0.0)[1] == speed


def test_paper_profile_reaches_its_published_figures():
    r = s_curves(20115.0, 20.0, PAPER)
    assert at(r, 2500.0)[0] == pytest.approx(188635.0, abs=0.5)
    w, u = np.array([at(r, t)[2:] for t in np.arange(0.0, 2500.0, 0.1)]).T
    assert (round(w.min(), 3), round(w.max(), 3)) == (-0.375, 0.365)
    assert round(abs(u).max(), 4) == 0.0088
    for _, end, final in PAPER:
        assert at(r, end)[1] == final


def test_s_curves_are_smooth_across_every_break():
    r = s_curves(0.0, 30.0, [(0.0, 50.0, 60.0), (50.0, 80.0, 20.0)])
    for t in r.breaks[1:-1]:
        before, after = at(r, t, t - 1.0), at(r, t, t + 1.0)
        np.testing.assert_allclose(before, after, atol=1e-9)
    # speed in the middle of a curve is halfway, its slope the largest: 1.875 changes per duration
    x = 25.0 * 30.0 + 50.0 * 30.0 * (2.5 / 16 - 3 / 32 + 1 / 64)
    np.testing.assert_allclose(at(r, 25.0), [x, 45.0, 1.875 * 30.0 / 50.0, 0.0], atol=1e-9)


def test_table_is_straight_lines_and_steps():
    r = table([(0.0, 10.0), (10.0, 30.0), (10.0, 20.0), (20.0, 20.0)], 5.0)
    np.testing.assert_allclose(at(r, 5.0), [5.0 + 50.0 + 25.0, 20.0, 2.0, 0.0])
    np.testing.assert_allclose(at(r, 10.0, 9.0)[:2], [205.0, 30.0])
    np.testing.assert_allclose(at(r, 10.0, 11.0)[:2], [205.0, 20.0])
    np.testing.assert_allclose(at(r, 100.0), [205.0 + 90.0 * 20.0, 20.0, 0.0, 0.0])


@pytest.mark.parametrize(
    "given, expected",
    [
        ({"speed_mps": 80}, constant(80.0, 7.0)),
        ({"speed_by_position": [[0, 80], [100, 70]], "position_m": 50}, by_position([(0.0, 80.0), (100.0, 70.0)], 50.0)),
        ({"s_curves": [[0, 5, 20]], "start_speed_mps": 10}, s_curves(7.0, 10.0, [(0.0, 5.0, 20.0)])),
        ({"table": [[0, 5], [3, 6]]}, table([(0.0, 5.0), (3.0, 6.0)], 7.0)),
    ],
)  # fmt: skip
def test_profile_is_the_reference_it_describes(given, expected):
    made = Profile.model_validate(given).leader(7.0)
    np.testing.assert_array_equal(made.breaks, expected.breaks)
    np.testing.assert_array_equal(made.position, expected.position)


@pytest.mark.parametrize(
    "given, words",
    [
        ({}, "exactly one of"),
        ({"speed_mps": 1.0, "table": [[0.0, 1.0]]}, "here speed_mps and table"),
        ({"s_curves": [[0.0, 5.0, 20.0]]}, "start_speed_mps"),
        ({"speed_mps": 1.0, "start_speed_mps": 1.0}, "start_speed_mps"),
        ({"speed_mps": -1.0}, "greater than or equal to 0"),
        ({"speed_mps": "80"}, "valid number"),
        ({"speed_by_position": [[0.0, 0.0]]}, "above 0"),
        ({"speed_by_position": [[5.0, 1.0], [5.0, 2.0]]}, "ascend"),
        ({"speed_by_position": [[5.0, 1.0, 2.0]]}, "at most 2"),
        ({"s_curves": [[10.0, 5.0, 20.0]], "start_speed_mps": 1.0}, "ends at or before its start"),
        ({"s_curves": [[0.0, 5.0, 20.0], [4.0, 8.0, 9.0]], "start_speed_mps": 1.0}, r"s_curves\[1\].*before 5 s"),
        ({"s_curves": [[-1.0, 5.0, -20.0]], "start_speed_mps": 1.0}, "start of the run.*below 0"),
        ({"table": [[1.0, 5.0]]}, "first time must be 0"),
        ({"table": [[0.0, 5.0], [2.0, 5.0], [1.0, -5.0]]}, "descend.*below 0"),
        ({"sped": 1.0}, "Extra inputs"),
    ],
)
def test_profile_refuses(given, words):
    with pytest.raises(ValidationError, match=words):
        Profile.model_validate(given)
