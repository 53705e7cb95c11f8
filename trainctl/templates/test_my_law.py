"""What every sampled law must keep, and that this one runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import trainctl
from trainctl.laws import find_law
from trainctl.testing_laws import CHECKS, Example

HERE = Path(__file__).parent


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(check: Callable[[Example], None]) -> None:
    """The contract in ``trainctl.signals``."""
    law = find_law("my_law.py", HERE)
    check(Example(law, law.Params(), weight=1.0))


def test_it_runs_on_three_tracks(tmp_path: Path) -> None:
    """The first ten control periods keep every bound."""
    settings: dict[str, Any] = {"run.duration_s": 80}
    run = trainctl.run(HERE / "my_law.toml", backend="numeric", out=tmp_path / "run", **settings)
    assert run.info["status"] == "complete"
    assert run.metrics["bounds.broken"] == 0
