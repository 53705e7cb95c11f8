"""What SUMO writes: the logs that are known, by their elements and columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

#: Columns that are names even where they look like numbers.
NAMES = frozenset((
    "id", "lane", "edge", "type", "vType", "track", "train", "sender", "receiver", "collider", "victim", "route_edges", "devices",
    "departLane", "arrivalLane", "departEdge", "arrivalEdge", "colliderType", "victimType", "line", "fromTaz", "toTaz", "kind",
    "route", "eclass", "ego", "foe", "interval_id", "edge_id", "vehicle", "leaderID",
))  # fmt: skip


class Kind(NamedTuple):
    """One of SUMO's logs."""

    name: str
    root: str
    rows: tuple[str, ...]  # elements that are rows
    #: elements around rows -> attributes that become columns of the rows -> names of these columns
    around: Mapping[str, Mapping[str, str]]
    time: str | None  # column with the time
    keys: tuple[str, ...]  # columns that tell rows of one instant apart
    #: columns of the table: one of each group is there, in CSV and Parquet
    marks: tuple[frozenset[str], ...]

    @property
    def step(self) -> str:
        """The element that carries the time of the rows in it; empty if the rows do."""
        return next((tag for tag, columns in self.around.items() if "time" in columns.values()), "")


STEP = {"timestep": {"time": "time"}}
INTERVAL = {"interval": {"begin": "begin", "end": "end", "id": "interval_id"}}


def _kind(
    name: str, root: str, rows: str, keys: str, marks: Sequence[str], time: str | None = None,
    around: Mapping[str, Mapping[str, str]] | None = None,
) -> Kind:  # fmt: skip
    groups = tuple(frozenset(group.split()) for group in marks)
    return Kind(name, root, tuple(rows.split()), around or {}, time, tuple(keys.split()), groups)


#: The first that fits is the kind of a CSV or Parquet file. Edge and lane data stand in the order of their ends.
KINDS = (
    _kind("fcd", "fcd-export", "vehicle person container", "id", ["time", "id", "x speed pos lane edge type"], "time", STEP),
    _kind("emission", "emission-export", "vehicle", "id", ["time", "id", "eclass CO2 CO HC NOx PMx fuel electricity noise"], "time",
          STEP),
    _kind("vehroute", "routes", "vType vehicle person container", "id", ["id", "depart", "route_edges walk_edges tranship_edges"]),
    _kind("tripinfo", "tripinfos", "tripinfo personinfo containerinfo", "id",
          ["id", "depart", "departDelay routeLength timeLoss traveltime duration"]),
    _kind("personsummary", "personSummary", "step", "", ["time", "walking", "riding"], "time"),
    _kind("summary", "summary", "step", "", ["time", "running", "loaded"], "time"),
    _kind("statistics", "statistics", "statistics", "", ["safety_collisions performance_clockBegin vehicles_loaded"]),
    _kind("collisions", "collisions", "collision", "collider victim", ["time", "collider", "victim"], "time"),
    _kind("stops", "stops", "stopinfo", "id lane", ["id", "started", "ended"]),
    _kind("lanedata", "meandata", "lane", "interval_id id", ["begin", "end", "id", "edge_id", "sampledSeconds"], "end",
          INTERVAL | {"edge": {"id": "edge_id"}}),
    _kind("edgedata", "meandata", "edge", "interval_id id", ["begin", "end", "id", "sampledSeconds"], "end", INTERVAL),
    _kind("ssm", "SSMLog", "globalMeasures conflict", "ego foe", ["ego", "foe timeSpan_values"]),
)  # fmt: skip

#: Columns of an emission log; an fcd log may have them too, but then it has a slope.
EMISSIONS = KINDS[1].marks[2]

#: Statistics with plain headers: names repeat, but they always stand in this order.
_STATISTICS = {
    "performance": "clockBegin clockEnd clockDuration traciDuration realTimeFactor vehicleUpdatesPerSecond personUpdatesPerSecond "
                   "begin end duration",
    "vehicles": "loaded inserted running waiting",
    "teleports": "total jam yield wrongLane",
    "safety": "collisions emergencyStops emergencyBraking",
    "persons": "loaded running jammed",
    "personTeleports": "total abortWait wrongDest",
    "vehicleTripStatistics": "count routeLength speed duration waitingTime timeLoss departDelay departDelayWaiting totalTravelTime "
                             "totalDepartDelay",
    "pedestrianStatistics": "number routeLength duration timeLoss",
    "rideStatistics": "number waitingTime routeLength duration bus train taxi bike aborted",
    "transportStatistics": "number waitingTime routeLength duration bus train taxi bike aborted",
}  # fmt: skip
STATISTICS = tuple((f"{tag}_{name}", name) for tag, names in _STATISTICS.items() for name in names.split())

#: Plain headers of what stands inside a row of trips and routes.
PLAIN = {
    "tripinfo": {f"{what}_abs": f"emissions_{what}_abs" for what in ["CO", "CO2", "HC", "PMx", "NOx", "fuel", "electricity"]},
    "vehroute": {"edges": "route_edges", "exitTimes": "route_exitTimes"},
    "walks": {name: f"walk_{name}" for name in ["edges", "exitTimes", "started", "ended"]},
}


def kind_of_table(names: Sequence[str]) -> tuple[Kind, list[str]] | None:
    """Kind of a CSV or Parquet file from its header, and what its columns are called here; None if it is none of the known.

    A name stands more than once where the file has a column for vehicles and another one for persons.
    """
    for kind in KINDS:
        for called in (_tagged(kind, names), _plain(kind, names)):
            if called is None or not all(group & set(called) for group in kind.marks):
                continue
            if kind.name != "fcd" or "slope" in called or not EMISSIONS & set(called):
                return kind, called
    return None


def _tagged(kind: Kind, names: Sequence[str]) -> list[str] | None:
    """Headers with the elements in front (``vehicle_speed``), or all elements down from the root (``timestep_vehicle_speed``)."""
    outer = {f"{tag}_{attribute}": column for tag, columns in kind.around.items() for attribute, column in columns.items()}
    path = "".join(f"{tag}_" for tag in kind.around)
    fronts = [front for row in kind.rows for front in (f"{path}{row}_", f"{row}_")]
    if kind.name == "lanedata":
        outer |= {"interval_edge_id": "edge_id"}
    if not any(name.startswith(tuple(fronts)) or name in outer for name in names) and kind.name != "statistics":
        return None
    if len(set(names)) < len(names):
        return None
    return [outer.get(name) or name.removeprefix(next((f for f in fronts if name.startswith(f)), "")) for name in names]


def _plain(kind: Kind, names: Sequence[str]) -> list[str] | None:
    """Headers that are attributes and nothing else."""
    if kind.name == "statistics":
        return _in_order(names)
    inner = PLAIN.get("walks" if kind.name == "vehroute" and "started" in names else kind.name, {})
    called = [inner.get(name, name) for name in names]
    ids = [place for place, name in enumerate(called) if name == "id"]
    wanted = {"lanedata": ["interval_id", "edge_id", "id"], "edgedata": ["interval_id", "id"]}.get(kind.name, ["id"])
    if len(ids) == len(wanted):
        for place, column in zip(ids, wanted, strict=True):
            called[place] = column
    return called if len(set(called)) == len(called) else None


def _in_order(names: Sequence[str]) -> list[str] | None:
    called, place = [], 0
    for name in names:
        place = next((k for k in range(place, len(STATISTICS)) if STATISTICS[k][1] == name), len(STATISTICS))
        if place == len(STATISTICS):
            return None
        called.append(STATISTICS[place][0])
        place += 1
    return called
