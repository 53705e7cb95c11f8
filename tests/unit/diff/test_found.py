"""What fuzzing has found: damaged input that ended in a traceback, now one line each."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from sumo_net import Line, LineError
from trainctl.diff.runs import diff
from trainctl.errors import InputError
from trainctl.metrics.run import metrics
from trainctl.metrics.traffic import metrics_of_fcd
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario


@pytest.fixture
def folder(finished, tmp_path):
    return Path(shutil.copytree(finished("three_tracks", "numeric", **{"run.duration_s": 8}).folder, tmp_path / "run"))


def rewritten(file, change):
    pq.write_table(change(pq.read_table(file)), file)


def without(name):
    return lambda table: table.drop_columns([name])


def doubled(name):
    return lambda table: table.append_column(name, table[name])


def texts(name):
    return lambda table: table.set_column(table.column_names.index(name), name, pa.array(["2020-01-01"] * table.num_rows))


def number(name, value):
    def change(table):
        values = table[name].to_pylist()
        values[3] = value
        return table.set_column(table.column_names.index(name), name, pa.array(values, table.schema.field(name).type))

    return change


def row_twice(table):
    return pa.concat_tables([table.slice(0, 3), table.slice(2, 1), table.slice(3)])


CASES = {
    "column missing": ("trains", without("time_s"), "trains: has no column time_s"),
    "key missing": ("units", without("unit"), "units: has no column unit"),
    "link column missing": ("links", without("lower_m"), "links: has no column lower_m"),
    "column twice": ("links", doubled("desired_m"), "links: a column appears more than once"),
    "texts for numbers": ("trains", texts("speed_mps"), "trains.speed_mps: must be numbers, not string"),
    "number missing": ("links", number("spacing_m", None), "links.spacing_m: a number is missing"),
    "number not finite": ("trains", number("position_m", float("nan")), "trains.position_m: a number is missing or not finite"),
    "number beyond reason": ("units", number("force_n", 1e300), "units.force_n: a number is beyond 1e+60"),
    "row twice": ("trains", row_twice, "trains: two rows of one train at 0 s"),
    "rows out of order": ("trains", lambda t: pa.concat_tables([t.slice(12), t.slice(0, 12)]), "trains: time does not ascend"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_damaged_table_of_a_run(folder, case):
    table, change, words = CASES[case]
    rewritten(folder / f"{table}.parquet", change)
    with pytest.raises(InputError) as told:
        metrics(Run(folder))
    assert words in str(told.value)


def test_a_run_as_recorded_passes(folder):
    assert metrics(Run(folder))["run.trains"] == 6


def test_mistakes_are_printable_lines(tmp_path):
    assert InputError("a\nb\x1b[31m").mistakes == ["a\\nb\\x1b[31m"]
    assert LineError(["a\nb\x00"]).mistakes == ["a\\nb\\x00"]


def test_an_fcd_log_with_a_column_twice(tmp_path):
    row = {"timestep_time": [0.0], "vehicle_id": ["a"], "vehicle_speed": [1.0]}
    table = pa.table(row).append_column("vehicle_speed", pa.array([1.0]))
    pq.write_table(table, tmp_path / "fcd.parquet")
    for function in (metrics_of_fcd, lambda path: diff(path, path)):
        with pytest.raises(InputError, match="more than once"):
            function(tmp_path / "fcd.parquet")


def test_an_encoding_that_is_none(tmp_path):
    (tmp_path / "x.net.xml").write_text('<?xml version="1.0" encoding="point"?>\n<net/>')
    with pytest.raises(LineError, match="unknown encoding"):
        Line.read(tmp_path / "x.net.xml")


def test_a_number_against_nothing(tmp_path):
    log = '<tripinfos><tripinfo id="a" duration="{}"/><tripinfo id="b" duration="2"/></tripinfos>'
    (tmp_path / "a.xml").write_text(log.format("1"))
    (tmp_path / "b.xml").write_text(log.format(""))
    report = diff(tmp_path / "a.xml", tmp_path / "b.xml")
    column = report.tables[0].columns["duration"]
    assert (column.first.a, column.first.b, column.first.difference) == (1.0, None, float("inf"))
    json.dumps(report.as_dict())


SCENARIOS = {
    "a number too great to compute with": ("bounds", "speed_upper_mps = 1e300", "bounds.speed_upper_mps = 1e+300: beyond 1e+15"),
    "an integer too great for a float": ("bounds", f"speed_upper_mps = {10**400}", "beyond 1e+15"),
    "an integer too great to be read": ("bounds", f"speed_upper_mps = {'9' * 5000}", "not a TOML file"),
    "a train that is beyond the line when it is rerouted": (
        "topology", 'weight = 1.0\n[[event]]\nkind = "reroute"\ntrain = 2\nto_track = 3\ntime_s = 100000', "no crossover from track 1 to it",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SCENARIOS)
def test_a_scenario_that_broke_the_check(tmp_path, case):
    table, text, words = SCENARIOS[case]
    (tmp_path / "s.toml").write_text(f'extends = "fully_distributed"\n[{table}]\n{text}\n')
    with pytest.raises(InputError) as told:
        open_scenario(str(tmp_path / "s.toml"))
    assert any(words in line for line in told.value.mistakes), told.value.mistakes


def test_a_seed_may_be_a_great_number(tmp_path):
    (tmp_path / "s.toml").write_text(f'extends = "fully_distributed"\n[run]\nseed = {10**18}\n')
    assert open_scenario(str(tmp_path / "s.toml")).scenario.run.seed == 10**18
