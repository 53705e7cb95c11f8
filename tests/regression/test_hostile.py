"""No law causes a collision where the supervisor is on; without it the same laws collide in most runs.

There are rows of trains on lines and nets (``hostile``), and traffic with all that files and orders may ask, with trains that turn
back, and with signals (``hostile_traffic``). Runs that were broken off go on to the byte.

A case that fails is kept: its folder has the scenario, its line or net and its law, and the message says how to run it.
"""

from __future__ import annotations

import multiprocessing
import time
import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import hostile
import hostile_traffic
import pytest

#: Unsupervised trains run at 1e300 m/s.
wild = pytest.mark.filterwarnings("ignore::RuntimeWarning")

#: Seeds of the part that always runs: every net, every way to do harm, with and without clamps, steps of 0.2 .. 10 s.
ALWAYS = (0, 5, 6, 10, 13, 14, 15, 17, 18, 19, 21, 23, 25, 27, 29, 34, 38, 40, 42, 50, 51, 53, 56, 57)
ALWAYS_OFF, ALWAYS_SUMO = range(16), (0, 10, 17)

#: The same in traffic, where most railways are busy only at times.
TRAFFIC_ALWAYS, TRAFFIC_ALWAYS_OFF, REVERSING_ALWAYS = range(8), (0, 1, 3, 7), (4, 5, 13, 22)
TRAFFIC_ALWAYS_SUMO = (
    (2, hostile_traffic.drawn), (5, hostile_traffic.reversing), (9, hostile_traffic.signalled), (15, hostile_traffic.signalled),
    (28, hostile_traffic.signalled), (20001, hostile_traffic.signalled),
)  # fmt: skip


def parts(begin: int, end: int, size: int) -> list[range]:
    """Seeds of the campaign in parts that take some minutes each."""
    return [range(a, min(a + size, end)) for a in range(begin, end, size)]


#: Seeds of the campaign. Those of SUMO are others, and as many run with the supervisor off.
CAMPAIGN, CAMPAIGN_SUMO, CAMPAIGN_OFF = parts(10_000, 13_000, 500), parts(20_000, 20_200, 100), range(10_000, 10_300)
TRAFFIC, REVERSING, TRAFFIC_OFF = parts(10_000, 11_000, 250), parts(10_000, 10_400, 200), range(10_000, 10_100)
TRAFFIC_SUMO, RESUMED = range(20_000, 20_100), range(30_000, 30_012)

PROCESSES = 2


class Report(NamedTuple):
    """What became of one run, in what goes from one process to another."""

    seed: int
    kind: str
    what: str
    words: str
    failures: list[str]
    folder: str
    steps: int
    seconds: float


#: Draws a case from a seed, a folder and plants.
Draws = Callable[[int, Path, hostile.Plants], hostile.Case]


def one(place: Path, draws: Draws, plants: hostile.Plants, mode: str, backend: str, seed: int) -> Report:
    """Draw, run and judge one case."""
    case = draws(seed, place, plants)
    found = hostile.driven(case, mode, backend)
    report = Report(
        seed, case.kind, found.what, found.words, found.failures, str(case.folder), found.steps, found.seconds
    )  # fmt: skip
    if not report.failures:
        hostile.forget(case)
    return report


def told(report: Report, backend: str) -> str:
    """A failure, and how to see it again."""
    return (
        f"seed {report.seed} ({report.kind}): {'; '.join(report.failures)}\n"
        f"    trainctl run {report.folder}/s.toml --backend {backend} --out {report.folder}/again"
    )


def counted(reports: list[Report]) -> Counter[str]:
    """How many runs ended how, and in how many there was what."""
    found = Counter(report.what for report in reports)
    for report in reports:
        found.update({failure.partition(":")[0] for failure in report.failures})
    return found


def refusals(reports: list[Report]) -> Counter[str]:
    """Why runs were refused: the keys that were named."""
    return Counter(hostile.reason(report.words) for report in reports if report.what == "refused")


def harmless(reports: list[Report], backend: str) -> None:
    """Nothing happened that must not, and not because most was refused."""
    failed = [told(report, backend) for report in reports if report.failures]
    assert not failed, f"{len(failed)} of {len(reports)} runs failed\n" + "\n".join(failed[:20])
    assert counted(reports)["refused"] < 0.25 * len(reports), refusals(reports)


def test_no_law_causes_a_collision(tmp_path):
    harmless([one(tmp_path, hostile.drawn, hostile.QUICK, "on", "numeric", seed) for seed in ALWAYS], "numeric")


def test_in_sumo_neither(tmp_path):
    harmless([one(tmp_path, hostile.drawn, hostile.QUICK, "on", "sumo", seed) for seed in ALWAYS_SUMO], "sumo")


def test_no_law_causes_a_collision_in_traffic(tmp_path):
    harmless([one(tmp_path, hostile_traffic.drawn, hostile.QUICK, "on", "numeric", seed) for seed in TRAFFIC_ALWAYS], "numeric")


def test_in_sumo_neither_in_traffic(tmp_path):
    harmless([one(tmp_path, draws, hostile.QUICK, "on", "sumo", seed) for seed, draws in TRAFFIC_ALWAYS_SUMO], "sumo")


def test_no_law_causes_a_collision_where_trains_turn_back(tmp_path):
    harmless(
        [one(tmp_path, hostile_traffic.reversing, hostile.QUICK, "on", "numeric", seed) for seed in REVERSING_ALWAYS], "numeric"
    )


