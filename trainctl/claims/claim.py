"""What a claim is, and how a verdict follows from what was measured."""

from __future__ import annotations

from typing import NamedTuple

REPRODUCED = "reproduced"
WITH_CORRECTION = "with correction"
NOT = "not reproducible"
BEYOND = "beyond the paper"

#: Verdict -> what it says, in the order of a count.
VERDICTS = {
    REPRODUCED: "comes out as stated, from what the paper prints; where it prints nothing, the note names what was chosen",
    WITH_CORRECTION: "comes out once a print error is corrected, or a statement read more narrowly, as the note says",
    NOT: "does not come out; the note names every reading and value that was tried",
    BEYOND: "judges what the paper does not say, or an assumption of ours, such as force limits: no verdict on the paper",
}


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
    text: str,
    stated: float | str,
    measured: float | str,
    unit: str,
    holds: bool,
    note: str = "",
    corrected: bool = False,
    beyond: bool = False,
) -> Claim:
    """A claim with its verdict: it holds as printed, holds with the correction that ``note`` names, or does not.

    With ``beyond`` it is not the paper's, or rests on an assumption of ours, and nothing is said of the paper.
    """
    verdict = BEYOND if beyond else NOT if not holds else WITH_CORRECTION if corrected else REPRODUCED
    return Claim("", text, stated, measured, unit, verdict, note)


def span(low: float, high: float) -> str:
    """A range in words."""
    return f"{low:.5g} .. {high:.5g}"
