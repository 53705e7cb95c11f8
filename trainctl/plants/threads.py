"""Trains shared out to threads: whole formations, each with work space of its own, so no number depends on how many there are.

Compiled code releases Python's lock while it integrates, so plain threads of Python use all cores.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from trainctl.errors import InputError
from trainctl.signals import Ints, Links

#: Environment variable with the number of threads; all cores if it is not set.
THREADS = "TRAINCTL_THREADS"

#: A thread takes at least so many trains: for fewer it is not worth the 50 us of a call.
LEAST = 64

#: Trains are integrated so many at a time, or a formation: few enough for the cache, enough to share the calls. If they are many,
#: and may be cut anywhere, up to ``MOST``, two lots to a thread.
TOGETHER, MOST = 64, 256


class Shares(NamedTuple):
    """Which thread integrates which trains."""

    blocks: tuple[Ints, ...]  # of each thread: the trains that its blocks begin with, and the one behind the last
    order: Ints  # (n,) as ``Links.order``, block by block
    space: tuple[str, ...] = ()  # fields of the law's constants of which each thread needs its own
    pool: ThreadPoolExecutor | None = None  # of all threads but the calling one


#: One thread that takes all trains at once.
ALONE = Shares((), np.zeros(0, np.int64))


def cores() -> int:
    """How many threads there may be: as the environment says, or as many as the process has cores."""
    if given := os.environ.get(THREADS, "").strip():
        if not (given.isascii() and given.isdigit() and int(given) >= 1):
            raise InputError(f"{THREADS}={given}: must be a whole number, at least 1")
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1  # macOS has none


def shares(first: Ints, links: Links, talk: bool, threads: int) -> Shares:
    """Cut trains into blocks, between trains that receive nothing from each other, and share these out by the units they have.

    Parameters
    ----------
    first : ndarray, shape (n + 1,)
        Units of train ``i``: ``first[i]:first[i + 1]``.
    links : Links
        Who receives from whom.
    talk : bool
        Whether they do within a stretch of integration, or their law watches them there by the state of others; else trains may be
        cut anywhere.
    threads : int
        At most so many shares.
    """
    n = len(first) - 1
    crossed = np.zeros(n + 2, np.int64)  # links over the cut before each train
    if talk:
        np.add.at(crossed, np.minimum(links.sender, links.receiver) + 1, 1)
        np.add.at(crossed, np.maximum(links.sender, links.receiver) + 1, -1)
    cuts = np.flatnonzero(np.cumsum(crossed)[: n + 1] == 0)
    bounds, lot = [0], TOGETHER if talk else max(TOGETHER, min(MOST, n // (2 * threads)))
    for cut in cuts.tolist():
        if cut - bounds[-1] >= lot:
            bounds.append(cut)
    blocks = np.array([*bounds, *([n] if bounds[-1] < n else [])], np.int64)
    number = max(min(threads, n // LEAST), 1)
    wanted = first[-1] * np.arange(1, number) / number
    ends = np.unique(np.abs(first[blocks][None, :] - wanted[:, None]).argmin(axis=1))
    parts = [part for part in np.split(np.arange(len(blocks) - 1), ends) if len(part)]
    block = np.searchsorted(blocks, links.order, side="right")
    order = links.order[np.argsort(block, kind="stable")]
    return Shares(tuple(blocks[part[0] : part[-1] + 2].copy() for part in parts), order)
