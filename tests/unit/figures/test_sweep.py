from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from trainctl.figures.sweep import not_settled, summary

MARGIN = "bounds.spacing_lower_margin_m"


def words(statuses: list[str], path: Path) -> str:
    """All text of the figure of a sweep whose runs ended so."""
    margins = [200.0 + k if status == "complete" else None for k, status in enumerate(statuses)]
    violated = [0 if status == "complete" else None for status in statuses]
    frame = pd.DataFrame({"run.seed": range(len(statuses)), "status": statuses, "violations": violated, MARGIN: margins})
    summary(frame, ["run.seed"], path / "summary.svg")
    return " ".join(re.findall(r"<text[^>]*>([^<]*)</text>", (path / "summary.svg").read_text()))


@pytest.mark.parametrize(
    ("statuses", "said"),
    [
        (["complete"] * 3, "all 3 runs"),
        (["refused", "complete", "failed", "refused"], "1 of 4 runs complete, 1 failed, 2 refused"),
        (["refused", "refused"], "0 of 2 runs complete, 2 refused"),
    ],
)
def test_it_says_how_many_runs_gave_nothing(statuses: list[str], said: str, tmp_path: Path) -> None:
    assert said in words(statuses, tmp_path)


def test_runs_that_did_not_settle_are_shown_and_counted(tmp_path: Path) -> None:
    times = [380.0, None, 420.0, None, None]
    frame = pd.DataFrame({
        "run.seed": range(5), "topology.loss": [0.0, 0.1, 0.2, 0.3, 0.4], "status": "complete", "violations": 0,
        "formation.settling_s": times, "formation.final_error_m": [0.1, 9.0, 0.1, 9.0, None],
    })  # fmt: skip
    assert not_settled(frame).tolist() == [False, True, False, True, False]  # the last has no links
    summary(frame, ["topology.loss"], tmp_path / "summary.svg")
    text = " ".join(re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / "summary.svg").read_text()))
    assert "2 not settled by the end" in text
    frame["formation.settling_s"] = np.nan
    summary(frame, ["topology.loss"], tmp_path / "none.svg")
    assert "4 not settled by the end" in (tmp_path / "none.svg").read_text()
