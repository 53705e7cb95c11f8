"""Railways on which protection has a hard time, beside those of ``nets``: each writes ``a.net.xml`` and returns its routes."""

from __future__ import annotations

import math
import random
import re
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import nets
from nets import both_ways, convert, net


def speed(draw: random.Random) -> float:
    """A limit [m/s]."""
    return draw.choice([12.0, 20.0, 25.0, 33.0, 40.0, 40.0])


def joins_in_a_row(folder: Path, draw: random.Random) -> list[str]:
    """A main line that branches join one after the other, some within a train's length of each other."""
    joins, x = draw.randint(2, 6), 0.0
    nodes, edges, routes = {"j0": (0.0, 0.0)}, {}, []
    for k in range(1, joins + 2):
        x += (
            draw.choice([draw.uniform(30.0, 200.0), draw.uniform(200.0, 1500.0), draw.uniform(1500.0, 4000.0)]) if k > 1 else 4000.0
        )
        nodes[f"j{k}"] = (x, 0.0)
        edges[f"m{k}"] = (f"j{k - 1}", f"j{k}", {"speed": speed(draw)})
    x += draw.uniform(2000.0, 8000.0)
    nodes["z"] = (x, 0.0)
    edges["mz"] = (f"j{joins + 1}", "z", {"speed": speed(draw)})
    main = [f"m{k}" for k in range(1, joins + 2)] + ["mz"]
    routes.append(" ".join(main))
    for k in range(1, joins + 1):
        away = draw.uniform(1500.0, 5000.0)
        nodes[f"i{k}"] = (nodes[f"j{k}"][0] - away, draw.choice([-1, 1]) * draw.uniform(200.0, 1500.0))
        edges[f"in{k}"] = (f"i{k}", f"j{k}", {"speed": speed(draw)})
        routes.append(" ".join([f"in{k}", *main[k:]]))
    net(folder, nodes, edges, *draw.choice([(), ("--no-internal-links",)]))
    return routes


def short_edges(folder: Path, draw: random.Random) -> list[str]:
    """A line cut into pieces of half a metre to fifty, with a join amid them."""
    nodes, edges, x = {"n0": (0.0, 0.0)}, {}, 3000.0
    count = draw.randint(8, 30)
    for k in range(1, count + 1):
        nodes[f"n{k}"] = (x, 0.0)
        edges[f"e{k}"] = (f"n{k - 1}", f"n{k}", {"speed": speed(draw) if draw.random() < 0.3 else 40.0})
        x += draw.choice([draw.uniform(0.5, 5.0), draw.uniform(5.0, 50.0), draw.uniform(5.0, 50.0), draw.uniform(50.0, 900.0)])
    nodes["z"] = (x + 6000.0, 0.0)
    edges["z"] = (f"n{count}", "z")
    at = draw.randint(2, count)
    nodes["b"] = (nodes[f"n{at}"][0] - 3500.0, 900.0)
    edges["b"] = ("b", f"n{at}")
    main = [f"e{k}" for k in range(1, count + 1)] + ["z"]
    net(folder, nodes, edges, *draw.choice([(), ("--no-internal-links",)]))
    return [" ".join(main), " ".join(["b", *main[at:]])]


def hills(folder: Path, draw: random.Random) -> list[str]:
    """Two branches over hill and dale, up to 35 per mil, that join and part."""
    steep = draw.uniform(0.01, 0.035)
    places = {"w": (0.0, 0.0), "s": (0.0, -1500.0), "1": (4000.0, 0.0), "2": (6500.0, 0.0), "3": (9000.0, 0.0), "4": (11000.0, 0.0),
              "e": (15000.0, 0.0), "n": (15000.0, 1500.0)}  # fmt: skip
    height = dict.fromkeys(places, 0.0)
    for a, b in (("1", "2"), ("2", "3"), ("3", "4"), ("4", "e"), ("4", "n")):
        run = ((places[b][0] - places[a][0]) ** 2 + (places[b][1] - places[a][1]) ** 2) ** 0.5
        height[b] = height[a] + run * draw.choice([-1.0, -1.0, 1.0, 0.0]) * draw.uniform(0.5, 1.0) * steep
    for a in ("w", "s"):
        height[a] = height["1"] + draw.choice([-1.0, 0.0, 1.0]) * 4000.0 * steep
    edges = {
        "west": ("w", "1"), "south": ("s", "1"), "a": ("1", "2", {"speed": speed(draw)}), "b": ("2", "3"),
        "c": ("3", "4", {"speed": speed(draw)}), "east": ("4", "e"), "north": ("4", "n"),
    }  # fmt: skip
    net(folder, places, edges)
    nodes = folder / "a.nod.xml"
    nodes.write_text(re.sub(r'id="(\w+)"', lambda m: f'{m[0]} z="{height[m[1]]:.3f}"', nodes.read_text()))
    convert(folder)
    return [f"{begin} a b c {end}" for begin in ("west", "south") for end in ("east", "north")]


