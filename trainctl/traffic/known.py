"""What is known of a SUMO configuration and its files: what is followed, and what is named or refused instead, in which words.

The tables below decide. What stands in none of them is named too, so that nothing is passed over without a word. What is
followed is listed as well: who reads the list need not trust silence.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import NamedTuple
from xml.etree.ElementTree import Element

from sumo_net.netfile import NetFile
from trainctl.traffic.files import bad_number

#: Why what is not known here is not followed.
UNKNOWN = "it is not known here"

#: The same of what would have trains rerouted, of how SUMO's own drivers drive, and of what SUMO may fit a train with.
KEEP_ROUTES, DRIVEN = "trains keep their routes", "train type and law of the scenario drive the train"
NO_DEVICE = "trains have no such device"

#: Params that SUMO reads of a train or a type, beside those of devices: how they begin, and why they are not followed.
PARAMS_NAMED = {
    "junctionModel.ignore": "no train is overlooked",
    "carFollowModel.ignore": "no train is overlooked",
    "parking.": "trains keep their parking areas",
}


class Refused(NamedTuple):
    """Why a configuration with this in it is not run."""

    why: str


class Said(NamedTuple):
    """What is said of a configuration's files, one line each."""

    followed: list[str]
    named: list[str]  # not followed, with the reason
    refused: list[str]


def _words(*lines: str) -> frozenset[str]:
    return frozenset(word for line in lines for word in line.split())


#: Values that switch something off, or are what it is anyway.
OFF = frozenset(("", "0", "false", "False", "off", "no", "-1", "none", "0.0", "0.00"))

#: Options that are followed.
OPTIONS = _words(
    "net-file route-files additional-files begin end scale scale-suffix max-depart-delay use-stop-ended",
    "default.departspeed",
    "junction-taz",
    "railway.max-train-length weights.reversal-penalty weights.turnaround-penalty weights.minor-penalty weights.priority-factor",
)

#: Those of which is said with the signals, see ``of_signals``: how they begin, and the one that is no difference to moving block.
#: Without eager-insert a train that a constraint keeps out keeps out all that are to begin on its edge.
OF_SIGNALS, MOVING_BLOCK = ("railsignal", "tls.", "eager-insert"), "railsignal-moving-block"

#: Options that cannot change the run of a train: what is written, drawn and checked, and how fast SUMO itself runs.
OPTIONS_OF_NO_EFFECT = _words(
    "verbose print-options help version xml-validation xml-validation.net xml-validation.routes no-warnings aggregate-warnings",
    "message-log error-log language no-step-log step-log.period duration-log.disable duration-log.statistics output-prefix",
    "output-suffix precision precision.geo human-readable-time threads route-steps quit-on-end start delay breakpoints remote-port",
    "num-clients demo registry-viewport window-size window-pos tracker-interval save-template save-schema save-commented",
    "netstate-dump netstate-dump.empty-edges netstate-dump.precision write-license write-metadata configuration-file",
    "load-state.offset load-state.remove-vehicles edgedata-files alternative-net-file selection-file disable-textures",
    "emergencydecel.warning-threshold waiting-time-memory max-num-persons",
)

#: Devices that watch a train, and do nothing to its run.
WATCHING = _words("fcd emissions ssm tripinfo vehroute battery elechybrid btreceiver btsender example transportable")

#: How the names of other such options begin: of such devices, and of what is no train.
OF_NO_EFFECT_FROM = (
    "gui", "log", "game", "save-configuration", "save-state.", "emissions.", "phemlight-", "pedestrian.", "person-device.",
    "persontrip.", "intermodal-collision.", "ride.", "overhead-wire.",
    *(f"device.{name}." for name in sorted(WATCHING)),
)  # fmt: skip

