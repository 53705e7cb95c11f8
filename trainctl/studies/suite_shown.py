"""The suite as a table and as one page."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trainctl.studies.results import percents
from trainctl.studies.stops import REFUSED
from trainctl.studies.suite import SITUATIONS, SuitePlan

STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; margin: 2em; color: #222; }
table { border-collapse: collapse; } th, td { padding: .35em .7em; text-align: left; border-bottom: 1px solid #ddd; }
td { white-space: nowrap; }
td small { color: #555; display: block; } .good { background: #e3f4ec; } .bad { background: #fbe3d6; } .refused { color: #777; }
"""


def words(cell: Mapping[str, Any]) -> str:
    """What came of a cell, short: so many runs failed, with the interval of the share."""
    if cell["what"] == REFUSED:
        return REFUSED
    return f"{cell['failed']} of {cell['of']} ({percents(cell['interval_95'])})"


def grid(cells: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str], dict[tuple[str, str], Mapping[str, Any]]]:
    """Rows, situations, and the cell of each pair."""
    known = {(cell["row"], cell["situation"]): cell for cell in cells}
    return list(dict.fromkeys(row for row, _ in known)), list(dict.fromkeys(name for _, name in known)), known


def confirmed(cells: Sequence[Mapping[str, Any]]) -> str:
    """What SUMO says of the first runs of the cells, in words."""
    ran = [cell for cell in cells if cell["sumo_failed"] is not None]
    if not ran:
        return "No cell was run in SUMO."
    off = max(abs(cell["sumo_gap_m"] - cell["first_gap_m"]) for cell in ran)
    return f"SUMO moved the trains of one run of each of {len(ran)} cells as well: minimum gaps differ by at most {off:.2g} m."


def page(cells: Sequence[Mapping[str, Any]], plan: SuitePlan) -> str:
    """One self-contained page: a row per law, a column per situation, what each situation is, and why cells were refused."""
    rows, names, known = grid(cells)
    head = "".join(f"<th>{_text(name)}</th>" for name in names)
    body = "".join(f"<tr><th>{_text(row)}</th>{''.join(_cell(known[row, name]) for name in names)}</tr>" for row in rows)
    about = "".join(f"<li><b>{_text(name)}</b>: {_text(_first(SITUATIONS[name].__doc__))}</li>" for name in names)
    wrong = [cell for cell in known.values() if cell["why"]]
    why = "".join(f"<li>{_text(cell['row'])}, {_text(cell['situation'])}: {html.escape(cell['why'])}</li>" for cell in wrong)
    kmh = 3.6 * plan.stops.speed_mps
    return (
        f"<!doctype html><html lang='en'><meta charset='utf-8'><title>trainctl: the suite</title><style>{STYLE}</style>"
        f"<h1>Laws in situations</h1><p>{plan.stops.trains} trains {plan.spacing_m:g} m apart at {kmh:.3g} km/h, {plan.runs}"
        " runs of each cell. In a cell: runs in which trains touched or one was faster than the line, with the 95 % interval of"
        " that share; of these, in how many they touched, and by how much the fastest was too fast; minimum gap; largest error"
        f" of a spacing at the end and jerk, medians of the runs. {confirmed(cells)}</p>"
        f"<table><tr><th></th>{head}</tr>{body}</table><h2>Situations</h2><ul>{about}</ul>"
        f"{f'<h2>Refused, or failed</h2><ul>{why}</ul>' if why else ''}</html>\n"
    )


def _text(name: str) -> str:
    return html.escape(name.replace("_", " "))


def _cell(cell: Mapping[str, Any]) -> str:
    if cell["what"] == REFUSED or cell["gap_m"] is None:
        return f"<td class='refused'>{words(cell)}</td>"
    fast = max(cell["faster_mps"], 0.0)
    why = f"touched {cell['contacts']}<br>{fast:.2g} m/s too fast<br>" if cell["failed"] else ""
    more = f"{why}gap {cell['gap_m']:.0f} m<br>error {cell['error_m']:.0f} m<br>jerk {cell['jerk_rms_mps3']:.2g} m/s³"
    return f"<td class='{'bad' if cell['failed'] else 'good'}'>{words(cell)}<small>{more}</small></td>"


def _first(text: str | None) -> str:
    return (text or "").partition("\n")[0]


def write_page(cells: Sequence[Mapping[str, Any]], plan: SuitePlan, out: Path) -> Path:
    """Write ``suite.html`` into ``out``."""
    place = out / "suite.html"
    place.write_text(page(cells, plan), encoding="utf-8")
    return place
