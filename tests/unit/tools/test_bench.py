"""The bench runs every case, tells what it says, and its cases are what they claim to be."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tomllib
from itertools import pairwise
from pathlib import Path

import pytest

import trainctl

FILE = Path(__file__).resolve().parents[3] / "tools" / "bench.py"
spec = importlib.util.spec_from_file_location("bench", FILE)
bench = importlib.util.module_from_spec(spec)
spec.loader.exec_module(bench)


@pytest.mark.parametrize("case", sorted({*bench.IN_SUMO, *bench.NUMERIC} - {"traffic"}))
def test_scenarios_have_the_trains_they_say_on_edges_of_5_km(case):
    text, line = bench.scenario(case, 100, 50)
    data, net = tomllib.loads(text), tomllib.loads(line)
    assert len(data["train"]) == 100
    assert {t["track"] for t in data["train"]} == {1, 2, 3}
    assert net["max_edge_m"] == 5000.0
    assert max(t["position_m"] for t in data["train"]) + 50 * 90 < net["length_m"]


def test_trains_of_the_traffic_case_come_merge_and_couple(tmp_path):
    text, _ = bench.scenario("traffic", 11, 300)
    (tmp_path / "scenario.toml").write_text(text)
    bench.railway(tmp_path, 11)
    run = trainctl.run(tmp_path / "scenario.toml", backend="numeric", out=tmp_path / "run")
    came = {e["train"]: e["time_s"] for e in run.events if e["kind"] == "depart"}
    assert sorted(came, key=int) == [str(k) for k in range(11)]
    assert max(came.values()) <= bench.BEFORE["traffic"]
    pairs = {(int(e["train"]), int(e["ahead"])) for e in run.events if e["kind"] == "couple"}
    assert any((a - b) % 2 for a, b in pairs) and all(a // bench.PER_PIECE == b // bench.PER_PIECE for a, b in pairs)


def test_the_trains_of_the_signalled_cases_are_there_and_obey_or_not(tmp_path):
    """The same trains on the same tracks; nobody stands while time is taken."""
    for case in bench.SIGNALLED:
        folder = tmp_path / case
        folder.mkdir()
        (folder / "scenario.toml").write_text(bench.scenario(case, 8, 820)[0])
        bench.railway(folder, 8, signals=True)
        run = trainctl.run(folder / "scenario.toml", backend="sumo", out=folder / "run")
        came = {e["train"]: e["time_s"] for e in run.events if e["kind"] == "depart"}
        assert len(came) == 8 and max(came.values()) <= bench.BEFORE[case]
        assert not [e for e in run.events if e["kind"] in ("signal", "red_passed", "violation")]
        said = [e["what"] for e in run.events if e["kind"] == "not_followed"]
        assert any("rail signals: not obeyed" in what for what in said) is (case == "ignoring")


def test_ratios_are_those_within_a_pair():
    def result(seconds):
        return {"steps": 10, "seconds": seconds, "cpu": 2.0 * seconds}

    pairs = [{"here": result(a), "there": result(b)} for a, b in ((2.0, 1.0), (3.0, 4.0), (8.0, 10.0))]
    row = bench.paired("loop", 1000, pairs)
    assert (row["ratio"], row["least_ratio"], row["greatest_ratio"], row["cpu_ratio"]) == (0.8, 0.75, 2.0, 0.8)
    assert (row["here_us"], row["there_us"]) == (300.0, 400.0)


def test_two_checkouts_are_compared_each_with_its_own_code(tmp_path):
    here = FILE.parents[1]
    command = [sys.executable, FILE, "--trains", "6", "--only", "supervised", "--repeats", "1", "--json", "--against"]
    done = subprocess.run([*command, here], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    [row] = json.loads(done.stdout)
    assert (row["case"], row["trains"], row["pairs"]) == ("supervised", 6, 1)
    assert 0.2 < row["ratio"] < 5.0
    (tmp_path / "trainctl").mkdir()  # another trainctl: it has no Simulation
    (tmp_path / "trainctl" / "__init__.py").touch()
    done = subprocess.run([*command, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "has no attribute 'Simulation'" in done.stderr


def test_time_inside_a_part_is_not_that_of_the_part_around_it(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(bench.time, "perf_counter", lambda: now[0])
    clock = bench.Clock()
    with clock.part("write"):
        now[0] += 1.0
        with clock.part("step"):
            now[0] += 10.0
        with clock.part("read"):
            now[0] += 100.0
        now[0] += 1000.0
    now[0] += 10_000.0
    assert (clock.spent["write"], clock.spent["step"], clock.spent["read"]) == (1001.0, 10.0, 100.0)


def test_rows_are_medians_per_train_and_step_and_of_ratios_within_a_repeat():
    def result(seconds):
        return {"steps": 10, "seconds": seconds, "cpu": seconds, "parts": {"step": seconds / 2}, "peak_mb": seconds}

    repeats = [{"loop": result(loop), "bare": result(bare)} for loop, bare in ((3.0, 2.0), (1.0, 0.8), (2.0, 0.5))]
    row = bench.row("loop", 100, repeats)
    assert row["us_per_train_step"] == pytest.approx(2000.0)
    assert (row["step_us"], row["read_us"], row["peak_mb"]) == (pytest.approx(1000.0), 0.0, 3.0)
    assert row["times_real_time"] == pytest.approx(5.0)
    assert row["ratio_to_bare"] == row["cpu_ratio_to_bare"] == 1.5
    assert bench.row("loop", 100, [{"loop": result(1.0)}])["ratio_to_bare"] is None


def test_one_command_measures_side_by_side():
    command = [sys.executable, FILE, "--trains", "6", "--only", "bare", "--only", "loop", "--repeats", "1", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = {row["case"]: row for row in json.loads(done.stdout)}
    assert rows["bare"]["ratio_to_bare"] == 1.0
    assert rows["loop"]["ratio_to_bare"] == pytest.approx(
        rows["loop"]["us_per_train_step"] / rows["bare"]["us_per_train_step"], rel=1e-2
    )
    parts = sum(rows["loop"][f"{part}_us"] for part in bench.PARTS)
    assert 0.5 * rows["loop"]["us_per_train_step"] < parts <= 1.01 * rows["loop"]["us_per_train_step"]
    assert all(row["peak_mb"] > 10 for row in rows.values())


def test_reading_logs_is_measured_beside_the_bare_parser():
    command = [sys.executable, FILE, "--logs", "0.5", "--repeats", "1", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = {row["case"]: row for row in json.loads(done.stdout)}
    assert list(rows) == ["regular", "few", "persons", "irregular", "strict", "one_line", "diff"]
    assert all(row["ratio_to_bare"] > 0.0 for name, row in rows.items() if name != "diff")
    assert rows["diff"]["mb"] == pytest.approx(2 * rows["regular"]["mb"], rel=0.1)


def test_runs_side_by_side_are_as_many_train_steps_as_it_says(monkeypatch):
    monkeypatch.syspath_prepend(str(FILE.parent))
    ensembles = importlib.import_module("bench_ensembles")
    monkeypatch.setattr(ensembles, "STEPS", 40)
    found = ensembles.models(3, 0.2, True)
    assert len({p.own.tobytes() for p in found}) == 3
    assert ensembles.together(found) == ensembles.plain(3) == 3 * 6 * 40
    rows = [{"case": "plain", "runs": 3, "million_per_s": 2.0, "us_per_train_step": 0.5, "to_plain": 1.0}, {"to_one": 1.8}]
    assert ensembles.table(rows).splitlines()[-1] == "two processes at once do 1.8 times what one does"


def test_agents_are_measured_beside_the_loop():
    command = [sys.executable, FILE, "--environment", "3", "--repeats", "1", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows = {row["case"]: row for row in json.loads(done.stdout)}
    assert list(rows) == ["vector", "vector_random", "parallel", "reset", "loop", "sumo_vector", "sumo_parallel"]
    assert rows["loop"]["to_loop"] == 1.0 and rows["sumo_vector"]["to_loop"] > 0.0
    assert rows["vector"]["million_per_s"] > rows["sumo_vector"]["million_per_s"] > 0.0


def test_the_country_s_timetable_has_the_trains_it_says_and_all_ways_are_on_its_net(monkeypatch):
    monkeypatch.syspath_prepend(str(FILE.parent))
    country = importlib.import_module("country")
    net = country.plan(country.CORRIDORS)
    rows = country.timetable(net, country.CORRIDORS, country.RUNS, country.DAY_S)
    assert len(rows) == 36_000 and all(a[0] <= b[0] < country.DAY_S for a, b in pairwise(rows))
    edges = {edge for ways in country.routes(country.CORRIDORS).values() for way in ways for edge in way}
    assert edges <= net.length.keys() and sum(edge[0] in "EW" and edge[1] != "L" for edge in edges) == 840  # stations, by direction
    assert any(f"-{edge}" in edges for edge in edges)  # single track


def test_every_train_of_a_small_country_is_accounted_for_and_some_wait_to_enter(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(FILE.parent))
    country, day = (importlib.import_module(name) for name in ("country", "bench_country"))
    country.write(tmp_path, runs=600, corridors=2, day_s=6000.0, first=60, duration_s=3000.0)
    row = day.whole(tmp_path)
    assert row["roster"] == 60 == row["entered"] + row["not_entered"]
    assert row["entered"] == row["arrived"] + row["on_the_way"]
    assert row["arrived"] > 0 and row["stops"] > 100
    assert row["waited_to_enter"] > 0 and row["longest_wait_s"] > 2.0
    assert (row["collisions"], row["gridlocks"]) == (0, 0)


def test_kernels_are_measured_on_six_formations():
    text, line = bench.scenario("finite_time", 12, 10, tracks=6)
    assert [t["track"] for t in tomllib.loads(text)["train"]] == [k for k in range(1, 7) for _ in range(2)]
    assert tomllib.loads(line)["tracks"] == [2, 1, 3, 4, 5, 6]
