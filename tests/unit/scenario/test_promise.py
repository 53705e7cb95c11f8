"""What protection relies on, computed from a scenario; what cannot be met is refused with numbers."""

from __future__ import annotations

import json

import numpy as np
import pytest
import tomli_w

from trainctl.cli.program import main
from trainctl.errors import InputError
from trainctl.runner import run
from trainctl.scenario import promise
from trainctl.scenario.build import open_scenario
from trainctl.signals import GRAVITY

LAW = '''
"""The first train brakes as hard as it can, the others pull."""
from typing import Literal
import numpy as np
from trainctl.signals import Demand, Table
CLOCK: Literal["sampled"] = "sampled"
PLANTS = ("point", "coupled_units", "actuated_units")
class Params(Table):
    pass
def violations(params, scene): return []
def constants(params, scene): return params
def message(constants, own, leader): return np.column_stack((own.position, own.speed))
def demand(constants, own, leader, links, heard):
    a = np.full(len(own.speed), 9.0)
    a[0] = -9.0
    return Demand(a, np.zeros(len(a), bool))
'''


def scenario(folder, *, gradient=(), spacing=3000.0, speed=50.0, plant=None, unit=None, trains=3, **more):
    """Trains on a line of 200 km of 70 m/s, written to ``folder``; the path of the scenario."""
    (folder / "hostile.py").write_text(LAW)
    line = {"name": "l", "tracks": ["1"], "length_m": 200000.0, "speed": [[0.0, 70.0]], "gradient": [list(g) for g in gradient]}
    (folder / "l.toml").write_text(tomli_w.dumps(line))
    emu = {"unit_length_m": 100.0, "unit_mass_kg": 2e5, "c0_n_per_kg": 0.01, "c1_ns_per_m_kg": 1e-4, "c2_ns2_per_m2_kg": 1e-5}
    table = {
        "schema_version": 1,
        "title": "hostile",
        "run": {"duration_s": 120.0, "seed": 3},
        "network": {"line": "l.toml"},
        "controller": {"law": "hostile.py"},
        "plant": {"kind": "point", **(plant or {})},
        "reference": {"speed_mps": speed},
        "topology": {"spacing_m": spacing},
        "supervisor": {"mode": "on"},
        "train_type": {"emu": {**emu, **(unit or {})}},
        "train": [
            {"id": i + 1, "type": "emu", "track": 1, "position_m": 90000.0 - spacing * i, "speed_mps": speed} for i in range(trains)
        ],
    }
    for key, value in more.items():
        table[key] = {**table[key], **value} if isinstance(value, dict) else value
    (folder / "s.toml").write_text(tomli_w.dumps(table))
    return str(folder / "s.toml")


def test_slopes_and_brakes_count_and_running_resistance_does_not(tmp_path):
    clamps = {"input_lower_mps2": -1.0, "input_upper_mps2": 1.0}
    level = open_scenario(scenario(tmp_path, plant=clamps)).assumed
    np.testing.assert_allclose(level.braking, 1.0)
    p = open_scenario(scenario(tmp_path, gradient=[(0.0, 0.0), (100000.0, -35.0), (120000.0, 10.0)], plant=clamps))
    np.testing.assert_allclose(p.assumed.braking, 1.0 - 0.035 * GRAVITY)
    behind = open_scenario(scenario(tmp_path, gradient=[(0.0, -35.0), (50000.0, 0.0)], plant=clamps))
    np.testing.assert_allclose(behind.assumed.braking, 1.0)  # the descent lies behind all of them