#: Options that are not followed: in which words, and the values with which they mean nothing.
OPTIONS_NAMED: Mapping[str, tuple[str, frozenset[str]]] = {
    "step-length": ("the step is run.step_s of the scenario", frozenset()),
    "seed": ("what is drawn is drawn with a seed of its own", frozenset()),
    "random": ("what is drawn is drawn with a seed of its own", OFF),
    "default.departlane": ("trains begin on a lane that allows them and leads on", _words("best_prob best first 0 allowed free")),
    "default.speeddev": ("no speed is drawn", OFF),
    "time-to-teleport": ("trains are never teleported", OFF),
    "time-to-teleport.highways": ("trains are never teleported", OFF),
    "time-to-teleport.bidi": ("trains are never teleported", OFF),
    "time-to-teleport.railsignal-deadlock": ("trains are never teleported", OFF),
    "time-to-teleport.disconnected": ("trains are never teleported", OFF),
    "collision.action": ("trains that collide stay where they are, and the run fails", _words("warn none")),
    "collision.mingap-factor": ("trains collide where they overlap", _words("0")),
    "collision.check-junctions": ("it is always on", _words("true 1 on yes")),
    "step-method.ballistic": ("the scenario's plants move the trains", OFF),
    "default.action-step-length": ("trains are commanded in every step", OFF),
    "default.carfollowmodel": ("the scenario's law drives the trains", frozenset()),
    "default.emergencydecel": ("the scenario's supervisor brakes the trains", frozenset()),
    "use-stop-started": ("a stop begins when the train stands", OFF),
    "ignore-route-errors": ("routes must be connected", OFF),
    "max-num-vehicles": ("all trains come", OFF),
    "insertion-checks": ("a train enters when it can do so safely", frozenset()),
    "random-depart-offset": ("trains depart when they are to", OFF),
    "load-state": ("trains begin as their routes say", OFF),
    "no-internal-links": ("trains run over the edges that junctions have inside", OFF),
    "ignore-accidents": ("trains that collide are always found", OFF),
    "keep-after-arrival": ("a train that has arrived is gone", OFF),
    "weight-files": (KEEP_ROUTES, OFF),
    "lateral-resolution": ("trains keep to the middle of their tracks", OFF | {"-1"}),
    "sloppy-insert": ("a train enters when it can do so safely", OFF),
    "emergency-insert": ("a train enters when it can do so safely", OFF),
    "extrapolate-departpos": ("a train begins where departPos says", OFF),
}  # fmt: skip

#: Elements of route and additional files, with the attributes of them that are followed.
ELEMENTS: Mapping[str, frozenset[str]] = {
    "vehicle": (_train := _words(
        "id type depart route line departPos departSpeed departEdge arrivalEdge arrivalPos begin end period number vehsPerHour",
        "perHour probability from to via fromJunction toJunction viaJunctions",
    )),
    "trip": _train,
    "flow": _train,
    "route": _words("id edges probability repeat cycleTime refId"),
    "routeDistribution": _words("id routes probabilities last"),
    "vTypeDistribution": _words("id vTypes probabilities"),
    "stop": _words(
        "lane edge startPos endPos friendlyPos duration until arrival ended trainStop busStop containerStop parkingArea",
        "chargingStation overheadWireSegment speed",
    ),
    "vType": _words(
        "id vClass length maxSpeed speedFactor probability carFollowModel trainType mass maxPower maxTraction resCoef_constant",
        "resCoef_linear resCoef_quadratic massFactor decel",
    ),
    **dict.fromkeys(
        ("trainStop", "busStop", "containerStop", "chargingStation", "overheadWireSegment"),
        _words("id lane startPos endPos friendlyPos"),
    ),
    "parkingArea": _words("id lane startPos endPos friendlyPos"),
    "space": frozenset(),
}  # fmt: skip

