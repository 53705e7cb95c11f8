"""String stability of the constant time gap: the law as it is agrees with the known condition, time gap against actuator lag.

``h >= 2 tau / (1 + k_a)``: of Rajamani for k_a = 0, of Darbha, Konduri, Pagilla with the acceleration of the train ahead.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strings import LENGTH_M, scene

from trainctl.controllers import ahead
from trainctl.controllers import time_headway as law
from trainctl.signals import Floats, Trains

SPEED = 40.0
FREE = {"acceleration_mps2": 1e9, "deceleration_mps2": 1e9, "faster_mps": 1e9}


def params(h: float, gain: float, share: float) -> tuple[law.Params, float]:
    """Gains, and the spacing that goes with them."""
    return law.Params(time_gap_s=h, gain_per_s=gain, acceleration_share=share, **FREE), LENGTH_M + 1.0 + h * SPEED


def asked(p: law.Params, spacing: float, moved: dict[str, float]) -> float:
    """What the second train asks for, with its place, its speed, or what it hears of the first one off by ``moved``."""
    sc = scene(2, spacing, SPEED)
    sc = sc._replace(bounds=sc.bounds._replace(speed_upper=np.full(2, np.inf)))
    constants, memory, leader = law.constants(p, sc), law.initial(p, sc), np.array([0.0, SPEED, 0.0, 0.0])
    own = sc.own.copy()
    own[1] += [moved.get("x", 0.0), moved.get("v", 0.0)]
    trains = Trains(own[:, 0].copy(), own[:, 1].copy(), np.zeros(2))
    heard = np.ascontiguousarray(law.message(constants, trains, leader, memory)[sc.links.sender])
    row = int(constants.who.row[1])
    for column, name in ((ahead.PLACE, "x_l"), (ahead.SAID_SPEED, "v_l"), (ahead.SAID_ACCELERATION, "a_l")):
        heard[row, column] += moved.get(name, 0.0)
    return float(law.demand(constants, trains, leader, sc.links, heard, memory)[0].acceleration[1])


def gain_over(p: law.Params, spacing: float, lag: float, frequencies: Floats) -> Floats:
    """|speed of the second train / speed of the first| at these frequencies [rad/s], for ``tau a' = u - a``.

    The law's own derivatives, taken from ``demand``: it is linear.
    """
    still = asked(p, spacing, {})
    assert still == pytest.approx(0.0, abs=1e-9)
    du = {name: asked(p, spacing, {name: 1.0}) - still for name in ("x", "v", "x_l", "v_l", "a_l")}
    s = 1j * frequencies
    to = (du["x_l"] + du["v_l"] * s + du["a_l"] * s**2) / (lag * s**3 + s**2 - du["v"] * s - du["x"])
    return np.abs(to)


@settings(max_examples=60)
@given(
    lag=st.floats(0.1, 3.0), share=st.floats(0.0, 0.9), gain=st.floats(0.03, 0.5),
    ratio=st.one_of(st.floats(0.6, 0.97), st.floats(1.03, 3.0)),
)  # fmt: skip
def test_disturbances_grow_just_where_the_time_gap_is_below_the_known_one(lag, share, gain, ratio) -> None:
    h = ratio * law.minimum_gap(lag, share)
    p, spacing = params(h, gain, share)
    highest = gain_over(p, spacing, lag, np.geomspace(1e-3, 30.0 / lag, 6000)).max()
    if ratio < 1.0:
        assert highest > 1.0 + 1e-9
    else:
        assert highest <= 1.0 + 1e-9


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("ratio", [0.7, 1.2])
def test_a_string_of_trains_does_what_the_transfer_function_says(share: float, ratio: float) -> None:
    """Ten trains, the first with a speed that swings at the worst frequency: the last swings more, or less."""
    lag, gain, step, n = 1.0, 0.2, 0.02, 10
    p, spacing = params(ratio * law.minimum_gap(lag, share), gain, share)
    frequencies = np.geomspace(0.02, 5.0, 2000)
    worst = float(frequencies[np.argmax(gain_over(p, spacing, lag, frequencies))]) if ratio < 1.0 else 0.5
    sc = scene(n, spacing, SPEED, step)
    sc = sc._replace(bounds=sc.bounds._replace(speed_upper=np.full(n, np.inf)))
    constants, memory = law.constants(p, sc), law.initial(p, sc)
    x, v, a = sc.own[:, 0].copy(), sc.own[:, 1].copy(), np.zeros(n)
    steps = int(40.0 * 2.0 * np.pi / worst / step) if ratio < 1.0 else 12000
    swing = np.zeros(n)
    for k in range(steps):
        trains, leader = Trains(x.copy(), v.copy(), np.zeros(n)), np.array([SPEED * k * step, SPEED, 0.0, 0.0])
        heard = law.message(constants, trains, leader, memory)[sc.links.sender]
        demanded, memory = law.demand(constants, trains, leader, sc.links, heard, memory)
        a += step / lag * (demanded.acceleration - a)
        a[0] = worst * np.cos(worst * k * step)
        v = v + step * a
        x = x + step * (v - 0.5 * step * a)
        if k > 0.8 * steps:
            swing = np.maximum(swing, np.abs(v - SPEED))
    assert (swing[-1] > swing[1]) == (ratio < 1.0), swing
