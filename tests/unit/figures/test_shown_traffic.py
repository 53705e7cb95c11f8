"""What people see of runs whose trains come and go: figures, page, comparison, export, the picture over TraCI, the net."""

from __future__ import annotations

import base64
import json
import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from matplotlib.text import Text

from trainctl.cli import program as cli
from trainctl.errors import InputError
from trainctl.figures import catalogue
from trainctl.figures.corridors import corridors
from trainctl.figures.train_graph import MARKS
from trainctl.figures.trains import drawable
from trainctl.report.animation import animation
from trainctl.report.film import film
from trainctl.report.page import page
from trainctl.report.panels import panels
from trainctl.runner import run
from trainctl.runs.known import facts
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario
from trainctl.sumo import gui
from trainctl.sumo.replay import replay

MERGING = Path(__file__).resolve().parents[3] / "scenarios"
SETTINGS = {"run.duration_s": 720}


@pytest.fixture(scope="module")
def merging(tmp_path_factory):
    """Up to the stop and beyond, under SUMO."""
    return run(open_scenario("merging", SETTINGS), tmp_path_factory.mktemp("merging") / "sumo")


@pytest.fixture(scope="module")
def numeric(tmp_path_factory):
    return run(open_scenario("merging", {"run.duration_s": 96}), tmp_path_factory.mktemp("merging") / "numeric", "numeric")


