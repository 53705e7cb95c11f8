"""Tolerances in time on streams: the same verdicts as the tube round whole curves, whatever the pieces the logs come in."""

from __future__ import annotations

import itertools

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainctl.diff.rows import compare
from trainctl.diff.runs import diff
from trainctl.diff.sources import Log
from trainctl.diff.tolerance import parse_tolerances
from trainctl.diff.tube import inside


def log(rows, pieces=(), time="time"):
    """A log of (time, id, speed, lane) that comes in pieces."""
    rows = sorted(rows, key=lambda row: row[0])
    cuts = [0, *sorted({min(p, len(rows)) for p in pieces}), len(rows)]

    def batches():
        for begin, end in itertools.pairwise(cuts):
            part = rows[begin:end]
            if part:
                columns = zip(*part, strict=True)
                yield pa.table(dict(zip((time, "id", "speed", "lane"), map(list, columns), strict=True)))

    return Log("fcd", "made up", time, ("id",), batches)


def curve(rng, name, step):
    n = int(rng.integers(0, 14))
    begin = float(rng.integers(0, 10))
    return [(begin + step * k, name, float(rng.normal()), "e") for k in range(n)]


@settings(max_examples=60)
@given(st.integers(0, 10**6))
def test_streaming_gives_the_verdicts_of_whole_curves(seed):
    rng = np.random.default_rng(seed)
    w, h = float(rng.integers(1, 6)) / 2, 0.4
    a = [row for name in "xyz" for row in curve(rng, name, float(rng.integers(1, 4)))]
    b = [row for name in "xyzu" for row in curve(rng, name, float(rng.integers(1, 8)) / 2)]
    pieces = [int(p) for p in rng.integers(0, 40, 5)], [int(p) for p in rng.integers(0, 40, 5)]
    told = parse_tolerances({"absolute": h, "time_s": w})
    found = compare(log(a, pieces[0]), log(b, pieces[1]), told, {})
    bad = alone = 0
    for name in "xyzu":
        time, y = (np.array([row[k] for row in a if row[1] == name], float) for k in (0, 2))
        at, value = (np.array([row[k] for row in b if row[1] == name], float) for k in (0, 2))
        near = np.array([np.any(np.abs(time - t) <= w) for t in at], bool)
        good = inside(time, y, np.full(len(time), w), np.full(len(time), h), at, value)
        bad, alone = bad + int((near & ~good).sum()), alone + int((~near).sum())
    assert (found.columns["speed"].differing if "speed" in found.columns else 0) == bad
    assert found.extra.count == alone
    gone = [t for t, name, *_ in a if not any(n == name and abs(t - s) <= w for s, n, *_ in b)]
    assert found.missing.count == len(gone)


def ramp(late=0.0, lanes=False, until=40, name="x"):
    times = np.arange(0.0, until)
    return [(t, name, max(0.0, t - late), f"e{int(max(0.0, t - late)) // 10}" if lanes else "e") for t in times]


@pytest.mark.parametrize("late, same", [(0.0, True), (0.9, True), (1.0, True), (1.1, False)])
def test_a_train_may_be_late_by_what_is_allowed(late, same):
    found = compare(log(ramp()), log(ramp(late)), parse_tolerances({"time_s": 1.0}), {})
    assert found.same == same


def test_a_name_may_come_late_too():
    told = parse_tolerances({"time_s": 2.0})
    assert compare(log(ramp(lanes=True)), log(ramp(2.0, lanes=True)), told, {}).same
    found = compare(log(ramp(lanes=True)), log(ramp(4.0, lanes=True)), told, {}).columns["lane"]
    assert (found.first.time_s, found.first.a, found.first.b) == (13.0, "e1", "e0")


def test_the_tube_is_told():
    found = compare(log(ramp()), log(ramp(3.0)), parse_tolerances({"columns": {"speed": {"absolute": 0.5, "time_s": 1.0}}}), {})
    worst = found.columns["speed"].largest
    assert worst.difference == pytest.approx(3.0)
    assert (worst.lower, worst.upper) == (worst.time_s - 1.5, worst.time_s + 1.5)
    assert found.columns["speed"].tolerance.told() == "0.5, within 1 s"


def test_relative_to_the_range_and_to_the_value():
    a, b = ramp(), [(t, n, 1.02 * v, lane) for t, n, v, lane in ramp()]
    for table, same in (
        ({"range": 0.0201}, True),
        ({"range": 0.019}, False),
        ({"relative": 0.0201}, True),
        ({"relative": 0.019}, False),
    ):
        assert compare(log(a), log(b), parse_tolerances(table), {}).same == same, table
    late = ramp(1.0)
    assert compare(log(a), log(late), parse_tolerances({"time_range": 1.01 / 39}), {}).same
    assert not compare(log(a), log(late), parse_tolerances({"time_range": 0.9 / 39}), {}).same


def test_only_the_common_time_is_compared():
    a, b = ramp(until=30), ramp(until=50)[5:]
    assert not compare(log(a), log(b, (10,)), parse_tolerances({}), {}).same
    found = compare(log(a, (7,)), log(b, (10, 30)), parse_tolerances({"ends": "common"}), {})
    assert found.same
    assert found.rows == 25


def test_another_step_is_no_difference_within_the_time():
    b = [(t, "x", t, "e") for t in np.arange(0.0, 39.1, 0.5)]
    assert compare(log(ramp()), log(b), parse_tolerances({"time_s": 0.5}), {}).same
    assert compare(log(ramp()), log(b), parse_tolerances({}), {}).extra.count == 39


def test_a_row_twice_is_no_row_that_is_near():
    b = sorted([*ramp(), ramp()[7]])
    found = compare(log(ramp()), log(b), parse_tolerances({"time_s": 1.0}), {})
    assert found.extra.count == 1
    assert found.only_b.of("doubled", 0) == 1.0


def test_memory_is_that_of_the_tolerance(monkeypatch):
    from trainctl.diff import in_time

    most = []
    forget = in_time.InTime._forget

    def watched(self, known):
        forget(self, known)
        most.append(len(self.reference.time) + len(self.other.time))

    monkeypatch.setattr(in_time.InTime, "_forget", watched)
    rows = ramp(until=4000)
    pieces = range(0, 4000, 50)
    assert compare(log(rows, pieces), log(rows, pieces), parse_tolerances({"time_s": 5.0}), {}).same
    assert max(most) < 50


@pytest.fixture
def golden(finished, tmp_path):
    from trainctl.testing import make_golden

    run = finished("three_tracks", "numeric", **{"run.duration_s": 40})
    return run, make_golden(run, tmp_path / "golden", every_s=10.0)


def test_a_thinned_golden_is_held_against_the_run_between_its_instants(golden):
    run, place = golden
    assert diff(place, run.folder, parse_tolerances({"time_s": 0.5})).same
    report = diff(place, run.folder, parse_tolerances({"absolute": 0.0, "time_s": 1e-9}))
    assert report.same, report.lines()
    assert {t.table: t.rows for t in report.tables}["trains"] == 5 * 6