def loops(folder: Path, draw: random.Random) -> list[str]:
    """Single track with passing loops, both ways."""
    count = draw.randint(1, 3)
    nodes, edges, x, up, down = {"n0": (0.0, 0.0)}, {}, 0.0, [], []
    for k in range(count + 1):
        x += draw.uniform(1500.0, 4000.0)
        nodes[f"a{k}"] = (x, 0.0)
        edges |= both_ways(f"s{k}", "n0" if k == 0 else f"b{k - 1}", f"a{k}", speed=draw.choice([25, 40]))
        up.append(f"s{k}")
        down.append(f"-s{k}")
        if k == count:
            break
        long = draw.uniform(600.0, 2500.0)
        nodes[f"b{k}"] = (x + long, 0.0)
        for name, ends, side in (("u", (f"a{k}", f"b{k}"), 20), ("d", (f"b{k}", f"a{k}"), -20)):
            shape = [f"{x},0", f"{x + 200},{side}", f"{x + long - 200},{side}", f"{x + long},0"]
            edges[f"{name}{k}"] = (*ends, {"shape": " ".join(shape if side > 0 else shape[::-1]), "speed": 25})
        up.append(f"u{k}")
        down.append(f"d{k}")
        x += long
    net(folder, nodes, edges)
    return [" ".join(up), " ".join(down[::-1])]


def known(build: Callable[..., None], *more: object) -> Callable[[Path, random.Random], list[str]]:
    """A net of ``nets`` with the routes of its traffic."""

    def lay(folder: Path, draw: random.Random) -> list[str]:
        build(folder, *more)
        return sorted(set(re.findall(r'<route edges="([^"]+)"', (folder / "a.rou.xml").read_text())))

    return lay


def drawn(folder: Path, draw: random.Random) -> list[str]:
    """One of ``nets.at_random``."""
    return known(nets.at_random, draw.randint(0, 10_000))(folder, draw)


def single(folder: Path) -> None:
    """The single track of ``nets``, with trains both ways."""
    nets.single_track(folder, nets.train("u", nets.UP, 0) + nets.train("d", nets.DOWN, 0))


#: How often each railway is laid, of all; those that are drawn are laid in many variants.
NETS: dict[str, tuple[Callable[[Path, random.Random], list[str]], int]] = {
    "joins_in_a_row": (joins_in_a_row, 12), "short_edges": (short_edges, 10), "hills": (hills, 8), "loops": (loops, 8),
    "at_random": (drawn, 8), "branches": (known(nets.branches), 1), "three_joins": (known(nets.three_joins), 1),
    "single_track": (known(single), 1), "diamond": (known(nets.diamond), 1), "ring": (known(nets.ring), 1),
    "limits": (known(nets.limits), 1),
}  # fmt: skip


def signalled(edges: Mapping[str, Any]) -> set[str]:
    """Nodes of these edges that trains run through."""
    return {begin for begin, *_ in edges.values()} & {end for _, end, *_ in edges.values()}


def two_ways(folder: Path, draw: random.Random, signals: bool = False) -> list[str]:
    """A way round an edge of the main line, with a branch before and one behind, close by."""
    x = [0.0]
    for low, high in ((500, 4000), (800, 3000), (600, 4000), draw.choice([(0.4, 3), (20, 200), (500, 3000)]), (1000, 6000)):
        x.append(x[-1] + draw.uniform(low, high))
    nodes = {f"n{k}": (at, 0.0) for k, at in enumerate(x)}
    nodes |= {"m": ((x[1] + x[2]) / 2, draw.uniform(150, 600)), "s": (-500.0, -800.0), "e": (x[-1], 900.0)}
    ends = {
        "a": "n0 n1",
        "b": "n1 n2",
        "b1": "n1 m",
        "b2": "m n2",
        "c": "n2 n3",
        "d": "n3 n4",
        "z": "n4 n5",
        "in": "s n1",
        "out": "n3 e",
    }
    edges = {name: (*said.split(), {"speed": draw.choice([8, 12, 20, 25, 33, 40, 40, 55])}) for name, said in ends.items()}
    net(folder, nodes, edges, *draw.choice([(), ("--no-internal-links",)]), signals=signalled(edges) if signals else ())
    return ["a b c d z", "a b1 b2 c d z", "in b c d z", "in b1 b2 c out", "a b c out"]


def laps(folder: Path, draw: random.Random, signals: bool = False) -> list[str]:
    """A small ring that trains run round up to three times; some begin on it."""
    r = draw.uniform(250, 1500)
    nodes = {"w": (-r, -3000), "a": (-r, 0), "b": (0, r), "c": (r, 0), "d": (0, -r), "e": (r, -3000)}
    edges = {"in": ("w", "a", {"speed": speed(draw)}), "out": ("c", "e", {"speed": speed(draw)})}
    for k, (begin, end) in enumerate(pairwise("abcda")):
        arc = [math.pi * (1.0 - k / 2.0 - part / 12.0) for part in range(7)]
        shape = " ".join(f"{r * math.cos(angle):.2f},{r * math.sin(angle):.2f}" for angle in arc)
        edges[begin + end] = (begin, end, {"speed": speed(draw), "shape": shape})
    net(folder, nodes, edges, signals=signalled(edges) if signals else ())
    lap = "ab bc cd da "
    return [f"in {lap * k}ab bc out" for k in range(3)] + ["da ab bc out", f"bc cd da {lap}ab bc out"]


