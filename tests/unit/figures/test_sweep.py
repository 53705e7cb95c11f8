from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest

from trainctl.figures.sweep import summary

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
