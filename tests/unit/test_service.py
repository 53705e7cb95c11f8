"""What the service decides, on scenarios that are prepared but not run."""

from __future__ import annotations

from pathlib import Path

import nets
import numpy as np
import pytest
import tomli_w

from trainctl.scenario.build import Prepared, open_scenario
from trainctl.stages.convoys import Service


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("line")
    nets.separate(folder)
    return folder


def prepared(folder: Path, law: str, **changes: object) -> Prepared:
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario(law, 100, **changes)))
    return open_scenario(str(folder / "s.toml"))


def test_a_formation_keeps_to_speeds_its_law_takes(line):
    """Assumption 2.4 of the fully distributed law, solved for the reference speed by hand."""
    p = prepared(line, "fully_distributed")
    service = Service(p)
    period, bounds = 5.0, p.bounds
    resistance = p.consists.train_davis()[0]
    f, F = (float(resistance @ [1.0, v, v * v]) for v in (bounds.speed_lower[0], bounds.speed_upper[0]))
    assert service.least == pytest.approx(38.0 - (f + 1.0) * period, abs=0.06)
    assert service.greatest == pytest.approx(31.0 + (1.0 - F) * period, abs=0.06)


def test_a_law_without_least_speed_follows_down_to_a_stand(line):
    assert Service(prepared(line, "emu_finite_time")).least == 0.0


def test_trains_of_one_edge_come_one_by_one(line):
    service = Service(prepared(line, "robust_constrained"))
    names = [service.p.scenario.ids[i] for i in service.due(200.0)]
    assert names == ["p.0", "q.0"]
    service.came[[service.p.scenario.ids.index(n) for n in names]] = True
    assert [service.p.scenario.ids[i] for i in service.due(39.0)] == []
    assert [service.p.scenario.ids[i] for i in service.due(40.0)] == ["p.1", "q.1"]


@pytest.mark.parametrize(("lower", "upper", "emergency", "greatest"), [(-1.0, 1.0, 1.065, 1.0), (-3.0, 2.0, 3.065, 2.0)])
def test_the_supervisor_leaves_a_law_what_its_bounds_allow(line, lower, upper, emergency, greatest):
    bounds = {"speed_lower_mps": 31.0, "speed_upper_mps": 38.0, "input_lower_mps2": lower, "input_upper_mps2": upper}
    rules = prepared(line, "fully_distributed", bounds=bounds).supervision
    assert rules.greatest_mps2 == greatest
    assert rules.emergency_mps2 == pytest.approx(emergency, abs=1e-3)


def test_no_braking_is_relied_on_that_the_plant_does_not_give(line):
    assert prepared(line, "robust_constrained").supervision.emergency_mps2 == 1.0
    weak = {"kind": "point", "speed_lower_mps": 0.0, "speed_upper_mps": 38.0, "input_lower_mps2": -0.6, "input_upper_mps2": 1.0}
    bounds = {k: v for k, v in weak.items() if k != "kind"}
    rules = prepared(line, "robust_constrained", plant=weak, bounds=bounds).supervision
    assert rules.emergency_mps2 == rules.service_mps2 == 0.6


def test_a_stated_limit_of_the_supervisor_stays(line):
    rules = prepared(
        line, "fully_distributed", supervisor={"emergency_mps2": 0.8, "greatest_mps2": 0.3, "service_mps2": 0.5}
    ).supervision
    assert (rules.mode, rules.emergency_mps2, rules.greatest_mps2) == ("on", 0.8, 0.3)


def test_nothing_but_a_chain_counts_as_led(line):
    service = Service(prepared(line, "robust_constrained"))
    assert not service.led.any()
    service.ahead[1] = 0
    assert np.flatnonzero(service.led).tolist() == [0, 1]
