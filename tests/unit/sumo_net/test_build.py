"""Nets built by netconvert and run in SUMO."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import libsumo
import numpy as np
import pytest
from nets import HILLY

import sumo_net
from sumo_net import Line, LineError, LineSpec, build, kept, parse_spec, read_spec
from sumo_net.build import netconvert

SIGNALLED = HILLY | {"name": "signalled", "signals_m": 1000.0}


@pytest.fixture(scope="module")
def three() -> LineSpec:
    return read_spec(sumo_net.shipped()["three_tracks"])


@pytest.fixture(scope="module")
def nets(tmp_path_factory, three) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("nets")
    return {spec.name: build(spec, folder) for spec in (three, *(parse_spec(t, "") for t in (HILLY, SIGNALLED)))}


Start = Callable[[Path, str, float, float], Callable[[], float]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Put one train on a track and return where it is; libsumo holds one simulation, so it is closed at the end."""

    def begin(net: Path, track: str, position: float, speed: float) -> Callable[[], float]:
        line = Line.read(net)
        options = (
            "--no-step-log true --insertion-checks none --time-to-teleport -1 --default.speeddev 0 --duration-log.disable true"
        )
        libsumo.start(["sumo", "-n", str(net), *options.split()])
        libsumo.vehicletype.copy("DEFAULT_VEHTYPE", "emu")
        libsumo.vehicletype.setVehicleClass("emu", "rail_electric")
        libsumo.vehicletype.setLength("emu", 200.0)
        libsumo.vehicletype.setMaxSpeed("emu", 100.0)
        libsumo.route.add("way", line.route(track, position))
        _, lane = line.locate(track, position)
        libsumo.vehicle.add("a", "way", typeID="emu", departPos=repr(lane), departSpeed=repr(speed))
        libsumo.simulationStep()
        libsumo.vehicle.setSpeedMode("a", 32)
        return lambda: float(line.start_m[line.index[libsumo.vehicle.getRoadID("a")]] + libsumo.vehicle.getLanePosition("a"))

    yield begin
    libsumo.close()


@pytest.mark.parametrize("name", ["three_tracks", "hilly", "signalled"])
def test_the_net_gives_back_the_very_line_it_was_built_from(nets, three, name):
    built = Line.of({"three_tracks": three, "hilly": parse_spec(HILLY, ""), "signalled": parse_spec(SIGNALLED, "")}[name])
    read = Line.read(nets[name])
    for field in ("edges", "tracks", "crossovers", "track_ids", "begin_m", "end_m"):
        assert getattr(read, field) == getattr(built, field), field
    for field in ("start_m", "length_m", "speed_mps"):
        np.testing.assert_array_equal(getattr(read, field), getattr(built, field))
    np.testing.assert_array_equal(read.gradient.breaks, built.gradient.breaks)
    np.testing.assert_array_equal(read.gradient.slope, built.gradient.slope)


def test_the_same_line_gives_the_same_bytes_and_nothing_else_is_left(nets, three, tmp_path: Path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))  # netconvert makes it again
    began = time.perf_counter()
    build(three, tmp_path / "net")
    print(f"three_tracks built in {time.perf_counter() - began:.2f} s")
    files = sorted((tmp_path / "net").iterdir())
    assert [f.name for f in files] == [f"three_tracks.{kind}.xml" for kind in ("con", "edg", "net", "nod")]
    for file in files:
        assert file.read_bytes() == (nets["three_tracks"].parent / file.name).read_bytes()
    assert "netconvert 1." in files[2].read_text()[:200]


def test_signals_stand_where_they_should_and_move_nothing(nets):
    words = {name: nets[name].read_text() for name in ("hilly", "signalled")}
    assert "rail_signal" not in words["hilly"]
    standing = re.findall(r'<junction id="n(left|right)_([\d.]+)" type="rail_signal"', words["signalled"])
    assert sorted(standing) == sorted((t, f"{250.5 + 1000.0 * k:g}") for t in ("left", "right") for k in range(1, 12))
    with_, without = Line.read(nets["signalled"]), Line.read(nets["hilly"])
    assert (with_.begin_m, with_.end_m, with_.crossovers) == (without.begin_m, without.end_m, without.crossovers)
    for track, position in (("left", 251.0), ("left", 4000.5), ("right", 6201.5), ("right", 12250.0)):
        places = [line.start_m[edge] + at for line in (with_, without) for edge, at in [line.locate(track, position)]]
        assert places == pytest.approx([position, position], abs=1e-9)