#: Which runs are broken off, and on what.
RESUMES = {
    "traffic": (hostile_traffic.drawn, "numeric"), "reversing": (hostile_traffic.reversing, "numeric"),
    "reversing in sumo": (hostile_traffic.reversing, "sumo"), "signalled": (hostile_traffic.signalled, "sumo"),
}  # fmt: skip


@pytest.mark.parametrize("draws, backend", [RESUMES[key] for key in ("reversing", "signalled")], ids=["reversing", "signalled"])
def test_a_hostile_run_resumes_to_the_byte(draws, backend, tmp_path):
    for seed in (4, 5):
        assert hostile_traffic.resumed(draws(seed, tmp_path, hostile.QUICK), backend, 0.6) == []


@wild
def test_without_the_supervisor_these_collide_in_traffic(tmp_path):
    reports = [one(tmp_path, hostile_traffic.drawn, hostile.QUICK, "off", "numeric", seed) for seed in TRAFFIC_ALWAYS_OFF]
    assert counted(reports)["overlap"] == len(TRAFFIC_ALWAYS_OFF)


@wild
def test_without_the_supervisor_most_runs_collide(tmp_path):
    reports = [one(tmp_path, hostile.drawn, hostile.QUICK, "off", "numeric", seed) for seed in ALWAYS_OFF]
    found = counted(reports)
    judged = len(reports) - found["refused"]
    assert found["overlap"] > 0.5 * judged
    assert sum(bool({"overlap", "overspeed"} & {f.partition(":")[0] for f in r.failures}) for r in reports) > 0.8 * judged
    assert not [told(r, "numeric") for r in reports if any(f.startswith("silence") for f in r.failures)]


def campaign(title: str, seeds: range, place: Path, draws: Draws, mode: str, backend: str) -> list[Report]:
    """Run all seeds on some processes, with a line every so often and the figures at the end."""
    began, reports = time.monotonic(), []
    strict = partial(warnings.simplefilter, "error" if mode == "on" else "ignore", RuntimeWarning)
    with multiprocessing.get_context("spawn").Pool(PROCESSES, strict) as pool:
        for report in pool.imap_unordered(partial(one, place, draws, hostile.PLANTS, mode, backend), seeds):
            reports.append(report)
            if report.failures and mode == "on":
                print(told(report, backend), flush=True)
            if len(reports) % 100 == 0 or len(reports) == len(seeds):
                took, work = time.monotonic() - began, sum(report.seconds for report in reports)
                print(
                    f"{title}: {len(reports)} of {len(seeds)}, {took:.0f} s, {len(reports) / work:.2f} runs per s of a core: ",
                    end="",
                )
                print(dict(counted(reports)), flush=True)
    print(
        f"{title}: refused for {dict(refusals(reports))}; died: {dict(Counter(r.words[:60] for r in reports if r.what == 'died'))}"
    )
    return sorted(reports)


@pytest.mark.campaign
@pytest.mark.parametrize("seeds", CAMPAIGN, ids=str)
def test_three_thousand_runs(seeds, tmp_path):
    harmless(campaign("on", seeds, tmp_path, hostile.drawn, "on", "numeric"), "numeric")


@pytest.mark.campaign
@pytest.mark.parametrize("seeds", TRAFFIC, ids=str)
def test_a_thousand_runs_in_traffic(seeds, tmp_path):
    harmless(campaign("traffic", seeds, tmp_path, hostile_traffic.drawn, "on", "numeric"), "numeric")


@pytest.mark.campaign
@pytest.mark.parametrize("seeds", REVERSING, ids=str)
def test_hundreds_of_runs_in_traffic_that_turns_back(seeds, tmp_path):
    harmless(campaign("turning", seeds, tmp_path, hostile_traffic.reversing, "on", "numeric"), "numeric")


@pytest.mark.campaign
@pytest.mark.parametrize("draws, backend", RESUMES.values(), ids=RESUMES)
def test_dozens_of_runs_in_traffic_resume_to_the_byte(draws, backend, tmp_path):
    cases = [draws(seed, tmp_path, hostile.PLANTS) for seed in RESUMED]
    found = {case.seed: hostile_traffic.resumed(case, backend, 0.2 + 0.06 * k) for k, case in enumerate(cases)}
    assert not any(found.values()), found
    assert list(found.values()).count(None) < 0.5 * len(found)


@pytest.mark.campaign
@pytest.mark.parametrize("seeds, draws", [
    *((seeds, hostile.drawn) for seeds in CAMPAIGN_SUMO), (TRAFFIC_SUMO, hostile_traffic.drawn),
    (TRAFFIC_SUMO, hostile_traffic.signalled), (TRAFFIC_SUMO, hostile_traffic.reversing),
], ids=["a", "b", "traffic", "signalled", "reversing"])  # fmt: skip
def test_hundreds_of_runs_in_sumo(seeds, draws, tmp_path):
    harmless(campaign("SUMO", seeds, tmp_path, draws, "on", "sumo"), "sumo")


@pytest.mark.campaign
@pytest.mark.parametrize("seeds, draws", [(CAMPAIGN_OFF, hostile.drawn), (TRAFFIC_OFF, hostile_traffic.drawn)])
def test_most_of_them_collide_without(seeds, draws, tmp_path):
    found = counted(campaign("off", seeds, tmp_path, draws, "off", "numeric"))
    assert found["overlap"] > (0.5 if draws is hostile.drawn else 0.35) * (found["done"] + found["died"])
