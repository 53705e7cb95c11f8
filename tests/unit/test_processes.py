"""Pools of processes end with what is done in them."""

from __future__ import annotations

import signal
import time
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children
from multiprocessing.process import BaseProcess

import pytest

from trainctl.processes import ended_with, processes, spawned


def none_left(others: set[BaseProcess]) -> bool:
    """Whether all processes but these have ended; threads of the pools may be late to notice it."""
    until = time.monotonic() + 10.0
    while (left := set(active_children()) - others) and time.monotonic() < until:
        time.sleep(0.05)
    return not left


def test_ctrl_c_is_for_the_program_that_started_them_and_ends_them():
    """A terminal sends it to all processes: theirs ended in tracebacks, or what waited was worked off first."""
    others = set(active_children())
    with pytest.raises(KeyboardInterrupt), processes(2) as pool:
        assert pool.submit(signal.getsignal, signal.SIGINT).result() == signal.SIG_IGN
        for _ in range(4):
            pool.submit(time.sleep, 60.0)
        began = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - began < 30.0
    assert none_left(others)


def test_processes_of_threads_are_ended_too():
    def alone() -> str:
        try:
            with spawned(1) as process:
                process.submit(time.sleep, 0.0).result()
                started.append(True)
                process.submit(time.sleep, 60.0).result()
        except BrokenProcessPool:
            return "ended"
        return "done"

    others, started = set(active_children()), list[bool]()
    with pytest.raises(KeyboardInterrupt), ended_with(pool := ThreadPoolExecutor(1)):
        runs = [pool.submit(alone) for _ in range(2)]
        while not started:
            time.sleep(0.05)
        began = time.monotonic()
        raise KeyboardInterrupt
    assert time.monotonic() - began < 30.0
    assert runs[0].result() == "ended" and not runs[1].running()
    assert none_left(others)
