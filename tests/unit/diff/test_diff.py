"""Comparing runs and logs: each kind of change is found and located, and nothing else is."""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess
import sys
from pathlib import Path

import nets
import numpy as np
import pyarrow as pa
import pyarrow.csv as pc_csv
import pyarrow.parquet as pq
import pytest
import tomli_w

from trainctl.diff.golden import make_golden
from trainctl.diff.rows import compare
from trainctl.diff.runs import EXACT, Tolerance, Tolerances, diff, parse_tolerances, read_tolerances
from trainctl.diff.sources import Log
from trainctl.errors import InputError
from trainctl.runs.run import Run
from trainctl.scenario.reading import read

LOSS = ("fully_distributed_loss", "numeric")
SHORT = {"run.duration_s": 60}


@pytest.fixture
def run(finished):
    return finished(*LOSS, **SHORT).folder


@pytest.fixture
def copy(run, tmp_path):
    return Path(shutil.copytree(run, tmp_path / "copy"))


def changed(path, change):
    """Rewrite a Parquet file; ``change`` gets its DataFrame."""
    frame = pq.read_table(path).to_pandas()
    change(frame)
    pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), path)


def test_a_rerun_is_clean_without_any_tolerance(finished, run, tmp_path):
    from trainctl.runner import run as again
    from trainctl.scenario.build import open_scenario

    rerun = again(open_scenario(LOSS[0], SHORT), tmp_path / "again", "numeric").folder
    report = diff(run, rerun, EXACT)
    assert report.same, report.lines()
    assert {t.table: t.rows for t in report.tables}["trains"] == 61 * 6
    assert report.notes == ["backend numeric -> numeric"] or report.notes == []


def test_one_altered_row_is_located(run, copy):
    def alter(frame):
        row = frame.index[(frame.time_s == 17.0) & (frame.train == "3")][0]
        frame.loc[row, "input_mps2"] += 2e-3

    changed(copy / "trains.parquet", alter)
    report = diff(run, copy)
    assert not report.same
    (table,) = [t for t in report.tables if not t.same]
    (column,) = table.columns.values()
    assert (table.table, column.column, column.differing) == ("trains", "input_mps2", 1)
    assert (column.first.time_s, column.first.who) == (17.0, "train 3")
    assert column.largest.difference == pytest.approx(2e-3)
    assert report.first.startswith("trains: 17 s, train 3: input_mps2 ")
    assert diff(run, copy, Tolerances(Tolerance(3e-3))).same


def test_a_delay_at_a_stop_is_located(tmp_path):
    from trainctl.runner import run as again
    from trainctl.scenario.build import open_scenario

    nets.station(tmp_path)
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 400)))
    one = again(open_scenario(str(tmp_path / "s.toml")), tmp_path / "one", "numeric").folder
    copy = Path(shutil.copytree(one, tmp_path / "copy"))
    assert diff(one, copy, EXACT).same
    changed(copy / "stops.parquet", lambda frame: frame.__setitem__("arrival_s", frame.arrival_s + 2.0))
    report = diff(one, copy)
    (table,) = [t for t in report.tables if not t.same]
    (column,) = table.columns.values()
    assert (table.table, column.column, column.differing) == ("calls", "arrival_s", 1)  # the other one has not come
    assert report.first is not None and report.first.startswith("calls: train stops, number 1: arrival_s ")
    assert diff(make_golden(one, tmp_path / "golden"), one).same
    assert not diff(make_golden(one, tmp_path / "kept"), copy).same
    (copy / "stops.parquet").unlink()
    assert diff(one, copy).files == ["stops: only in A"]


def test_a_changed_seed_is_located(finished, run):
    other = finished(*LOSS, **SHORT, **{"run.seed": 2})
    report = diff(run, other.folder)
    assert ("seed", 1, 2) in report.settings
    links = next(t for t in report.tables if t.table == "links")
    mine = Run(run).links
    assert links.columns["heard"].first.time_s == mine.time_s[mine.heard != other.links.heard].min()
    assert "sender" in links.columns["heard"].first.who


def test_a_perturbed_law_is_located(finished):
    """Feedback gain of the robust law +1 %."""
    a = finished("robust_constrained_undisturbed", "numeric", **{"run.duration_s": 80}).folder
    b = finished("robust_constrained_undisturbed", "numeric", **{"run.duration_s": 80, "controller.h_per_s": 0.303}).folder
    report = diff(a, b)
    assert ("scenario.controller.h_per_s", 0.3, 0.303) in report.settings
    trains = next(t for t in report.tables if t.table == "trains")
    assert trains.columns["input_mps2"].first.time_s < 5.0
    assert trains.columns["position_m"].largest.difference > 0.01
    assert report.first.startswith("trains: ")


