"""The page of a run without a browser: complete, offline, no extreme lost, event times exact."""

from __future__ import annotations

import base64
import itertools
import json
import re

import numpy as np
import pytest
from PIL import Image, ImageSequence

from trainctl.errors import InputError
from trainctl.figures.trains import drawable
from trainctl.record.recorder import Recorder, standard_tables
from trainctl.report.animation import animation, frames
from trainctl.report.film import film
from trainctl.report.film import unpacked as film_numbers
from trainctl.report.page import page, raised, report, three
from trainctl.report.panels import natural, panels, times, told
from trainctl.runs.run import Run


def unpacked(packed):
    return film_numbers(packed)


def data_of(text):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S).group(1))


@pytest.fixture(scope="module")
def run(finished):
    return finished("three_tracks", "numeric", **{"run.duration_s": 1100})


@pytest.fixture(scope="module")
def text(run):
    return page(run)


def test_page_is_one_file_that_asks_for_nothing(run, text):
    outside = re.sub(r"<script>.*?</script>", "", text, flags=re.S)  # the plotting library names addresses it never uses offline
    assert re.findall(r'(?:src|href)="([^"#]*)', outside) == ["data:,", "", ""]  # an empty icon, two places on this page
    assert "url(" not in outside
    assert "default-src 'none'" in outside
    assert report(run).read_text(encoding="utf-8") == text
    assert len(text) < 7e6


def test_every_panel_is_there_with_its_bounds(run, text):
    shown = {panel["id"]: panel for panel in data_of(text)["panels"]}
    wanted = {"graph", "relative", "speeds", "spacing", "errors", "inputs", "forces", "couplers", "energy", "events"}
    assert wanted <= set(shown)
    assert [b["value"] for b in shown["speeds"]["bounds"]] == [79.0, 85.0]
    assert [b["value"] for b in shown["forces"]["bounds"]] == [-64.0, 40.0]
    assert {b["dash"] for b in shown["spacing"]["bounds"]} == {"dash", "dot"}
    assert all("[" in panel["unit"] for name, panel in shown.items() if name != "events")


def test_no_extreme_of_any_speed_is_lost(run, text):
    (speeds,) = [panel for panel in data_of(text)["panels"] if panel["id"] == "speeds"]
    by_train = run.trains.groupby(run.trains.train.astype(str)).speed_mps
    for trace in speeds["traces"]:
        if trace["name"].startswith("train"):
            y = unpacked(trace["y"])
            name = trace["name"].split()[1]
            assert y.max() == np.float32(by_train.max()[name])
            assert y.min() == np.float32(by_train.min()[name])


def test_frames_hold_every_event_and_the_instants_around_it():
    instants = np.arange(0.0, 100_000.0)
    kept = frames(instants, [0.0, 12_345.0, 99_999.0], 50)
    assert {0.0, 12_344.0, 12_345.0, 12_346.0, 99_999.0} <= set(kept)
    assert len(kept) < 5100
    assert np.all(np.diff(kept) > 0)


def test_trains_2_and_5_change_tracks_and_the_links_are_redrawn_at_1001(run):
    film = animation(drawable(run))
    names, time = [t["name"] for t in film["trains"]], np.array(film["time"])
    lateral = unpacked(film["lateral"]).reshape(len(time), -1)
    assert film["tracks"] == ["2", "1", "3"]  # from left to right in the running direction
    before, after, past = (int(np.flatnonzero(time == t)[0]) for t in (1000.0, 1001.0, 1020.0))
    two, five = names.index("2"), names.index("5")
    assert (lateral[before, two], lateral[before, five]) == (1.0, 0.0)
    assert 1.0 < lateral[after, two] < 2.0
    assert 0.0 < lateral[after, five] < 1.0
    assert (lateral[past, two], lateral[past, five]) == (2.0, 1.0)
    links = np.frombuffer(base64.b64decode(film["links"]), np.uint8).reshape(len(time), -1)

    def heard(frame):
        return {frozenset((names[a], names[b])) for (a, b), state in zip(film["pairs"], links[frame], strict=True) if state == 2}

    assert heard(before) == {frozenset(pair) for pair in ("12", "23", "34", "46")}
    assert heard(after) == {frozenset(pair) for pair in ("13", "34", "45", "56")}


