"""Scenes that tests of more than one module look at."""

from __future__ import annotations

from typing import Any

import numpy as np

from trainctl.signals import Bounds, Consists, Links, Reference, Scene


def coupled_trains(positions: tuple[float, ...], units: int, reference: Reference, **consist: Any) -> Scene:
    """Trains of light couplers and no limits at 80 m/s, with leading units at ``positions``.

    Neighbours hear each other and want 3000 m from rear to front, the first wants to be at the reference. ``consist`` replaces
    fields of ``Consists``.
    """
    trains = len(positions)
    rows = trains * units
    one, endless = np.ones(rows), np.full(rows, np.inf)
    coupled = np.arange(1, rows + 1) % units != 0
    consists = Consists(
        np.arange(0, rows + 1, units), 80.0 * one, 8e4 * one, one.copy(), np.tile([0.01176, 7.7616e-4, 1.6e-5], (rows, 1)),
        1.6e5 * coupled, 600.0 * coupled, endless, endless, endless, endless, endless,
    )._replace(**consist)  # fmt: skip
    pairs = [(j, i) for i in range(trains) for j in (i - 1, i + 1) if 0 <= j < trains]
    sender, receiver = np.array(pairs, dtype=np.int64).reshape(-1, 2).T.copy()
    spacing, some = 3000.0 + 80.0 * units, np.ones(len(pairs))
    links = Links(
        sender, receiver, np.searchsorted(receiver, np.arange(trains + 1)), (receiver - sender) * spacing, -np.inf * some,
        np.inf * some, some, some > 0.0, -spacing * np.arange(trains), np.arange(trains),
    )  # fmt: skip
    own = np.empty((rows, 2))
    own[:, 0] = np.repeat(positions, units) - 80.0 * np.tile(np.arange(units), trains)
    own[:, 1] = 80.0
    free = np.full(trains, np.inf)
    names = [str(i + 1) for i in range(trains)]
    return Scene(names, consists, own, links, Bounds(-free, free, -free, free), reference, 0.0, 1.0, 1.0, 0.5, 0.01)
