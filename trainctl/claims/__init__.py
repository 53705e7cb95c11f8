"""The claims of the papers, measured: every number, table and "validates that" sentence of their examples.

One module per paper holds the paper's example as printed (with the readings named) and the measurements. What comes out is computed
each time; the tests of the papers measure with the same functions. ``README.md`` beside this file is the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import as_completed
from functools import cached_property
from importlib import import_module
from typing import Any

from trainctl.citation import PAPERS
from trainctl.claims.claim import BEYOND, NOT, REPRODUCED, VERDICTS, WITH_CORRECTION, Claim
from trainctl.processes import processes

__all__ = [
    "BEYOND", "NOT", "REPRODUCED", "VERDICTS", "WITH_CORRECTION", "Claim", "as_markdown", "counts", "measure",
]  # fmt: skip


def measure(
    papers: Sequence[str] = tuple(PAPERS), progress: Callable[[int, int], Any] | None = None, workers: int = 1
) -> list[Claim]:
    """Measure the claims of some papers.

    Parameters
    ----------
    papers : sequence of str
        Keys of ``PAPERS``.
    progress : callable, optional
        Called with (closed loops done, closed loops).
    workers : int
        Processes that run the closed loops; 1: this one alone.

    Returns
    -------
    list of Claim
        In the order of the papers and of their text, the same whatever ``workers`` is.
    """
    modules = {paper: import_module(f"trainctl.claims.{paper}") for paper in papers}
    runs = {paper: module.Runs() for paper, module in modules.items()}
    jobs = [(paper, name) for paper, module in modules.items() for name in loops(module)]
    for done, (paper, name, result) in enumerate(_closed_loops(jobs, workers)):
        if progress is not None:
            progress(done, len(jobs))
        runs[paper].__dict__[name] = result  # where cached_property keeps it
    if progress is not None:
        progress(len(jobs), len(jobs))
    steps: list[tuple[str, Callable[[Any], Iterable[Claim]]]] = [
        (paper, step) for paper, module in modules.items() for step in module.MEASUREMENTS
    ]
    return [claim._replace(paper=paper) for paper, step in steps for claim in step(runs[paper])]


def loops(module: Any) -> list[str]:
    """Names of what the claims of a paper are measured on: the cached properties of its ``Runs``."""
    return [name for name, value in vars(module.Runs).items() if isinstance(value, cached_property)]


def _closed_loops(jobs: Sequence[tuple[str, str]], workers: int) -> Iterable[tuple[str, str, Any]]:
    """Paper, name and result of every job, in any order."""
    if workers == 1:
        yield from map(_closed_loop, *zip(*jobs, strict=True))
        return
    with processes(min(workers, len(jobs))) as pool:
        for job in as_completed([pool.submit(_closed_loop, *job) for job in jobs]):
            yield job.result()


def _closed_loop(paper: str, name: str) -> tuple[str, str, Any]:
    return paper, name, getattr(import_module(f"trainctl.claims.{paper}").Runs(), name)


def counts(claims: Sequence[Claim]) -> str:
    """How many claims have which verdict, in words."""
    found = {verdict: sum(claim.verdict == verdict for claim in claims) for verdict in VERDICTS}
    return ", ".join(f"{number} {verdict}" for verdict, number in found.items() if number)


def as_markdown(claims: Sequence[Claim]) -> str:
    """A Markdown table per paper."""
    parts = []
    for paper in dict.fromkeys(claim.paper for claim in claims):
        rows = [claim for claim in claims if claim.paper == paper]
        parts += [
            f"## `{paper}`",
            "",
            f"{PAPERS[paper].text()}",
            "",
            f"{len(rows)} claims: {counts(rows)}.",
            "",
            "| claim | paper | measured | unit | verdict | note |",
            "| --- | --- | --- | --- | --- | --- |",
        ]
        parts += ["| " + " | ".join(_cell(value) for value in claim[1:]) + " |" for claim in rows] + [""]
    return "\n".join(parts).rstrip()


def _cell(value: Any) -> str:
    return (f"{value:.5g}" if isinstance(value, float) else str(value)).replace("|", "\\|")
