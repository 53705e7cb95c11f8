"""What a sweep runs, what it keeps, and what it says of it; no cluster, no SUMO."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from trainctl.errors import InputError, LawError, TrainctlError
from trainctl.record.folder import held
from trainctl.studies import sweep as sweeping
from trainctl.studies.results import part, shares, wilson, write_results
from trainctl.studies.sweep import SweepPlan, half_width, job_model, jobs, seeds, sweep, values

SHORT = {"run.duration_s": [20]}


@pytest.fixture
def alone(monkeypatch):
    """The cluster is this process; the last job comes first."""
    asked = []

    def here(todo, workers, scheduler):
        asked.append([job.number for job in todo])
        yield from ((job, sweeping.simulate(job)) for job in reversed(todo))

    monkeypatch.setattr(sweeping, "_scattered", here)
    return asked


@pytest.fixture
def here(monkeypatch):
    """The cluster is this process; the last task comes first, and after so many of them it is interrupted."""
    after = [1000]

    def scattered(todo, workers, scheduler):
        for task in [*reversed(todo)][: after[0]]:
            yield task, sweeping._done(task)
        if len(todo) > after[0]:
            raise KeyboardInterrupt

    monkeypatch.setattr(sweeping, "_scattered", scattered)
    return after


@pytest.mark.parametrize(
    ("text", "key", "found"),
    [
        ("topology.loss=0,0.1", "topology.loss", [0, 0.1]),
        ("controller.eta=printed,own_speed", "controller.eta", ["printed", "own_speed"]),
        ("reference.table=[[0, 80.0], [10, 75.0]]", "reference.table", [[[0, 80.0], [10, 75.0]]]),
        ('disturbance=[], [{on = "input"}]', "disturbance", [[], [{"on": "input"}]]),
    ],
)
def test_values_are_toml_or_bare_words(text, key, found):
    assert values(text) == (key, found)


def test_seeds_are_ranges_and_numbers():
    assert seeds("0..3") == [0, 1, 2, 3]
    assert seeds("1,2,5..7,2") == [1, 2, 5, 6, 7]
    for wrong in ("a", "3..1", "-1", "1..", "", str(2**63), "0..1000000", "0..9999999999"):
        with pytest.raises(InputError, match="--seeds"):
            seeds(wrong)
    assert seeds(str(2**63 - 1)) == [2**63 - 1]


def test_what_is_given_twice_is_done_once():
    plan = SweepPlan("fully_distributed", {"run.duration_s": [20, 20, 30], "event": [[], []]}, [1, 2, 1], {}, "numeric")
    assert [(one["run.duration_s"], one["run.seed"]) for one in plan.combinations()] == [(20, 1), (20, 2), (30, 1), (30, 2)]


def test_numbers_beyond_64_bits_are_no_integers_in_the_dataset(tmp_path):
    found = part([{"run": k, "parameters": {"mass": mass}, "status": "complete"} for k, mass in enumerate((10**20, 7, None))])
    frame = write_results(found, [0, 1, 2], tmp_path / "results.parquet")
    assert frame["mass"].tolist()[:2] == [1e20, 7.0]


def test_jitter_needs_a_key_of_trains_and_a_width():
    assert half_width("train.position_m=500") == ("train.position_m", 500.0)
    for wrong in ("position_m=5", "train.position_m", "train.position_m=x", "train.position_m=-1", "train.position_m=inf"):
        with pytest.raises(InputError, match="--jitter"):
            half_width(wrong)


def test_every_setting_meets_every_other_and_every_seed():
    plan = SweepPlan("fully_distributed", {"topology.loss": [0.0, 0.1], "run.duration_s": [10, 20]}, [1, 2, 3], {})
    found = plan.combinations()
    assert len(found) == 12
    assert len({json.dumps(c) for c in found}) == 12
    assert found[0] == {"topology.loss": 0.0, "run.duration_s": 10, "run.seed": 1}


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (SweepPlan("fully_distributed", {"topology.los": [0]}, [0], {}), "topology.los: unknown key; did you mean loss"),
        (SweepPlan("fully_distributed", {"controller.etta": ["printed"]}, [0], {}), "controller.etta: unknown key"),
        (SweepPlan("fully_distributed", {"topology.loss": [0.0, 2.0]}, [0], {}), "topology.loss = 2.0"),
        (SweepPlan("fully_distributed", {}, [], {"train.position_m": 1.0}), "needs --seeds"),
        (SweepPlan("fully_distributed", {}, [0], {"train.speed_upper_mps": 1.0}), "not every"),
        (SweepPlan("no_such", {}, [0], {}), "no such scenario"),
    ],
)
def test_mistakes_are_told_before_anything_runs(plan, words):
    with pytest.raises(InputError, match=words):
        jobs(plan)


def test_one_start_that_is_refused_does_not_stop_the_others():
    plan = SweepPlan("fully_distributed", {"bounds.speed_upper_mps": [70.0, 85.0]}, [], {})
    assert len(jobs(plan)) == 2
    with pytest.raises(InputError, match=r"speed bounds 75 \.\. 70 are empty"):
        jobs(SweepPlan("fully_distributed", {"bounds.speed_upper_mps": [70.0]}, [], {}))


def test_jitter_depends_on_seed_and_key_alone():
    def starts(seed, **jitter):
        plan = SweepPlan("monte_carlo_start", {}, [seed], {f"train.{k}": w for k, w in jitter.items()})
        plan = SweepPlan(str(sweeping.sweeps()["monte_carlo_start"]), plan.settings, plan.seeds, plan.jitter)
        return job_model(jobs(plan)[0]).own

    rest, moved, both = starts(1), starts(1, position_m=500.0), starts(1, position_m=500.0, speed_mps=4.0)
    deviation = moved[:, 0] - rest[:, 0]
    assert np.all(np.abs(deviation) <= 500.0)
    assert len(np.unique(deviation)) == len(deviation)
    assert np.array_equal(moved[:, 0], both[:, 0])
    assert np.array_equal(moved[:, 1], rest[:, 1])
    assert not np.array_equal(moved[:, 0], starts(2, position_m=500.0)[:, 0])


def test_wilson_interval_against_published_numbers():
    # Newcombe (1998), Statistics in Medicine 17:857, Table I, method 3
    for hits, total, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        assert wilson(hits, total) == pytest.approx((low, high), abs=5e-5)
    assert wilson(29, 29) == (pytest.approx(1 - wilson(0, 29)[1]), 1.0)
    assert wilson(0, 0) is None


def test_rows_come_in_the_order_of_the_plan_whoever_was_first(alone, tmp_path):
    plan = SweepPlan("fully_distributed", {**SHORT, "topology.loss": [0.0, 0.2]}, [0, 1], {}, "numeric")
    info = sweep(plan, tmp_path / "a")
    assert (info["status"], info["complete"], info["failed"], info["refused"]) == ("complete", 4, 0, 0)
    table = pd.read_parquet(tmp_path / "a" / "results.parquet")
    assert table["run"].tolist() == [0, 1, 2, 3]
    assert table["topology.loss"].tolist() == [0.0, 0.0, 0.2, 0.2]
    assert table["run.seed"].tolist() == [0, 1, 0, 1]
    assert table["bounds.speed_upper_margin_mps"].notna().all()
    assert (tmp_path / "a" / "summary.png").stat().st_size > 5000
    assert not list((tmp_path / "a").glob("runs"))


def test_one_failure_is_recorded_and_the_rest_goes_on(alone, tmp_path, monkeypatch):
    from trainctl import runner

    whole = runner.run

    def fails_once(p, folder, *more):
        if p.scenario.run.seed == 1:
            raise LawError(f"diverged in {folder}")
        return whole(p, folder, *more)

    monkeypatch.setattr(runner, "run", fails_once)
    plan = SweepPlan("fully_distributed", SHORT, [0, 1, 2], {}, "numeric")
    info = sweep(plan, tmp_path / "a")
    assert (info["complete"], info["failed"]) == (2, 1)
    assert info["reasons"] == ["run 1 failed: diverged in 000001"]  # no scratch folder in the dataset
    table = pd.read_parquet(tmp_path / "a" / "results.parquet")
    assert table["status"].tolist() == ["complete", "failed", "complete"]

    monkeypatch.setattr(runner, "run", whole)
    info = sweep(plan, tmp_path / "a", resume=True)
    assert info["complete"] == 3
    assert alone == [[0, 1, 2], [1]]  # only what failed was done again


def test_resume_skips_what_is_done_and_survives_a_cut_line(alone, tmp_path):
    plan = SweepPlan("fully_distributed", SHORT, [0, 1, 2], {}, "numeric")
    out = tmp_path / "a"
    sweep(plan, out)
    whole = (out / "results.parquet").read_bytes()
    lines = (out / "rows.jsonl").read_text().splitlines()
    (out / "rows.jsonl").write_text(lines[0] + "\n" + lines[1][:40])
    sweep(plan, out, resume=True)
    assert alone[1] == [0, 1]  # run 2 came first and was kept
    assert (out / "results.parquet").read_bytes() == whole


def test_resume_refuses_another_sweep_and_nothing_is_replaced_unasked(alone, tmp_path):
    out = tmp_path / "a"
    sweep(SweepPlan("fully_distributed", SHORT, [0], {}, "numeric"), out)
    with pytest.raises(InputError, match="--resume: its scenario"):
        sweep(SweepPlan("fully_distributed_loss", SHORT, [0], {}, "numeric"), out, resume=True)
    with pytest.raises(InputError, match="--force replaces it"):
        sweep(SweepPlan("fully_distributed", SHORT, [0], {}, "numeric"), out)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "thesis.tex").touch()
    with pytest.raises(InputError, match="not a sweep"):
        sweep(SweepPlan("fully_distributed", SHORT, [0], {}, "numeric"), tmp_path / "b", resume=True)
    assert (tmp_path / "b" / "thesis.tex").exists()


def test_the_ready_made_sweep_is_found_and_its_starts_are_sound():
    plan = sweeping.ready_made("monte_carlo")
    assert plan is not None
    assert len(plan.seeds) == 100
    for job in [j for j in jobs(plan) if j.parameters["topology.loss"] == 0.0]:
        job_model(job)  # raises if a start condition fails
    assert sweeping.ready_made("fully_distributed") is None


def test_shares_are_told_per_combination(alone, tmp_path):
    plan = SweepPlan("fully_distributed", {**SHORT, "bounds.speed_upper_mps": [85.0, 85.5]}, [0, 1], {}, "numeric")
    sweep(plan, tmp_path / "a")
    rows = shares(tmp_path / "a", ["bounds.speed_upper_mps"])
    assert [(r["values"], r["runs"], r["of"]) for r in rows] == [((85.0,), 0, 2), ((85.5,), 0, 2)]


def test_two_sweeps_do_not_write_into_one_folder(tmp_path):
    plan = SweepPlan("fully_distributed", SHORT, [0], {}, "numeric")
    out = tmp_path / "s"
    out.mkdir()
    for more in ({}, {"resume": True}, {"force": True}):
        with held(out), pytest.raises(InputError, match="another process is writing there"):
            sweep(plan, out, **more)
    assert list(out.iterdir()) == []


def test_workers_that_cannot_be_started_are_an_error_in_words(tmp_path, monkeypatch):
    """As where there is no network at all, not even the loopback."""

    def refuses(**options):
        assert options["host"] == "127.0.0.1"
        raise RuntimeError("Cluster failed to start")

    monkeypatch.setattr("distributed.LocalCluster", refuses)
    with pytest.raises(TrainctlError, match=r"could not be started on 127\.0\.0\.1.*Cluster failed to start"):
        sweep(SweepPlan("fully_distributed", SHORT, [0], {}, "numeric"), tmp_path / "s")


MANY = SweepPlan(
    str(sweeping.sweeps()["monte_carlo_start"]), {**SHORT, "topology.loss": [0.0, 0.2]}, range(13), {"train.position_m": 500.0},
    "numeric",
)  # fmt: skip


def test_runs_side_by_side_give_one_dataset_however_they_are_cut_and_resumed(here, tmp_path):
    info = sweep(MANY, tmp_path / "whole", workers=1)
    assert (info["complete"], info["refused"], info["alone"]) == (26, 0, {})
    whole = (tmp_path / "whole" / "results.parquet").read_bytes()
    assert len(list((tmp_path / "whole" / "parts").iterdir())) > 2
    here[0] = 3
    with pytest.raises(KeyboardInterrupt):
        sweep(MANY, tmp_path / "cut", workers=4)
    kept = len(pd.read_parquet(tmp_path / "cut" / "results.parquet"))
    assert 0 < kept < 26
    here[0] = 1000
    told = []
    assert sweep(MANY, tmp_path / "cut", resume=True, progress=lambda *numbers: told.append(numbers))["complete"] == 26
    assert told[0][0] > kept
    assert (tmp_path / "cut" / "results.parquet").read_bytes() == whole
    for path, left in zip(sorted((tmp_path / "cut" / "parts").iterdir()), (0, 500), strict=False):
        path.write_bytes(path.read_bytes()[:left])
    with pytest.warns(UserWarning, match="cannot be read: its runs are done again") as said:
        assert sweep(MANY, tmp_path / "cut", resume=True)["complete"] == 26
    assert len(said) == 2
    assert (tmp_path / "cut" / "results.parquet").read_bytes() == whole


def test_few_runs_that_are_left_are_done_as_the_others_were(here, tmp_path):
    """Sums of a run by itself have other last bits."""
    sweep(MANY, tmp_path / "whole", workers=1)
    here[0] = 3  # of the second batch 4 are left
    with pytest.raises(KeyboardInterrupt):
        sweep(MANY, tmp_path / "cut", workers=1)
    here[0] = 1000
    assert sweep(MANY, tmp_path / "cut", workers=1, resume=True)["alone"] == {}
    assert (tmp_path / "cut" / "results.parquet").read_bytes() == (tmp_path / "whole" / "results.parquet").read_bytes()


def test_runs_side_by_side_give_the_dataset_of_single_ones(here, tmp_path, monkeypatch):
    sweep(MANY, tmp_path / "many")
    monkeypatch.setattr("trainctl.studies.blocks.SMALLEST", 100)
    info = sweep(MANY, tmp_path / "single")
    assert info["alone"] == {"fewer than 100 runs differ in their seeds alone": 26}
    many, single = (pd.read_parquet(tmp_path / name / "results.parquet") for name in ("many", "single"))
    assert list(many.columns) == list(single.columns)
    sums = [c for c in many.columns if any(part in c for part in ("l2_gain", "energy.", "jerk_rms", "_mean_"))]
    pd.testing.assert_frame_equal(many.drop(columns=sums), single.drop(columns=sums), check_exact=True)
    pd.testing.assert_frame_equal(many[sums], single[sums], rtol=1e-12, atol=0.0)


def test_runs_that_cannot_go_side_by_side_run_one_by_one_and_it_is_said(here, tmp_path):
    """A start that is refused, orders on the way, tables that are to be kept."""
    wild = SweepPlan("fully_distributed", SHORT, range(12), {"train.position_m": 3000.0}, "numeric")
    info = sweep(wild, tmp_path / "wild")
    assert info["refused"] == info["alone"]["its start is refused"] > 0
    assert info["complete"] == 12 - info["refused"]
    late = [{"kind": "reroute", "train": 2, "crossover": "leave", "time_s": 9.0}]
    ordered = SweepPlan("fully_distributed", {**SHORT, "event": [late]}, range(10), {}, "numeric")
    assert sweep(ordered, tmp_path / "ordered")["alone"] == {"it has events during the run": 10}
    assert sweep(MANY, tmp_path / "kept", keep=True)["alone"] == {"--keep asks for its tables": 26}


def test_a_law_that_takes_one_run_alone_gets_them_one_by_one(here, tmp_path, monkeypatch):
    from trainctl.controllers import fully_distributed

    whole = fully_distributed.constants

    def one_only(params, scene):
        if len(scene.trains) > 6:
            raise ValueError("six trains are the most")
        return whole(params, scene)

    monkeypatch.setattr(fully_distributed, "constants", one_only)
    info = sweep(SweepPlan("fully_distributed", SHORT, range(20), {}, "numeric"), tmp_path / "a", workers=1)
    assert info["complete"] == 20
    assert info["alone"] == {"ValueError: six trains are the most": 20}


def test_a_run_like_another_is_the_one_it_is_by_itself():
    """All that is in the model, and a start that is not sound is told in the words of its own reading."""
    (batch,) = sweeping.batches(SweepPlan(MANY.scenario, {"topology.loss": [0.2]}, range(4), {"train.speed_mps": 4.0}, "numeric"))
    jobs = batch.each()
    like = job_model(jobs[0])
    for job in jobs[1:]:
        one, other = job_model(job, like=like), job_model(job)
        assert one.scenario == other.scenario
        for name in ("own", "bounds", "reference", "plan", "first_links", "consists", "clamps"):
            assert repr(getattr(one, name)) == repr(getattr(other, name)), name
        assert one.roster.edge.tolist() == other.roster.edge.tolist() and one.roster.routes == other.roster.routes
        assert one.radio.key.tolist() == other.radio.key.tolist() != like.radio.key.tolist()
    wild = jobs[1]._replace(jitter={"train.position_m": 9000.0})
    told = []
    for way in ({}, {"like": like}):
        with pytest.raises(InputError) as refused:
            job_model(wild, **way)
        told.append(refused.value.mistakes)
    assert told[0] == told[1]
