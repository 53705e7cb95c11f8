"""A run that was killed ends, resumed, with the same files as one that was not."""

from __future__ import annotations

import json
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import nets
import pandas as pd
import pytest
import tomli_w

from trainctl.errors import InputError
from trainctl.loop import Loop
from trainctl.record.folder import remove
from trainctl.runner import Backend, opened, resume, run
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario
from trainctl.scenario.model import Model

BIN = Path(sys.executable).parent / "trainctl"
TABLES = ("trains.parquet", "units.parquet", "links.parquet", "stops.parquet")
#: EMU units, a train leaves and another joins.
SCENARIO = ("three_tracks", "-q", "--set", "run.duration_s=1300", "--set", "run.record_every_s=5")
OURS = (*TABLES, "events.jsonl", "metrics.json", "scenario.toml")

#: Header, clocks and durations in SUMO's logs.
CLOCKS = r'<performance [^>]*/>|<!--.*?-->|\bduration="\d+"(?=\s*/>)'


def command(*arguments: object) -> list[str]:
    return [str(BIN), *map(str, arguments)]


def typed(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False)


def about(folder: Path) -> dict[str, object]:
    info = json.loads((folder / "run.json").read_text())
    return {key: value for key, value in info.items() if key not in ("wall_time_s", "command_line")}


def lines(path: Path) -> list[str]:
    """An XML log without header, clocks and durations of the computer."""
    return re.sub(CLOCKS, "", path.read_text(), flags=re.DOTALL).splitlines()


def assert_same(folder: Path, reference: Path) -> None:
    for name in OURS:
        assert (folder / name).exists() == (reference / name).exists(), name
        if (reference / name).exists():
            assert (folder / name).read_bytes() == (reference / name).read_bytes(), name
    assert about(folder) == about(reference)
    assert {path.name for path in folder.iterdir()} == {path.name for path in reference.iterdir()}
    logs = sorted(path.name for path in (reference / "sumo").glob("*.xml")) if (reference / "sumo").exists() else []
    for name in logs:
        assert lines(folder / "sumo" / name) == lines(reference / "sumo" / name), name
    if logs:
        fcd = [pd.read_parquet(place / "sumo" / "fcd.parquet") for place in (folder, reference)]
        pd.testing.assert_frame_equal(*fcd, check_exact=True)


def killed(arguments: list[str], when: float) -> int:
    """The exit code of a run killed after so many seconds, unless it was done before."""
    process = subprocess.Popen(arguments, stderr=subprocess.DEVNULL)
    try:
        return process.wait(timeout=when)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        return process.wait()


def killed_past(arguments: list[str], ready: Callable[[], bool]) -> None:
    """Kill a run as soon as it is ``ready``, or a moment later."""
    process = subprocess.Popen(arguments, stderr=subprocess.DEVNULL)
    for _ in range(6000):
        if ready() or process.poll() is not None:
            break
        time.sleep(0.01)
    time.sleep(random.uniform(0.0, 0.1))
    assert process.poll() is None, "over before it could be killed"
    process.send_signal(signal.SIGKILL)
    process.wait()


@pytest.fixture(scope="module")
def reference(tmp_path_factory) -> Path:
    """Not killed: EMU units, a reroute, recorded every 5 s."""
    folder = tmp_path_factory.mktemp("reference") / "run"
    done = typed("run", *SCENARIO, "--out", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_a_killed_run_of_units_ends_as_if_it_had_not_been(share, reference, tmp_path):
    folder, partial = tmp_path / "run", tmp_path / "run.partial"
    moves, state = (partial / "checkpoint" / name for name in ("moves.bin", "state.npz"))
    killed_past(
        command("run", *SCENARIO, "--checkpoint-every", 40, "--out", folder),
        lambda: state.exists() and moves.stat().st_size > share * 1300 * 6 * 8,
    )
    assert Run(partial).info["status"] == "running"
    assert not folder.exists()
    assert len(Run(partial).trains) > 0
    assert typed("metrics", partial).returncode == 0
    done = typed("resume", folder)
    assert done.returncode == 0, done.stderr
    assert re.search(r"resumed at \d+ s", done.stdout)
    assert_same(folder, reference)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert "done already" in typed("resume", folder).stdout


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("fully_distributed_loss", {"run.duration_s": 120, "topology.delay_s": 2.0}),
        ("fault_tolerant_noise", {"run.duration_s": 20, "topology.communication_period_s": 0.5, "run.record_every_s": 2.0}),
        ("emu_group_reroute", {"run.duration_s": 12}),
        ("robust_three_tracks", {"run.duration_s": 60}),
        ("three_tracks", {"run.duration_s": 120, "supervisor.mode": "on", "supervisor.greatest_mps2": 0.05}),
    ],
)
def test_every_law_resumes_from_any_step(name, settings, tmp_path):
    """In process, stopped by an error at a step between two checkpoints: queues, noise, estimates, disturbances."""
    whole = assert_resumed(open_scenario(name, settings), tmp_path, "numeric", (0.5,))
    assert whole.info["status"] == "complete"


