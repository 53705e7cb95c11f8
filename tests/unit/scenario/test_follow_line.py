from __future__ import annotations

import math
import tomllib

import numpy as np
import pytest

from trainctl.errors import InputError
from trainctl.scenario.build import open_scenario
from trainctl.scenario.reference import Profile, obeying, table
from trainctl.signals import leader_at

LINE = """
name = "limits"
tracks = [1, 2]
length_m = 20000.0
max_edge_m = 1000.0
speed = [[0.0, 30.0], [6000.0, 15.0], [8000.0, 25.0]]
gradient = [{gradient}]
[[crossover]]
from = 1
to = 2
position_m = 3000.0
length_m = 300.0
speed_mps = 10.0
"""

SCENARIO = """
schema_version = 1
title = "Three points behind a reference that obeys the line"
[run]
duration_s = {duration}
[network]
line = "limits.toml"
[controller]
law = "robust_constrained"
h_per_s = 0.5
[plant]
input_lower_mps2 = -0.8
input_upper_mps2 = {room}
speed_lower_mps = 0.0
speed_upper_mps = 40.0
[reference]
follow_line = true
{reference}
[bounds]
input_lower_mps2 = -0.8
input_upper_mps2 = {room}
speed_lower_mps = 0.0
speed_upper_mps = 40.0
[topology]
spacing_m = 500.0
weight = 0.01
[train_type.point]
unit_length_m = 100.0
unit_mass_kg = 1e5
c0_n_per_kg = 0.01
c1_ns_per_m_kg = 0.0
c2_ns2_per_m2_kg = 1e-5
"""


def scenario(folder, reference="speed_mps = 28.0", duration=300, gradient="", room=0.8):
    (folder / "limits.toml").write_text(LINE.format(gradient=gradient))
    trains = "".join(
        f'[[train]]\nid = {k}\ntype = "point"\ntrack = 1\nposition_m = {2000 - 500 * k}\nspeed_mps = 20.0\n' for k in (1, 2, 3)
    )
    (folder / "s.toml").write_text(SCENARIO.format(duration=duration, reference=reference, room=room) + trains)
    return str(folder / "s.toml")


def leader(reference, t):
    out = np.empty(4)
    leader_at(reference, t, t, out)
    return out


def test_a_restriction_is_kept_from_the_front_of_the_first_to_the_rear_of_the_last():
    # Worked by hand: 20 m/s, 10 m/s from 5000 to 6000 m, a formation of 300 m; 0.5 m/s2 down takes 300 m, 0.25 up 600 m.
    points = obeying([(0.0, 20.0), (5000.0, 10.0), (6000.0, 20.0)], 4000.0, 20.0, (-300.0, 0.0), (0.25, 0.5))
    times = [0.0, 700 / 20, 700 / 20 + 20.0, 700 / 20 + 20.0 + 130.0, 700 / 20 + 20.0 + 130.0 + 40.0]
    assert np.array(points) == pytest.approx(np.array(list(zip(times, [20.0, 20.0, 10.0, 10.0, 20.0], strict=True))))
    reference = table(points, 4000.0)
    assert leader(reference, times[2])[:2] == pytest.approx([5000.0, 10.0])
    assert leader(reference, times[3])[:2] == pytest.approx([6300.0, 10.0])


def test_it_stops_where_it_is_told():
    points = obeying([(0.0, 20.0)], 0.0, 0.0, (0.0, 0.0), (0.3, 0.4), stop=3000.0)
    assert points[-1][1] == 0.0
    assert leader(table(points, 0.0), points[-1][0] + 100.0)[:2] == pytest.approx([3000.0, 0.0])


def test_between_two_restrictions_too_near_for_the_limit_it_turns_from_speeding_up_to_braking():
    limits = [(0.0, 10.0), (1000.0, 30.0), (1400.0, 10.0)]
    points = obeying(limits, 0.0, 10.0, (0.0, 0.0), (0.25, 0.5))
    # v^2 = 100 + 0.5 s = 100 + (400 - s), so s = 800 / 3
    assert max(v for _, v in points) == pytest.approx(math.sqrt(100.0 + 0.5 * 800.0 / 3.0))


def test_cap_and_distance_below_the_limits():
    assert max(v for _, v in obeying([(0.0, 20.0)], 0.0, 0.0, (0.0, 0.0), (0.3, 0.4), cap=12.0)) == 12.0
    assert max(v for _, v in obeying([(0.0, 20.0)], 0.0, 0.0, (0.0, 0.0), (0.3, 0.4), cap=30.0, below=1.5)) == 18.5


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"speed": 25.0}, "starts with 25 m/s, but the limits ahead allow 20 m/s"),
        ({"position": 4900.0}, r"the limits ahead allow 14.14213562 m/s at 4900 m when braking with 0.5 m/s2"),
        ({"below": 10.0}, "the limit of 10 m/s at 5000 m is not above below_limit_mps = 10"),
        ({"stop": -5.0}, "stops at -5 m, at or behind its start"),
    ],
)
def test_what_cannot_be_done_is_told_in_words(keys, words):
    given = {"position": 0.0, "speed": 20.0, "reach": (0.0, 0.0), "rates": (0.3, 0.5)} | keys
    with pytest.raises(ValueError, match=words):
        obeying([(0.0, 20.0), (5000.0, 10.0)], **given)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"speed_mps": 20.0, "stop_m": 9.0}, "stop_m belongs to follow_line"),
        ({"follow_line": True, "table": ((0.0, 1.0),)}, "exactly one of .* here table and follow_line"),
        ({"follow_line": False}, "exactly one of"),
        ({"follow_line": True, "acceleration_mps2": 0.0}, "greater than 0"),
    ],
)
def test_keys_that_do_not_go_together(keys, words):
    with pytest.raises(ValueError, match=words):
        Profile(**keys)


