"""Recorder and run folder: bytes, kills, folder protocol."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from trainctl.errors import InputError
from trainctl.record.folder import about_run, finish, open_partial, partial_of, write_info
from trainctl.record.recorder import Recorder, standard_tables
from trainctl.runs.run import Run

NAMES = ["1", "2", "10"]
TABLES = standard_tables(NAMES, ["1", "2"], ["a", "b"], watched=["gap_m"])


def record(
    folder: Path, steps: int = 50, cuts: tuple[int, ...] = (), resume: dict | None = None, start: int = 0, segment_groups: int = 2
) -> list[dict]:
    """Record three trains with groups of 16 rows and segments of 2 groups; returns what each cut said."""
    folder.mkdir(exist_ok=True)
    positions = []
    with Recorder(
        folder, TABLES, {"scenario_sha256": "0" * 64}, resume=resume, group_rows=16, segment_groups=segment_groups
    ) as recorder:
        for step in range(start, steps):
            x = np.array([100.0, 50.0, 0.0]) + 10.0 * step
            recorder.write(
                "trains", time_s=float(step), train=[0, 1, 2], track=[0, 1, 0], edge=[0, -1, 1], position_m=x, speed_mps=10.0,
                input_mps2=0.1 * step, spacing_m=[np.nan, 50.0, 50.0], gap_m=np.nan, saturated=[True, False, step % 2 == 0],
                gap_m_min=x - 1, gap_m_max=x + 1,
            )  # fmt: skip
            recorder.write(
                "links", time_s=step, sender=[0, 1], receiver=[1, 2], spacing_m=[50.0, 50.0], desired_m=40.0, lower_m=-np.inf,
                upper_m=90.0, heard=True,
            )  # fmt: skip
            if step % 10 == 0:
                recorder.event(float(step), "topology", links=np.array([[1, 2], [2, 10]]), worst=np.float64("nan"))
            if step in cuts:
                positions.append(recorder.cut())
    return positions


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_two_recordings_are_the_same_bytes_wherever_the_segments_were_cut(tmp_path: Path) -> None:
    record(tmp_path / "a")
    record(tmp_path / "b")
    record(tmp_path / "c", cuts=(0, 1, 7, 30, 49))
    record(tmp_path / "d", segment_groups=100)  # one segment, which becomes the file
    assert contents(tmp_path / "a") == contents(tmp_path / "b") == contents(tmp_path / "c") == contents(tmp_path / "d")
    assert set(contents(tmp_path / "a")) == {"trains.parquet", "links.parquet", "units.parquet", "events.jsonl"}


def test_full_groups_leave_no_empty_one_behind(tmp_path: Path) -> None:
    record(tmp_path, steps=16, cuts=(3,))
    file = pq.ParquetFile(tmp_path / "trains.parquet")
    assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == [16] * 3


def test_what_was_written_is_read_back(tmp_path: Path) -> None:
    record(tmp_path)
    write_info(tmp_path, about_run("", 1, []))
    run = Run(tmp_path)
    assert len(run.trains) == 150
    assert list(run.trains.columns) == list(TABLES["trains"])
    row = run.trains.iloc[-2]
    assert (row.time_s, row.train, row.track, row.position_m, row.speed_mps) == (49.0, "2", "2", 540.0, 10.0)
    assert run.trains.edge.isna().sum() == 50
    assert run.trains.saturated.sum() == 75
    assert run.links.lower_m.eq(-np.inf).all()
    assert run.units.empty
    assert run.events[1] == {"time_s": 10.0, "kind": "topology", "links": [[1, 2], [2, 10]], "worst": None}


def test_parquet_layout(tmp_path: Path) -> None:
    record(tmp_path)
    file = pq.ParquetFile(tmp_path / "trains.parquet")
    assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == [16] * 9 + [6]
    assert file.schema_arrow.metadata[b"schema_version"] == b"1"
    group = file.metadata.row_group(0)
    kinds = {group.column(k).path_in_schema: group.column(k) for k in range(group.num_columns)}
    assert all(column.compression == "ZSTD" for column in kinds.values())
    assert "BYTE_STREAM_SPLIT" in kinds["position_m"].encodings
    assert not kinds["position_m"].has_dictionary_page
    assert kinds["train"].has_dictionary_page
    assert kinds["train"].physical_type == "BYTE_ARRAY"


class Killed(Recorder):
    """A recorder whose process dies when it would close."""

    def close(self) -> None:
        os._exit(9)


def test_a_killed_run_is_readable_to_its_last_cut_and_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    record(tmp_path / "whole")
    killed = tmp_path / "killed"
    script = f"""
