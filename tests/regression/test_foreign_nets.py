"""Railways nobody here laid out: trains come, join, part, stop, meet and leave, under every law, and nothing breaks."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import nets
import numpy as np
import pytest
import tomli_w

from trainctl.prepare import open_scenario
from trainctl.record.run import Run
from trainctl.runner import run


def go(folder: Path, tables: dict[str, Any], backend: str = "sumo") -> Run:
    """Run the configuration in ``folder``."""
    (folder / "s.toml").write_text(tomli_w.dumps(tables))
    return run(open_scenario(str(folder / "s.toml")), folder / f"out_{backend}", backend)  # type: ignore[arg-type]


def kinds(run: Run) -> Counter[str]:
    return Counter(e["kind"] for e in run.events)


def unharmed(run: Run, arrive: bool = True) -> None:
    """No collision, no teleport, no word from SUMO, no bound broken, no emergency, and every train arrives."""
    sumo = run.folder / "sumo"
    assert "<collision " not in (sumo / "collisions.xml").read_text()
    assert 'teleports total="0"' in (sumo / "statistics.xml").read_text()
    assert [e for e in run.events if e["kind"] in ("sumo_warning", "violation")] == []
    assert [e for e in run.events if e["kind"] == "supervisor" and (e["emergency"] or e["reason"] != "limit")] == []
    if arrive:
        trains = {e["train"] for e in run.events if e["kind"] == "depart"}
        assert trains == {e["train"] for e in run.events if e["kind"] == "arrive"}


def order_at(run: Run, edge: str) -> list[str]:
    """Trains in the order in which they came onto an edge."""
    rows = run.trains[run.trains.edge.astype(str) == edge]
    return rows.groupby("train", observed=True).time_s.min().sort_values(kind="stable").index.astype(str).tolist()


@pytest.mark.parametrize("law", nets.LAWS)
def test_trains_of_two_branches_join_in_one_formation(tmp_path, law):
    nets.branches(tmp_path, number=1)
    found = go(tmp_path, nets.scenario(law, 700))
    unharmed(found, arrive=False)
    [couple] = [e for e in found.events if e["kind"] == "couple"]
    assert (couple["train"], couple["ahead"]) == ("s.0", "w.0")
    assert couple["time_s"] < 200  # before the join, which the first reaches at 229 s
    assert order_at(found, "main") == ["w.0", "s.0"]
    links = found.links[found.links.sender.astype(str) == "w.0"]
    assert (links.time_s > 229).any()
    assert np.abs(links.spacing_m.iloc[-1] - 1200.0) < 1.0


@pytest.mark.parametrize("options", [(), ("--no-internal-links",)], ids=["internal", "plain"])
def test_joins_and_branchings_with_and_without_internal_edges(tmp_path, options):
    nets.branches(tmp_path, *options)
    found = go(tmp_path, nets.scenario("robust_constrained", 1700))
    unharmed(found)
    assert kinds(found)["couple"] >= 3
    assert order_at(found, "main") == ["w.0", "s.0", "w.1", "s.1", "w.2", "s.2"]
