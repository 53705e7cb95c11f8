"""What is counted of stacked runs whose trains have units, beside what ``count`` counts of trains: couplers, forces, energies."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from trainctl.ensemble.count import NOT_FINITE, Counts
from trainctl.ensemble.stack import Stack
from trainctl.kernels import bare
from trainctl.loop import ASTRAY
from trainctl.metrics.driving import ELECTRIC_BRAKE_FROM_MPS, JOULES_PER_KWH
from trainctl.metrics.run import SLACK
from trainctl.monitors import energy
from trainctl.monitors.on_track import ROUNDING
from trainctl.runs.known import Range, facts_of
from trainctl.runs.schema import GREATEST
from trainctl.signals import POSITION, POWERS, SPEED, Bools, Consists, Extremes, Floats, Ints, Row, Scene

#: Rows of ``Tally.low`` and ``Tally.high``.
COUPLER, COUPLER_FORCE, FORCE = range(3)

#: Columns of ``Extremes.energy``.
TRACTION, BRAKING = POWERS.index("traction"), POWERS.index("braking")


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


class Kept(NamedTuple):
    """Bounds that the tally goes by."""

    run: Ints  # (U,) of every unit
    limits: Range  # m, coupler bounds of the scenario
    known: Range  # m, the same as metrics have them
    constrained: Floats  # (lower and upper, N, q) bounds of what the law constrains


class Watched(NamedTuple):
    """What does not change, and what the tally goes by."""

    kept: Kept
    balance: energy.Balance
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
    run, balance = np.repeat(np.arange(len(stack.runs)), units // len(stack.runs)), energy.Balance(p)
    kept = Kept(run, limits, known.coupler_m, np.stack(p.law.watched_bounds(p.params, scene)) if names else free)
    return Watched(kept, balance, names), Tally(
        np.full((3, units), np.inf), np.full((3, units), -np.inf), np.full((2, units), -np.inf), free[::-1].copy(),
        np.zeros((3, n)), np.zeros((2, units), bool), np.zeros((2, n, len(names)), bool), np.zeros(n, bool), balance.initial(),
    )  # fmt: skip


def count(stack: Stack, fixed: Watched, row: Row, tally: Tally, counts: Counts) -> None:
    """Count an instant; of one that is not recorded ``row.extremes`` is None, and only the energies go on."""
    tally.balance[[i for i, _ in fixed.balance.violated(row, tally.energies)]] = True
    if row.extremes is not None:
        force = np.full(len(row.own), np.nan) if row.motion is None or row.motion.force is None else row.motion.force
        _count(stack.model.consists, fixed.kept, row.time, row.own, force, row.extremes, tally, counts.first, counts.fate)


@bare(error_model="numpy")
def _count(
    consists: Consists, kept: Kept, t: float, own: Floats, force: Floats, x: Extremes, tally: Tally, late: Floats, fate: Ints
) -> None:  # fmt: skip
    """Count what is recorded, as ``record.columns.UNITS`` has it. ``force`` (U,) [N] is NaN at the end; ``late``: ``Counts.first``.

    What is NaN widens nothing, and what was never seen is infinite the other way round.
    """
    low, high, first = tally.low, tally.high, consists.first
    for i in range(len(first) - 1):
        for u in range(first[i], first[i + 1]):
            f, v = force[u], own[u, SPEED]
            _widen(low, high, FORCE, u, f, f)
            _widen(low, high, FORCE, u, x.force_min[u], x.force_max[u])
            if f == f:
                tally.power[0, u] = max(tally.power[0, u], f * v if f > 0.0 else 0.0)
                tally.power[1, u] = max(tally.power[1, u], -(f * v) if f < 0.0 else 0.0)
            if u + 1 < first[i + 1]:
                stretch, rate = own[u, POSITION] - own[u + 1, POSITION] - consists.length[u], v - own[u + 1, SPEED]
                pull = consists.stiffness[u] * stretch + consists.damping[u] * rate
                least, most = min(x.coupler_min[u], stretch), max(x.coupler_max[u], stretch)
                _widen(low, high, COUPLER, u, least, most)
                _widen(low, high, COUPLER_FORCE, u, pull, pull)
                if least - kept.known[0] < -SLACK or kept.known[1] - most < -SLACK:
                    late[kept.run[u]] = min(late[kept.run[u]], t) if late[kept.run[u]] == late[kept.run[u]] else t
                tally.couplers[0, u] |= x.coupler_min[u] < kept.limits[0]
                tally.couplers[1, u] |= x.coupler_max[u] > kept.limits[1]
        tally.work[0, i] += x.energy[i, TRACTION]
        tally.work[1, i] += x.energy[i, BRAKING]
        if own[first[i], SPEED] > ELECTRIC_BRAKE_FROM_MPS:
            tally.work[2, i] += x.energy[i, BRAKING]
        for p in range(x.energy.shape[1]):
            if not abs(x.energy[i, p]) <= GREATEST:
                fate[kept.run[first[i]]] = NOT_FINITE
        for q in range(x.watched.shape[1]):
            least, most = x.watched_min[i, q], x.watched_max[i, q]
            tally.watched[0, i, q], tally.watched[1, i, q] = min(tally.watched[0, i, q], least), max(tally.watched[1, i, q], most)
            if least <= most:
                tally.constrained[0, i, q] |= least < kept.constrained[0, i, q] - ROUNDING
                tally.constrained[1, i, q] |= most > kept.constrained[1, i, q] + ROUNDING


@bare(inline="always")
def _widen(low, high, k, u, least, most):  # type: ignore[no-untyped-def]
    """Let row ``k`` of ``low`` and ``high`` enclose what lies from ``least`` to ``most`` at unit ``u``."""
    if least < low[k, u]:
        low[k, u] = least
    if most > high[k, u]:
        high[k, u] = most


def check(fixed: Watched, own: Floats, estimate: Floats, counts: Counts) -> None:
    """Mark runs with numbers that are none of a run, see ``runs.schema``, or whose observers have diverged."""
    wild = ~(np.abs(own) <= GREATEST).all(axis=1)
    wild |= ~(np.abs(estimate) < ASTRAY).all(axis=1)
    counts.fate[fixed.kept.run[wild]] = NOT_FINITE


def check_extremes(stack: Stack, fixed: Watched, tally: Tally, counts: Counts) -> None:
    """Mark runs whose extremes are none of a run; what was never seen is infinite."""
    run, train = fixed.kept.run, fixed.kept.run[stack.model.leading]
    for least, most, of in ((tally.low, tally.high, run), (tally.watched[0].T, tally.watched[1].T, train)):
        beyond = (least <= most) & ((np.abs(least) > GREATEST) | (np.abs(most) > GREATEST))
        counts.fate[of[beyond.any(axis=0)]] = NOT_FINITE


def violations(fixed: Watched, tally: Tally, runs: int) -> Ints:
    """Bounds that were violated, each once per coupler or train that did."""
    found = np.zeros(runs, np.int64)
    for side in range(2):
        found += np.bincount(fixed.kept.run[tally.couplers[side]], minlength=runs)
        found += tally.constrained[side].reshape(runs, -1).sum(axis=1)
    found += tally.balance.reshape(runs, -1).sum(axis=1)
    return found


def margins(fixed: Watched, tally: Tally) -> dict[str, tuple[Floats, Ints]]:
    """Minimum margins of every coupler to its bounds, and the run of each; see ``metrics.run.of_bounds``."""
    with np.errstate(invalid="ignore"):
        return {
            "coupler_lower_margin_m": (tally.low[COUPLER] - fixed.kept.known[0], fixed.kept.run),
            "coupler_upper_margin_m": (fixed.kept.known[1] - tally.high[COUPLER], fixed.kept.run),
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
