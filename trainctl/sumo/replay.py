"""A finished run replayed: SUMO moves the trains as they were recorded, nothing is computed anew."""

from __future__ import annotations

import tempfile
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

import sumo_net
from sumo_net import Line, LineError, Rails
from trainctl.errors import InputError, SimulatorError
from trainctl.runs.run import Run
from trainctl.scenario.reading import examine
from trainctl.scenario.roster import chart
from trainctl.scenario.tables import Scenario
from trainctl.signals import Bools, Floats, Ints, Links, Start
from trainctl.sumo.gui import Gui, Map
from trainctl.topology import graph

#: A train that is slower stands [m/s].
STANDS_MPS = 1e-6


def replay(run: Run, binary: str = "sumo-gui", from_s: float = 0.0, delay_ms: float = 20.0) -> int:
    """Show a run in sumo-gui.

    Parameters
    ----------
    run : Run
        A run folder; one that broke off is shown as far as it was recorded.
    binary : str
        "sumo-gui", or "sumo" for the same without a window.
    from_s : float
        Where to begin [s].
    delay_ms : float
        Minimum time of a step on the screen.

    Returns
    -------
    int
        Number of steps shown.

    Raises
    ------
    InputError
        Nothing to show.
    SimulatorError
        SUMO could not be started, or the window was closed.
    """
    scenario, _ = examine(run.scenario, resolved=True)
    if scenario is None:
        raise InputError(f"{run.folder}: its scenario.toml is damaged")
    if scenario.network.sumocfg is not None:
        return _traffic(run, scenario, binary, from_s, delay_ms)
    ids = list(scenario.ids)
    trains = run.trains
    trains = trains[trains["time_s"] >= from_s - 1e-9]
    times, edge_names = np.unique(trains["time_s"].to_numpy()), _grid(trains, "edge", ids)
    if len(times) < 2:
        raise InputError(f"{run.folder}: fewer than two instants recorded from {from_s:g} s on")
    step = round(float(times[1] - times[0]), 9)
    times = times[: 1 + int(np.sum(np.cumprod(np.abs(np.diff(times) - step) < 1e-6)))]  # the last row may come early
    position, speed = _grid(trains, "position_m", ids).astype(float), _grid(trains, "speed_mps", ids).astype(float)
    with tempfile.TemporaryDirectory(prefix="replay.") as scratch:
        line, net = _network(run, scenario, Path(scratch))
        edge = np.array([[line.index[name] for name in row] for row in edge_names[: len(times)]])
        links = _changes(run, times, ids, _tracks(line)[edge], position)
        gui = Gui(line, net, Path(scratch), step, len(times), binary=binary, delay_ms=delay_ms)
        try:
            gui.start(_start(scenario, line, edge, position[0], speed[0]))
            for k, (now, then) in enumerate(pairwise(times.tolist())):
                if now in links:
                    gui.linked(*links[now])
                gui.move(position[k + 1] - position[k], then - now)
        finally:
            gui.close()
    return len(times) - 1


