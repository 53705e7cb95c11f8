"""The constant time gap: how it follows from the spacing, what old and missing messages do, what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from strings import LENGTH_M, String, first_brakes, scene

from trainctl.controllers import ahead
from trainctl.controllers import time_headway as law

AT_60 = law.Params(standstill_m=20.0)


def test_the_time_gap_follows_from_the_spacing_and_the_other_way_round() -> None:
    sc = scene(3, 420.0)
    np.testing.assert_allclose(law.constants(AT_60, sc).h[1:], (420.0 - LENGTH_M - 20.0) / 40.0)
    np.testing.assert_allclose(law.constants(law.Params(time_gap_s=4.0), sc).r[1:], 420.0 - 160.0)
    assert law.report(AT_60, sc, ()) == ["time gap 5 s, spacing at standstill 220 m (on-board sensors)"]


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_at_another_speed_the_gap_in_time_is_kept(share: float) -> None:
    """Behind a first train that runs at 25 instead of 40 m/s."""
    string = String(law, AT_60.model_copy(update={"acceleration_share": share}), scene(3, 420.0))
    for _ in range(600):
        string.step(np.array([0.1 * (25.0 - string.own[0, 1]), np.nan, np.nan]))
    np.testing.assert_allclose(string.spacing, LENGTH_M + 20.0 + 5.0 * 25.0, atol=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.8])
def test_behind_a_first_train_that_stops_all_stop_at_the_gap_of_standstill(share: float) -> None:
    string = String(law, AT_60.model_copy(update={"acceleration_share": share}), scene(4, 420.0))
    least = string.spacing
    for _ in range(400):
        string.step(first_brakes(4, 0.5))
        least = np.minimum(least, string.spacing)
    assert np.all(least > LENGTH_M)
    np.testing.assert_allclose(string.own[:, 1], 0.0, atol=1e-3)
    # Nobody drives back: with the acceleration of a train that has stopped they come some metres nearer.
    assert np.all((string.spacing > LENGTH_M + 14.0) & (string.spacing < LENGTH_M + 20.05))


def test_an_old_message_is_carried_forward() -> None:
    """The train ahead braked with 0.5 m/s2 when it was last heard, 4 s ago: its spacing now is that of one that brakes on."""
    sc = scene(2, 420.0)
    who, sent = ahead.followed(sc), np.zeros((2, 6))
    sent[:] = [-10.0, 36.0, -0.5, 1000.0, 0.8, 1.0]
    now = np.array([1160.0, 40.0, 0.0, 0.0])  # the reference ran 160 m, 4 s
    own = String(law, AT_60, sc)
    own.own[:, 0] = [0.0, 500.0]
    seen = ahead.seen(who, law.Trains(own.own[:, 0], own.own[:, 1], np.zeros(2)), now, sc.links, sent)
    assert seen.spacing[1] == pytest.approx(1000.0 - 10.0 + 36.0 * 4.0 - 0.25 * 16.0 - 500.0)
    assert seen.speed[1] == pytest.approx(34.0) and seen.acceleration[1] == -0.5
    sent[:, ahead.SAID_SPEED] = 1.0  # it stands after 2 s, and goes no farther
    seen = ahead.seen(who, law.Trains(own.own[:, 0], own.own[:, 1], np.zeros(2)), now, sc.links, sent)
    assert seen.spacing[1] == pytest.approx(1000.0 - 10.0 + 1.0 - 500.0)
    assert seen.speed[1] == 0.0 == seen.acceleration[1]


def test_who_has_not_heard_of_the_train_ahead_does_not_accelerate() -> None:
    sc = scene(2, 420.0)
    string = String(law, AT_60, sc)
    string.own[:, 1] = 35.0  # slower than the reference: both would like to accelerate
    asked = string.step(arrives=False).acceleration
    assert asked[0] > 0.0 and asked[1] == 0.0


def test_of_several_trains_ahead_the_nearest_is_followed() -> None:
    """Train 3 hears 1 and 2: only 2 counts."""
    sc = scene(3, 420.0)
    rows = [(1, 0), (0, 1), (2, 1), (0, 2), (1, 2)]
    sender, receiver = (np.array(column) for column in zip(*rows, strict=True))
    slot, m = sc.links.slot, len(rows)
    links = sc.links._replace(
        sender=sender, receiver=receiver, first=np.array([0, 1, 3, 5]), desired=slot[sender] - slot[receiver],
        lower=np.full(m, -np.inf), upper=np.full(m, np.inf), weight=np.ones(m), heard=np.ones(m, bool),
    )  # fmt: skip
    who = ahead.followed(sc._replace(links=links))
    assert who.follows.tolist() == [False, True, True]
    assert sender[who.row[1:]].tolist() == [0, 1]


def test_what_is_refused() -> None:
    with pytest.raises(ValidationError):
        law.Params(time_gap_s=0.0)
    with pytest.raises(ValidationError):
        law.Params(acceleration_share=1.0)
    assert law.violations(AT_60, scene(2, 420.0)) == []
    assert law.violations(AT_60, scene(2, 220.0)) == [
        "link[1,2].desired_m = 220: leaves a time gap of 0 s; must be above 220, the train ahead and standstill_m"
    ]
    assert law.violations(law.Params(time_gap_s=6.0), scene(2, 420.0)) == [
        "controller.time_gap_s = 6: at standstill leaves a spacing of 180 m of the desired 420 m on link[1,2], and the train ahead is"
        " 200 m long"
    ]
    (unstable,) = law.violations(AT_60, scene(2, 232.0))
    assert "unstable with gain_per_s = 0.1 and a control period of 1 s" in unstable and "= 0.3:" in unstable


def test_a_time_gap_that_is_not_string_stable_is_a_warning() -> None:
    """The train's lag of 2 s and half a control period make 5 s; with the acceleration of the train ahead less."""
    slow = scene(3, 400.0, rate=0.5)  # a time gap of 4.5 s
    (line,) = law.warnings(AT_60, slow)
    assert "is 4.5 s" in line and "at least 5 s" in line
    assert law.warnings(law.Params(acceleration_share=0.5), slow) == []
    assert law.warnings(AT_60, scene(3, 421.0, rate=0.5)) == []
