"""The smallest safe spacing: what a stop is, how it is searched for, what the table says."""

from __future__ import annotations

import json
import math
import re

import numpy as np
import pytest

from trainctl.errors import InputError
from trainctl.studies import spacing, spacing_shown, stops
from trainctl.studies.stops import REFUSED, SAFE, UNSAFE, Outcome, StopsPlan, scenario, stopped

PLAN = StopsPlan(trains=3, stops=6, searched=3, speed_mps=40.0, line_mps=41.0)


def test_the_lines_are_two_stops_a_period_the_message_and_the_train_ahead() -> None:
    found = stops.reference_lines(StopsPlan(delay_s=2.0, brake_scatter=0.0))
    b = 218.4e3 / (420e3 * 1.04)
    assert found["relative"] == pytest.approx(220.0 + 3.0 * 82.333)
    assert found["absolute"] == pytest.approx(found["relative"] + 82.333**2 / (2.0 * b), abs=0.2)


def test_a_stop_is_the_same_among_others(tmp_path) -> None:
    """Stop 4 alone, and as one of six: brakes, errors, losses, disturbances."""
    alone, of_one = stopped(PLAN, "sliding_mode", 500.0, [4], tmp_path)
    among, of_six = stopped(PLAN, "sliding_mode", 500.0, range(6), tmp_path)
    assert alone.what == among.what == SAFE
    first, last = of_one.state.own, of_six.state.own[12:15]
    steps = min(of_one.k, of_six.k)
    assert steps > 100
    np.testing.assert_allclose(np.diff(first[:, 0]), np.diff(last[:, 0]), atol=0.5)  # one may have ended some steps earlier
    tables = scenario(PLAN, "sliding_mode", 500.0, range(6))
    (mine,) = [t for t in tables["train"] if t["id"] == "4.2"]
    (other,) = [t for t in scenario(PLAN, "sliding_mode", 500.0, [4])["train"] if t["id"] == "4.2"]
    assert mine["position_m"] == other["position_m"] and mine["speed_mps"] == other["speed_mps"]
    brakes = {t: k["braking_n"] for t, k in tables["train_type"].items()}
    assert len(set(brakes.values())) == 18 and max(brakes.values()) <= 1.05 * 218.4e3 and min(brakes.values()) >= 0.95 * 218.4e3


def test_too_near_is_unsafe_and_below_the_start_condition_refused(tmp_path) -> None:
    near, _ = stopped(PLAN, "sliding_mode", 205.0, range(3), tmp_path)
    assert near.what == UNSAFE and near.contacts > 0 and near.gap_m < 0.0 and near.failures
    refused, loop = stopped(PLAN, "relative_braking", 250.0, range(3), tmp_path)
    assert refused.what == REFUSED and loop is None
    assert refused.why.startswith("link[0.1,0.2].desired_m = 250: must be at least 290 at 40 m/s")


def test_no_train_but_the_first_is_told_of_the_order(tmp_path) -> None:
    """The reference goes on; without messages the others run into it whatever the spacing."""
    deaf = PLAN._replace(loss=0.99, delay_s=30.0, trains=2)
    found, loop = stopped(deaf, "time_headway", 1500.0, range(2), tmp_path)
    assert found.what == UNSAFE
    assert loop.state.formed.references.leader(loop.time)[1] == 40.0


class Thresholds:
    """Stops each of which needs a spacing of its own; what was asked."""

    def __init__(self, monkeypatch, needs, refused_below=0.0, refused_above=math.inf, unsafe_above=math.inf) -> None:
        self.needs, self.asked, self.unsafe_above = needs, [], unsafe_above
        self.refused = refused_below, refused_above
        monkeypatch.setattr(spacing, "stopped", self.stopped)

    def stopped(self, plan, row, at, numbers, out):
        self.asked.append((at, list(numbers)))
        if not self.refused[0] <= at <= self.refused[1]:
            return Outcome(at, REFUSED, 0, len(numbers), 0, math.inf, "too something"), None
        failed = tuple(k for k in numbers if not self.needs[k] <= at <= self.unsafe_above)
        return Outcome(at, UNSAFE if failed else SAFE, len(failed), len(numbers), len(failed), 1.0, "", failed), None


def smallest(plan, tmp_path):
    return spacing._Search(plan, "any", tmp_path).smallest()


def test_the_smallest_is_found_within_a_per_cent(monkeypatch, tmp_path) -> None:
    Thresholds(monkeypatch, [900.0, 1234.0, 500.0, 600.0, 700.0, 800.0])
    low, high = smallest(PLAN, tmp_path)
    assert low.spacing_m < 1234.0 <= high.spacing_m <= 1.01 * low.spacing_m and high.of == 6


