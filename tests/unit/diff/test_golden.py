"""Goldens: thinned runs that later runs must match; and streams that stay in step."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from trainctl.diff.findings import short
from trainctl.diff.golden import accept
from trainctl.diff.rows import compare
from trainctl.diff.runs import EXACT, Tolerances, diff
from trainctl.diff.sources import Log
from trainctl.errors import InputError
from trainctl.runs.run import Run
from trainctl.testing import assert_run_matches, make_golden


@pytest.fixture
def run(finished):
    return finished("three_tracks", "numeric", **{"run.duration_s": 40})


@pytest.fixture
def golden(run, tmp_path):
    return make_golden(run, tmp_path / "golden", every_s=10.0)


def altered(run, place, time, train):
    copy = Path(shutil.copytree(run.folder, place))
    frame = pq.read_table(copy / "trains.parquet").to_pandas()
    frame.loc[(frame.time_s == time) & (frame.train == train), "speed_mps"] += 0.01
    pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), copy / "trains.parquet")
    return copy


def test_a_run_matches_its_golden_exactly(run, golden):
    report = assert_run_matches(run, golden, EXACT)
    assert {t.table: t.rows for t in report.tables}["trains"] == 5 * 6
    assert Run(golden).info["thinned"] == ["trains", "links", "units", "fcd"]


def test_a_golden_has_no_clock_in_it(run, golden, tmp_path):
    again = make_golden(run.folder, tmp_path / "again", every_s=10.0)
    files = [p.relative_to(golden) for p in golden.rglob("*") if p.is_file()]
    assert files
    assert "files" not in Run(golden).info
    assert all((golden / f).read_bytes() == (again / f).read_bytes() for f in files)


def test_a_change_at_a_kept_instant_is_located(run, golden, tmp_path):
    with pytest.raises(AssertionError, match=r"first: trains: 20 s, train 4: speed_mps .* \(by 0.01\)"):
        assert_run_matches(altered(run, tmp_path / "b", 20.0, "4"), golden)
    assert_run_matches(altered(run, tmp_path / "c", 20.0, "4"), golden, {"columns": {"speed_mps": 0.011}})
    assert_run_matches(altered(run, tmp_path / "d", 21.0, "4"), golden)


def test_a_golden_given_second_is_told(run, golden):
    assert diff(golden, run.folder).notes == []
    assert [note for note in diff(run.folder, golden).notes if "golden" in note] == [
        f"{short(str(golden))} is a golden, which holds some instants only: give it first"
    ]


def test_rows_that_are_missing_at_a_kept_instant_are_told(run, golden, tmp_path):
    copy = Path(shutil.copytree(run.folder, tmp_path / "b"))
    table = pq.read_table(copy / "trains.parquet")
    pq.write_table(table.slice(0, 25 * 6), copy / "trains.parquet")
    with pytest.raises(AssertionError, match="trains: 12 rows only in A, first 30 s, train 1"):
        assert_run_matches(copy, golden)


def test_only_a_complete_run_becomes_a_golden(run, tmp_path):
    copy = Path(shutil.copytree(run.folder, tmp_path / "b"))
    text = (copy / "run.json").read_text()
    (copy / "run.json").write_text(text.replace('"complete"', '"failed"'))
    with pytest.raises(InputError, match="only a complete run"):
        make_golden(copy, tmp_path / "golden")


def test_a_golden_replaces_goldens_only(run, golden, tmp_path):
    (tmp_path / "thesis").mkdir()
    make_golden(run, tmp_path / "thesis")  # empty: nothing is lost
    (tmp_path / "text").mkdir()
    (tmp_path / "text" / "mine").touch()
    with pytest.raises(InputError, match="text: is no golden"):
        make_golden(run, tmp_path / "text")
    whole = Path(shutil.copytree(run.folder, tmp_path / "whole"))
    with pytest.raises(InputError, match="whole: is no golden"):
        make_golden(golden, whole)  # exchanged: the run would be lost
    assert assert_run_matches(whole, run.folder, EXACT).same


def test_a_run_is_accepted_unless_notes_would_be_lost(run, tmp_path):
    old, new = (Path(shutil.copytree(run.folder, tmp_path / name)) for name in "ab")
    (old / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds notes\.txt beside its run: nothing was accepted"):
        accept(old, new)
    assert (old / "notes.txt").exists()
    (old / "notes.txt").unlink()
    (new / "events.jsonl").write_text("")
    accept(old, new)
    assert (old / "events.jsonl").read_text() == ""


def test_a_golden_that_fails_leaves_the_old_one(golden, tmp_path):
    before = sorted(tmp_path.rglob("*"))
    (tmp_path / "cut.xml").write_text('<fcd-export><timestep time="0"><vehicle id="a" speed="1"/>')
    for place in (golden, tmp_path / "new"):
        with pytest.raises(InputError, match="not well-formed"):
            make_golden(tmp_path / "cut.xml", place)
    assert sorted(tmp_path.rglob("*")) == sorted([*before, tmp_path / "cut.xml"])


def test_streams_are_read_in_step(monkeypatch):
    """However many batches there are, neither log is ever more than a few ahead of what was compared."""
    open_batches = {"a": 0, "b": 0}
    most = []

    def log(name, rows):
        def batches():
            for k in range(200):
                open_batches[name] += 1
                most.append(abs(open_batches["a"] / 3 - open_batches["b"]) if name == "a" else 0)
                times = [float(k * rows + j) for j in range(rows)]
                yield pa.table({"time": times, "id": ["x"] * rows, "speed": times})

        return Log("fcd", name, "time", ("id",), batches)

    # b has three times as many instants in a batch as a
    found = compare(log("a", 10), log("b", 30), Tolerances(), {})
    assert (found.rows, found.missing.count, found.extra.count) == (2000, 0, 4000)
    assert max(most) < 3


GENERATE = """
import sys
with open(sys.argv[1], "w") as f:
    f.write("<fcd-export>")
    for t in range(int(sys.argv[2])):
        f.write(f'<timestep time="{t}.00">')
        f.writelines(f'<vehicle id="t{i}" x="{80 * t + i}.25" speed="80.00" pos="{80 * t % 9000}.50" lane="e_0"/>' for i in range(1000))
        f.write("</timestep>")
    f.write("</fcd-export>")
"""
MEASURE = """
import re, sys
from pathlib import Path
from trainctl.diff.runs import diff
assert diff(sys.argv[1], sys.argv[2]).same
status = Path("/proc/self/status").read_text()  # ru_maxrss is at least that of the process that started this one
print(int(re.search(r"VmHWM:\\s+(\\d+)", status)[1]) // 1024)
"""


@pytest.mark.campaign
def test_memory_does_not_grow_with_the_logs(tmp_path):
    used = []
    for steps in (400, 4000):
        for name in "ab":
            subprocess.run([sys.executable, "-c", GENERATE, tmp_path / name, str(steps)], check=True)
        done = subprocess.run([sys.executable, "-c", MEASURE, tmp_path / "a", tmp_path / "b"], capture_output=True, check=True)
        used.append(int(done.stdout))
    assert used[1] < 500
    assert used[1] < used[0] + 50
