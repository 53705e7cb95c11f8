"""Every mistake in traffic of a SUMO configuration: clear words, exit code 2, nothing left on disk. The test of scenarios is beside."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from trainctl.errors import SimulatorError

MERGING = Path(__file__).resolve().parents[3] / "scenarios"


@pytest.fixture
def typed(typed, tmp_path):
    """Type a command where a copy of the scenario ``merging`` lies: exit code and the lines on stderr."""
    shutil.copytree(MERGING / "merging", tmp_path / "merging")
    shutil.copy(MERGING / "merging.toml", tmp_path / "mistaken.toml")
    return typed


def added(text):
    return "mistaken.toml", None, text


ROUTES, NET, CONFIGURATION = (f"merging/merging.{kind}" for kind in ("rou.xml", "net.xml", "sumocfg"))
ROAD = '<net><edge id="e"><lane id="e_0" speed="1" length="1" shape="0,0 1,0"/></edge></net>'
UNITS = """[train_type.emu]
units = 4
unit_length_m = 25.0
unit_mass_kg = 50000.0
coupler_stiffness_n_per_m = 1e6
coupler_damping_ns_per_m = 1e4
traction_n = 50000.0
braking_n = 45000.0
"""

#: What is changed in which file -> what is told. (file, old, new); old None: put at the end; new None: the file is gone.
CASES = {
    "no rail edges": ([(NET, "", ROAD)], ["merging.net.xml: has no rail edges"]),
    "net is not a net": ([(NET, "", "<routes/>")], ["merging.net.xml: not a SUMO net: its root element is <routes>, not <net>"]),
    "no such net": ([(NET, "", None)], ["merging.net.xml: no such file"]),
    "route not connected": (
        [(ROUTES, "from_west trunk beyond to_east", "from_west from_south")],
        ["fast", "from_west", "from_south"],
    ),
    "route over an edge that is not there": ([(ROUTES, "from_south trunk", "from_north trunk")], ["branch", "from_north"]),
    "vType without data": (
        [("mistaken.toml", "[train_type.emu]", "[train_type.other]")],
        ["vType emu: no mass, no maxPower", "add [train_type.emu] or, for all such types,"],
    ),
    "no such configuration": ([(CONFIGURATION, "", None)], ["merging.sumocfg: no such file"]),
    "configuration is not XML": ([(CONFIGURATION, "", "nonsense")], ["merging.sumocfg: not XML: "]),
    "configuration is neither": (
        [(CONFIGURATION, "", "<net/>")], ["merging.sumocfg: not a SUMO configuration: it begins with <net>, not <sumoConfiguration>"],
    ),
    "configuration without routes": (
        [(CONFIGURATION, '<route-files value="merging.rou.xml"/>', "")], ["merging.sumocfg: no route-files, nor additional-files with trains in them"],
    ),
    "routes are neither": ([(ROUTES, "", "<net/>")], ["merging.sumocfg: no trains: no vehicle, trip or flow has a vType of a rail class"]),
    "trains of its own": (
        [added('[[train]]\nid = 1\ntype = "emu"\ntrack = "trunk"\nposition_m = 0.0\nspeed_mps = 0.0\n')],
        ["train: not with network.sumocfg, whose own trains run"],
    ),
    "spacing missing": ([("mistaken.toml", "spacing_m = 1000.0", "")], ["topology.spacing_m: missing; trains of a SUMO configuration"]),
    "reference of another form": (
        [("mistaken.toml", "speed_mps = 36.0 ", "speed_by_position = [[0.0, 36.0]] ")],
        ["reference: with network.sumocfg give speed_mps, the cruising speed"],
    ),
    "nobody of that name cooperates": (
        [added('[traffic]\ncooperate = ["fast.*", "slow.*"]\n')],
        ["traffic.cooperate = slow.*: no train of that name; there are: fast.0, branch.0"],
    ),
    "units for points": (
        [("mistaken.toml", "[train_type.emu]\nunit_length_m = 100.0\nunit_mass_kg = 200000.0\n", UNITS)],
        ["train_type.emu.units = 4: the point plant has one unit per train"],
    ),
    "no such edge to go to": (
        [added('[[event]]\nkind = "reroute"\ntrain = "fast.0"\nto_edge = "to_south"\n')],
        ["event[1].to_edge = to_south: no such edge for trains; there are: "],
    ),
    "no such train to reroute": (
        [added('[[event]]\nkind = "reroute"\ntrain = "slow"\nto_edge = "to_north"\n')],
        ["event[1].train = slow: no such train; there are: fast.0, branch.0"],
    ),
    "a track to go to": (
        [added('[[event]]\nkind = "reroute"\ntrain = "fast.0"\nto_track = 1\n')], ["event[1]: with network.sumocfg give to_edge"],
    ),
    "supervisor beyond the brakes": (
        [
            ("mistaken.toml", 'kind = "point"', 'kind = "coupled_units"'),
            ("mistaken.toml", "[train_type.emu]\nunit_length_m = 100.0\nunit_mass_kg = 200000.0\n", UNITS),
            added("[supervisor]\nemergency_mps2 = 1.2\n"),
        ],
        ["supervisor.emergency_mps2 = 1.2: train fast.0 can brake with 0.9"],
    ),
    "service braking above emergency": (
        [added("[supervisor]\nemergency_mps2 = 0.5\nservice_mps2 = 0.6\n")],
        ["supervisor: service_mps2 = 0.6: at most emergency_mps2 = 0.5"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_mistake_is_told_in_words(case, typed, tmp_path):
    changes, expected = CASES[case]
    for file, old, new in changes:
        place = tmp_path / file
        if new is None:
            place.unlink()
        elif old:
            assert old in place.read_text()
            place.write_text(place.read_text().replace(old, new))
        else:
            place.write_text(place.read_text() + new if old is None else new)
    before = sorted(tmp_path.rglob("*"))
    code, lines = typed("run", "mistaken.toml", "--backend", "numeric")
    assert code == 2
    assert lines and all(line.startswith("mistaken.toml: ") for line in lines), lines
    for part in expected:
        assert any(part in line for line in lines), lines
    assert len(set(lines)) == len(lines)
    assert sorted(tmp_path.rglob("*")) == before


def test_what_such_runs_cannot_do_is_said_at_once(typed, tmp_path):
    code, lines = typed("run", "mistaken.toml", "--set", "controller.law=sumo", "--set", "controller.block=fixed", "--out", "r")
    assert code == 2 and "merging.net.xml has no rail signals" in lines[0]
    assert not (tmp_path / "r").exists() and not (tmp_path / "r.partial").exists()


def test_a_run_that_broke_off_is_not_shown_but_begun_again(typed, tmp_path, monkeypatch):
    def broken(*_):
        raise SimulatorError("pulled the plug")

    with monkeypatch.context() as patch:
        patch.setattr("trainctl.numeric.Numeric.move", broken)
        code, _ = typed("run", "mistaken.toml", "--backend", "numeric", "--set", "run.duration_s=16", "--out", "r")
    assert code == 3
    assert typed("replay", "r.partial", "--gui-program", "sumo")[0] == 2
    assert typed("resume", "r", "-q") == (0, [])
    assert (tmp_path / "r" / "metrics.json").exists()


def test_a_net_of_another_origin_is_not_a_line(typed, tmp_path):
    (tmp_path / "line.toml").write_text('extends = "three_tracks"\n[network]\nnet = "merging/merging.net.xml"\n')
    code, lines = typed("check", "line.toml")
    assert code == 2
    assert "others run with network.sumocfg" in lines[0]