#: Attributes that cannot change the run of a train.
OF_NO_EFFECT: Mapping[str, frozenset[str]] = {
    "vehicle": (_drawn := _words(
        "color imgFile personNumber containerNumber personCapacity containerCapacity departPosLat arrivalPosLat",
    )),
    "trip": _drawn,
    "flow": _drawn,
    "route": _words("color cost period savings exitTimes type"),
    "stop": _words(
        "line tripId actType color name posLat permitted expected expectedContainers",
    ),
    "vType": _words(
        "color width height guiShape imgFile osgFile emissionClass carriageLength locomotiveLength carriageGap personCapacity",
        "containerCapacity boardingDuration loadingDuration laneChangeModel maxSpeedLat latAlignment minGapLat",
        "manoeuverAngleTimes manufacturer parkingBadges",
    ),
    **dict.fromkeys(
        ("trainStop", "busStop", "containerStop", "chargingStation", "overheadWireSegment", "parkingArea"),
        _words("name lines color personCapacity parkingLength group access angle width length",
               "power efficiency chargeInTransit chargeDelay chargeType"),
    ),
    "space": _words("x y z width length angle slope"),
}  # fmt: skip

#: Attributes that are not followed: in which words, and the values with which they mean nothing.
NAMED: Mapping[tuple[str, str], tuple[str, frozenset[str]] | Refused] = {
    **{
        (tag, key): said
        for tag in ("vehicle", "trip", "flow")
        for key, said in {
            "arrivalSpeed": ("trains leave as fast as they come", _words("current")),
            "speedFactor": ("that of the vType holds", frozenset()),
            "insertionChecks": ("a train enters when it can do so safely", _words("all")),
            "departLane": ("trains begin on a lane that allows them and leads on", _words("0 first free allowed best best_prob")),
            "arrivalLane": ("trains arrive on any lane", _words("current first")),
            "reroute": (KEEP_ROUTES, OFF),
            "fromTaz": ("trips between zones have no route here", frozenset()),
            "toTaz": ("trips between zones have no route here", frozenset()),
        }.items()
    },
    ("stop", "parking"): ("the train stays on its track, and others wait for it", OFF | _words("true 1 yes on x t True")),
    ("stop", "triggered"): ("no passengers board; a train stands as long as duration and until say", OFF),
    ("stop", "containerTriggered"): ("nothing is loaded; a train stands as long as duration and until say", OFF),
    ("stop", "join"): Refused("trains are not joined; take the stop and the train that joins out of the files"),
    ("stop", "split"): Refused("trains are not split; take the stop's split and the train it names out of the files"),
    ("stop", "jump"): Refused("a train cannot jump to its next edge; give it a route there"),
    ("stop", "jumpUntil"): ("trains do not jump", OFF),
    ("stop", "started"): ("a stop begins when the train stands", OFF),
    ("stop", "onDemand"): ("no passengers wait or board; the train stops", OFF),
    ("stop", "index"): ("stops are made in the order of the file", _words("end fit")),
    ("stop", "extension"): ("the train does not wait for others", OFF),
    ("parkingArea", "roadsideCapacity"): ("trains park at its end, whichever place is free", _words("0 1")),
    ("parkingArea", "onRoad"): ("a train that stops there leaves the track", OFF),
    ("vType", "scale"): ("every train of it comes once", _words("1 1.0 1.00")),
    **{
        ("vType", key): (DRIVEN, frozenset[str]())
        for key in ("accel", "emergencyDecel", "apparentDecel", "tau", "sigma", "minGap", "speedDev", "actionStepLength",
                    "desiredMaxSpeed", "startupDelay", "impatience", "timeToTeleport", "curveResistance")
    },
}  # fmt: skip

#: Whole elements of route and additional files that are not followed, in which words.
ELEMENTS_NAMED: Mapping[str, str | Refused] = {
    "calibrator": "no train is let in or taken out by it",
    "vaporizer": "no train is taken out by it",
    "overheadWire": "overhead wires are not modelled",
    "tractionSubstation": "overhead wires are not modelled",
    "taz": "trips between zones have no route here",
    "tazs": "trips between zones have no route here",
    "interval": "flows between edges or zones have no route here",
    "relation": "they say nothing of a train here",
    "deadlock": "our own interlocking keeps trains apart",
}  # fmt: skip

#: Whole elements of additional files that are followed where signals are obeyed, and why they are not where they are ignored.
ELEMENTS_OF_SIGNALS: Mapping[str, str] = {
    "railSignalConstraints": "trains go first come, first served",
    "tlLogic": "signals are not obeyed; our own interlocking keeps trains apart",
    "WAUT": "signals are not obeyed; our own interlocking keeps trains apart",
    "wautJunction": "signals are not obeyed; our own interlocking keeps trains apart",
}

