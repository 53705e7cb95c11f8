"""Claims: verdicts follow from numbers, tables are complete, the README shows what is measured."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from trainctl.claims import NOT, PAPERS, REPRODUCED, WITH_CORRECTION, as_markdown, measure
from trainctl.claims.claim import claim, span

README = Path(__file__).parents[2] / "README.md"


@pytest.fixture(scope="module")
def quick():
    """The two papers whose claims take a second each."""
    return measure(["fully_distributed", "robust_constrained"])


def by_text(claims, words):
    (found,) = [c for c in claims if words in c.claim]
    return found


def test_verdict_follows_from_what_was_measured():
    assert claim("a", 1, 1, "m", True).verdict == REPRODUCED
    assert claim("a", 1, 1, "m", True, corrected=True).verdict == WITH_CORRECTION
    assert claim("a", 1, 2, "m", False, corrected=True).verdict == NOT
    assert span(-2, 1 / 3) == "-2 .. 0.33333"


def test_every_row_is_complete(quick):
    assert {c.paper for c in quick} == {"fully_distributed", "robust_constrained"}
    for c in quick:
        assert c.claim
        assert c.verdict in (REPRODUCED, WITH_CORRECTION, NOT)
        assert isinstance(c.measured, str) or np.isfinite(float(c.measured))
        if c.verdict == NOT:
            assert c.note, c.claim
    assert len({c.claim for c in quick}) == len(quick)


def test_known_verdicts(quick):
    assert by_text(quick, "O2: speeds").verdict == REPRODUCED
    assert by_text(quick, "O1: spacings").verdict == WITH_CORRECTION
    assert by_text(quick, "only relative positions").verdict == NOT
    bound = by_text(quick, "Theorem 1 bounds the error by 7694 m")
    assert bound.verdict == NOT
    assert bound.measured == pytest.approx(2.77e8, rel=0.01)
    usable = by_text(quick, "a bound on the error for any disturbance")
    assert usable.measured == pytest.approx(94.0, abs=0.01)


def test_a_law_that_does_worse_gets_another_verdict(monkeypatch):
    """Computed, not typed: with the lead left out the formation never settles and the verdicts say so."""
    module = import_module("trainctl.claims.fully_distributed")
    runs = module.Runs()
    runs.__dict__["example"] = module.run(module.BEFORE, module.AFTER, lead=1.0)
    found = list(module.objectives(runs))
    assert by_text(found, "O3: speeds").verdict == NOT
    assert by_text(found, "O3: spacings").verdict == NOT


def test_progress_counts_to_the_end():
    seen = []
    measure(["robust_constrained"], lambda done, steps: seen.append((done, steps)))
    assert seen[0][0] == 0
    assert seen[-1][0] == seen[-1][1] == len(import_module("trainctl.claims.robust_constrained").MEASUREMENTS)


def rows_of(markdown):
    return [line for line in markdown.splitlines() if line.startswith("| ") and not line.startswith(("| claim", "| ---"))]


def test_readme_shows_all_papers_and_what_is_measured(quick):
    table = re.search(r"<!-- claims -->\n(.*?)<!-- end of claims -->", README.read_text(encoding="utf-8"), re.S).group(1)
    assert all(title in table for title in PAPERS.values())

    def words(row):  # rounding residues differ between machines
        cells = row.split(" | ")
        return [cells[0], cells[1], *cells[3:]]

    shown = {tuple(words(row)) for row in rows_of(table)}
    missing = [row for row in rows_of(as_markdown(quick)) if tuple(words(row)) not in shown]
    assert missing == [], "run `trainctl claims --markdown` and put it between the markers in README.md"


@pytest.mark.campaign
def test_all_claims_take_less_than_a_minute():
    import time

    began = time.perf_counter()
    found = measure()
    assert time.perf_counter() - began < 60.0
    assert {c.paper for c in found} == set(PAPERS)
