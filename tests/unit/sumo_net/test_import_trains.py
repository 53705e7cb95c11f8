from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml

from sumo_net.import_trains import fitted
from sumo_net.importing import Options, convert
from sumo_net.spec import LineError
from trainctl.scenario.tables import TrainType

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data"
REAL = [
    *sorted((DATA / "ttobench" / "trains").glob("*.json")),
    *(DATA / "trainruns" / f"{n}.yaml" for n in ("local", "longdistance", "train_schema_2022")),
]
G = 9.80665


def quantity(value, unit):
    return {"value": value, "unit": unit}


def multiple_unit(**changes):
    data = {
        "metadata": {"id": "Swift"},
        "length": quantity(60.0, "m"), "mass": quantity(120.0, "t"), "rho": quantity(10, "%"),
        "max traction power": quantity(2.6, "MW"), "max traction force": quantity(200.0, "kN"),
        "max reg braking power": quantity(2600.0, "kW"), "max reg braking force": quantity(150.0, "kN"),
        "max speed": quantity(160, "km/h"),
        "rolling resistance r0": quantity(2.4, "kN"), "rolling resistance r1": quantity(0.017, "kN/(km/h)"),
        "rolling resistance r2": quantity(0.0009, "kN/(km/h)^2"),
    }  # fmt: skip
    return {k: v for k, v in (data | changes).items() if v is not None}


EFFORT = [[v, min(100e3, 1.8e6 / max(v / 3.6, 1e-9))] for v in range(0, 141, 5)]


def vehicle(**changes):
    data = {
        "id": "motor", "name": "M", "vehicle_type": "multiple unit", "length": 40.0, "mass": 60.0, "load_limit": 10.0, "mass_traction": 40.0,
        "rotation_mass": 1.1, "base_resistance": 3.0, "rolling_resistance": 1.5, "air_resistance": 4.0, "a_braking": -0.5,
        "speed_limit": 120, "tractive_effort": EFFORT,
    }  # fmt: skip
    return {k: v for k, v in (data | changes).items() if v is not None}


WAGON = vehicle(
    id="wagon", vehicle_type="passenger", mass=50.0, mass_traction=None, tractive_effort=None, a_braking=None, rotation_mass=1.06
)


def stock(formation, *vehicles):
    return {
        "schema": "https://railtoolkit.org/schema/rolling-stock.json",
        "trains": [{"id": "T1", "name": "Test", "formation": formation}],
        "vehicles": list(vehicles),
    }


@pytest.fixture
def imported(tmp_path):
    def read(data, **options):
        file = tmp_path / ("train.json" if "metadata" in data else "train.yaml")
        file.write_text(json.dumps(data) if "metadata" in data else yaml.safe_dump(data))
        found = convert(file, Options(**options))
        table = tomllib.loads(found.toml)["train_type"]
        assert (found.kind, list(table)) == ("train", [found.name])
        return found, TrainType.model_validate_json(json.dumps(table[found.name]))

    return read


def resistance(kind, v):
    """Of the whole train [N] at ``v`` [m/s]."""
    per_kg = kind.per_unit("c0_n_per_kg") + kind.per_unit("c1_ns_per_m_kg") * v + kind.per_unit("c2_ns2_per_m2_kg") * v * v
    return (kind.per_unit("unit_mass_kg") * per_kg).sum()


@pytest.mark.parametrize("kmh", [0.0, 80.0, 160.0])
def test_resistance_of_a_ttobench_train_is_that_of_the_file(imported, kmh):
    _, kind = imported(multiple_unit())
    assert resistance(kind, kmh / 3.6) == pytest.approx(1e3 * (2.4 + 0.017 * kmh + 0.0009 * kmh**2), rel=1e-7)


def test_forces_masses_and_length_of_a_ttobench_train(imported):
    _, kind = imported(multiple_unit())
    assert (kind.units, kind.unit_length_m, kind.unit_mass_kg, kind.rotating_mass_factor) == (1, 60.0, 120e3, 1.1)
    assert (kind.traction_n, kind.traction_power_w, kind.braking_n, kind.braking_power_w) == (200e3, 2.6e6, 150e3, 2.6e6)