#: Whole elements of additional files that are followed.
ELEMENTS_FOLLOWED = _words("variableSpeedSign rerouter")

#: What of them, and of the elements in them, is followed, told elsewhere, or drawn.
OF_FOLLOWED: Mapping[str, frozenset[str]] = {
    "variableSpeedSign": _words("id lanes file vTypes name pos"),  # SUMO shows it to every type
    "step": _words("time speed"),
    "rerouter": _words("id edges file probability off vTypes timeThreshold name pos"),
    "interval": _words("id begin end"),
    "closingReroute": _words("id allow disallow"),
    "destProbReroute": _words("id probability"),
    "routeProbReroute": _words("id probability"),
}

#: Attributes of these that are not followed, in which words.
OF_FOLLOWED_NAMED = {
    ("rerouter", "optional"): "trains are rerouted there unasked",
    ("rerouter", "radius"): "trains are rerouted where they come onto its edges",
    ("closingReroute", "until"): "a train goes round a closed edge, however long it is closed",
}

#: What a rerouter may hold besides: why it is not followed.
REROUTERS_NAMED = {
    "closingLaneReroute": "no lane is closed",
    "parkingAreaReroute": "trains keep their parking areas",
    "stationReroute": "trains keep their stops",
    "viaProbReroute": "trains keep their routes",
    "overtakingReroute": "trains keep their routes; our own interlocking lets them meet",
}

#: Elements that cannot change the run of a train: outputs, drawings, and what belongs to roads.
ELEMENTS_OF_NO_EFFECT = _words(
    "poly poi location type include param inductionLoop e1Detector instantInductionLoop laneAreaDetector e2Detector",
    "entryExitDetector e3Detector edgeData laneData routeProbe vTypeProbe timedEvent access edgeRelations edges dataSource",
    "person personFlow container containerFlow",  # counted: see ``checks``
)

#: Elements of a net.
NET_ELEMENTS = _words("location type edge junction connection prohibition roundabout param neigh")
#: Those that are not followed, in which words.
NET_NAMED = {"stopOffset": "trains stop where the track ends or a signal stands"}
#: Attributes of edges, lanes and connections that matter, and those that only draw.
NET_EDGE = _words("id from to priority type function bidi distance spreadType shape name length crossingEdges routingType")
NET_LANE = _words(
    "id index allow disallow speed length width shape endOffset customShape type acceleration outlineShape changeLeft changeRight",
)
NET_CONNECTION = _words(
    "from to fromLane toLane via dir state tl linkIndex linkIndex2 pass keepClear contPos visibility shape uncontrolled length",
    "speed customLength allow disallow changeLeft changeRight indirect fringe",
)


#: The same of options whose names begin so.
OPTIONS_NAMED_FROM = {
    "device.rerouting.": (KEEP_ROUTES, OFF),
    "device.": (NO_DEVICE, OFF),
    "meso-": ("trains are simulated one by one", frozenset[str]()),
    "lanechange.": ("trains keep to their tracks", OFF),
    "time-to-teleport.": ("trains are never teleported", OFF),
    "collision.": ("trains that collide stay where they are, and the run fails", OFF),
}

#: Options with which a configuration is not run.
OPTIONS_REFUSED = {"mesosim": Refused("SUMO's mesoscopic model has no trains on tracks; take it out")}


def of_options(options: Mapping[str, str]) -> Said:
    """What options of a configuration are followed, one line for all, and which are not, one line each."""
    followed, lines, refused = [], [], []
    for key, value in options.items():
        if key in OPTIONS_REFUSED and value not in OFF:
            refused.append(f"option {key} = {value}: {OPTIONS_REFUSED[key].why}")
        if key in OPTIONS_REFUSED or key.startswith(OF_SIGNALS) or _no_effect(key):
            continue
        kind = next((said for start, said in OPTIONS_NAMED_FROM.items() if key.startswith(start)), (UNKNOWN, frozenset[str]()))
        words, idle = OPTIONS_NAMED.get(key, kind)
        if key in OPTIONS or value in idle:
            followed.append(key)
        else:
            lines.append(f"option {key} = {value}: not followed: {words}")
    return Said([f"options: {', '.join(followed)}"] if followed else [], lines, refused)


