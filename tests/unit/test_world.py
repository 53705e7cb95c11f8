from __future__ import annotations

import numpy as np
import pytest

import sumo_net
from trainctl.numeric import Numeric
from trainctl.signals import Start


@pytest.fixture(scope="module")
def line():
    return sumo_net.Line.of(sumo_net.read_spec(sumo_net.shipped()["three_tracks"]))


def on(line, track, position):
    world = Numeric(line)
    edge, lane = line.locate(track, position)
    world.start(
        Start(
            ["a"],
            np.array([edge]),
            np.array([lane]),
            np.array([80.0]),
            np.zeros(1),
            [np.zeros(1)],
            [line.route(track, position)],
            np.ones(1, bool),
            ["rail"],
        )
    )
    return world


def test_position_is_continuous_over_edges_and_a_crossover(line):
    world = on(line, "1", 90000.0)
    edge = line.edges[world.measure().edge[0]]
    world.route(0, line.route_over(edge, "leave"))
    tracks = []
    for k in range(400):
        seen = world.measure()
        assert seen.position[0] == pytest.approx(90000.0 + 80.0 * k, abs=1e-8)
        tracks.append(line.tracks[seen.edge[0]])
        world.move(np.array([80.0]), 1.0)
    change = tracks.index("3")
    assert set(tracks[:change]) == {"1"}
    assert set(tracks[change:]) == {"3"}
    assert 90000.0 + 80.0 * change == pytest.approx(line.crossover["leave"].start_m, abs=80.0)


def test_a_train_on_the_very_end_of_an_edge_is_still_on_it(line):
    world = on(line, "1", 5000.0 - 80.0)
    before = world.measure().edge[0]
    end = line.start_m[before] + line.length_m[before]
    world.move(np.array([end - 4920.0]), 1.0)
    assert world.measure().edge[0] == before
    world.move(np.array([1e-3]), 1.0)
    assert world.measure().edge[0] != before