def test_a_stop_that_fails_among_all_is_searched_with_from_then_on(monkeypatch, tmp_path) -> None:
    """Stops 0 to 2 are searched with; stops 3 and 5 need more."""
    asked = Thresholds(monkeypatch, [900.0, 1000.0, 500.0, 1500.0, 700.0, 1800.0])
    low, high = smallest(PLAN, tmp_path)
    assert low.spacing_m < 1800.0 <= high.spacing_m <= 1.0101 * low.spacing_m and high.what == SAFE
    assert asked.asked[-1][1] == list(range(6))
    assert [0, 1, 2, 3, 5] in [numbers for _, numbers in asked.asked]


def test_refused_is_not_unsafe(monkeypatch, tmp_path) -> None:
    Thresholds(monkeypatch, [100.0] * 6, refused_below=2000.0)
    low, high = smallest(PLAN, tmp_path)
    assert low.what == REFUSED and high.spacing_m == pytest.approx(2000.0, rel=0.01)


def test_a_law_with_an_upper_end_is_searched_below_it(monkeypatch, tmp_path) -> None:
    Thresholds(monkeypatch, [3000.0] * 6, refused_above=9000.0)
    _, high = smallest(PLAN, tmp_path)
    assert high.what == SAFE and high.spacing_m == pytest.approx(3000.0, rel=0.01)


def test_a_law_that_is_unsafe_far_apart_is_searched_below_it(monkeypatch, tmp_path) -> None:
    Thresholds(monkeypatch, [3000.0] * 6, unsafe_above=9000.0)
    _, high = smallest(PLAN, tmp_path)
    assert high.what == SAFE and high.spacing_m == pytest.approx(3000.0, rel=0.01)


@pytest.mark.parametrize(("needs", "what"), [(1e6, UNSAFE), (1.0, SAFE)])
def test_none_and_the_smallest_looked_at(monkeypatch, tmp_path, needs, what) -> None:
    Thresholds(monkeypatch, [needs] * 6)
    low, high = smallest(PLAN, tmp_path)
    assert low is high and high.what == what and high.spacing_m == (PLAN.to_m if what == UNSAFE else PLAN.from_m)


ROW = {
    "row": "sliding_mode", "spacing_m": 812.5, "below": "unsafe", "headway_s": 9.87, "trains_per_hour": 364.8, "journey_time_s": 1217.0,
    "energy_kwh_per_train_km": 20.4, "jerk_rms_mps3": 0.09, "string_gain": 1.2, "messages_per_train_s": 1.0, "law_ms_per_train": 0.05,
    "points": [Outcome(400.0, UNSAFE, 2, 3, 2, -1.0, "").plain(), Outcome(250.0, REFUSED, 0, 3, 0, math.inf, "because").plain()],
    "checked": [{"share": s, **Outcome(s * 812.5, UNSAFE if s < 1 else SAFE, int(s < 1), 6, 0, 3.0, "").plain()} for s in spacing.SHARES],
    "others": Outcome(812.5, UNSAFE, 1, 6, 1, -1.0, "").plain(), "told": "what it is told", "why": "", "keys": {"gain_per_s": 0.2},
    "in_sumo": [], "wall_time_s": 1.0,
}  # fmt: skip
NONE = {**ROW, "row": "fully_distributed", "spacing_m": None, "below": "refused", "checked": [], "others": None, "why": "no room."}


def test_the_table_says_which(tmp_path) -> None:
    cells = dict(zip(spacing_shown.COLUMNS, spacing_shown.cells(ROW), strict=True))
    assert cells["failed of all at 95 / 100 / 105 / 110 %"] == "1 of 6 / 0 of 6 / 0 of 6 / 0 of 6"
    assert cells["of as many others"].startswith("1 of 6 (") and cells["just below"] == "unsafe"
    assert dict(zip(spacing_shown.COLUMNS, spacing_shown.cells(NONE), strict=True))["spacing [m]"] == "none: refused"
    assert spacing_shown.reasons([NONE]) == ["fully distributed: what it is told. no room. (gain_per_s = 0.2)"]
    (written,) = spacing_shown.figure([ROW, NONE], StopsPlan(), tmp_path / "spacing")
    assert written.stat().st_size > 5000


def test_the_latex_table_has_as_many_cells_in_every_row() -> None:
    text = spacing_shown.latex([ROW, NONE], StopsPlan())
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert len(rows) == 5 and r"\midrule" in text and {line.count("&") for line in rows} == {len(spacing_shown.COLUMNS) - 1}
    assert not re.search(r"(?<!\\)[%_]", text.partition("\n")[2])


