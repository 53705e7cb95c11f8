"""What a SUMO configuration says in other words, and what nothing was said of: against plain SUMO on the same files where it can."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import nets
import pytest
import tomli_w
from beside import OPEN, plain

from trainctl.errors import InputError
from trainctl.scenario.build import open_scenario
from trainctl.scenario.model import Model
from trainctl.traffic.files import read_options
from trainctl.traffic.handed import handed
from trainctl.traffic.read import Configuration, read_traffic

WAY = "ab bc cd"
TRAIN = nets.train("v", WAY, 0)


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Configuration]:
    """Read one demand on three edges and a branch, with options and changes to the text of the net."""

    def read(
        body: str = TRAIN, options: str = "", types: str = nets.EMU, net: tuple[str, str] = ("", ""), **said: int
    ) -> Configuration:
        edges = {"ab": ("a", "b"), "bc": ("b", "c"), "cd": ("c", "d"), "by": ("b", "y")}
        nets.net(tmp_path, {"a": (0, 0), "b": (2000, 0), "c": (4000, 0), "d": (6000, 0), "y": (4000, -800)}, edges)
        file = tmp_path / "a.net.xml"
        assert net[0] in file.read_text()
        file.write_text(file.read_text().replace(*net, 1))
        nets.traffic(tmp_path, body, types, **said)
        sumocfg = tmp_path / "a.sumocfg"
        sumocfg.write_text(sumocfg.read_text().replace(OPEN, OPEN + options).replace('<end value="-1"/>', ""))
        return read_traffic(sumocfg, tmp_path / "work")

    return read


def notes(traffic: Configuration, word: str) -> list[str]:
    return [note for note in traffic.notes if word in note]


# Options


def test_an_option_may_stand_as_text_as_in_sumo(read, tmp_path) -> None:
    assert (
        {d.id for d in read(options="<processing>words<scale>2</scale></processing>").departures}
        == {row["id"] for row in plain(tmp_path, "tripinfo")}
        == {"v", "v.1"}
    )


def test_options_have_one_name_whatever_the_file_calls_them(tmp_path) -> None:
    file = tmp_path / "a.sumocfg"
    file.write_text(
        '<configuration><input><n value="n"/><routes value="r"/></input><railsignal.moving-block value="true"/><W value="true"/>'
        '<vehroutes.sorted value="1"/><device.routing.period value="9"/><device.toc.knownveh value="x"/></configuration>'
    )
    assert list(read_options(file)) == [
        "net-file", "route-files", "railsignal-moving-block", "no-warnings", "vehroute-output.sorted", "device.rerouting.period",
        "device.toc.explicit",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ('<net value="a.net.xml"/>', "option net-file is given twice, which SUMO refuses; take one out"),
        ('<tripinfos-output value="t.xml"/>', "option tripinfos-output: SUMO has none of this name"),
        ('<mesosim value="true"/>', "option mesosim = true: SUMO's mesoscopic model has no trains on tracks; take it out"),
    ],
)
def test_options_that_cannot_be_are_refused(read, tmp_path, options, told) -> None:
    with pytest.raises(InputError) as caught:
        read(options=options)
    assert caught.value.mistakes == [f"{tmp_path / 'a.sumocfg'}: {told}"]


def test_an_end_before_the_beginning_is_a_mistake(read, tmp_path) -> None:
    with pytest.raises(InputError) as caught:
        read(begin=10, end=5)
    assert caught.value.mistakes == [f"{tmp_path / 'a.sumocfg'}: end = 5: must be after begin = 10 s"]


@pytest.mark.parametrize(
    "key", ["no-internal-links", "ignore-accidents", "device.glosa.probability", "max-num-vehicles", "time-to-teleport"]
)
def test_options_that_change_a_run_in_sumo_are_named(read, key) -> None:
    assert len(notes(read(options=f'<{key} value="1"/>'), f"option {key} = 1: not followed: ")) == 1


def test_sumo_is_handed_no_option_that_is_said_not_to_be_followed(read) -> None:
    traffic = read(options='<max-num-vehicles value="1"/><eager-insert value="1"/><railsignal.max-block-length value="9"/>')
    assert dict(handed(traffic.source, ["v"], [], 0.0).options).keys() == {"eager-insert", "railsignal.max-block-length"}


def obeying(folder: Path, options: str, signals: str, stops: str = "") -> Model:
    nodes = {"a": (0, 0), "b": (4000, 0), "c": (8000, 0)}
    nets.net(folder, nodes, {"ab": ("a", "b"), "bc": ("b", "c")}, signals="b")
    nets.traffic(folder, nets.train("v", "ab bc", 0, stops))
    sumocfg = folder / "a.sumocfg"
    sumocfg.write_text(sumocfg.read_text().replace(OPEN, OPEN + options))
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario("robust_constrained", 100, traffic={"signals": signals})))
    return open_scenario(str(folder / "s.toml"))


@pytest.mark.parametrize("signals", ["obey", "ignore"])
def test_options_of_signals_are_followed_where_signals_are(tmp_path, signals) -> None:
    roster = obeying(tmp_path, '<railsignal.max-block-length value="9000"/>', signals).roster
    named = "option railsignal.max-block-length = 9000: not followed: signals are not obeyed"
    assert ("options: railsignal.max-block-length" in roster.followed, named in roster.notes) == (
        signals == "obey",
        signals != "obey",
    )


def test_a_constraint_that_goes_by_the_trip_of_a_stop_is_named(tmp_path) -> None:
    rule = '<railSignalConstraints id="b"><predecessor tripId="T1" tl="b" foes="v"/></railSignalConstraints>'
    (tmp_path / "c.add.xml").write_text(f"<additional>{rule}</additional>")
    stop = '<stop lane="ab_0" endPos="900" duration="5" tripId="T1"/>'
    told = "railSignalConstraints b: predecessor: T1: not followed: no stop gives a train another tripId"
    assert told in obeying(tmp_path, '<additional-files value="c.add.xml"/>', "obey", stop).roster.notes


# Trains


def test_devices_that_change_a_run_are_named_and_those_that_watch_are_not(read) -> None:
    given = {"has.toc.device": "true", "device.stationfinder.radius": "9", "has.fcd.device": "true", "has.glosa.device": "false",
             "has.routing.device": "true", "junctionModel.ignoreIDs": "w", "doors": "red"}  # fmt: skip
    params = "".join(f'<param key="{key}" value="{value}"/>' for key, value in given.items())
    assert notes(read(nets.train("v", WAY, 0, params)), "<param") == [
        "1 x <param has.toc.device>, 1 x <param device.stationfinder.radius>: not followed: trains have no such device",
        "1 x <param has.routing.device>: not followed: trains keep their routes",
        "1 x <param junctionModel.ignoreIDs>: not followed: no train is overlooked",
    ]


def test_a_train_that_sumo_would_let_pass_red_is_named(read) -> None:
    types = nets.EMU.replace("/>", ' jmDriveAfterRedTime="99" lcStrategic="1"/>')
    assert notes(read(types=types), "<vType") == [
        "1 x <vType jmDriveAfterRedTime>: not followed: train type and law of the scenario drive the train"
    ]


def test_limits_that_a_train_need_not_keep_in_sumo_are_kept_and_that_is_named(read) -> None:
    assert notes(read(types=nets.EMU.replace("/>", ' speedFactor="1.2"/>')), "vType emu") == [
        "vType emu: speedFactor = 1.2: not followed: trains keep to the limits of their tracks"
    ]


def test_a_waypoint_with_a_time_is_named(read) -> None:
    stop = '<stop lane="bc_0" endPos="900" until="300" speed="{}"/>'
    said = "1 x <stop until with speed>: not followed: a train passes a waypoint whenever it comes"
    assert said in read(nets.train("v", WAY, 0, stop.format(10))).notes
    assert said not in read(nets.train("v", WAY, 0, stop.format(0))).notes


@pytest.mark.parametrize(("speed", "top", "told"), [(40, 45, 0), (40.05, 45, 1), (44, 30, 1)])
def test_a_departure_that_sumo_refuses_as_too_fast_is_named(read, speed, top, told) -> None:
    traffic = read(nets.train("v", WAY, 0, departSpeed=speed), types=nets.EMU.replace("45", str(top)))
    assert len(notes(traffic, "x departSpeed: not followed: they begin no faster")) == told


def test_a_stop_that_begins_where_it_ends_is_made_as_in_sumo(read, tmp_path) -> None:
    body = nets.train("v", WAY, 0, '<stop lane="bc_0" startPos="100" endPos="100" duration="10"/>')
    (stop,) = read(body).departures[0].stops
    (theirs,) = plain(tmp_path, "stop")
    assert (stop.edge, stop.position_m) == ("bc", float(theirs["pos"]))


@pytest.mark.parametrize(
    ("place", "told"), [('startPos="900" endPos="100"', "startPos = 900"), ('startPos="x" endPos="100"', "startPos = x")]
)
def test_a_stop_that_begins_behind_its_end_is_a_mistake(read, place, told) -> None:
    with pytest.raises(InputError) as caught:
        read(nets.train("v", WAY, 0, f'<stop lane="bc_0" {place} duration="10"/>'))
    assert caught.value.mistakes == [f"train v: stop on edge bc: {told}: must be a number, and not behind its end at 100 m"]


def test_a_stop_short_of_the_end_of_its_place_is_made_there_as_in_sumo(read, tmp_path) -> None:
    place = '<busStop id="s" lane="bc_0" startPos="500" endPos="700"/>'
    (tmp_path / "p.add.xml").write_text(f"<additional>{place}</additional>")
    body = nets.train("v", WAY, 0, '<stop busStop="s" endPos="600" duration="10"/><stop busStop="s" duration="10"/>')
    stops = read(body, '<additional-files value="p.add.xml"/>').departures[0].stops
    assert [s.position_m for s in stops] == [float(s["pos"]) for s in plain(tmp_path, "stop")] == [600.0, 700.0]


def test_stops_of_a_repeated_route_that_is_the_trains_own_are_made_once_as_in_sumo(read, tmp_path) -> None:
    edges = {"ab": ("a", "b"), "bc": ("b", "c"), "ca": ("c", "a")}
    read()  # the net is another one
    nets.net(tmp_path, {"a": (0, 0), "b": (2000, 0), "c": (1000, 2000)}, edges)
    route = '<route edges="ab bc ca" repeat="1"><stop lane="bc_0" endPos="500" duration="10"/></route>'
    body = f'<vehicle id="v" type="emu" depart="0">{route}<stop lane="ca_0" endPos="700" duration="10"/></vehicle>'
    nets.traffic(tmp_path, body)
    (train,) = read_traffic(tmp_path / "a.sumocfg", tmp_path / "work").departures
    assert [(s.edge, s.first) for s in train.stops] == [("bc", 0), ("ca", 0)]
    assert [row["lane"] for row in plain(tmp_path, "stop")] == ["bc_0", "ca_0"]


def test_no_stop_is_lost_in_silence(read) -> None:
    with pytest.raises(InputError) as caught:
        read(nets.train("v", WAY, 0, '<stop lane="bc_0" endPos="0" duration="10"/>'))
    (told,) = caught.value.mistakes
    assert told.startswith("train v: SUMO's duarouter drops 1 of its stops")


# Routes and flows

ROUTES = (
    '<route id="q1" edges="ab bc cd"><stop lane="bc_0" endPos="300" until="100"/></route>'
    '<route id="q2" edges="ab by"><stop lane="by_0" endPos="300" until="200"/></route>'
)


@pytest.mark.parametrize("within", [True, False])
@pytest.mark.parametrize("by", ["list", "members"])
def test_routes_that_a_distribution_names_are_as_probable_as_it_says(read, tmp_path, within, by) -> None:
    members = '<route refId="q1" probability="0"/><route refId="q2" probability="1"/>'
    said = 'routes="q1 q2" probabilities="0 1"/>' if by == "list" else f">{members}</routeDistribution>"
    outside, inside = ("", f"<routeDistribution {said}") if within else (f'<routeDistribution id="rd" {said}', "")
    route = "" if within else 'route="rd"'
    vehicles = "".join(f'<vehicle id="v{k}" type="emu" depart="{50 * k}" {route}>{inside}</vehicle>' for k in range(5))
    traffic = read(f"{ROUTES}{outside}{vehicles}")
    assert {d.edges for d in traffic.departures} == {("ab", "by")}
    theirs = plain(tmp_path, "stop", "--insertion-checks", "none")
    assert (
        [d.stops[0].until_s for d in traffic.departures]
        == [float(s["ended"]) for s in theirs]
        == [200.0 + 50 * k for k in range(5)]
    )


def test_routes_of_a_distribution_that_cannot_be_told_apart_are_refused(read) -> None:
    other = ROUTES.replace('edges="ab bc cd"', 'edges="ab by"').replace("bc_0", "by_0")
    with pytest.raises(InputError) as caught:
        read(f'{other}<vehicle id="v" type="emu" depart="0"><routeDistribution routes="q1 q2"/></vehicle>')
    assert caught.value.mistakes == [
        "train v: stops of routes in a distribution, several of the same edges, are not followed; give each train its route"
    ]


def test_a_route_that_a_distribution_does_not_find_is_a_mistake(read) -> None:
    with pytest.raises(InputError) as caught:
        read(f'{ROUTES}<vehicle id="v" type="emu" depart="0"><routeDistribution routes="q1 q3"/></vehicle>')
    assert caught.value.mistakes == ["routeDistribution of a train: route q3: no such route"]


@pytest.mark.parametrize(("begin", "end", "said"), [(0, 2000, 'begin="100"'), (300, 3000, ""), (0, -1, 'begin="100"')])
def test_a_number_of_trains_without_an_end_comes_as_in_sumo(read, tmp_path, begin, end, said) -> None:
    """Spread until the end of the configuration, or else over a day, however long the scenario is."""
    traffic = read(f'<flow id="g" type="emu" {said} number="3"><route edges="ab bc"/></flow>', begin=begin, end=end)
    theirs = [float(row["depart"]) for row in plain(tmp_path, "tripinfo")]
    assert len(theirs) == 3
    assert [d.depart_s for d in traffic.departures] == pytest.approx(theirs, abs=1.0)


# Signs and rerouters


@pytest.mark.parametrize(
    ("attributes", "child", "told"),
    [
        ('radius="90"', "", "1 x <rerouter radius>: not followed: trains are rerouted where they come onto its edges"),
        ('optional="true"', "", "1 x <rerouter optional>: not followed: trains are rerouted there unasked"),
        ('optional="false" pos="3"', "", None),
        ("", '<closingReroute id="by" until="90"/>',
         "1 x <closingReroute until>: not followed: a train goes round a closed edge, however long it is closed"),
        ("", '<riddle id="by"/>', "1 x <riddle>: not followed: it is not known here"),
    ],
)  # fmt: skip
def test_what_a_rerouter_says_that_is_not_followed_is_named(read, tmp_path, attributes, child, told) -> None:
    rerouter = f'<rerouter id="r" edges="ab" {attributes}><interval begin="0" end="9">{child}</interval></rerouter>'
    (tmp_path / "r.add.xml").write_text(f"<additional>{rerouter}</additional>")
    traffic = read(options='<additional-files value="r.add.xml"/>')
    assert "<rerouter>: 1" in traffic.followed and traffic.notes == ((told,) if told else ())


@pytest.mark.parametrize(("times", "sorted_"), [((0, 9), True), ((9, 9), True), ((9, 0), False)])
def test_steps_of_a_sign_that_sumo_refuses_are_refused(read, tmp_path, times, sorted_) -> None:
    steps = "".join(f'<step time="{t}" speed="9"/>' for t in times)
    (tmp_path / "v.add.xml").write_text(
        f'<additional><variableSpeedSign id="s" lanes="ab_0">{steps}</variableSpeedSign></additional>'
    )
    try:
        read(options='<additional-files value="v.add.xml"/>')
    except InputError as error:
        assert error.mistakes == [f"{tmp_path / 'a.sumocfg'}: variableSpeedSign s: steps must be sorted by time"] and not sorted_
    else:
        assert sorted_


def test_a_rerouter_that_ends_routes_is_refused(read, tmp_path) -> None:
    end = '<interval begin="0" end="9"><destProbReroute id="terminateRoute"/></interval>'
    (tmp_path / "r.add.xml").write_text(f'<additional><rerouter id="r" edges="ab">{end}</rerouter></additional>')
    with pytest.raises(InputError) as caught:
        read(options='<additional-files value="r.add.xml"/>')
    told = "rerouter r: destProbReroute terminateRoute: no train ends at a rerouter; end its route there, or take this out"
    assert caught.value.mistakes == [f"{tmp_path / 'a.sumocfg'}: {told}"]


# Nets


def test_a_limit_of_one_class_is_refused_where_it_is_another(read, tmp_path) -> None:
    def limited(vclass: str, speed: float) -> tuple[str, str]:
        return '<edge id="ab"', f'<type id="k"><restriction vClass="{vclass}" speed="{speed}"/></type><edge id="ab" type="k"'

    assert not notes(read(net=limited("rail", 40.0)), "restriction") + notes(read(net=limited("tram", 12.0)), "restriction")
    with pytest.raises(InputError) as caught:
        read(net=limited("rail", 12.0))
    (told,) = caught.value.mistakes
    assert told.startswith(f"{tmp_path / 'a.net.xml'}: edge ab: its type k has a restriction of rail to 12.0 m/s: ")


def test_what_stands_in_edges_and_lanes_of_a_net_is_named(read) -> None:
    told = read(net=('<lane id="ab_0"', '<stopOffset value="9"/><riddle/><lane id="ab_0"'))
    assert notes(told, "net: 1 x <") == [
        "net: 1 x <stopOffset>: not followed: trains stop where the track ends or a signal stands",
        "net: 1 x <riddle>: not followed: it is not known here",
    ]


def test_a_default_namespace_changes_nothing(read, tmp_path) -> None:
    read()
    routes = tmp_path / "a.rou.xml"
    routes.write_text(routes.read_text().replace("<routes>", '<routes xmlns="http://sumo.dlr.de">'))
    assert [d.id for d in read_traffic(tmp_path / "a.sumocfg", tmp_path / "work").departures] == ["v"]
