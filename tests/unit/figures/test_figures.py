"""Figures of made-up runs: which ones a law gets, that they draw, that downsampling keeps every extreme."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from PIL import Image

from trainctl.errors import InputError
from trainctl.figures import catalogue, style
from trainctl.figures.catalogue import FIGURES, applicable, comparison, drawable, figure, plot
from trainctl.laws import shipped
from trainctl.plants.actuated_units import COLUMNS as UNIT_EXTRAS
from trainctl.record.folder import about_run, write_info
from trainctl.record.recorder import Recorder, standard_tables
from trainctl.runs.run import Run

STEPS = 60


def made_up(folder: Path, law: str, *, trains: int = 3, units: int = 0, extras: tuple[str, ...] = (), **more: Any) -> Run:
    """A formation 5 km apart whose errors decay; the second train is away from 20 s on, on track 3."""
    folder.mkdir(exist_ok=True)
    ids = [str(k + 1) for k in range(trains)]
    tables = standard_tables(ids, ["1", "2", "3"], ["e"], units=units > 0, unit_extras=extras)
    rng = np.random.default_rng(1)
    start = -5000.0 * np.arange(trains) + rng.normal(0, 500, trains)
    with Recorder(folder, tables) as recorder:
        for k in range(STEPS):
            decay = 0.9**k
            x = 80.0 * k + start + 300 * (1 - decay) * np.sin(np.arange(trains))
            v = 80.0 + 4 * decay * np.cos(np.arange(trains))
            away = np.zeros(trains, bool) if k < 20 or trains < 3 else np.arange(trains) == 1
            spacing = np.append(np.nan, -np.diff(x))
            recorder.write(
                "trains", time_s=float(k), train=np.arange(trains), track=np.where(away, 2, 0), edge=0, position_m=x, speed_mps=v,
                input_mps2=np.full(trains, np.nan) if k == STEPS - 1 else 0.2 + decay, spacing_m=spacing, gap_m=spacing - 80,
                saturated=False,
            )  # fmt: skip
            chain = np.flatnonzero(~away)
            ends = np.array([pair for a, b in pairwise(chain) for pair in ((a, b), (b, a))], dtype=int).reshape(-1, 2)
            gap = x[ends[:, 0]] - x[ends[:, 1]]
            wanted = 5000.0 * (ends[:, 1] - ends[:, 0])
            recorder.write(
                "links", time_s=float(k), sender=ends[:, 0], receiver=ends[:, 1], spacing_m=gap, desired_m=wanted,
                lower_m=wanted - 4900, upper_m=wanted + 4900, heard=True,
            )  # fmt: skip
            if units:
                which, unit = np.repeat(np.arange(trains), units), np.tile(np.arange(units), trains)
                stretch = np.where(unit < units - 1, 0.05 * decay * np.cos(k / 3 + unit), np.nan)
                force = 20e3 + 1e4 * decay * np.sin(k / 4 + unit)
                recorder.write(
                    "units", time_s=float(k), train=which, unit=unit + 1, position_m=x[which] - 20.0 * unit - 0.03 * decay * unit,
                    speed_mps=v[which] + 0.01 * decay * unit, force_n=force, coupler_m=stretch, coupler_force_n=1.6e5 * stretch,
                    coupler_min_m=stretch - 0.01, coupler_max_m=stretch + 0.01, force_min_n=force - 2e3, force_max_n=force + 2e3,
                    **{name: np.sin(k / 5) + (0.1 * decay if "estimate" in name else 0.0) for name in extras},
                )  # fmt: skip
        recorder.event(0.0, "topology", edges=[])
        recorder.event(20.0, "topology", edges=[])
    scenario = {
        "controller": {"law": law, "speed_error_lower_mps": -50.0, "speed_error_upper_mps": 50.0},
        "reference": {"speed_mps": 80.0},
        "bounds": {
            "speed_lower_mps": 75.0, "speed_upper_mps": 85.0, "input_lower_mps2": -2.0, "input_upper_mps2": 2.0,
            "coupler_lower_m": -0.1, "coupler_upper_m": 0.1,
        },
        "train_type": {
            "t": {"units": max(units, 1), "unit_mass_kg": 8e4, "unit_length_m": 20.0, "traction_n": 4e4, "braking_n": 6.4e4}
        },
        "train": [{"id": name, "type": "t", "position_m": 0.0} for name in ids],
        **more,
    }  # fmt: skip
    (folder / "scenario.toml").write_text(tomli_w.dumps(scenario))
    write_info(folder, about_run("", 1, [], steps=STEPS))
    return Run(folder)


CASES = {
    "fully_distributed": ({}, {"fig3_positions", "fig4_spacing", "fig5_speeds", "fig6_inputs", "train_graph", "spacing_errors"}),
    "robust_constrained": (
        {}, {"fig2_positions", "fig3_speeds_and_inputs", "fig4_spacing", "fig5_spacing_errors", "train_graph"}),
    "emu_finite_time": (
        {"units": 4},
        {"fig3_unit_speeds", "fig4_speed_over_position", "fig5_couplers", "fig6_gaps", "train_graph", "positions", "spacing",
         "spacing_errors", "speeds", "inputs", "coupler_forces", "unit_forces"}),
    "fault_tolerant": (
        {"units": 3, "extras": UNIT_EXTRAS},
        {"fig2_fault_estimates", "fig3_acceleration_estimates", "fig4_position_differences", "fig5_speed_differences",
         "fig6_unit_positions", "fig7_unit_speeds", "fig8_unit_forces", "train_graph", "positions", "spacing", "spacing_errors",
         "speeds", "inputs", "couplers", "coupler_forces"}),
    "somebody_elses": ({}, {"train_graph", "positions", "spacing", "spacing_errors", "speeds", "inputs"}),
}  # fmt: skip


@pytest.mark.parametrize("law", CASES)
def test_each_law_gets_its_papers_figures(tmp_path: Path, law: str, monkeypatch: pytest.MonkeyPatch) -> None:
    options, expected = CASES[law]
    monkeypatch.setattr(style, "DPI", 40)  # what is drawn counts here, not how finely
    monkeypatch.setattr(catalogue, "is_example", lambda run, law: True)
    files = plot(made_up(tmp_path / "run", law, **options), tmp_path / "out", formats=("png",))
    assert {path.stem for path in files} == expected
    assert all(path.stat().st_size > 1000 for path in files)


def test_a_law_without_links_units_or_reference_still_has_figures(tmp_path: Path) -> None:
    run = made_up(tmp_path, "sumo", trains=1)
    (tmp_path / "scenario.toml").unlink()
    assert set(applicable(drawable(run))) == {"train_graph", "positions", "speeds", "inputs"}
    for name in applicable(drawable(run)):
        assert isinstance(figure(run, name, "single"), Figure)


def test_numbers_of_a_paper_only_where_it_is_its_example(tmp_path: Path, finished: Callable[..., Run]) -> None:
    own = finished("fully_distributed", "numeric", **{"run.duration_s": 60})
    assert applicable(drawable(own))["positions"] == "fig3_positions"
    for other in (finished("three_tracks", "numeric", **{"run.duration_s": 60}), made_up(tmp_path, "fully_distributed")):
        assert applicable(drawable(other))["positions"] == "positions"


def test_the_comparisons_of_two_papers_have_their_numbers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue, "is_example", lambda run, law: True)
    ordinary = made_up(tmp_path / "a", "emu_finite_time", units=2, controller={"law": "emu_finite_time", "alpha_1": 1.0})
    assert applicable(drawable(ordinary))["unit_speeds"] == "fig7_ordinary_consensus_unit_speeds"
    other = made_up(tmp_path / "b", "fault_tolerant", units=2, observer={"kind": "intermediate"})
    assert applicable(drawable(other))["unit_differences"] == "fig9_intermediate_estimator_unit_differences"
    shown = comparison([ordinary, other], ["finite time", "ordinary"])
    assert [axes.get_title(loc="left") for axes in shown.axes] == ["finite time", "ordinary"]


def test_axes_have_units_and_bounds_are_dashed(tmp_path: Path) -> None:
    run = made_up(tmp_path, "fault_tolerant", units=2, extras=UNIT_EXTRAS)
    for name in FIGURES.keys() - {"platforms"}:  # nobody stops
        shown = figure(run, name)
        assert "[" in shown.axes[-1].get_xlabel(), name
        assert all("[" in axes.get_ylabel() for axes in shown.axes), name
        assert all(not axes.get_legend() for axes in shown.axes), name  # it stands outside the data
        assert {"2", "3"} <= named_in(shown), name  # nobody is ahead of the first
    dashed = [line for line in figure(run, "speeds").axes[0].lines if line.get_label() == "bound"]
    assert sorted(float(np.ravel(line.get_ydata())[0]) for line in dashed) == [75.0, 85.0]
    assert all(line.is_dashed() for line in dashed)


def named_in(shown: Figure) -> set[str]:
    """Trains named beside their lines, on them, or in a legend; a link names both its trains."""
    words = [text.get_text() for axes in shown.axes for text in axes.texts]
    words += [text.get_text() for found in shown.legends for text in found.get_texts()]
    return set(re.findall(r"\d+", " ".join(words)))


def test_lines_are_named_beside_their_ends_and_never_on_each_other(tmp_path: Path) -> None:
    shown = figure(made_up(tmp_path, "fully_distributed", trains=6), "speeds")  # all end at the same speed
    labels = [text for text in shown.axes[0].texts if text.get_text().startswith("train ")]
    assert [text.get_text() for text in labels] == [f"train {k}" for k in range(6, 0, -1)]
    assert np.diff([text.xy[1] for text in labels]).min() > 0.9 * style.line_share(shown.axes[0])
    assert not any(text.get_text().startswith("train") for found in shown.legends for text in found.get_texts())


@given(st.lists(st.floats(0.0, 1.0), max_size=30).map(sorted))
def test_labels_keep_their_distance_and_stay_inside(places: list[float]) -> None:
    moved = style.spread(places, 0.06)
    apart = min(0.06, 1.0 / max(len(places) - 1, 1))
    assert all(b - a > apart - 1e-9 for a, b in pairwise(moved))
    assert all(-1e-9 <= place <= 1.0 + 1e-9 for place in moved)
    if all(b - a >= 0.06 for a, b in pairwise(places)):
        assert moved == pytest.approx(places)


def test_a_bound_far_from_the_data_does_not_squeeze_them(tmp_path: Path) -> None:
    (panel,) = figure(
        made_up(tmp_path, "fully_distributed", bounds={"speed_lower_mps": 0.0, "speed_upper_mps": 85.0}), "speeds"
    ).axes
    low, high = panel.get_ylim()
    assert low > 70.0 and high > 85.0  # the far one is left out, the near one is in sight
    assert any("bound 0" in text.get_text() for text in panel.texts)


def test_events_stand_in_every_panel_over_time(tmp_path: Path) -> None:
    run = made_up(tmp_path, "robust_constrained")
    for name in ("speeds_and_inputs", "positions", "spacing", "train_graph"):
        for panel in figure(run, name).axes:
            assert [line.get_xdata()[0] for line in panel.lines if line.get_gid() == style.EVENT] == [20.0], name
    assert "topology" in {text.get_text() for text in figure(run, "speeds").axes[0].texts}


def test_couplers_at_rest_have_no_figure(tmp_path: Path) -> None:
    run = made_up(tmp_path, "emu_finite_time", units=2)
    drawn = drawable(run)
    assert "coupler_forces" in applicable(drawn)
    for name in ("coupler_m", "coupler_force_n"):
        drawn.units.column(name)[:] *= 1e-9  # rounding
    assert not {"couplers", "coupler_forces"} & set(applicable(drawn))


def test_hours_and_kilometres_per_hour_by_option(tmp_path: Path) -> None:
    run = made_up(tmp_path, "fully_distributed")
    plain, shown = figure(run, "speeds").axes[0], figure(run, "speeds", clock=True, kmh=True).axes[0]
    assert (shown.get_xlabel(), shown.get_ylabel()) == ("time [h:min]", "speed [km/h]")
    ours, si = (next(line.get_ydata() for line in axes.lines if line.get_label() == "train 1") for axes in (shown, plain))
    assert ours == pytest.approx(3.6 * si)
    assert [style.on_the_clock(t) for t in (0.0, 90.0, 3660.0, 90000.0)] == ["00:00", "00:01:30", "01:01", "25:00"]


def test_a_figure_says_what_it_was_drawn_from(tmp_path: Path) -> None:
    run = made_up(tmp_path / "run", "fully_distributed", title="Three trains")
    files = {path.suffix: path for path in plot(run, tmp_path / "out", formats=("png", "svg", "pdf")) if path.stem == "train_graph"}
    with Image.open(files[".png"]) as picture:
        assert picture.info["Title"] == "train_graph of Three trains"
        assert re.search(r"Three trains, law fully_distributed, trainctl \S+, .*seed 1", picture.info["Description"])
    assert "seed 1" in files[".svg"].read_text()
    below = figure(run, "speeds", caption=True)
    assert "seed 1" in below.get_supxlabel()
    assert figure(run, "speeds").get_supxlabel() == ""


def test_of_many_trains_the_graph_shows_what_each_gained(tmp_path: Path) -> None:
    run = made_up(tmp_path, "fully_distributed", trains=31)
    absolute, gained = figure(run, "train_graph").axes
    assert "gained" in gained.get_ylabel()
    assert all(
        line.get_ydata()[0] == pytest.approx(0.0)
        for line in gained.lines
        if line.get_label() != "_child1" and len(line.get_xdata()) == STEPS
    )
    assert absolute.get_position().height < gained.get_position().height


def test_of_many_trains_the_figures_of_units_name_a_few(tmp_path: Path) -> None:
    (panel,) = figure(made_up(tmp_path, "emu_finite_time", trains=40, units=2), "unit_forces").axes
    named = [text for text in panel.texts if text.get_text().startswith("train ")]
    assert 4 <= len(named) <= style.NAMED
    assert np.diff(sorted(text.xy[1] for text in named)).min() > 0.9 * style.line_share(panel)


FAULT = {
    "train": 1, "unit": 1, "kind": "sinusoid", "amplitude_n_per_s": 2e5, "omega_rad_per_s": 1.0, "phase_rad": 2.0, "start_s": 500.0,
}  # fmt: skip


def test_a_fault_of_6_s_is_drawn_as_a_sinusoid_between_the_rows_of_every_second(finished: Callable[..., Run]) -> None:
    """Rows alone miss its height; the truth is what the scenario states, and goes through every row."""
    run = finished("fault_tolerant", "numeric", **{"run.duration_s": 520, "fault": [FAULT]})
    name = next(name for name in applicable(drawable(run)) if name.endswith("fault_estimates"))
    above, magnified, _ = figure(run, name).axes
    assert "what the scenario states" in magnified.get_title("right")
    unit = run.units[run.units.train.astype(str).eq("1") & run.units.unit.astype(str).eq("1")].dropna(subset="fault_mps3")
    for panel, step in ((above, 1.0), (magnified, 0.11)):
        (line,) = [line for line in panel.lines if str(line.get_label()).startswith("truth")]
        x, y = line.get_data()
        there = x >= 500.0
        assert y[there] == pytest.approx(2.5 * np.cos(x[there] + 2.0), abs=1e-6)
        assert y.max() > 2.499 and np.diff(x[there]).max() < step + 1e-9
    assert np.interp(unit.time_s, x, y)[-20:] == pytest.approx(unit.fault_mps3.to_numpy()[-20:], abs=1e-6)


def test_every_numbered_figure_exists() -> None:
    papers = [shipped(name) for name in ("fully_distributed", "robust_constrained", "emu_finite_time", "fault_tolerant")]
    assert all(law.FIGURES and law.FIGURES.keys() <= FIGURES.keys() for law in papers)


def test_the_same_figure_is_the_same_bytes(tmp_path: Path) -> None:
    run = made_up(tmp_path / "run", "fully_distributed")
    shown = [style.save(figure(run, "speeds"), tmp_path / name, ("png", "svg", "pdf")) for name in "ab"]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(*shown, strict=True))


def test_downsampling_keeps_every_extreme_and_every_gap() -> None:
    rng = np.random.default_rng(3)
    x, y = np.arange(100_000.0), rng.normal(size=100_000)
    y[[5, 77_777]] = 50.0, -60.0
    y[40_000:40_010] = np.nan
    few_x, few_y = style.envelope(x, y, 400)
    assert len(few_x) < 500
    assert np.all(np.diff(few_x) > 0)
    assert few_y[few_x == 5] == 50.0
    assert few_y[few_x == 77_777] == -60.0
    assert np.isnan(few_y).sum() == 10
    for begin in range(0, 100_000, 1000):  # the envelope of each stretch is that of the data
        inside, drawn = slice(begin, begin + 1000), (few_x >= begin) & (few_x < begin + 1000)
        assert np.nanmax(few_y[drawn]) == np.nanmax(y[inside])
        assert np.nanmin(few_y[drawn]) == np.nanmin(y[inside])


def test_a_gap_in_the_log_breaks_the_line() -> None:
    x, y = style.broken(np.array([0.0, 1, 2, 3, 10, 11]), np.arange(6.0))
    assert np.isnan(x).tolist() == [False, False, False, False, True, False, False]
    assert np.isnan(y).tolist() == np.isnan(x).tolist()


def test_many_trains_are_coloured_by_a_scale_and_few_named() -> None:
    names = [str(k) for k in range(100)]
    assert len(style.colours(100)) == 100
    assert sum(not label.startswith("_") for label in style.labels(names)) <= style.NAMED


@pytest.mark.parametrize(
    ("options", "words"), [({"formats": ["bmp"]}, "format bmp: not known"), ({"width": "wide"}, "width wide: not known")]
)
def test_wrong_options_are_told(tmp_path: Path, options: dict[str, Any], words: str) -> None:
    run = made_up(tmp_path / "run", "fully_distributed")
    with pytest.raises(InputError, match=words):
        plot(run, tmp_path / "out", **options)
    with pytest.raises(InputError, match="figure nonsense: not known"):
        figure(run, "nonsense")
    with pytest.raises(InputError, match="nothing recorded for figure couplers"):
        figure(run, "couplers")
