"""What a claim is, and how a verdict follows from what was measured."""

from __future__ import annotations

from typing import NamedTuple

REPRODUCED = "reproduced"
WITH_CORRECTION = "with correction"
NOT = "not reproducible"


class Claim(NamedTuple):
    """One claim of a paper and what comes out here."""

    paper: str
    claim: str
    paper_value: float | str  # as stated
    measured: float | str
    unit: str
    verdict: str
    note: str


def claim(
    text: str, stated: float | str, measured: float | str, unit: str, holds: bool, note: str = "", corrected: bool = False
) -> Claim:
    """A claim with its verdict: it holds as printed, holds with the correction that ``note`` names, or does not."""
    verdict = NOT if not holds else WITH_CORRECTION if corrected else REPRODUCED
    return Claim("", text, stated, measured, unit, verdict, note)


def span(low: float, high: float) -> str:
    """A range in words."""
    return f"{low:.5g} .. {high:.5g}"