def _traffic(run: Run, scenario: Scenario, binary: str, from_s: float, delay_ms: float) -> int:
    """The same for trains that come and go: as SUMO's own log has them, edge by edge."""
    log = run.folder / "sumo" / "fcd.parquet"
    nets = sorted((run.folder / "sumo").glob("*.net.xml"))
    if not nets or not log.is_file():
        raise InputError(f"{run.folder}: made without SUMO, which alone knows where its net lies: run it with SUMO to see it")
    columns = {"timestep_time": "time_s", "vehicle_id": "train", "vehicle_lane": "lane", "vehicle_pos": "m", "vehicle_speed": "v"}
    try:
        seen = pd.DataFrame(pq.read_table(log, columns=list(columns)).to_pandas()).rename(columns=columns)
        rails = Rails.read(nets[0], set(seen["lane"].dropna().astype(str).str.rpartition("_")[0]))
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{log}: cannot be read: {str(error).partition(chr(10))[0]}") from None
    except LineError as error:
        raise InputError(error.mistakes) from None
    seen = seen[seen["train"].notna() & (seen["time_s"] >= from_s - 1e-9)]
    times = np.unique(seen["time_s"].to_numpy())
    if len(times) < 2:
        raise InputError(f"{run.folder}: fewer than two instants recorded from {from_s:g} s on")
    step = scenario.run.step_s
    if scenario.run.recorded_steps > 1:
        every = scenario.run.record_every_s
        raise InputError(f"run.record_every_s = {every:g}: trains that come and go are replayed from an FCD log of every step")
    times = times[0] + step * np.arange(1 + round(float(times[-1] - times[0]) / step))
    ids = [i for i in scenario.ids if i in set(seen["train"])]
    number = {name: i for i, name in enumerate(ids)}
    train, row = seen["train"].map(number).to_numpy(), np.round((seen["time_s"].to_numpy() - times[0]) / step).astype(np.int64)
    speed, edge = np.full((len(times), len(ids)), np.nan), np.full((len(times), len(ids)), -1)
    speed[row, train] = seen["v"].to_numpy()
    edge[row, train] = seen["lane"].astype(str).str.rpartition("_")[0].map(rails.index).to_numpy()
    there = edge >= 0
    first = np.argmax(there, axis=0)
    places = seen.drop_duplicates("train").set_index("train").loc[ids]
    kept = [scenario.ids.index(name) for name in ids]
    consists = scenario.consists()
    legs = [_legs(rails, edge[:, i], speed[:, i]) for i in range(len(ids))]
    lengths = consists.train_length()[kept]
    # What a train turns on it must be able to run back over, whether it has done so or not.
    ways = [_run_back(rails, [_way(rails, leg) for _, leg in own], float(n)) for own, n in zip(legs, lengths, strict=True)]
    turns = {(k, i): way for i, own in enumerate(legs) for (k, _), way in zip(own[1:], ways[i][1:], strict=True)}
    start = Start(
        ids=ids, edge=np.array([own[0][0] for own in ways]), lane_position=places["m"].to_numpy(),
        speed=speed[first, range(len(ids))], length=lengths,
        unit_length=[consists.length[consists.first[k] : consists.first[k + 1]] for k in kept],
        routes=[tuple(rails.edges[e] for e in own[0]) for own in ways], present=first == 0, vclass=["rail"] * len(ids),
    )  # fmt: skip
    position = _grid(run.trains, "position_m", ids, times)
    links = _changes(run, times, ids, np.zeros_like(edge), np.nan_to_num(position, nan=-np.inf))
    with tempfile.TemporaryDirectory(prefix="replay.") as scratch:
        net = Path(scratch) / nets[0].name
        net.write_bytes(nets[0].read_bytes())
        gui = Map(chart(rails), net, Path(scratch), step, len(times), binary=binary, delay_ms=delay_ms)
        try:
            gui.start(start)
            for k, now in enumerate(times[:-1].tolist()):
                if now in links:
                    gui.linked(*_formations(links[now][0]))
                for i in np.flatnonzero(first == k + 1).tolist():
                    gui.insert(i, float(speed[k + 1, i]))
                turned = [i for i in range(len(ids)) if (k, i) in turns]
                for i in turned:
                    gui.turn(i, tuple(rails.edges[e] for e in turns[k, i]), np.inf)
                # Who is gone by the next instant has left at the end of its way.
                gone = np.where(there[k], np.nan_to_num(speed[k]) * step + float(rails.length_m.max()), 0.0)
                moves = np.where(there[k] & there[k + 1], np.nan_to_num(speed[k + 1]) * step, gone)
                moves[turned] = 0.0
                gui.move(moves, step)
        finally:
            gui.close()
    return len(times) - 1


def _legs(rails: Rails, edge: Ints, speed: Floats) -> list[tuple[int, list[int]]]:
    """The edges (-1: none) that a train was seen on at every instant, one part for each turn, with the instant before its turn.

    A train that has turned stands, and is on track that it has come over.
    """
    there = np.flatnonzero(edge >= 0).tolist()
    legs: list[tuple[int, list[int]]] = [(there[0], [int(edge[there[0]])])]
    for before, k in pairwise(there):
        leg, here = legs[-1][1], int(edge[k])
        if here != leg[-1] and speed[k] < STANDS_MPS and here in {int(rails.twin[e]) for e in leg}:
            legs.append((before, [int(rails.twin[leg[-1]])]))
        legs[-1][1].append(here)
    return legs


def _run_back(rails: Rails, legs: list[list[int]], length: float) -> list[list[int]]:
    """The legs of a train, each after a turn as long as the train, if need be on along the track that it has come over."""
    for leg, onward in pairwise(legs):
        back = [int(rails.twin[e]) for e in reversed(leg)]
        if onward == back[: len(onward)]:
            under = int(np.searchsorted(np.cumsum(rails.length_m[back]), length + rails.length_m[back[0]])) + 1
            onward += [e for e in back[len(onward) : under] if e >= 0]
    return legs


def _way(rails: Rails, seen: list[int]) -> list[int]:
    """The edges of a train that was seen on these: a short one may have been passed between two instants."""
    way = [seen[0]]
    for here, there in pairwise(seen):
        if here != there:
            path = rails.path(here, there)
            if path is None:
                raise SimulatorError(f"recorded edges {rails.edges[here]} and {rails.edges[there]} do not follow each other")
            way += path[1:].tolist()
    return way


