"""Every mistake a user can make in a scenario: one line each, all at once, exit code 2, nothing left on disk."""

from __future__ import annotations

import pytest

PAPER = 'extends = "fully_distributed"\n'
TWO_TRAINS = """
schema_version = 1
title = "t"
[run]
duration_s = 10
[network]
line = "three_tracks"
[controller]
law = "fully_distributed"
[reference]
speed_mps = 80.0
[bounds]
speed_lower_mps = 75.0
speed_upper_mps = 85.0
input_lower_mps2 = -11.0
input_upper_mps2 = 11.0
[train_type.point]
unit_mass_kg = 1.0
c0_n_per_kg = 0.01
c1_ns_per_m_kg = 0.0
c2_ns2_per_m2_kg = 0.0
"""


def train(number, position, speed=80.0):
    return f'[[train]]\nid = {number}\ntype = "point"\ntrack = 1\nposition_m = {position}\nspeed_mps = {speed}\n'


CASES = {
    "unknown key": (PAPER + "[run]\ndt = 1\n", ["run.dt: unknown key; known: duration_s"]),
    "unknown key of the law": (PAPER + "[controller]\nkv = 1.0\n", ["controller.kv: unknown key; known: eta, join"]),
    "near miss": (PAPER + "[run]\nduraton_s = 1\n", ["run.duraton_s: unknown key; did you mean duration_s?"]),
    "wrong type": (PAPER + '[bounds]\nspeed_upper_mps = "85"\n', ['bounds.speed_upper_mps = "85": input should be a valid number']),
    "wrong unit": (PAPER + "[[train]]\nid = 1\nspeed_kmh = 288\n", ["train[1].speed_kmh: unknown key"]),
    "below a bound": (PAPER + "[[train]]\nid = 2\nspeed_mps = 91.0\n", ["train[2].speed_mps = 91: above speed_upper_mps = 85"]),
    "outside (13)": (PAPER + "[[train]]\nid = 2\nposition_m = 23950.0\n", ["spacing at the start is 50 m", "eq. (13), is 53 m"]),
    "graph not connected": (
        TWO_TRAINS + "[topology]\nrule = 'links'\nspacing_m = 5000.0\n" + train(1, 9000) + train(2, 4000) + train(3, 500)
        + "[[link]]\nbetween = [1, 2]\n",
        ["topology: the graph of the [[link]] tables is not connected: 1, 2 | 3"],
    ),
    "cycle": (
        TWO_TRAINS + "[topology]\nspacing_m = 5000.0\n" + train(1, 11000) + train(2, 6000) + train(3, 500)
        + "[[link]]\nbetween = [1, 3]\ndesired_m = 11000.0\nextra = true\n",
        ["around the cycle 3-2-1-3 sum to -1000 m, must be 0"],
    ),
    "off the line": (PAPER + "[[train]]\nid = 1\nposition_m = 480001.0\n", ["train[1].position_m = 480001: off the line"]),
    "overlap": (
        'extends = "three_tracks"\n[[train]]\nid = 2\nposition_m = 24100.0\n',
        ["train[2].position_m = 24100: overlaps train 1 on track 1, whose rear is at 24080 m"],
    ),
    "no such crossover": (
        PAPER + '[[event]]\nkind = "reroute"\ntrain = 2\ncrossover = "nowhere"\n',
        ["event[1].crossover = nowhere: no such crossover; next on track 1:"],
    ),
    "crossover of another track": (
        PAPER + '[[event]]\nkind = "reroute"\ntrain = 5\ncrossover = "leave"\n',
        ["event[1].crossover = leave: leaves track 1, train 5 is on track 2"],
    ),
    "switch certainly passed": (
        PAPER + '[[event]]\nkind = "reroute"\ntrain = 2\ncrossover = "leave"\ntime_s = 1100\n',
        ["event[1].crossover = leave: its switch at 99945 m has been passed"],
    ),
    "switch passed when the time comes": (
        PAPER + '[[event]]\nkind = "reroute"\ntrain = 2\ncrossover = "leave"\ntime_s = 1010\n',
        ["event[1]: crossover leave: its switch at 99945 m lies behind", "train 2 is at 1007"],
    ),
    "missing net": (PAPER + '[network]\nline = 1\n', ["network.line = 1: input should be a valid string"]),
    "no such line": (PAPER + '[network]\nline = "four"\n', ["network.line = four: no such line; known: fast_crossovers, single_track, three_tracks"]),
    "no such law": (PAPER + '[controller]\nlaw = "magic"\n', ["controller.law = magic: no such law; known:"]),
    "loss without seed": (PAPER + "[topology]\nloss = 0.1\n", ["topology.loss = 0.1: losses are random, so the run needs [run] seed"]),
    "units of the wrong number": (
        'extends = "three_tracks"\n[train_type.emu]\nunit_mass_kg = [1.0, 2.0]\n',
        ["train_type.emu: unit_mass_kg has 2 values: units = 4"],
    ),
    "mass not positive": (
        'extends = "three_tracks"\n[train_type.emu]\nunit_mass_kg = -5.0\n', ["train_type.emu: unit_mass_kg = -5: must be above 0"],
    ),
    "control period too short": (
        'extends = "three_tracks"\n[run]\ncontrol_period_s = 6.0\n', ["run.control_period_s above 6.26537"],
    ),
    "lower bound inside a train": (
        'extends = "three_tracks"\n[topology]\nlower_m = 100.0\n', ["spacing is front to front, and train 1 is 320 m"],
    ),
    "line too short": (PAPER + "[run]\nduration_s = 6000\n", ["run.duration_s = 6000: at the reference speed train 1 reaches 504000 m"]),
    "not TOML": ("a = = 3", ["not a TOML file"]),
    "extends itself": ('extends = "mistaken.toml"\n', ["leads back to itself"]),
}  # fmt: skip