@pytest.mark.parametrize("name", ["three_tracks", "hilly", "signalled"])
def test_sumo_opens_the_net_without_a_word(nets, name):
    program, environment = netconvert()
    done = subprocess.run(
        [str(program.parent / "sumo"), "-n", str(nets[name]), "--no-step-log", "-e", "1"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout + done.stderr == ""


def test_position_goes_on_exactly_through_changes_of_track(nets, start):
    net, begin = nets["three_tracks"], 85000.37
    line, ways, passed = Line.read(net), ["join", "leave", "x3-1_105000"], []
    where = start(net, "2", begin, 80.0)
    assert where() == pytest.approx(begin, abs=1e-9)
    worst = 0.0
    for step in range(1, 301):
        edge = libsumo.vehicle.getRoadID("a")
        if edge not in passed:
            passed.append(edge)
        if ways and line.crossover[ways[0]].from_track == line.tracks[line.index[edge]]:
            libsumo.vehicle.setRoute("a", line.route_over(edge, ways.pop(0)))
        libsumo.vehicle.setSpeed("a", 80.0)
        libsumo.simulationStep()
        worst = max(worst, abs(where() - (begin + 80.0 * step)))
    assert [e for e in passed if e.startswith("x")] == ["x2-1_88960", "x1-3_99945", "x3-1_105000"]
    assert worst < 3e-10  # m; rounding of 300 sums near 1e5 m


def test_position_is_exact_at_odd_speeds_over_odd_lengths_and_slopes(nets, start):
    line = Line.read(nets["hilly"])
    where = start(nets["hilly"], "left", 300.0, 40.0)
    libsumo.vehicle.setRoute("a", line.route_over("left_250.5", "over"))
    expected = where()
    for step in range(250):
        speed = 40.0 + 7.3 * math.sin(step)
        if libsumo.vehicle.getRoadID("a") == "xleft-right_5800.123456":
            libsumo.vehicle.setRoute("a", line.route_over("xleft-right_5800.123456", "on"))
        libsumo.vehicle.setSpeed("a", speed)
        libsumo.simulationStep()
        expected += speed
        assert where() == pytest.approx(expected, abs=3e-10)
    assert libsumo.vehicle.getRoadID("a") == "left_6400.823456"


def test_the_slope_sumo_finds_is_the_gradient_of_the_line(nets, start):
    line = Line.read(nets["hilly"])
    where = start(nets["hilly"], "left", 451.0, 10.0)
    compared, on_crossover = 0, 0
    for step in range(1100):
        if step == 450:
            libsumo.vehicle.setRoute("a", line.route_over(libsumo.vehicle.getRoadID("a"), "over"))
        libsumo.vehicle.setSpeed("a", 10.0)
        libsumo.simulationStep()
        front = where()
        rear, ahead = np.searchsorted(line.gradient.breaks, [front - 200.5, front + 0.5], side="right") - 1
        if rear == ahead:  # SUMO's slope is the mean under the train: skip where that holds a change
            crossing = any(c.start_m <= front <= c.start_m + c.length_m + 200.0 for c in line.crossovers)
            slope = math.tan(math.radians(libsumo.vehicle.getSlope("a")))
            # The shape of a crossover is longer than its edge by the way sideways: 4.5 m in 400 m.
            assert slope == pytest.approx(line.gradient.slope[ahead], abs=1e-8, rel=1.3e-4 if crossing else 1e-8)
            compared, on_crossover = compared + 1, on_crossover + crossing
    assert compared > 850
    assert on_crossover > 10


def test_height_is_the_gradient_added_up(nets, start):
    line = Line.read(nets["hilly"])
    where = start(nets["hilly"], "left", 451.0, 50.0)
    angle = np.arctan(line.gradient.slope)
    for _ in range(200):
        libsumo.vehicle.setSpeed("a", 50.0)
        libsumo.simulationStep()
        at = np.clip(where() - line.gradient.breaks, 0.0, np.diff(line.gradient.breaks, append=np.inf))
        assert libsumo.vehicle.getPosition3D("a")[2] == pytest.approx(float(at @ np.sin(angle)), abs=1e-6)


def test_a_net_is_made_once(tmp_path: Path, three, monkeypatch):
    """Another line, or what is damaged in the cache, is made anew; where nothing can be kept, each time."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run, runs = subprocess.run, list[list[str]]()
    monkeypatch.setattr(subprocess, "run", lambda command, **more: runs.append(command) or run(command, **more))
    first = build(three, tmp_path / "first").read_bytes()
    assert build(three, tmp_path / "second").read_bytes() == first
    assert len(runs) == 1
    build(parse_spec(HILLY, ""), tmp_path / "hilly")
    assert len(runs) == 2
    folder = tmp_path / "cache" / "trainctl" / "nets"
    assert len(list(folder.iterdir())) == 2
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[:-100])
    assert build(three, tmp_path / "third").read_bytes() == first
    assert len(runs) == 3
    folder.chmod(0o777)
    assert build(three, tmp_path / "fourth").read_bytes() == first
    assert len(runs) == 4


def test_only_so_many_nets_are_kept(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(kept, "MOST", 3)
    for k in range(5):
        kept.keep(f"{k}", b"net %d" % k)
    assert [kept.find(f"{k}") for k in range(5)] == [None, None, b"net 2", b"net 3", b"net 4"]
    assert kept.key(Path(sys.executable), ("a", "b"), ()) != kept.key(Path(sys.executable), ("ab",), ())


def test_a_folder_that_cannot_be_written_is_one_line(tmp_path: Path, three):
    (tmp_path / "file").write_text("")
    with pytest.raises(LineError) as caught:
        build(three, tmp_path / "file")
    assert len(caught.value.mistakes) == 1
    assert "the net cannot be built here" in caught.value.mistakes[0]


def test_what_netconvert_says_is_told_and_nothing_is_left(tmp_path: Path, three, monkeypatch):
    monkeypatch.setattr(sys.modules["sumo_net.build"], "_edges", lambda *_: "<edges><edge id='x' from='a' to='b'/></edges>")
    with pytest.raises(LineError, match=r"three_tracks: netconvert refused the line: Error: .*'a'"):
        build(three, tmp_path)
    assert not list(tmp_path.iterdir())


def test_no_netconvert_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "sumo", None)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(LineError, match="netconvert: not found; install eclipse-sumo"):
        netconvert()
