"""Nothing is silent: collisions, overspeeds, circles and long waits are events, lines of the summary, and exit codes."""

from __future__ import annotations

import json

import nets
import numpy as np
import pandas as pd
import pytest
import tomli_w

import trainctl
from trainctl.runner import opened, resume, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario
from trainctl.stages.driver import Driven, Driver
from trainctl.stages.traffic import Traffic
from trainctl.studies.jobs import simulate
from trainctl.studies.results import part, write_results
from trainctl.studies.sweep import SweepPlan, jobs
from trainctl.sumo.session import collisions

#: A law that never does anything.
IDLE = '''
"""Nobody pulls, nobody brakes."""

from trainctl.templates.my_law import *  # noqa: F403
from trainctl.templates.my_law import CLOCK, Params, constants, message  # noqa: F401
from trainctl.signals import Demand


def violations(params, scene):
    """None."""
    return []


def demand(constants, own, leader, links, heard):
    """Rolling."""
    return Demand(0.0 * own.speed, own.speed < 0.0)
'''


def line(folder, trains, law=None, length=100.0, limits=((0.0, 30.0),), **tables):
    """Trains (position, speed) on one track of 40 km; the scenario's path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "idle.py").write_text(IDLE)
    spec = {"name": "one", "tracks": ["1"], "length_m": 40000.0, "speed": [*map(list, limits)], "max_edge_m": 5000.0}
    (folder / "one.toml").write_text(tomli_w.dumps(spec))
    content = {
        "schema_version": 1, "title": "told", "run": {"duration_s": 60}, "network": {"line": "one.toml"},
        "controller": law or {"law": "idle.py"}, "reference": {"speed_mps": 20.0}, "topology": {"spacing_m": 1000.0},
        "train_type": {"t": nets.TYPE | {"unit_length_m": length, "c0_n_per_kg": 0.0, "c1_ns_per_m_kg": 0.0,
                                         "c2_ns2_per_m2_kg": 0.0}},
        "train": [{"id": str(k), "type": "t", "track": 1, "position_m": x, "speed_mps": v} for k, (x, v) in enumerate(trains, 1)],
        **tables,
    }  # fmt: skip
    path = folder / "s.toml"
    path.write_text(tomli_w.dumps(content))
    return path


RAMS = [(10_000.0, 5.0), (9600.0, 15.0)]  # bumper to bumper after 30 s, at 10050 m


def violations(done, bound):
    return [e for e in done.events if e["kind"] == "violation" and e["bound"] == bound]


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_a_collision_on_a_line_fails_the_run(backend, tmp_path, typed, capsys):
    path = line(tmp_path / "s", RAMS)
    out = tmp_path / "r"
    assert typed("run", path, "--out", out, "--backend", backend)[0] == 1
    done = Run(out)
    (told,) = violations(done, "gap_m")
    assert (told["time_s"], told["trains"], told["track"], told["position_m"]) == (31.0, ["1", "2"], "1", 10_065.0)
    assert told["value"] == pytest.approx(-10.0)
    assert violations(done, "sumo_collision") == []  # SUMO counts the same pair
    if backend == "sumo":
        (counted,) = collisions(out / "sumo" / "collisions.xml", {"1", "2"})
        assert (counted["time_s"], counted["trains"]) == (31.0, ["1", "2"])
        assert done.metrics["traffic.collisions"] == done.collisions
    assert (done.collisions, done.ok, done.info["checks_failed"]) == (1, False, ["collision"])
    # through the length of train 1 at 30 s .. 40 s, the second behind it until 50 s, both 100 m long: most of all at 40 s
    assert done.info["worst"]["gap_m"] == {"time_s": 40.0, "who": "1-2", "value": pytest.approx(-100.0), "limit": 0.0}


def test_the_summary_tells_it_and_never_that_all_held(tmp_path, typed, monkeypatch, capsys):
    from trainctl.cli import program as cli

    path = line(tmp_path / "s", RAMS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["trainctl", "run", str(path), "--backend", "numeric", "--out", "r"])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    said = " ".join(capsys.readouterr().out.split())
    assert stop.value.code == 1
    assert "collisions FAILED: 1 pair of trains, first 1-2 at 31 s, track 1 at 10065 m; deepest 100 m, 1-2" in said
    assert "held" not in said
    html = trainctl.open("r")._repr_html_()
    assert "FAILED: 1 pair of trains" in html and "held" not in html
    assert typed("report", "r")[0] == 0
    page = (tmp_path / "r" / "report.html").read_text()
    verdict = page[page.index('<p class="verdict') : page.index("<thead>")]
    assert "<strong>Collisions</strong>: 1 pair of trains" in verdict
    assert "held" not in verdict


def test_points_of_which_only_sumo_says_that_they_touch(tmp_path, typed):
    """SUMO has no points: its shortest train has 1 m."""
    path = line(tmp_path / "s", [(10_000.0, 10.0), (9999.5, 10.0)], length=0.0)
    for backend, code in (("numeric", 0), ("sumo", 1)):
        assert typed("run", path, "--out", tmp_path / backend, "--backend", backend)[0] == code
    done = Run(tmp_path / "sumo")
    (told,) = violations(done, "sumo_collision")
    assert told["trains"] == ["1", "2"] and told["edge"] in open_scenario(str(path)).line.edges
    assert (done.collisions, done.metrics["traffic.collisions"]) == (1, 1)


@pytest.fixture(scope="module")
def head_on(tmp_path_factory):
    """Two trains meet on single track, and nobody holds them."""
    folder = tmp_path_factory.mktemp("head_on")
    nets.net(folder, {"a": (0, 0), "b": (9000, 0)}, nets.both_ways("ab", "a", "b"))
    nets.traffic(folder, nets.train("up", "ab", 0) + nets.train("down", "-ab", 0))
    told = nets.scenario("robust_constrained", 150, supervisor={"mode": "off"}, traffic={"cooperate": []})
    (folder / "s.toml").write_text(tomli_w.dumps(told))
    return folder / "s.toml"


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_unsupervised_on_a_net(head_on, backend, tmp_path, monkeypatch):
    """The driver is blind, too: only then do they meet."""
    monkeypatch.setattr(Driver, "step", _blind)
    monkeypatch.setattr(Traffic, "entering", _let_in)
    done = run(open_scenario(str(head_on)), tmp_path / "r", backend)
    (told,) = violations(done, "gap_m")
    assert set(told["trains"]) == {"up", "down"} and told["edge"] in ("ab", "-ab")
    assert told["time_s"] == pytest.approx(9000.0 / 70.0, abs=4.0)
    assert (done.collisions, done.info["checks_failed"]) == (1, ["collision"])
    if backend == "sumo":
        assert done.metrics["traffic.collisions"] == 1


def _blind(self, speed, acceleration, around, traffic, formed, commanded):
    """Nobody brakes, whatever is ahead."""
    return Driven(np.zeros(self.n), np.zeros(self.n, bool)), formed


def _let_in(self, t, ways, here, speed, s, due, reach=None, red=None, after=None):
    """Everybody comes at his time, whoever has the track."""
    self._take_over(ways, s)
    nobody = np.zeros(len(speed), bool)
    s, held = self._request(t, ways, here, speed, nobody, nobody, s)
    come = tuple((i, 35.0) for i in due)
    came = s.came.copy()
    for i, v in come:
        came[i], speed[i] = True, v
        self.journal.event(t, "depart", train=self.p.scenario.ids[i], planned_s=t, delay_s=0.0, speed_mps=v)
    return s._replace(came=came), held, come, {}


def test_the_baseline_fails_too(tmp_path, typed):
    """SUMO cannot stop a train within 400 m from 70 m/s."""
    law = {"law": "sumo", "block": "moving", "top_speed_mps": 75.0}
    path, out = line(tmp_path / "s", [(10_000.0, 0.0), (9500.0, 70.0)], law, limits=[[0.0, 80.0]]), tmp_path / "r"
    code, said = typed("run", path, "--out", out)
    assert code == 1, said
    done = Run(out)
    assert done.collisions == 1 == done.metrics["traffic.collisions"]
    told = [(e["bound"], e["trains"]) for e in done.events if e["kind"] == "violation" and "trains" in e]
    assert told == [("gap_m", ["1", "2"])]  # ours, at the time and place SUMO counts
    (counted,) = collisions(out / "sumo" / "collisions.xml", {"1", "2"})
    assert violations(done, "gap_m")[0]["time_s"] == counted["time_s"]


def test_in_a_sweep_a_collision_is_a_result(tmp_path):
    path = line(tmp_path / "s", RAMS)
    found = [simulate(job) for job in jobs(SweepPlan(str(path), {"run.duration_s": [20, 50]}, [], {}, "numeric"))]
    assert [(row["status"], row["collisions"], row["gridlocks"]) for row in found] == [("complete", 0, 0), ("complete", 1, 0)]
    frame = write_results(part(found), [0, 1], tmp_path / "results.parquet")
    assert frame["collisions"].tolist() == pd.read_parquet(tmp_path / "results.parquet")["collisions"].tolist() == [0, 1]


def test_a_sweep_says_in_how_many_runs_trains_collided(tmp_path, typed):
    path = line(tmp_path / "s", RAMS)
    asked = ("sweep", path, "--set", "run.duration_s=20,50", "--backend", "numeric", "--workers", "1", "--out", tmp_path / "w")
    assert typed(*asked)[0] == 0
    info = json.loads((tmp_path / "w" / "sweep.json").read_text())
    assert (info["complete"], info["failed"], info["with_collisions"], info["with_gridlocks"]) == (2, 0, 1, 0)


def test_in_python_the_run_is_returned_and_says_so(tmp_path):
    path = line(tmp_path / "s", RAMS)
    done = trainctl.run(path, backend="numeric", out=tmp_path / "r")
    assert (done.ok, done.collisions) == (False, 1)
    short = trainctl.run(path, backend="numeric", out=tmp_path / "r", **{"run.duration_s": 20})
    assert (short.ok, short.collisions) == (True, 0)


def test_overspeed_is_told_and_fails_only_where_it_must(tmp_path, typed):
    path = line(tmp_path / "s", [(10_000.0, 20.0), (5000.0, 27.5)], limits=[[0.0, 30.0], [5200.0, 25.0]])
    for backend in ("numeric", "sumo"):
        assert typed("run", path, "--out", tmp_path / "r", "--backend", backend)[0] == 0
        done = Run(tmp_path / "r")
        (told,) = violations(done, "line_speed_mps")
        assert (told["time_s"], told["who"], told["value"], told["limit"]) == (8.0, "2", 27.5, 25.0)
        assert (done.ok, done.info["overspeeds"], done.info["checks_failed"]) == (True, 1, [])
        assert "1 train above the speed limit, by up to 2.5 m/s" in trainctl.open(done.folder)._repr_html_()
    assert typed("run", path, "--out", tmp_path / "r", "--backend", "numeric", "--strict")[0] == 1


# Waiting


@pytest.fixture(scope="module")
def circle(tmp_path_factory):
    """A roundabout: who comes in has its turn before who is on it, finds the ring full, and all the others wait for it."""
    folder = tmp_path_factory.mktemp("circle")
    ring = {"a": (0, 0), "b": (2000, 0), "c": (2000, 2000), "d": (0, 2000)}
    outer = {"e": (-2500, 0), "f": (2000, -2500), "g": (4500, 2000), "h": (0, 4500)}
    edges = {name: tuple(name) for name in ("ab", "bc", "cd", "da", "ea", "fb", "gc", "hd")}
    nets.net(folder, ring | outer, edges)
    ways = [("ab bc", 1700), ("bc cd", 1700), ("cd da", 1700), ("da ab", 1700)]
    ways += [("ea ab", 2300), ("fb bc", 2300), ("gc cd", 2300), ("hd da", 2300)]
    body = (nets.train("ABCDEFGH"[k], way, 0, departSpeed=0, departPos=x) for k, (way, x) in enumerate(ways))
    nets.traffic(folder, "".join(body))
    told = nets.scenario(
        "fully_distributed",
        700,
        traffic={"cooperate": [], "wait_limit_s": 150.0},
        topology={"spacing_m": 3000.0, "lower_m": 1600.0, "upper_m": 9000.0},
    )
    told["train_type"]["emu"] = {**told["train_type"]["emu"], "unit_length_m": 1500.0}
    (folder / "s.toml").write_text(tomli_w.dumps(told))
    return folder / "s.toml"


@pytest.mark.parametrize("backend", ["numeric", "sumo"])
def test_trains_that_wait_for_each_other_are_told_at_once(circle, backend, tmp_path, typed):
    assert typed("run", circle, "--out", tmp_path / "r", "--backend", backend)[0] == 1
    done = Run(tmp_path / "r")
    (told,) = [e for e in done.events if e["kind"] == "gridlock"]
    assert done.info["checks_failed"] == ["gridlock"]
    waits = {w["train"]: w for w in told["waits"]}
    assert set(waits) == set(told["trains"]) and {w["other"] for w in told["waits"]} == set(told["trains"])
    # They all stand from that moment on, and not all of them before.
    speed = done.trains.pivot(index="time_s", columns="train", values="speed_mps")[told["trains"]].abs().max(axis=1)
    assert (speed[speed.index >= told["time_s"]] < 0.05).all()
    assert speed[told["time_s"] - 1.0] >= 0.05
    html = trainctl.open(done.folder)._repr_html_()
    assert "trains wait in a circle" in html and "all held" not in html
    long = [e for e in done.events if e["kind"] == "waiting"]
    assert len({e["train"] for e in long}) == len(long) == done.info["waited_long"] > 0
    assert all(e["time_s"] - e["since_s"] == 151.0 and e["other"] for e in long)


def test_a_run_that_is_resumed_in_a_circle_tells_it_once(circle, tmp_path):
    prepared = open_scenario(str(circle))
    straight = run(prepared, tmp_path / "straight", "numeric", checkpoint_every_s=20.0)
    at = next(e["time_s"] for e in straight.events if e["kind"] == "gridlock")
    for name, when in (("before", at - 10.0), ("after", at + 190.0)):  # the second between two long waits
        with (
            pytest.raises(RuntimeError, match="pulled"),
            opened(prepared, tmp_path / name, "numeric", checkpoint_every_s=20.0) as sim,
        ):
            while sim.time < when:
                sim.step()
            raise RuntimeError("pulled")
        again, since = resume(tmp_path / name)
        assert since is not None and when - 20.0 <= since <= when
        for file in ("events.jsonl", "trains.parquet", "metrics.json"):
            assert (again.folder / file).read_bytes() == (straight.folder / file).read_bytes(), (name, file)
        same = [{k: v for k, v in done.info.items() if k not in ("wall_time_s", "command_line")} for done in (again, straight)]
        assert same[0] == same[1]


def test_nobody_is_told_to_wait_at_its_own_stop(tmp_path, typed):
    """One train stands at its stop for 300 s, one behind it waits, and two come after the end of the platform is taken."""
    nets.net(tmp_path / "s", {"a": (0, 0), "b": (3000, 0), "c": (9000, 0)}, {"ab": ("a", "b"), "bc": ("b", "c")})
    nets.traffic(
        tmp_path / "s",
        nets.train("stops", "ab bc", 0, '<stop lane="ab_0" endPos="1500" duration="400"/>')
        + nets.train("behind", "ab bc", 60)
        + "".join(nets.train(f"late.{k}", "ab bc", 100 + k) for k in range(12)),
    )
    told = nets.scenario("robust_constrained", 500, traffic={"cooperate": [], "wait_limit_s": 150.0})
    (tmp_path / "s" / "s.toml").write_text(tomli_w.dumps(told))
    assert typed("run", tmp_path / "s" / "s.toml", "--out", tmp_path / "r", "--backend", "numeric")[0] == 0
    done = Run(tmp_path / "r")
    told = {e["train"]: e for e in done.events if e["kind"] == "waiting"}
    assert "stops" not in told and not [e for e in done.events if e["kind"] == "gridlock"]
    assert (told["behind"]["other"], told["behind"]["place"]) == ("stops", "train")
    assert told["late.11"]["place"] == "entry" and told["late.11"]["since_s"] == 111.0
    (never,) = [e["trains"] for e in done.events if e["kind"] == "not_entered"]
    came = {e["train"] for e in done.events if e["kind"] == "depart"}
    assert never and set(never) | came == {t["id"] for t in done.scenario["train"]} and not set(never) & came
    assert done.info["not_entered"] == len(never)
    assert f"{len(never)} train" in trainctl.open(done.folder)._repr_html_()