EMU, ROBUST, FAULTY = (f'extends = "{name}"\n' for name in ("emu_finite_time", "robust_constrained", "fault_tolerant"))
FAULT = '[[fault]]\ntrain = 1\nunit = 2\nkind = "constant"\namplitude_n_per_s = 2e5\n'
CASES |= {
    "unit data missing": (
        'extends = "three_tracks"\n[train_type.other]\nunits = 2\nunit_length_m = 80.0\n', ["train_type.other.unit_mass_kg: missing"],
    ),
    "coupler outside its range": (
        EMU + "[[train]]\nid = 1\ncoupler_m = [0.0, 0.12, 0.0]\n", ["train 1: coupler 2 = 0.12 m: must start inside (-0.1, 0.1) m"],
    ),
    "couplers of the wrong number": (
        EMU + "[[train]]\nid = 1\ncoupler_m = [0.0, 0.12]\n", ["train[1].coupler_m: has 2 values, the type has 3 couplers"],
    ),
    "p1 below k/m": (EMU + "[controller]\np_1 = 2.0\n", ["controller.p_1 = 2: must exceed coupler stiffness over mass, 2 1/s2"]),
    "step too large for the law": (EMU + "[run]\nsub_step_s = 0.05\n", ["run.sub_step_s = 0.05: at most 0.0101 s"]),
    "couplers damped too hard": (
        EMU + "[plant]\nin_train_damping_per_s = 100.0\n",
        ["plant.in_train_damping_per_s = 100: at most 62.5 with integration steps of 0.01 s"],
    ),
    "stiff couplers through slow actuators": (
        FAULTY + "[plant]\nin_train_stiffness_per_s2 = 400.0\n",
        ["plant.in_train_stiffness_per_s2 = 400: at most 100, half of in_train_damping_per_s times the slowest actuator rate"],
    ),
    "step that never ends": (EMU + "[run]\nsub_step_s = 5e-324\n", ["run.sub_step_s = 5e-324: "]),
    "interval too short": (
        EMU + "[[train]]\nid = 2\nposition_m = 107500.0\n", ["trains 1 and 2: interval = 980.0 m: must start above emergency_distance_m"],
    ),
    "negative weight": (ROBUST + "[topology]\nweight = -0.01\n", ["link[2 > 1].weight = -0.01: must be above 0"]),
    "not strongly connected": (
        ROBUST + '[topology]\nrule = "links"\n[[link]]\nsender = 1\nreceiver = 2\n[[link]]\nsender = 2\nreceiver = 3\n'
        "[[link]]\nsender = 3\nreceiver = 4\n",
        ["the graph must be strongly connected", "what train 4 sends does not reach train 1, train 2, train 3"],
    ),
    "h T not below 1": (ROBUST + "[controller]\nh_per_s = 1.5\n", ["controller.h_per_s = 1.5: h T = 1.2 with T = 0.8 s"]),
    "v0 above the maximum": (ROBUST + "[reference]\nspeed_mps = 90.0\n", ["reference.speed_mps = 90: must be below the maximum speed 85"]),
    "amplitude without unit": (
        ROBUST + '[[disturbance]]\non = "position"\nshape = "constant"\namplitude = 0.1\n', ["the key must carry the unit: amplitude_m"],
    ),
    "noise without seed": (
        ROBUST + '[[disturbance]]\non = "position"\nshape = "gaussian"\nstd_m = 0.1\n', ["random, so it needs a seed, [run] seed"],
    ),
    "tables against the order of positions": (
        ROBUST + "[[train]]\nid = 3\nposition_m = 22000.0\n",
        ["train[3].position_m = 22000: ahead of train 2 at 18500 m, whose table comes before", "track 1 must go front to rear"],
    ),
    "outside (39)": (
        FAULTY + "[[train]]\nid = 3\nposition_m = 4000.0\n", ["distance error -4948 m is not between -2351 and 1947 m", "condition (39)"],
    ),
    "gains per carriage of the wrong length": (
        FAULTY + "[controller]\ncarriage_l1 = [0.1, 0.2]\nhead_l4 = [1.0, 1.0]\n[observer]\npole_per_s = [-3.0, -3.0, -2.0, -3.0]\n",
        [
            "controller.carriage_l1 = [0.1, 0.2]: has 2 values, it takes one number, or a list of 3 (the carriages of a train) or 9",
            "controller.head_l4 = [1, 1]: has 2 values, it takes one number, or a list of 3 (all trains)",
            "observer.pole_per_s = [-3, -3, -2, -3]: has 4 values",
        ],
    ),
    "gains outside (38)": (
        FAULTY + "[controller]\nhead_l2 = 2.0\nhead_l3 = 4.0\nhead_l4 = 0.4\n",
        ["head_l2 = 2: must be above 2", "head_l3 = 4: must be above", "head_l4 = 0.4: must be above 1/2"],
    ),
    "unobservable fault model": (FAULTY + "[observer]\nfault_constant_n_per_s = 0.0\n", ["the constant fault is unobservable"]),
    "window ends before it starts": (
        FAULTY + FAULT + "start_s = 400\nend_s = 300\n", ["end_s = 300: the window ends before it starts, start_s = 400"],
    ),
    "windows overlap": (
        FAULTY + FAULT + "start_s = 400\nend_s = 800\n" + FAULT + "start_s = 700\nend_s = 900\n",
        ["fault[2].start_s = 700: this constant of train 1 unit 2 overlaps fault[1], 400 to 800 s"],
    ),
    "step too large for an active limit": (
        'extends = "fault_tolerant_force_limit"\n[run]\nsub_step_s = 0.1\n', ["run.sub_step_s = 0.1: too large where a force limit acts"],
    ),
    "wrong plant": (FAULTY + '[plant]\nkind = "coupled_units"\n', ["plant.kind = coupled_units: law fault_tolerant runs on actuated_units"]),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_each_mistake_is_told_in_words(case, typed, tmp_path):
    text, expected = CASES[case]
    (tmp_path / "mistaken.toml").write_text(text)
    code, lines = typed("run", "mistaken.toml", "--backend", "numeric")
    assert code == 2
    assert all(line.startswith("mistaken.toml: ") for line in lines)
    for part in expected:
        assert any(part in line for line in lines), lines
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == ["mistaken.toml"]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ('extends = "fault_tolerant"\n[controller]\ncarriage_l1 = [0.1, 0.1]\n', "controller.carriage_l1 = [0.1, 0.1]: has 2 values, it takes"),
        ('extends = "fault_tolerant"\n[controller]\ncarriage_l1 = [0.1, -0.1, 0.1]\n', "controller.carriage_l1[2] = -0.1: input should be greater than 0"),
        ('extends = "fault_tolerant"\n[controller]\nhead_l4 = "x"\n', 'controller.head_l4 = "x": input should be a valid number'),
        ('extends = "emu_finite_time"\n[controller]\np_1 = [1, "a"]\n', 'controller.p_1 = [1, "a"]: input should be a valid number'),
        ('extends = "emu_finite_time"\n[train_type.emu]\nunit_mass_kg = [6e4, 8e4]\n', "train_type.emu: unit_mass_kg has 2 values: units = 4 of them"),
        ('extends = "emu_finite_time"\n[train_type.emu]\nunit_mass_kg = [6e4, "x", 8e4, 8e4]\n', 'train_type.emu.unit_mass_kg[2] = "x": input should be'),
    ],
)  # fmt: skip
def test_one_line_for_a_mistake_in_a_list(text, line, typed, tmp_path):
    """Neither that a list is no number, nor that trains have no type because their type is wrong."""
    (tmp_path / "mistaken.toml").write_text(text)
    code, lines = typed("check", "mistaken.toml")
    assert code == 2
    assert len(lines) == 1 and line in lines[0], lines