def test_every_law_that_runs_on_a_line_says_what_it_is_told() -> None:
    for row, law in stops.LAW_ROWS.items():
        assert 40 < len(law.IN_STOPS) < 200, row
        made = scenario(PLAN, row, 2000.0, [0, 1])
        assert made["controller"]["law"] and len(made["train"]) == 6


def test_the_command(typed, tmp_path, capsys) -> None:
    status, said = typed("compare", "spacing", "--rows", "nobody,sliding_mode", "--loss", "2")
    assert status == 2 and said == [f"--rows nobody: no such row; there are: {', '.join(stops.ROWS)}"]
    status, said = typed("compare", "spacing", "--loss", "2", "--searched", "9", "--stops", "3", "--trains", "1")
    assert status == 2 and said == [
        "--trains: must be at least 2", "--searched: must be at least 1, at most --stops", "--loss: must be 0 .. 0.99",
    ]  # fmt: skip
    assert typed("compare", "spacing", "--length-km", "5") == (2, ["--length-km: not with `trainctl compare spacing`"])
    assert typed("compare", "capacity", "--stops", "5") == (2, ["--stops: only with `trainctl compare spacing`"])


def test_a_row_from_the_search_to_the_calm_run(tmp_path) -> None:
    row = spacing.found(PLAN._replace(stops=4, searched=2, within=0.1, to_m=2000.0), "sliding_mode", tmp_path)
    assert row["below"] == UNSAFE and row["checked"][1]["failed"] == 0 and row["checked"][1]["of"] == 4
    assert 200.0 < row["spacing_m"] < 800.0 and row["headway_s"] == pytest.approx(row["spacing_m"] / 40.0)
    assert row["journey_time_s"] == pytest.approx(100_000.0 / 40.0, rel=0.02) and row["energy_kwh_per_train_km"] > 1.0
    assert row["jerk_rms_mps3"] > 0.0 and row["string_gain"] > 0.0 and 0.0 < row["law_ms_per_train"] < 5.0
    assert row["messages_per_train_s"] == 1.0 and row["keys"]["control_period_s"] == 1.0
    json.dumps(row)


def test_the_string_gain_is_the_laws_own(tmp_path) -> None:
    """A constant time gap damps what the train ahead does, relative braking passes it on; errors on every link would hide both."""
    gap, relative = (spacing.measured(PLAN, row, 700.0, tmp_path)["string_gain"] for row in ("time_headway", "relative_braking"))
    assert 0.5 < gap < 1.0 and relative == pytest.approx(1.0, abs=0.01)


def test_sumo_says_the_same_of_stops_and_of_contacts(tmp_path, capfd) -> None:
    told = [stopped(PLAN, "sliding_mode", at, range(3), tmp_path, sumo)[0] for at in (205.0, 500.0) for sumo in (False, True)]
    assert [(o.what, o.contacts, round(o.gap_m, 6)) for o in told[::2]] == [
        (o.what, o.contacts, round(o.gap_m, 6)) for o in told[1::2]
    ]
    assert told[1].what == UNSAFE and told[3].what == SAFE and capfd.readouterr().err == ""
    found = spacing.in_sumo(PLAN, "sliding_mode", 500.0, tmp_path)
    assert [(one["share"], one["first"], one["of"]) for one in found] == [(0.95, 0, 6), (1.0, 0, 6), (1.0, 6, 6)]
    lines = spacing_shown.sumo_lines([ROW, {**ROW, "in_sumo": found}])
    assert lines == ["sliding mode in SUMO: failed 0 of 6 at 95 %, 0 of 6 at it; of others 0 of 6 (0 .. 39 %)"]


def test_rows_that_are_done_stay(tmp_path) -> None:
    place = tmp_path / "sliding_mode" / spacing.ROW
    place.parent.mkdir()
    place.write_text(json.dumps({"plan": PLAN._asdict(), "found": ROW}))
    assert spacing.compare(PLAN, tmp_path, ("sliding_mode",), workers=1, resume=True) == [json.loads(json.dumps(ROW))]
    assert json.loads((tmp_path / "spacing.json").read_text())["rows"][0]["spacing_m"] == 812.5
    assert not spacing._asked_the_same(PLAN._replace(loss=0.5), place.parent)


def test_without_sumo_it_is_not_asked(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(spacing, "has_sumo", lambda: False)
    with pytest.raises(InputError, match="--in-sumo: SUMO: libsumo is not installed"):
        spacing.compare(PLAN, tmp_path, ("sliding_mode",), sumo=True)


def test_a_plan_that_makes_no_sense_is_refused(tmp_path) -> None:
    with pytest.raises(InputError) as told:
        spacing.compare(StopsPlan(from_m=100.0, to_m=50.0, speed_mps=90.0), tmp_path)
    assert [line.partition(":")[0] for line in told.value.mistakes] == ["--from-m", "--to-m", "--speed-mps"]