def renamed_scenario(tmp_path):
    """The scenario with another name for train 2, wherever it stands; without losses, which are drawn by name."""
    data, _ = read("fully_distributed_loss")
    data["topology"]["loss"] = 0.0

    def renamed(value, key=""):
        if isinstance(value, dict):
            return {k: renamed(v, k) for k, v in value.items()}
        if isinstance(value, list):
            return [renamed(v, key) for v in value]
        return "express" if key in ("id", "train", "between") and value == 2 else value

    path = tmp_path / "renamed.toml"
    path.write_text(tomli_w.dumps(renamed(data | {"run": data["run"] | {"duration_s": 60}})))
    return path


def test_a_renamed_train_is_the_only_difference(finished, tmp_path):
    plain = finished(*LOSS, **SHORT, **{"topology.loss": 0.0}).folder
    report = diff(plain, finished(str(renamed_scenario(tmp_path)), "numeric").folder)
    assert report.renamed == {"2": "express"}
    assert not report.same
    assert all(t.same for t in report.tables), report.lines()
    assert [key for key, *_ in report.settings if not key.endswith((".id", ".train"))] == []


def test_missing_and_extra_rows_are_counted_and_located(run, copy):
    frame = pq.read_table(copy / "trains.parquet").to_pandas()
    frame = frame[~((frame.time_s >= 20) & (frame.time_s < 25) & (frame.train == "4"))]
    pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), copy / "trains.parquet")
    table = next(t for t in diff(run, copy).tables if t.table == "trains")
    assert (table.missing.count, table.missing.first_time_s, table.missing.first_who) == (5, 20.0, "train 4")
    back = next(t for t in diff(copy, run).tables if t.table == "trains")
    assert (back.extra.count, back.missing.count) == (5, 0)


def test_versions_are_notes(run, copy):
    info = json.loads((copy / "run.json").read_text())
    info["versions"]["sumo"] = "1.29.0"
    (copy / "run.json").write_text(json.dumps(info))
    report = diff(run, copy)
    assert report.same
    assert "sumo 1.28.0 -> 1.29.0" in report.notes


def test_a_run_that_failed_differs(run, copy):
    info = json.loads((copy / "run.json").read_text()) | {"status": "failed"}
    (copy / "run.json").write_text(json.dumps(info))
    assert ("status", "complete", "failed") in diff(run, copy).settings


def test_rows_may_stand_in_another_order_within_an_instant(run, copy):
    frame = pq.read_table(copy / "trains.parquet").to_pandas().sort_values(["time_s", "train"], ascending=[True, False])
    pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), copy / "trains.parquet")
    assert diff(run, copy, EXACT).same


def test_a_number_that_became_nan_or_infinite_differs(run, copy):
    for value in (np.nan, np.inf):

        def alter(frame, value=value):
            frame.loc[frame.index[(frame.time_s == 30.0)][0], "speed_mps"] = value

        changed(copy / "trains.parquet", alter)
        column = next(t for t in diff(run, copy).tables if t.table == "trains").columns["speed_mps"]
        assert (column.first.time_s, column.largest.difference) == (30.0, np.inf)


# Logs of SUMO's


def fcd(times=range(50), trains=("a", "b", "c"), digits=2, alter=None, header=""):
    lines = [f"<!-- generated on {header} by Eclipse SUMO sumo 1.28.0\n-->", "<fcd-export>"]
    for t in times:
        lines.append(f'<timestep time="{t:.2f}">')
        for k, name in enumerate(trains):
            speed = 20 + k + t / 10 + (0.5 if alter == (t, name) else 0)
            lines.append(f'<vehicle id="{name}" speed="{speed:.{digits}f}" pos="{t * 2.5137:.{digits}f}" lane="{k}_1_0"/>')
        lines.append("</timestep>")
    return "\n".join([*lines, "</fcd-export>"])


@pytest.fixture
def logs(tmp_path):
    """Write FCD logs of all formats: logs("b.csv", trains=...)."""

    def write(name, **how):
        path, text = tmp_path / name, fcd(**how)
        if ".xml" in name:
            body = text.encode()
        else:
            (tmp_path / "tmp.xml").write_text(text)
            from trainctl.diff.sources import sumo_log

            table = pa.concat_tables(sumo_log(tmp_path / "tmp.xml").batches())
            names = {"time": "timestep_time", **{n: f"vehicle_{n}" for n in ("id", "speed", "pos", "lane")}}
            table = table.rename_columns([names[n] for n in table.column_names])
            if "parquet" in name:
                table = table.set_column(2, "vehicle_speed", table["vehicle_speed"].cast(pa.float32()))
                pq.write_table(table, path)
                return path
            out = pa.BufferOutputStream()
            pc_csv.write_csv(table, out, pc_csv.WriteOptions(delimiter=";", quoting_style="none"))
            body = out.getvalue().to_pybytes()
        path.write_bytes(gzip.compress(body) if name.endswith(".gz") else body)
        return path

    return write


