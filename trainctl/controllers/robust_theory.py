"""Theorem 1 of robust_constrained evaluated, beside what holds instead (``robust_gain``).

As printed, with one correction; in the paper's own example its assumptions have no solution and its bound is astronomic.

Symbols
-------
psi              all phat_i and phat_i + c_i vbar_i (position and speed errors in the moving formation)
q_i, xi_a        weights of what a train receives, summed; minimum weight of all [1/s2]
h, T             feedback gain [1/s], period [s]
W1, W2, W3       maximum |w1| [m], |w2| [m/s], |w3| [m/s2]
b1lo, B1         minimum and maximum magnitude a saturated speed error can have [m/s]
b2lo, B2         the same for the input less the resistance [m/s2]
eta1, eta2       lower bounds of what the clamps leave of speed error and input, eqs. (10), (11), Lemma 1
c                2 / (eta2 h) [s]
mubar            lower bound of the positive elements of the system matrix
lambda1, lambda2 mubar^(2n); 2n (W1 + c W2 + c W3 T) [m]

Correction
----------
b2lo is printed as min{|theta_2hi - c0|, |theta_2lo - r_max|}. The input less the resistance saturates at theta_2hi - r, which is
minimum where r is maximum: b2lo = min{theta_2hi - r_max, |theta_2lo| + r_min}.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.sparse import csgraph

from trainctl.controllers import robust_gain
from trainctl.controllers.robust_gain import MEASUREMENT, RESISTANCE, W1, W2, W3, Gain, Steady
from trainctl.signals import POSITION, SPEED, Floats, Scene

#: The bound the paper states for its example, "by calculation" from Theorem 1 [m].
PRINTED_BOUND = 7694.0


@dataclass(frozen=True)
class Theorem:
    """Theorem 1 and its assumptions; lists are per train."""

    trains: list[str]
    h_t: list[float]
    q: list[float]  # 1/s2
    kappa: float  # minimum ratio of input to resistance, Assumption 1
    b1_low: list[float]
    b1_high: list[float]
    b2_low: list[float]  # corrected
    b2_low_printed: list[float]
    b2_high: list[float]
    eta1: list[float]
    eta2: list[float] | None  # None: Assumption 2 has no solution
    c_s: list[float] | None
    spread_m: float | None  # max |psi_l(0) - psi_s(0)|
    mubar: float | None
    lambda1: float | None
    lambda2_m: float | None
    bound_m: float | None
    charitable_mubar: float  # with eta2 = 1, the best any reading can give
    charitable_bound_m: float
    least_bound_m: float  # no graph and no eta allow less with these h, T and amplitudes
    needed_mubar: float  # for PRINTED_BOUND
    violated: list[str]

    @property
    def holds(self) -> bool:
        """Whether every assumption and the hypothesis hold, so that ``bound_m`` is proved."""
        return not self.violated

    def lines(self) -> list[str]:
        """Text for the terminal."""
        if self.eta2 is None or self.c_s is None or self.bound_m is None:
            value = "no eta2 solves Assumption 2"
        else:
            value = (
                f"bound {self.bound_m:.3g} m: eta1 {min(self.eta1):.4g}, eta2 {min(self.eta2):.4g}, c {max(self.c_s):.4g} s, "
                f"mubar {self.mubar:.4g}, lambda1 {self.lambda1:.3g}, lambda2 {self.lambda2_m:.4g} m"
            )
        lines = [f"Theorem 1: {'holds' if self.holds else 'does not apply'}; {value}", *(f"  violated: {v}" for v in self.violated)]
        if self.least_bound_m > 0.0:
            lines += [
                f"  most charitable reading (eta2 = 1): mubar {self.charitable_mubar:.4g}, bound {self.charitable_bound_m:.3g} m; "
                f"with these gains and amplitudes no graph gives less than {self.least_bound_m:.3g} m",
                f"  the paper states {PRINTED_BOUND:g} m for its example: not reproducible, it needs mubar = "
                f"{self.needed_mubar:.4f} but mubar <= h T / 2 = {max(self.h_t) / 2:.3g}",
            ]
        return lines


def start_spread(p: Floats, v: Floats, c: Floats) -> float:
    """Maximum |psi_l - psi_s| for position errors ``p`` [m], speed errors ``v`` [m/s] and ``c`` [s]."""
    return float(np.ptp(np.concatenate((p, p + c * v))))


def theorem_1(h: Floats, scene: Scene, amplitude: Floats) -> Theorem:
    """Evaluate Assumptions 1 and 2 and Theorem 1.

    Parameters
    ----------
    h : ndarray, shape (n,)
        Feedback gains [1/s].
    scene : Scene
        The start.
    amplitude : ndarray, shape (3, n)
        Maximum |w1| [m], |w2| [m/s], |w3| [m/s2].

    Returns
    -------
    Theorem

    Notes
    -----
    eta2 stands on both sides of Assumption 2, since c = 2 / (eta2 h). Its maximum solution is found from eta2 = 1 downwards;
    the right-hand side grows with eta2, so if the iteration goes to 0 there is none. "B1 i T" in its denominator is read as
    B1 / T, from |h vbar| <= B1 / T; B1 T or B1 h change nothing in the example.
    """
    n, T, v0 = len(scene.trains), scene.control_period, robust_gain.reference_speed(scene)
    low, high = scene.bounds.input_lower, scene.bounds.input_upper
    r_min, r_max = robust_gain.train_resistance(scene, scene.bounds.speed_lower), robust_gain.greatest_resistance(scene)
    below, above = v0 - scene.bounds.speed_lower, scene.bounds.speed_upper - v0
    b1_low, b1_high = np.minimum(below, above), np.maximum(below, above)
    b2_low, b2_high = np.minimum(high - r_max, r_min - low), np.maximum(high - r_min, r_max - low)
    printed = np.minimum(np.abs(high - r_min), np.abs(low - r_max))
    w1, w2, w3 = amplitude.max(axis=1)
    q = robust_gain.laplacian(n, scene.links).diagonal()
    xi = float(scene.links.weight.min()) if len(scene.links.weight) else 0.0
    eta1 = b1_low / (b1_high + b2_high * T + w2)
    state = robust_gain.heads(scene)
    p, v = state[:, POSITION] - robust_gain.potentials(n, scene.links), state[:, SPEED] - v0

    def scaled_denominator(eta2: Floats) -> Floats:
        c = 2.0 / (eta2 * h)
        full: Floats = b1_high / T + n * q * (start_spread(p, v, c) + 4 * n * (w1 + c * w2 + c * w3 * T)) + w3
        return eta2 * full

    def bound(eta1: Floats, eta2: Floats) -> tuple[float, float, float, float]:
        c = 2.0 / (eta2 * h)
        mubar = float(np.minimum(eta2 * h * T / 2 - 2 * q * T / (eta2 * h), 2 * eta1 * xi * T / h).min())
        lambda1 = mubar ** (2 * n) if mubar > 0.0 else 0.0  # the even power would make a negative mubar look good
        lambda2 = float(2 * n * (w1 + c * w2 + c * w3 * T).max())
        return mubar, lambda1, lambda2, (lambda2 / lambda1 + 2 * lambda2 if lambda1 > 0.0 else np.inf)

    eta2 = _greatest_eta2(lambda eta2: np.minimum(eta2 * b2_low / scaled_denominator(eta2), 1.0), n)
    violated = []
    ratio = float((np.minimum(high, -low) / r_max).min())
    if ratio <= 10.0:
        violated.append(f"Assumption 1: the input is only {ratio:.2f} times the resistance, kappa > 10 is needed")
    if np.any(h * T >= 1.0):
        violated.append(f"Assumption 2: h T = {(h * T).max():g}, must be below 1")
    if csgraph.connected_components(robust_gain.graph(n, scene.links), connection="strong")[0] > 1:
        violated.append("Theorem 1: the graph is not strongly connected")
    c = spread = mubar = lambda1 = lambda2 = value = None
    if eta2 is None:
        limit = scaled_denominator(np.full(n, 1e-12))
        worst = int(np.argmax(limit - b2_low))
        violated.append(
            f"Assumption 2 has no solution for train {scene.trains[worst]}: eta2 times the denominator stays at {limit[worst]:.4g} "
            f"even for eta2 -> 0, above b2lo = {b2_low[worst]:.4f}"
        )
        violated += [
            f"Assumption 2: train {scene.trains[i]} has q = {q[i]:.4g}, must be below h^2/4 = {h[i] ** 2 / 4:.4g} at eta2 = 1"
            for i in np.flatnonzero(q >= h**2 / 4).tolist()
        ]
    else:
        c = 2.0 / (eta2 * h)
        spread = start_spread(p, v, c)
        limit = eta2**2 * h**2 / 4
        violated += [
            f"Assumption 2: train {scene.trains[i]} has q = {q[i]:.4g}, must be below eta2^2 h^2/4 = {limit[i]:.3g}, "
            f"eta2 = {eta2[i]:.4g}"
            for i in np.flatnonzero(q >= limit).tolist()
        ]
        mubar, lambda1, lambda2, value = bound(eta1, eta2)
        if not spread > value:
            violated.append(f"Theorem 1: the start spread {spread:.4g} m must exceed the bound {value:.3g} m itself")
    ones = np.ones(n)
    charitable = bound(eta1, ones)
    least_lambda2 = charitable[2]
    limit_mubar = float((h * T).max()) / 2
    rest = PRINTED_BOUND - 2 * least_lambda2
    return Theorem(
        trains=list(scene.trains), h_t=(h * T).tolist(), q=q.tolist(), kappa=ratio,
        b1_low=b1_low.tolist(), b1_high=b1_high.tolist(), b2_low=b2_low.tolist(), b2_low_printed=printed.tolist(),
        b2_high=b2_high.tolist(), eta1=eta1.tolist(),
        eta2=None if eta2 is None else eta2.tolist(), c_s=None if c is None else c.tolist(), spread_m=spread,
        mubar=mubar, lambda1=lambda1, lambda2_m=lambda2, bound_m=value,
        charitable_mubar=charitable[0], charitable_bound_m=charitable[3],
        least_bound_m=least_lambda2 / limit_mubar ** (2 * n) + 2 * least_lambda2,
        needed_mubar=float((least_lambda2 / rest) ** (1 / (2 * n))) if rest > 0.0 else np.inf,
        violated=violated,
    )  # fmt: skip


def _greatest_eta2(right_side: Callable[[Floats], Floats], n: int) -> Floats | None:
    """Return the maximum solution of ``eta2 = right_side(eta2)`` in (0, 1], None if there is none; ``right_side`` is monotone."""
    eta2 = np.ones(n)
    for _ in range(100_000):
        new = right_side(eta2)
        if np.all(np.abs(new - eta2) <= 1e-14 * eta2):
            return new
        eta2 = new
        if eta2.min() < 1e-9:
            return None
    return None


@dataclass(frozen=True)
class Report:
    """What ``check`` prints of this law."""

    theorem: Theorem
    gain: Gain | None  # None: the loop is unstable, a disturbance has no bound, or the formation is too long
    steady: Steady | None  # None: the disturbances are not constant
    notes: list[str]

    def lines(self) -> list[str]:
        """Text for the terminal."""
        parts = [part.lines() for part in (self.theorem, self.gain, self.steady) if part is not None]
        return [line for part in parts for line in part] + self.notes

    def as_dict(self) -> dict[str, Any]:
        """For ``--json``; infinities become null."""
        plain: dict[str, Any] = _finite(asdict(self))
        return plain


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def report(h: Floats, scene: Scene, amplitude: Floats, constant: Floats | None) -> Report:
    """Theorem 1, l1 bound and steady state of one scene that is free of ``violations``.

    Parameters
    ----------
    h : ndarray, shape (n,)
        Feedback gains [1/s].
    scene : Scene
        The start.
    amplitude : ndarray, shape (5, n)
        Maximum magnitudes, see ``plants.disturbance``.
    constant : ndarray, shape (5, n), or None
        The disturbances, if they are constant.
    """
    n, notes, bound, steady = len(scene.trains), [], None, None
    extra = amplitude[RESISTANCE] * robust_gain.greatest_resistance(scene)
    # to the theorem, an error of the resistance and one of the measurement are inputs
    measured = np.abs(robust_gain.laplacian(n, scene.links)) @ amplitude[MEASUREMENT]
    theorem = theorem_1(h, scene, np.stack((amplitude[W1], amplitude[W2], amplitude[W3] + extra + measured)))
    if n < 2:
        notes.append("one train: there is no formation error")
    elif n > robust_gain.DENSE:
        notes.append(
            f"{n} trains: the steady state is computed up to {robust_gain.DENSE}, the l1 bound up to {robust_gain.BOUNDED}"
        )
    elif not amplitude.any():
        notes.append("no disturbance: every error ends at 0")
    elif robust_gain.radius(robust_gain.loop(h, scene)) >= 1.0:
        notes.append("the loop is unstable: no bound on the formation error")
    else:
        if n > robust_gain.BOUNDED:
            notes.append(f"{n} trains: the l1 bound is computed up to {robust_gain.BOUNDED}")
        elif np.all(np.isfinite(amplitude)):
            bound = robust_gain.gain(h, scene, amplitude)
        else:
            notes.append("a Gaussian disturbance without an amplitude that cuts it off has no bound, so neither has the error")
        if constant is not None:
            steady = robust_gain.steady_state(h, scene, constant)
    return Report(theorem, bound, steady, notes)
