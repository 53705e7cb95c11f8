"""Metrics of stacked runs: what ``metrics`` computes from the tables of one run, from ``count.Counts`` of many.

Every function gives one array per metric, a number per run; NaN where a run does not have it. Names and rules are those of
``metrics.run.DEFINITIONS``. Extremes, times and counts are the same to the last bit, sums to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from trainctl.ensemble import count, units
from trainctl.ensemble.count import Counts, Fixed, Pairs
from trainctl.ensemble.stack import Stack, restarts
from trainctl.metrics.driving import JOULES_PER_KWH
from trainctl.metrics.run import SLACK, nearest
from trainctl.runs.series import INSTANT, pairs
from trainctl.scenario.model import Model
from trainctl.signals import Bounds, Floats, Ints

Columns = dict[str, Floats]

#: Band of the spacings around what is desired, within which they have settled [m].
BAND_M = 1.0

#: Bounds of trains as the scenario has them, in the order of ``Bounds``, and what they are where none is stated.
KNOWN = {"speed_lower_mps": -np.inf, "speed_upper_mps": np.inf, "input_lower_mps2": -np.inf, "input_upper_mps2": np.inf}


class Recorded(NamedTuple):
    """What is kept of every recorded instant, K of them."""

    times: Floats  # (K,) s
    position: Floats  # (K, N) m


class Chained(NamedTuple):
    """Links along a formation, C of them: a link and the one ahead of it, as rows of ``Pairs``."""

    front: Ints  # (C,)
    back: Ints  # (C,)


def fixed(stack: Stack) -> tuple[Fixed, Chained]:
    """What does not change while the runs of a stack go on."""
    p, n = stack.model, stack.trains
    run = np.repeat(np.arange(len(stack.runs)), n)
    listed, chained = _pairs(stack)
    mass = np.add.reduceat(p.consists.mass, p.leading)
    found = Fixed(
        run, stack.formed.ahead, p.consists.train_length(), np.where(np.isnan(mass), 1000.0, mass), _known(stack.runs), p.bounds,
        stack.links, listed, BAND_M,
    )  # fmt: skip
    return found, chained


def _known(runs: tuple[Model, ...]) -> Bounds:
    """Bounds of every train as its resolved scenario states them, which is what metrics go by."""

    def of(p: Model) -> Floats:
        found = [
            [usual if value is None else value for value in (getattr(t, key) for t in p.scenario.train)]
            for key, missing in KNOWN.items()
            for usual in [missing if getattr(p.scenario.bounds, key) is None else getattr(p.scenario.bounds, key)]
        ]  # fmt: skip
        return np.array(found)

    first = of(runs[0])
    return Bounds(*np.concatenate([first if restarts(p, runs[0]) else of(p) for p in runs], axis=1))


def _pairs(stack: Stack) -> tuple[Pairs, Chained]:
    """The pairs of all runs; those of runs with the same links are found once."""
    n, links, known = stack.trains, stack.links, dict[bytes, tuple[Floats, Ints]]()
    run = links.receiver // n
    table = np.column_stack([links.sender - run * n, links.receiver - run * n, links.desired, links.lower, links.upper])
    each = []
    for p, rows in zip(stack.runs, np.split(table, links.first[n:-1:n]), strict=True):
        if (key := rows.tobytes()) not in known:
            known[key] = _listed(p.scenario.ids, rows.T)
        each.append(known[key])
    count = np.array([len(found) for found, _ in each])
    listed, of = np.concatenate([found for found, _ in each]), np.repeat(np.arange(len(each)), count)
    begins = np.repeat(np.cumsum(count) - count, [len(chain) for _, chain in each])
    chains = np.concatenate([chain for _, chain in each]) + begins[:, None]
    ahead, behind = (listed[:, k].astype(np.int64) + of * n for k in (0, 1))
    desired, lower, upper = (listed[:, k].copy() for k in (2, 3, 4))
    return Pairs(ahead, behind, desired, lower, upper, of), Chained(chains[:, 0].copy(), chains[:, 1].copy())


def _listed(ids: tuple[str, ...], table: Floats) -> tuple[Floats, Ints]:
    """Pairs (Q, 5) of one run, from its links (5, L) at one instant, and which of them follow each other (C, 2)."""
    sender, receiver, desired, lower, upper = table
    if not len(sender):
        return np.zeros((0, 5)), np.zeros((0, 2), np.int64)
    links = pa.table({
        "time_s": np.zeros(len(sender)), "spacing_m": desired, "desired_m": desired, "lower_m": lower, "upper_m": upper,
        "sender": [ids[i] for i in sender.astype(int).tolist()], "receiver": [ids[i] for i in receiver.astype(int).tolist()],
    })  # fmt: skip
    listed = pairs(links)
    place = {name: float(i) for i, name in enumerate(ids)}
    ends = np.array([(place[a], place[b]) for a, b in listed.ends]).reshape(-1, 2)
    number = {name: q for q, name in enumerate(listed.names)}
    chain = [(number[front], number[back]) for _, front, back in nearest(listed)]
    return np.column_stack([ends, *(listed.column(name) for name in ("desired_m", "lower_m", "upper_m"))]), np.array(
        chain, np.int64
    ).reshape(-1, 2)


def metrics(
    stack: Stack, fixed: Fixed, chained: Chained, counts: Counts, recorded: Recorded,
    tallied: tuple[units.Watched, units.Tally] | None,
) -> Columns:  # fmt: skip
    """All metrics of all runs, those of single trains aside; see ``metrics.run.metrics``. ``tallied`` is of trains with units."""
    times, runs, n = recorded.times, len(stack.runs), stack.trains
    c = counts.train.reshape(runs, n, -1)
    kilometres = _sum(c[:, :, count.POSITION] - c[:, :, count.START]) / 1000
    return {
        "run.duration_s": np.full(runs, float(np.ptp(times))),
        "run.trains": np.full(runs, float(n)),
        "run.train_km": kilometres,
        **of_bounds(fixed, counts, runs, {} if tallied is None else units.margins(*tallied)),
        **of_formation(fixed, chained, counts, times, runs),
        "formation.final_speed_error_mps": c[:, :, count.SPEED_ERROR].max(axis=1),
        "formation.speed_overshoot_mps": c[:, :, count.OVERSHOOT].max(axis=1),
        "units.saturated_share": _sum(c[:, :, count.SATURATED]) / (n * len(times)),
        **(of_energy(stack, c, kilometres) if tallied is None else units.metrics(*tallied, kilometres, runs)),
        **of_comfort(c, times),
        **of_trains(stack, fixed, c, recorded),
    }


def _sum(number: Floats) -> Floats:
    """Sums over the trains (R, n) of every run, one after the other: they must not depend on how many runs there are."""
    found: Floats = np.add.accumulate(number, axis=1)[:, -1]
    return found


def _worst(number: Floats, of: Ints, runs: int, worse: np.ufunc) -> Floats:
    """The worst finite number of every run; NaN where it has none."""
    empty = np.inf if worse is np.minimum else -np.inf
    found = np.full(runs, empty)
    worse.at(found, of, np.where(np.isfinite(number), number, empty))
    return np.where(np.isfinite(found), found, np.nan)


def of_bounds(fixed: Fixed, counts: Counts, runs: int, more: Mapping[str, tuple[Floats, Ints]]) -> Columns:
    """As ``metrics.run.of_bounds``: a margin is smallest where the number itself is smallest or largest; ``more`` are couplers'."""
    c, q, known, pairs = counts.train, counts.pair, fixed.known, fixed.pairs
    with np.errstate(invalid="ignore"):
        margins = {
            "spacing_lower_margin_m": (q[:, count.LOWEST] - pairs.lower, pairs.run),
            "spacing_upper_margin_m": (pairs.upper - q[:, count.HIGHEST], pairs.run),
            "speed_lower_margin_mps": (c[:, count.SPEED_MIN] - known.speed_lower, fixed.run),
            "speed_upper_margin_mps": (known.speed_upper - c[:, count.SPEED_MAX], fixed.run),
            "input_lower_margin_mps2": (c[:, count.INPUT_MIN] - known.input_lower, fixed.run),
            "input_upper_margin_mps2": (known.input_upper - c[:, count.INPUT_MAX], fixed.run),
            **more,
        }
    found = {f"bounds.{name}": _worst(margin, of, runs, np.minimum) for name, (margin, of) in margins.items()}
    broken = np.sum([margin < -SLACK for margin in found.values()], axis=0)
    return {**found, "bounds.broken": broken.astype(float), "bounds.first_violation_s": counts.first}


