"""When links change, and what that does to messages and to the constants of the law."""

from __future__ import annotations

import numpy as np
import pytest
from staged import started

from trainctl.scenario.build import open_scenario


class Sorting:
    """The topology stage of three_tracks, asked for an instant at a time."""

    def __init__(self):
        self.loop, self.told = started(open_scenario("three_tracks"))
        s = self.loop.state
        self.rule, self.formed, self.messages, self.own = s.rule, s.formed, s.messages, s.own
        seen = self.loop.world.measure()
        speed = self.own[self.loop.p.leading, 1]
        self.going, self.around = self.loop.traffic.step(0.0, self.loop.world.ways, seen, speed, 0.0 * speed, s.traffic)
        self.seen = seen

    def at(self, t, track=None):
        """The answer at ``t``; ``track`` is that of train 3, which is else where it was."""
        seen, lines = self.seen, self.loop.p.line
        if track is not None:
            row, edge = seen.row.copy(), seen.edge.copy()
            edge[2] = next(
                e for e, (name, start, length) in enumerate(zip(lines.tracks, lines.start_m, lines.length_m, strict=True))
                if name == track and start <= seen.position[2] < start + length
            )  # fmt: skip
            seen = seen._replace(row=row, edge=edge)
        found = self.loop.topology.step(t, seen, self.own, self.around, self.going, self.rule, self.formed, self.messages)
        self.rule, self.formed, self.messages, self.own = found.rule, found.formed, found.messages, found.own
        return found

    def links(self):
        """Who receives from whom, by name."""
        ids = self.loop.p.scenario.ids
        return {(ids[a], ids[b]) for a, b in zip(self.formed.links.sender, self.formed.links.receiver, strict=True)}


@pytest.fixture
def sorting():
    return Sorting()


def test_links_are_told_once_and_nothing_is_made_anew_while_they_last(sorting):
    first = sorting.at(0.0)
    assert first.scene is not None and sorting.told.kinds() == [("topology", "")]
    constants, links = sorting.formed.constants, sorting.formed.links
    again = sorting.at(1.0)
    assert again.scene is None and sorting.told.kinds() == [("topology", "")]
    assert sorting.formed.constants is constants and sorting.formed.links is links


def test_a_train_on_another_track_has_other_neighbours_and_the_law_learns_of_it(sorting):
    sorting.at(0.0)
    before, constants = sorting.links(), sorting.formed.constants
    there = {sorting.loop.p.line.tracks[e] for e in sorting.seen.edge}
    assert len(there) > 1
    other = sorted(there - {sorting.loop.p.line.tracks[sorting.seen.edge[2]]})[0]
    found = sorting.at(1.0, track=other)
    assert found.scene is not None and sorting.links() != before and sorting.formed.constants is not constants
    changed = sorting.links() ^ before
    assert changed and all("3" in pair or len(changed) > 1 for pair in changed) and any("3" in pair for pair in changed)
    first, second = (fields for kind, fields in sorting.told if kind == "topology")
    assert first["formations"] != second["formations"] and second["time_s"] == 1.0
    assert len(sorting.messages.heard) == len(sorting.formed.links.sender)


def test_who_is_ahead_is_of_the_same_formation(sorting):
    sorting.at(0.0)
    formed, position = sorting.formed, sorting.seen.position
    for i, j in enumerate(formed.ahead.tolist()):
        if j >= 0:
            assert formed.formation[i] == formed.formation[j] and position[j] > position[i]
            between = (formed.formation == formed.formation[i]) & (position > position[i]) & (position < position[j])
            assert not between.any()
    heads = formed.ahead < 0
    assert heads.sum() == len(np.unique(formed.formation))