@pytest.mark.parametrize(
    ("net", "law", "backend", "duration"),
    [
        ("branches", "fully_distributed", "sumo", 450),
        ("branches", "fault_tolerant", "numeric", 240),
        ("station", "robust_constrained", "sumo", 450),
        ("single_track", "robust_constrained", "sumo", 600),
        pytest.param("branches", "emu_finite_time", "sumo", 900, marks=pytest.mark.campaign),
        pytest.param("three_joins", "robust_constrained", "numeric", 2800, marks=pytest.mark.campaign),
    ],
)
def test_runs_of_a_configuration_resume_from_any_step(net, law, backend, duration, tmp_path):
    """Trains that have come, left, stopped, coupled, requested switches and taken another way; the configuration itself is gone."""
    place = tmp_path / "configuration"
    place.mkdir()
    if net == "single_track":
        up = nets.flow("up", nets.UP, 3, 240, departSpeed="0")
        nets.single_track(place, up + nets.flow("down", nets.DOWN, 3, 240, 20, departSpeed="0"))
    else:
        getattr(nets, net)(place)
    (place / "s.toml").write_text(tomli_w.dumps(nets.scenario(law, duration)))
    whole = assert_resumed(open_scenario(str(place / "s.toml")), tmp_path, backend, (0.3, 0.7))
    happened = {event["kind"] for event in whole.events}
    assert {"depart", "topology"} <= happened
    assert happened & {"couple", "stop_left", "switch_granted"}


def assert_resumed(prepared: Model, place: Path, backend: Backend, shares: tuple[float, ...]) -> Run:
    """A run that ends by an error, once or again, leaves what one that does not leaves; that one."""
    whole = run(prepared, place / "whole", backend, command_line=["x"])
    steps = whole.info["steps"]
    every = prepared.scenario.run.step_s * 3
    folder = place / "run"

    class Stop(Exception):
        pass

    def stopped(simulation: Loop, share: float) -> None:
        while simulation.k < round(share * steps):
            simulation.step()
        raise Stop

    with pytest.raises(Stop), opened(prepared, folder, backend, command_line=["x"], checkpoint_every_s=every) as simulation:
        stopped(simulation, shares[0])
    remove(place / "configuration")
    for share in shares[1:]:
        with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
            patch.setattr(Loop, "run", lambda simulation, _, share=share: stopped(simulation, share))
            resume(folder)
    last = round(shares[-1] * steps)
    failed = Run(place / "run.partial").info
    assert (failed["status"], failed["steps"], failed["failure"]["reason"]) == ("failed", last, "Stop")
    done, since = resume(folder)
    assert since == pytest.approx(last // 3 * every)
    assert_same(done.folder, whole.folder)
    return whole


@pytest.mark.parametrize("moment", ["replace", "rename", "join", "metrics", "info", "remove", "finish", "old"])
def test_a_kill_while_the_run_ends_leaves_what_can_be_finished(moment, tmp_path, monkeypatch):
    """The process dies at the worst places of the end: between joining, measuring and renaming."""
    from trainctl import runner
    from trainctl.record import checkpoint, recorder
    from trainctl.record import folder as place
    from trainctl.scenario.build import open_scenario

    prepared = open_scenario("three_tracks", {"run.duration_s": 40})
    whole = runner.run(prepared, tmp_path / "whole", "numeric", command_line=["x"])

    class Killed(BaseException):
        pass

    def die(*_: object, **__: object) -> None:
        raise Killed

    def second(function):
        calls = iter((function, die))
        return lambda *a: next(calls, die)(*a)

    real_replace = checkpoint.replace

    def replaced(path: Path, content: bytes) -> None:
        if path.name == "state.npz" and path.exists():
            path.with_name("state.npz.new").write_bytes(content[:999])
            raise Killed
        real_replace(path, content)

    out = tmp_path / "run"
    if moment == "old":  # an earlier run is there to be replaced
        runner.run(open_scenario("three_tracks", {"run.duration_s": 10}), out, "numeric")
    with monkeypatch.context() as patch:
        if moment == "replace":  # the second checkpoint is written, but does not replace the first
            patch.setattr(checkpoint, "replace", replaced)
        elif moment == "join":
            patch.setattr(recorder._Segments, "join", second(recorder._Segments.join))
        elif moment == "metrics":
            patch.setattr(runner, "metrics", die)
        elif moment == "info":
            patch.setattr(runner, "write_info", second(place.write_info))
        elif moment == "remove":
            real_remove = runner.remove
            patch.setattr(runner, "remove", lambda p: die() if p.name == "checkpoint" else real_remove(p))
        elif moment == "finish":
            patch.setattr(runner, "finish", die)
        elif moment == "rename":
            patch.setattr(place.Path, "rename", die)
        else:
            patch.setattr(place.Path, "rename", second(Path.rename))
        # a dead process says nothing more; what it had open is closed all the same
        patch.setattr(runner, "_quietly", lambda f, *a: f() if f.__name__ in ("close", "leave") else None)
        with pytest.raises(Killed):
            runner.run(prepared, out, "numeric", command_line=["x"], checkpoint_every_s=10)
    done, _ = resume(out)
    assert_same(done.folder, whole.folder)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "whole"]


