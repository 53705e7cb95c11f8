"""Metrics of the traffic: headways, throughput, what SUMO's own logs say; also from any FCD log, ours or not."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from trainctl.errors import InputError
from trainctl.metrics.values import Values, put_worst
from trainctl.runs.series import INSTANT, Series
from trainctl.runs.sumo_logs import elements, find_log, seconds
from trainctl.signals import Bools, Floats

#: Headways in time are counted for trains faster than this [m/s]: one at standstill has none.
MOVING_MPS = 1.0

#: attribute of a tripinfo -> name of its mean
TRIPINFO = {
    "duration": "traffic.sumo_duration_mean_s",
    "routeLength": "traffic.sumo_route_length_mean_m",
    "waitingTime": "traffic.sumo_waiting_time_mean_s",
    "timeLoss": "traffic.sumo_time_loss_mean_s",
}

DEFINITIONS: dict[str, tuple[str, str]] = {
    "traffic.gap_min_m": (
        "m",
        "Minimum distance from the rear of the train ahead to the front of a train; negative: they overlap.",
    ),
    "traffic.spacing_min_m": ("m", "Minimum distance from front to front of a train and the one ahead."),
    "traffic.spacing_mean_m": ("m", "Mean of that distance over all rows."),
    "traffic.headway_min_s": ("s", "Minimum spacing over the follower's speed, for trains faster than 1 m/s."),
    "traffic.headway_mean_s": ("s", "Mean of that headway over all rows."),
    "traffic.speed_mean_mps": ("m/s", "Mean speed over all rows."),
    "traffic.speed_max_mps": ("m/s", "Maximum speed."),
    "traffic.section_m": ("m", "Kilometrage at which passages are counted."),
    "traffic.passages": ("1", "Trains whose front passed the section."),
    "traffic.trains_per_hour": (
        "1/h",
        "Passages minus one, divided by the time from the first to the last of them; per track as items.",
    ),
    "traffic.passage_headway_min_s": ("s", "Minimum time between two fronts at the section on one track."),
    "traffic.sumo_trips": ("1", "Trips that SUMO saw arrive (tripinfo)."),
    TRIPINFO["duration"]: ("s", "Mean journey time of these trips."),
    TRIPINFO["routeLength"]: ("m", "Mean route length."),
    TRIPINFO["waitingTime"]: ("s", "Mean waiting time (speed below 0.1 m/s)."),
    TRIPINFO["timeLoss"]: ("s", "Mean delay against driving at the allowed speed."),
    "traffic.collisions": ("1", "Collisions that SUMO counted."),
    "traffic.teleports": ("1", "Vehicles that SUMO teleported."),
    "traffic.emergency_stops": ("1", "Emergency stops that SUMO counted."),
    "traffic.emergency_braking": ("1", "Emergency brakings that SUMO counted."),
    "fcd.duration_s": ("s", "FCD log: time from the first step to the last."),
    "fcd.steps": ("1", "FCD log: steps with at least one vehicle."),
    "fcd.vehicles": ("1", "FCD log: different vehicles."),
    "fcd.rows": ("1", "FCD log: rows."),
    "fcd.vehicles_mean": ("1", "FCD log: mean number of vehicles per such step."),
    "fcd.speed_mean_mps": ("m/s", "FCD log: mean speed over all rows."),
    "fcd.speed_max_mps": ("m/s", "FCD log: maximum speed."),
    "fcd.standing_share": ("1", "FCD log: share of rows below 0.1 m/s."),
    "fcd.spacing_min_m": (
        "m",
        "FCD log: minimum distance from front to front on one lane (needs pos and lane); of parked vehicles only"
        " where it is not known when they parked: a stop-output beside the log, or the events of the run.",
    ),
    "fcd.spacing_mean_m": ("m", "FCD log: mean of that distance."),
    "fcd.headway_min_s": ("s", "FCD log: minimum spacing over the follower's speed, for vehicles faster than 1 m/s."),
    "fcd.headway_mean_s": ("s", "FCD log: mean of that headway."),
}


def of_trains(trains: Series, section_m: float | None, inside: Sequence[float], turned: Bools) -> Values:
    """Headways and throughput from our own log.

    ``inside`` are gaps of trains that were reported to overlap, below 0 [m]; ``turned`` (rows,) is that of ``runs.series.turns``.
    """
    if not trains.names:
        return {}
    values: Values = {}
    speed, spacing = trains.column("speed_mps"), trains.column("spacing_m")
    put_worst(values, "traffic.gap_min_m", trains, trains.column("gap_m"), np.minimum)
    if inside:  # between two rows, or of trains in no formation with each other
        values["traffic.gap_min_m"] = float(np.fmin(min(inside), np.nanmin([*trains.column("gap_m"), math.inf])))
    put_worst(values, "traffic.spacing_min_m", trains, spacing, np.minimum)
    headway = np.where(speed > MOVING_MPS, spacing / np.maximum(speed, MOVING_MPS), np.nan)
    put_worst(values, "traffic.headway_min_s", trains, headway, np.minimum)
    for name, number in (("spacing_mean_m", spacing), ("headway_mean_s", headway), ("speed_mean_mps", speed)):
        if np.isfinite(number).any():
            values[f"traffic.{name}"] = float(np.mean(number[np.isfinite(number)]))
    values["traffic.speed_max_mps"] = float(np.max(speed))
    return values | of_section(trains, section_m, turned)


def of_section(trains: Series, section_m: float | None, turned: Bools) -> Values:
    """Passages of fronts at one kilometrage."""
    position, time = trains.column("position_m"), trains.column("time_s")
    if section_m is None:
        lowest = max(float(position[rows].min()) for _, rows in trains.slices())
        highest = min(float(position[rows].max()) for _, rows in trains.slices())
        section_m = 0.5 * (lowest + highest)
    before = trains.follows()[1:] & ~turned[:-1] & (position[:-1] < section_m) & (position[1:] >= section_m)
    k = np.flatnonzero(before)
    values: Values = {"traffic.section_m": section_m, "traffic.passages": len(k)}
    if len(k):
        part = (section_m - position[k]) / (position[k + 1] - position[k])
        passed, track = time[k] + part * (time[k + 1] - time[k]), trains.words["track"]
        _rate(values, "traffic.trains_per_hour", passed)
        shortest = []
        for name in sorted(track._replace(codes=track.codes[k]).taken()):
            times = passed[track.codes[k] == track.names.index(name)]
            _rate(values, f"traffic.trains_per_hour/{name}", times)
            shortest += list(np.diff(np.sort(times)))
        if shortest:
            values["traffic.passage_headway_min_s"] = float(min(shortest))
    return values


def _rate(values: Values, name: str, times: Floats) -> None:
    if len(times) > 1 and np.ptp(times) > 0:
        values[name] = float((len(times) - 1) * 3600 / np.ptp(times))


def of_sumo(folder: Path) -> Values:
    """Means of tripinfo, collisions and teleports from SUMO's own logs, as far as they are there."""
    values: Values = {}
    trips = find_log(folder, "tripinfo")
    if trips:
        sums, count = dict.fromkeys(TRIPINFO, 0.0), 0
        for _, attributes in elements(trips, "tripinfos", {"tripinfo"}):
            if _number(trips, attributes, "arrival") < 0.0:  # under way when the run ended
                continue
            count += 1
            for attribute in sums:
                sums[attribute] += _number(trips, attributes, attribute)
        values["traffic.sumo_trips"] = count
        values |= {TRIPINFO[attribute]: total / count for attribute, total in sums.items() if count}
    statistics = find_log(folder, "statistic")
    if statistics:
        for tag, attributes in elements(statistics, "statistics", {"teleports", "safety"}):
            if tag == "teleports":
                values["traffic.teleports"] = int(_number(statistics, attributes, "total"))
            else:
                values["traffic.collisions"] = int(_number(statistics, attributes, "collisions"))
                values["traffic.emergency_stops"] = int(_number(statistics, attributes, "emergencyStops"))
                values["traffic.emergency_braking"] = int(_number(statistics, attributes, "emergencyBraking"))
    return values


