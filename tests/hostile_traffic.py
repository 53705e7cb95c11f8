"""Hostile runs in traffic that is not a row of trains: as ``hostile`` draws them, with whatever files and orders may ask beside.

Trains enter deep in an edge, at once, or right before a low limit; they stop, park and leave in mid-track; limits change, edges are
closed, trains are sent elsewhere or in an order, faults begin on the way, and laws react within the step.
"""

from __future__ import annotations

import random
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import hostile_nets
from hostile import PLANTS, Case, Plants, base, coarser, fleet, supervisor, written

from trainctl import runner
from trainctl.errors import TrainctlError
from trainctl.runner import Backend
from trainctl.scenario.build import open_scenario

#: Styles of the continuous law that answer what happens within the step.
REACTING = ("twitch", "neighbour")

#: With which trains enter; SUMO refuses those of its own that are too fast for their edge.
SPEEDS = ("max", "max", "10", "0", "25", "40", "avg", "speedLimit")

#: Files of a run that are the same however often it was resumed.
FILES = ("trains.parquet", "events.jsonl", "metrics.json")

#: Nets, the first ones also with signals.
SIGNALLED = (
    hostile_nets.two_ways, hostile_nets.two_ways, hostile_nets.laps, hostile_nets.platforms, hostile_nets.platforms, hostile_nets.crossing,
)  # fmt: skip
TURNING = (hostile_nets.terminals, hostile_nets.heads)
NETS = (*SIGNALLED, hostile_nets.short_edges, hostile_nets.joins_in_a_row, hostile_nets.loops, hostile_nets.hills)


def drawn(seed: int, place: Path, plants: Plants = PLANTS, signals: bool = False, turning: bool = False) -> Case:
    """Draw a case into ``place/traffic.SEED``.

    ``signals``: SUMO's, which are obeyed, and some trains are by themselves or SUMO's own; ``turning``: most trains turn back.
    """
    draw = random.Random(f"hostile traffic {seed} {signals}{' turning' if turning else ''}")
    folder = place / f"{'signals' if signals else 'turning' if turning else 'traffic'}.{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    kind, continuous, _ = draw.choices(plants, [weight for *_, weight in plants])[0]
    tables = base(draw, seed, kind, continuous)
    if continuous and draw.random() < 0.4:
        tables["controller"]["style"] = draw.choice(REACTING)
    lay = draw.choice(SIGNALLED if signals else TURNING if turning else NETS)
    routes = lay(folder, draw, signals=True) if signals else lay(folder, draw)
    duration = coarser(draw, tables) * draw.randint(120, 300)
    ids = [f"t{k}" for k in range(draw.randint(2, 8))]
    trains, troubles, faults, braking = fleet(draw, tables, kind, 35.0 if lay is hostile_nets.hills else 0.0, ids, 0.5)
    for one in faults:
        one["start_s"] = draw.uniform(0.0, 0.7) * duration
        one["end_s"] = one["start_s"] + draw.uniform(0.05, 0.5) * duration
    lengths = {
        edge.get("id", ""): float(edge.find("lane").get("length"))  # type: ignore[union-attr, arg-type]
        for edge in ElementTree.parse(folder / "a.net.xml").getroot().iter("edge")
        if edge.get("function") != "internal"
    }
    types = {name: train.length for name, train in trains.items()}
    ways = {i: draw.choice(routes).split() for i in ids}
    (folder / "a.rou.xml").write_text(
        f"<routes>{entering(draw, ways, types, lengths, duration, ('max', '0', 'avg') if signals else SPEEDS)}</routes>"
    )
    closed = ("b", "b1") if lay is hostile_nets.two_ways else ()
    (folder / "a.add.xml").write_text(f"<additional>{changing(draw, sorted(lengths), closed, duration)}</additional>")
    (folder / "a.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/><additional-files value="a.add.xml"/></input>'
        f'<time><end value="{duration:.0f}"/></time></configuration>'
    )
    driving: dict[str, Any] = {"join_band_m": draw.choice([400.0, 4000.0]), "join_band_mps": draw.choice([5.0, 40.0])}
    driving["join_range_m"] = draw.choice([300.0, 20_000.0])
    if signals:
        others = draw.choice(["driven", "sumo", "sumo"])
        driving |= {"signals": "obey", "others": others, "cooperate": draw.sample(ids, draw.randint(1, len(ids)))}
    ours = driving["cooperate"] if signals and driving["others"] == "sumo" else ids
    tables["run"]["duration_s"] = duration
    tables["topology"] |= {"spacing_m": draw.uniform(300.0, 1200.0) + max(types.values()), "upper_m": 20_000.0, "lower_m": 50.0}
    tables |= {
        "network": {"sumocfg": "a.sumocfg"}, "reference": {"speed_mps": draw.choice([15.0, 25.0, 35.0])}, "plant": trains["k0"].plant,
        "train_type": {k: t.type for k, t in trains.items()}, "supervisor": supervisor(draw, braking), "disturbance": troubles,
        "fault": [one for one in faults if one["train"] in ours], "traffic": driving,
        "event": ordered(draw, ours, sorted(lengths), duration), "order": [] if turning else in_turn(draw, ways),
    }  # fmt: skip
    return written(
        draw, seed, f"{lay.__name__}{' signals' if signals else ''} {kind}{' continuous' if continuous else ''}", folder, tables
    )


