"""Line descriptions: what is read, and every way they can be wrong."""

from __future__ import annotations

import copy
import re
from pathlib import Path

import pytest

import sumo_net
from sumo_net import LineError, LineSpec, parse_spec, read_spec

GOOD = {
    "name": "small", "tracks": [2, "1", 3], "length_m": 30000.0, "start_m": 1000.0,
    "speed": [[1000.0, 80.0], [20000.0, 60.0]], "gradient": [[2000.0, 10.0], [4000.0, -5.0]],
    "crossover": [{"id": "over", "from": 1, "to": 3, "position_m": 8000.0, "length_m": 400.0, "speed_mps": 40.0}],
    "regular_crossovers": {"every_m": 10000.0, "first_m": 5000.0, "length_m": 300.0, "speed_mps": 30.0},
}  # fmt: skip


def mistakes(**changed: object) -> list[str]:
    data = copy.deepcopy(GOOD) | changed
    with pytest.raises(LineError) as caught:
        parse_spec({key: value for key, value in data.items() if value is not None}, "f.toml")
    assert str(caught.value) == "\n".join(caught.value.mistakes)
    assert all(line.startswith("f.toml: ") and "\n" not in line for line in caught.value.mistakes)
    return [line.removeprefix("f.toml: ") for line in caught.value.mistakes]


def crossover(**changed: object) -> list[object]:
    more = {"from": 2, "to": 1, "position_m": 12000.0, "length_m": 400.0, "speed_mps": 40.0} | changed
    return [*GOOD["crossover"], {key: value for key, value in more.items() if value is not None}]


def test_a_good_line_is_read_with_track_ids_as_text():
    spec = parse_spec(GOOD, "f.toml")
    assert spec.tracks == ("2", "1", "3")
    assert (spec.begin_m, spec.end_m, spec.max_edge_m) == (1000.0, 31000.0, 5000.0)
    assert spec.crossover[0].from_track == "1"
    regular = {(c.from_track, c.to_track, c.position_m) for c in spec.all_crossovers() if c.id is None}
    pairs = [("2", "1"), ("1", "2"), ("1", "3"), ("3", "1")]
    assert regular == {(a, b, at) for a, b in pairs for at in (5000.0, 15000.0, 25000.0)}


def test_the_last_regular_crossover_lies_wholly_on_the_line():
    # 30750 + 300 m would end beyond 31000 m.
    spec = parse_spec(GOOD | {"regular_crossovers": GOOD["regular_crossovers"] | {"every_m": 25750.0}}, "f.toml")
    assert {c.position_m for c in spec.all_crossovers() if c.id is None} == {5000.0}


def test_signals_stand_inside_the_line_only():
    line = {"name": "plain", "tracks": ["a"], "start_m": 500.0, "speed": [[500, 10]], "signals_m": 2000.0}
    assert parse_spec(line | {"length_m": 6000.0}, "f.toml").signals() == [2500.0, 4500.0]
    assert parse_spec(line | {"length_m": 6001.0}, "f.toml").signals() == [2500.0, 4500.0, 6500.0]
    assert parse_spec(line | {"length_m": 2000.0}, "f.toml").signals() == []


def test_a_signal_too_close_to_a_switch_is_told():
    assert mistakes(signals_m=6999.5) == [
        "tracks = 1: the signal at 7999.5 m and the switch of over at 8000 m: must be one place or at least 1 m apart, not 0.5 m"
    ]
    assert mistakes(signals_m=5.0) == ["signals_m = 5.0: must be greater than or equal to 10"]
    crowded = mistakes(signals_m=10.0, length_m=1e6, crossover=[], regular_crossovers=None)
    assert crowded == ["signals_m = 10: cuts the line into 300000 blocks, at most 100000"]


