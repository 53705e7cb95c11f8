"""How long the interlocking takes to decide, by the switches of a line: ``python tools/bench_decisions.py [SWITCHES ...]``.

A single track with stations of two tracks, two switches each, and a train at every station, half of them each way: the first
instant, in which all of them ask at once for what lies ahead and nothing is decided yet, and one in which they ask again.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from decisions import CLEARANCE, railway

from trainctl.railway import along, interlocking, zones
from trainctl.railway.ways import ways

SWITCHES = (10, 20, 50, 100, 200, 500, 1000)

#: Lengths of a station, of the track between two, and of a train; how far ahead it asks [m].
STATION_M, BETWEEN_M, TRAIN_M, REACH_M = 800.0, 3000.0, 200.0, 4000.0


def decided(switches: int) -> tuple[int, float, float]:
    """Trains, and the seconds of the first and of the second instant."""
    stations = switches // 2
    lengths, links, twins = dict[str, float](), list[tuple[str, str]](), list[tuple[str, str]]()
    for k in range(stations + 1):
        lengths |= {f"s{k}": BETWEEN_M, f"-s{k}": BETWEEN_M}
        twins.append((f"s{k}", f"-s{k}"))
    for k in range(stations):
        lengths |= {f"u{k}": STATION_M, f"d{k}": STATION_M}
        links += [(f"s{k}", f"u{k}"), (f"u{k}", f"s{k + 1}"), (f"-s{k + 1}", f"d{k}"), (f"d{k}", f"-s{k}")]
    net = railway(lengths, links, twins)
    up = [name for k in range(stations) for name in (f"s{k}", f"u{k}")] + [f"s{stations}"]
    down = [name for k in reversed(range(stations)) for name in (f"-s{k + 1}", f"d{k}")] + ["-s0"]
    paths = [[net.number[name] for name in (up if k % 2 else down)] for k in range(stations)]
    laid = ways(paths, np.zeros(len(net.length_m)), net.length_m)
    n = len(paths)
    row = np.array([laid.first[i] + (2 * i + 1 if i % 2 else 2 * (stations - 1 - i) + 1) for i in range(n)])
    s = laid.begin[row] + STATION_M - 100.0
    begun = time.process_time()
    shared = zones.of(laid, along.net(net))
    spent, state = [time.process_time() - begun], interlocking.none()
    for _ in range(2):
        begun = time.process_time()
        state, ends, _ = interlocking.request(
            shared, state, row, s, np.full(n, TRAIN_M), np.ones(n, bool), np.full(n, REACH_M), CLEARANCE
        )
        spent.append(time.process_time() - begun)
    assert (ends.room > 0.0).any()  # somebody may go on
    return n, spent[1], spent[2]


def main(arguments: list[str]) -> int:
    """Print a table."""
    sizes = [int(word) for word in arguments] or SWITCHES
    decided(sizes[0])  # compiled before
    print(f"{'switches':>8} {'trains':>7} {'first_s':>9} {'again_s':>9} {'exponent':>9}")
    before: tuple[int, float] | None = None
    for size in sizes:
        n, first, again = decided(size)
        grows = "" if before is None else f"{np.log(first / before[1]) / np.log(size / before[0]):9.2f}"
        print(f"{size:8d} {n:7d} {first:9.4f} {again:9.4f} {grows}", flush=True)
        before = size, first
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
