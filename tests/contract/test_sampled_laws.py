"""Every law that is evaluated once per control period keeps the same contract, whoever wrote it.

A module in ``trainctl.controllers`` with ``CLOCK = "sampled"`` is found by itself, with every row it has in comparisons; one that
weights its links adds that to ``WEIGHTS``. The checks themselves are ``trainctl.testing_laws``, so that authors elsewhere can run them too.
"""

from __future__ import annotations

import importlib
import pkgutil
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from trainctl import controllers
from trainctl.testing_laws import CHECKS, Example, check_sampled_law

#: The weight of all links, where it is not 1.
WEIGHTS = {"robust_constrained": 0.01}


def sampled() -> list[str]:
    names = [m.name for m in pkgutil.iter_modules(controllers.__path__)]
    modules = {name: importlib.import_module(f"{controllers.__name__}.{name}") for name in names}
    return [name for name, module in modules.items() if getattr(module, "CLOCK", None) == "sampled"]


def law(name: str) -> Any:
    return importlib.import_module(f"{controllers.__name__}.{name}")


def test_there_are_sampled_laws() -> None:
    assert {"fully_distributed", "robust_constrained", "time_headway"} <= set(sampled())


def rows() -> dict[str, tuple[str, dict[str, Any]]]:
    """Rows of comparisons -> law and keys of [controller]."""
    return {row: (name, keys) for name in sampled() for row, keys in law(name).COMPARED.items()}


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__.removeprefix("check_"))
@pytest.mark.parametrize("row", rows())
def test_contract(row: str, check: Any) -> None:
    name, keys = rows()[row]
    check(Example(law(name), law(name).Params.model_validate(keys), WEIGHTS.get(name, 1.0)))


def spoilt(**parts: Any) -> Any:
    """The robust law with some of its functions replaced."""
    return SimpleNamespace(**{**vars(law("robust_constrained")), **parts})


def reads_everybody(constants: Any, own: Any, leader: Any, links: Any, heard: Any) -> Any:
    asked = law("robust_constrained").demand(constants, own, leader, links, heard)
    return asked._replace(acceleration=asked.acceleration + 1e-9 * (np.mean(own.speed) - leader[1]))


def writes_into_its_inputs(constants: Any, own: Any, leader: Any, links: Any, heard: Any) -> Any:
    asked = law("robust_constrained").demand(constants, own, leader, links, heard)
    heard[0, 0] += 1.0
    return asked


@pytest.mark.parametrize("demand", [reads_everybody, writes_into_its_inputs])
def test_a_law_that_breaks_the_contract_is_found_out(demand: Any) -> None:
    with pytest.raises(AssertionError):
        check_sampled_law(spoilt(demand=demand), {"h_per_s": 0.3}, 0.01)