def _formations(links: Links) -> tuple[Links, Ints]:
    """Links with the trains in the order of their formations, and the formation of every train: those who are connected."""
    formation = np.arange(len(links.order))
    for group in graph.components(len(formation), links.sender, links.receiver):
        formation[list(group)] = min(group)
    return links._replace(order=links.order[np.argsort(formation[links.order], kind="stable")]), formation


def _grid(trains: pd.DataFrame, column: str, ids: list[str], times: Floats | None = None) -> np.ndarray:
    """A column as rows of instants (``times``, or all there are), columns of trains."""
    grid = trains.pivot(index="time_s", columns="train", values=column)[ids]
    return (grid if times is None else grid.reindex(times)).to_numpy()


def _network(run: Run, scenario: Scenario, folder: Path) -> tuple[Line, Path]:
    """The net that SUMO ran on, or for a run without SUMO the one of its line."""
    try:
        kept = sorted((run.folder / "sumo").glob("*.net.xml"))
        if kept:
            net = folder / kept[0].name
            net.write_bytes(kept[0].read_bytes())
            return Line.read(net), net
        known, name = sumo_net.shipped(), str(scenario.network.line)
        if name not in known:
            raise InputError(f"{run.folder}: made without SUMO on {name}, which is not a shipped line: run it with SUMO to see it")
        spec = sumo_net.read_spec(known[name])
        return Line.of(spec), sumo_net.build(spec, folder)
    except LineError as error:
        raise SimulatorError("; ".join(error.mistakes)) from None


def _start(scenario: Scenario, line: Line, edge: Ints, position: Floats, speed: Floats) -> Start:
    """The trains at the first instant, on routes made of the edges they were seen on and the rest of their last track."""
    routes = []
    for i in range(edge.shape[1]):
        seen = [int(edge[0, i])] + [int(b) for a, b in pairwise(edge[:, i]) if a != b]
        way: list[int] = [seen[0]]
        for k in seen[1:]:
            way += _between(line, way[-1], k)
        end = float(line.start_m[way[-1]] + line.length_m[way[-1]])
        rest = line.route(line.tracks[way[-1]], round(end, 6)) if end < line.end_m - 1e-6 else ()
        routes.append((*(line.edges[k] for k in way), *rest))
    consists = scenario.consists()
    return Start(
        ids=scenario.ids, edge=edge[0], lane_position=position - line.start_m[edge[0]], speed=speed,
        length=consists.train_length(), unit_length=[consists.length[a:b] for a, b in pairwise(consists.first)], routes=routes,
        present=np.ones(len(speed), bool), vclass=["rail"] * len(speed),
    )  # fmt: skip


def _tracks(line: Line) -> Ints:
    """Track of every edge, as index into ``line.track_ids``."""
    return np.array([line.track_ids.index(t) for t in line.tracks], np.int64)


def _between(line: Line, here: int, there: int) -> list[int]:
    """Edges after ``here`` up to ``there``: a long recording interval leaves some out."""
    way = []
    while here != there:
        end, track = round(float(line.start_m[here] + line.length_m[here]), 6), line.tracks[here]
        if abs(float(line.start_m[there]) - end) < 1e-6:
            here = there
        elif line.tracks[there] == track or end < float(line.start_m[there]):
            here = line.locate(track, end)[0]
        else:
            raise SimulatorError(f"recorded edges {line.edges[here]} and {line.edges[there]} do not follow each other")
        way.append(here)
    return way


def _changes(run: Run, times: Floats, ids: list[str], track: Ints, position: Floats) -> dict[float, tuple[Links, Ints]]:
    """Who receives from whom, and the track of each train, at the instants where that changed."""
    table = run.links[["time_s", "sender", "receiver", "heard"]] if len(run.links) else pd.DataFrame()
    rows = zip(*(table[c].tolist() for c in table.columns), strict=True)
    number = {name: i for i, name in enumerate(ids)}
    edges = {
        time: tuple(sorted((number[r], number[s], bool(h)) for _, s, r, h in group))
        for time, group in groupby(rows, key=lambda row: row[0])
    }
    found: dict[float, tuple[Links, Ints]] = {}
    before: object = None
    for k, time in enumerate(times.tolist()):
        now = (edges.get(time, ()), tuple(track[k].tolist()))
        if now != before:
            before = now
            found[time] = (_as_links(now[0], position[k], track[k]), track[k])
    return found


def _as_links(edges: tuple[tuple[int, int, bool], ...], position: Floats, track: Ints) -> Links:
    """What the picture needs of the links."""
    receiver, sender = (np.array([e[k] for e in edges], np.int64) for k in (0, 1))
    heard: Bools = np.array([e[2] for e in edges], bool)
    none = np.zeros(len(edges))
    return Links(
        sender, receiver, np.searchsorted(receiver, np.arange(len(track) + 1)).astype(np.int64), none, none, none, none, heard,
        np.zeros(len(track)), np.lexsort((-position, track)),
    )  # fmt: skip
