"""A pytest plugin: the fixture ``golden_run`` holds runs and logs against goldens beside the test, ``--force-regen`` renews these.

In ``conftest.py``::

    pytest_plugins = ["trainctl.testing_pytest"]

In a test::

    def test_three_tracks(golden_run, tmp_path):
        run = trainctl.run("three_tracks", out=tmp_path / "run", **{"run.duration_s": 60})
        golden_run(run, "three_tracks", {"absolute": 1e-4}, every_s=10.0)

holds the run against ``goldens/three_tracks`` beside the file of the test.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from trainctl.diff.golden import EVERY_S, accept, make_golden
from trainctl.diff.runs import Report, Tolerances, diff
from trainctl.runs.run import Run
from trainctl.testing import assert_run_matches

GoldenRun = Callable[..., Report]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--force-regen``, unless another plugin has it: then one option serves both."""
    with contextlib.suppress(ValueError):
        parser.addoption("--force-regen", action="store_true", default=False, help="Renew goldens; tests of those fail.")


@pytest.fixture
def golden_run(request: pytest.FixtureRequest) -> GoldenRun:
    """``golden_run(run, name, tolerances=None, every_s=60.0)``: assert that a run or log matches ``goldens/NAME`` beside the test.

    With ``--force-regen`` a golden that is missing or does not match is written anew, and the test fails with what moved, so that
    none is renewed unnoticed.
    """

    def check(
        run: Run | Path | str,
        name: str,
        tolerances: Tolerances | Mapping[str, Any] | Path | str | None = None,
        every_s: float = EVERY_S,
    ) -> Report:
        golden = request.path.parent / "goldens" / name
        source = run.folder if isinstance(run, Run) else Path(run)
        renew = bool(request.config.getoption("force_regen"))
        if not golden.exists():
            if not renew:
                pytest.fail(f"{golden}: no such golden: write it with pytest --force-regen", pytrace=False)
            make_golden(source, golden, every_s)
            pytest.fail(f"{golden}: written", pytrace=False)
        try:
            return assert_run_matches(source, golden, tolerances)
        except AssertionError as error:
            if not renew:
                raise
            accept(golden, source)
            report = diff(golden, source)
            again = "" if report.same else "; it does not match itself"
            pytest.fail(f"{golden}: renewed{again}; what moved:\n{error}", pytrace=False)

    return check