def of_formation(fixed: Fixed, chained: Chained, counts: Counts, times: Floats, runs: int) -> Columns:
    """As ``metrics.run.of_formation`` and ``of_strings``, where the links stay as they are."""
    q, run = counts.pair, fixed.pairs.run
    if not len(run):
        return {}
    has = np.bincount(run, minlength=runs) > 0
    instants = np.round(times / INSTANT) * INSTANT
    after = np.minimum(counts.outside + 1, len(instants) - 1)
    settled = np.where(counts.outside < len(instants) - 1, instants[0] + (instants[after] - instants[0]), np.nan)
    found = {
        "formation.settling_s": np.where(has, settled, np.nan),
        "formation.last_link_s": np.where(has, instants[-1], np.nan),
        "formation.final_error_m": _worst(q[:, count.ERROR_LAST], run, runs, np.maximum),
        "formation.overshoot_m": _worst(q[:, count.ERROR_OVERSHOOT], run, runs, np.maximum),
    }
    norms = {"l2": np.sqrt(q[:, count.ERROR_SQUARES]), "peak": q[:, count.ERROR_MAX]}
    for name, norm in norms.items():
        front, back = norm[chained.front], norm[chained.back]
        grows = front > SLACK
        found[f"string.{name}_gain"] = _worst(
            np.where(grows, back / np.where(grows, front, 1.0), np.nan), run[chained.back], runs, np.maximum
        )
    return found


