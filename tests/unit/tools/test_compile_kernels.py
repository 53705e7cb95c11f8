from __future__ import annotations

import contextlib
import importlib
from pathlib import Path
from types import SimpleNamespace

import pytest

from trainctl.scenario.reading import shipped


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "tools"))
    return importlib.import_module("compile_kernels")


def test_every_shipped_scenario_is_in_one_combination(tool):
    found = tool.combinations()
    names = [name for each in found.values() for name in each]
    driven_by_sumo = {name for name, path in shipped().items() if 'law = "sumo"' in path.read_text()}
    assert len(names) == len(set(names)) and set(names) == set(shipped()) - driven_by_sumo
    assert [key[0] for key in found][:3] == [False, False, False]  # what takes longest comes first
    observers = {key[3] for key in found if key[1] == "fault_tolerant"}
    assert {"asymptotic", "intermediate"} <= observers


def test_a_combination_is_run_by_the_first_scenario_that_can_be_short(tool):
    assert tool.compiled(["fully_distributed"], False) is None
    assert tool.compiled(["no_such", "fully_distributed"], False) is None
    assert tool.compiled(["no_such"], False).startswith("no_such: ")


def test_continuous_laws_are_also_run_side_by_side(tool, monkeypatch):
    jobs = list[tuple[list[str], bool]]()
    monkeypatch.setattr(tool, "ProcessPoolExecutor", lambda *_: contextlib.nullcontext(SimpleNamespace(map=_noted(jobs))))
    tool.main()
    assert [names[0] for names, abreast in jobs if abreast] == ["fault_tolerant", "emu_finite_time"]
    assert [names for names, abreast in jobs if not abreast] == list(tool.combinations().values())
    assert tool.compiled(["emergency_stop", "emu_finite_time"], True) is None
    assert tool.compiled(["fault_tolerant_noise"], True) == "fault_tolerant_noise: its plant has noise of its own"


def _noted(jobs):
    def noted(_, names, abreast):
        jobs.extend(zip(names, abreast, strict=True))
        return []

    return noted
