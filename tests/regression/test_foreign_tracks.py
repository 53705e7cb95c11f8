"""Lanes, permissions and crossings as SUMO has them: trams on streets, nets that let everybody on, nets that SUMO refuses."""

from __future__ import annotations

import re

import nets
import pytest
import tomli_w
from beside import followed

from trainctl.errors import InputError
from trainctl.report.page import page
from trainctl.scenario.build import open_scenario
from trainctl.traffic.read import read_traffic

TRAM = '<vType id="emu" vClass="tram" length="30" maxSpeed="15"/>'
LINE = {"a": (0, 0), "b": (1500, 0), "c": (3000, 0)}
LANES = '<lane index="0" allow="pedestrian"/><lane index="1" allow="tram passenger"/>'


def tracks(folder, edges, connections=""):
    """A net of edges given as XML."""
    (folder / "a.nod.xml").write_text(
        "<nodes>" + "".join(f'<node id="{n}" x="{x}" y="{y}"/>' for n, (x, y) in LINE.items()) + "</nodes>"
    )
    (folder / "a.edg.xml").write_text(f"<edges>{edges}</edges>")
    (folder / "a.con.xml").write_text(f"<connections>{connections}</connections>")
    nets.convert(folder, "-x", "a.con.xml")


def notes(folder):
    return read_traffic(folder / "a.sumocfg", folder / "work").notes


@pytest.mark.parametrize(
    ("edges", "route", "lane"),
    [
        (f'<edge id="ab" from="a" to="b" numLanes="2" speed="14">{LANES}</edge>', "ab", "ab_1"),
        (
            '<edge id="ab" from="a" to="b" numLanes="3" speed="14" allow="tram passenger"/>'
            '<edge id="bc" from="b" to="c" numLanes="1" speed="14" allow="tram"/>',
            "ab bc",
            "ab_2",
        ),
    ],
)
def test_a_tram_takes_the_lane_that_lets_it_on_and_leads_on(tmp_path, edges, route, lane):
    tracks(tmp_path, edges, '<connection from="ab" to="bc" fromLane="2" toLane="0"/>' if "bc" in route else "")
    nets.traffic(tmp_path, "", TRAM)
    found = followed(tmp_path, nets.train("v", route, 0), 260, types=TRAM)
    assert [e["kind"] for e in found.events if e["kind"] == "arrive"] == ["arrive"]
    assert f'departLane="{lane}"' in (found.folder / "sumo" / "tripinfo.xml").read_text()


def test_trains_run_where_everybody_may(tmp_path):
    """A net whose lanes say nothing of whom they let on, as one edge of it does too."""
    for folder, marked in ((tmp_path / "all", False), (tmp_path / "some", True)):
        nets.net(folder, LINE, {"ab": ("a", "b"), "bc": ("b", "c")})
        net = folder / "a.net.xml"
        text = net.read_text()
        lanes = ("bc_0",) if marked else ("ab_0", "bc_0")
        for lane in lanes:
            text = re.sub(f'(<lane id="{lane}" index="0") allow="rail"', r"\1", text)
        net.write_text(text)
        found = followed(folder, nets.train("v", "ab bc", 0), 200)
        assert set(found.trains.edge.astype(str)) >= {"ab", "bc"}
        assert [e for e in found.events if e["kind"] == "arrive"]
        count = 1 if marked else 2
        assert (
            f"net: {count} x edges of routes are open to all classes, to no rail class by name: taken for tracks without road traffic"
            in notes(folder)
        )
        assert "bc" in page(found)


def test_a_net_that_would_kill_the_process_is_refused_in_words_of_sumo(tmp_path):
    nets.net(tmp_path, LINE, {"ab": ("a", "b"), "bc": ("b", "c")})
    net = tmp_path / "a.net.xml"
    net.write_text(net.read_text().replace('allow="rail"', 'allow="rail" changeLeft=""'))
    nets.traffic(tmp_path, nets.train("v", "ab bc", 0))
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 20)))
    with pytest.raises(InputError) as caught:
        open_scenario(str(tmp_path / "s.toml"))
    assert any("a.net.xml: SUMO refuses it: Attribute 'changeLeft' in definition of lane 'ab_0' is empty" in m
               for m in caught.value.mistakes)  # fmt: skip


CROSS = {"w": (0, 0), "x": (1000, 0), "e": (2000, 0), "s": (1000, -1000), "n": (1000, 1000), "m": (400, -800), "k": (600, 800)}


@pytest.mark.parametrize(
    ("edges", "routes", "words"),
    [
        ({"wx": ("w", "x"), "xe": ("x", "e"), "sx": ("s", "x"), "xn": ("x", "n")}, ("wx xe", "sx xn"), "cross on junction x ("),
        ({"wx": ("w", "x"), "xe": ("x", "e"), "sx": ("s", "x"), "xn": ("x", "n")}, ("wx xe", "sx xe"), None),  # they join
        ({"wx": ("w", "x"), "xe": ("x", "e"), "mk": ("m", "k")}, ("wx xe", "mk"), "cross without a junction at mk and wx:"),
        ({"we": ("w", "e"), "sn": ("s", "m")}, ("we", "sn"), None),
    ],
)
def test_tracks_that_cross_unseen_are_told(tmp_path, edges, routes, words):
    nets.net(tmp_path, CROSS, edges, "--no-internal-links")
    nets.traffic(tmp_path, "".join(nets.train(f"t{k}", route, k) for k, route in enumerate(routes)))
    told = [n for n in notes(tmp_path) if "cross" in n]
    assert (len(told) == 1 and words in told[0]) if words else told == []


def test_a_level_crossing_with_edges_inside_is_no_matter(tmp_path):
    nets.net(tmp_path, CROSS, {"wx": ("w", "x"), "xe": ("x", "e"), "sx": ("s", "x"), "xn": ("x", "n")})
    nets.traffic(tmp_path, nets.train("t", "wx xe", 0) + nets.train("u", "sx xn", 0))
    assert not [n for n in notes(tmp_path) if "cross" in n]
