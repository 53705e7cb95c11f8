"""Every way a run can fail, provoked for real: run.json says what and when, what was recorded is readable, the exit code tells."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import libsumo
import numpy as np
import pytest

from trainctl.cli import program as cli
from trainctl.errors import CouplingError, LawError, SimulatorError
from trainctl.runner import opened, resume, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario

BIN = Path(sys.executable).parent / "trainctl"
SCENARIO = ("three_tracks", "-q", "--set", "run.duration_s=600")


def command(*arguments: object) -> list[str]:
    return [str(BIN), *map(str, arguments)]


def wait_for(path: Path, process: subprocess.Popen[bytes]) -> None:
    for _ in range(6000):
        if path.exists() or process.poll() is not None:
            break
        time.sleep(0.01)
    assert process.poll() is None, "over before it could be stopped"


def failure(partial: Path) -> tuple[str, float, str]:
    info = Run(partial).info
    return info["failure"]["reason"], info["failure"]["time_s"], info["status"]


@pytest.fixture
def small_disk(tmp_path):
    """A full tmpfs where mounting is allowed; otherwise nothing."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1000k", "tmpfs", place], capture_output=True, check=False)
    if mounted.returncode != 0:
        yield None
        return
    yield place
    subprocess.run(["umount", place], check=True)


