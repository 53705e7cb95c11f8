"""The generated parts of trainctl/diff/README.md are up to date, and say what the logs have."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pyarrow as pa
import pytest

from trainctl.diff.sources import sumo_log, sumo_logs_in

ROOT = Path(__file__).parents[3]


#: What SUMO 1.28 writes and its own schemas do not know; and, of routes, the attributes of types and of vehicles.
LATER = {
    "summary": {"discarded"},
    "statistics": set(),
    "vehroute": {"length", "vClass", "maxSpeed", "accel", "decel", "speedFactor", "insertionChecks", "arrivalPos"},
}


@pytest.fixture(scope="module")
def tool():
    loader = importlib.util.spec_from_file_location("diff_tables", ROOT / "tools" / "diff_tables.py")
    module = importlib.util.module_from_spec(loader)
    loader.loader.exec_module(module)
    return module


def test_the_page_is_up_to_date(tool):
    assert tool.page() == tool.PAGE.read_text(encoding="utf-8"), "python tools/diff_tables.py"


def columns_of_the_page(tool):
    parts = re.split(r"\n\*\*(\w+)\*\* \(", tool.PAGE.read_text(encoding="utf-8"))
    return {
        table: {name: (unit, kind) for name, unit, kind in re.findall(r"\| `([^`]+)` \| ([^|]*) \| ([^|]*) \|", text)}
        for table, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def test_what_sumo_writes_is_on_the_page(tool, finished):
    """Each column of the logs of a run, and whether it is a number."""
    named = columns_of_the_page(tool)
    for table, path in sumo_logs_in(finished("merging").folder / "sumo").items():
        batches = list(sumo_log(path).batches())
        if not batches:  # no collisions
            continue
        whole = pa.concat_tables(batches, promote_options="permissive")
        assert set(whole.column_names) - set(named[table]) <= LATER.get(table, set()), table
        for name in set(whole.column_names) & set(named[table]):
            unit, kind = named[table][name]
            texts = whole[name].drop_null().cast(pa.string()).to_pylist()
            if kind == "number" and texts:
                assert all(re.fullmatch(r"-?[\d.]+(e[+-]?\d+)?", text) for text in texts[:50]), (table, name)
                assert unit, (table, name)