def of_energy(stack: Stack, c: Floats, kilometres: Floats) -> Columns:
    """As ``metrics.driving.of_energy`` for trains without units."""
    spent, braking, back = (_sum(c[:, :, k]) / JOULES_PER_KWH for k in (count.TRACTION, count.BRAKING, count.ELECTRIC))
    if np.isnan(stack.model.consists.mass).any():
        return {"energy.traction_kwh_per_t": spent, "energy.braking_kwh_per_t": braking}
    moved = kilometres > 0.0
    per_km = np.where(moved, kilometres, np.nan)
    return {
        "energy.traction_kwh": spent, "energy.braking_kwh": braking, "energy.regenerable_kwh": back,
        "energy.net_kwh": spent - back, "energy.traction_kwh_per_train_km": spent / per_km,
        "energy.net_kwh_per_train_km": (spent - back) / per_km,
    }  # fmt: skip


def of_comfort(c: Floats, times: Floats) -> Columns:
    """As ``metrics.driving.of_comfort``."""
    if len(times) < 2:
        return {}
    found = {
        "comfort.acceleration_min_mps2": c[:, :, count.ACCELERATION_MIN].min(axis=1),
        "comfort.acceleration_max_mps2": c[:, :, count.ACCELERATION_MAX].max(axis=1),
    }
    if len(times) > 2:
        dt = np.diff(times)
        middle = 0.5 * (dt[1:] + dt[:-1])
        found["comfort.jerk_max_mps3"] = c[:, :, count.JERK_MAX].max(axis=1)
        found["comfort.jerk_rms_mps3"] = np.sqrt(_sum(c[:, :, count.JERK_SUM]) / (c.shape[1] * np.sum(middle)))
    return found


