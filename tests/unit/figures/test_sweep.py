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


def test_where_all_runs_have_one_value_the_scale_shows_it_and_zero(tmp_path: Path) -> None:
    """A coupler has 0.1 m of room in all runs: that is neither 1 m nor -0.9 m; and no time at all is not 0 s."""
    frame = pd.DataFrame({
        "run.seed": range(3), "topology.loss": [0.0, 0.1, 0.2], "status": "complete", "violations": 0,
        "bounds.coupler_lower_margin_m": 0.1, "formation.settling_s": np.nan, "formation.final_error_m": 9.0,
    })  # fmt: skip
    summary(frame, ["topology.loss"], tmp_path / "summary.svg")
    scales = re.findall(r'<g id="ytick_\d+">.*?<text[^>]*>([^<]*)</text>', (tmp_path / "summary.svg").read_text(), re.S)
    assert scales == ["0.0", "0.1", "0", "9"]  # the room, nothing of the times, the error


def over_two(**more: list[float | None]) -> pd.DataFrame:
    """Four cells with two runs each."""
    return pd.DataFrame({
        "run.seed": [0, 1] * 4, "topology.loss": [0.0, 0.0, 0.1, 0.1] * 2, "topology.delay_s": [0] * 4 + [5] * 4,
        "status": "complete", "violations": [0, 0, 0, 1, 0, 0, 2, 1], MARGIN: [10.0, 20.0, 5.0, -1.0, 8.0, 8.0, -3.0, -4.0], **more,
    })  # fmt: skip


def drawn(frame: pd.DataFrame, path: Path) -> list[str]:
    summary(frame, ["topology.loss", "topology.delay_s", "run.seed"], path / "summary.svg")
    return [re.sub("\u2212", "-", text) for text in re.findall(r"<text[^>]*>([^<]*)</text>", (path / "summary.svg").read_text())]


def test_two_settings_are_maps_with_the_median_of_every_pair(tmp_path: Path) -> None:
    text = drawn(over_two(), tmp_path)
    assert {"topology.loss", "topology.delay_s", "share of runs that violate a bound", "room above the lower spacing [m]"} <= set(
        text
    )
    assert {"20", "5", "8", "-3"} <= set(text)  # medians
    assert {"0", "0.5", "1"} <= set(text)  # shares
    assert "all 8 runs; median of 2 runs per cell" in text


def test_a_map_shows_what_did_not_settle_and_what_gave_nothing(tmp_path: Path) -> None:
    frame = over_two(**{
        "formation.settling_s": [300.0, 400.0, 350.0, None, None, None, 500.0, 600.0],
        "formation.final_error_m": [0.1, 0.1, 0.1, 9.0, 9.0, 9.0, 0.1, 0.1],
    })  # fmt: skip
    text = drawn(frame, tmp_path)
    assert "most runs not settled" in text and "no complete run" not in text
    assert {"400", "600"} <= set(text) and "350" not in text  # one of two did not settle: later than the other
    frame.loc[6:, "status"] = "failed"
    text = drawn(frame, tmp_path)
    assert "no complete run" in text and "6 of 8 runs complete, 2 failed; median of 2 runs per cell" in text


def test_where_no_run_settled_it_is_said(tmp_path: Path) -> None:
    frame = over_two(**{"formation.final_error_m": [9.0] * 8})  # metrics that are never a number have no column
    assert not_settled(frame).all()
    assert "most runs not settled" in drawn(frame, tmp_path)
    summary(frame, ["topology.loss"], tmp_path / "one.svg")
    assert "8 not settled by the end" in (tmp_path / "one.svg").read_text()


def test_rounding_is_no_violation_and_one_value_has_no_scale(tmp_path: Path) -> None:
    frame = over_two()
    frame[MARGIN] = -1e-14
    text = drawn(frame, tmp_path)
    assert not [word for word in text if "e-14" in word or word == "-0"]