def test_scenario_keeps_the_limits_of_the_tracks_not_of_the_crossovers(tmp_path):
    p = open_scenario(scenario(tmp_path, "speed_mps = 28.0\nmargin_m = 50.0"))
    points = p.scenario.reference.table
    assert p.scenario.reference.follow_line is None  # what is logged stands without the line
    assert max(v for _, v in points) == 28.0
    slow = [t for t, v in points if v == pytest.approx(15.0)]
    assert len(slow) == 2
    assert leader(p.reference, slow[0])[0] == pytest.approx(6000.0 - 50.0)
    assert leader(p.reference, slow[1])[0] == pytest.approx(8000.0 + 1000.0 + 100.0 + 50.0)  # slots, the last train's length
    assert tomllib.loads(p.scenario.toml())["reference"]["table"][0] == [0.0, 20.0]


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ("stop_m = 30000.0", "reference.stop_m = 30000: off the line, which is 0 .. 20000 m"),
        ("start_speed_mps = 35.0", "reference.follow_line: starts with 35 m/s"),
        ("speed_mps = 28.0\ntable = [[0.0, 1.0]]", "exactly one of"),
    ],
)
def test_mistakes_of_a_scenario(tmp_path, reference, words):
    with pytest.raises(InputError, match=words):
        open_scenario(scenario(tmp_path, reference))


def test_a_run_off_the_end_is_told(tmp_path):
    with pytest.raises(InputError, match="beyond the line's end"):
        open_scenario(scenario(tmp_path, duration=3000))
    with pytest.raises(InputError) as error:  # it stops before the end, but this law wants a reference that never stands
        open_scenario(scenario(tmp_path, "stop_m = 19000.0", duration=3000))
    assert [m.partition(": ")[2] for m in error.value.mistakes] == [
        "reference.speed_mps = 0: must be above the minimum speed 0 m/s (all trains)"
    ]


def test_slopes_change_the_input_of_point_trains_not_their_motion(tmp_path):
    from trainctl.runner import run
    from trainctl.runs.run import Run

    def rows(folder, gradient):
        folder.mkdir()
        done: Run = run(open_scenario(scenario(folder, duration=400, gradient=gradient)), folder / "run", "numeric")
        return done.trains

    level, hilly = rows(tmp_path / "level", ""), rows(tmp_path / "hilly", "[2500.0, 12.0], [5000.0, -8.0]")
    for column in ("position_m", "speed_mps"):
        assert hilly[column].to_numpy() == pytest.approx(level[column].to_numpy(), rel=1e-12)
    x = hilly["position_m"].to_numpy()
    slope = np.where(x >= 5000.0, -0.008, np.where(x >= 2500.0, 0.012, 0.0))
    told = level["input_mps2"].notna().to_numpy()
    difference = (hilly["input_mps2"] - level["input_mps2"]).to_numpy()
    assert difference[told] == pytest.approx(9.80665 * slope[told], abs=1e-9)


def test_a_slope_that_leaves_no_input_is_told_with_its_numbers(tmp_path):
    # 40 per mil take 0.3923, resistance at 28 m/s is 0.01784 m/s2
    steep = "[9000.0, 40.0], [12000.0, -30.0]"
    open_scenario(scenario(tmp_path, gradient=steep, room=0.42))
    with pytest.raises(InputError) as error:
        open_scenario(scenario(tmp_path, gradient=steep, room=0.41))
    assert [m.partition(": ")[2] for m in error.value.mistakes] == [
        "train[1].input_upper_mps2 = 0.41: 40 per mil at 9000 m take 0.3923 m/s2 and running resistance at 28 m/s 0.01784 m/s2,"
        " so nothing is left for control (the first of 3 trains)"
    ]


@pytest.mark.parametrize(("permil", "fits"), [(5.0, True), (10.0, False)])
def test_what_a_slope_leaves_must_do_what_the_law_asks_of_its_bounds(tmp_path, permil, fits):
    # 0.1 m/s up in 1 s needs 0.1 m/s2 besides the resistance, 0.01 + 1e-5 * 80.2^2 = 0.0743; 0.25 less 10 per mil leave 0.0776.
    file = scenario(tmp_path, "speed_mps = 80.0", duration=60, gradient=f"[9000.0, {permil}]", room=0.25)
    text = (tmp_path / "s.toml").read_text().replace('"robust_constrained"\nh_per_s = 0.5', '"fully_distributed"')
    text = (
        text.replace("follow_line = true\n", "")
        .replace("speed_mps = 20.0", "speed_mps = 80.0")
        .replace("weight = 0.01", "lower_m = 200.0\nupper_m = 900.0")
    )
    text = text.replace("speed_upper_mps = 40.0", "speed_upper_mps = 80.2").replace(
        "speed_lower_mps = 0.0", "speed_lower_mps = 79.9"
    )
    plant, _, rest = text.partition("[plant]")[2].partition("[reference]")
    assert plant
    (tmp_path / "s.toml").write_text(text.partition("[plant]")[0] + "[reference]" + rest)
    if fits:
        open_scenario(file)
        return
    with pytest.raises(InputError, match=r"must be above 0\.17.* \(input bounds less 10 and 0 per mil"):
        open_scenario(file)
