"""Findings: what was done to a log is what is said of it, in a line or two; and nothing is said of what is the same."""

from __future__ import annotations

import zlib

import mutations
import numpy as np
import pandas as pd
import pytest

from trainctl.diff.findings import CAUSES
from trainctl.diff.rows import compare
from trainctl.diff.runs import diff
from trainctl.diff.sources import Log
from trainctl.diff.tolerance import Tolerances

FORMATS = (".xml", ".csv", ".parquet")


@pytest.fixture(scope="module")
def fcd(finished):
    """A log of SUMO's with a join, a fork and a stop."""
    return mutations.read(finished("merging").folder)


@pytest.fixture(scope="module")
def written(fcd, tmp_path_factory):
    """The reference in three formats."""
    place = tmp_path_factory.mktemp("reference")
    return {end: mutations.write(fcd, place / f"a{end}") for end in FORMATS}


def judged(fcd, written, tmp_path, kind, seed):
    rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])
    done, end = mutations.MUTATIONS[kind](fcd, rng), FORMATS[seed % 3]
    a, b = written[end], mutations.write(done.log, tmp_path / f"b{end}")
    report = diff(b, a) if kind == "stop" else diff(a, b)
    told = [(f.cause, f.words, f.rows, f.values) for f in report.findings]
    assert not report.same
    assert 1 <= len(told) <= 3, told
    named = [f for f in report.findings if f.cause in done.causes and set(done.trains) <= set(f.trains)]
    assert named, told
    if done.by is not None:
        assert any(abs(abs(f.by) - abs(done.by)) <= 0.01 * abs(done.by) + 0.006 for f in named), told
    return report


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", mutations.MUTATIONS)
def test_what_was_done_is_named(fcd, written, tmp_path, kind, seed):
    report = judged(fcd, written, tmp_path, kind, seed)
    values = sum(c.differing for t in report.tables for c in t.columns.values())
    rows = sum(t.missing.count + t.extra.count for t in report.tables)
    assert sum(f.values for f in report.findings) == values, "every value that differs belongs to one finding"
    if not report.renamed:
        assert sum(f.rows for f in report.findings) == rows


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("kind", mutations.MUTATIONS)
def test_a_hundred_and_sixty_changes_are_named(fcd, written, tmp_path, kind, seed):
    judged(fcd, written, tmp_path, kind, 1000 + seed)


def of_a_column(report):
    """Of a change of law or seed: a finding per column of each table, with the first and the largest; and the setting."""
    columns = [(f.tables[0], c) for f in report.findings for c in f.columns]
    assert len(columns) == len(set(columns))
    differing = {(t.table, c) for t in report.tables for c in t.columns}
    assert set(columns) == differing
    assert differing
    for f in report.findings:
        if f.columns:
            assert f.first is not None
            assert f.values > 0
            assert f.largest is not None or f.first.place.difference is None
    return [f.words for f in report.findings if f.cause == "setting"]


GAIN, SEED = ("robust_constrained_undisturbed", "numeric"), ("fully_distributed_loss", "numeric")


def test_another_gain_is_a_finding_per_column(finished):
    a = finished(*GAIN, **{"run.duration_s": 80})
    b = finished(*GAIN, **{"run.duration_s": 80, "controller.h_per_s": 0.303})
    assert of_a_column(diff(a.folder, b.folder)) == ["scenario.controller.h_per_s: 0.3 -> 0.303"]


def test_another_seed_is_a_finding_per_column(finished):
    a = finished(*SEED, **{"run.duration_s": 60})
    b = finished(*SEED, **{"run.duration_s": 60, "run.seed": 2})
    assert of_a_column(diff(a.folder, b.folder)) == ["seed: 1 -> 2"]


@pytest.mark.campaign
@pytest.mark.parametrize("number", range(20))
def test_twenty_gains_and_seeds(finished, number):
    a, b = finished(*GAIN, **{"run.duration_s": 80}), finished(*SEED, **{"run.duration_s": 60})
    gain = 0.3 * (1 + (-1) ** number * 0.002 * (number + 1))
    of_a_column(diff(a.folder, finished(*GAIN, **{"run.duration_s": 80, "controller.h_per_s": gain}).folder))
    of_a_column(diff(b.folder, finished(*SEED, **{"run.duration_s": 60, "run.seed": number + 2}).folder))


# No false alarms


