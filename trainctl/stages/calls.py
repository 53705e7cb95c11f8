"""The stops of trains as arrays: all who just run on towards their next ones are looked at together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trainctl.scenario.roster import Stop
from trainctl.signals import Bools, Floats, Ints

#: A train that is slower and nearer to its stop than this has reached it [m/s], [m].
STANDS_MPS, STOP_BAND_M = 0.05, 2.0


class Calls(NamedTuple):
    """All stops of all trains, one train after the other; S stops."""

    first: Ints  # (n,) rows of train i begin at first[i]
    number: Ints  # (n,) how many it has
    place: Floats  # (S,) m, NaN: no longer on its way
    leg: Ints  # (S,) number of turns before it
    passes: Bools  # (S,) the train does not stand there
    parks: Bools  # (S,) it leaves the track meanwhile


def calls(stops: Sequence[Sequence[Stop]]) -> Calls:
    """The stops of every train as arrays."""
    every = [stop for own in stops for stop in own]
    count = np.array([len(own) for own in stops], np.int64)
    return Calls(
        first=np.cumsum(count) - count, number=count, place=np.array([stop.place for stop in every], float),
        leg=np.array([stop.leg for stop in every], np.int64), passes=np.array([stop.passing > 0.0 for stop in every], bool),
        parks=np.array([stop.parks for stop in every], bool),
    )  # fmt: skip


def stand(speed: Floats, driven: Bools, stopped: Bools | None) -> Bools:
    """Which trains stand, (n,); of those that the simulator drives, which it says to be ``stopped`` (None: it drives none)."""
    slow = speed < STANDS_MPS
    return slow if stopped is None else np.where(driven, stopped, slow)


def on_the_way(
    known: Calls, trains: Ints, next_stop: Ints, leg: Ints, position: Floats, stands: Bools, standing: Bools
) -> tuple[Bools, Floats]:  # fmt: skip
    """Which trains just run on towards the next stop, where they are to stand, and the room to it [m], (k,) each.

    Parameters
    ----------
    known : Calls
        Of all n trains.
    trains : ndarray, shape (k,)
        Those that are asked for; they have a stop left.
    next_stop, leg : ndarray, shape (n,)
        Stops and turns made.
    position : ndarray, shape (n,)
        Fronts [m].
    stands, standing : ndarray, shape (n,)
        Who does not move; who is at a stop.
    """
    at = known.first[trains] + next_stop[trains]
    room = known.place[at] - position[trains]
    runs = ~standing[trains] & ~(stands[trains] & (room < STOP_BAND_M))
    runs &= ~(known.passes[at] | known.parks[at] | np.isnan(room)) & (known.leg[at] <= leg[trains])
    return runs, room


def own_stops(known: Calls, trains: Bools, next_stop: Ints, leg: Ints) -> Floats:
    """Where these ``trains`` (n,) are to stand next [m], shape (n,); inf: nowhere."""
    places, i = np.full(len(next_stop), np.inf), np.flatnonzero(trains & (next_stop < known.number))
    at = known.first[i] + next_stop[i]
    stands = (known.leg[at] <= leg[i]) & ~known.passes[at]
    places[i[stands]] = known.place[at[stands]]
    return places


def merged(trains: list[int], rooms: list[float], others: Ints, further: Floats) -> tuple[list[int], list[float]]:
    """Two lots of trains and the rooms they have [m] as one, by train."""
    together, room = [*trains, *others.tolist()], [*rooms, *further.tolist()]
    by_train = sorted(range(len(together)), key=together.__getitem__)
    return [together[k] for k in by_train], [room[k] for k in by_train]
