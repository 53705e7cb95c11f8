"""Numbers of a law or an observer that may differ from carriage to carriage, or from train to train."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainctl.signals import Consists, Floats

#: One number for all, or a list: see ``spread``.
Numbers = float | tuple[float, ...]


def spread(value: Numbers, consists: Consists) -> Floats:
    """The value of every carriage, shape (U,).

    A list has one number per carriage of a train, if all trains have as many, or one per carriage of all trains, table by table.
    """
    units, total = np.diff(consists.first), int(consists.first[-1])
    if isinstance(value, tuple) and len(value) != total and (units == len(value)).all():
        value = value * len(units)
    return np.broadcast_to(np.asarray(value, float), total).copy()


def of_trains(value: Numbers, trains: int) -> Floats:
    """The value of every train, shape (n,); a list has one number per train."""
    return np.broadcast_to(np.asarray(value, float), trains).copy()


def miscounted(key: str, value: Numbers, consists: Consists) -> list[str]:
    """What is wrong with the length of a list that ``spread`` is given."""
    units, total = np.diff(consists.first), int(consists.first[-1])
    if not isinstance(value, tuple) or len(value) == total or (units == len(value)).all():
        return []
    each = f"{units[0]} (the carriages of a train) or " if (units == units[0]).all() else ""
    return [f"{key} = {_listed(value)}: has {len(value)} values, it takes one number, or a list of {each}{total} (all carriages)"]


def miscounted_trains(key: str, value: Numbers, trains: Sequence[str]) -> list[str]:
    """What is wrong with the length of a list that ``of_trains`` is given."""
    if not isinstance(value, tuple) or len(value) == len(trains):
        return []
    return [f"{key} = {_listed(value)}: has {len(value)} values, it takes one number, or a list of {len(trains)} (all trains)"]


def _listed(value: tuple[float, ...]) -> str:
    shown = ", ".join(f"{v:g}" for v in value[:8])
    return f"[{shown}{', ...' if len(value) > 8 else ''}]"
