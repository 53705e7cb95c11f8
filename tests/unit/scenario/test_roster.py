"""What a roster says of the trains of a SUMO configuration, on scenarios that are read but not run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import nets
import numpy as np
import pytest

from sumo_net import Rails
from trainctl.errors import InputError
from trainctl.scenario.reading import examine
from trainctl.scenario.roster import Roster, Stop, chart, enrol
from trainctl.scenario.tables import Scenario

Read = Callable[..., tuple[Scenario, Roster, Path]]

#: A ring with a way in; ``LAP`` comes to the first edge of the ring twice.
WAY, LAP = "in ab bc", "ab bc cd da ab bc"
#: A vType that says all a plant needs.
WHOLE = """<vType id="emu" vClass="rail" length="100" carFollowModel="Rail" trainType="custom" mass="90000" maxPower="2350"
maxTraction="150" resCoef_constant="1.67" resCoef_linear="0.02" resCoef_quadratic="0.01"/>"""


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ring")
    nets.ring(folder)
    return folder


@pytest.fixture
def enrolled(ring: Path) -> Read:
    """Enrol trains on the ring: the scenario, the roster and the net."""

    def read(
        body: str, *, types: str = nets.EMU, known: str = "emu", begin: int = 0, duration: float = 9000.0,
        event: tuple[dict[str, str], ...] = (), **changes: Any,
    ) -> tuple[Scenario, Roster, Path]:  # fmt: skip
        nets.traffic(ring, body, types, begin=begin)
        scenario, mistakes = examine(nets.scenario("robust_constrained", duration, (known,), **changes) | {"event": list(event)})
        assert scenario is not None and not mistakes
        return enrol(scenario, ring)

    return read


@pytest.fixture
def mistakes(enrolled: Read) -> Callable[..., list[str]]:
    """What is told of trains that cannot be enrolled."""

    def told(body: str, **options: Any) -> list[str]:
        with pytest.raises(InputError) as caught:
            enrolled(body, **options)
        return caught.value.mistakes

    return told


def stop(edge: str, at: float, **said: Any) -> str:
    said = {"duration": 10} | said
    return f'<stop lane="{edge}_0" endPos="{at}" ' + " ".join(f'{k}="{v}"' for k, v in said.items()) + "/>"


def along(roster: Roster, *edges: str) -> float:
    """Length of edges, those on junctions between them included [m]."""
    return float(roster.rails.length_m[roster.rails.way(edges)].sum())


# The net as a line


def chain() -> Rails:
    """Two edges, the second at a lower kilometrage than the first, and two edges on the junction between."""
    n = 4
    return Rails(
        edges=("ab", "bc", ":b_0", ":b_1"), internal=np.array([False, False, True, True]), length_m=np.array([100.0, 300.0, 5.0, 7.0]),
        speed_mps=np.full(n, 40.0), start_m=np.array([500.0, 20.0, 600.0, 605.0]), slope=np.zeros(n), after=((2,), (), (3,), (1,)),
        before=((), (3,), (0,), (2,)), twin=np.full(n, -1), crossing=((),) * n, reversal=frozenset(),
    )  # fmt: skip


def test_every_edge_for_trains_is_a_track_of_its_own() -> None:
    assert chart(chain()).track_ids == ("ab", "bc")


def test_all_edges_of_a_junction_lie_on_the_track_they_lead_to() -> None:
    assert chart(chain()).tracks == ("ab", "bc", "bc", "bc")


def test_a_chart_begins_where_its_first_edge_does() -> None:
    assert chart(chain()).begin_m == 20.0


def test_a_chart_ends_where_its_last_edge_does() -> None:
    assert chart(chain()).end_m == 612.0


# Ways and places


def test_a_way_runs_over_the_edges_of_the_junctions(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 0))
    assert roster.routes == (("in", ":a_1", "ab", ":b_0", "bc"),)


def test_the_place_of_a_train_is_on_the_kilometrage(enrolled: Read) -> None:
    scenario, roster, _ = enrolled(nets.train("a", "bc cd", 0, departPos=250))
    assert scenario.train[0].position_m == roster.rails.start_m[roster.rails.index["bc"]] + 250.0


def test_a_train_enters_where_its_file_says(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", "bc cd", 0, departPos=250) + nets.train("b", "in ab", 0))
    assert roster.lane_position.tolist() == [250.0, 100.1]  # SUMO's place of a train of 100 m


def test_a_train_enters_on_the_first_edge_of_its_way(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", "bc cd", 0) + nets.train("b", "in ab", 0))
    assert [roster.rails.edges[e] for e in roster.edge] == ["bc", "in"]


def test_the_net_is_that_of_the_configuration(enrolled: Read, ring: Path) -> None:
    assert enrolled(nets.train("a", WAY, 0))[2] == ring / "a.net.xml"


# Departures


def test_trains_are_in_the_order_of_their_departures(enrolled: Read) -> None:
    scenario, _, _ = enrolled(nets.train("late", WAY, 90) + nets.train("early", WAY, 20))
    assert scenario.ids == ("early", "late")


def test_departures_count_from_the_beginning_of_the_configuration(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 620) + nets.train("b", WAY, 690), begin=600)
    assert roster.depart.tolist() == [20.0, 90.0]


def test_a_run_is_as_long_as_it_says_whenever_it_begins(enrolled: Read) -> None:
    scenario, _, _ = enrolled(nets.train("a", WAY, 699) + nets.train("b", WAY, 701), begin=600, duration=100)
    assert scenario.ids == ("a",)


def test_a_departure_with_a_speed_keeps_it_any_other_is_open(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 0, departSpeed=12) + nets.train("b", WAY, 90, departSpeed="max"))
    np.testing.assert_array_equal(roster.speed, [12.0, np.nan])


@pytest.mark.parametrize(
    ("said", "top", "speed"),
    [(12, 45, 12.0), (44, 30, 30.0), (44, 45, 40.0), ("max", 45, 35.0), ("max", 30, 30.0)],
    ids=["as stated", "its type", "the limit", "the reference", "its type below the reference"],
)  # fmt: skip
def test_a_train_starts_no_faster_than(enrolled: Read, said: Any, top: float, speed: float) -> None:
    types = f'<vType id="emu" vClass="rail" length="100" maxSpeed="{top}"/>'
    assert enrolled(nets.train("a", WAY, 0, departSpeed=said), types=types)[0].train[0].speed_mps == speed


@pytest.mark.parametrize(("top", "factor", "speed"), [(30, 0.8, 30.0), (30, 1.2, 30.0), (45, 0.8, 32.0), (45, 1.2, 35.0)])
def test_a_speed_factor_is_of_the_limits_not_of_the_train(enrolled: Read, top: float, factor: float, speed: float) -> None:
    """As fast as SUMO drives such a train where 40 m/s are allowed, measured; but nobody is driven above the reference, or a limit."""
    types = f'<vType id="emu" vClass="rail" length="100" maxSpeed="{top}" speedFactor="{factor}"/>'
    scenario, roster, _ = enrolled(nets.train("a", WAY, 0), types=types)
    assert (roster.top_speed.tolist(), roster.speed_factor.tolist()) == ([float(top)], [min(factor, 1.0)])
    assert scenario.train[0].speed_mps == speed


# Stops


def test_a_stop_lies_as_far_along_the_way_as_the_train_runs(enrolled: Read) -> None:
    """From the kilometrage of the first edge on, which the ring closes with a jump."""
    _, roster, _ = enrolled(nets.train("a", "bc cd da ab", 0, stop("ab", 300)))
    ahead = along(roster, "bc", "cd", "da", "ab") - along(roster, "ab") + 300.0
    assert roster.stops[0][0].place == pytest.approx(roster.rails.start_m[roster.rails.index["bc"]] + ahead)


def places(roster: Roster) -> list[float]:
    """Places of the stops of the only train from the beginning of its way [m]."""
    (stops,) = roster.stops
    return [s.place - float(roster.rails.start_m[roster.edge[0]]) for s in stops]


def test_stops_on_one_edge_are_made_in_one_passage(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", LAP, 0, stop("ab", 1000) + stop("ab", 1000) + stop("ab", 3000)))
    assert places(roster) == pytest.approx([1000.0, 1000.0, 3000.0])


def test_a_stop_behind_the_one_before_waits_for_the_next_lap(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", LAP, 0, stop("ab", 3000) + stop("ab", 1000)))
    lap = along(roster, *LAP.split()[:5]) - along(roster, "ab")
    assert places(roster) == pytest.approx([3000.0, lap + 1000.0])


def test_a_stop_behind_the_departure_waits_for_the_next_lap(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", LAP, 0, stop("ab", 1000), departPos=2000))
    lap = along(roster, *LAP.split()[:5]) - along(roster, "ab")
    assert places(roster) == pytest.approx([lap + 1000.0])


def test_a_stop_on_another_edge_between_ends_the_passage(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", LAP, 0, stop("ab", 1000) + stop("da", 10) + stop("ab", 3000)))
    lap = along(roster, *LAP.split()[:5]) - along(roster, "ab")
    assert places(roster)[2] == pytest.approx(lap + 3000.0)


def test_a_stop_the_train_never_comes_to_is_a_mistake(mistakes: Callable[..., list[str]]) -> None:
    told = mistakes(nets.train("a", WAY, 0, stop("in", 1000), departPos=2000))
    assert told == ["network.sumocfg: train a: stop on edge in at 1000 m: lies behind the departure or the stop before"]


def test_a_schedule_counts_from_the_beginning_of_the_configuration(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 620, stop("ab", 9, until=700)), begin=600)
    assert roster.stops[0][0].until == 100.0


def test_a_stop_without_a_schedule_holds_nobody(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 620, stop("ab", 9)), begin=600)
    assert roster.stops[0][0].until == -np.inf


def test_a_stop_lasts_as_long_as_its_file_says(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 620, stop("ab", 9, duration=45)), begin=600)
    assert roster.stops[0][0].duration == 45.0


def test_a_stop_is_called_by_its_station_else_by_its_edge(enrolled: Read) -> None:
    station = '<trainStop id="west" lane="ab_0" startPos="100" endPos="300"/>'
    body = station + nets.train("a", WAY, 0, '<stop trainStop="west" duration="5"/>' + stop("bc", 9))
    assert [s.name for s in enrolled(body)[1].stops[0]] == ["west", "bc"]


def test_trains_keep_their_own_stops(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 0) + nets.train("b", WAY, 50, stop("in", 900)))
    start = float(roster.rails.start_m[roster.rails.index["in"]])
    assert roster.stops == ((), (Stop(start + 900.0, 10.0, -np.inf, "in", edge="in"),))


# Who forms up


def test_everybody_cooperates_unless_told_otherwise(enrolled: Read) -> None:
    assert enrolled(nets.flow("f", WAY, 3, 60))[1].cooperates.tolist() == [True] * 3


def test_those_cooperate_whom_any_pattern_names(enrolled: Read) -> None:
    body = nets.flow("f", WAY, 2, 60) + nets.train("F.0", WAY, 200) + nets.train("slow", WAY, 300)
    _, roster, _ = enrolled(body, traffic={"cooperate": ["f.*", "slow"]})
    assert roster.cooperates.tolist() == [True, True, False, True]


def test_a_pattern_that_names_nobody_is_a_mistake(mistakes: Callable[..., list[str]]) -> None:
    told = mistakes(nets.flow("f", WAY, 2, 60), traffic={"cooperate": ["f.*", "F.*"]})
    assert told == ["traffic.cooperate = F.*: no train of that name; there are: f.0, f.1"]


def test_of_many_trains_the_first_eight_are_listed(mistakes: Callable[..., list[str]]) -> None:
    (told,) = mistakes(nets.flow("f", WAY, 9, 60), traffic={"cooperate": ["x"]})
    assert told.endswith("there are: f.0, f.1, f.2, f.3, f.4, f.5, f.6, f.7 ...")


# Types


def test_what_the_scenario_says_of_a_type_goes_before_its_file(enrolled: Read) -> None:
    assert enrolled(nets.train("a", WAY, 0), types=WHOLE)[0].train_type["emu"].unit_mass_kg == 200000.0


def test_a_type_the_scenario_does_not_know_is_read_from_its_file(enrolled: Read) -> None:
    scenario, _, _ = enrolled(nets.train("a", WAY, 0), types=WHOLE, known="other")
    assert scenario.train_type["emu"].unit_mass_kg == 90000.0


def test_a_train_has_the_vclass_of_its_type(enrolled: Read) -> None:
    assert enrolled(nets.train("a", WAY, 0))[1].vclass == ("rail",)


def test_a_point_has_one_unit(mistakes: Callable[..., list[str]]) -> None:
    told = mistakes(nets.train("a", WAY, 0), train_type={"emu": nets.UNITS})
    assert told == ["train_type.emu.units = 4: the point plant has one unit per train"]


def test_what_is_not_followed_is_kept_for_the_reader(enrolled: Read) -> None:
    _, roster, _ = enrolled(nets.train("a", WAY, 0) + '<person id="p" depart="0"><walk edges="in"/></person>')
    assert roster.notes[0] == "1 definitions of persons left out"


# Orders


def order(**said: str) -> dict[str, str]:
    return {"kind": "reroute", "train": "a", "to_edge": "bc"} | said


def test_an_edge_of_a_junction_is_nowhere_to_go_to(mistakes: Callable[..., list[str]]) -> None:
    told = mistakes(nets.train("a", WAY, 0), event=(order(), order(to_edge=":b_0")))
    assert told == ["event[2].to_edge = :b_0: no such edge for trains; there are: ab, bc, cd, da, in, out"]


def test_nobody_is_ordered_who_does_not_come(mistakes: Callable[..., list[str]]) -> None:
    told = mistakes(nets.train("a", WAY, 0), event=(order(train="b"),))
    assert told == ["event[1].train = b: no such train; there are: a"]


def test_all_mistakes_are_told_at_once_each_of_them_once(mistakes: Callable[..., list[str]]) -> None:
    told = mistakes(
        nets.train("a", WAY, 0),
        traffic={"cooperate": ["x", "x"]}, train_type={"emu": nets.UNITS}, event=(order(train="b"),),
    )  # fmt: skip
    assert [line.partition(" = ")[0] for line in told] == ["train_type.emu.units", "traffic.cooperate", "event[1].train"]
