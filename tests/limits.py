"""What an input may cost, and how it may fail."""

from __future__ import annotations

import resource
import signal
from contextlib import contextmanager
from pathlib import Path

from sumo_net import LineError
from trainctl.errors import InputError

#: No example may take more processor time than this [s], nor more memory beyond what the test began with.
LIMIT_S, LIMIT_BYTES = 20.0, 1 << 30


class Hang(BaseException):
    """Not an Exception, so that nothing swallows it."""


@contextmanager
def bounded(memory=LIMIT_BYTES):
    """Only mistakes in words may leave; processor time and memory [bytes] are limited."""

    def stop(*_):
        raise Hang(f"more than {LIMIT_S} s of processor time")

    data = next(int(line.split()[1]) << 10 for line in Path("/proc/self/status").read_text().splitlines() if "VmData" in line)
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    before = signal.signal(signal.SIGPROF, stop)
    resource.setrlimit(resource.RLIMIT_DATA, (data + memory, hard))
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    try:
        yield
    except (InputError, LineError) as error:
        assert error.mistakes
        for line in error.mistakes:
            assert line.isprintable() and line.strip(), line
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
        signal.signal(signal.SIGPROF, before)
