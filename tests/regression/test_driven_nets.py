"""Random single track that is driven: lines, stations and branches of chance, trains both ways, whole runs instead of decisions alone.

The same kind of net on the level of decisions, ten thousand of them, is in ``tests/property/test_single_track.py``.
"""

from __future__ import annotations

import random
from pathlib import Path

import nets
import pytest
import tomli_w
from staged import Told

from trainctl.loop import Loop
from trainctl.numeric import Numeric
from trainctl.runner import opened
from trainctl.scenario.build import open_scenario

#: Nobody takes longer to get out [s].
LONGEST_S = 20_000.0


def made(folder: Path, seed: int) -> int:
    """A line of single track with stations of one to three tracks, perhaps a branch; so many trains from its ends."""
    draw = random.Random(seed)
    stations, x = draw.randint(1, 5), 0.0
    nodes: dict[str, tuple[float, float]] = {"a": (0.0, 0.0)}
    edges, platforms, last = {}, list[list[str]](), "a"
    for k in range(stations):
        x += draw.uniform(900.0, 4000.0) if k == 0 else draw.uniform(400.0, 4000.0)
        length = draw.uniform(300.0, 1500.0)
        nodes |= {f"l{k}": (x, 0.0), f"r{k}": (x + length, 0.0)}
        edges |= nets.both_ways(f"s{k}", last, f"l{k}")
        platforms.append([f"p{k}{t}" for t in range(draw.randint(1, 3))])
        for t, name in enumerate(platforms[-1]):
            shape = [(x, 0.0), (x + 60.0, 12.0 * t), (x + length - 60.0, 12.0 * t), (x + length, 0.0)]
            for way, ends, points in ((name, (f"l{k}", f"r{k}"), shape), (f"-{name}", (f"r{k}", f"l{k}"), shape[::-1])):
                said = {"shape": " ".join(f"{u},{v}" for u, v in points), "spreadType": "center"}
                edges[way] = (*ends, said)
        x, last = x + length, f"r{k}"
    nodes["b"] = (x + draw.uniform(900.0, 4000.0), 0.0)
    edges |= nets.both_ways(f"s{stations}", last, "b")
    branch = draw.randrange(stations) if draw.random() < 0.4 else -1
    if branch >= 0:
        at = nodes[f"l{branch}"][0]
        nodes["c"] = (at - draw.uniform(900.0, 3000.0), -600.0)
        edges |= nets.both_ways("branch", "c", f"l{branch}")
    nets.net(folder, nodes, edges)
    one_way, trains, body = draw.random() < 0.5, draw.randint(2, 20), ""
    for n in range(trains):
        up, over = draw.random() < 0.5, branch >= 0 and draw.random() < 0.3
        way = ["branch" if over else "s0"]
        for k in range(branch if over else 0, stations):
            names = platforms[k]
            if one_way and len(names) == 2:
                names = names[:1] if up else names[1:]
            way += [*([f"s{k}"] if k > (branch if over else 0) else []), draw.choice(names)]
        way.append(f"s{stations}")
        if not up:
            way = [f"-{name}" for name in reversed(way)]
        body += nets.train(f"t{n}", " ".join(way), draw.randint(0, 60 * trains), type=draw.choice(["short", "long"]))
    kinds = "".join(f'<vType id="{k}" vClass="rail" length="{draw.randint(*span)}" maxSpeed="45"/>'
                    for k, span in (("short", (40, 250)), ("long", (250, 700))))  # fmt: skip
    nets.traffic(folder, body, kinds)
    scenario = nets.scenario("robust_constrained", LONGEST_S, ("short", "long"), traffic={"cooperate": []})
    (folder / "s.toml").write_text(tomli_w.dumps(scenario))
    return trains


def driven(folder: Path, seed: int, backend: str) -> float:
    """Let all trains of a net run until they have left; when that was [s]. Fails if two touch, or wait for each other for ever."""
    trains = made(folder, seed)
    p = open_scenario(str(folder / "s.toml"))
    if backend == "numeric":
        told = Told()
        loop = Loop(p, Numeric(p.line), told)  # type: ignore[arg-type]
        out(loop)
        kinds = {kind for kind, _ in told}
    else:
        with opened(p, folder / "out", "sumo") as loop:
            out(loop)
        import json

        kinds = {json.loads(line)["kind"] for line in (folder / "out" / "events.jsonl").read_text().splitlines()}
    assert loop.state.traffic.left.sum() == trains, (seed, loop.time)
    assert not kinds & {"violation", "gridlock"}, (seed, kinds)
    return loop.time


def out(loop: Loop) -> None:
    """Steps until nobody is left."""
    while not loop.over and not loop.state.traffic.left.all():
        loop.step()


@pytest.mark.parametrize("seed", [1, 94, 120, 228])
def test_everybody_gets_out(tmp_path, seed):
    """In 94 two wait before a join that becomes free to both at once; in 120 one is kept out by one that waits for it; in 228 a train
    comes to a join after a slow one that let a fast one pass, and saw that one only."""
    driven(tmp_path, seed, "numeric")


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("backend", "seeds"), [*(("numeric", range(k, k + 30)) for k in range(0, 300, 30)), ("sumo", range(300, 330))]
)
def test_campaign_three_hundred_nets(tmp_path, backend, seeds):
    for seed in seeds:
        driven(tmp_path / str(seed), seed, backend)