def test_pneumatic_brakes_have_no_power_limit_and_comfort_caps_the_force(imported):
    data = multiple_unit(**{"max pn braking force": quantity(1000.0, "kN")})
    assert (imported(data)[1].braking_n, imported(data)[1].braking_power_w) == (1150e3, None)
    found, kind = imported(data | {"max deceleration": quantity(1.0, "m/s^2")})
    assert kind.braking_n == pytest.approx(132e3)
    assert any("comfort limit of 1 m/s2" in note for note in found.notes)


def test_equal_units_make_the_same_train(imported):
    couplers = {"coupler_stiffness_n_per_m": 1e6, "coupler_damping_ns_per_m": 1e4}
    one, six = imported(multiple_unit())[1], imported(multiple_unit(), units=6, **couplers)[1]
    for key in ("unit_length_m", "unit_mass_kg", "traction_n", "traction_power_w", "braking_n"):
        assert six.per_unit(key).sum() == pytest.approx(one.per_unit(key).sum(), rel=1e-8)
    assert resistance(six, 30.0) == pytest.approx(resistance(one, 30.0), rel=1e-8)
    assert six.per_unit("coupler_stiffness_n_per_m").tolist() == [1e6] * 5 + [0.0]


def test_what_a_train_lacks_is_asked_for_by_option_all_at_once(imported):
    with pytest.raises(LineError) as error:
        imported(multiple_unit(length=None), units=2)
    assert [m.rpartition("give ")[2] for m in error.value.mistakes] == [
        "--length-m",
        "--coupler-stiffness-n-per-m",
        "--coupler-damping-ns-per-m",
    ]
    assert imported(multiple_unit(length=None), length_m=61.0)[1].unit_length_m == 61.0


@pytest.mark.parametrize("kmh", [0.0, 60.0, 120.0])
def test_resistance_of_railtoolkit_vehicles_is_that_of_trainruns(imported, kmh):
    # TrainRuns.jl: driving axles base, carrying axles rolling, air at ((v + 15) / 100)^2 of the empty weight of a powered vehicle;
    # wagons base, rolling * v / 100 and air of the loaded weight. All per mil.
    air = 4.0 * ((kmh + 15.0) / 100.0) ** 2
    motor = G * (3.0 * 40.0 + 1.5 * 20.0 + air * 60.0)
    wagon = G * 60.0 * (3.0 + 1.5 * kmh / 100.0 + air)
    _, kind = imported(stock(["motor", "wagon", "wagon"], vehicle(), WAGON))
    assert resistance(kind, kmh / 3.6) == pytest.approx(motor + 2.0 * wagon, rel=1e-7)


def test_a_train_with_unpowered_vehicles_is_one_rigid_unit(imported):
    found, kind = imported(stock(["motor", "wagon", "wagon"], vehicle(), WAGON))
    assert (kind.units, kind.unit_length_m, kind.unit_mass_kg) == (1, 120.0, 190e3)
    inertia = 1.1 * 60e3 + 2 * 1.06 * 50e3 + 30e3  # the load does not turn
    assert kind.rotating_mass_factor == pytest.approx(inertia / 190e3)
    assert kind.braking_n == pytest.approx(0.5 * inertia)
    assert any("one rigid unit" in note for note in found.notes)


def test_multiple_units_stay_units_and_need_couplers(imported):
    data = stock(["motor", "other"], vehicle(), vehicle(id="other", mass=80.0))
    with pytest.raises(LineError, match="give --coupler-stiffness-n-per-m"):
        imported(data)
    _, kind = imported(data, coupler_stiffness_n_per_m=1e6, coupler_damping_ns_per_m=1e4)
    assert (kind.units, kind.unit_mass_kg) == (2, (70e3, 90e3))


def test_load_share(imported):
    assert imported(stock(["motor"], vehicle()), load_share=0.0)[1].unit_mass_kg == 60e3