@pytest.mark.parametrize("one", FORMATS)
@pytest.mark.parametrize("two", FORMATS)
def test_the_same_run_in_two_formats_has_no_finding(written, one, two):
    report = diff(written[one], written[two])
    assert report.same, report.lines()
    assert report.findings == []


def test_another_rounding_has_no_finding(fcd, tmp_path):
    rng, other = np.random.default_rng(1), fcd.copy()
    for name in mutations.NUMBERS:
        other[name] *= 1 + 1e-9 * rng.uniform(-1, 1, len(other))
    for end in FORMATS:
        a, b = mutations.write(fcd, tmp_path / f"a{end}"), mutations.write(other, tmp_path / f"b{end}")
        assert diff(a, b).findings == []


def test_two_runs_of_one_scenario_have_no_finding(finished, tmp_path):
    from trainctl.runner import run
    from trainctl.scenario.build import open_scenario

    again = run(open_scenario(SEED[0], {"run.duration_s": 60}), tmp_path / "again", "numeric")
    assert diff(finished(*SEED, **{"run.duration_s": 60}).folder, again.folder).findings == []


# Made up: what the run above does not have


def log(frame: pd.DataFrame, name="fcd", keys=("id",), time="time"):
    import pyarrow as pa

    return Log(name, "made up", time, keys, lambda: iter([pa.Table.from_pandas(frame, preserve_index=False)]))


