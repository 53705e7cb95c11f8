"""The line coordinate, without SUMO."""

from __future__ import annotations

import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from nets import NO_NETS, refused

import sumo_net
from sumo_net import Line, LineError, parse_spec, read_spec
from sumo_net.picture import show

SMALL = {
    "name": "small", "tracks": ["a", "b", "c"], "length_m": 20000.0, "start_m": 500.5, "max_edge_m": 6000.0,
    "speed": [[500.5, 80.0], [7000.25, 60.0]], "gradient": [[500.5, 0.0], [2000.0, 10.0], [4000.0, 10.0], [6500.0, -50.0]],
    "crossover": [
        {"id": "one", "from": "a", "to": "b", "position_m": 5000.0, "length_m": 400.0, "speed_mps": 40.0},
        {"id": "two", "from": "b", "to": "c", "position_m": 5400.0, "length_m": 400.0, "speed_mps": 40.0},
        {"id": "back", "from": "b", "to": "a", "position_m": 11000.0, "length_m": 300.0, "speed_mps": 40.0},
        {"id": "skip", "from": "a", "to": "c", "position_m": 12000.125, "length_m": 300.0, "speed_mps": 40.0},
    ],
}  # fmt: skip


@pytest.fixture(scope="module")
def line() -> Line:
    return Line.of(parse_spec(SMALL, "small.toml"))


def test_tracks_are_cut_at_switches_speed_changes_and_whole_multiples_of_the_longest_edge(line):
    b = [
        (e, s, n, v)
        for e, t, s, n, v in zip(line.edges, line.tracks, line.start_m, line.length_m, line.speed_mps, strict=True)
        if t == "b"
    ]
    assert b == [
        ("b_500.5", 500.5, 4899.5, 80.0),
        ("b_5400", 5400.0, 1600.25, 80.0),
        ("b_7000.25", 7000.25, 3999.75, 60.0),
        ("b_11000", 11000.0, 1000.0, 60.0),
        ("b_12000", 12000.0, 6000.0, 60.0),
        ("b_18000", 18000.0, 2500.5, 60.0),
        ("xa-b_5000", 5000.0, 400.0, 40.0),
    ]
    # 12000 m would leave a splinter of 0.125 m before the switch of "skip".
    assert "a_12000" not in line.edges
    assert "a_12000.125" in line.edges


def test_every_track_is_covered_without_gap_or_overlap(line):
    crossovers = {c.edge for c in line.crossovers}
    for track in line.track_ids:
        rows = [k for k, t in enumerate(line.tracks) if t == track and line.edges[k] not in crossovers]
        assert line.start_m[rows[0]] == line.begin_m == 500.5
        assert line.start_m[rows[-1]] + line.length_m[rows[-1]] == line.end_m == 20500.5
        assert all(line.start_m[a] + line.length_m[a] == line.start_m[b] for a, b in pairwise(rows))


def test_gradient_is_rise_over_run_and_leaves_out_changes_that_change_nothing(line):
    assert line.gradient.breaks.tolist() == [500.5, 2000.0, 6500.0]
    assert line.gradient.slope.tolist() == [0.0, 0.01, -0.05]


def test_locate_finds_edge_and_lane_position(line):
    for track, at, edge, where in [
        ("b", 500.5, "b_500.5", 0.0), ("b", 5399.5, "b_500.5", 4899.0), ("b", 5400.0, "b_5400", 0.0),
        ("c", 20500.5, "c_18000", 2500.5),
    ]:  # fmt: skip
        k, lane = line.locate(track, at)
        assert (line.edges[k], lane) == (edge, where)
        assert line.index[edge] == k


def test_locate_all_is_locate_for_many(line):
    places = np.linspace(line.begin_m, line.end_m, 500)
    for track in line.track_ids:
        k, lane = line.locate_all(track, places)
        assert [(int(a), float(b)) for a, b in zip(k, lane, strict=True)] == [line.locate(track, float(x)) for x in places]
        np.testing.assert_allclose(line.start_m[k] + lane, places, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("track", "at", "why"),
    [
        ("d", 1000.0, "no such track; there are: a, b, c"),
        ("a", 500.0, "off the line, 500.5 to 20500.5"),
        ("a", 20501.0, "off the line"),
        ("a", float("nan"), "off the line"),
    ],
)
def test_a_place_off_the_line_is_refused(line, track, at, why):
    with pytest.raises(ValueError, match=why):
        line.locate(track, at)
    with pytest.raises(ValueError, match=why):
        line.locate_all(track, np.array([1000.0, at]))


def test_route_stays_on_the_track_to_its_end(line):
    assert line.route("b", 9000.0) == ("b_7000.25", "b_11000", "b_12000", "b_18000")


