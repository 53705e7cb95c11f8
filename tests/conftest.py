from __future__ import annotations

import fcntl
import hashlib
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

settings.register_profile("suite", derandomize=True, deadline=None)
settings.load_profile("suite")

# Whoever starts the suite in the background of a shell has Ctrl-C ignored, here and in the processes that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Callable[..., Any]:
    """Run a scenario once per session: finished("three_tracks", "numeric", **{"run.duration_s": 60}) is its run folder.

    Processes that share the suite (pytest -n) share the folders too: whoever comes first runs, the others wait for it.
    """
    from trainctl.runner import run
    from trainctl.runs.run import Run
    from trainctl.scenario.build import open_scenario

    base = tmp_path_factory.getbasetemp()
    place = (base if worker_id == "master" else base.parent) / "finished"
    place.mkdir(exist_ok=True)
    done: dict[str, Run] = {}

    def finish(name: str, backend: str = "sumo", **overrides: Any) -> Run:
        key = repr((name, backend, sorted(overrides.items())))
        if key not in done:
            folder = place / hashlib.sha256(key.encode()).hexdigest()[:16] / Path(name).stem
            folder.parent.mkdir(exist_ok=True)
            with (folder.parent / "lock").open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                if not folder.exists():
                    run(open_scenario(name, overrides), folder, backend)  # type: ignore[arg-type]
            done[key] = Run(folder)
        return done[key]

    return finish


@pytest.fixture
def typed(tmp_path, monkeypatch, capsys):
    """Type a command: exit code and the lines on stderr."""
    from trainctl.cli import program as cli

    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["trainctl", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        return stop.value.code, capsys.readouterr().err.splitlines()

    return call