def test_defaults():
    spec = parse_spec({"name": "plain", "tracks": ["a"], "length_m": 10, "speed": [[0, 10]]}, "f.toml")
    assert (spec.start_m, spec.gradient, spec.all_crossovers()) == (0.0, (), [])


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"name": "a b"}, r"name = a b: must be letters, digits or _ or - or \., and begin with a letter or digit"),
        ({"name": "-a"}, r"name = -a: must be letters"),
        ({"name": None}, r"name: missing"),
        ({"tracks": []}, r"tracks = \[\]: must have at least one item"),
        ({"tracks": [1, "1", 3], "crossover": [], "regular_crossovers": None}, r"tracks = 1: appears more than once"),
        ({"tracks": [1, 3, 2.5]}, r"tracks\[3\] = 2.5: must be a valid string"),
        ({"tracks": [1, 3, "x_y"]}, r"tracks\[3\] = x_y: must be letters, digits or \., and begin"),
        ({"length_m": -1.0}, r"length_m = -1.0: must be greater than 0"),
        ({"length_m": "30 km"}, r"length_m = 30 km: must be a valid number"),
        ({"length_m": float("inf")}, r"length_m = inf: must be (a finite number|less than)"),
        ({"start_m": -5.0}, r"start_m = -5.0: must be greater than or equal to 0"),
        ({"max_edge_m": 1.0}, r"max_edge_m = 1.0: must be greater than or equal to 10"),
        ({"max_edge_m": 10.0, "length_m": 1e6}, r"max_edge_m = 10: cuts the line into 300000 edges, at most 100000"),
        ({"sped": []}, r"sped: unknown key; did you mean speed\?; known: name, tracks, "),
        ({"speed": None}, r"speed: missing"),
        ({"speed": []}, r"speed = \[\]: must have at least one item"),
        ({"speed": [[0.0, 80.0]]}, r"speed\[1\] = \[0, 80\]: must begin where the line does, at start_m = 1000"),
        ({"speed": [[1000.0, 0.0]]}, r"speed\[1\]\[2\] = 0.0: must be greater than 0"),
        ({"speed": [[1000.0, 300.0]]}, r"speed\[1\]\[2\] = 300.0: must be less than or equal to 200"),
        ({"speed": [[1000.0, 80.0, 1.0]]}, r"speed\[1\] = \[1000.0, 80.0, 1.0\]: must be a pair \[from_m, value\]"),
        ({"speed": [[1000.0, True]]}, r"speed\[1\]\[2\] = True: must be a valid number"),
        (
            {"speed": [[1000.0, 80.0], [9000.0, 60.0], [7000.0, 50.0]]},
            r"speed\[3\] = \[7000, 50\]: from_m must increase, the one before begins at 9000 m",
        ),
        ({"speed": [[1000.0, 80.0], [40000.0, 60.0]]}, r"speed\[2\] = \[40000, 60\]: lies outside the line \(1000 to 31000 m\)"),
        ({"gradient": [[2000.0, 50.1]]}, r"gradient\[1\]\[2\] = 50.1: must be less than or equal to 50"),
        ({"gradient": [[2000.0, -51.0]]}, r"gradient\[1\]\[2\] = -51.0: must be greater than or equal to -50"),
        ({"gradient": [[500.0, 5.0]]}, r"gradient\[1\] = \[500, 5\]: lies outside the line"),
        ({"gradient": [[5000.0, 5.0], [5000.0, 6.0]]}, r"gradient\[2\] = \[5000, 6\]: from_m must increase"),
        ({"crossover": crossover(to=2)}, r"crossover\[2\].to = 2: leads from a track to itself"),
        ({"crossover": crossover(to=7)}, r"crossover\[2\].to = 7: no such track; there are: 2, 1, 3"),
        ({"crossover": crossover(**{"from": "x"})}, r"crossover\[2\].from = x: no such track; there are: 2, 1, 3"),
        (
            {"crossover": crossover(position_m=30900.0)},
            r"crossover\[2\].position_m = 30900: ends at 31300 m, must lie wholly inside",
        ),
        (
            {"crossover": crossover(position_m=30600.0)},
            r"crossover\[2\].position_m = 30600: ends at 31000 m, must lie wholly inside",
        ),
        (
            {"crossover": crossover(position_m=1000.0)},
            r"crossover\[2\].position_m = 1000: must lie inside the line, which begins at 1000 m",
        ),
        ({"crossover": crossover(position_m=-3.0)}, r"crossover\[2\].position_m = -3.0: must be greater than or equal to 0"),
        (
            {"crossover": crossover(length_m=20.0)},
            r"crossover\[2\].length_m = 20: must be at least 31.5 m to reach a track 4.5 m beside",
        ),
        (
            {"crossover": crossover(to=3, length_m=40.0)},
            r"crossover\[2\].length_m = 40: must be at least 63 m to reach a track 9 m beside",
        ),
        ({"crossover": crossover(speed_mps=None)}, r"crossover\[2\].speed_mps: missing"),
        ({"crossover": crossover(speed_mps=float("nan"))}, r"crossover\[2\].speed_mps = nan: must be a finite number"),
        (
            {"crossover": crossover(lenght_m=1.0)},
            r"crossover\[2\].lenght_m: unknown key; did you mean length_m\?; known: id, from, to, ",
        ),
        ({"crossover": crossover(id="over")}, r"crossover\[over\]: its id over is already that of crossover\[over\]"),
        (
            {"crossover": crossover(id="x1-2_5000")},
            r"regular_crossovers \(x1-2_5000\): its id x1-2_5000 is already that of crossover\[x1-2_5000\]",
        ),
        (
            {"crossover": crossover(**{"from": 1, "to": 3, "position_m": 8000.0})},
            r"crossover\[(2|over)\]: is the same as crossover\[(2|over)\], also from 1 to 3",
        ),
        (
            {"crossover": crossover(**{"from": 1, "to": 3, "position_m": 8399.0})},
            r"crossover\[2\]: overlaps crossover\[over\], also from 1 to 3, at 8000 to 8400 m",
        ),
        (
            {"crossover": crossover(position_m=14800.0)},
            r"regular_crossovers \(x2-1_15000\): overlaps crossover\[2\], also from 2 to 1",
        ),
        (
            {"crossover": crossover(**{"from": 1, "to": 2, "position_m": 7999.5})},
            r"tracks = 1: the switch of x1-2_7999.5 at 7999.5 m and the switch of over at 8000 m: must be one place or",
        ),
        ({"crossover": "none"}, r"crossover = none: must be a valid tuple"),
        ({"crossover": [7]}, r"crossover\[1\] = 7: must be a valid dictionary"),
        (
            {"regular_crossovers": {k: v for k, v in GOOD["regular_crossovers"].items() if k != "first_m"}},
            r"regular_crossovers.first_m: missing",
        ),
        (
            {"regular_crossovers": GOOD["regular_crossovers"] | {"every_m": 300.0}},
            r"regular_crossovers.every_m = 300: must be longer than length_m = 300 by 1 m",
        ),
        (
            {"regular_crossovers": GOOD["regular_crossovers"] | {"first_m": 30900.0}},
            r"regular_crossovers.first_m = 30900: the first does not lie wholly inside the line",
        ),
        (
            {"regular_crossovers": GOOD["regular_crossovers"] | {"length_m": 10.0}},
            r"regular_crossovers.length_m = 10: must be at least 31.5 m",
        ),
        (
            {"regular_crossovers": GOOD["regular_crossovers"] | {"evry_m": 1.0}},
            r"regular_crossovers.evry_m: unknown key; did you mean every_m\?",
        ),
        ({"tracks": [1], "crossover": []}, r"regular_crossovers: a line of one track has none"),
    ],
)
def test_one_mistake_gives_one_line_with_key_value_and_rule(changed, line):
    said = mistakes(**changed)
    assert len(said) == 1, said
    assert re.match(line, said[0]), said[0]


