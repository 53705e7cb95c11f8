"""Metrics against values computed by hand on logs of a few rows."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w

from trainctl.cli.program import settling
from trainctl.errors import InputError
from trainctl.metrics.run import DEFINITIONS, metrics
from trainctl.metrics.traffic import metrics_of_fcd
from trainctl.metrics.values import base
from trainctl.metrics.versions import CHANGES, VERSION, current
from trainctl.record.folder import about_run, write_info
from trainctl.record.recorder import Recorder, standard_tables
from trainctl.runs.run import Run

NAN = float("nan")


def run_folder(
    folder: Path,
    tables: Mapping[str, Mapping[str, Any]],
    scenario: Mapping[str, Any] | None = None,
    events: Sequence[Mapping[str, Any]] = (),
    **options: Any,
) -> Run:
    """A run folder of trains 1, 2, 3 on tracks 1, 2; columns that are not given are NaN, False or the first name."""
    standard = standard_tables(["1", "2", "3"], ["1", "2"], ["e"], units="units" in tables, **options)
    with Recorder(folder, standard) as recorder:
        for table, columns in tables.items():
            rows = len(columns["time_s"])
            recorder.write(table, **{
                name: columns.get(name, np.full(rows, np.nan) if kind == "float" else np.zeros(rows, int))
                for name, kind in standard[table].items()
            })  # fmt: skip
        for event in events:
            recorder.event(**event)
    write_info(folder, about_run("", 1, []))
    if scenario is not None:
        (folder / "scenario.toml").write_text(tomli_w.dumps(dict(scenario)))
    return Run(folder)


def scenario(units: int = 1, **more: Any) -> dict[str, Any]:
    return {
        "run": {"duration_s": 4.0, "step_s": 1.0},
        "controller": {"law": "fully_distributed"},
        "bounds": {
            "speed_lower_mps": 5.0, "speed_upper_mps": 20.0, "input_lower_mps2": -1.0, "input_upper_mps2": 1.0,
            "coupler_lower_m": -0.1, "coupler_upper_m": 0.1,
        },
        "train_type": {"t": {"units": units, "unit_mass_kg": 1000.0}},
        "train": [
            {"id": "1", "type": "t", "position_m": 300.0},
            {"id": "2", "type": "t", "position_m": 200.0, "speed_upper_mps": 30.0},
            {"id": "3", "type": "t", "position_m": 100.0},
        ],
        "reference": {"speed_mps": 10.0},
        **more,
    }  # fmt: skip


def three_trains() -> dict[str, dict[str, Any]]:
    """Four instants; train 1 holds 10 m/s, train 2 overshoots from 8 m/s to 11 m/s, train 3 brakes from 12 m/s."""
    time = np.repeat([0.0, 1.0, 2.0, 3.0], 3)
    speed = np.array([[10, 8, 12], [10, 9, 11], [10, 11, 10], [10, 10, 10]], float)
    position = np.array([300.0, 200.0, 100.0]) + np.vstack([np.zeros(3), np.cumsum(speed[:-1], axis=0)])
    spacing = np.column_stack([np.full(4, NAN), -np.diff(position, axis=1)])
    inputs = np.vstack([np.diff(speed, axis=0) / 2, np.full(3, NAN)])
    trains = {
        "time_s": time, "train": np.tile([0, 1, 2], 4), "track": np.tile([0, 0, 1], 4), "position_m": position.ravel(),
        "speed_mps": speed.ravel(), "input_mps2": inputs.ravel(), "spacing_m": spacing.ravel(), "gap_m": spacing.ravel() - 20,
        "saturated": np.arange(12) == 5,
    }  # fmt: skip
    links = {  # 1 and 2 hear each other, 3 hears 2 only
        "time_s": np.repeat([0.0, 1.0, 2.0, 3.0], 3), "sender": np.tile([0, 1, 1], 4), "receiver": np.tile([1, 0, 2], 4),
        "spacing_m": np.column_stack([spacing[:, 1], -spacing[:, 1], spacing[:, 2]]).ravel(),
        "desired_m": np.tile([102.0, -102.0, 90.0], 4), "lower_m": np.tile([101.5, -200.0, 92.0], 4),
        "upper_m": np.tile([200.0, -50.0, 150.0], 4), "heard": np.ones(12, bool),
    }  # fmt: skip
    return {"trains": trains, "links": links}


def test_bounds_of_a_point_formation(tmp_path: Path) -> None:
    """Spacings 1-2: 100, 102, 103, 102; 2-3: 100, 96, 94, 95 m. At time 0 link 1-2 is below its bound: given, not controlled."""
    values = metrics(run_folder(tmp_path, three_trains(), scenario()))
    assert values["bounds.spacing_lower_margin_m/1-2"] == 0.5
    assert values["bounds.spacing_lower_margin_m/2-3"] == 2.0
    assert values["bounds.spacing_lower_margin_m"] == 0.5
    assert values["bounds.spacing_upper_margin_m"] == 54.0  # 2-3 at 96 m from t = 1 on: not the 50 of t = 0
    assert values["bounds.speed_lower_margin_mps"] == 3.0
    assert values["bounds.speed_upper_margin_mps/2"] == 19.0  # its own bound
    assert values["bounds.speed_upper_margin_mps"] == 8.0
    assert values["bounds.input_upper_margin_mps2"] == 0.0
    assert values["bounds.input_lower_margin_mps2"] == 0.5
    assert values["bounds.broken"] == 0
    assert "bounds.first_violation_s" not in values


def test_first_violation_is_located(tmp_path: Path) -> None:
    tables = three_trains()
    tables["trains"]["speed_mps"][7] = 31.0  # train 2 at 2 s
    tables["links"]["spacing_m"][11] = 91.0  # 2-3 at 3 s
    values = metrics(run_folder(tmp_path, tables, scenario()))
    assert values["bounds.broken"] == 2
    assert values["bounds.first_violation_s"] == 2.0
    assert values["bounds.first_violation_who"] == "upper speed bound of train of 2 by 1"
    assert values["bounds.spacing_lower_margin_m/2-3"] == -1.0


def test_a_new_link_counts_from_one_control_period_on(tmp_path: Path) -> None:
    """Link 2-3 is away at 1 s; when it comes back at 2 s below its bound, 2 s is its first instant and 3 s counts."""
    tables = three_trains()
    links = {name: column[np.arange(12) != 5] for name, column in tables["links"].items()}  # no 2-3 at 1 s
    at = (links["sender"] == 1) & (links["receiver"] == 2)
    links["spacing_m"][at] = [100.0, 80.0, 95.0]
    tables["links"] = links
    assert metrics(run_folder(tmp_path, tables, scenario()))["bounds.spacing_lower_margin_m/2-3"] == 3.0


def test_a_longer_control_period_leaves_more_instants_uncounted(tmp_path: Path) -> None:
    """With T_c = 2 s the first instants that the law can answer for are those of 2 and 3 s: 2-3 at 94 and 95 m."""
    slow = scenario(run={"duration_s": 4.0, "step_s": 1.0, "control_period_s": 2.0})
    values = metrics(run_folder(tmp_path, three_trains(), slow))
    assert values["bounds.spacing_upper_margin_m/2-3"] == 55.0


def test_a_link_heard_by_the_train_ahead_only_is_the_same_pair(tmp_path: Path) -> None:
    tables = three_trains()
    backward = tables["links"]["sender"] == 1
    backward &= tables["links"]["receiver"] == 0
    tables["links"] = {name: column[backward] for name, column in tables["links"].items()}
    values = metrics(run_folder(tmp_path, tables, scenario()))
    assert values["formation.final_error_m/1-2"] == 0.0
    assert values["bounds.spacing_lower_margin_m/1-2"] == 52.0  # -50 m is the upper bound of what train 1 sees
    assert values["bounds.spacing_upper_margin_m/1-2"] == 97.0


def test_formation(tmp_path: Path) -> None:
    """Errors 1-2: -2, 0, 1, 0; 2-3: 10, 6, 4, 5."""
    events = [{"time_s": t, "kind": "topology", "links": []} for t in (0.0, 2.0)]
    run = run_folder(tmp_path, three_trains(), scenario(), events)
    values = metrics(run)
    assert values["formation.settling_s"] is None
    assert values["formation.final_error_m"] == 5.0
    assert values["formation.final_error_m/1-2"] == 0.0
    assert values["formation.overshoot_m/1-2"] == 0.0  # the error of 1 m at 2 s opens a new window
    wide = metrics(run, band_m=5.5)
    assert wide["formation.settling_s"] == 2.0
    assert wide["formation.window_settling_s/0"] is None
    assert wide["formation.window_settling_s/2"] == 0.0
    assert metrics(run, band_m=20.0)["formation.window_settling_s/0"] == 0.0
    assert values["formation.last_link_s"] == 3.0


def test_settling_is_a_time_of_the_run(tmp_path: Path) -> None:
    """The same links from 100 s on, in a run that began at 100 s."""
    tables = {name: columns | {"time_s": np.asarray(columns["time_s"]) + 100.0} for name, columns in three_trains().items()}
    values = metrics(run_folder(tmp_path, tables, scenario()), band_m=5.5)
    assert (values["formation.settling_s"], values["formation.last_link_s"]) == (102.0, 103.0)


def test_settling_in_words() -> None:
    known = {"run.duration_s": 960.0, "formation.settling_s": 380.0, "formation.last_link_s": 766.0}
    assert settling(known) == "from 380 s, last link at 766 s"
    assert settling(known | {"formation.last_link_s": 960.0}) == "from 380 s"
    assert settling(known | {"formation.settling_s": None}) == "not by the end, last link at 766 s"
    assert settling({"run.duration_s": 960.0}) == ""


def test_overshoot_in_one_window_and_speeds(tmp_path: Path) -> None:
    values = metrics(run_folder(tmp_path, three_trains(), scenario()))
    assert values["formation.overshoot_m/1-2"] == 1.0
    assert values["formation.overshoot_m/2-3"] == 0.0
    assert values["formation.speed_overshoot_mps/2"] == 1.0
    assert values["formation.speed_overshoot_mps/3"] == 0.0
    assert values["formation.speed_settling_s/0"] == 3.0
    assert values["formation.final_speed_error_mps"] == 0.0


def test_string_gain(tmp_path: Path) -> None:
    values = metrics(run_folder(tmp_path, three_trains(), scenario()))
    assert values["string.l2_gain"] == pytest.approx(np.sqrt((100 + 36 + 16 + 25) / (4 + 0 + 1 + 0)))
    assert values["string.peak_gain"] == 5.0


@pytest.mark.parametrize(
    ("ahead", "told", "expected"), [(0.0, [], 74.0), (90.0, [], -16.0), (0.0, [-3.5], -3.5), (90.0, [-3.5], -16.0)]
)
def test_gap_is_negative_where_trains_overlap(ahead: float, told: list[float], expected: float, tmp_path: Path) -> None:
    """In a row, and between two rows, where only the event knows."""
    tables = three_trains()
    tables["trains"]["gap_m"] = tables["trains"]["gap_m"] - ahead
    events = [
        {"kind": "violation", "time_s": 1.5, "bound": "gap_m", "who": "1-2", "trains": ["1", "2"], "value": value} for value in told
    ]
    assert metrics(run_folder(tmp_path, tables, scenario(), events))["traffic.gap_min_m"] == expected


def test_traffic(tmp_path: Path) -> None:
    """Fronts at 0 s: 300, 200, 100; nobody passes where another was, unless a section is named."""
    run = run_folder(tmp_path, three_trains(), scenario())
    values = metrics(run)
    assert values["traffic.gap_min_m"] == 74.0
    assert values["traffic.spacing_min_m"] == 94.0
    assert values["traffic.headway_min_s"] == 100.0 / 12.0
    assert values["traffic.speed_max_mps"] == 12.0
    at_305 = metrics(run, section_m=305.0)
    assert (at_305["traffic.passages"], at_305["traffic.section_m"]) == (1, 305.0)
    assert "traffic.trains_per_hour" not in at_305
    assert values["run.train_km"] == pytest.approx((30 + 28 + 33) / 1000)


def test_passages(tmp_path: Path) -> None:
    """Three trains pass 50 m at 4.5, 9.5 and 14.5 s on tracks 1, 1, 2."""
    time = np.repeat(np.arange(20.0), 3)
    position = (np.arange(20.0)[:, None] * 10 + np.array([5.0, -45.0, -95.0])).ravel()
    trains = {
        "time_s": time, "train": np.tile([0, 1, 2], 20), "track": np.tile([0, 0, 1], 20), "position_m": position,
        "speed_mps": np.full(60, 10.0),
    }  # fmt: skip
    values = metrics(run_folder(tmp_path, {"trains": trains}), section_m=50.0)
    assert values["traffic.passages"] == 3
    assert values["traffic.trains_per_hour"] == pytest.approx(720.0)
    assert values["traffic.trains_per_hour/1"] == pytest.approx(720.0)
    assert values["traffic.passage_headway_min_s"] == pytest.approx(5.0)


def test_energy_and_comfort_of_points(tmp_path: Path) -> None:
    """Train 2: inputs 0.5, 1, -0.5 over 8, 9, 11 m: 13 J and -5.5 J per kg; train 3: -0.5, -0.5, 0 over 12, 11 m: -11.5 J."""
    values = metrics(run_folder(tmp_path, three_trains(), scenario()))
    assert values["energy.source"] == "input times mass held between rows"
    assert values["energy.traction_kwh"] == pytest.approx(13e3 / 3.6e6)
    assert values["energy.braking_kwh"] == pytest.approx(17e3 / 3.6e6)
    assert values["energy.regenerable_kwh"] == pytest.approx(17e3 / 3.6e6)
    assert values["energy.traction_kwh_per_train_km"] == pytest.approx(13e3 / 3.6e6 / 0.091)
    assert values["comfort.acceleration_max_mps2"] == 2.0
    assert values["comfort.acceleration_min_mps2"] == -1.0
    assert values["comfort.jerk_max_mps3"] == 3.0  # train 2: accelerations 1, 2, -1
    assert values["comfort.jerk_rms_mps3"] == pytest.approx(np.sqrt((0 + 0 + 1 + 9 + 0 + 1) / 6))
    (tmp_path / "scenario.toml").unlink()
    without_mass = metrics(Run(tmp_path))
    assert without_mass["energy.traction_kwh_per_t"] == pytest.approx(13e3 / 3.6e6)


def test_units(tmp_path: Path) -> None:
    """One train of two units; the sub-steps saw more than the rows."""
    trains = {
        "time_s": [0.0, 1.0], "position_m": [100.0, 110.0], "speed_mps": [10.0, 10.0], "input_mps2": [1.0, NAN],
        "saturated": [True, False],
    }  # fmt: skip
    units = {
        "time_s": [0.0, 0.0, 1.0, 1.0], "unit": [1, 2, 1, 2], "position_m": [100.0, 80.0, 110.0, 90.0],
        "speed_mps": [10.0, 10.0, 10.0, 10.0], "force_n": [3000.0, -1000.0, 1500.0, -1000.0], "coupler_m": [0.0, NAN, 0.02, NAN],
        "coupler_force_n": [0.0, NAN, 500.0, NAN], "coupler_min_m": [NAN, NAN, -0.01, np.inf],
        "coupler_max_m": [NAN, NAN, 0.12, -np.inf], "force_min_n": [NAN, NAN, 2000.0, -1500.0],
        "force_max_n": [NAN, NAN, 4000.0, -1000.0],
    }  # fmt: skip
    run = run_folder(tmp_path, {"trains": trains, "units": units}, scenario(units=2))
    values = metrics(run)
    assert values["units.coupler_max_m"] == 0.12
    assert values["units.coupler_min_m/1.1"] == -0.01
    assert values["units.coupler_stroke_m"] == pytest.approx(0.13)
    assert values["units.coupler_force_max_n"] == 500.0
    assert (values["units.force_min_n"], values["units.force_max_n"]) == (-1500.0, 4000.0)
    assert (values["units.power_traction_max_w"], values["units.power_braking_max_w"]) == (30e3, 10e3)
    assert values["units.saturated_share"] == 0.5
    assert values["energy.source"] == "unit forces held between rows"
    assert values["energy.traction_kwh/1.1"] == pytest.approx(30e3 / 3.6e6)
    assert values["energy.braking_kwh"] == pytest.approx(10e3 / 3.6e6)
    assert values["bounds.coupler_upper_margin_m"] == pytest.approx(-0.02)
    assert values["bounds.first_violation_who"] == "upper coupler bound [m] behind unit of 1.1 by 0.02"
    assert values["bounds.first_violation_s"] == 1.0


def test_logged_energies_and_watched_quantities_are_used(tmp_path: Path) -> None:
    trains = {
        "time_s": [0.0, 1.0], "position_m": [0.0, 10.0], "speed_mps": [2.0, 10.0], "traction_j": [0.0, 3.6e6],
        "braking_j": [0.0, 7.2e6], "tilde_x_m_min": [NAN, -5.0], "tilde_x_m_max": [NAN, 7.0],
    }  # fmt: skip
    values = metrics(run_folder(tmp_path, {"trains": trains}, train_extras=("traction_j", "braking_j"), watched=("tilde_x_m",)))
    assert values["energy.source"] == "integrated over the sub-steps"
    assert (values["energy.traction_kwh"], values["energy.net_kwh"]) == (1.0, -1.0)
    assert (values["watched.tilde_x_m_min"], values["watched.tilde_x_m_max/1"]) == (-5.0, 7.0)


def test_every_metric_has_a_definition(tmp_path: Path) -> None:
    run = run_folder(tmp_path, three_trains(), scenario())
    (run.folder / "sumo").mkdir()
    (run.folder / "sumo" / "tripinfo.xml").write_text('<tripinfos><tripinfo duration="5"/><tripinfo duration="7"/></tripinfos>')
    (run.folder / "sumo" / "statistics.xml").write_text(
        '<statistics><teleports total="1"/><safety collisions="2" emergencyStops="0" emergencyBraking="3"/></statistics>'
    )
    values = metrics(run)
    assert {base(name) for name in values} <= DEFINITIONS.keys()
    assert (values["traffic.sumo_duration_mean_s"], values["traffic.collisions"], values["traffic.teleports"]) == (6.0, 2, 1)


FCD = """<fcd-export>
<timestep time="0.00"><vehicle id="a" speed="10" pos="100" lane="e_0"/><vehicle id="b" speed="20" pos="40" lane="e_0"/></timestep>
<timestep time="1.00"/>
<timestep time="2.00">
<vehicle id="a" speed="10" pos="120" lane="e_0"/><vehicle id="b" speed="0.05" pos="80" lane="e_0"/>
<vehicle id="c" speed="12" pos="70" lane="f_0"/></timestep>
</fcd-export>"""
CSV = """timestep_time;vehicle_id;vehicle_speed;vehicle_pos;vehicle_lane
0.00;a;10;100;e_0
0.00;b;20;40;e_0
1.00;;;;
2.00;a;10;120;e_0
2.00;b;0.05;80;e_0
2.00;c;12;70;f_0
"""


def fcd_files(folder: Path) -> list[Path]:
    (folder / "fcd.xml").write_text(FCD)
    (folder / "fcd.csv").write_text(CSV)
    (folder / "fcd.xml.gz").write_bytes(gzip.compress(FCD.encode()))
    (folder / "fcd.csv.gz").write_bytes(gzip.compress(CSV.encode()))
    rows = [line.split(";") for line in CSV.splitlines()]
    columns = dict(zip(rows[0], zip(*(r for r in rows[1:] if r[1]), strict=True), strict=True))
    texts = ("vehicle_id", "vehicle_lane")
    table = pa.table({name: list(c) if name in texts else [float(v) for v in c] for name, c in columns.items()})
    pq.write_table(table, folder / "fcd.parquet")
    return sorted(folder.iterdir())


def test_any_kind_of_fcd_gives_the_same_metrics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for batch_rows in (65536, 2, 1):
        monkeypatch.setattr("trainctl.runs.xml_rows.BATCH_ROWS", batch_rows)
        for path in fcd_files(tmp_path):
            values = metrics_of_fcd(path)
            assert {name: pytest.approx(value) for name, value in values.items()} == {
                "fcd.duration_s": 2.0, "fcd.steps": 2, "fcd.vehicles": 3, "fcd.rows": 5, "fcd.vehicles_mean": 2.5,
                "fcd.speed_mean_mps": 52.05 / 5, "fcd.speed_max_mps": 20.0, "fcd.standing_share": 0.2, "fcd.spacing_min_m": 40.0,
                "fcd.spacing_mean_m": 50.0, "fcd.headway_min_s": 3.0, "fcd.headway_mean_s": 3.0,
            }, (path.name, batch_rows)  # fmt: skip
            assert values.keys() <= DEFINITIONS.keys()


BOMB = '<!DOCTYPE x [<!ENTITY a "lol"><!ENTITY b "&a;&a;&a;">]><fcd-export><timestep time="&b;"/></fcd-export>'


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no vehicle"),
        (b"hello", "no column"),
        (b"\xff\xfe\x00garbage", "no column"),
        (b"PAR1 but no more", "not a complete Parquet file"),
        (b"\x1f\x8b\x08 damaged", "damaged gzip"),
        (gzip.compress(FCD.encode())[:-30], "damaged gzip"),
        (BOMB.encode(), "document type or entities"),
        (b"<net/>", "not a log of the kind <fcd-export>"),
        (FCD[:200].encode(), "not well-formed"),
        (FCD.replace('"10"', '"fast"').encode(), "fast"),
        (FCD.replace('"10"', '"nan"').encode(), "not finite"),
        (FCD.replace("2.00", "-2.00").encode(), "does not ascend: -2 s after 0 s"),
        (b'<fcd-export><timestep time="0"/></fcd-export>', "no vehicle"),
        (b'<fcd-export><timestep><vehicle id="a" speed="1"/></timestep></fcd-export>', "outside any timestep with a time"),
        (b'<fcd-export><timestep time="0"><vehicle id="a"/></timestep></fcd-export>', "without id or speed"),
        (b'<?xml version="1.0" encoding="nonsense"?><fcd-export/>', "nonsense|unknown encoding"),
        (CSV.replace("120", "much").encode(), "pos = much: not a number"),
        (CSV.replace("2.00;a", "2.00;a;10;110;e_0\n2.00;a").encode(), "vehicle a appears twice at 2 s"),
        (FCD.replace('id="c"', 'id="b"').encode(), "vehicle b appears twice at 2 s"),
        (CSV.partition("\n")[2].encode(), "line 1 = 0.00;a;10;100;e_0: a CSV log begins with the names of its columns"),
        (b"timestep_time;vehicle_id;vehicle_speed\n0;a\xff;1\n", "not a CSV log"),
    ],
)
def test_garbage_gives_one_clear_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "log"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        metrics_of_fcd(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_endless_element_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "fcd.xml.gz"
    path.write_bytes(gzip.compress(b'<fcd-export a="' + b"x" * (1 << 25)))
    with pytest.raises(InputError, match="longer than"):
        metrics_of_fcd(path)


def test_a_broken_scenario_is_one_line(tmp_path: Path) -> None:
    run = run_folder(tmp_path, three_trains(), {"train": [{"type": "t"}]})
    with pytest.raises(InputError, match=r"scenario\.toml: not a resolved scenario"):
        metrics(run)


def test_metrics_say_by_which_definitions_they_were_computed(finished: Any, tmp_path: Path) -> None:
    done = finished("fully_distributed", "numeric", **{"run.duration_s": 60})
    stored = json.loads((done.folder / "metrics.json").read_text())
    assert stored["definitions"] == done.definitions == VERSION == max(CHANGES)
    assert "definitions" not in done.metrics and current(done) is done.metrics
    folder = tmp_path / "old"
    shutil.copytree(done.folder, folder)
    (folder / "metrics.json").write_text(json.dumps({"formation.settling_s": -1.0}))
    old = Run(folder)
    assert (old.definitions, old.metrics["formation.settling_s"]) == (1, -1.0)
    assert current(old) == metrics(old) and current(old)["formation.settling_s"] != -1.0
    (folder / "metrics.json").write_text('{"definitions": "new"}')
    with pytest.raises(InputError, match=r"metrics.json: definitions = 'new': must be a number of a version"):
        current(Run(folder))
