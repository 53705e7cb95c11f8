"""The comparison as one HTML page that opens offline: findings, both curves with the tube, every column, all notes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from trainctl.diff.columns import floats, resolution
from trainctl.diff.findings import Finding, counted, short
from trainctl.diff.rows import TableDiff
from trainctl.diff.runs import Report, at, told
from trainctl.diff.tally import Evidence
from trainctl.diff.tube import GAP_S, half_widths, tube
from trainctl.figures.style import envelope
from trainctl.record.folder import plain
from trainctl.signals import Floats

#: The page may ask for nothing.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:"
#: Plots of one page, points of one line.
PLOTS, POINTS = 24, 600
#: A plot shows so much of the curves before the first difference, and after the last, of the time between [share].
AROUND = 0.15
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 1100, 260, 76, 12, 10, 34


class Curves(NamedTuple):
    """What one plot shows: a column of a train in both logs, and the tube round the first."""

    title: str
    time_a: Floats
    a: Floats
    time_b: Floats
    b: Floats
    lower: Floats
    upper: Floats
    at: float


def page(report: Report) -> str:
    """The whole page as text."""
    with np.errstate(over="ignore", invalid="ignore"):  # a damaged log may hold any number
        return _page(report)


def _page(report: Report) -> str:
    plots = [(f, c) for f in report.findings for c in _curves(f, report)][:PLOTS]
    shown: dict[int, list[str]] = {}
    data = []
    for number, (f, curves) in enumerate(plots):
        figure, values = _figure(curves, number)
        shown.setdefault(id(f), []).append(figure)
        data.append(values)
    body = "".join(_finding(f, n, shown.get(id(f), [])) for n, f in enumerate(report.findings, 1))
    rows = sum(t.rows for t in report.tables)
    names = escape(", ".join(t.table for t in report.tables))
    verdict = (
        f'<p class="verdict held">No difference in {counted(rows, "row")} of {names}.</p>'
        if report.same
        else f'<p class="verdict broken">{counted(len(report.findings), "finding")} in {rows} compared rows. '
        f"First: {escape(report.first or '')}</p>"
    )
    notes = "".join(f"<li>{escape(note)}</li>" for note in report.notes)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{POLICY}">
<link rel="icon" href="data:,">
<title>{escape(report.b)} against {escape(report.a)} · trainctl</title>
<style>{_file("trainctl.report", "report.css")}{_file("trainctl.diff", "diff.css")}</style>
</head>
<body>
<header><div><h1>Comparison of logs</h1>
<p class="about">A, the reference: {escape(report.a)}<br>B: {escape(report.b)}</p></div></header>
<main>
{verdict}
<section><h2>Findings</h2>{body or '<p class="keys">None.</p>'}</section>
<section><h2>Columns that differ</h2>{_columns(report.tables)}</section>
<section><h2>Notes</h2><ul>{notes or "<li>none</li>"}</ul></section>
</main>
<script type="application/json" id="data">{_inline(data)}</script>
<script>{_file("trainctl.diff", "diff.js")}</script>
</body>
</html>
"""


def _file(package: str, name: str) -> str:
    return (files(package) / "templates" / name).read_text(encoding="utf-8")