import json, pathlib, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_recorder as here
here.Recorder = here.Killed
cut = here.Recorder.cut
here.Recorder.cut = lambda self: pathlib.Path({str(tmp_path / "cut.json")!r}).write_text(json.dumps(cut(self)))
here.record(pathlib.Path({str(killed)!r}), steps=40, cuts=(20,))
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, "-c", script], env=environment, check=False).returncode == 9
    write_info(killed, about_run("", 1, []))
    run = Run(killed)
    assert list(run.trains.time_s[::3]) == list(range(32))  # 33 rows in a full segment, 30 to the cut, 33 in the next
    assert run.events[-1]["time_s"] == 30.0
    (killed / "run.json").unlink()
    position = json.loads((tmp_path / "cut.json").read_text())
    shutil.copytree(killed, tmp_path / "copy")
    with Recorder(tmp_path / "copy", TABLES, resume=position):  # what was recorded after the cut is gone at once
        left = {path.name for path in (tmp_path / "copy" / "segments").iterdir()}
        assert left == {f"{name}-{k:05d}.parquet" for name, sums in position["segments"].items() for k in range(len(sums))}
    record(killed, start=21, resume=position)
    assert contents(killed) == contents(tmp_path / "whole")


def test_when_the_disk_is_full_all_but_the_last_segment_is_kept(tmp_path: Path) -> None:
    """A limit on file sizes stands for the full disk: writing beyond it fails in the same way."""
    noise = np.random.default_rng(0).random(40_000)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    recorder = Recorder(tmp_path, {"t": {"time_s": "float"}}, group_rows=1000)
    recorder.write("t", time_s=noise[:5000])
    recorder.cut()
    recorder.event(1.0, "kept")
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
        with pytest.raises(OSError), recorder:  # closing fails, too: that does not hide the first failure
            recorder.write("t", time_s=noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    write_info(tmp_path, about_run("", 1, []))
    assert np.array_equal(Run(tmp_path).table("t").time_s, noise[:5000])
    assert [event["kind"] for event in Run(tmp_path).events] == ["kept"]
    assert not list(tmp_path.rglob("*.open"))


def test_wrong_columns_are_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path, {"t": {"time_s": "float", "train": NAMES}}) as recorder:
        with pytest.raises(ValueError, match="train"):
            recorder.write("t", time_s=1.0)
        with pytest.raises(ValueError, match="different lengths"):
            recorder.write("t", time_s=[1.0, 2.0], train=[0, 1, 2])


def finished(folder: Path, text: str) -> None:
    partial = open_partial(folder)
    write_info(partial, about_run("", 1, ["trainctl"]))
    (partial / "note").write_text(text)
    finish(folder)


def test_a_finished_run_of_ours_is_replaced_only_at_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    finished(folder, "old")
    partial = open_partial(folder)
    assert partial == partial_of(folder)
    assert not any(partial.iterdir())
    assert (folder / "note").read_text() == "old"
    write_info(partial, about_run("", 1, []))
    finish(folder)
    assert not (folder / "note").exists()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run"]


def test_anything_else_is_refused_unless_forced(tmp_path: Path) -> None:
    folder = tmp_path / "thesis"
    folder.mkdir()
    open_partial(folder)  # empty: fine
    (folder / "chapter.tex").write_text("x")
    with pytest.raises(InputError, match="not a run of trainctl"):
        open_partial(folder)
    assert (folder / "chapter.tex").exists()
    partial = open_partial(folder, force=True)
    assert (folder / "chapter.tex").exists()
    write_info(partial, about_run("", 1, []))
    finish(folder)
    assert not (folder / "chapter.tex").exists()


def test_the_current_directory_is_never_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for place in (tmp_path, tmp_path.parent, Path("/")):
        with pytest.raises(InputError, match="current directory"):
            open_partial(place, force=True)


def test_a_foreign_partial_and_an_unwritable_place_are_refused(tmp_path: Path) -> None:
    (tmp_path / "run.partial").mkdir()
    (tmp_path / "run.partial" / "mine").write_text("x")
    with pytest.raises(InputError, match=r"run\.partial: exists"):
        open_partial(tmp_path / "run")
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="cannot be written"):
        open_partial(tmp_path / "file" / "run")


def read_all(folder: Path) -> tuple[object, ...]:
    run = Run(folder)
    return run.trains, run.links, run.events, run.scenario


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda d: (d / "run.json").unlink(), "not a run folder"),
        (lambda d: (d / "run.json").write_text("{"), "not JSON"),
        (lambda d: (d / "run.json").write_text('{"format": "other"}'), "not a run of trainctl"),
        (lambda d: (d / "run.json").write_text('{"format": "trainctl run", "schema_version": 99}'), "schema_version = 99"),
        (lambda d: (d / "trains.parquet").unlink(), "trains.parquet is missing"),
        (lambda d: (d / "trains.parquet").write_bytes((d / "trains.parquet").read_bytes()[:-20]), "not a complete Parquet"),
        (lambda d: (d / "events.jsonl").write_text('{"kind": 3}\n'), "line 1 is not an event"),
        (lambda d: (d / "scenario.toml").write_text("a = ["), "scenario.toml"),
    ],
)
def test_damaged_run_folders_give_one_clear_line(tmp_path: Path, spoil, words: str) -> None:  # type: ignore[no-untyped-def]
    record(tmp_path, steps=3)
    write_info(tmp_path, about_run("", 1, []))
    (tmp_path / "scenario.toml").write_text("")
    spoil(tmp_path)
    with pytest.raises(InputError, match=words) as caught:
        read_all(tmp_path)
    assert "\n" not in str(caught.value)