def test_every_disturbance_counts_with_its_maximum(tmp_path):
    entries = [
        {"on": "input", "shape": "constant", "amplitude_mps2": 0.05, "train": 2},
        {"on": "speed", "shape": "sine", "period_s": 9.0, "amplitude_mps": 0.02},
        {"on": "position", "shape": "uniform", "amplitude_m": 0.3},
        {"on": "resistance", "shape": "constant", "error_percent": -20.0},
        {"on": "measurement", "shape": "gaussian", "std_m": 0.5},
    ]
    p = open_scenario(scenario(tmp_path, disturbance=entries, supervisor={"speed_uncertainty_mps": 0.4}))
    resistance = 0.2 * (0.01 + 1e-4 * 70.0 + 1e-5 * 70.0**2)
    np.testing.assert_allclose(p.assumed.scatter, np.array([0.0, 0.05, 0.0]) + 0.02 + resistance)
    np.testing.assert_allclose(p.assumed.braking, 1.0 - p.assumed.scatter)
    np.testing.assert_allclose(p.assumed.hardest, 1.0 + p.assumed.scatter)
    np.testing.assert_allclose(p.assumed.drift, 0.3 + 0.4)
    np.testing.assert_allclose(p.assumed.uncertainty, 6 * 0.5)
    assert p.assumed.blur == 0.4
    said = promise.told(p)
    assert said["deviations"] == 6.0 and said["relied_on_of"] == "2"


def test_actuators_and_faults_count(tmp_path):
    unit = {
        "units": 2, "coupler_stiffness_n_per_m": 1e6, "coupler_damping_ns_per_m": 1e4, "traction_n": 3e5, "braking_n": 3e5,
        "actuator_rate_per_s": 2.0,
    }  # fmt: skip
    base = {"plant": {"kind": "actuated_units"}, "unit": unit}
    sound = open_scenario(scenario(tmp_path, **base)).assumed
    assert np.all(sound.lag == 0.5) and np.all(sound.braking > 0.99)
    lost = open_scenario(
        scenario(tmp_path, **base, fault=[{"train": 2, "unit": 1, "kind": "effectiveness", "effectiveness": 0.4}])
    ).assumed
    np.testing.assert_allclose(sound.braking - lost.braking, [0.0, 0.3, 0.0], atol=1e-12)
    pushed = open_scenario(
        scenario(tmp_path, **base, fault=[{"train": 3, "unit": 2, "kind": "constant", "amplitude_n_per_s": 8e4}])
    ).assumed
    np.testing.assert_allclose(sound.braking - pushed.braking, [0.0, 0.0, 0.1], atol=1e-12)


def refused(path, **settings):
    with pytest.raises(InputError) as error:
        open_scenario(path, settings)
    return error.value.mistakes


def test_what_cannot_be_kept_is_refused_with_the_number_that_would_do(tmp_path):
    (steep,) = refused(scenario(tmp_path, gradient=[(0.0, -50.0), (150000.0, -49.0)], plant={"input_lower_mps2": -0.5, "input_upper_mps2": 1.0},
                                supervisor={"emergency_mps2": 0.5, "service_mps2": 0.5}))  # fmt: skip
    assert "cannot be relied on to brake" in steep and "its brakes leave 0.00967 on 50 per mil downhill" in steep
    (more,) = refused(
        scenario(tmp_path, plant={"input_lower_mps2": -0.5, "input_upper_mps2": 1.0}, supervisor={"emergency_mps2": 0.9})
    )
    assert "supervisor.emergency_mps2 = 0.9: train 1 can brake with 0.5 m/s2 at most" in more
    (late,) = refused(scenario(tmp_path, spacing=600.0, speed=50.0, gradient=[(0.0, -30.0)],
                               plant={"input_lower_mps2": -1.0, "input_upper_mps2": 1.0},
                               train=[{"id": 1, "type": "emu", "track": 1, "position_m": 90300.0, "speed_mps": 5.0},
                                      {"id": 2, "type": "emu", "track": 1, "position_m": 89500.0, "speed_mps": 60.0}]))  # fmt: skip
    assert late.startswith("s.toml: train[2].speed_mps = 60: 700 m behind train 1 (5 m/s)") and "at most 30.97 m/s" in late
    (fast,) = refused(scenario(tmp_path, speed=71.0, trains=1))
    assert "train[1].speed_mps = 71: the line allows 70 m/s where it starts" in fast
    assert fast.endswith("with braking of 1 m/s2 at most 70 m/s")
    (stands,) = refused(scenario(tmp_path, plant={"speed_lower_mps": 10.0}))
    assert stands.startswith("s.toml: plant.speed_lower_mps = 10: trains that cannot stand")
    (unit,) = refused(scenario(tmp_path, supervisor={"uncertainty": 3.0}))
    assert "supervisor.uncertainty" in unit and "position_uncertainty_m or speed_uncertainty_mps" in unit


