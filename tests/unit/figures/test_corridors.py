"""Trains of a double line that turn back in a station: one distance axis for both ways, and who stood at which platform."""

from __future__ import annotations

import nets
import numpy as np
import pytest
import tomli_w

from sumo_net import Rails
from trainctl.figures import beside, catalogue
from trainctl.figures.beside import Scale
from trainctl.figures.corridors import corridors
from trainctl.figures.trains import drawable
from trainctl.runner import run
from trainctl.scenario.build import open_scenario


@pytest.fixture(scope="module")
def terminal(tmp_path_factory):
    """Three trains that turn back at two platforms, without SUMO; the second comes late, the third is still there at the end."""
    folder = tmp_path_factory.mktemp("terminal")
    body = "".join(
        nets.train(f"t{k}", f"up p{k % 2 + 1} -p{k % 2 + 1} down", 120 * k,
                   f'<stop lane="p{k % 2 + 1}_0" duration="40" arrival="{120 * k + (330, 250, 330)[k]}" until="{until}"/>')
        for k, until in enumerate((400, 500, 2000))
    )  # fmt: skip
    nets.platforms(folder, body)
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 900)))
    return run(open_scenario(str(folder / "s.toml")), folder / "out", "numeric")


def test_a_run_without_sumo_keeps_the_net_it_ran_on(terminal):
    assert terminal.net == terminal.folder / "a.net.xml" and "a.net.xml" in terminal.info["files"]
    assert "up" in Rails.read(terminal.net).edges


def test_both_tracks_and_both_platforms_are_one_corridor(terminal):
    drawn = drawable(terminal)
    (only,), more = corridors(terminal, drawn.trains)
    assert more == "" and set(only.distance) == {"t0", "t1", "t2"}
    for train, rows in drawn.trains.slices():
        at, edge = only.distance[train], drawn.trains.words["edge"].each()[rows]
        jumps = np.abs(np.diff(at))
        assert np.isfinite(at).all() and jumps.max() < 101.0 and np.sum(jumps > 40.0) <= 1  # it turns: its rear is its front
        there, back = (np.sign(np.diff(at)[edge[1:] == name]) for name in ("up", "down"))
        assert len(set(there.tolist())) == 1 and set(back.tolist()) <= {-there[0]} and (len(back) > 0) is (train != "t2")
    assert {place.name for place in only.places if place.kind == "stop"} == {"p1", "p2"}


def test_a_track_that_leads_elsewhere_is_not_beside(terminal):
    """Its end is too far away, or it is much longer than what it lies beside."""
    rails = Rails.read(terminal.net)
    up, down = rails.index["up"], rails.index["down"]
    straight, known = np.array([[0.0, 0.0], [9000.0, 0.0]]), {up: Scale(0.0, 1.0)}
    for points, found in (
        ([[9000.0, -40.0], [0.0, -40.0]], True), ([[9000.0, -40.0], [0.0, -140.0]], False), ([[9000.0, -40.0], [6000.0, -40.0]], False)
    ):  # fmt: skip
        place = beside.Corridor((up,), known, {up: straight, down: np.array(points)}, rails)
        scale = place.scale(down)
        assert (scale is not None) is found
        assert beside.along((down,), known, place, rails).keys() == ({down} if found else set())
        if scale is not None:
            assert scale.per_m == pytest.approx(-1.0, abs=0.02) and scale.start_m == pytest.approx(rails.length_m[up], rel=0.01)


def test_a_bar_for_every_stop_and_a_frame_for_its_plan(terminal):
    figure = catalogue.figure(terminal, "platforms")
    (panel,) = figure.axes
    assert [label.get_text() for label in panel.get_yticklabels()] == ["p1", "p2"]
    bars = {bar.get_gid(): bar.get_paths()[0].get_extents() for bar in panel.collections if bar.get_gid()}
    frames = {line.get_gid(): line.get_xdata() for line in panel.lines if str(line.get_gid()).startswith("planned")}
    calls = terminal.stops.astype({"train": str}).set_index("train")
    for train in ("t0", "t1"):
        bar = bars[f"stopped {train}"]
        assert (bar.x0, bar.x1) == pytest.approx((calls.arrival_s[train], calls.departure_s[train]))
    assert bars["stopped t2"].x1 == 900.0  # it is still there
    assert (min(frames["planned t0"]), max(frames["planned t0"])) == (330.0, 400.0)
    rows = {name: round(float(bar.y0 + bar.y1) / 2) for name, bar in bars.items()}
    assert rows == {"stopped t0": 0, "stopped t1": 1, "stopped t2": 0}