def test_verdict_says_what_broke_first_and_where(finished, text):
    assert "All bounds held" in text
    violated = page(finished("fully_distributed_ratchet", "numeric", **{"run.duration_s": 1010}))
    assert re.search(
        r"1 of \d kinds of bound violated.</strong> First at 989 s: lower spacing bound \[m\] of link of 4-5", violated
    )
    assert '<td class=whose>4-5</td><td class="broken">⚠ violated</td>' in violated


def test_metrics_are_words_with_three_digits_and_bad_ones_are_marked(text):
    table = text[text.index("<caption>Metrics") : text.index('id="tracks"')]
    assert re.search(r">Formation</th>.*>Traffic</th>.*>Energy and comfort</th>", table, re.S)
    (gain,) = re.findall(r"growth of the spacing error.*?</tr>", table)
    assert re.search(r"class=n>[\d.]{4}<.*⚠ above 1", gain)
    assert "formation." not in re.sub(r'title="[^"]*"', "", table)  # keys stand in the titles alone
    shown = [three(v) for v in (0.0999999, 18625.4, 1758.0, 3.0084e-6, 0.0, None, 12.345, 2400000.0, 7)]
    assert shown == ["0.100", "18\u2009600", "1758", "3.01·10<sup>-6</sup>", "0", "never", "12.3", "2.40·10<sup>6</sup>", "7"]


def test_a_page_says_where_it_comes_from_and_what_to_cite(run, text):
    source = text[text.index('id="source"') : text.index("</main>")]
    assert f"seed {run.info['seed']}" in source and run.info["scenario_sha256"][:12] in source
    assert "Fully Distributed Approach" in source


def test_lines_stand_by_number_and_a_link_goes_with_its_train_behind(finished):
    shown = {panel["id"]: panel for panel in panels(drawable(finished("three_tracks", "numeric", **{"run.duration_s": 1100})))}
    assert sorted(["10", "9", "1.2"], key=natural) == ["1.2", "9", "10"]
    assert [t["group"] for t in shown["errors"]["traces"]] == ["2", "3", "3", "4", "5", "6", "6"]
    colour = {t["group"]: t["color"] for t in shown["speeds"]["traces"] if "group" in t}
    assert all(t["color"] == colour[t["group"]] for t in shown["errors"]["traces"])
    assert {p["name"] for p in shown["graph"]["places"]} == {"emu_leave", "emu_join"}


def test_bounds_far_from_the_data_are_set_aside(finished):
    wide = {"bounds.input_lower_mps2": -200.0, "bounds.input_upper_mps2": 200.0}
    own = finished("fully_distributed", "numeric", **{"run.duration_s": 60, **wide})
    shown = {panel["id"]: panel for panel in panels(drawable(own))}
    assert [(b["value"], b["far"]) for b in shown["inputs"]["bounds"]] == [(-200.0, -1), (200.0, 1)]
    assert [(b["value"], b["far"]) for b in shown["speeds"]["bounds"]] == [(75.0, 0), (85.0, 0)]


def test_hours_and_kilometres_per_hour_by_option(run):
    data = data_of(page(run, clock=True, kmh=True))
    assert (data["clock"], data["per_mps"], data["speed_unit"]) == (True, 3.6, "km/h")
    (speeds,) = [panel for panel in data["panels"] if panel["id"] == "speeds"]
    assert speeds["unit"] == "speed [km/h]"
    assert [b["value"] for b in speeds["bounds"]] == pytest.approx([284.4, 306.0])


def test_lost_messages_are_told_from_missing_links(finished):
    film = animation(drawable(finished("fully_distributed_loss", "numeric", **{"run.duration_s": 60})))
    assert set(base64.b64decode(film["links"])) == {1, 2}


def made_up(folder, trains, steps, title="made up"):
    folder.mkdir()
    ids = [f"t{k}" for k in range(trains)]
    with Recorder(folder, standard_tables(ids, ["1"], ["e"], units=False)) as recorder:
        for k in range(steps):
            x = 80.0 * k - 5000.0 * np.arange(trains)
            recorder.write(
                "trains", time_s=float(k), train=np.arange(trains), track=np.zeros(trains, int), edge=np.zeros(trains, int), position_m=x,
                speed_mps=80.0 + np.sin(k / 7 + np.arange(trains)), input_mps2=np.zeros(trains), spacing_m=np.full(trains, np.nan),
                gap_m=np.full(trains, np.nan), saturated=np.zeros(trains, bool),
            )  # fmt: skip
        recorder.event(0.0, "note", text=title)
    (folder / "run.json").write_text(json.dumps({"format": "trainctl run", "schema_version": 1, "status": "complete"}))
    return Run(folder)


