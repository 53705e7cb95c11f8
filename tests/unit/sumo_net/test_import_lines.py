from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest
import yaml

import sumo_net
from sumo_net.importing import Options, convert
from sumo_net.spec import LineError, parse_spec

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data"
REAL = [
    *sorted((DATA / "ttobench" / "tracks").glob("*.json")),
    DATA / "trainruns" / "realworld.yaml",
    DATA / "trainruns" / "path_schema_2022.yaml",
]


def track(**changes):
    data = {
        "metadata": {"id": "Hill_Line", "license": "none"},
        "stops": {"unit": "m", "values": [0.0, 2000.0, 9000.0]},
        "speed limits": {"units": {"position": "m", "velocity": "km/h"}, "values": [[0.0, 90], [4000.0, 126]]},
        "gradients": {"units": {"position": "m", "slope": "permil"}, "values": [[0.0, 10.0], [3000.0, -20.5]]},
    }
    return {k: v for k, v in (data | changes).items() if v is not None}


def path(**changes):
    rows = [[100.0, 36.0, 0.0], [400.0, 36.0, 5.0], [700.0, 72.0, 5.0], [1100.0, 72.0, 0.0]]
    return {"id": "valley", "name": "A valley", "characteristic_sections": rows} | changes


def railtoolkit(*paths):
    return {"schema": "https://railtoolkit.org/schema/running-path.json", "schema_version": "2022.05", "paths": list(paths)}


@pytest.fixture
def imported(tmp_path):
    def read(data, **options):
        file = tmp_path / ("line.json" if "metadata" in data else "line.yaml")
        file.write_text(json.dumps(data) if "metadata" in data else "%YAML 1.2\n---\n" + yaml.safe_dump(data))
        found = convert(file, Options(**options))
        assert found.kind == "line"
        return found, parse_spec(tomllib.loads(found.toml), "again")

    return read


def test_ttobench_track_becomes_a_line_with_its_limits_and_gradients(imported):
    found, spec = imported(track(), tracks=2)
    assert found.name == spec.name == "Hill_Line"
    assert spec.tracks == ("1", "2")
    assert spec.length_m == 9000.0
    assert spec.speed == ((0.0, 25.0), (4000.0, 35.0))
    assert spec.gradient == ((0.0, 10.0), (3000.0, -20.5))
    assert "# stop 2: 2000 m" in found.toml


def test_units_of_the_file_are_read_not_assumed(imported):
    limits = {"units": {"position": "km", "velocity": "m/s"}, "values": [[0.0, 25.0], [4.0, 35.0]]}
    stops = {"unit": "km", "values": [0.0, 9.0]}
    assert imported(track(**{"speed limits": limits, "stops": stops}))[1] == imported(track())[1]


def test_level_track_before_and_after_shifts_the_kilometrage(imported):
    _, spec = imported(track(), before_m=1000.0, after_m=500.0)
    assert spec.length_m == 10500.0
    assert spec.speed == ((0.0, 25.0), (5000.0, 35.0))
    assert spec.gradient == ((1000.0, 10.0), (4000.0, -20.5), (10000.0, 0.0))
    line = sumo_net.Line.of(spec)
    assert line.gradient.slope.tolist() == [0.0, 0.01, -0.0205, 0.0]


def test_what_is_left_out_is_said(imported):
    curves = {"units": {}, "values": [[0.0, 300.0, 300.0], [5.0, "infinity", "infinity"]]}
    assert any("2 curvatures are left out" in note for note in imported(track(curvatures=curves))[0].notes)


def test_running_path_begins_at_zero_and_ends_at_its_last_row(imported):
    found, spec = imported(railtoolkit(path(points_of_interest=[[500.0, "halt", "front"]])))
    assert spec.length_m == 1000.0
    assert spec.speed == ((0.0, 10.0), (600.0, 20.0))
    assert spec.gradient == ((0.0, 0.0), (300.0, 5.0))
    assert "# halt: 400 m" in found.toml


def test_a_file_with_two_paths_asks_which(imported):
    both = railtoolkit(path(), path(id="ridge"))
    with pytest.raises(LineError, match="--item: valley, ridge"):
        imported(both)
    assert imported(both, item="ridge")[1].name == "ridge"
    with pytest.raises(LineError, match="--item peak: no such path; there are: valley, ridge"):
        imported(both, item="peak")