def _number(path: Path, attributes: dict[str, str], name: str) -> float:
    try:
        return float(seconds(attributes.get(name, "0")))
    except ValueError:
        raise InputError(f"{path}: {name} = {attributes[name]:.40}: not a number") from None


def metrics_of_fcd(path: Path | str) -> Values:
    """Traffic metrics of any FCD log of SUMO: XML, CSV (both also gzipped) or Parquet; streaming, whatever its size.

    Parameters
    ----------
    path : Path
        The log. Its kind follows from its content, not from its name.

    Raises
    ------
    InputError
        Not an FCD log, damaged, or with document types or entities in it.
    """
    from trainctl.runs.logs import vehicles  # with pyarrow.compute, which takes long to import, and no run of ours needs

    return _of_rows(vehicles(Path(path)), Path(path), parked(Path(path)))


def parked(path: Path) -> dict[str, list[tuple[float, float]]]:
    """When vehicles of an FCD log were off their lane [s], though it has them there: from a stop log beside it, or our events."""
    found: dict[str, list[tuple[float, float]]] = {}
    ours, stops = path.parent.parent / "events.jsonl", find_log(path.parent, "stop")
    if path.parent.name == "sumo" and ours.is_file():
        for event in map(json.loads, ours.read_text(encoding="utf-8").splitlines()):
            times = found.setdefault(str(event.get("train")), [])
            if event["kind"] == "stop_reached" and event.get("parked"):
                times.append((event["time_s"], math.inf))
            elif event["kind"] == "stop_left" and times and math.isinf(times[-1][1]):
                times[-1] = times[-1][0], event["time_s"]
    elif stops is not None:
        for _, stop in elements(stops, "stops", {"stopinfo"}):
            if stop.get("parking") == "1":
                begin, end = (_number(stops, stop, key) for key in ("started", "ended"))
                found.setdefault(stop["id"], []).append((begin, end if end >= begin else math.inf))
    return {name: times for name, times in found.items() if times}