def limited_files() -> None:
    """Files of 100 kB at most: writing beyond fails as on a full disk, though with another word."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))


def test_disk_full(small_disk, tmp_path):
    folder = (small_disk or tmp_path) / "run"
    done = subprocess.run(
        command("run", *SCENARIO, "--out", folder, "--checkpoint-every", 50),
        capture_output=True, text=True, check=False, preexec_fn=None if small_disk else limited_files,
    )  # fmt: skip
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    partial = folder.with_name("run.partial")
    reason, when, status = failure(partial)
    assert status == "failed"
    assert "No space left" in reason or "File too large" in reason or "disk full" in reason
    assert when > 0
    trains = Run(partial).trains
    assert trains.time_s.min() == 0
    assert trains.time_s.max() >= 49
    assert subprocess.run(command("metrics", partial), capture_output=True, check=False).returncode == 0
    if small_disk:
        subprocess.run(["mount", "-o", "remount,size=20m", small_disk], check=True)
        again = subprocess.run(command("resume", folder), capture_output=True, text=True, check=False)
        assert again.returncode == 0, again.stderr
        assert Run(folder).info["status"] == "complete"


def test_disk_full_is_noticed_though_sumo_says_nothing(tmp_path, monkeypatch):
    """SUMO goes on when its logs cannot be written."""
    prepared = open_scenario("three_tracks", {"run.duration_s": 60})
    out = tmp_path / "run"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with pytest.raises(SimulatorError, match=r"summary\.xml.* incomplete"), opened(prepared, out) as simulation:
            resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, before[1]))
            simulation.run()
            resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, before[1]))  # what SUMO has lost stays lost
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert failure(tmp_path / "run.partial")[1:] == (60.0, "failed")


def test_kill_9_leaves_a_readable_run(tmp_path):
    partial = tmp_path / "run.partial"
    process = subprocess.Popen(command("run", *SCENARIO, "--out", tmp_path / "run", "--checkpoint-every", 20))
    wait_for(partial / "checkpoint" / "state.npz", process)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    left = Run(partial)
    assert left.info["status"] == "running"
    assert len(left.trains) > 0 and len(left.units) > 0 and len(left.links) > 0
    assert {event["kind"] for event in left.events} >= {"topology", "reroute"}
    assert subprocess.run(command("metrics", partial), capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm(number, tmp_path):
    partial = tmp_path / "run.partial"
    process = subprocess.Popen(
        command("run", *SCENARIO, "--out", tmp_path / "run", "--checkpoint-every", 20), stderr=subprocess.PIPE, text=True
    )
    wait_for(partial / "checkpoint" / "state.npz", process)
    process.send_signal(number)
    words = process.communicate()[1]
    assert process.returncode == 130
    assert words.strip() == "trainctl: interrupted"
    reason, when, status = failure(partial)
    assert (reason, status) == (f"interrupted by {number.name}", "interrupted")
    assert when >= 20
    assert Run(partial).trains.time_s.max() == when - 1  # all steps that were done
    if number == signal.SIGINT:
        done, since = resume(tmp_path / "run")
        assert since == when
        assert (done.info["status"], done.info["steps"]) == ("complete", 600)


def test_a_broken_pipe_spoils_only_the_printing(tmp_path):
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        command("run", "three_tracks", "--backend", "numeric", "--set", "run.duration_s=30", "--json", "--out", tmp_path / "run"),
        stdout=writing, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    os.close(writing)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr
    assert Run(tmp_path / "run").info["status"] == "complete"


def typed(monkeypatch, *arguments: object) -> int:
    """The command line in this process: its exit code."""
    monkeypatch.setattr(sys, "argv", command(*arguments))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


@pytest.mark.parametrize("name", ["three_tracks", "fully_distributed"])
def test_a_sampled_law_that_gives_nan(name, tmp_path, monkeypatch, capsys):
    from trainctl.controllers import fully_distributed

    real, calls = fully_distributed.demand, iter(range(100))

    def poisoned(*arguments):
        demand = real(*arguments)
        if next(calls) == 3:
            demand.acceleration[2] = np.nan
        return demand

    monkeypatch.setattr(fully_distributed, "demand", poisoned)
    code = typed(monkeypatch, "run", name, "-q", "--backend", "numeric", "--set", "run.duration_s=80", "--out", tmp_path / "run")
    assert code == 3
    held = open_scenario(name).scenario.run.held_steps
    reason, when, status = failure(tmp_path / "run.partial")
    assert "not finite for train 3" in reason and f"at {3 * held} s" in reason
    assert (when, status) == (3.0 * held, "failed")
    assert Run(tmp_path / "run.partial").trains.time_s.max() == 3 * held - 1
    assert reason in capsys.readouterr().err


def test_a_continuous_law_that_gives_nan(tmp_path):
    prepared = open_scenario("fault_tolerant", {"run.duration_s": 10})
    with (
        pytest.raises(LawError, match=r"train 2.* is no longer finite after 3 s"),
        opened(prepared, tmp_path / "run", "numeric") as s,
    ):
        for _ in range(3):
            s.step()
        s.state.plant.estimate[prepared.leading[1], 2] = np.nan  # its observer went astray
        s.step()
    assert failure(tmp_path / "run.partial")[1:] == (3.0, "failed")
    assert Run(tmp_path / "run.partial").trains.time_s.max() == 2


def test_sumo_refuses(tmp_path):
    """An order SUMO cannot follow, in the middle of a run."""
    prepared = open_scenario("three_tracks", {"run.duration_s": 40})
    with pytest.raises(SimulatorError, match=r"SUMO at 20\.000 s: .*[Rr]oute"), opened(prepared, tmp_path / "run") as s:
        for _ in range(20):
            s.step()
        s.world.route(0, (prepared.line.edges[0], prepared.line.edges[-1]))
    assert failure(tmp_path / "run.partial")[1:] == (20.0, "failed")
    assert Run(tmp_path / "run.partial").trains.time_s.max() == 19
    assert not libsumo.simulation.isLoaded()


def test_something_else_moves_a_train(tmp_path):
    prepared = open_scenario("three_tracks", {"run.duration_s": 40})
    with (
        pytest.raises(CouplingError, match=r"train 4 .*something else moved it .*speed mode"),
        opened(prepared, tmp_path / "run") as s,
    ):
        for _ in range(20):
            s.step()
        libsumo.vehicle.setSpeedMode("4", 31)
        libsumo.vehicle.setMaxSpeed("4", 10.0)
        for _ in range(5):
            s.step()
    _, when, status = failure(tmp_path / "run.partial")
    assert (when, status) == (20.0, "failed")
    assert Run(tmp_path / "run.partial").trains.time_s.max() == 20


def test_a_second_simulation_in_one_process_is_refused(tmp_path):
    prepared = open_scenario("three_tracks", {"run.duration_s": 5})
    libsumo.start(["sumo", "-n", str(run(prepared, tmp_path / "first").folder / "sumo" / "three_tracks.net.xml"), "--no-step-log"])
    try:
        with pytest.raises(SimulatorError, match="already runs in this process"):
            run(prepared, tmp_path / "run")
    finally:
        libsumo.close()
    assert failure(tmp_path / "run.partial")[1:] == (0.0, "failed")
