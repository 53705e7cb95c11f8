"""Observer, law, limits and plant advanced together: one Runge-Kutta stage is one evaluation of the whole closed loop.

Forces held for 0.1 s make unit-level laws diverge, so everything is integrated jointly in sub-steps of 5 to 10 ms inside
each simulator step, and only the displacement leaves.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import njit, types, typeof

from trainctl.signals import POWERS, SPEED, Consists, Floats, Links, Reference, leader_at


class Loop(NamedTuple):
    """Constants of the three parts."""

    law: Any
    observer: Any
    plant: Any


class Air(NamedTuple):
    """Messages between trains."""

    heard: Floats  # (L, w) what each link brought
    live: bool  # True: neighbours' data are those of this very instant (the papers); False: ``heard`` is held
    chain: bool  # a message depends on its sender's demand: front to rear, message after demand
    sent_at: float  # s, when ``heard`` was sent, if held


class Extremes(NamedTuple):
    """Over the sub-steps since they were last reset: a once-a-second sample hides peaks."""

    coupler_min: Floats  # (U,) m
    coupler_max: Floats
    force_min: Floats  # (U,) N
    force_max: Floats
    watched_min: Floats  # (n, q) the law's constrained quantities
    watched_max: Floats
    limited: Floats  # (n,) s, time during which a unit limit acted
    energy: Floats  # (n, 6) J, see signals.POWERS

    @classmethod
    def fresh(cls, trains: int, units: int, watched: int) -> Extremes:
        """Nothing seen yet."""
        low, high = np.full(units, np.inf), np.full(units, -np.inf)
        return cls(
            low, high, low.copy(), high.copy(), np.full((trains, watched), np.inf), np.full((trains, watched), -np.inf),
            np.zeros(trains), np.zeros((trains, len(POWERS))),
        )  # fmt: skip


class Scratch(NamedTuple):
    """Work space of one stage."""

    leader: Floats  # (4,)
    correction: Floats  # (U, c)
    applied: Floats  # (U,)
    own_rate: Floats  # (U, s)
    estimate_rate: Floats  # (U, q)
    power: Floats  # (n, 6)
    sent: Floats  # (n, w)
    limited: Floats  # (n,)


def scratch(own: Floats, estimate: Floats, trains: int, corrections: int, message: int) -> Scratch:
    """Work space for these shapes."""
    units = len(own)
    return Scratch(
        np.zeros(4), np.zeros((units, corrections)), np.zeros(units), np.zeros_like(own), np.zeros_like(estimate),
        np.zeros((trains, len(POWERS))), np.zeros((trains, message)), np.zeros(trains),
    )  # fmt: skip


@njit(cache=True)
def stage(parts, loop, first, links, reference, air, t, inside, own, estimate, work):  # type: ignore[no-untyped-def]
    """Evaluate the closed loop at one instant: fills ``work`` with forces and rates."""
    demand, message, _, correction, estimate_rate, limit, rate = parts
    observed = estimate.shape[1] > 0
    leader_at(reference, t, inside, work.leader)
    age = 0.0 if air.live else t - air.sent_at
    for i in range(len(first) - 1):
        a, b = first[i], first[i + 1]
        if observed:
            correction(i, loop.observer, own[a:b], estimate[a:b], work.correction[a:b])
        if air.live and not air.chain:
            message(i, loop.law, work.leader, links.slot[i], own[a:b], estimate[a:b], work.estimate_rate[a:b], work.sent[i])
    for i in links.order:
        a, b = first[i], first[i + 1]
        e, f = links.first[i], links.first[i + 1]
        if air.live:
            for k in range(e, f):
                for q in range(air.heard.shape[1]):
                    air.heard[k, q] = work.sent[links.sender[k], q]
        demand(
            i, loop.law, work.leader, age, links.slot[i], own[a:b], estimate[a:b], work.correction[a:b],
            links.desired[e:f], air.heard[e:f], work.applied[a:b],
        )  # fmt: skip
        work.limited[i] = 1.0 if limit(i, loop.plant, own[a:b], work.applied[a:b]) else 0.0
        if observed:
            estimate_rate(
                i, loop.observer, own[a:b], estimate[a:b], work.correction[a:b], work.applied[a:b], work.estimate_rate[a:b]
            )  # fmt: skip
        if air.live and air.chain:
            message(i, loop.law, work.leader, links.slot[i], own[a:b], estimate[a:b], work.estimate_rate[a:b], work.sent[i])
        rate(i, loop.plant, t, inside, own[a:b], work.applied[a:b], work.own_rate[a:b], work.power[i])


@njit(cache=True)
def exchange(parts, loop, first, links, reference, air, t, own, estimate, work):  # type: ignore[no-untyped-def]
    """Fill ``work.sent`` with what every train sends at ``t``, each from what it had heard until then."""
    message = parts[1]
    stage(parts, loop, first, links, reference, air, t, t, own, estimate, work)
    for i in range(len(first) - 1):
        a, b = first[i], first[i + 1]
        message(i, loop.law, work.leader, links.slot[i], own[a:b], estimate[a:b], work.estimate_rate[a:b], work.sent[i])


@njit(cache=True)
def see(parts, loop, first, length, links, own, work, watched, extremes):  # type: ignore[no-untyped-def]
    """Widen ``extremes`` by the state and the forces of this instant."""
    watch = parts[2]
    for i in range(len(first) - 1):
        a, b = first[i], first[i + 1]
        for u in range(a, b):
            extremes.force_min[u] = min(extremes.force_min[u], work.applied[u])
            extremes.force_max[u] = max(extremes.force_max[u], work.applied[u])
            if u + 1 < b:
                stretch = own[u, 0] - own[u + 1, 0] - length[u]
                extremes.coupler_min[u] = min(extremes.coupler_min[u], stretch)
                extremes.coupler_max[u] = max(extremes.coupler_max[u], stretch)
        watch(i, loop.law, work.leader, first, own, links, watched)
        for q in range(len(watched)):
            extremes.watched_min[i, q] = min(extremes.watched_min[i, q], watched[q])
            extremes.watched_max[i, q] = max(extremes.watched_max[i, q], watched[q])


@njit(cache=True, inline="always")
def along(out, base, factor, direction):  # type: ignore[no-untyped-def]
    """``out = base + factor * direction`` for tables, without temporaries."""
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] = base[r, c] + factor * direction[r, c]


@njit(cache=True, inline="always")
def copy(out, table):  # type: ignore[no-untyped-def]
    """``out = table``."""
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] = table[r, c]


@njit(cache=True)
def advance(parts, loop, first, length, links, reference, air, t, h, n, breaks, own, estimate, work, extremes):  # type: ignore[no-untyped-def]
    """Integrate ``own`` and ``estimate`` in place over ``n`` classic Runge-Kutta steps of ``h`` seconds from ``t``.

    Steps are split at ``breaks`` (ascending times where the reference or a fault jumps): across a jump the order of the
    integrator is lost. Returns the forces applied at ``t``, shape (U,).
    """
    own0, estimate0 = own.copy(), estimate.copy()
    own_sum, estimate_sum = np.zeros_like(own), np.zeros_like(estimate)
    applied0 = np.zeros_like(work.applied)
    watched = np.zeros(extremes.watched_min.shape[1])
    for k in range(n):
        begin, end = t + k * h, t + (k + 1) * h
        while begin < end:
            stop = end
            for b in breaks:
                if begin + 1e-9 < b < end - 1e-9:
                    stop = b
                    break
            dt = stop - begin
            copy(own0, own)
            copy(estimate0, estimate)
            for s in range(4):
                ahead = 0.0 if s == 0 else (dt if s == 3 else 0.5 * dt)
                if s > 0:
                    along(own, own0, ahead, work.own_rate)
                    along(estimate, estimate0, ahead, work.estimate_rate)
                stage(parts, loop, first, links, reference, air, begin + ahead, begin + 0.5 * dt, own, estimate, work)
                if s == 0:
                    see(parts, loop, first, length, links, own, work, watched, extremes)
                    for i in range(len(work.limited)):
                        extremes.limited[i] += dt * work.limited[i]
                    if k == 0 and begin == t:
                        for u in range(len(applied0)):
                            applied0[u] = work.applied[u]
                    copy(own_sum, work.own_rate)
                    copy(estimate_sum, work.estimate_rate)
                else:
                    along(own_sum, own_sum, 2.0 if s < 3 else 1.0, work.own_rate)
                    along(estimate_sum, estimate_sum, 2.0 if s < 3 else 1.0, work.estimate_rate)
                along(extremes.energy, extremes.energy, (dt if s in (0, 3) else 2.0 * dt) / 6.0, work.power)
            along(own, own0, dt / 6.0, own_sum)
            along(estimate, estimate0, dt / 6.0, estimate_sum)
            begin = stop
    return applied0


def compiled(law: Any, observer: Any, plant: Any, arguments: tuple[Any, ...]) -> tuple[Callable[..., None], ...]:
    """The seven functions of the closed loop, compiled for these arguments of ``stage`` (after ``parts``), ready to hand over.

    A jitted function passed as an argument makes numba compile its caller in every process, unless its type is spelled out
    as a function type: so that is done here, and the caches of ``advance`` and ``exchange`` serve.
    """
    functions = (law.demand, law.message, law.watch, observer.correction, observer.rate, plant.limit, plant.rate)
    if numba.config.DISABLE_JIT:
        return functions
    loop, first, length, links, reference, air, _, _, _, breaks, own, estimate, work, extremes = arguments
    whole, real, row, table = types.int64, types.float64, types.float64[::1], types.float64[:, ::1]
    law_c, observer_c, plant_c = (typeof(c) for c in loop)
    signatures = (
        types.void(whole, law_c, row, real, real, table, table, table, row, table, row),
        types.void(whole, law_c, row, real, table, table, table, row),
        types.void(whole, law_c, row, typeof(first), table, typeof(links), row),
        types.void(whole, observer_c, table, table, table),
        types.void(whole, observer_c, table, table, table, row, table),
        types.boolean(whole, plant_c, table, row),
        types.void(whole, plant_c, real, real, table, row, table, row),
    )
    parts = types.Tuple([types.FunctionType(s) for s in signatures])
    rest = [typeof(x) for x in (links, reference, air)]
    state = [typeof(x) for x in (own, estimate, work)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", numba.NumbaExperimentalFeatureWarning)  # function types: tested here, kept
        for function, signature in zip(functions, signatures, strict=True):
            function.compile(signature)
        for dispatcher, signature in (
            (advance, (parts, typeof(loop), typeof(first), row, *rest, real, real, whole, row, *state, typeof(extremes))),
            (exchange, (parts, typeof(loop), typeof(first), *rest, real, *state)),
        ):
            dispatcher.disable_compile(False)
            dispatcher.compile(signature)
            dispatcher.disable_compile()  # otherwise a call would compile once more, for these very functions
    return functions
