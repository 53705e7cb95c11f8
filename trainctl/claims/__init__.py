"""The claims of the papers, measured: every number, table and "validates that" sentence of their examples.

One module per paper holds the paper's example as printed (with the readings named) and the measurements. What comes out is computed
each time; the tests of the papers measure with the same functions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from typing import Any

from trainctl.claims.claim import NOT, REPRODUCED, WITH_CORRECTION, Claim

__all__ = ["NOT", "PAPERS", "REPRODUCED", "WITH_CORRECTION", "Claim", "as_markdown", "measure"]

#: Papers: the name used here -> how it is cited.
PAPERS = {
    "fully_distributed": "Zhang, Chen, Fang: Cooperative Control of Constrained Discrete-Time Multi-Train Systems",
    "emu_finite_time": "Wei, Ge, Wu: Finite-time distributed cooperative cruise control of EMU groups",
    "robust_constrained": "Hu, Fan, Wei: Robust Constrained Cooperative Control for Multiple Trains",
    "fault_tolerant": "Zhang, Chen: Asymptotical Cooperative Cruise Fault Tolerant Control for Multiple High-speed Trains",
}


def measure(papers: Sequence[str] = tuple(PAPERS), progress: Callable[[int, int], Any] | None = None) -> list[Claim]:
    """Measure the claims of some papers.

    Parameters
    ----------
    papers : sequence of str
        Keys of ``PAPERS``.
    progress : callable, optional
        Called with (measurements done, measurements).

    Returns
    -------
    list of Claim
        In the order of the papers and of their text.
    """
    steps: list[tuple[str, Callable[[Any], Iterable[Claim]], Any]] = []
    for paper in papers:
        module = import_module(f"trainctl.claims.{paper}")
        runs = module.Runs()
        steps += [(paper, step, runs) for step in module.MEASUREMENTS]
    found: list[Claim] = []
    for k, (paper, step, runs) in enumerate(steps):
        if progress is not None:
            progress(k, len(steps))
        found += [claim._replace(paper=paper) for claim in step(runs)]
    if progress is not None:
        progress(len(steps), len(steps))
    return found


def as_markdown(claims: Sequence[Claim]) -> str:
    """A Markdown table per paper."""
    parts = []
    for paper in dict.fromkeys(claim.paper for claim in claims):
        rows = [claim for claim in claims if claim.paper == paper]
        parts += [
            f"**{PAPERS[paper]}** (`{paper}`)",
            "",
            "| claim | paper | measured | unit | verdict | note |",
            "| --- | --- | --- | --- | --- | --- |",
        ]
        parts += ["| " + " | ".join(_cell(value) for value in claim[1:]) + " |" for claim in rows] + [""]
    return "\n".join(parts).rstrip()


def _cell(value: Any) -> str:
    return (f"{value:.5g}" if isinstance(value, float) else str(value)).replace("|", "\\|")
