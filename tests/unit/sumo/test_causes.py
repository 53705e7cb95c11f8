"""When SUMO does something else than it is told, the run ends with a cause in words."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import libsumo
import nets
import pytest
import tomli_w

from trainctl.errors import CouplingError
from trainctl.loop import Loop
from trainctl.runner import opened
from trainctl.scenario.build import open_scenario
from trainctl.sumo.causes import cause

NODES = {"a": (0, 0), "b": (3000, 0), "c": (6000, 0), "d": (6000, 800)}


@pytest.fixture
def scenario(tmp_path):
    """One train on a track of two edges with a branch; the first edge can be run over both ways."""
    edges = {**nets.both_ways("ab", "a", "b"), "bc": ("b", "c"), "bd": ("b", "d")}
    nets.net(tmp_path, NODES, edges)
    nets.traffic(tmp_path, nets.train("v", "ab bc", 0))
    (tmp_path / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 120)))
    return open_scenario(str(tmp_path / "s.toml"))


def stop() -> None:
    libsumo.vehicle.setActionStepLength("v", 1.0)
    libsumo.vehicle.setStop("v", "ab", pos=libsumo.vehicle.getLanePosition("v") + 60.0, laneIndex=0, duration=50.0)


def slowly() -> None:
    libsumo.vehicle.setSpeedMode("v", 31)
    libsumo.vehicle.setMaxSpeed("v", 5.0)


CAUSES: dict[str, tuple[Callable[[], object], str]] = {
    "stop": (stop, "a stop that SUMO holds it at"),
    "route": (lambda: libsumo.vehicle.setRoute("v", ["ab", "bd"]), "SUMO gave it another route, over edge bd: a rerouter"),
    "speed mode": (slowly, "its speed mode is 31, not 32"),
    "cut": (lambda: libsumo.vehicle.setRoute("v", ["ab"]), "SUMO let it arrive before the end of its route, on edge ab"),
}


@pytest.mark.parametrize("case", CAUSES)
def test_a_disagreement_names_its_cause(scenario, tmp_path, case):
    meddle, words = CAUSES[case]
    with pytest.raises(CouplingError, match=f"train v .*likely cause: {words}"), opened(scenario, tmp_path / "run") as s:
        assert isinstance(s, Loop)
        for k in range(110):
            if k == 20:
                meddle()
            s.step()


def test_a_lane_that_does_not_lead_on_and_a_closed_edge_are_told():
    """Against what libsumo answers then: a commanded train stands at the end of its edge."""

    def told(links: list[tuple[str]], allowed: list[str], bidi: str = "", here: str = "ab") -> str:
        api = SimpleNamespace(
            simulation=SimpleNamespace(
                getStartingTeleportIDList=list, getEndingTeleportIDList=list, getArrivedIDList=list
            ),
            vehicle=SimpleNamespace(
                getIDList=lambda: ["v"], getRoadID=lambda _: here, getRoute=lambda _: ["ab", "bc"], getRouteIndex=lambda _: 0,
                getSpeedMode=lambda _: 32, isStopped=lambda _: False, getVehicleClass=lambda _: "rail", getLaneID=lambda _: "ab_0",
            ),
            edge=SimpleNamespace(getBidiEdge=lambda _: bidi, getLaneNumber=lambda _: 1),
            lane=SimpleNamespace(getAllowed=lambda _: allowed, getLinks=lambda _: links),
        )  # fmt: skip
        return cause(api, "v", "ab", ["ab", "bc"])

    assert told([("bd_0",)], ["rail"]) == "lane ab_0 does not lead on to edge bc"
    assert told([("bc_0",)], ["tram"]) == "edge bc is closed to rail"
    assert told([("bc_0",)], [], bidi="-ab", here="-ab") == "it reversed on edge ab"
    assert told([("bc_0",)], []) == "unknown"