def test_a_missing_braking_rate_is_asked_for(imported):
    data = stock(["motor"], vehicle(a_braking=None, rotation_mass=None, load_limit=None))
    with pytest.raises(LineError, match="a_braking: missing in every powered vehicle: give --deceleration-mps2"):
        imported(data)
    assert imported(data, deceleration_mps2=0.4)[1].braking_n == pytest.approx(0.4 * 60e3)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (stock(["wagon"], WAGON), "no traction unit or multiple unit"),
        (stock(["motor"], vehicle(tractive_effort=None)), "tractive_effort: missing"),
        (stock(["motor", "ghost"], vehicle()), "ghost: no such vehicle; there are: motor"),
        (stock(["motor"], vehicle(mass_traction=70.0)), "exceeds the vehicle's mass"),
        (stock(["motor"], vehicle(mass=0.0)), "mass: must be above 0"),
        (multiple_unit(mass=None), "mass: missing"),
        (multiple_unit(**{"max traction force": quantity(2.0, "lbf")}), "unit lbf: must be one of N, kN"),
        (multiple_unit(**{"max reg braking force": quantity(0.0, "kN")}), "no brakes"),
    ],
)
def test_what_is_wrong_is_told_in_words(imported, data, words):
    with pytest.raises(LineError, match=words):
        imported(data)


def test_an_effort_curve_of_force_and_power_is_found_again():
    v = np.linspace(0.0, 45.0, 91)
    fit = fitted(np.column_stack([v, np.minimum(2e5, 3e6 / np.maximum(v, 1e-9))]))
    # The curve has corners where the file has points: the interpolation between them is what is fitted.
    assert (fit.force, fit.power) == (pytest.approx(2e5, rel=1e-3), pytest.approx(3e6, rel=1e-3))
    assert fit.rms < 100.0


def test_the_errors_of_a_fit_are_what_they_are_said_to_be():
    v = np.linspace(0.0, 30.0, 61)
    curve = np.column_stack([v, 9e4 * np.exp(-v / 15.0)])
    fit = fitted(curve)
    at = np.linspace(0.0, 30.0, 401)

    def rms(force, power):
        with np.errstate(divide="ignore"):
            return np.sqrt(((np.minimum(force, power / at) - np.interp(at, v, curve[:, 1])) ** 2).mean())

    error = np.minimum(fit.force, fit.power / np.maximum(at, 1e-9)) - np.interp(at, v, curve[:, 1])
    assert (fit.most_above, fit.most_below) == (pytest.approx(error.max()), pytest.approx(-error.min()))
    assert fit.rms == pytest.approx(rms(fit.force, fit.power))
    for force, power in ((1.01, 1.0), (0.99, 1.0), (1.0, 1.01), (1.0, 0.99)):  # and no fit nearby is better
        assert rms(force * fit.force, power * fit.power) > fit.rms


@pytest.mark.skipif(not DATA.is_dir(), reason="the files of TTOBench and TrainRuns.jl are not here")
@pytest.mark.parametrize("file", REAL, ids=lambda p: p.stem)
def test_every_real_train_is_read_with_what_it_lacks_as_options(file):
    lacking = {"CH_Stadler_KISS_SBB": "--length-m", "NL_Intercity_VIRM6": "--length-m", "longdistance": "--deceleration-mps2"}
    if file.stem in lacking:
        with pytest.raises(LineError, match=lacking[file.stem]):
            convert(file, Options())
    found = convert(file, Options(length_m=150.0, deceleration_mps2=0.5))
    kind = TrainType.model_validate_json(json.dumps(tomllib.loads(found.toml)["train_type"][found.name]))
    mass = kind.per_unit("unit_mass_kg").sum()
    assert 0.005 < resistance(kind, 0.0) / mass < 0.05
    assert 0.02 < resistance(kind, 30.0) / mass < 0.2
    assert 0.3 < kind.per_unit("braking_n").sum() / mass < 1.3
