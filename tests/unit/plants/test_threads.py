"""Threads share out whole formations; how many there are, and what is known of the trains when a law is compiled, changes no bit."""

from __future__ import annotations

import importlib.util
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trainctl.errors import InputError
from trainctl.loop import Loop
from trainctl.numeric import Numeric
from trainctl.plants import threads, views
from trainctl.scenario.build import open_scenario
from trainctl.signals import Links
from trainctl.stages.record import Journal

FILE = Path(__file__).resolve().parents[3] / "tools" / "bench.py"
spec = importlib.util.spec_from_file_location("bench", FILE)
assert spec is not None and spec.loader is not None
bench = importlib.util.module_from_spec(spec)
spec.loader.exec_module(bench)


def linked(pairs: list[tuple[int, int]], trains: int, order: list[int] | None = None) -> Links:
    """Links both ways between these pairs of trains."""
    both = sorted([(b, a) for a, b in pairs] + pairs)
    receiver, sender = np.array(both, np.int64).reshape(-1, 2).T.copy()
    none, n = np.zeros(len(both)), np.arange(trains)
    first = np.searchsorted(receiver, np.arange(trains + 1))
    there = n if order is None else np.array(order)
    return Links(sender, receiver, first, none, none, none, none, none > 0.0, np.zeros(trains), there)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks and shares of single trains."""
    monkeypatch.setattr(threads, "LEAST", 1)
    monkeypatch.setattr(threads, "TOGETHER", 1)


@pytest.mark.usefixtures("small")
def test_trains_that_receive_from_each_other_are_in_one_block():
    """Formations 0-1-2, 3 and 4-5; links go by the order of formations on their tracks."""
    first, links = np.arange(7) * 4, linked([(0, 1), (1, 2), (4, 5)], 6, [4, 5, 3, 0, 1, 2])
    for number in (1, 2, 3, 4):
        found = threads.shares(first, links, True, number)
        blocks = [(int(a), int(b)) for part in found.blocks for a, b in pairwise(part)]
        assert blocks == [(0, 3), (3, 4), (4, 6)]
        assert [sorted(found.order[a:b].tolist()) for a, b in blocks] == [[0, 1, 2], [3], [4, 5]]
        assert found.order.tolist() == [0, 1, 2, 3, 4, 5]
        assert 1 <= len(found.blocks) <= number
    assert len(threads.shares(first, links, True, 2).blocks) == 2
    assert len(threads.shares(first, links, False, 6).blocks) == 6  # nobody receives anything within a stretch


@pytest.mark.usefixtures("small")
def test_a_crossed_pair_of_formations_is_never_cut():
    """0-2 and 1-3: by their numbers they lie in each other."""
    found = threads.shares(np.arange(5) * 3, linked([(0, 2), (1, 3)], 4), True, 3)
    assert [part.tolist() for part in found.blocks] == [[0, 4]]


def test_few_trains_are_left_to_one_thread():
    found = threads.shares(np.arange(100) * 4, linked([], 99), False, 4)
    assert [part.tolist() for part in found.blocks] == [[0, 64, 99]]
    assert len(threads.shares(np.arange(1001) * 4, linked([], 1000), False, 3).blocks) == 3


def test_the_environment_says_how_many_threads_there_are(monkeypatch):
    monkeypatch.setenv(threads.THREADS, "3")
    assert threads.cores() == 3
    monkeypatch.delenv(threads.THREADS)
    assert threads.cores() >= 1
    for wrong in ("0", "-1", "two", "2.5", "²"):
        monkeypatch.setenv(threads.THREADS, wrong)
        with pytest.raises(InputError, match=f"TRAINCTL_THREADS={wrong}: must be a whole number, at least 1"):
            threads.cores()


def ran(case: str, folder: Path, number: int, monkeypatch: Any, by_radio: bool = False) -> tuple[Any, int]:
    """State after some steps of twelve trains in six formations, and how many threads there were."""
    folder.mkdir()
    text, line = bench.scenario(case, 12, 5, tracks=6)
    if by_radio:
        text = text.replace("[topology]", "[topology]\ncommunication_period_s = 0.5")
    (folder / "scenario.toml").write_text(text)
    (folder / "line.toml").write_text(line)
    monkeypatch.setenv(threads.THREADS, str(number))
    p = open_scenario(str(folder / "scenario.toml"))
    journal = Journal(folder, p)
    loop = Loop(p, Numeric(p.line), journal)
    for _ in range(4):
        loop.step()
    journal.close()
    s = loop.state
    return (s.own, s.plant.estimate, *s.plant.extremes), len(loop.plant.shares.blocks)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("case", ["coupled_units", "finite_time", "actuated_units"])
def test_no_bit_depends_on_the_number_of_threads(case, tmp_path, monkeypatch):
    alone, one = ran(case, tmp_path / "1", 1, monkeypatch)
    assert one == 1
    for number in (2, 3):
        shared, many = ran(case, tmp_path / str(number), number, monkeypatch)
        assert many == number
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(alone, shared, strict=True))


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("case", ["finite_time", pytest.param("actuated_units", marks=pytest.mark.campaign)])
def test_no_bit_depends_on_what_is_known_of_the_trains(case, tmp_path, monkeypatch):
    plain, _ = ran(case, tmp_path / "plain", 1, monkeypatch)
    monkeypatch.setattr(views, "WORTH", 1)
    known, _ = ran(case, tmp_path / "known", 2, monkeypatch)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(plain, known, strict=True))


@pytest.mark.parametrize("case", ["finite_time", pytest.param("actuated_units", marks=pytest.mark.campaign)])
def test_what_is_watched_is_of_one_instant_though_messages_are_held(case, tmp_path, monkeypatch):
    """Nothing is received within a stretch then, but intervals to the trains ahead are watched in it."""
    together, _ = ran(case, tmp_path / "together", 1, monkeypatch, by_radio=True)
    monkeypatch.setattr(threads, "LEAST", 1)
    monkeypatch.setattr(threads, "TOGETHER", 1)
    for number in (1, 2):
        apart, many = ran(case, tmp_path / str(number), number, monkeypatch, by_radio=True)
        assert many == number
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(together, apart, strict=True))


def test_a_law_that_does_not_say_what_it_writes_into_has_one_thread(tmp_path, monkeypatch):
    from trainctl.controllers import emu_finite_time

    monkeypatch.delattr(emu_finite_time, "WORK")
    monkeypatch.setattr(threads, "LEAST", 1)
    _, number = ran("finite_time", tmp_path / "run", 2, monkeypatch)
    assert number == 1