def _inline(data: object) -> str:
    """JSON that may stand inside a script element."""
    text = json.dumps(plain(data), separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def _finding(f: Finding, number: int, figures: list[str]) -> str:
    lines = []
    for label, d in (("first", f.first), ("largest", f.largest)):
        if d is not None:
            lines.append(f"<tr><td>{label}</td><td>{escape(at(d.place.time_s, d.place.who))}</td><td>{escape(d.column)}</td>"
                         f"<td>{escape(told(d.place))}</td></tr>")  # fmt: skip
    table = f"<table>{''.join(lines)}</table>" if lines else ""
    columns = f'<p class="keys">Columns: {escape(", ".join(f.columns))}</p>' if f.columns else ""
    where = f'<p class="keys">{escape(f.where)}</p>' if f.where else ""
    return f'<article class="finding"><h3>{number}. {escape(f.words)}</h3>{where}{columns}{table}{"".join(figures)}</article>'


def _columns(tables: Sequence[TableDiff]) -> str:
    rows = []
    for t in tables:
        for c in t.columns.values():
            most = c.largest or c.first
            if most is not None and c.first is not None:
                cells = (f"{t.table}.{c.column}", f"{c.differing} of {t.rows}", c.tolerance.told(), at(c.first.time_s, c.first.who),
                         at(most.time_s, most.who), told(most))  # fmt: skip
                rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    if not rows:
        return '<p class="keys">None.</p>'
    heads = "".join(f'<th scope="col">{h}</th>' for h in ("column", "rows", "tolerance", "first at", "most at", "A → B"))
    return f"<table><thead><tr>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _curves(f: Finding, report: Report) -> list[Curves]:
    """What a finding's plots show: the column and train of its largest difference, then of its first."""
    out: list[Curves] = []
    done = set()
    for d in (f.largest, f.first):
        for t in report.tables:
            if (
                d is None
                or t.time is None
                or t.table not in f.codes
                or d.column not in t.tallies
                or not t.tallies[d.column].numbers
            ):
                continue
            name = d.place.who.removeprefix(f"{t.keys[0]} ") if t.keys else ""
            name = name.partition(f", {t.keys[1]} ")[0] if len(t.keys) > 1 else name
            train = next((k for k in f.codes[t.table] if t.trains[k] == name), None)
            if train is None or (t.table, d.column, train) in done:
                continue
            done.add((t.table, d.column, train))
            found = _of(t, d.column, train, report)
            out += [found] if found is not None else []
    return out[:2]


def _of(t: TableDiff, column: str, train: int, report: Report) -> Curves | None:
    sides = [_series(evidence, train, column) for evidence in (t.rows_a, t.rows_b)]
    (time_a, a, decimal), (time_b, b, other) = sides
    if len(time_a) < 2 and len(time_b) < 2:
        return None
    tolerance = report.tolerances.of(t.table, column)
    absolute = tolerance.absolute if tolerance.stated else max(tolerance.absolute, 1.01 * decimal, 1.01 * other)
    known = a[np.isfinite(a)]
    span = float(np.ptp(known)) if len(known) else 0.0
    duration = float(np.ptp(time_a)) if len(time_a) else 0.0
    h = half_widths(absolute, tolerance.relative, tolerance.range, a, span)
    w = half_widths(tolerance.time_s, tolerance.time_relative, tolerance.time_range, time_a, duration)
    lower, upper = (a - h, a + h) if not tolerance.in_time else tube(time_a, a, w, h, time_a)
    name = f"{t.table}.{column}{f', {t.keys[0]} {short(t.trains[train])}' if t.keys else ''}; tolerance {tolerance.told()}"
    return Curves(name, time_a, a, time_b, b, lower, upper, float(t.tallies[column].figures["first_s"][train]))


def _series(evidence: Evidence, train: int, column: str) -> tuple[Floats, Floats, float]:
    """Kept values of a column of one train (of its first unit or link), their times, the value of their last decimal."""
    table, time, trains = evidence.rows()
    if column not in table.column_names:
        return np.zeros(0), np.zeros(0), 0.0
    mine = trains == train
    part = table.filter(pa.array(mine))[column]
    values = floats(part)
    if values is None:
        return np.zeros(0), np.zeros(0), 0.0
    unique = np.unique(time[mine], return_index=True)[1]
    return time[mine][unique], values[unique], resolution(part)


def _figure(c: Curves, number: int) -> tuple[str, dict[str, object]]:
    """A plot as SVG, and its values for the cursor."""
    times = np.concatenate([c.time_a, c.time_b])
    edges = np.concatenate([v[np.isfinite(v)] for v in (c.a, c.b, c.lower, c.upper)])
    begin, end = float(times.min()), float(times.max())
    begin = max(begin, c.at - AROUND * (end - c.at) - 5.0)
    inside = [v[(t >= begin) & (t <= end) & np.isfinite(v)] for t, v in ((c.time_a, c.a), (c.time_b, c.b))]
    visible = np.concatenate(inside) if any(len(v) for v in inside) else edges
    low, high = (float(visible.min()), float(visible.max())) if len(visible) else (0.0, 1.0)
    wide = c.upper - c.lower
    pad = 0.06 * (high - low) or max(1e-9, 0.01 * abs(high), float(wide[np.isfinite(wide)].max(initial=0.0)))
    low, high = low - pad, high + pad
    end = end if end > begin else begin + 1.0
    if not (math.isfinite(high - low) and high > low and math.isfinite(end - begin)):
        low, high, begin, end = 0.0, 1.0, 0.0, 1.0  # numbers no picture can show

    def x(t: Floats) -> Floats:
        return LEFT + (t - begin) / (end - begin) * (WIDTH - LEFT - RIGHT)

    def y(v: Floats) -> Floats:
        return np.clip(TOP + (high - v) / (high - low) * (HEIGHT - TOP - BOTTOM), -1e4, 1e4)

    def path(t: Floats, v: Floats) -> str:
        seen = (t >= begin) & (t <= end) & np.isfinite(v)
        if not seen.any():
            return ""
        t, v = envelope(t[seen], v[seen], POINTS)
        jump = np.append(True, np.diff(t) > GAP_S)
        return "".join(f"{'M' if j else 'L'}{p:.1f},{q:.1f}" for j, p, q in zip(jump, x(t), y(v), strict=True))

    band = (c.time_a >= begin) & np.isfinite(c.lower) & np.isfinite(c.upper)
    step = max(1, int(band.sum()) // POINTS)
    at_, lo, up = c.time_a[band][::step], c.lower[band][::step], c.upper[band][::step]
    ring = [*zip(x(at_), y(up), strict=True), *zip(x(at_)[::-1], y(lo)[::-1], strict=True)]
    area = "".join(f"{'L' if k else 'M'}{p:.1f},{q:.1f}" for k, (p, q) in enumerate(ring))
    ticks = []
    for value in _ticks(begin, end, 8):
        p = float(x(np.array([value]))[0])
        ticks.append(f'<line class="grid" x1="{p:.1f}" x2="{p:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
                     f'<text x="{p:.1f}" y="{HEIGHT - BOTTOM + 15}" text-anchor="middle">{value:.10g}</text>')  # fmt: skip
    for value in _ticks(low, high, 5):
        q = float(y(np.array([value]))[0])
        ticks.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{q:.1f}" y2="{q:.1f}"/>'
                     f'<text x="{LEFT - 6}" y="{q + 4:.1f}" text-anchor="end">{value:.10g}</text>')  # fmt: skip
    mark = float(x(np.array([min(max(c.at, begin), end)]))[0])
    ends = f'y1="{TOP}" y2="{HEIGHT - BOTTOM}"'
    svg = (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" data-plot="{number}"'
        f' aria-label="{escape(c.title)}: A, B and the tube over time">{"".join(ticks)}'
        f'<path class="tube" d="{area}Z"/><line class="since" x1="{mark:.1f}" x2="{mark:.1f}" {ends}/>'
        f'<path class="curve a" d="{path(c.time_a, c.a)}"/><path class="curve b" d="{path(c.time_b, c.b)}"/>'
        f'<line class="cursor-line" x1="-9" x2="-9" {ends}/>'
        f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 4}" text-anchor="end">time [s]</text></svg>'
    )
    keys = {"a": "A", "b": "B", "tube": "tube round A", "since": "first difference"}
    legend = " ".join(f'<span class="key {name}">{words}</span>' for name, words in keys.items())
    figure = f'<figure><figcaption>{escape(c.title)} · {legend} <output class="value"></output></figcaption>{svg}</figure>'
    values = {
        "begin": begin, "end": end, "left": LEFT, "right": WIDTH - RIGHT,
        "a": _thin(c.time_a, c.a), "b": _thin(c.time_b, c.b), "lower": _thin(c.time_a, c.lower), "upper": _thin(c.time_a, c.upper),
    }  # fmt: skip
    return figure, values


def _thin(t: Floats, v: Floats) -> list[list[float]]:
    """Points for the cursor, at most twice ``POINTS``."""
    step = max(1, len(t) // (2 * POINTS))
    return [[float(p), float(f"{q:.10g}")] for p, q in zip(t[::step], v[::step], strict=True)]


def _ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers within an interval."""
    raw = (high - low) / most
    size = 10.0 ** np.floor(np.log10(raw))
    step = next(float(k * size) for k in (1, 2, 5, 10) if k * size >= raw)
    return [float(f"{k * step:.12g}") for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]