def of_trains(stack: Stack, fixed: Fixed, c: Floats, recorded: Recorded) -> Columns:
    """As ``metrics.traffic.of_trains``, without overlaps: runs with those are not counted here."""
    runs, n, rows = len(stack.runs), stack.trains, len(recorded.times)
    follows = (fixed.ahead >= 0).reshape(runs, n)
    spacing = np.where(follows, c[:, :, count.SPACING_MIN], np.nan)
    ahead = fixed.length[fixed.ahead].reshape(runs, n)
    followers = follows.sum(axis=1)
    headways = _sum(c[:, :, count.HEADWAYS])

    def least(number: Floats) -> Floats:
        return _worst(number.ravel(), fixed.run, runs, np.minimum)

    def mean(total: Floats, number: Floats) -> Floats:
        found: Floats = np.where(number > 0, total / np.maximum(number, 1), np.nan)
        return found

    return {
        "traffic.gap_min_m": least(spacing - ahead),
        "traffic.spacing_min_m": least(spacing),
        "traffic.headway_min_s": least(np.where(follows, c[:, :, count.HEADWAY_MIN], np.nan)),
        "traffic.spacing_mean_m": mean(_sum(c[:, :, count.SPACING_SUM]), (followers * rows).astype(float)),
        "traffic.headway_mean_s": mean(_sum(c[:, :, count.HEADWAY_SUM]), headways),
        "traffic.speed_mean_mps": _sum(c[:, :, count.SPEED_SUM]) / (n * rows),
        "traffic.speed_max_mps": c[:, :, count.SPEED_MAX].max(axis=1),
        **of_section(stack, recorded),
    }


def of_section(stack: Stack, recorded: Recorded) -> Columns:
    """As ``metrics.traffic.of_section``; positions never fall, so each train passes a place once."""
    runs, n, times = len(stack.runs), stack.trains, recorded.times
    position = recorded.position
    begin, end = position[0].reshape(runs, n), position[-1].reshape(runs, n)
    section = 0.5 * (begin.max(axis=1) + end.min(axis=1))
    place = np.repeat(section, n)
    low, high = np.zeros(runs * n, np.int64), np.full(runs * n, len(times) - 1)
    passes = (position[0] < place) & (position[-1] >= place)
    who = np.arange(runs * n)
    while np.any(high - low > 1):  # bisection for the last instant before the place, all trains at once
        middle = (low + high) // 2
        before = position[middle, who] < place
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    if len(times) > 1:
        here, there = position[low, who], position[high, who]
        with np.errstate(divide="ignore", invalid="ignore"):
            part = (place - here) / (there - here)
            passed = np.where(passes, times[low] + part * (times[high] - times[low]), np.nan).reshape(runs, n)
    else:
        passed = np.full((runs, n), np.nan)
    number = np.isfinite(passed).sum(axis=1)
    with np.errstate(all="ignore"):
        span = np.fmax.reduce(passed, axis=1) - np.fmin.reduce(passed, axis=1)
        rate = np.where((number > 1) & (span > 0), (number - 1) * 3600 / span, np.nan)
    tracks = stack.formed.formation.reshape(runs, n) - len(stack.model.line.track_ids) * np.arange(runs)[:, None]
    order = np.lexsort((passed, tracks), axis=1)
    by_time, on = np.take_along_axis(passed, order, 1), np.take_along_axis(tracks, order, 1)
    apart = np.where(on[:, 1:] == on[:, :-1], np.diff(by_time, axis=1), np.nan)
    shortest = np.fmin.reduce(apart, axis=1) if n > 1 else np.full(runs, np.nan)
    return {
        "traffic.section_m": section, "traffic.passages": number.astype(float), "traffic.trains_per_hour": rate,
        "traffic.passage_headway_min_s": shortest,
    }  # fmt: skip