#: Drawn with signals and trains of SUMO's, which SUMO alone knows.
signalled = partial(drawn, signals=True)

#: Drawn with trains that turn back.
reversing = partial(drawn, turning=True)


def resumed(case: Case, backend: Backend, share: float) -> list[str] | None:
    """Break a run off at this share of its steps and go on with it: files that differ then. None: nothing to resume, it is refused."""
    try:
        p = open_scenario(str(case.folder / "s.toml"))
        whole = runner.run(p, case.folder / "whole", backend)
    except TrainctlError:
        return None
    broken = int(share * p.scenario.run.steps)
    every = max(broken // 30, 1) * 10 * p.scenario.run.step_s
    with suppress(ConnectionError), runner.opened(p, case.folder / "cut", backend, checkpoint_every_s=every) as simulation:
        for _ in range(broken):
            simulation.step()
        raise ConnectionError
    again, since = runner.resume(case.folder / "cut")
    assert since is not None and since > 0.0
    return [name for name in FILES if (whole.folder / name).read_bytes() != (again.folder / name).read_bytes()]


def entering(
    draw: random.Random, ways: dict[str, list[str]], types: dict[str, float], lengths: dict[str, float], duration: float,
    speeds: tuple[str, ...],
) -> str:  # fmt: skip
    """Types and trains of a route file."""
    depart, rows = 0.0, [f'<vType id="{k}" vClass="rail" length="{length}" maxSpeed="60"/>' for k, length in types.items()]
    for i, way in ways.items():
        said = {"type": draw.choice(sorted(types)), "departSpeed": draw.choice(speeds)}
        stop, at = "", draw.choice(way)
        if draw.random() < 0.5 and lengths[at] > 50.0:
            parks = ' parking="true"' if draw.random() < 0.5 else ""
            stop = f'<stop lane="{at}_0" endPos="{draw.uniform(0.3, 0.95) * lengths[at]:.0f}" duration="{draw.randint(5, 90)}"{parks}/>'
        if draw.random() < 0.6 and not (stop and at == way[0]):
            said["departPos"] = f"{draw.uniform(0.2, 0.98) * lengths[way[0]]:.1f}"
        if draw.random() < 0.3 and not (stop and at == way[-1]):
            said["arrivalPos"] = f"{draw.uniform(0.1, 0.95) * lengths[way[-1]]:.1f}"
        if draw.random() < 0.3:
            said["speedFactor"] = f"{draw.uniform(0.7, 1.3):.2f}"
        more = " ".join(f'{k}="{v}"' for k, v in said.items())
        rows.append(f'<vehicle id="{i}" depart="{depart:.0f}" {more}><route edges="{" ".join(way)}"/>{stop}</vehicle>')
        depart = min(depart + draw.choice([0.0, 0.0, draw.uniform(0.0, 20.0), draw.uniform(10.0, 60.0)]), 0.6 * duration)
    return "".join(rows)


def changing(draw: random.Random, edges: list[str], closed: tuple[str, ...], duration: float) -> str:
    """Variable signs, and a rerouter that closes one of the edges ``closed`` for a while."""
    rows = []
    for edge in draw.sample(edges, draw.choice([0, 0, 1, 2, 3])):
        time, steps = draw.uniform(0.0, 0.3) * duration, ""
        for _ in range(draw.randint(1, 5)):
            steps += f'<step time="{time:.0f}" speed="{draw.choice([3, 8, 15, 25, 40])}"/>'
            time += draw.uniform(2.0, 0.3 * duration)
        rows.append(f'<variableSpeedSign id="v_{edge}" lanes="{edge}_0">{steps}</variableSpeedSign>')
    if closed and draw.random() < 0.7:
        begin = draw.uniform(0.0, 0.5) * duration
        end = begin + draw.uniform(10.0, 0.5 * duration)
        shut = f'<interval begin="{begin:.0f}" end="{end:.0f}"><closingReroute id="{draw.choice(closed)}"/></interval>'
        rows.append(f'<rerouter id="r" edges="{draw.choice(["a", "in", "a in"])}">{shut}</rerouter>')
    return "".join(rows)


def ordered(draw: random.Random, ids: list[str], edges: list[str], duration: float) -> list[dict[str, Any]]:
    """[[event]]: trains are sent to any edge."""
    return [
        {"kind": "reroute", "train": draw.choice(ids), "to_edge": draw.choice(edges), "time_s": round(draw.uniform(0.0, 0.6) * duration, 1)}
        for _ in range(draw.choice([0, 0, 1, 2, 4]))
    ]  # fmt: skip


def in_turn(draw: random.Random, ways: dict[str, list[str]]) -> list[dict[str, Any]]:
    """[[order]]: which of two trains that use an edge is first."""
    edge = draw.choice(sorted({e for way in ways.values() for e in way}))
    users = [i for i, way in ways.items() if edge in way]
    if draw.random() >= 0.25 or len(users) < 2:
        return []
    pair = draw.sample(users, 2)
    on, other = (set(ways[i][: ways[i].index(edge) + 1]) for i in pair)
    together = len(on & other) > 1 or ways[pair[0]][0] == ways[pair[1]][0]  # behind one another before: they cannot change places
    return [{"edge": edge, "trains": sorted(pair) if together else pair}]
