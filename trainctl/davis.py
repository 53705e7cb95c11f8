"""Running resistance by the Davis form, for arrays and for compiled loops."""

from __future__ import annotations

from numba import njit

from trainctl.kernels import inlined
from trainctl.signals import Floats


def resistance(speed: Floats, davis: Floats) -> Floats:
    """Specific running resistance, Davis form ``c0 + c1 v + c2 v^2``: f of fully_distributed (1), r of robust_constrained (2).

    Parameters
    ----------
    speed : ndarray, shape (k,) or (..., k)
        Forward positive [m/s].
    davis : ndarray, shape (k, 3)
        c0 [N/kg], c1 [N s/(m kg)], c2 [N s2/(m2 kg)].

    Returns
    -------
    ndarray, shape of ``speed``
        Decelerating force per mass [N/kg].

    Notes
    -----
    As printed, so ``c0`` acts at standstill too, where the plant holds the train.
    """
    return davis[:, 0] + davis[:, 1] * speed + davis[:, 2] * speed**2


@njit(cache=True, inline="always", error_model="numpy")
def resistance_of(i: int, v: float, davis: Floats) -> float:
    """The same of train ``i`` alone, for compiled loops."""
    return davis[i, 0] + davis[i, 1] * v + davis[i, 2] * (v * v)  # type: ignore[no-any-return]


@inlined(inline="always")
def running_resistance(v: float, c0: float, c1: float, c2: float) -> float:
    """The same [N/kg] of a unit that stands still where nothing drives it: zero there."""
    return c0 + (c1 + c2 * v) * v if v > 0.0 else 0.0