def course(name, edges, speed=20.0, begin=0, n=200, length=1000.0):
    times = np.arange(begin, begin + n, dtype=float)
    distance = speed * (times - begin)
    where = [edges[min(int(d // length), len(edges) - 1)] for d in distance]
    return pd.DataFrame(
        {
            "time": times,
            "id": name,
            "speed": speed,
            "pos": distance % length,
            "distance": distance,
            "lane": [f"{e}_0" for e in where],
        }
    )


def found(a, b, sort=("time", "id"), **more):
    from trainctl.diff.causes import causes

    a, b = (pd.concat(parts).sort_values(list(sort), kind="stable") for parts in (a, b))
    return causes(compare(log(a, **more), log(b, **more), Tolerances(), {}), Tolerances())


def test_another_way_is_one_finding():
    a = [course("p", ["west", "left", "east"]), course("q", ["west", "right", "east"], begin=5)]
    b = [course("p", ["west", "siding", "east"], speed=20.0), a[1]]
    b[0].loc[b[0].lane == "siding_0", "speed"] = 11.0
    (f,) = found(a, b)
    assert (f.cause, f.trains) == ("route", ["p"])
    assert f.words == "train p takes another route from 50 s on: siding east instead of left east"


def test_another_track_of_the_same_way():
    a, b = course("p", ["west", "mid", "east"]), course("p", ["west", "mid", "east"])
    b.loc[(b.time >= 60) & (b.time < 90), "lane"] = "mid_1"
    (f,) = found([a], [b])
    assert f.cause == "route"
    assert "another track" in f.words


def test_a_train_that_is_late_in_two_logs_is_one_finding():
    from trainctl.diff.causes import causes
    from trainctl.diff.findings import merged

    rows = course("p", ["a", "b", "c"])
    late = mutations.later(rows.assign(x=0.0, y=0.0, angle=0.0, slope=0.0), 60.0, 7.0, True)[rows.columns].query("time < 200")
    trips = pd.DataFrame({"id": ["p", "q"], "depart": [0.0, 1.0], "arrival": [200.0, 210.0], "duration": [200.0, 209.0]})
    slow = trips.assign(arrival=[207.0, 210.0], duration=[207.0, 209.0])
    one = compare(log(rows), log(late), Tolerances(), {})
    how = {"name": "tripinfo", "time": None}
    two = compare(log(trips, **how), log(slow, **how), Tolerances(), {})
    (f,) = merged([f for t in (one, two) for f in causes(t, Tolerances())])
    assert (f.cause, f.trains, f.by, f.tables) == ("late", ["p"], 7.0, ["fcd", "tripinfo"])
    assert f.words == "train p late by 7 s from 61 s on: it is at a standstill on b"
    assert f.first.place.time_s == pytest.approx(60.0, abs=1.0)


def test_one_value_is_no_shift():
    how = {"name": "tripinfo", "time": None}
    a = pd.DataFrame({"id": list("pqrs"), "depart": [0.0, 1.0, 2.0, 3.0], "routeLength": [100.0, 200.0, 300.0, 400.0]})
    (f,) = found([a], [a.assign(routeLength=[101.0, 203.0, 307.0, 400.0])], sort=["id"], **how)
    assert (f.cause, f.words) == ("values", "routeLength of trains p, q, r differs by up to 7")
    (f,) = found([a], [a.assign(routeLength=[101.0, 201.0, 301.0, 400.0])], sort=["id"], **how)
    assert (f.cause, f.by) == ("shift", 1.0)


@pytest.mark.parametrize("others", [[], ["q"], ["q", "r"]])
def test_a_train_at_a_steady_speed_is_late_and_its_place_is_not_shifted(others):
    rest = [course(name, ["d", "e"], begin=7) for name in others]
    a = course("p", ["a", "b", "c"])
    b = a.copy()
    b.loc[b.time >= 60, ["pos", "distance", "lane"]] = a.loc[a.time.between(57, 196), ["pos", "distance", "lane"]].to_numpy()
    (f,) = found([a, *rest], [b, *rest])
    assert (f.cause, f.words) == ("late", "train p late by 3 s from 60 s on")
    (f,) = found([a, *rest], [a.assign(distance=a.distance + 4.0), *rest])
    assert (f.cause, f.by) == ("shift", 4.0)


def test_other_routes_of_several_trains():
    from trainctl.diff.causes import causes

    how = {"name": "vehroute", "time": None}
    a = pd.DataFrame({"id": list("pqr"), "depart": [0.0, 1.0, 2.0], "route_edges": ["a b c", "a b d", "a b e"]})
    b = a.assign(route_edges=["a b c", "a x d", "a b f e"])
    told = [f.words for f in causes(compare(log(a, **how), log(b, **how), Tolerances(), {}), Tolerances())]
    assert told == ["train q takes another route: x d instead of b d", "train r takes another route: f e instead of e"]


def test_noise_is_called_noise():
    a = course("p", ["a"], n=400)
    b = a.assign(distance=a.distance + np.random.default_rng(0).uniform(-0.05, 0.05, len(a)))
    (f,) = found([a], [b])
    assert f.cause == "noise"
    assert f.words.startswith("distance of train p scatters within 0.05")
    (g,) = found([a], [a.assign(distance=a.distance * 1.001 + 1e-4 * a.time**2)])
    assert g.cause == "values"


def test_a_log_that_ends_before_is_one_finding():
    a = [course(name, ["a", "b"], begin=k) for k, name in enumerate("pqrs")]
    (f,) = found(a, [rows[rows.time < 150] for rows in a])
    assert (f.cause, f.rows, f.from_s) == ("ends", 4 * 50 + 6, 149.0)
    assert f.words == "the log ends earlier than the reference: at 149 s instead of 202 s"


def test_a_train_that_is_missing_and_one_that_is_new():
    a, b = [course("p", ["a"]), course("q", ["b"])], [course("p", ["a"]), course("z", ["c", "d"], speed=7.0)]
    told = {f.cause: f.words for f in found(a, b)}
    assert told == {"missing": "train q missing", "added": "train z not in the reference"}


def test_what_differs_by_no_rule_is_no_other_thing():
    """A train that loses time all the way is not late by what it has lost in the last ten rows."""
    a = course("p", ["a", "b", "c"], n=60).drop(columns="pos")
    lost = np.where(a.time >= 50, 5.0, 0.021 * a.time)
    assert [f.cause for f in found([a], [a.assign(distance=a.distance - 20.0 * lost)])] == ["values"]


def test_one_late_train_among_thousands_is_found_with_little_memory():
    from trainctl.diff import tally

    a = [course(f"t{k}", ["a", "b"], n=60) for k in range(300)]
    late = mutations.later(a[7].assign(x=0.0, y=0.0, angle=0.0, slope=0.0), 20.0, 3.0, True)[a[7].columns].query("time < 60")
    whole = compare(log(pd.concat(a).sort_values("time", kind="stable")),
                    log(pd.concat([*a[:7], late, *a[8:]]).sort_values("time", kind="stable")), Tolerances(), {})  # fmt: skip
    assert int(whole.rows_a.kept.sum()) == 60
    assert whole.rows_a.bytes < tally.EVIDENCE_BYTES


def test_every_cause_is_explained():
    assert all(text and not text.endswith(".") for text in CAUSES.values())