FORMATS = ["a.xml", "a.xml.gz", "a.csv", "a.csv.gz", "a.parquet"]


@pytest.mark.parametrize("name", FORMATS)
def test_all_formats_hold_the_same_rows(logs, name):
    report = diff(logs("reference.xml", header="2026"), logs(name, header="2027"))
    assert report.same, report.lines()
    assert report.tables[0].rows == 150
    assert report.notes == []


@pytest.mark.parametrize("name", FORMATS)
def test_an_altered_row_is_located_in_all_formats(logs, name):
    report = diff(logs("reference.xml"), logs(name, alter=(31, "b")))
    (column,) = report.tables[0].columns.values()
    assert (column.column, column.differing, column.first.time_s, column.first.who) == ("speed", 1, 31.0, "id b")
    assert column.largest.difference == pytest.approx(0.5, abs=1e-5)


def test_a_log_is_not_held_to_more_decimals_than_it_has(logs):
    fine, coarse = logs("fine.xml", digits=6), logs("coarse.xml", digits=2)
    assert diff(fine, coarse).same
    assert not diff(fine, coarse, Tolerances(Tolerance(1e-3, stated=True))).same
    assert not diff(fine, coarse, EXACT).same


def test_a_renamed_vehicle_of_a_bare_log(logs):
    report = diff(logs("a.xml"), logs("b.csv", trains=("a", "x", "c")))
    assert report.renamed == {"b": "x"}
    assert report.tables[0].same


def test_logs_of_different_length(logs):
    a, b = logs("a.xml"), logs("b.xml", times=range(10, 60))
    table = diff(a, b).tables[0]
    assert (table.rows, table.missing.count, table.missing.first_time_s) == (120, 30, 0.0)
    assert (table.extra.count, table.extra.first_time_s) == (30, 50.0)


def test_a_rare_row_twice_and_attributes_that_come_late(logs, tmp_path):
    text = fcd().replace(
        '<timestep time="40.00">', '<timestep time="40.00"><vehicle id="a" speed="1.00" pos="2" lane="0" signals="8"/>'
    )
    (tmp_path / "b.xml").write_text(text)
    report = diff(logs("a.xml"), tmp_path / "b.xml")
    assert report.tables[0].extra.count == 1
    assert "fcd.signals: only in B" in report.notes or "speed" in report.tables[0].columns


def test_only_clocks_differ_in_statistics(tmp_path):
    for name, clock in (("a", 1.5), ("b", 2.5)):
        (tmp_path / f"{name}.xml").write_text(
            f'<statistics><performance clockBegin="{clock}" clockDuration="{clock}" realTimeFactor="{clock}" end="5.00"/>'
            '<teleports total="0"/></statistics>'
        )
        (tmp_path / f"s{name}.xml").write_text(f'<summary><step time="0.00" running="1" duration="{int(clock)}"/></summary>')
    assert diff(tmp_path / "a.xml", tmp_path / "b.xml", EXACT).same
    assert diff(tmp_path / "sa.xml", tmp_path / "sb.xml", EXACT).same


def test_tripinfo_is_matched_by_vehicle_with_what_is_inside(tmp_path):
    row = '<tripinfo id="{}" duration="{}" arrivalLane=""><emissions CO_abs="{}"/></tripinfo>'
    (tmp_path / "a.xml").write_text(f"<tripinfos>{row.format('x', '10.00', 1)}{row.format('y', '11.00', 2)}</tripinfos>")
    (tmp_path / "b.xml").write_text(f"<tripinfos>{row.format('y', '11.00', 5)}{row.format('x', '10.00', 1)}</tripinfos>")
    (table,) = diff(tmp_path / "a.xml", tmp_path / "b.xml").tables
    (column,) = table.columns.values()
    assert (column.column, column.first.who, column.largest.difference) == ("emissions_CO_abs", "id y", 3.0)


def test_names_that_look_like_numbers_are_names(tmp_path):
    for name, lane in (("a", "1000000"), ("b", "1000001")):
        (tmp_path / f"{name}.xml").write_text(fcd(times=[0], trains=("a",)).replace('lane="0_1_0"', f'lane="{lane}"'))
    assert not diff(tmp_path / "a.xml", tmp_path / "b.xml", Tolerances(Tolerance(10.0))).same


