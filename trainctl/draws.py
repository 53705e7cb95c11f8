"""Random numbers by name: each is a function of the seed, of what it is for, of whom it is for and of a count, as in [1]_.

Nothing drawn before matters, nor who else there is: trains may come, go or change places, and every train keeps its numbers.

References
----------
.. [1] Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11: Philox4x32-10.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np
from numba import njit

from trainctl.signals import Floats, Ints

#: What numbers are for: the second word of the counter. Disturbances, with steps of up to 64 bits, have 0.
DISTURBANCE, NOISE, LOSS, JITTER, DEPARTURE, REROUTER, BURST = range(7)

WORD = 0xFFFFFFFF


def word(name: str) -> int:
    """A word of 32 bits for a name, such as a train's id."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=4).digest(), "little")


def uniform(seed: int, purpose: int, count: Ints, who: Ints) -> Floats:
    """Numbers in [0, 1), shape (k, m).

    Parameters
    ----------
    seed : int
        Below 2**64.
    purpose : int
        One of the constants of this module.
    count : ndarray of int, shape (k,)
        Below 2**32, such as the number of a sample.
    who : ndarray of int, shape (m, 2)
        Two words for each of those the numbers are for.
    """
    return _drawn(seed, purpose, count, who, False)


def normal(seed: int, purpose: int, count: Ints, who: Ints) -> Floats:
    """Numbers of a standard normal distribution, shape (k, m), as ``uniform``."""
    return _drawn(seed, purpose, count, who, True)


def key(seed: int) -> tuple[int, int]:
    """The two words of a seed below 2**64 that begin every draw."""
    return seed & WORD, seed >> 32 & WORD


def _drawn(seed: int, purpose: int, count: Ints, who: Ints, gaussian: bool) -> Floats:
    out = np.empty((len(count), len(who)))
    _fill(*key(seed), purpose, np.asarray(count, np.int64), np.asarray(who, np.int64), gaussian, out)
    return out


@njit(cache=True)
def _fill(key_low: int, key_high: int, purpose: int, count: Ints, who: Ints, gaussian: bool, out: Floats) -> None:
    """Write the numbers of every count and every train into ``out`` (k, m)."""
    for r in range(len(count)):
        for i in range(len(who)):
            first, second = uniforms(count[r], purpose, who[i, 0], who[i, 1], key_low, key_high)
            out[r, i] = gauss(first, second) if gaussian else first


@njit(cache=True)
def gauss(first: float, second: float) -> float:
    """A standard normal number from two in [0, 1): Box and Muller."""
    return math.sqrt(-2.0 * math.log(1.0 - first)) * math.cos(2.0 * math.pi * second)


@njit(cache=True)
def uniforms(c0: int, c1: int, c2: int, c3: int, key_low: int, key_high: int) -> tuple[float, float]:
    """Two numbers in [0, 1) of 53 random bits each."""
    w, x, y, z = philox(c0 & WORD, c1, c2, c3, key_low, key_high)
    return ((w >> 5) * 67108864.0 + (x >> 6)) / 9007199254740992.0, ((y >> 5) * 67108864.0 + (z >> 6)) / 9007199254740992.0


@njit(cache=True)
def philox(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> tuple[int, int, int, int]:
    """Philox4x32-10 [1]_: four random words of 32 bits from a counter of four and a key of two.

    Products of two words may wrap around in 64-bit integers; the masked words are right all the same.
    """
    for _ in range(10):
        a, b = 0xD2511F53 * c0, 0xCD9E8D57 * c2
        c0, c1, c2, c3 = (b >> 32 & WORD) ^ c1 ^ k0, b & WORD, (a >> 32 & WORD) ^ c3 ^ k1, a & WORD
        k0, k1 = k0 + 0x9E3779B9 & WORD, k1 + 0xBB67AE85 & WORD
    return c0, c1, c2, c3
