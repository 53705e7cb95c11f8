"""A long roster is taken in parts, those trains that are in service: the run is the same as with all of them at once."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from staged import Told

from trainctl import in_service
from trainctl.in_service import Between, InService, loop_of
from trainctl.loop import Loop
from trainctl.numeric import Numeric
from trainctl.record import checkpoint
from trainctl.scenario.build import open_scenario
from trainctl.scenario.model import Model
from trainctl.stages.record import Journal

TOOLS = Path(__file__).resolve().parents[2] / "tools"
spec = importlib.util.spec_from_file_location("country", TOOLS / "country.py")
assert spec is not None and spec.loader is not None
country = importlib.util.module_from_spec(spec)
sys.modules["country"] = country
spec.loader.exec_module(country)


@pytest.fixture
def short_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts that serve for two minutes."""
    monkeypatch.setattr(in_service, "MANY", 10)
    monkeypatch.setattr(in_service, "SERVES_S", 120.0)
    monkeypatch.setattr(in_service, "EARLY_S", 30.0)


class Unheard(Told):
    """A journal that does not mind whose rows it gets."""

    def serve(self, trains: object) -> None:
        """Rows of these trains from now on."""


def opened(folder: Path, duration: float, cooperate: str = "[]") -> Model:
    """Two corridors with more trains than they bear, so that some wait."""
    country.write(folder, runs=2000, corridors=2, day_s=20_000.0, first=200, duration_s=duration, record_every_s=20.0)
    text = (folder / "scenario.toml").read_text()
    (folder / "scenario.toml").write_text(text.replace("cooperate = []", f"cooperate = {cooperate}"))
    return open_scenario(str(folder / "scenario.toml"))


def ran(kind: type[Loop], p: Model, folder: Path) -> Loop:
    """A run to its end, its tables joined."""
    folder.mkdir()
    journal = Journal(folder, p)
    loop = kind(p, Numeric(p.line), journal)
    loop.run()
    journal.join()
    journal.close()
    return loop


@pytest.mark.usefixtures("short_parts")
def test_a_run_in_parts_is_the_run_of_all_trains_to_the_last_byte(tmp_path):
    p = opened(tmp_path / "in", 700.0, '["*"]')
    whole, parts = ran(Loop, p, tmp_path / "whole"), ran(InService, p, tmp_path / "parts")
    for name in ("trains.parquet", "links.parquet", "stops.parquet", "events.jsonl"):
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "parts" / name).read_bytes(), name
    told, same = whole.outcome(), parts.outcome()
    assert told.pop("messages_sent") > same.pop("messages_sent")  # who is not in service sends nothing
    assert told == same
    ours, theirs = (dict(checkpoint.leaves("", loop.state._replace(messages=()))) for loop in (whole, parts))
    assert ours.keys() == theirs.keys()
    assert [k for k in ours if not np.array_equal(ours[k], theirs[k], equal_nan=True)] == []
    kinds = {json.loads(line)["kind"] for line in (tmp_path / "parts" / "events.jsonl").read_text().splitlines()}
    assert {"depart", "stop_reached", "stop_left", "couple", "topology"} <= kinds


@pytest.mark.usefixtures("short_parts")
def test_a_part_holds_those_who_are_there_or_soon_due_and_only_those(tmp_path):
    p = opened(tmp_path / "in", 700.0)
    loop = loop_of(p, Numeric(p.line), Unheard())
    assert isinstance(loop, InService)
    loop.step()
    assert loop.part is not None
    assert (p.roster.depart[loop.part.trains] <= 151.0).all()
    assert len(loop.part.trains) == (p.roster.depart <= 150.0).sum()
    assert loop.part.loop.p.scenario.ids == tuple(p.scenario.ids[i] for i in loop.part.trains)
    assert len(loop.state.own) == len(p.scenario.ids)  # the state is that of all


@pytest.mark.usefixtures("short_parts")
def test_an_order_from_outside_takes_all_trains_into_service(tmp_path):
    p = opened(tmp_path / "in", 700.0)
    loop = loop_of(p, Numeric(p.line), Unheard())
    loop.step()
    loop.command([len(p.scenario.ids) - 1], -0.5)
    assert loop.state.commanded[-1] == -0.5
    loop.step()
    assert loop.k == 2 and loop.state.commanded[-1] == -0.5


def test_rosters_that_name_trains_or_are_short_are_not_divided(tmp_path):
    p = opened(tmp_path / "in", 100.0)
    assert type(loop_of(p, Numeric(p.line), Unheard())) is Loop  # 200 trains
    assert in_service.divisible(p)
    assert not in_service.divisible(open_scenario("three_tracks"))
    text = (tmp_path / "in" / "scenario.toml").read_text()
    alike = [i for i, legs in enumerate(p.roster.legs) if legs == p.roster.legs[-1]][:2]
    two, edge = [p.scenario.ids[i] for i in alike], p.roster.legs[-1][0][0]
    named = f'[[order]]\nedge = "{edge}"\ntrains = {json.dumps(two)}\n'
    (tmp_path / "in" / "scenario.toml").write_text(text + named)
    assert not in_service.divisible(open_scenario(str(tmp_path / "in" / "scenario.toml")))


def test_numbers_of_some_trains_and_back():
    between = Between.of(np.array([1, 3, 4]), 6)
    whole = np.arange(6.0)
    assert between.some(whole).tolist() == [1.0, 3.0, 4.0]
    assert between.everybody(whole, np.array([10.0, 30.0, 40.0])).tolist() == [0.0, 10.0, 2.0, 30.0, 40.0, 5.0]
    ahead = np.array([-1, 3, -1, 4, 5, -1])
    assert between.some(ahead, "ahead").tolist() == [1, 2, -1]  # who is not among them is nobody
    assert between.everybody(np.full(6, -1), np.array([1, 2, -1]), "ahead").tolist() == [-1, 3, -1, 4, -1, -1]
    requests = {"joins": {"7": [3, 1]}, "stretches": [(4, 2, True)], "until": {"3": 5.0}}
    some = between.some(requests)
    assert some == {"joins": {"7": [1, 0]}, "stretches": [(2, 2, True)], "until": {"1": 5.0}}
    assert between.everybody({}, some) == requests
