r"""The tube round a reference curve: what lies in it is no difference.

Definition. A curve is a row of samples :math:`(t_i, y_i)` in ascending time, joined by straight lines. Round each sample lies the
rectangle :math:`R_i = [t_i - w_i, t_i + w_i] \times [y_i - h_i, y_i + h_i]` of its tolerances in time, w, and in value, h. The tube
is the union of the convex hulls of neighbouring rectangles: the rectangle swept along the curve. With constant w and h it is the
set of all points no farther than w and h from some point of the curve. A value is inside if lower(t) <= value <= upper(t), the ends
of the tube's cut at its time; before ``t_0 - w_0`` and after ``t_n + w_n`` there is no tube and nothing is inside.

So the tube follows a slope to the very end of the curve and goes on level for w; it is as narrow as was said, for however small a
signal. Samples farther apart than ``GAP_S`` are not joined: a train that was away comes back as another curve. A sample that is
no number breaks the curve; a value that is no number is inside if one of the reference's within w is none.

Algorithm. A value within h of the curve at its own time is inside: one interpolation. For the others the cut is computed from all
hulls that cover the time; the upper edge of a hull is the maximum of the lines through two of its four upper corners. Exact but
for rounding; the cost of a value outside is the number of samples within w.

The same tubes, by way of corners and removed loops, in pyfunnel [1]_; there values outside the reference's ends are no comparison.

.. [1] LBNL, pyfunnel, https://github.com/lbl-srg/funnel
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from trainctl.signals import Bools, Floats, Ints

#: Samples farther apart than this are not joined [s].
GAP_S = 600.0


@njit(cache=True)
def _edge(t: float, times: Floats, tops: Floats) -> float:
    """Upper edge of the hull of four corners at a time; -inf where there is none."""
    best = -math.inf
    for p in range(4):
        for q in range(4):
            if times[p] <= t <= times[q]:
                if times[p] == times[q]:
                    best = max(best, tops[p], tops[q])
                else:
                    share = (t - times[p]) / (times[q] - times[p])
                    best = max(best, tops[p] + share * (tops[q] - tops[p]))
    return best


@njit(cache=True)
def _cut(t: float, time: Floats, y: Floats, w: Floats, h: Floats, begin: int, end: int, gap: float) -> tuple[float, float]:
    """Lower and upper end of the tube's cut at a time, from the samples ``begin:end``; NaN, NaN where there is no tube."""
    lower, upper = math.inf, -math.inf
    corners, tops = np.empty(4), np.empty(4)
    for i in range(begin, end):
        if math.isnan(y[i]):
            continue
        j = i + 1
        if j >= end or math.isnan(y[j]) or time[j] - time[i] > gap:
            j = i
        corners[0], corners[1] = time[i] - w[i], time[i] + w[i]
        corners[2], corners[3] = time[j] - w[j], time[j] + w[j]
        tops[0] = tops[1] = y[i] + h[i]
        tops[2] = tops[3] = y[j] + h[j]
        upper = max(upper, _edge(t, corners, tops))
        tops[0] = tops[1] = -(y[i] - h[i])
        tops[2] = tops[3] = -(y[j] - h[j])
        lower = min(lower, -_edge(t, corners, tops))
    if upper == -math.inf:
        return math.nan, math.nan
    return lower, upper