def test_all_mistakes_come_at_once(typed, tmp_path):
    text = PAPER + (
        '[run]\nduration_s = "long"\ndt = 3\n[bounds]\nspeed_upper_mps = "85"\n[[train]]\nid = 3\nposition_m = -5.0\n'
        '[[event]]\nkind = "reroute"\ntrain = 2\ncrossover = "nowhere"\n'
    )
    (tmp_path / "mistaken.toml").write_text(text)
    code, lines = typed("check", "mistaken.toml")
    assert code == 2
    for key in (
        'run.duration_s = "long"',
        "run.dt:",
        'bounds.speed_upper_mps = "85"',
        "train[3].position_m = -5",
        "event[1].crossover",
    ):
        assert sum(f"mistaken.toml: {key}" in line for line in lines) == 1, lines
    assert not any("speed_upper_mps = inf" in line for line in lines), "what follows from a mistake is not another one"


def test_a_net_that_is_missing_or_not_rail(typed, tmp_path):
    (tmp_path / "road.net.xml").write_text('<net><edge id="e"><lane id="e_0" speed="1" length="1" shape="0,0 1,0"/></edge></net>')
    for name, words in (("gone.net.xml", "no such net file"), ("road.net.xml", "has no rail edges")):
        (tmp_path / "mistaken.toml").write_text(f'{PAPER}[network]\nnet = "{name}"\n')
        code, lines = typed("check", "mistaken.toml")
        assert code == 2
        assert any(words in line for line in lines), lines