def strange(options: Iterable[str]) -> list[str]:
    """Options that the tables do not have, of SUMO's or none."""
    tables: tuple[Collection[str], ...] = (OPTIONS, OPTIONS_NAMED, OPTIONS_REFUSED)
    return [key for key in options if not any(key in table for table in tables) and key not in OPTIONS_OF_NO_EFFECT]


def _no_effect(key: str) -> bool:
    return key in OPTIONS_OF_NO_EFFECT or "output" in key or key.startswith(OF_NO_EFFECT_FROM)


def of_trains(elements: Iterable[Element]) -> Said:
    """What the elements of trains, routes, stops and types say: what of it is followed, what is not, and what is refused.

    Of what is followed there is one line for each element, of the rest one for each reason: attributes with the same reason share
    it, each with how often it stands there.
    """
    found = Counter(said for element in elements for one in element.iter() for said in _of_one(one))
    followed: dict[str, list[str]] = {}
    named: dict[str, list[str]] = {}
    refused: dict[str, list[str]] = {}
    for (tag, key, said), n in found.items():
        if said is None:
            followed.setdefault(tag, []).append(f"{n} x {key}")
            continue
        lines, why = (refused, said.why) if isinstance(said, Refused) else (named, said)
        lines.setdefault(why, []).append(f"{n} x <{f'{tag} {key}'.rstrip()}>")
    return Said(
        [f"<{tag}>: {', '.join(keys)}" for tag, keys in followed.items()],
        [f"{', '.join(those)}: not followed: {why}" for why, those in named.items()],
        [f"{', '.join(those)}: {why}" for why, those in refused.items()],
    )


def _of_one(element: Element) -> Iterator[tuple[str, str, str | Refused | None]]:
    """Element, attribute, and why it is not followed (None: it is) of all that one element says of the run of a train."""
    tag = element.tag
    if tag == "param":  # what SUMO does not know is the user's own
        key = element.get("key", "")
        if (why := _of_param(key)) and element.get("value", "") not in OFF:
            yield tag, key, why
        return
    if tag.startswith("carFollowing-"):
        yield tag, "", DRIVEN
        return
    if tag not in ELEMENTS:
        yield tag, "", UNKNOWN
        return
    for key, value in element.items():
        if key == "id" or key in OF_NO_EFFECT.get(tag, ()) or (tag == "vType" and key.startswith("lc")):
            continue
        if tag == "vType" and key.startswith("jm"):
            yield tag, key, DRIVEN
            continue
        if tag == "stop" and key == "until" and not bad_number(speed := element.get("speed")) and float(speed or "0") > 0.0:
            yield tag, f"{key} with speed", "a train passes a waypoint whenever it comes"
            continue
        said = NAMED.get((tag, key), (UNKNOWN, frozenset[str]()))
        if key in ELEMENTS[tag]:
            yield tag, key, None
        elif isinstance(said, Refused):
            yield tag, key, said
        else:
            yield tag, key, None if value in said[1] else said[0]


def _of_param(key: str) -> str:
    """Why a param that SUMO itself reads is not followed; "": it reads none of this name, or it changes no run."""
    start, _, rest = key.partition(".")
    if start in ("has", "device"):
        device = rest.partition(".")[0]
        return "" if device in WATCHING else KEEP_ROUTES if device in ("rerouting", "routing") else NO_DEVICE
    return next((why for begin, why in PARAMS_NAMED.items() if key.startswith(begin)), "")


