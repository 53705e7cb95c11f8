"""Which signals no other train can want, and past which signals others come to what a signal gives: there SUMO need not be asked."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import nets
import numpy as np
import pytest

from sumo_net import Rails
from sumo_net.netfile import read_net
from trainctl.sumo.signal_box import NOBODY, Box, alone_on, entries
from trainctl.traffic.rail_signals import rail_signals

#: A line with signals at b, c and e; at d another one joins, and its last edge can be run over both ways.
NODES = {
    "a": (0, 0), "b": (1000, 0), "c": (2000, 0), "x": (2500, 0), "d": (3000, 0), "y": (2000, 800), "e": (4000, 0), "f": (5000, 0),
}  # fmt: skip
EDGES = {"ab": ("a", "b"), "bc": ("b", "c"), "cx": ("c", "x"), "xd": ("x", "d"), "yd": ("y", "d"), "de": ("d", "e")}


@pytest.fixture
def alone(tmp_path):
    nets.net(tmp_path, NODES, {**EDGES, **nets.both_ways("ef", "e", "f")}, signals="bce")
    rails = Rails.read(tmp_path / "a.net.xml")
    index = rails.index
    signals = {(index[s.edge], index[s.onward]) for s in rail_signals(read_net(tmp_path / "a.net.xml"))}
    return lambda edge: [e for e in (rails.edges[k] for k in alone_on(rails, index[edge], signals)) if not e.startswith(":")]


def test_up_to_the_next_signal_on_plain_track_nobody_else_comes(alone):
    assert alone("ab") == ["ab", "bc"]


def test_who_comes_the_other_way_right_behind_a_block_may_want_what_its_signal_gives(tmp_path):
    tracks = {
        "ab": ("a", "b"),
        "bc": ("b", "c"),
        **nets.both_ways("cx", "c", "x"),
        "xd": ("x", "d"),
        "yx": ("y", "x"),
        "cy": ("c", "y"),
    }
    nets.net(tmp_path, {k: v for k, v in NODES.items() if k in "abcxdy"}, tracks, signals="bcx")
    rails = Rails.read(tmp_path / "a.net.xml")
    signals = {(rails.index[s.edge], rails.index[s.onward]) for s in rail_signals(read_net(tmp_path / "a.net.xml"))}
    assert alone_on(rails, rails.index["ab"], signals) == ()


def test_before_a_join_and_on_track_for_both_directions_others_may_want_what_a_signal_gives(alone):
    assert alone("bc") == []
    assert alone("de") == []


#: Two lines that merge at m, where one of them has a join before the signal, and a crossing of the other with a third line.
MERGING = {
    "a": (0, 0), "b": (1000, 0), "m": (3000, 0), "x": (4000, 0), "y": (5000, 0),
    "s": (0, 900), "t": (1000, 900), "u": (1000, 1800), "v": (2000, 500), "z": (5000, 600),
}  # fmt: skip
TRACKS = {
    "ab": ("a", "b"), "bm": ("b", "m"), "mx": ("m", "x"), "xy": ("x", "y"),
    "st": ("s", "t"), "ut": ("u", "t"), "tv": ("t", "v"), "vm": ("v", "m"),
}  # fmt: skip


@pytest.fixture
def beyond(tmp_path):
    def found(tracks, signals, edge, onward, places=MERGING):
        nets.net(tmp_path, places, tracks, signals=signals)
        rails = Rails.read(tmp_path / "a.net.xml")
        index = rails.index
        numbers = {(index[s.edge], index[s.onward]): k for k, s in enumerate(rail_signals(read_net(tmp_path / "a.net.xml")))}
        pairs = {k: tuple(rails.edges[e] for e in pair) for pair, k in numbers.items()}
        return [
            (pairs[at], [rails.edges[e] for e in back if not rails.internal[e]])
            for at, back in entries(rails, index[edge], index[onward], numbers)
        ]

    return found


def test_others_come_to_a_join_past_its_other_signal_over_the_track_back_to_a_switch(beyond):
    assert beyond(TRACKS, "mx", "bm", "mx") == [(("vm", "mx"), ["vm", "tv"])]
    assert beyond(TRACKS, "mx", "vm", "mx") == [(("bm", "mx"), ["bm", "ab"])]
    assert beyond({**TRACKS, "vz": ("v", "z")}, "mx", "bm", "mx") == [(("vm", "mx"), ["vm"])]
    assert beyond(TRACKS, "bmx", "ab", "bm") == []  # nobody else comes there


@pytest.mark.parametrize(
    ("more", "signals"),
    [
        ({"xz": ("x", "z")}, "mx"),  # x leads to two tracks, but the block ends there
        ({}, "m"),  # to its end
    ],
)
def test_a_block_ends_at_the_next_signal_or_where_the_track_does(beyond, more, signals):
    assert beyond({**TRACKS, **more}, signals, "bm", "mx")


@pytest.mark.parametrize(
    ("more", "signals"),
    [
        ({"xz": ("x", "z")}, "m"),  # a switch in the block
        ({"vx": ("v", "x")}, "m"),  # a join in the block
        (nets.both_ways("mx", "m", "x"), "mx"),  # a block for both directions
        (nets.both_ways("vm", "v", "m"), "mx"),  # an entry for both directions
        (nets.both_ways("xy", "x", "y"), "mx"),  # and who comes the other way right behind the block
    ],
)
def test_where_a_block_is_no_plain_track_sumo_is_asked(beyond, more, signals):
    assert not beyond({**TRACKS, **more}, signals, "bm", "mx")


def test_where_tracks_cross_before_a_block_sumo_is_asked(beyond):
    places = {"w": (0, 0), "m": (1000, 0), "e": (2000, 0), "n": (1000, 1000), "s": (1000, -1000), "k": (0, -700)}
    tracks = {"wm": ("w", "m"), "me": ("m", "e"), "km": ("k", "m"), "nm": ("n", "m"), "ms": ("m", "s")}
    assert not beyond(tracks, "m", "wm", "me", places)


class Lights:
    """SUMO as far as a box asks it: one train is a rival of others at the signals of junction b, and has green at all ahead of it."""

    def __init__(self) -> None:
        self.held: list[tuple[Any, ...]] = []

    def getRivalVehicles(self, name: str, link: int) -> tuple[str, ...]:
        return ("one",) if name == "b" else ()

    def getNextTLS(self, train: str) -> tuple[tuple[str, int, float, str], ...]:
        return (("a", 0, 20.0, "G"), ("c", 0, 900.0, "G"))

    def addConstraint(self, *said: Any) -> None:
        self.held.append(said[:4])

    def removeConstraints(self, *said: Any) -> None:
        self.held = [one for one in self.held if one != said]


@pytest.fixture
def box():
    lights = Lights()
    obeyed: Any = SimpleNamespace(
        driven=np.zeros(3, bool), signals=(("a", 0), ("b", 0), ("b", 1)), alone=((), (), ()), entries=((), (), ()),
        handed=SimpleNamespace(trips=("one", "other", "third")), rails=SimpleNamespace(edges=()),
    )  # fmt: skip
    edges = SimpleNamespace(getLaneNumber=lambda edge: 1)
    session: Any = SimpleNamespace(
        ids=["one", "other", "third"], api=SimpleNamespace(trafficlight=lights, vehicle=lights, edge=edges)
    )
    return Box(session, obeyed, lambda name: "G"), lights


@pytest.mark.parametrize(("claims", "at"), [([[1, 1]], "a"), ([[0, 0], [1, 1]], "c")])
def test_nobody_is_held_at_a_signal_that_it_cannot_stop_before_any_more(box, claims, at):
    box, lights = box
    box.claims = claims
    box.hold()
    assert lights.held == [(at, "one", "b", NOBODY)]


def test_who_is_held_for_two_trains_at_one_junction_waits_for_both(box):
    box, lights = box
    for box.claims, held in (([[1, 1], [2, 2]], True), ([[2, 2]], True), ([], False)):
        box.hold()
        assert bool(lights.held) is held, box.claims
