"""`trainctl new scenario`: what it writes runs, whatever trains the configuration has."""

from __future__ import annotations

import nets
import pytest

from trainctl.errors import InputError
from trainctl.runner import run
from trainctl.scenario.build import open_scenario
from trainctl.scenario.starter import starter

RAIL = '<vType id="{0}" vClass="rail" carFollowModel="Rail" trainType="{0}"/>'
TYPES = {
    "plain": nets.EMU,
    "heavy": RAIL.format("Freight").replace('id="Freight"', 'id="emu"'),
    "fast": RAIL.format("NGT400").replace('id="NGT400"', 'id="emu"'),
    "weak brakes": '<vType id="emu" vClass="rail" length="300" decel="0.2"/>',
    "slow": '<vType id="emu" vClass="tram" length="30" maxSpeed="8"/>',
    "mixed": nets.EMU + RAIL.format("RB628") + '<vType id="other" vClass="rail_fast" length="50" mass="90000"/>',
}


@pytest.mark.parametrize("case", TYPES)
def test_it_fits_the_trains_found(tmp_path, case):
    nets.net(tmp_path, {"a": (0, 0), "b": (9000, 0)}, {"ab": ("a", "b", {"speed": 100, "allow": "rail rail_fast tram"})})
    others = {"mixed": nets.train("r", "ab", 60, type="RB628") + nets.train("o", "ab", 120, type="other")}.get(case, "")
    stop = '<stop lane="ab_0" endPos="4000" duration="60"/>'
    nets.traffic(tmp_path, nets.train("v", "ab", 0, stop, departSpeed="avg") + others, TYPES[case])
    (tmp_path / "s.toml").write_text(starter(tmp_path / "a.sumocfg", tmp_path))
    found = run(open_scenario(str(tmp_path / "s.toml")), tmp_path / "out", "numeric")
    kinds = [e["kind"] for e in found.events]
    assert kinds.count("arrive") == 1 + 2 * bool(others) and kinds.count("stop_left") == 1
    assert "violation" not in kinds


def test_the_command_writes_it_and_run_says_so(tmp_path, typed):
    nets.net(tmp_path, {"a": (0, 0), "b": (3000, 0)}, {"ab": ("a", "b")})
    nets.traffic(tmp_path, nets.train("v", "ab", 0))
    cfg = tmp_path / "a.sumocfg"
    code, told = typed("run", cfg)
    assert code == 2 and f"`trainctl new scenario {cfg}` writes one" in " ".join(told)
    made = tmp_path / "mine.toml"
    assert typed("new", "scenario", cfg, "--out", made)[0] == 0
    assert "# " in made.read_text() and 'sumocfg = "a.sumocfg"' in made.read_text()
    assert typed("check", made)[0] == 0
    assert typed("new", "scenario", cfg, "--out", made)[0] == 2


def test_what_is_wrong_with_the_configuration_is_told(tmp_path):
    nets.net(tmp_path, {"a": (0, 0), "b": (3000, 0)}, {"ab": ("a", "b")})
    nets.traffic(tmp_path, nets.train("v", "ab nowhere", 0))
    with pytest.raises(InputError, match="edge nowhere: not in the net"):
        starter(tmp_path / "a.sumocfg", tmp_path)
