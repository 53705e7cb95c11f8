"""The generated parts of trainctl/diff/README.md are up to date, and say what the logs have."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import every_log
import pyarrow as pa
import pytest

from trainctl.diff.sources import KINDS, sumo_log, sumo_logs_in

ROOT = Path(__file__).parents[3]


#: Of routes, the attributes of types and of vehicles: whatever the scenario gives them.
OF_TYPES = {"vehroute": {"length", "vClass", "maxSpeed", "accel", "decel", "speedFactor", "insertionChecks", "arrivalPos"}}


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


@pytest.fixture(scope="module")
def logs(finished, tmp_path_factory):
    """Logs of a run of ours, and all that SUMO writes of one of its own."""
    place = tmp_path_factory.mktemp("sumo")
    every_log.write(place, ["xml"])
    return [*sumo_logs_in(finished("merging").folder / "sumo").values(), *(place / "xml").glob("*.xml")]


def test_what_sumo_writes_is_on_the_page(tool, logs):
    """Each column, and whether it is a number."""
    named, seen = columns_of_the_page(tool), set()
    for path in logs:
        log = sumo_log(path)
        batches = list(log.batches())
        if not batches:  # no collisions
            continue
        seen.add(log.name)
        whole, known = pa.concat_tables(batches, promote_options="permissive"), named[log.name]
        for column in whole.column_names:
            name = column if column in known else re.sub(r"\d+$", "", column)  # of the second walk of a person
            if name in OF_TYPES.get(log.name, ()):
                continue
            assert name in known, (path.name, column)
            unit, kind = known[name]
            texts = whole[column].drop_null().cast(pa.string()).to_pylist()
            if kind == "number" and texts:
                assert all(re.fullmatch(r"-?[\d.]+(e[+-]?\d+)?|NA", text) for text in texts[:50]), (log.name, name)
                assert unit, (log.name, name)
    assert seen == {kind.name for kind in KINDS}
    assert all(named.values())
