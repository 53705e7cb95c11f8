"""Dask's processes, which do the runs of a sweep."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from trainctl.errors import InputError, TrainctlError

#: A run whose worker dies is given to another one; after so many deaths it is taken for the cause.
MOST_DEATHS = 3


def dask_setup(worker: Any) -> None:
    """Called by a worker on this machine as it starts: Ctrl-C is for the program that started it, which ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def client_of(workers: int, scheduler: str | None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a cluster on this machine: processes of one thread each, all spawned."""
    import dask
    from distributed import Client, LocalCluster

    with dask.config.set(
        {
            "distributed.scheduler.allowed-failures": MOST_DEATHS, "distributed.worker.multiprocessing-method": "spawn",
            "distributed.worker.preload": [__name__] if scheduler is None else [],
        }
    ):  # fmt: skip
        if scheduler is not None:
            try:
                where = {"scheduler_file": scheduler} if scheduler.endswith(".json") else {"address": scheduler}
                client = Client(**where, timeout=10, set_as_default=False)  # type: ignore[no-untyped-call]
            except (OSError, ValueError, TypeError) as error:
                raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there: {error}") from None
            with client:
                yield client
            return
        try:
            cluster = LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=workers, threads_per_worker=1, processes=True, memory_limit=0, silence_logs=50,
                host="127.0.0.1", dashboard_address="127.0.0.1:0",  # not to be reached from elsewhere
            )  # fmt: skip
        except (RuntimeError, OSError) as error:
            raise TrainctlError(f"workers could not be started on 127.0.0.1, is the loopback up? {error}") from None
        with cluster, Client(cluster, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            yield client
