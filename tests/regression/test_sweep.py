"""Sweeps over real worker processes: what happens to the workers changes nothing in the dataset."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pandas as pd
import psutil
import pytest

from trainctl.studies.jobs import simulate
from trainctl.studies.results import part, write_results
from trainctl.studies.sweep import SweepPlan, jobs, ready_made, sweep

BIN = Path(sys.executable).parent
SEEDS, DURATION = range(8), 300
ASKED = ("--set", f"run.duration_s={DURATION}", "--set", "topology.loss=0.1", "--seeds", "0..7")


def command(out, *more):
    return [BIN / "trainctl", "sweep", "monte_carlo", *ASKED, "--out", out, *more]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """The dataset as this process computes it, one run after the other."""
    made = ready_made("monte_carlo")
    settings = {"topology.loss": [0.1], "run.duration_s": [DURATION]}
    rows = [simulate(job) for job in jobs(SweepPlan(made.scenario, settings, SEEDS, made.jitter))]
    path = tmp_path_factory.mktemp("alone") / "results.parquet"
    write_results(part(rows), range(len(rows)), path)
    return path.read_bytes()


def workers_of(process):
    """Processes Dask started for this sweep that simulate."""
    children = psutil.Process(process.pid).children(recursive=True)
    return [child for child in children if any("spawn_main" in word for word in child.cmdline())]


def test_a_killed_worker_loses_nothing(alone, tmp_path):
    out = tmp_path / "sweep"
    sweep = subprocess.Popen(command(out, "--workers", "2", "--json"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    rows, deadline = out / "rows.jsonl", time.monotonic() + 120
    while not (rows.exists() and rows.stat().st_size) and sweep.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    before = workers_of(sweep)
    assert before, sweep.communicate()
    os.kill(before[0].pid, signal.SIGKILL)
    said, complaints = sweep.communicate(timeout=180)
    assert sweep.returncode == 0, complaints
    assert len(rows.read_text().splitlines()) == len(SEEDS)
    assert json.loads(said)["complete"] == len(SEEDS)
    assert (out / "results.parquet").read_bytes() == alone


@pytest.mark.campaign
def test_a_separate_scheduler_gives_the_dataset_of_the_local_cluster(alone, tmp_path):
    """dask scheduler and two dask workers, each started by itself, and a local cluster."""
    address = tmp_path / "scheduler.json"
    started = [
        subprocess.Popen([BIN / "dask", "scheduler", "--port", "0", "--dashboard-address", ":0", "--scheduler-file", address])
    ]
    try:
        started += [
            subprocess.Popen(
                [BIN / "dask", "worker", "--scheduler-file", address, "--nthreads", "1", "--local-directory", tmp_path / f"w{k}"]
            )
            for k in range(2)
        ]
        deadline = time.monotonic() + 60
        while not address.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        done = subprocess.run(command(tmp_path / "far", "--scheduler", address, "-q"), capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.wait(30)
    done = subprocess.run(command(tmp_path / "near", "--workers", "2", "-q"), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    far, near = ((tmp_path / name / "results.parquet").read_bytes() for name in ("far", "near"))
    assert far == near == alone
    assert len(pd.read_parquet(tmp_path / "far" / "results.parquet")) == len(SEEDS)


def test_a_sweep_listens_on_the_loopback_alone(tmp_path):
    """No port of scheduler, dashboard or workers can be reached from another machine."""
    heard = set()

    def look(*_):
        for process in (psutil.Process(), *psutil.Process().children(recursive=True)):
            with suppress(psutil.Error):
                heard.update(c.laddr.ip for c in process.net_connections("inet") if c.status == psutil.CONN_LISTEN)

    plan = SweepPlan("fully_distributed", {"run.duration_s": [20]}, [0, 1], {}, "numeric")
    assert sweep(plan, tmp_path / "s", workers=1, progress=look)["complete"] == 2
    assert heard == {"127.0.0.1"}