def test_many_small_regular_crossovers_are_refused_before_they_fill_the_memory():
    many = {"every_m": 40.0, "first_m": 5000.0, "length_m": 35.0, "speed_mps": 30.0}
    assert mistakes(length_m=1e7, max_edge_m=5000.0, crossover=[], regular_crossovers=many) == [
        "regular_crossovers.every_m = 40: makes 1000000 crossovers, at most 100000"
    ]


def test_all_mistakes_are_told_at_once_those_of_single_keys_and_those_between_keys():
    said = mistakes(
        sped=1,
        length_m=30000,
        speed=[[1000.0, 80.0], [9000.0, "fast"], [12000.0, 50.0], [11000.0, 40.0]],
        crossover=[
            {"from": 1, "to": 3, "position_m": 8000.0, "length_m": 400.0},
            {"from": 1, "to": 9, "position_m": 9000.0, "length_m": 400.0, "speed_mps": 40.0},
            {"from": 2, "to": 1, "position_m": 9500.0, "length_m": 400.0, "speed_mps": 40.0},
            {"from": 2, "to": 1, "position_m": 9600.0, "length_m": 400.0, "speed_mps": 40.0},
        ],
    )
    expected = (
        "crossover[1].speed_mps: missing", "sped: unknown key", "speed[2][2] = fast: ", "speed[4] = [11000, 40]: from_m must",
        "crossover[2].to = 9: no such", "crossover[4]: overlaps crossover[3]",
    )  # fmt: skip
    assert all(any(line.startswith(e) for line in said) for e in expected), said
    assert len(said) == len(expected)


@pytest.mark.parametrize(
    ("content", "rule"),
    [(None, "no such file"), (b"name = ", "not TOML: "), (b"\xff\xfe", "not TOML: "), ("folder", "cannot be read: ")],
)
def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path, content, rule):
    path = tmp_path / "line.toml"
    if content == "folder":
        path.mkdir()
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(LineError) as caught:
        read_spec(path)
    assert len(caught.value.mistakes) == 1
    assert caught.value.mistakes[0].startswith(f"{path}: {rule}")


def test_both_ways_at_one_place_and_crossovers_end_to_end_are_allowed():
    both = [{"from": a, "to": b, "position_m": 8000.0, "length_m": 400.0, "speed_mps": 40.0} for a, b in ((1, 2), (2, 1))]
    onward = [{"from": 1, "to": 2, "position_m": 8400.0, "length_m": 400.0, "speed_mps": 40.0}]
    assert len(parse_spec(GOOD | {"crossover": both + onward}, "f.toml").crossover) == 3


def test_the_shipped_lines_are_right():
    shipped = sumo_net.shipped()
    assert set(shipped) == {"three_tracks", "single_track", "fast_crossovers"}
    specs: dict[str, LineSpec] = {name: read_spec(path) for name, path in shipped.items()}
    assert all(spec.name == name for name, spec in specs.items())
    three = specs["three_tracks"]
    assert three.tracks == ("2", "1", "3")
    # 2400 s at 85 m/s from 24 km, and 450 km for the EMU formation.
    assert three.end_m > 24000 + 2400 * 85
    assert three.end_m > 460000
    leave, join, emu_leave, emu_join = three.crossover
    assert (leave.id, leave.from_track, leave.to_track) == ("leave", "1", "3")
    assert (join.id, join.from_track, join.to_track) == ("join", "2", "1")
    assert (emu_leave.from_track, emu_leave.to_track) == ("1", "3")
    assert (emu_join.from_track, emu_join.to_track) == ("2", "1")
    assert 88920 < join.start_m < 89000
    assert min(leave.speed_mps, join.speed_mps) >= 80
