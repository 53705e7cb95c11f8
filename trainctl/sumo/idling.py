"""SUMO's drivers idle: what they decide is overruled anyhow, and it takes half of SUMO's time."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager

#: SUMO's driver decides that often [s]: never, but where it is told to. Every train is commanded in every step, so all it decides
#: is overruled, and it takes half of SUMO's time. Only its way over the end of an edge has to be planned.
IDLE_S = 1e6

#: What SUMO says about drivers who decide so rarely.
OF_IDLING = ("Warning: Given action step length", "Warning: Action step length")


def idle_s(step: float) -> float:
    """``IDLE_S`` in whole steps of the simulator: SUMO rounds anything else, and says so."""
    return round(math.ceil(IDLE_S / step) * step, 3)


@contextmanager
def silent() -> Iterator[None]:
    """What libsumo prints on stderr meanwhile goes nowhere; it stands in SUMO's message log, too."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
