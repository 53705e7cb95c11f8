"""Which way a trip takes where trains must turn, by the options of the configuration, as in plain SUMO; timetables with what was."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import nets
import pytest
from beside import OPEN, plain

from trainctl.errors import InputError
from trainctl.traffic.read import read_traffic

TRIP = '<trip id="v" type="emu" depart="0" from="in" to="out" departSpeed="0"/>'


def siding(folder: Path, length: float, options: str) -> Path:
    """A siding of three edges of 300 m, in which trains turn that come from ``in`` and go ``out``."""
    nodes = {"x": (-2000, 100), "y": (-2000, -100), "s": (0, 0), "p": (300, 0), "q": (600, 0), "r": (900, 0)}
    edges = {**nets.both_ways("sp", "s", "p"), **nets.both_ways("pq", "p", "q"), **nets.both_ways("qr", "q", "r")}
    nets.net(folder, nodes, {**edges, "in": ("x", "s"), "out": ("s", "y")}, nets.TERMINALS)
    nets.traffic(folder, TRIP, nets.EMU.replace('length="100"', f'length="{length}"'), end=1000)
    sumocfg = folder / "a.sumocfg"
    sumocfg.write_text(sumocfg.read_text().replace(OPEN, OPEN + options))
    return sumocfg


@pytest.mark.parametrize("length", [100, 700])
@pytest.mark.parametrize(
    "options",
    [
        "",
        '<railway.max-train-length value="400"/>',
        '<weights.reversal-penalty value="-1"/>',
        '<weights.priority-factor value="2"/>',
    ],
)
def test_a_trip_turns_where_it_does_in_sumo(tmp_path, length, options):
    sumocfg = siding(tmp_path, length, options)
    try:
        plain(tmp_path, "vehroute")
        [theirs] = re.findall(r'<route edges="([^"]*)"', (tmp_path / "plain.xml").read_text())
    except subprocess.CalledProcessError as error:
        assert b"No connection between edge 'in' and edge 'out' found" in error.stderr
        with pytest.raises(InputError, match="train v: no path from edge in to edge out"):
            read_traffic(sumocfg, tmp_path / "work")
        assert "penalty" in options or (length == 700 and "length" in options)
        return
    traffic = read_traffic(sumocfg, tmp_path / "work")
    assert " ".join(traffic.departures[0].edges) == theirs == "in sp pq qr -qr -pq -sp out"
    assert not [note for note in traffic.notes if "option" in note]


def test_options_of_the_ways_must_be_numbers(tmp_path):
    options = '<railway.max-train-length value="-1"/><weights.reversal-penalty value="none"/><weights.minor-penalty value="x"/>'
    with pytest.raises(InputError) as caught:
        read_traffic(siding(tmp_path, 100, options), tmp_path / "work")
    said = [line.partition(".sumocfg: ")[2] for line in caught.value.mistakes]
    assert said == [
        "railway.max-train-length = -1: must be a number, not negative",
        "weights.reversal-penalty = none: must be a number",
        "weights.minor-penalty = x: must be a number, not negative",
    ]


@pytest.mark.parametrize("option", [True, False])
def test_what_was_late_does_not_make_a_timetable_wrong(tmp_path, option):
    """A stop ended at 80 s; the next is planned for 40 s all the same: SUMO stands until 80 s, or the plan stands alone."""
    stops = '<stop lane="ab_0" endPos="500" duration="10" until="20" ended="80"/><stop lane="bc_0" endPos="500" arrival="40" until="50"/>'
    nets.net(tmp_path, {"a": (0, 0), "b": (2000, 0), "c": (4000, 0)}, {"ab": ("a", "b"), "bc": ("b", "c")})
    nets.traffic(tmp_path, nets.train("v", "ab bc", 0, stops), end=1000)
    sumocfg = tmp_path / "a.sumocfg"
    if option:
        sumocfg.write_text(sumocfg.read_text().replace(OPEN, f'{OPEN}<use-stop-ended value="true"/>'))
    [train] = read_traffic(sumocfg, tmp_path / "work").departures
    assert [(s.until_s, s.arrival_s) for s in train.stops] == [(80.0 if option else 20.0, None), (50.0, 40.0)]
    [first, _] = plain(tmp_path, "stop")
    assert (float(first["ended"]) == 80.0) == option
    (tmp_path / "a.rou.xml").write_text((tmp_path / "a.rou.xml").read_text().replace('until="20" ended="80"', 'until="80"'))
    with pytest.raises(InputError, match="arrival = 40 s: must not be before 80 s"):
        read_traffic(sumocfg, tmp_path / "work")