def test_a_step_without_vehicles_is_no_row(tmp_path):
    for name, ids in (("a", ["x", None, "x"]), ("b", ["x", "x"])):
        times = [0.0, 1.0, 2.0] if name == "a" else [0.0, 2.0]
        table = pa.table({"timestep_time": times, "vehicle_id": ids, "vehicle_speed": [1.0] * len(ids)})
        pq.write_table(table, tmp_path / f"{name}.parquet")
    report = diff(tmp_path / "a.parquet", tmp_path / "b.parquet")
    assert report.same, report.lines()


@pytest.mark.parametrize("gaps", [(0.1, 0.5, 0.2), (0.5, 0.1, 0.2), (0.1, 0.2, 0.5)])
def test_the_largest_difference_of_all_pieces_is_kept(gaps):
    def log(name, by):
        def batches():
            for k, gap in enumerate(by):
                yield pa.table({"time": [float(k), k + 0.5], "id": ["x", "x"], "speed": [1.0, 1.0 + gap]})

        return Log("fcd", name, "time", ("id",), batches)

    column = compare(log("a", (0.0, 0.0, 0.0)), log("b", gaps), Tolerances(), {}).columns["speed"]
    assert column.largest.difference == pytest.approx(0.5)
    assert column.largest.time_s == gaps.index(0.5) + 0.5
    assert (column.first.time_s, column.differing) == (0.5, 3)


# Tolerances and the command


def test_tolerances_of_a_file(tmp_path):
    (tmp_path / "t.toml").write_text('absolute = 1e-3\n[columns]\nspeed = 0.6\nfcd.pos = "ignore"\nx = {relative = 0.1}\n')
    found = read_tolerances(tmp_path / "t.toml")
    assert found.of("fcd", "speed") == Tolerance(0.6, 0.0, False, True)
    assert found.of("fcd", "pos").ignore
    assert found.of("other", "pos") == Tolerance(1e-3, 0.0, False, True)
    assert found.of("any", "x").relative == 0.1


@pytest.mark.parametrize("table, words", [
    ({"columns": {"speed": -1}}, "columns.speed = -1: must be a number, at least 0"),
    ({"columns": {"speed": {"absolut": 1}}}, "columns.speed.absolut = 1: must be absolute, relative, range, time_s, time_relative, time_range or ignore"),
    ({"absolute": "1"}, "absolute = 1: must be a number"),
    ({"collumns": {}}, "collumns: unknown key"),
    ({"columns": 3}, "columns = 3: must be a table"),
])  # fmt: skip
def test_mistaken_tolerances_are_told(table, words):
    with pytest.raises(InputError, match="tolerances: ") as told:
        parse_tolerances(table)
    assert words in str(told.value)


def test_a_tolerance_of_no_column_is_told(logs):
    report = diff(logs("a.xml"), logs("b.xml"), parse_tolerances({"columns": {"sped": 1.0}}))
    assert report.notes == ["tolerance of sped: no such column was compared"]


BIN = Path(sys.executable).parent / "trainctl"


def test_exit_codes_and_json(logs):
    a, b = logs("a.xml"), logs("b.parquet", alter=(7, "c"))

    def typed(*arguments):
        return subprocess.run([BIN, "diff", *map(str, arguments)], capture_output=True, text=True, check=False)

    assert typed(a, a, "--zero").returncode == 0
    told = typed(a, b)
    assert (told.returncode, "first difference: fcd: 7 s, id c: speed 22.7 -> 23.2" in told.stdout) == (1, True)
    found = json.loads(typed(a, b, "--json").stdout)
    assert found["tables"][0]["columns"][0]["largest"]["time_s"] == 7.0
    bad = typed(a, a.with_name("gone.xml"))
    assert (bad.returncode, bad.stderr.count("\n")) == (2, 1)


BOMB = '<!DOCTYPE x [<!ENTITY a "{}"><!ENTITY b "{}">]><fcd-export><timestep time="&b;"/></fcd-export>'


@pytest.mark.parametrize("text", [
    BOMB.format("a" * 1000, "&a;" * 1000), "", "<", "<fcd-export>", "no log", "<net/>", "PAR1", "a;b\n1;2",
    '<fcd-export><timestep time="nan"><vehicle id="a" speed="1"/></timestep></fcd-export>',
    '<fcd-export><vehicle id="a" speed="1"/></fcd-export>', "\x1f\x8bnot gzip",
])  # fmt: skip
def test_what_is_no_log_is_one_line(tmp_path, logs, text):
    bad = tmp_path / "bad.xml"
    bad.write_text(text, encoding="latin-1")
    if text == "":
        assert diff(bad, logs("a.xml")).tables[0].extra.count == 150
        return
    with pytest.raises(InputError) as told:
        diff(logs("a.xml"), bad)
    assert len(told.value.mistakes) == 1
    assert str(bad) in str(told.value)
