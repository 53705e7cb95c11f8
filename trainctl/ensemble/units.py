"""What is counted of stacked runs whose trains have units, beside what ``count`` counts of trains: couplers, forces, energies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.ensemble.count import NOT_FINITE, Counts
from trainctl.ensemble.stack import Stack
from trainctl.loop import ASTRAY
from trainctl.metrics.driving import ELECTRIC_BRAKE_FROM_MPS, JOULES_PER_KWH
from trainctl.metrics.run import SLACK
from trainctl.monitors import energy
from trainctl.monitors.on_track import ROUNDING
from trainctl.record import columns
from trainctl.record.columns import finite
from trainctl.runs.known import Range, facts_of
from trainctl.signals import POWERS, Bools, Extremes, Floats, Ints, Row, Scene

#: Rows of ``Tally.low`` and ``Tally.high``.
COUPLER, COUPLER_FORCE, FORCE = range(3)


class Tally(NamedTuple):
    """What was counted so far; overwritten in place."""

    low: Floats  # (3, U) minima
    high: Floats  # (3, U) maxima
    power: Floats  # (traction and braking, U) W
    watched: Floats  # (minima and maxima, N, q)
    work: Floats  # (traction, braking, regenerable; N) J
    couplers: Bools  # (lower and upper, U) a bound was violated
    constrained: Bools  # (lower and upper, N, q)
    balance: Bools  # (N,) energy came from nowhere
    energies: energy.State


class Watched(NamedTuple):
    """What does not change, and what the tally goes by."""

    run: Ints  # (U,) of every unit
    balance: energy.Balance
    limits: Range  # m, coupler bounds of the scenario
    known: Range  # m, the same as metrics have them
    constrained: Floats  # (lower and upper, N, q) bounds of what the law constrains
    names: tuple[str, ...]  # q


def watched(stack: Stack, scene: Scene) -> tuple[Watched, Tally]:
    """What is counted, and nothing counted yet; ``scene`` is that at the start."""
    p = stack.model
    n, units = len(scene.trains), len(p.own)
    names = tuple(getattr(p.law, "WATCHED", ())) if not p.sampled else ()
    free = np.stack([np.full((n, len(names)), -np.inf), np.full((n, len(names)), np.inf)])
    bounds, known = p.scenario.bounds, facts_of(stack.runs[0].scenario.model_dump(mode="json", exclude_none=True))
    stated = bounds.coupler_lower_m is not None and bounds.coupler_upper_m is not None
    limits = (float(bounds.coupler_lower_m or 0.0), float(bounds.coupler_upper_m or 0.0)) if stated else (-np.inf, np.inf)
    balance = energy.Balance(p)
    fixed = Watched(
        np.repeat(np.arange(len(stack.runs)), units // len(stack.runs)), balance, limits, known.coupler_m,
        np.stack(p.law.watched_bounds(p.params, scene)) if names else free, names,
    )  # fmt: skip
    return fixed, Tally(
        np.full((3, units), np.inf), np.full((3, units), -np.inf), np.full((2, units), -np.inf), free[::-1].copy(),
        np.zeros((3, n)), np.zeros((2, units), bool), np.zeros((2, n, len(names)), bool), np.zeros(n, bool), balance.initial(),
    )  # fmt: skip


def count(stack: Stack, fixed: Watched, row: Row, tally: Tally, counts: Counts) -> None:
    """Count an instant; of one that is not recorded ``row.extremes`` is None, and only the energies go on."""
    tally.balance[[i for i, _ in fixed.balance.violated(row, tally.energies)]] = True
    x = row.extremes
    if x is None:
        return
    seen = columns.units(columns.instant(row), stack.model.consists)
    now = {name: value(seen) for name, value in columns.UNITS.items()}
    for k, least, most, instant in (
        (COUPLER, now["coupler_min_m"], now["coupler_max_m"], now["coupler_m"]),
        (COUPLER_FORCE, now["coupler_force_n"], now["coupler_force_n"], now["coupler_force_n"]),
        (FORCE, now["force_min_n"], now["force_max_n"], now["force_n"]),
    ):
        lowest, highest = np.fmin(finite(least), finite(instant)), np.fmax(finite(most), finite(instant))
        np.fmin(tally.low[k], lowest, out=tally.low[k])
        np.fmax(tally.high[k], highest, out=tally.high[k])
        if k == COUPLER:
            hit = (lowest - fixed.known[0] < -SLACK) | (fixed.known[1] - highest < -SLACK)
            late = np.unique(fixed.run[hit])
            counts.first[late] = np.fmin(counts.first[late], row.time)
    force, power = now["force_n"], now["force_n"] * now["speed_mps"]
    for k, (acts, size) in enumerate(((force > 0, power), (force < 0, -power))):
        np.fmax(tally.power[k], np.where(acts, size, 0.0 * force), out=tally.power[k])
    _constrained(fixed, x, tally)
    tally.couplers[0] |= x.coupler_min < fixed.limits[0]
    tally.couplers[1] |= x.coupler_max > fixed.limits[1]
    traction, braking = (np.nan_to_num(x.energy[:, POWERS.index(name)]) for name in ("traction", "braking"))
    tally.work[0] += traction
    tally.work[1] += braking
    tally.work[2] += np.where(row.speed > ELECTRIC_BRAKE_FROM_MPS, braking, 0.0)


def _constrained(fixed: Watched, x: Extremes, tally: Tally) -> None:
    """What the law constrains."""
    np.fmin(tally.watched[0], finite(x.watched_min), out=tally.watched[0])
    np.fmax(tally.watched[1], finite(x.watched_max), out=tally.watched[1])
    seen = x.watched_min <= x.watched_max
    tally.constrained[0] |= seen & (x.watched_min < fixed.constrained[0] - ROUNDING)
    tally.constrained[1] |= seen & (x.watched_max > fixed.constrained[1] + ROUNDING)


def check(fixed: Watched, own: Floats, estimate: Floats, counts: Counts) -> None:
    """Mark runs whose numbers are no longer finite, or whose observers have diverged."""
    wild = ~np.isfinite(own).all(axis=1)
    wild |= ~(np.abs(estimate) < ASTRAY).all(axis=1)
    counts.fate[fixed.run[wild]] = NOT_FINITE


def violations(fixed: Watched, tally: Tally, runs: int) -> Ints:
    """Bounds that were violated, each once per coupler or train that did."""
    found = np.zeros(runs, np.int64)
    for side in range(2):
        found += np.bincount(fixed.run[tally.couplers[side]], minlength=runs)
        found += tally.constrained[side].reshape(runs, -1).sum(axis=1)
    found += tally.balance.reshape(runs, -1).sum(axis=1)
    return found


def margins(fixed: Watched, tally: Tally) -> dict[str, tuple[Floats, Ints]]:
    """Minimum margins of every coupler to its bounds, and the run of each; see ``metrics.run.of_bounds``."""
    with np.errstate(invalid="ignore"):
        return {
            "coupler_lower_margin_m": (tally.low[COUPLER] - fixed.known[0], fixed.run),
            "coupler_upper_margin_m": (fixed.known[1] - tally.high[COUPLER], fixed.run),
        }


def metrics(fixed: Watched, tally: Tally, kilometres: Floats, runs: int) -> dict[str, Floats]:
    """Metrics of couplers, forces, energies and of what the law constrains; see ``metrics.driving``."""

    def worst(number: Floats, worse: np.ufunc) -> Floats:
        empty = np.inf if worse is np.minimum else -np.inf
        found = worse.reduce(np.where(np.isfinite(number), number, empty).reshape(runs, -1), axis=1)
        return np.where(np.isfinite(found), found, np.nan)

    low, high = tally.low, tally.high
    with np.errstate(invalid="ignore"):
        stroke = high[COUPLER] - low[COUPLER]
    found = {
        "units.coupler_min_m": worst(low[COUPLER], np.minimum), "units.coupler_max_m": worst(high[COUPLER], np.maximum),
        "units.coupler_stroke_m": worst(stroke, np.maximum),
        "units.coupler_force_min_n": worst(low[COUPLER_FORCE], np.minimum),
        "units.coupler_force_max_n": worst(high[COUPLER_FORCE], np.maximum),
        "units.force_min_n": worst(low[FORCE], np.minimum), "units.force_max_n": worst(high[FORCE], np.maximum),
        "units.power_traction_max_w": worst(tally.power[0], np.maximum),
        "units.power_braking_max_w": worst(tally.power[1], np.maximum),
    }  # fmt: skip
    for q, name in enumerate(fixed.names):
        found[f"watched.{name}_min"] = worst(tally.watched[0, :, q], np.minimum)
        found[f"watched.{name}_max"] = worst(tally.watched[1, :, q], np.maximum)
    spent, braking, back = (
        np.add.accumulate(work.reshape(runs, -1), axis=1)[:, -1] / JOULES_PER_KWH for work in tally.work
    )  # fmt: skip
    per_km = np.where(kilometres > 0.0, kilometres, np.nan)
    return found | {
        "energy.traction_kwh": spent, "energy.braking_kwh": braking, "energy.regenerable_kwh": back, "energy.net_kwh": spent - back,
        "energy.traction_kwh_per_train_km": spent / per_km, "energy.net_kwh_per_train_km": (spent - back) / per_km,
    }  # fmt: skip
