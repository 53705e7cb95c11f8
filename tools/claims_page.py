"""Write trainctl/claims/README.md and the summary of the claims in README.md.

trainctl claims --json > claims.json
python tools/claims_page.py claims.json
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from trainctl.citation import PAPERS
from trainctl.claims import VERDICTS, Claim, as_markdown, counts

ROOT = Path(__file__).resolve().parent.parent
PAGE, README = ROOT / "trainctl" / "claims" / "README.md", ROOT / "README.md"
BEGIN, END = "<!-- claims -->", "<!-- end of claims -->"

HEAD = f"""# The claims of the papers

Every number, bound and "validates that" sentence of the four papers, measured by `trainctl claims` (some 15 s on two cores;
`--paper NAME` for one of them, `--json` for machines). Nothing on this page is typed in: `tools/claims_page.py` writes it.

| verdict | meaning |
| --- | --- |
{chr(10).join(f"| {verdict} | {words} |" for verdict, words in VERDICTS.items())}

A print error counts against the rows it concerns directly; the other rows of that paper are measured with it corrected. Figures are
compared with what the text says of them, since their values are not in the text: times are taken to be good to 10 %. *measured* is
what comes out here, in the unit of its row; where mistakes or violations are counted, 0 is success, and where a row is about the
equations as printed, it shows what these give and the note says what is right. Laws, corrections and departures in full:
[`controllers`](../controllers/README.md)."""


def summary(claims: Sequence[Claim]) -> str:
    """A line per paper."""
    rows = {paper: [claim for claim in claims if claim.paper == paper] for paper in PAPERS}
    return "\n".join(
        f"- `{paper}`, {', '.join(author.split()[-1] for author in PAPERS[paper].authors)}: {len(found)} claims, {counts(found)}"
        for paper, found in rows.items()
    )


def main() -> int:
    """Rewrite both pages."""
    claims = [Claim(**row) for row in json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))]
    PAGE.write_text(f"{HEAD}\n\n{as_markdown(claims)}\n", encoding="utf-8")
    old = README.read_text(encoding="utf-8")
    new = re.sub(f"{BEGIN}\n.*?{END}", lambda _: f"{BEGIN}\n{summary(claims)}\n{END}", old, flags=re.S)
    README.write_text(new, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