def typed(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["trainctl", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_there_is_no_common_reference_but_a_cruising_speed(merging):
    known = facts(merging)
    assert (known.traffic, known.reference, known.cruise_mps) == (True, None, 36.0)
    assert not any(name.startswith("formation.final_speed") for name in merging.metrics)


def test_no_line_where_a_train_is_not_there_and_marks_where_something_happened(merging):
    axes = catalogue.figure(merging, "train_graph").axes
    first = merging.trains.astype({"train": str}).groupby("train")["time_s"].min()
    colour = {name: to_hex(c) for name, c in drawable(merging).colour.items()}
    marked = {mark: set() for mark, _ in MARKS.values()}
    for line in (line for panel in axes for line in panel.lines if to_hex(line.get_color()) in colour.values()):
        x, y = (np.asarray(v, float) for v in line.get_data())
        (name,) = [name for name, c in colour.items() if c == to_hex(line.get_color())]
        if line.get_marker() in marked:
            marked[line.get_marker()].add((name, float(x[0])))
            continue
        assert np.min(x[np.isfinite(y)], initial=np.inf) >= first[name]
        assert line.get_linestyle() in ("-", ":")
    happened = {mark: {(e["train"], e["time_s"]) for e in merging.events if e["kind"] == kind} for kind, (mark, _) in MARKS.items()}
    assert marked == happened
    assert len(happened["^"]) >= 3 and len(happened["s"]) == 1 and len(happened["D"]) >= 2


def test_two_branches_are_two_corridors_and_places_have_their_names(merging):
    (west, south), left_out = corridors(merging, drawable(merging).trains)
    assert left_out == ""
    assert (west.name, south.name) == ("from_west to to_east", "from_south to to_north")
    assert {place.name: place.kind for place in west.places} == {"junction": "junction", "trunk": "stop", "fork": "junction"}
    at = {place.name: place.at_m for place in west.places}
    for name, distance in west.distance.items():  # those of the branch are in this panel between the junction and the fork alone
        if name.startswith("branch"):
            assert at["junction"] - 50.0 < np.nanmin(distance) and np.nanmax(distance) < at["fork"] + 50.0
    assert np.nanmin(south.distance["branch.0"]) < 1000.0
    shown = catalogue.figure(merging, "train_graph").axes
    assert [panel.get_title(loc="left") for panel in shown] == [west.name, south.name]
    words = {text.get_text() for text in shown[0].texts}
    assert {"junction", "trunk", "fork", "fast.0", "stopping"} <= words


def test_planned_times_stand_beside_actual_ones(merging, tmp_path):
    folder = tmp_path / "planned"
    shutil.copytree(merging.folder, folder)
    (stop,) = [e for e in merging.events if e["kind"] == "stop_reached"]
    at = stop["time_s"]
    pd.DataFrame({
        "train": ["stopping"], "stop": ["trunk"], "platform": ["trunk"], "number": [1], "planned_arrival_s": [at - 60.0],
        "arrival_s": [at], "planned_departure_s": [at - 20.0], "departure_s": [np.nan], "delay_s": [60.0],
    }).to_parquet(folder / "stops.parquet")  # fmt: skip
    panel, *_ = catalogue.figure(Run(folder), "train_graph").axes
    (plan,) = [line for line in panel.lines if line.get_gid() == "planned"]
    assert plan.get_xdata().tolist() == [at - 60.0, at - 20.0]
    assert plan.get_ydata() == pytest.approx(15.9, abs=0.2)
    assert "+60 s" in {text.get_text() for text in panel.texts}


def test_stations_that_no_train_reached_are_named_in_figure_page_and_map(merging, tmp_path, monkeypatch):
    folder = tmp_path / "unreached"
    shutil.copytree(merging.folder, folder)
    pd.DataFrame({
        "train": ["stopping", "stopping"], "stop": ["trunk", "Far"], "platform": ["trunk", "to_east"], "number": [1, 2],
        **{key: np.full(2, np.nan) for key in ("planned_arrival_s", "planned_departure_s", "departure_s", "delay_s")},
        "arrival_s": [650.0, np.nan],
    }).to_parquet(folder / "stops.parquet")  # fmt: skip
    run = Run(folder)
    (west, south), _ = corridors(run, drawable(run).trains)
    kinds = {place.name: (place.kind, place.at_m) for place in west.places}
    assert kinds["trunk"][0] == "stop" and kinds["Far"][0] == "unreached" and "Far" not in {p.name for p in south.places}
    assert kinds["Far"][1] == pytest.approx(kinds["fork"][1] + 4000.0, abs=60.0)  # to_east has 8 km
    shown = catalogue.figure(run, "train_graph")
    assert "Far" in {text.get_text() for text in shown.axes[0].texts}
    assert "stop that no train reached" in {text.get_text() for text in shown.legends[0].get_texts()}
    monkeypatch.setattr("trainctl.figures.corridors.NEAR", 0.05)
    (west, _), _ = corridors(run, drawable(run).trains)
    assert west.beyond == ("Far",) and "Far" not in {place.name for place in west.places}
    assert catalogue.figure(run, "train_graph").axes[0].get_title(loc="right") == "no train came near Far"
    assert next(p for p in panels(drawable(run)) if p["id"] == "graph")["note"].endswith("No train came near Far.")
    monkeypatch.undo()
    graph = next(p for p in panels(drawable(run)) if p["id"] == "graph")
    assert "Far (no train came)" in {place["name"] for place in graph["places"]}
    stops = {stop["name"]: stop for stop in animation(drawable(run))["stops"]}
    assert [stops[name]["reached"] for name in ("trunk", "Far")] == [True, False]
    assert abs(stops["trunk"]["x"] - 15900.0) < 20.0


def test_corridors_that_are_not_shown_are_counted(merging, monkeypatch):
    monkeypatch.setattr("trainctl.figures.corridors.MOST", 1)
    _, left_out = corridors(merging, drawable(merging).trains)
    assert left_out == "1 more corridor is not shown, whose trains stand in these"
    assert catalogue.figure(merging, "train_graph").axes[-1].get_title(loc="right") == left_out
    graph = next(p for p in panels(drawable(merging)) if p["id"] == "graph")
    assert graph["note"].endswith("1 more corridor is not shown, whose trains stand in these.")


def test_the_page_shows_the_net_as_it_lies(merging):
    film = animation(drawable(merging))
    frames, trains = len(film["time"]), len(film["trains"])
    x, y, edge = (np.frombuffer(base64.b64decode(film[k]["bdata"]), "<f4") for k in ("position", "lateral", "edge"))
    x, y, edge = (v.reshape(frames, trains) for v in (x, y, edge))
    late = [t["name"] for t in film["trains"]].index("stopping")
    assert np.isnan(x[0, late]) and np.isfinite(x[-1, late])
    at = film["time"].index(next(e["time_s"] for e in merging.events if e["kind"] == "stop_reached"))
    assert film["tracks"][int(edge[at, late])] == "trunk"
    assert abs(x[at, late] - 15900.0) < 20.0 and abs(y[at, late] - 3400.0) < 20.0  # endPos 8900 m on trunk, which begins at 7 km
    text = page(merging)
    assert "On the net" in text and "There is no animation" not in text and "{{" not in text.partition("<script>")[0]


def test_a_run_without_sumo_has_a_page_without_animation(numeric, tmp_path):
    assert animation(drawable(numeric))["time"] == []
    with pytest.raises(InputError, match="nothing to draw the trains on"):
        film(numeric, tmp_path / "film.gif")
    text = page(numeric)
    assert "There is no animation: without SUMO" in text
    assert "<div hidden>" in text


def test_commands_work_on_such_runs(merging, numeric, tmp_path, monkeypatch, capsys):
    for command in ("check merging", f"metrics {merging.folder}", f"metrics {merging.folder} --all --json"):
        assert typed(monkeypatch, capsys, *command.split())
    files = typed(monkeypatch, capsys, "plot", merging.folder, "--out", tmp_path / "figures").split()
    assert {"train_graph.png", "positions.png", "spacing.png"} <= {name.rpartition("/")[2] for name in files}
    assert "no difference" in typed(monkeypatch, capsys, "diff", merging.folder, merging.folder)
    found = json.loads(typed(
        monkeypatch, capsys, "compare", merging.folder, numeric.folder, "--out", tmp_path / "compare", "--json"
    ))  # fmt: skip
    assert len(found["figures"]) == 4
    assert typed(monkeypatch, capsys, "film", merging.folder, "--out", tmp_path / "film.gif", "--seconds", "0.3").strip()
    for form in ("csv", "mat"):
        assert typed(monkeypatch, capsys, "export", merging.folder, "--format", form, "--out", tmp_path / form)
    assert "in_formation" in (tmp_path / "csv" / "trains.csv").read_text().partition("\n")[0]


def test_a_watched_run_is_the_same_run_and_dots_come_and_go(merging, tmp_path, monkeypatch):
    told, added, removed = open_scenario("merging", {"run.duration_s": 240}), [], []
    add, remove = gui.traci.polygon.add, gui.traci.polygon.remove
    monkeypatch.setattr(gui.traci.polygon, "add", lambda name, *a, **k: (added.append(name), add(name, *a, **k)))
    monkeypatch.setattr(gui.traci.polygon, "remove", lambda name: (removed.append(name), remove(name)))
    watched = run(told, tmp_path / "watched", gui="sumo")
    plain = run(told, tmp_path / "plain")
    for name in ("trains", "links"):
        assert (watched.folder / f"{name}.parquet").read_bytes() == (plain.folder / f"{name}.parquet").read_bytes()
    assert {"dot_fast.0", "dot_stopping"} <= set(added)
    assert any(name.startswith("link_") for name in added)


def test_a_run_is_shown_again_as_sumo_had_it(merging, monkeypatch):
    shown, read, names = {}, gui.Map.move, gui.Map.linked

    def move(self, *a):
        read(self, *a)
        for i in np.flatnonzero(self.seen.present).tolist():
            shown[round(100.0 + self.now(), 3), self.ids[i]] = self.line.edges[self.seen.edge[i]]

    formations = []
    monkeypatch.setattr(gui.Map, "move", move)
    monkeypatch.setattr(gui.Map, "linked", lambda self, links, f: (formations.append(f.copy()), names(self, links, f)))
    assert replay(merging, "sumo", from_s=100.0) == 620
    rows = merging.trains[merging.trains["time_s"] > 100.0]
    recorded = {(round(t, 3), str(n)): str(e) for t, n, e in zip(rows["time_s"], rows["train"], rows["edge"], strict=True)}
    assert {k: v for k, v in shown.items() if k in recorded} == recorded
    assert max(np.bincount(f).max() for f in formations) >= 2, "a formation is coloured as one"


def test_a_run_without_sumo_is_not_shown_again(numeric):
    with pytest.raises(Exception, match="made without SUMO, which alone knows where its net lies"):
        replay(numeric, "sumo")


def test_an_fcd_log_with_gaps_is_not_replayed(tmp_path):
    thinned = run(open_scenario("merging", {"run.duration_s": 96, "run.record_every_s": 8}), tmp_path / "r")
    with pytest.raises(
        InputError, match=r"run.record_every_s = 8: trains that come and go are replayed from an FCD log of every step"
    ):
        replay(thinned, "sumo")


def test_what_is_said_before_and_after_a_run(tmp_path, monkeypatch, capsys):
    found = json.loads(typed(monkeypatch, capsys, "check", "merging", "--json"))
    assert found["net"] == "6 rail edges, 46.6707 km"
    assert (found["cooperate"], found["stops"]) == ("all", 1)
    assert "links_at_start" not in found and found["supervisor"].startswith("on, ")
    (tmp_path / "merging").mkdir()
    for path in MERGING.glob("merging/*"):
        text = path.read_text().replace("</routes>", '<person id="p" depart="0"><walk edges="trunk"/></person></routes>')
        (tmp_path / "merging" / path.name).write_text(text)
    (tmp_path / "s.toml").write_text((MERGING / "merging.toml").read_text())
    monkeypatch.chdir(tmp_path)
    for command in (("check", "s.toml"), ("run", "s.toml", "--backend", "numeric", "--set", "run.duration_s=16")):
        assert "warning: 1 definitions of persons left out" in typed(monkeypatch, capsys, *command)


def test_formations_named_are_of_trains_that_are_there(numeric):
    at_start = next(e for e in numeric.events if e["kind"] == "topology")
    assert at_start["formations"] == [["fast.0"]]


def test_any_rail_net_is_drawn(merging, tmp_path, monkeypatch, capsys):
    net = next((merging.folder / "sumo").glob("*.net.xml"))
    typed(monkeypatch, capsys, "net", "show", net, "--out", tmp_path / "net.png")
    assert (tmp_path / "net.png").stat().st_size > 5000
    monkeypatch.setattr(sys, "argv", ["trainctl", "net", "show", str(net), "--from-m", "100"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    assert "has no kilometrage" in capsys.readouterr().err


def test_tables_of_such_runs_name_trains_only_while_they_are_there(numeric):
    again = Run(numeric.folder)
    assert again.trains["in_formation"].isin((0.0, 1.0)).all()
    first = again.trains.astype({"train": str}).groupby("train").time_s.min()
    assert first.to_dict() == {e["train"]: e["time_s"] for e in again.events if e["kind"] == "depart"}
    assert first["fast.1"] == 70.0


@pytest.mark.parametrize("place", [120, 400, 1200])
def test_a_station_near_the_entry_is_not_overrun(tmp_path, place):
    (tmp_path / "merging").mkdir()
    for path in MERGING.glob("merging/*"):
        text = path.read_text().replace('edge="trunk" endPos="8900"', f'edge="from_west" endPos="{place}"')
        (tmp_path / "merging" / path.name).write_text(text)
    routes = tmp_path / "merging" / "merging.rou.xml"
    root = ElementTree.parse(routes).getroot()
    root.find(".//*[@depart='165']").set("depart", "2")
    root[:] = sorted(root, key=lambda element: float(element.get("depart", element.get("begin", -1))))  # else SUMO leaves it out
    ElementTree.ElementTree(root).write(routes)
    (tmp_path / "s.toml").write_text((MERGING / "merging.toml").read_text())
    done = run(open_scenario(str(tmp_path / "s.toml"), {"run.duration_s": 160}), tmp_path / "r", "numeric")
    (stop,) = [e for e in done.events if e["kind"] == "stop_reached"]
    assert (stop["train"], abs(stop["short_m"]) < 2.0) == ("stopping", True)


@pytest.mark.parametrize("name", sorted(catalogue.FIGURES))
def test_no_figure_shows_the_signs_of_a_formula(name, merging):
    """Words are text; a formula says so."""
    try:
        figure = catalogue.figure(merging, name)
    except InputError:
        return  # nothing recorded for it
    assert [text.get_text() for text in figure.findobj(Text) if "$" in text.get_text() and not text.get_parse_math()] == []