def test_without_checkpoints_it_begins_again_and_says_so(tmp_path):
    killed_past(
        command("run", *SCENARIO, "--backend", "numeric", "--out", tmp_path / "run"), (tmp_path / "run.partial" / "segments").exists
    )
    done = typed("resume", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "from the beginning" in done.stdout
    assert about(tmp_path / "run")["steps"] == 1300


def stopped(tmp_path: Path) -> Path:
    """A run that waits to be resumed."""
    from trainctl.runner import opened
    from trainctl.scenario.build import open_scenario

    prepared = open_scenario("three_tracks", {"run.duration_s": 40})
    with pytest.raises(ZeroDivisionError), opened(prepared, tmp_path / "run", "numeric", checkpoint_every_s=10) as simulation:
        for _ in range(25):
            simulation.step()
        raise ZeroDivisionError
    return tmp_path / "run.partial"


def test_other_versions_another_scenario_and_damage_are_refused_in_words(tmp_path, monkeypatch):
    from trainctl.record import checkpoint

    partial = stopped(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "installed", lambda package: "0.0" if package == "libsumo" else None)
        with pytest.raises(InputError, match=r"SUMO = 1\.\d+.*: cannot be resumed with 0\.0"):
            resume(tmp_path / "run")
    text = (partial / "scenario.toml").read_text()
    (partial / "scenario.toml").write_text(text.replace("speed_mps = 85.0", "speed_mps = 84.0", 1))
    with pytest.raises(InputError, match=r"scenario\.toml: damaged, or changed since"):
        resume(partial)
    (partial / "scenario.toml").write_text(text)
    moves = partial / "checkpoint" / "moves.bin"
    content = moves.read_bytes()
    moves.write_bytes(content[:-5])
    with pytest.raises(InputError, match=r"moves\.bin: damaged"):
        resume(partial)


def test_damaged_and_missing_checkpoints_are_refused_in_words(tmp_path):
    with pytest.raises(InputError, match="no run that could be resumed"):
        resume(tmp_path / "nothing")
    partial = stopped(tmp_path)
    state = partial / "checkpoint" / "state.npz"
    state.write_bytes(state.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"state\.npz: not a checkpoint"):
        resume(partial)
    assert typed("resume", partial).returncode == 2


def test_a_run_that_is_going_on_is_left_alone(tmp_path):
    from trainctl.record.folder import held

    partial = stopped(tmp_path)
    with held(partial), pytest.raises(InputError, match="another process is writing"):
        resume(partial)


@pytest.mark.parametrize("wrong", ["0.3", "0", "-5"])
def test_a_wrong_interval_is_one_line(wrong, tmp_path):
    done = typed("run", "three_tracks", "--backend", "numeric", "--checkpoint-every", wrong, "--out", tmp_path / "run")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "must be a multiple of step_s" in done.stderr


@pytest.mark.campaign
def test_killed_at_20_random_moments_of_2400_s(tmp_path):
    """SUMO and EMU units; kills fall anywhere: compiling, running, while a checkpoint is written, joining. Prints the moments."""
    base = ("run", "three_tracks", "-q", "--out")
    began = time.perf_counter()
    assert typed(*base, tmp_path / "reference").returncode == 0
    whole = time.perf_counter() - began
    moments, k, resumed = random.Random(7), 0, 0
    while k < 20:
        folder = tmp_path / f"run{k}"
        when = moments.uniform(0.5, 1.3 * whole)
        code = killed(command(*base, folder, "--checkpoint-every", 60), when)
        if code != -9:
            continue  # it was faster this time
        done = typed("resume", folder)
        if "no run that could be resumed" in done.stderr or "before it began" in done.stderr:
            print(f"{when:.2f} s: killed before there was a run")
            assert typed(*base, folder, "--checkpoint-every", 60).returncode == 0
        else:
            assert done.returncode == 0, done.stderr
            resumed += 1
            print(f"{when:.2f} s: {done.stdout.strip().rpartition(': ')[2]}")
        assert_same(folder, tmp_path / "reference")
        k += 1
    assert resumed >= 10
