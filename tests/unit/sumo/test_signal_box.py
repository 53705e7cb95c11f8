"""Which signals no other train can want: only there SUMO need not be asked for rivals."""

from __future__ import annotations

import nets
import pytest

from sumo_net import Rails
from sumo_net.netfile import read_net
from trainctl.sumo.signal_box import alone_on
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


def test_before_a_join_and_on_track_for_both_directions_others_may_want_what_a_signal_gives(alone):
    assert alone("bc") == []
    assert alone("de") == []