def test_a_folder_that_is_not_ours_is_not_touched(typed, tmp_path):
    other = tmp_path / "mine"
    other.mkdir()
    (other / "thesis.tex").write_text("precious")
    code, lines = typed("run", "fully_distributed", "--backend", "numeric", "--set", "run.duration_s=2", "--out", "mine")
    assert code == 2
    assert "is not a run of trainctl" in lines[0]
    assert (other / "thesis.tex").read_text() == "precious"
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_unknown_scenario_has_a_hint(typed):
    code, lines = typed("run", "fully_distributd")
    assert code == 2
    assert lines == ["fully_distributd: no such scenario (see `trainctl list`) and no such file; did you mean fully_distributed?"]


def test_a_folder_whose_name_sumo_cannot_read_is_refused(typed, tmp_path):
    code, lines = typed("run", "fully_distributed", "--out", "a,b")
    assert code == 2 and len(lines) == 1 and "a comma for the end of a file's name" in lines[0]
    assert not list(tmp_path.glob("a*"))


def test_mistakes_of_all_kinds_come_in_one_round(tmp_path, typed):
    """Tables that cannot be read, names and keys of law and plant, tracks and places on the line."""
    (tmp_path / "s.toml").write_text(
        """
schema_version = 1
title = 5
[run]
duration_s = -1.0
[network]
line = "three_tracks"
[controller]
law = "fully_distributed"
joined = "ratchet"
[observer]
kind = "nobody"
[plant]
kind = "points"
[topology]
spacing_m = 1000.0
[[train]]
id = "a"
type = "e"
track = 9
position_m = -5.0
speed_mps = 80.0
[train_type.e]
unit_mas_kg = 5e4
"""
    )
    code, told = typed("check", "s.toml")
    assert code == 2
    for mistake in (
        "title = 5: input should be", "run.duration_s = -1.0: input should be", "reference: missing", "train_type.e.unit_mas_kg: unknown key",
        "train_type.e.unit_mass_kg: missing", "controller.joined: unknown key", "observer.kind = nobody: no such", "plant.kind = points: no such",
        "train[a].track = 9: no such track", "train[a].position_m = -5: off the line",
    ):  # fmt: skip
        assert sum(f"s.toml: {mistake}" in line for line in told) == 1, (mistake, told)


def test_a_line_that_is_not_there_is_told_with_the_rest(tmp_path, typed):
    (tmp_path / "s.toml").write_text(
        'extends = "fully_distributed"\ntitle = 5\n[run]\nduration_s = "x"\n[network]\nline = "nowhere.toml"\n'
    )
    code, told = typed("check", "s.toml")
    assert (code, len(told)) == (2, 3) and any("nowhere.toml" in line for line in told)