def _of_rows(batches: Iterable[pa.Table], path: Path, parked: Mapping[str, Sequence[tuple[float, float]]]) -> Values:
    names: set[str] = set()
    steps = rows = standing = 0
    begin, end = np.inf, -np.inf
    speed_sum, speed_max = 0.0, -np.inf
    spacing, headway = _Mean(), _Mean()
    for batch in batches:
        time, speed = batch["time"].to_numpy(), batch["speed"].to_numpy()
        back = np.flatnonzero(np.diff(time) < 0)
        if len(back) or time[0] <= end:
            before, after = (time[back[0]], time[back[0] + 1]) if len(back) else (end, time[0])
            raise InputError(f"{path}: time does not ascend: {after:.10g} s after {before:.10g} s")
        begin, end = min(begin, float(time[0])), float(time[-1])
        names.update(batch["id"].unique().to_pylist())
        _once(path, time, batch["id"])
        steps += 1 + int(np.count_nonzero(np.diff(time) > INSTANT))
        rows, standing = rows + len(time), standing + int(np.count_nonzero(speed < 0.1))
        speed_sum, speed_max = speed_sum + float(speed.sum()), max(speed_max, float(speed.max()))
        if {"lane", "pos"} <= set(batch.column_names):
            distance, follower = _spacings(_on_lane(batch, parked))
            spacing.add(distance)
            headway.add(distance[follower > MOVING_MPS] / follower[follower > MOVING_MPS])
    if not rows:
        raise InputError(f"{path}: no vehicle in this FCD log")
    values: Values = {
        "fcd.duration_s": end - begin, "fcd.steps": steps, "fcd.vehicles": len(names), "fcd.rows": rows,
        "fcd.vehicles_mean": rows / steps, "fcd.speed_mean_mps": speed_sum / rows, "fcd.speed_max_mps": speed_max,
        "fcd.standing_share": standing / rows,
    }  # fmt: skip
    for name, unit, mean in (("spacing", "m", spacing), ("headway", "s", headway)):
        if mean.count:
            values |= {f"fcd.{name}_min_{unit}": mean.minimum, f"fcd.{name}_mean_{unit}": mean.total / mean.count}
    return values


def _once(path: Path, time: Floats, ids: pa.ChunkedArray) -> None:
    """Refuse a log in which a vehicle stands twice at one instant: it would be no distance ahead of itself."""
    coded = ids.combine_chunks().dictionary_encode()
    instant = np.concatenate(([0], np.cumsum(np.diff(time) > INSTANT)))
    key = np.sort(instant * len(coded.dictionary) + coded.indices.to_numpy(zero_copy_only=False))
    again = np.flatnonzero(key[1:] == key[:-1])
    if len(again):
        k, who = divmod(int(key[again[0]]), len(coded.dictionary))
        at = time[int(np.searchsorted(instant, k))]
        raise InputError(f"{path}: vehicle {coded.dictionary[who].as_py()} appears twice at {at:.10g} s")


def _on_lane(batch: pa.Table, parked: Mapping[str, Sequence[tuple[float, float]]]) -> pa.Table:
    """Rows of vehicles that are on a lane: one that is parked has left it."""
    kept = np.asarray(batch["lane"].is_valid()) & np.asarray(batch["pos"].is_valid())
    if parked:
        time, name = batch["time"].to_numpy(), np.asarray(batch["id"].to_pylist(), dtype=object)
        for who, times in parked.items():
            for begin, end in times:
                kept &= ~((name == who) & (time > begin) & (time < end))
    return batch.filter(pa.array(kept))


def _spacings(on_lane: pa.Table) -> tuple[Floats, Floats]:
    """Distance of each vehicle on a lane to the one ahead of it there, and its speed."""
    lane = on_lane["lane"].combine_chunks().dictionary_encode().indices.to_numpy(zero_copy_only=False)
    time, pos, speed = (on_lane[name].to_numpy() for name in ("time", "pos", "speed"))
    order = np.lexsort((pos, lane, time))
    time, lane, pos, speed = time[order], lane[order], pos[order], speed[order]
    same = (time[1:] == time[:-1]) & (lane[1:] == lane[:-1])
    return np.diff(pos)[same], speed[:-1][same]


class _Mean:
    """Mean and minimum value of numbers that come in pieces."""

    def __init__(self) -> None:
        self.count, self.total, self.minimum = 0, 0.0, np.inf

    def add(self, numbers: Floats) -> None:
        if len(numbers):
            self.count, self.total = self.count + len(numbers), self.total + float(numbers.sum())
            self.minimum = min(self.minimum, float(numbers.min()))