def platforms(folder: Path, draw: random.Random, signals: bool = False) -> list[str]:
    """Single track both ways to a station with two platforms; trains enter right before it."""
    a = draw.uniform(50, 1500)
    b, c = a + draw.uniform(1500, 6000), draw.uniform(400, 1200)
    c += b
    nodes = {
        "w": (0, 0),
        "w2": (0, 300),
        "a": (a, 0),
        "b": (b, 0),
        "c": (c, 0),
        "e": (c + draw.uniform(100, 2000), 0),
        "f": (c + 1500, 500),
    }
    up, down = (f"{b},0 {b + 100},{y} {c - 100},{y} {c},0".split() for y in (15, -15))
    edges = {
        "wi": ("w", "a", {"speed": speed(draw)}), "wo": ("a", "w2", {"speed": speed(draw)}), **both_ways("m", "a", "b", speed=speed(draw)),
        "p1": ("b", "c", {"speed": speed(draw), "shape": " ".join(up)}),
        "p2": ("c", "b", {"speed": speed(draw), "shape": " ".join(down[::-1])}),
        "eo": ("c", "e", {"speed": speed(draw)}), "ei": ("f", "c", {"speed": speed(draw)}),
    }  # fmt: skip
    net(folder, nodes, edges, signals=signalled(edges) if signals else ())
    return ["wi m p1 eo", "ei p2 -m wo"]


def terminals(folder: Path, draw: random.Random) -> list[str]:
    """Single track from a terminal to two others, with stations between; trains turn back in each."""
    a, b, c = (draw.choice([draw.uniform(300.0, 1700.0), draw.uniform(1700.0, 5000.0)]) for _ in range(3))
    nodes = {"a": (0.0, 0.0), "b": (a, 0.0), "c": (a + b, 0.0), "d": (a + 0.9 * c, 0.4 * c)}
    edges = {
        **both_ways("ab", "a", "b", speed=speed(draw)), **both_ways("bc", "b", "c", speed=speed(draw)),
        **both_ways("bd", "b", "d", speed=speed(draw)),
    }  # fmt: skip
    net(folder, nodes, edges, nets.TERMINALS, *draw.choice([(), ("--no-internal-links",)]))
    return ["ab bc -bc -ab", "-bc -ab ab bd", "ab bd -bd -ab ab bc", "-bd -ab", "-bc -ab ab bc -bc -ab"]


def heads(folder: Path, draw: random.Random) -> list[str]:
    """A double track that ends in a station of two platforms, with one edge more before each dead end now and then."""
    far, size = draw.uniform(2500.0, 7000.0), draw.choice([draw.uniform(300.0, 900.0), draw.uniform(900.0, 2500.0)])
    nodes = {"a": (0.0, 0.0), "z": (0.0, -40.0), "s": (far, 0.0), "t1": (far + size, 40.0), "t2": (far + size, -40.0)}
    edges: dict[str, Any] = {"up": ("a", "s", {"speed": speed(draw)}), "down": ("s", "z", {"speed": speed(draw)})}
    edges |= {**both_ways("p1", "s", "t1", speed=speed(draw)), **both_ways("p2", "s", "t2", speed=speed(draw))}
    more = draw.random() < 0.5
    if more:
        nodes["u1"] = (far + size + draw.uniform(50.0, 600.0), 40.0)
        edges |= both_ways("q1", "t1", "u1", speed=speed(draw))
    net(folder, nodes, edges, nets.TERMINALS)
    return ["up p1 q1 -q1 -p1 down" if more else "up p1 -p1 down", "up p2 -p2 down", "-p2 down"]


def crossing(folder: Path, draw: random.Random, signals: bool = False) -> list[str]:
    """Two lines that cross, with a turn from the one to the other; some sides are short."""
    away = {"w": (-1, 0), "e": (1, 0), "n": (0, 1), "s": (0, -1)}
    nodes = {"x": (0.0, 0.0)}
    for name, (x, y) in away.items():
        far = draw.uniform(200, 3000)
        nodes[name] = (x * far, y * far)
    ends = {"wx": "w x", "xe": "x e", "nx": "n x", "xs": "x s"}
    edges = {name: (*said.split(), {"speed": speed(draw)}) for name, said in ends.items()}
    net(folder, nodes, edges, signals=signalled(edges) if signals else ())
    return ["wx xe", "nx xs", "wx xs", "nx xe"]
