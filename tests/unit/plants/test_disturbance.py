"""Disturbances: every shape by hand, windows, repeatable noise, and what is refused in which words."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from trainctl import draws
from trainctl.plants import disturbance as d
from trainctl.signals import Disturbed, Floats

IDS = ("1", "2", "3")
T = 0.5
HERE = np.array([1000.0, 500.0, 0.0])


def entry(**table: Any) -> d.Disturbance:
    """As the scenario reads it."""
    return d.Disturbance.model_validate_json(json.dumps(table))


def series(*tables: dict[str, Any], steps: int = 8, seed: int | None = 1, position: Floats = HERE) -> list[Disturbed]:
    signals = d.signals([entry(**t) for t in tables], IDS, T, seed)
    return [d.at(signals, k, k * T, position) for k in range(steps)]


def first_train(**table: Any) -> list[float]:
    return [float(s.speed[0]) for s in series({"on": "speed", "amplitude_mps": 2.0, **table})]


# --- shapes ---


def test_philox_gives_the_published_words() -> None:
    """Known answers of Random123, philox 4x32 with 10 rounds."""
    assert draws.philox(0, 0, 0, 0, 0, 0) == (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)
    assert draws.philox(*[0xFFFFFFFF] * 6) == (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)
    pi = (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344, 0xA4093822, 0x299F31D0)
    assert draws.philox(*pi) == (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1)


def test_shapes_by_hand() -> None:
    assert first_train(shape="constant") == [2.0] * 8
    assert first_train(shape="alternating") == [2.0, -2.0] * 4
    assert first_train(shape="alternating", from_s=0.5) == [0.0, 2.0, -2.0, 2.0, -2.0, 2.0, -2.0, 2.0]
    assert first_train(shape="step", from_s=1.5) == [0.0] * 3 + [2.0] * 5
    assert first_train(shape="square", period_s=2.0) == [2.0, 2.0, -2.0, -2.0] * 2
    assert first_train(shape="square", period_s=2.0, phase_rad=np.pi) == [-2.0, -2.0, 2.0, 2.0] * 2
    sine = first_train(shape="sine", period_s=4.0, phase_rad=0.3, from_s=1.0)
    np.testing.assert_allclose(sine[2:], 2 * np.sin(2 * np.pi * np.arange(6) * T / 4 + 0.3))
    assert sine[:2] == [0.0, 0.0]
    assert first_train(shape="table", values=[1, -0.5, 0], from_s=1.0) == [0, 0, 2.0, -1.0, 0, 0, 0, 0]
    assert first_train(shape="constant", from_s=1.0, to_s=2.0) == [0, 0, 2.0, 2.0, 0, 0, 0, 0]


def test_a_gust_acts_by_position() -> None:
    gust = {"on": "input", "shape": "gust", "amplitude_mps2": -0.2, "from_m": 500.0, "to_m": 1000.0}
    np.testing.assert_array_equal(series(gust)[0].input, [0.0, -0.2, 0.0])
    np.testing.assert_array_equal(series(gust, position=HERE + 499.0)[0].input, [0.0, -0.2, 0.0])
    np.testing.assert_array_equal(series(gust, position=HERE - 1.0)[0].input, [-0.2, 0.0, 0.0])


def test_channels_trains_and_sums() -> None:
    s = series(
        {"on": "position", "shape": "constant", "amplitude_m": [0.1, 0.2, 0.3]},
        {"on": "position", "train": [3, "1"], "shape": "constant", "amplitude_m": [1.0, 2.0]},
        {"on": "resistance", "train": 2, "shape": "constant", "error_percent": -20},
        {"on": "measurement", "shape": "alternating", "amplitude_m": 5.0},
    )[1]
    np.testing.assert_allclose(s.position, [2.1, 0.2, 1.3])
    np.testing.assert_allclose(s.resistance, [1.0, 0.8, 1.0])
    np.testing.assert_array_equal(s.measurement, [-5.0] * 3)
    np.testing.assert_array_equal(s.speed, 0.0)


def test_nothing_disturbs_nothing() -> None:
    (s,) = series(steps=1)
    for name, row in s._asdict().items():
        np.testing.assert_array_equal(row, 1.0 if name == "resistance" else 0.0)


def test_worst_case_takes_the_signs_of_the_law() -> None:
    asked = []

    def worst(plus: int, minus: int, steps: int) -> Floats:
        asked.append((plus, minus, steps))
        return np.arange(5 * steps * 3).reshape(5, steps, 3) % 2 * 2.0 - 1.0

    e = entry(on="speed", train=[3, 1], shape="worst_case", amplitude_mps=[0.1, 0.2], pair=[1, 3], peak_s=2.0)
    signals = d.signals([e], IDS, T, None, worst)
    assert asked == [(0, 2, 4)]
    signs = worst(0, 2, 4)
    for k in range(6):
        wanted = np.zeros(3) if k >= 4 else signs[d.SPEED, k] * [0.2, 0.0, 0.1]
        np.testing.assert_array_equal(d.at(signals, k, k * T, HERE).speed, wanted)


# --- noise ---


NOISE = {"on": "speed", "shape": "uniform", "amplitude_mps": 1.0}


def noise(steps: int = 2000, ids: tuple[str, ...] = IDS, seed: int | None = 1, before: int = 0, **changes: Any) -> Floats:
    quiet = {"on": "speed", "shape": "constant", "amplitude_mps": 0.0}
    signals = d.signals([*[entry(**quiet)] * before, entry(**{**NOISE, **changes})], ids, T, seed)
    return np.array([d.at(signals, k, k * T, np.zeros(len(ids))).speed for k in range(steps)])


def test_noise_has_its_moments_and_no_memory() -> None:
    """Five standard errors of 6000 numbers."""
    u = noise()
    assert np.all(np.abs(u) < 1.0)
    assert abs(u.mean()) < 5 * np.sqrt(1 / 3 / u.size)
    assert u.var() == pytest.approx(1 / 3, abs=5 * np.sqrt(4 / 45 / u.size))
    g = noise(shape="gaussian", std_mps=0.5, amplitude_mps=None)
    assert abs(g.mean()) < 5 * 0.5 / np.sqrt(g.size)
    assert g.std() == pytest.approx(0.5, abs=5 * 0.5 / np.sqrt(2 * g.size))
    assert np.abs(g).max() > 1.2
    for x in (u, g):
        between = np.corrcoef(np.concatenate((x[1:], x[:-1]), axis=1).T) - np.eye(6)
        assert np.abs(between).max() < 5 / np.sqrt(len(x))


def test_gaussian_is_cut_off_at_the_amplitude() -> None:
    g = noise(shape="gaussian", std_mps=0.5, amplitude_mps=0.4)
    assert np.abs(g).max() == 0.4


def test_noise_depends_on_seed_entry_train_and_step_alone() -> None:
    u = noise(50)
    signals = d.signals([entry(**NOISE)], IDS, T, 1)
    np.testing.assert_array_equal(d.at(signals, 37, 37 * T, HERE).speed, u[37])  # a resumed run
    np.testing.assert_array_equal(noise(50, ids=("3", "7", "1"))[:, [2, 0]], u[:, [0, 2]])  # other trains, other order
    for other in (noise(50, seed=2), noise(50, seed=1 + 2**32), noise(50, before=1)):
        assert not np.any(other == u)


def test_own_seed_makes_an_entry_independent_of_the_others() -> None:
    quiet = entry(on="speed", shape="constant", amplitude_mps=0.0)
    own = entry(**NOISE, seed=5)
    alone, behind = d.signals([own], IDS, T, 1), d.signals([quiet, own], IDS, T, None)
    np.testing.assert_array_equal(d.at(alone, 3, 1.5, HERE).speed, d.at(behind, 3, 1.5, HERE).speed)


# --- extent ---


def test_greatest_and_steady_values() -> None:
    e = entry(on="resistance", train=[2, 3], shape="constant", error_percent=[-20, 10])
    np.testing.assert_allclose(e.maximum(IDS)[d.RESISTANCE], [0.0, 0.2, 0.1])
    steady = e.steady(IDS)
    assert steady is not None
    np.testing.assert_allclose(steady[d.RESISTANCE], [0.0, -0.2, 0.1])
    assert entry(**NOISE).steady(IDS) is None
    assert entry(on="speed", shape="constant", amplitude_mps=1, to_s=5.0).steady(IDS) is None
    assert np.all(entry(on="speed", shape="gaussian", std_mps=1).maximum(IDS)[d.SPEED] == np.inf)
    assert np.all(entry(on="speed", shape="gaussian", std_mps=1, amplitude_mps=3).maximum(IDS)[d.SPEED] == 3.0)


# --- mistakes ---


def words(**table: Any) -> str:
    with pytest.raises(ValidationError) as caught:
        entry(**table)
    return "\n".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in caught.value.errors())


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"on": "speed", "shape": "constant", "amplitude": 1}, ["amplitude: the key must carry the unit", "amplitude_mps (speed)"]),
        ({"on": "speed", "shape": "gaussian", "std": 0.1}, ["std: the key must carry the unit"]),
        ({"on": "speed", "shape": "constant", "amplitude_m": 0.1}, [
            "amplitude_mps: missing", "amplitude_m: wrong unit, on = speed takes amplitude_mps"]),
        ({"on": "resistance", "shape": "constant", "amplitude_mps2": 1}, ["takes error_percent"]),
        ({"on": "input", "shape": "gaussian", "amplitude_mps2": 1}, ["std_mps2: missing"]),
        ({"on": "input", "shape": "constant", "amplitude_mps2": 1, "std_mps2": 1}, ["std_mps2: on = input with shape = constant"]),
        ({"on": "input", "shape": "sine", "amplitude_mps2": 1}, ["period_s: missing, shape = sine needs it"]),
        ({"on": "input", "shape": "constant", "amplitude_mps2": 1, "seed": 1}, ["seed: shape = constant does not take it"]),
        ({"on": "input", "shape": "gust", "amplitude_mps2": 1, "from_m": 5.0}, ["to_m: missing"]),
        ({"on": "input", "shape": "gust", "amplitude_mps2": 1, "from_m": 5.0, "to_m": 5.0}, ["to_m = 5: must be beyond"]),
        ({"on": "input", "shape": "step", "amplitude_mps2": 1}, ["from_s: missing"]),
        ({"on": "input", "shape": "constant", "amplitude_mps2": 1, "from_s": 5, "to_s": 4}, ["must be after from_s = 5"]),
        ({"on": "input", "shape": "table", "amplitude_mps2": 1, "values": [0, 2]}, ["values.1", "less than or equal to 1"]),
        ({"on": "input", "shape": "worst_case", "amplitude_mps2": 1, "pair": [1, 1]}, ["peak_s: missing", "names one train twice"]),
        ({"on": "input", "train": [1, 2], "shape": "constant", "amplitude_mps2": [1, 2, 3]}, ["one value for each of train"]),
        ({"on": "input", "shape": "gaussian", "std_mps2": [-1, 1]}, ["must not be negative"]),
        ({"on": "wind", "shape": "breeze"}, ["on: ", "shape: "]),
    ],
)  # fmt: skip
def test_mistakes_in_a_table(table: dict[str, Any], said: list[str]) -> None:
    text = words(**table)
    for word in said:
        assert word in text


def test_all_mistakes_of_a_table_come_at_once() -> None:
    text = words(on="position", shape="sine", amplitude_mps=1, seed=2, from_s=5, to_s=1)
    for word in ("amplitude_m: missing", "amplitude_mps: wrong unit", "seed: shape", "period_s: missing", "to_s = 1"):
        assert word in text


def test_mistakes_that_need_the_scenario() -> None:
    tables = [
        {**NOISE},
        {"on": "input", "train": 9, "shape": "constant", "amplitude_mps2": 1},
        {"on": "input", "shape": "constant", "amplitude_mps2": [1, 2]},
        {"on": "input", "shape": "worst_case", "amplitude_mps2": 1, "pair": [1, 8], "peak_s": 1000},
        {**NOISE, "seed": 3},
    ]
    found = d.violations([entry(**t) for t in tables], IDS, None, worst=False)
    assert [f.split(":")[0] for f in found] == [
        "disturbance[1].shape = uniform",
        "disturbance[2].train = 9",
        "disturbance[3].amplitude_mps2 = [1.0, 2.0]",
        "disturbance[4].pair = 8",
        "disturbance[4].shape = worst_case",
    ]
    assert "needs a seed" in found[0]
    assert len(d.violations([entry(**t) for t in tables], IDS, 0, worst=True)) == 3


def test_the_schema_does_not_offer_keys_without_a_unit() -> None:
    keys = d.Disturbance.model_json_schema()["properties"]
    assert "amplitude_mps2" in keys
    assert "amplitude" not in keys
    assert "std" not in keys
