"""The peer's suite over a small folder of its own: what ran, what was refused and why, what a lost stop or a failed run looks like."""

from __future__ import annotations

import importlib.util
import json
from collections import Counter
from pathlib import Path

import nets
import pytest

FILE = Path(__file__).resolve().parents[3] / "tools" / "sumo_tests.py"
spec = importlib.util.spec_from_file_location("sumo_tests", FILE)
sumo_tests = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sumo_tests)

STOP = '<stop lane="ab_0" endPos="2000" duration="30"/>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two trains on one track, a join with a passing stop, and a route that is not connected."""
    base = tmp_path_factory.mktemp("suite")
    line = {"a": (0, 0), "b": (3000, 0), "c": (6000, 0), "d": (0, 1500)}
    edges = {"ab": ("a", "b"), "bc": ("b", "c"), "db": ("d", "b")}
    for name, body in {
        "stop": nets.train("v", "ab bc", 0, STOP) + nets.train("w", "ab bc", 60),
        "join": nets.train("v", "ab bc", 0) + nets.train("w", "db bc", 20),
        "broken": nets.train("v", "ab db", 0),
    }.items():
        nets.net(base / name, line, edges)
        nets.traffic(base / name, body, end=1500)
    return base


def test_every_case_has_a_row_beside_plain_sumo(folder, capsys):
    assert sumo_tests.main([str(folder), "--json"]) == 0
    rows = {row["case"].partition("/")[0]: row for row in json.loads(capsys.readouterr().out)}
    assert rows["broken"]["plain"].startswith("refused: Error") and rows["broken"]["law"]["ran"].startswith("exit 2: ")
    for name, stops in (("stop", "1/1"), ("join", "0/0")):
        for who in ("law", "baseline"):
            row = rows[name][who]
            assert (row["ran"], row["arrived"], row["order"], row["stops"]) == ("ok", "2/2", True, stops)
            assert row["collisions"] <= 0
        assert abs(rows[name]["baseline"]["late_s"]) <= 1.0
    text = sumo_tests.table(list(rows.values()))
    assert len(text.splitlines()) == 7 and "exit 2" in text


def test_what_must_not_be_fails_the_suite():
    result = sumo_tests.Result
    there = result(0, "", ((100.0, "v"), (120.0, "w")), Counter(v=2), 1, 0)
    lost = sumo_tests.compared(result(0, "", ((90.0, "w"), (95.0, "v")), Counter(v=1, w=3), 3, 2), there, 10.0)
    assert lost == {"ran": "ok", "arrived": "2/2", "order": False, "stops": "1/2", "late_s": -20.0, "collisions": 2, "named": 2}
    died = sumo_tests.compared(result(3, "it died", (), Counter(), 0, 0), there, 0.0)
    said = sumo_tests.wrong({"case": "c", "law": lost, "baseline": died})
    assert said == ["c: law: 2 more collisions", "c: law: 1 stops not made", "c: baseline: exit 3: it died"]
    refused = sumo_tests.compared(result(2, "no", (), Counter(), 0, 0), there, 0.0)
    assert sumo_tests.wrong({"case": "c", "law": refused, "baseline": refused}) == []
    assert sumo_tests.main(["/nonexistent"]) == 2
