"""Processes beside this one, which share its work and end with it.

A terminal sends Ctrl-C to all of them, but it is for the program that started them: they ignore it, and are ended by that.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context


def spawned(number: int) -> ProcessPoolExecutor:
    """A pool of so many processes."""
    return ProcessPoolExecutor(number, get_context("spawn"), signal.signal, (signal.SIGINT, signal.SIG_IGN))


@contextmanager
def ended_with(pool: Executor) -> Iterator[None]:
    """Let no work of a pool outlive an exception such as Ctrl-C: what has not begun is left, processes started inside are ended."""
    others = set(active_children())
    with pool:
        try:
            yield
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            started = set(active_children()) - others
            for child in started:
                child.terminate()
            for child in started:
                child.join()
            raise


@contextmanager
def processes(number: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of so many processes, which ends with whatever is done inside."""
    with ended_with(pool := spawned(number)):
        yield pool
