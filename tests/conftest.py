from __future__ import annotations

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
def finished(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Any]:
    """Run a scenario once per session: finished("three_tracks", "numeric", **{"run.duration_s": 60}) is its run folder."""
    from trainctl.runner import run
    from trainctl.runs.run import Run
    from trainctl.scenario.build import open_scenario

    done: dict[Any, Run] = {}

    def finish(name: str, backend: str = "sumo", **overrides: Any) -> Run:
        key = (name, backend, repr(sorted(overrides.items())))
        if key not in done:
            folder: Path = tmp_path_factory.mktemp("runs") / Path(name).stem
            done[key] = run(open_scenario(name, overrides), folder, backend)  # type: ignore[arg-type]
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