def test_route_over_a_crossover_goes_on_to_the_switch_and_ends_on_the_other_track(line):
    assert line.route_over("b_5400", "back") == ("b_5400", "b_7000.25", "xb-a_11000", "a_11300", "a_12000.125", "a_18000")
    assert line.route_over("a_5000", "skip")[-3:] == ("xa-c_12000.125", "c_12300.125", "c_18000")


def test_route_over_from_a_crossover_even_into_one_that_begins_where_it_ends(line):
    assert line.route_over("xa-b_5000", "two")[:3] == ("xa-b_5000", "xb-c_5400", "c_5800")
    assert line.route_over("xa-b_5000", "back")[:4] == ("xa-b_5000", "b_5400", "b_7000.25", "xb-a_11000")


@pytest.mark.parametrize(
    ("edge", "over", "why"),
    [
        ("a_5000", "one", "its switch at 5000 m lies behind edge a_5000, which begins at 5000 m"),
        ("b_12000", "back", "lies behind"),
        ("xb-a_11000", "one", "lies behind"),
        ("c_500.5", "one", "leaves track a, edge c_500.5 is on track c"),
        ("xa-b_5000", "one", "leaves track a, edge xa-b_5000 is on track b"),
        ("a_5000", "nowhere", "no such crossover; there are: one, two, back, skip"),
        ("a_1", "one", "edge a_1: not on this line"),
    ],
)
def test_route_over_says_why_not(line, edge, over, why):
    with pytest.raises(ValueError, match=why):
        line.route_over(edge, over)


def test_every_route_over_is_connected_on_the_kilometrage(line):
    for c in line.crossovers:
        for k, edge in enumerate(line.edges):
            if line.tracks[k] == c.from_track and line.start_m[k] + line.length_m[k] <= c.start_m:
                way = [line.index[e] for e in line.route_over(edge, c.id)]
                assert all(line.start_m[a] + line.length_m[a] == line.start_m[b] for a, b in pairwise(way))
                assert line.tracks[way[-1]] == c.to_track


def test_next_crossover(line):
    found = line.next_crossover("a", 600.0, "b")
    assert found is not None
    assert found.id == "one"
    assert line.next_crossover("a", 5000.0, "b") is None
    assert line.next_crossover("c", 600.0, "b") is None
    with pytest.raises(ValueError, match="no such track"):
        line.next_crossover("a", 600.0, "z")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        *NO_NETS,
        (
            '<net><edge id="e"><lane allow="rail" length="1"/></edge></net>',
            "none of its 1 rail edges has a 'track' parameter",
        ),
        ('<net><edge id="e"><lane allow="rail" length="1"/><param key="track" value="1"/></edge></net>', "edge e: has no speed"),
        (
            '<net><edge id="e"><lane allow="rail" length="x" speed="1" shape="0,0"/><param key="track" value="1"/></edge></net>',
            "edge e: could not convert string to float: 'x'",
        ),
        (
            '<net><edge id="e"><lane allow="rail" length="1" speed="1" shape="0,0 1,0"/>'
            '<param key="track" value="1"/><param key="crossover" value="c"/></edge></net>',
            "has crossovers but no tracks",
        ),
    ],
)
def test_a_file_that_is_no_net_of_ours_is_one_clear_line(tmp_path: Path, content, why):
    assert refused(Line.read, tmp_path / "x.net.xml", content).startswith(why)


def test_a_folder_is_no_net(tmp_path: Path):
    with pytest.raises(LineError, match="cannot be read: "):
        Line.read(tmp_path)


def test_the_package_is_light_to_import():
    heavy = "matplotlib", "sumolib", "libsumo", "numba", "pandas", "sumo", "trainctl"
    code = f"import sys, sumo_net; print(*(m for m in {heavy!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_the_long_line_is_computed_at_once():
    spec = read_spec(sumo_net.shipped()["three_tracks"])
    began = time.process_time()
    long = Line.of(spec)
    assert time.process_time() - began < 0.05
    assert len(long.edges) < 600  # SUMO's cost of a step grows with the number of edges


def test_a_picture_of_the_line_and_of_a_piece(line, tmp_path: Path):
    for name, piece in (("whole.png", (None, None)), ("piece.svg", (4000.0, 7000.0)), ("beyond.png", (0.0, 1e6))):
        path = show(line, tmp_path / "new" / name, *piece, title="small")
        assert path.stat().st_size > 5000
    again = show(line, tmp_path / "again.png", title="small")
    assert again.read_bytes() == (tmp_path / "new" / "whole.png").read_bytes()
    svg = (tmp_path / "new" / "piece.svg").read_text()
    assert svg.startswith("<?xml")


@pytest.mark.parametrize("piece", [(21000.0, 22000.0), (0.0, 100.0), (5000.0, 5000.0), (6000.0, 5000.0)])
def test_no_picture_of_what_is_not_there(line, tmp_path: Path, piece):
    with pytest.raises(ValueError, match="holds nothing of the line"):
        show(line, tmp_path / "x.png", *piece)
    assert not list(tmp_path.iterdir())