def test_a_missing_length_is_asked_for_by_the_name_of_the_option(imported):
    with pytest.raises(LineError, match="give --length-m"):
        imported(track(stops=None))
    assert imported(track(stops=None), length_m=7000.0)[1].length_m == 7000.0


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"metadata": {"id": "x"}}, "neither format"),
        (track(gradients={"units": {"position": "m", "slope": "permil"}, "values": [[0, 50.1], [9, -51]]}), "gradient at 9 m = -51 per mil: at most 50"),
        (track(**{"speed limits": {"units": {"position": "m", "velocity": "mph"}, "values": [[0, 1]]}}), "unit mph: must be one of m/s, km/h"),
        (track(**{"speed limits": {"units": {"position": "m", "velocity": "km/h"}, "values": [[0, "x"]]}}), r"speed limits.values\[1\]\[2\]: must be a number, is x"),
        (track(**{"speed limits": {"units": {"position": "m", "velocity": "km/h"}, "values": [[0, 80], [9500, 60]]}}), "lies outside the line"),
        (track(**{"speed limits": {"units": {"position": "m", "velocity": "km/h"}, "values": [[10, 80]]}}), "must be at 0 m"),
        (railtoolkit(path(characteristic_sections=[[0, 80, 0]])), "at least two rows"),
        (railtoolkit(path(characteristic_sections=[[0, 80, 0], [9, 80]])), "must have 3 items, has 2"),
        (railtoolkit(), "must be a list with at least one item"),
        (railtoolkit({"id": "x", "name": "y"}), r"paths\[1\].characteristic_sections: missing"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told_in_words(imported, data, words):
    with pytest.raises(LineError, match=words):
        imported(data)


@pytest.mark.parametrize(
    ("content", "words"),
    [(b'{"a": ', "not JSON"), (b"a: [", "neither JSON nor YAML"), (b"hello", "neither format"), (b"\xff\xfe", "not text"), (b"", "neither format"),
     (b'{"a": ' + b"[" * 100_000, "not JSON: nested too deeply"), (b"a: " + b"[" * 20_000, "neither JSON nor YAML: nested too deeply"),
     (b" " * (1 << 24) + b"a", "neither format: longer than 16 MiB")],
)  # fmt: skip
def test_what_is_no_such_file_is_told_in_words(tmp_path, content, words):
    (tmp_path / "x.txt").write_bytes(content)
    with pytest.raises(LineError, match=words):
        convert(tmp_path / "x.txt", Options())


def test_a_file_that_is_not_there():
    with pytest.raises(LineError, match="no such file"):
        convert("nowhere.json", Options())


def test_command_writes_a_line_that_builds(tmp_path, monkeypatch, capsys):
    from trainctl.cli.program import main

    (tmp_path / "track.json").write_text(json.dumps(track()))

    def call(*words):
        monkeypatch.setattr("sys.argv", ["trainctl", "net", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code, capsys.readouterr()

    code, said = call("import", tmp_path / "track.json", "--out", tmp_path / "lines")
    assert (code, said.out.splitlines()[0]) == (0, str(tmp_path / "lines" / "Hill_Line.toml"))
    assert call("build", tmp_path / "lines" / "Hill_Line.toml", "--out", tmp_path)[0] == 0
    assert sumo_net.Line.read(tmp_path / "Hill_Line.net.xml").gradient.slope.tolist() == [0.01, -0.0205]
    (tmp_path / "track.json").write_text(json.dumps(track(stops=None)))
    code, said = call("import", tmp_path / "track.json")
    assert (code, said.err) == (2, "track.json: stops: missing, so the length of the line is not known: give --length-m\n")


@pytest.mark.skipif(not DATA.is_dir(), reason="the files of TTOBench and TrainRuns.jl are not here")
@pytest.mark.parametrize("file", REAL, ids=lambda p: p.stem)
def test_every_real_line_is_read(file):
    found = convert(file, Options())
    spec = parse_spec(tomllib.loads(found.toml), file.name)
    assert spec.length_m > 9_999.0
    if file.suffix == ".json":
        given = json.loads(file.read_text())
        assert [v * 3.6 for _, v in spec.speed] == pytest.approx([v for _, v in given["speed limits"]["values"]], abs=1e-7)
        assert [list(pair) for pair in spec.gradient] == given["gradients"]["values"]
