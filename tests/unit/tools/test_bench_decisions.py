"""The bench of decisions: as many trains as stations, who all ask."""

from __future__ import annotations

import importlib.util
from pathlib import Path

FILE = Path(__file__).resolve().parents[3] / "tools" / "bench_decisions.py"
spec = importlib.util.spec_from_file_location("bench_decisions", FILE)
bench_decisions = importlib.util.module_from_spec(spec)
spec.loader.exec_module(bench_decisions)


def test_a_line_of_every_size_has_a_row(capsys):
    assert bench_decisions.main(["10", "40"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [row[:2] for row in rows] == [["10", "5"], ["40", "20"]] and 0.0 < float(rows[1][2]) < 10.0
