"""The processes that do the runs of a sweep."""

from __future__ import annotations

import signal

from trainctl.studies.cluster import client_of


def test_ctrl_c_is_left_to_the_program_that_started_the_workers() -> None:
    """A terminal sends it to all of them; theirs ended in tracebacks."""
    with client_of(1, None) as client:
        assert client.submit(signal.getsignal, signal.SIGINT).result() == signal.SIG_IGN