def of_others(elements: Iterable[Element], unread: Iterable[Element]) -> Said:
    """What elements beside trains, routes, stops and types are followed, and which are not, one line for each kind.

    ``unread`` are those in route files that SUMO reads in additional files alone.
    """
    passed = ELEMENTS.keys() | ELEMENTS_OF_NO_EFFECT | ELEMENTS_OF_SIGNALS.keys()
    counts = Counter(e.tag for e in elements if e.tag not in passed)
    followed, lines = [], []
    for tag, n in counts.items():
        if tag in ELEMENTS_FOLLOWED:
            followed.append(f"<{tag}>: {n}")
        else:
            lines.append(f"{n} x <{tag}>: not followed: {ELEMENTS_NAMED.get(tag, UNKNOWN)}")
    inner = Counter(found for e in elements if e.tag in ELEMENTS_FOLLOWED for found in _within(e))
    for (tag, key), n in inner.items():
        lines.append(f"{n} x <{f'{tag} {key}'.rstrip()}>: not followed: {OF_FOLLOWED_NAMED.get((tag, key), UNKNOWN)}")
    for tag, n in Counter(e.tag for e in unread).items():
        lines.append(f"{n} x <{tag}> in route files: not followed, as in SUMO, which reads it in additional files alone")
    return Said(followed, lines, [])


def _within(element: Element) -> Iterator[tuple[str, str]]:
    """Element and attribute of what stands in a sign or a rerouter and is not followed; no attribute: the element as a whole."""
    for one in element.iter():
        if one.tag in OF_FOLLOWED:
            yield from ((one.tag, key) for key, value in one.items() if key not in OF_FOLLOWED[one.tag] and value not in OFF)
        elif one.tag not in ELEMENTS_OF_NO_EFFECT and one.tag not in REROUTERS_NAMED:
            yield one.tag, ""


def of_net(net: NetFile) -> list[str]:
    """What a net says that is not followed, one line for each."""
    counts = Counter(_unknown(net))
    lines = [f"net: {n} x {what}: not followed: {NET_NAMED.get(what.strip('<>'), UNKNOWN)}" for what, n in counts.items()]
    lights = sum(j.attributes.get("type", "").startswith("traffic_light") for j in net.junctions)
    if lights:
        lines.append(f"net: {lights} x traffic lights: not obeyed")
    return lines


def of_signals(signals: int, options: Mapping[str, str], elements: Iterable[Element], obeyed: bool) -> Said:
    """What is said of rail signals and all that belongs to them, one line for each: followed where they are obeyed, else named."""
    counts = Counter(e.tag for e in elements if e.tag in ELEMENTS_OF_SIGNALS)
    value = options.get(MOVING_BLOCK, "")
    belonging = [key for key in options if key.startswith(OF_SIGNALS) and not _no_effect(key)]
    if obeyed:
        lines = [f"net: {signals} x rail signals"] if signals else []
        lines += [f"options: {', '.join(belonging)}"] if belonging else []
        return Said([*lines, *(f"<{tag}>: {n}" for tag, n in counts.items())], [], [])
    lines = (
        [f"net: {signals} x rail signals: not obeyed: our own interlocking keeps trains apart in moving block"] if signals else []
    )
    if value not in OFF:
        lines.append(f"option {MOVING_BLOCK} = {value}: not followed: trains are kept apart in moving block anyway")
    others = [key for key in belonging if key != MOVING_BLOCK and options[key] not in OFF]
    lines += [f"option {key} = {options[key]}: not followed: signals are not obeyed" for key in others]
    return Said([], [*lines, *(f"{n} x <{tag}>: not followed: {ELEMENTS_OF_SIGNALS[tag]}" for tag, n in counts.items())], [])


def _unknown(net: NetFile) -> Iterator[str]:
    for edge in net.edges:
        yield from (f"<edge {key}>" for key in edge.attributes.keys() - NET_EDGE)
        for lane in edge.lanes:
            yield from (f"<lane {key}>" for key in lane.keys() - NET_LANE)
    for connection in net.connections:
        yield from (f"<connection {key}>" for key in connection.keys() - NET_CONNECTION)
    yield from (f"<{tag}>" for tag in net.others if tag not in NET_ELEMENTS and tag != "tlLogic")