def test_a_start_is_judged_in_steps_as_trains_move(tmp_path):
    """Over 1760 m braking with 1 m/s2 ends at 10 m/s from 60 m/s; in steps of 10 s, with the old speed, from 55.1 m/s."""
    path = scenario(tmp_path, trains=1, speed=60.0, run={"duration_s": 120.0, "step_s": 10.0})
    line = {"name": "l", "tracks": ["1"], "length_m": 200000.0, "speed": [[0.0, 70.0], [91760.0, 10.0]]}
    (tmp_path / "l.toml").write_text(tomli_w.dumps(line))
    (late,) = refused(path)
    assert late == ("s.toml: train[1].speed_mps = 60: the line allows 10 m/s in 1760 m; with braking of 1 m/s2 at most 55.1 m/s")
    done = run(open_scenario(path, {"train": [{"id": 1, "type": "emu", "track": 1, "position_m": 90000.0, "speed_mps": 55.1}]}),
               tmp_path / "run", "numeric")  # fmt: skip
    assert json.loads((done.folder / "run.json").read_text())["overspeeds"] == 0


def test_a_train_that_does_not_fit_its_plant_is_told_by_that_alone(tmp_path):
    with pytest.raises(InputError) as refused:  # and not by a division by its actuators' rate of 0
        open_scenario(scenario(tmp_path, trains=1, plant={"kind": "actuated_units"}))
    assert refused.value.mistakes == ["s.toml: actuator_rate_per_s = 0: must be above 0 for train 1 in actuated_units"]


def test_monitoring_refuses_nothing(tmp_path):
    open_scenario(scenario(tmp_path, speed=71.0, trains=1, supervisor={"mode": "monitor"}))
    open_scenario(scenario(tmp_path, speed=71.0, trains=1, supervisor={"mode": "off"}))


def test_check_prints_the_promise_and_the_run_keeps_it(tmp_path, capsys, monkeypatch):
    path = scenario(tmp_path, disturbance=[{"on": "input", "shape": "constant", "amplitude_mps2": 0.05}])
    monkeypatch.setattr("sys.argv", ["trainctl", "check", path])
    with pytest.raises(SystemExit) as end:
        main()
    out = capsys.readouterr().out
    assert end.value.code == 0
    assert "protection: no law causes a collision" in out and "brakes with at least 0.95 m/s2 up to 70 m/s" in out
    done = run(open_scenario(path), tmp_path / "run", "numeric")
    info = json.loads((done.folder / "run.json").read_text())
    assert info["protection"]["relied_on_mps2"] == 0.95


@pytest.mark.parametrize("plant", ["point", "coupled_units"])
def test_disturbed_trains_keep_their_margin(plant, tmp_path):
    """The followers pull and a force nobody knows of pushes them; the first brakes. Couplers let a head go a little farther."""
    unit = {"units": 2, "coupler_stiffness_n_per_m": 1e6, "coupler_damping_ns_per_m": 1e4, "braking_n": 3e5, "traction_n": 3e5}
    entries = [{"on": "input", "shape": "constant", "amplitude_mps2": 0.05, "train": [2, 3]}]
    path = scenario(tmp_path, plant={"kind": plant}, unit=unit if plant != "point" else None, spacing=1500.0, disturbance=entries)
    done = run(open_scenario(path, {"run.duration_s": 200.0}), tmp_path / "run", "numeric")
    last = done.trains[done.trains.time_s == 200.0]
    gaps = last.gap_m.dropna()
    length = 100.0 if plant == "point" else 200.0
    assert (last.speed_mps < 1e-6).all() and len(gaps) == 2
    assert (gaps > 20.0 - (1e-6 if plant == "point" else 0.5)).all() and (gaps < 60.0 + length).all()