def test_a_million_rows_make_a_small_page(tmp_path):
    run = made_up(tmp_path / "run", 250, 4000)
    assert sum(len(panel["traces"]) for panel in panels(drawable(run))) > 700
    text = page(run)
    assert len(text) < 10e6
    (speeds,) = [panel for panel in data_of(text)["panels"] if panel["id"] == "speeds"]
    assert sum(len(unpacked(trace["x"])) for trace in speeds["traces"]) < 80_000


def test_names_cannot_break_out_of_the_page(tmp_path):
    text = page(made_up(tmp_path / "run", 1, 3, title="</script><b>&\u2028"))
    assert "</script><b>" not in text
    assert data_of(text)["animation"]["events"][0]["text"] == "text </script><b>&\u2028"


def test_an_event_is_one_line():
    event = {"time_s": 1.0, "kind": "topology", "edges": [["1", "3"]], "formations": [["1", "3"], ["2"]], "start_condition": []}
    assert told(event) == "links 1-3, formations 1 3 | 2"
    assert told({"time_s": 0, "kind": "depart", "train": "7", "delay_s": 2.0, "speed_mps": 36.0, "switch_m": 1.5}) == (
        "train 7, delay 2 s, speed 36 m/s, switch 1.5 m"
    )


def test_of_a_fleet_an_event_names_the_first_and_the_last_and_says_how_many():
    names = [str(k) for k in range(1, 101)]
    line = told({"time_s": 0.0, "kind": "topology", "edges": list(itertools.pairwise(names)), "formations": [names]})
    assert line == "links 1-2 2-3 3-4 … 98-99 99-100 (99 links), formations 1 2 3 … 99 100 (100 trains)"
    cut = told({"time_s": 0.0, "kind": "not_followed", "what": "x" * 1000})
    assert len(cut) == 300 and cut.endswith("x…")


def test_the_train_graph_says_what_its_dashes_mean(run):
    notes = {panel["id"]: panel.get("note", "") for panel in panels(drawable(run))}
    assert notes["graph"].startswith("One colour per train: full on track 1, dashed on track 2, dotted on track 3.")
    assert all("the reference." in notes[name] for name in ("graph", "speeds"))


def test_a_run_without_trains_or_a_wrong_place_is_told(tmp_path):
    run = made_up(tmp_path / "run", 1, 3)
    with pytest.raises(InputError, match="cannot be written"):
        report(run, tmp_path / "nowhere" / "page.html")


def test_whole_seconds_take_half_the_room():
    whole, odd = times(np.array([0.0, 1.0, 65535.0])), times(np.array([0.0, 0.5]))
    assert (whole["dtype"], odd["dtype"]) == ("u2", "f4")
    assert np.frombuffer(base64.b64decode(whole["bdata"]), "<u2").tolist() == [0, 1, 65535]
    assert {times(np.array(v))["dtype"] for v in ([65536.0], [-1.0], [np.nan], [])} == {"f4"}


def test_powers_of_units_stand_above_the_line():
    assert [raised(unit) for unit in ("m/s2", "m/s3", "kWh/km")] == ["m/s²", "m/s³", "kWh/km"]


@pytest.mark.parametrize("kind", ["gif", "webp"])
def test_a_film_has_a_picture_per_moment_and_trains_move_in_it(run, tmp_path, kind):
    path = film(run, tmp_path / f"film.{kind}", seconds=0.5, from_s=990.0, until_s=1030.0)
    with Image.open(path) as picture:
        frames = [np.asarray(frame.convert("RGB"), int) for frame in ImageSequence.Iterator(picture)]
    assert len(frames) == 6 and frames[0].shape[1] == 960
    assert all((a != b).any() for a, b in itertools.pairwise(frames))


def test_what_a_film_cannot_be_made_of_is_said(run, tmp_path):
    with pytest.raises(InputError, match=r"film.mp4: must end in .gif or .webp"):
        film(run, tmp_path / "film.mp4")
    with pytest.raises(InputError, match="fewer than two recorded instants between 5000 and 1100 s"):
        film(run, tmp_path / "film.gif", from_s=5000.0)
