"""Powers of many numbers at once are those of the mathematical library."""

from __future__ import annotations

import math

import numpy as np
import pytest

from trainctl.controllers.powers import BLOCK, signed_powers


def powers(x, alpha):
    x, out = np.asarray(x, float), np.empty(len(x))
    signed_powers(x, alpha, out)
    return out


@pytest.mark.parametrize("alpha", [0.9, 1.8 / 1.9, 0.5, 1.0, 0.01])
@pytest.mark.parametrize("decades", [(-12, 6), (-307, 307)])
def test_they_are_those_of_the_library(alpha, decades):
    rng = np.random.default_rng(1)
    x = rng.choice([-1.0, 1.0], 100 * BLOCK) * 10.0 ** rng.uniform(*decades, 100 * BLOCK)
    expected = [math.copysign(math.pow(abs(v), alpha), v) for v in x]
    np.testing.assert_allclose(powers(x, alpha), expected, rtol=5e-16, atol=0.0)


def test_a_number_has_the_same_power_in_every_place():
    """A block is taken in one go, what is left over one by one: both must give the same bits."""
    x = np.random.default_rng(2).normal(size=3 * BLOCK - 1)
    np.testing.assert_array_equal(powers(x, 0.9), [powers([v], 0.9)[0] for v in x])


def test_ends_of_the_numbers():
    x = [0.0, -0.0, 1.0, -1.0, 1e-310, np.nan, np.inf, -np.inf]
    with np.errstate(invalid="ignore"):  # the uncompiled one warns
        found = powers(x, 0.9)
    np.testing.assert_array_equal(found, [0.0, 0.0, 1.0, -1.0, 0.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(np.signbit(found[:2]), [False, True])
