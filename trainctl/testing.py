"""For test suites: keep a run, or logs of SUMO's, as a golden, and assert that later ones match it.

::

    import trainctl
    from trainctl.testing import assert_run_matches, make_golden

    run = trainctl.run("three_tracks", out="runs/three_tracks", **{"run.duration_s": 60})
    make_golden(run, "goldens/three_tracks", every_s=10.0)  # once, and when it is meant to change

    def test_three_tracks(tmp_path):
        again = trainctl.run("three_tracks", out=tmp_path / "run", **{"run.duration_s": 60})
        assert_run_matches(again, "goldens/three_tracks", {"absolute": 1e-4, "columns": {"position_m": 1e-3}})

``trainctl.testing_pytest`` has a fixture that writes goldens with ``pytest --force-regen``. The page is trainctl/diff/README.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trainctl.diff.golden import make_golden
from trainctl.diff.runs import Report, Tolerances, diff, parse_tolerances, read_tolerances
from trainctl.runs.run import Run

__all__ = ["assert_run_matches", "make_golden"]


def assert_run_matches(
    run: Run | Path | str, golden: Run | Path | str, tolerances: Tolerances | Mapping[str, Any] | Path | str | None = None
) -> Report:
    """Assert that a run matches a golden one (or any other run), or a log of SUMO's another.

    Parameters
    ----------
    run : Run or Path
        The run to be tested, or a log of SUMO's, or a folder of these.
    golden : Run or Path
        What it must match: of the same kind, whole or thinned by ``make_golden``. At the instants of a thinned one all rows must
        be there; what lies between them is not compared.
    tolerances : mapping, Path or Tolerances, optional
        As in the file of ``trainctl diff --tolerances``; a path is such a file.

    Returns
    -------
    Report
        What was compared.

    Raises
    ------
    AssertionError
        With the findings, the first difference, and the largest of every column.
    InputError
        One of them is neither run folder nor log, or is damaged, or the tolerances are mistaken.
    """
    if isinstance(tolerances, Path | str):
        tolerances = read_tolerances(tolerances)
    elif isinstance(tolerances, Mapping):
        tolerances = parse_tolerances(tolerances)
    expected, found = (place.folder if isinstance(place, Run) else Path(place) for place in (golden, run))
    report = diff(expected, found, tolerances)
    if not report.same:
        raise AssertionError("\n".join([f"{found} does not match {expected}:", *report.lines()]))
    return report