@njit(cache=True)
def judged(
    first: Ints, count: Ints, time: Floats, y: Floats, w: Floats, h: Floats, curve: Ints, at: Floats, value: Floats, gap: float,
    inside: Bools, reference: Floats, lower: Floats, upper: Floats,
) -> None:  # fmt: skip
    """Judge values of many curves; fills the last four.

    Parameters
    ----------
    first, count : ndarray, shape (curves,)
        A curve's samples are ``first:first + count``.
    time, y, w, h : ndarray, shape (samples,)
        Samples of all curves, ascending in time within each, and their tolerances in time [s] and value. ``time + w`` and
        ``time - w`` ascend too.
    curve, at, value : ndarray, shape (values,)
        What is judged: number of its curve, time [s], value.
    gap : float
        Samples farther apart are not joined [s].
    inside : ndarray, shape (values,)
        Whether it lies in the tube.
    reference, lower, upper : ndarray, shape (values,)
        The curve at that time (its nearest sample where it is not), NaN if there is none; the tube's cut, of values outside.
    """
    for k in range(len(at)):
        begin = first[curve[k]]
        end = begin + count[curve[k]]
        t, v = at[k], value[k]
        inside[k], reference[k], lower[k], upper[k] = False, math.nan, math.nan, math.nan
        if begin == end:
            continue
        after = begin + np.searchsorted(time[begin:end], t, side="right")
        # on the curve itself
        i, j = max(after - 1, begin), min(after, end - 1)
        joined = time[i] <= t < time[j] <= time[i] + gap
        share = (t - time[i]) / (time[j] - time[i]) if joined else 0.0
        if not joined and abs(time[j] - t) < abs(time[i] - t):
            i = j
        reference[k] = y[i] + share * (y[j] - y[i]) if share > 0.0 else y[i]
        half = h[i] + share * (h[j] - h[i]) if share > 0.0 else h[i]
        if (joined or time[i] == t) and (abs(v - reference[k]) <= half or v == reference[k]):
            inside[k] = True
            continue
        # all samples whose rectangles, or the lines to them, can reach this time
        low, high = after, after
        while low > begin and time[low - 1] + w[low - 1] >= t:
            low -= 1
        while high < end and time[high] - w[high] <= t:
            high += 1
        low, high = max(low - 1, begin), min(high + 1, end)
        if math.isnan(v):
            for n in range(low, high):
                inside[k] = inside[k] or (math.isnan(y[n]) and abs(time[n] - t) <= w[n])
            continue
        lower[k], upper[k] = _cut(t, time, y, w, h, low, high, gap)
        inside[k] = lower[k] <= v <= upper[k]


@njit(cache=True)
def met(first: Ints, count: Ints, time: Floats, y: Ints, w: Floats, curve: Ints, at: Floats, value: Ints) -> Bools:
    """Which texts, as numbers, stand in the reference within the tolerance in time; a text holds until the next sample.

    Parameters are those of ``judged``.
    """
    out = np.zeros(len(at), np.bool_)
    for k in range(len(at)):
        begin = first[curve[k]]
        end = begin + count[curve[k]]
        after = begin + np.searchsorted(time[begin:end], at[k], side="right")
        n = after - 1
        while n >= begin:
            out[k] = out[k] or y[n] == value[k]
            if out[k] or time[n] + w[n] < at[k]:
                break
            n -= 1
        n = after
        while not out[k] and n < end and time[n] - w[n] <= at[k]:
            out[k] = y[n] == value[k]
            n += 1
    return out


@njit(cache=True)
def number_between(first: Ints, count: Ints, time: Floats, curve: Ints, begin: Floats, end: Floats) -> Ints:
    """How many samples of its curve lie between two times [s], both included; other parameters are those of ``judged``."""
    out = np.zeros(len(begin), np.int64)
    for k in range(len(begin)):
        start = first[curve[k]]
        own = time[start : start + count[curve[k]]]
        out[k] = np.searchsorted(own, end[k], side="right") - np.searchsorted(own, begin[k], side="left")
    return out


def tube(time: Floats, y: Floats, w: Floats, h: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Lower and upper edge of the tube round one curve at given times.

    Parameters
    ----------
    time, y : ndarray, shape (samples,)
        The curve, time ascending [s].
    w, h : ndarray, shape (samples,)
        Tolerances of each sample in time [s] and in value.
    at : ndarray, shape (values,)
        Where the edges are asked for [s].

    Returns
    -------
    lower, upper : ndarray, shape (values,)
        NaN where there is no tube.
    """
    lower, upper = np.full(len(at), np.nan), np.full(len(at), np.nan)
    for k, t in enumerate(at):
        lower[k], upper[k] = _cut(float(t), time, y, w, h, 0, len(time), GAP_S)
    return lower, upper


def inside(time: Floats, y: Floats, w: Floats, h: Floats, at: Floats, value: Floats) -> Bools:
    """Which values of one curve lie in the tube round another.

    Parameters
    ----------
    time, y, w, h : ndarray, shape (samples,)
        The reference and its tolerances, as for ``tube``.
    at, value : ndarray, shape (values,)
        The curve that is judged.
    """
    found, spare, one = np.zeros(len(at), np.bool_), np.empty((3, len(at))), np.zeros(1, np.int64)
    curve = np.zeros(len(at), np.int64)
    judged(one, np.array([len(time)]), time, y, w, h, curve, at, value, GAP_S, found, spare[0], spare[1], spare[2])
    return found


def half_widths(absolute: float, relative: float, share: float, values: Floats, span: float) -> Floats:
    """Tolerance of each sample: the widest of absolute, relative to its value, and a share of the range ``span``."""
    with np.errstate(over="ignore", invalid="ignore"):
        size: Floats = np.maximum(max(absolute, share * span if share else 0.0), relative * np.abs(values))
    return np.where(np.isfinite(size), size, absolute)
