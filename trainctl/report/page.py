"""One page per run, ``report.html``: verdicts, an animation of the tracks and linked plots. It opens offline."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from trainctl.citation import works
from trainctl.errors import InputError
from trainctl.figures.trains import Drawn, drawable
from trainctl.metrics.run import DEFINITIONS, SLACK
from trainctl.metrics.versions import current
from trainctl.record.folder import plain
from trainctl.report.animation import animation
from trainctl.report.panels import panels
from trainctl.runs.outcome import summary
from trainctl.runs.run import Run

#: Bounds in words, by the name of their margin.
BOUNDS = {
    "spacing_lower_margin_m": ("spacing above its lower bound", "m"),
    "spacing_upper_margin_m": ("spacing below its upper bound", "m"),
    "speed_lower_margin_mps": ("speed above its lower bound", "m/s"),
    "speed_upper_margin_mps": ("speed below its upper bound", "m/s"),
    "input_lower_margin_mps2": ("input above its lower bound", "m/s²"),
    "input_upper_margin_mps2": ("input below its upper bound", "m/s²"),
    "coupler_lower_margin_m": ("coupler stroke above its lower bound", "m"),
    "coupler_upper_margin_m": ("coupler stroke below its upper bound", "m"),
}

#: What else the summary names: metric -> words, by group.
FIGURES = {
    "Formation": {
        "formation.settling_s": "all links within 1 m from",
        "formation.last_link_s": "last recorded link",
        "formation.final_error_m": "largest spacing error at that time",
        "formation.final_speed_error_mps": "largest speed error at the end",
        "string.l2_gain": "growth of the spacing error from link to link",
    },
    "Traffic": {
        "traffic.gap_min_m": "smallest gap between trains",
        "traffic.headway_min_s": "shortest headway",
        "traffic.trains_per_hour": "trains per hour",
        "traffic.collisions": "collisions that SUMO counted",
        "traffic.teleports": "trains that SUMO teleported",
        "punctuality.stop_delay_mean_s": "mean delay at stops",
        "punctuality.stop_delay_max_s": "largest delay at a stop",
    },
    "Energy and comfort": {
        "energy.traction_kwh": "traction at the wheel",
        "energy.net_kwh_per_train_km": "net energy per train-km",
        "comfort.acceleration_min_mps2": "strongest braking",
        "comfort.jerk_max_mps3": "largest jerk",
    },
}

#: When a value is bad, and why.
BAD: dict[str, tuple[Callable[[float], bool], str]] = {
    "formation.final_error_m": (lambda v: v > 1.0, "above 1 m"),
    "string.l2_gain": (lambda v: v > 1.0, "above 1: errors grow"),
    "traffic.gap_min_m": (lambda v: v < 0.0, "trains overlap"),
    "traffic.collisions": (lambda v: v > 0, "none is allowed"),
    "traffic.teleports": (lambda v: v > 0, "none is allowed"),
    "punctuality.stop_delay_max_s": (lambda v: v > 180.0, "above 3 min"),
}

#: In place of the animation.
NO_FILM = (
    '<p class="keys">There is no animation: without SUMO, a run does not know where the tracks of its net lie. The plots below show'
    " every train.</p>"
)


def report(run: Run, out: Path | str | None = None, *, clock: bool = False, kmh: bool = False) -> Path:
    """Write the page of a run.

    Parameters
    ----------
    run : Run
        A run folder.
    out : Path, optional
        The file; default ``report.html`` in the run folder.
    clock : bool
        Time in hours and minutes of the run.
    kmh : bool
        Speeds in km/h.

    Returns
    -------
    Path
        The file.
    """
    path = Path(out) if out is not None else run.folder / "report.html"
    text = page(run, clock=clock, kmh=kmh)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    return path


def page(run: Run, *, clock: bool = False, kmh: bool = False) -> str:
    """The whole page as text."""
    from plotly.offline import get_plotlyjs

    drawn = drawable(run, clock=clock, kmh=kmh)
    if not drawn.trains.names:
        raise InputError(f"{run.folder}: no train was recorded")
    values = current(run)
    film = animation(drawn)
    span = [float(drawn.instants[0]), float(drawn.instants[-1])]
    data: dict[str, Any] = {"animation": film, "panels": panels(drawn), "title": drawn.known.title, "span": span}
    data |= {"clock": drawn.clock, "per_mps": drawn.per_mps, "speed_unit": drawn.speed_unit}
    parts = {
        "title": escape(drawn.known.title or run.folder.name),
        "css": _template("report.css"),
        "library": get_plotlyjs(),
        "script": _template("report.js"),
        "data": _inline(data),
        "about": _about(drawn),
        "verdict": _outcome(drawn.run) + _verdict(values, drawn.run) + _of_files(drawn.run),
        "bounds": _bounds(values),
        "unbounded": "" if _margins(values) else "hidden",
        "figures": _figures(values),
        "origin": escape(drawn.origin),
        "cite": _cited(drawn),
        "events": _events(film),
        "tracks": "On the net" if drawn.known.traffic else "On the tracks",
        "no_film": "" if film["time"] else NO_FILM,
        "hidden": "" if film["time"] else "hidden",
    }
    return _filled(_template("report.html"), parts)


def _template(name: str) -> str:
    return (files("trainctl.report") / "templates" / name).read_text(encoding="utf-8")


def _filled(template: str, parts: Mapping[str, str]) -> str:
    """The template with each ``{{name}}`` replaced; what is put in is not looked at again."""
    out = []
    for piece in template.split("{{"):
        name, closed, rest = piece.partition("}}")
        out.append(parts[name] + rest if closed else piece)
    return "".join(out)


def _inline(data: Any) -> str:
    """JSON that may stand inside a script element whatever names it contains."""
    return (
        json.dumps(plain(data), separators=(",", ":"))
        .replace("<", "\\u003c")
        .replace("\u2028", "\\u2028")
        .replace("\u2029", "\\u2029")
    )


def _about(drawn: Drawn) -> str:
    info, known = drawn.run.info, drawn.known
    versions = info.get("versions", {})
    words = [
        f"law {known.law}" if known.law else "",
        f"{len(drawn.trains.names)} trains",
        f"{drawn.instants[-1] - drawn.instants[0]:g} s",
        f"backend {info['backend']}" if info.get("backend") else "",
        f"status {info.get('status', 'unknown')}",
        f"trainctl {versions['trainctl']}" if versions.get("trainctl") else "",
        f"SUMO {versions['sumo']}" if versions.get("sumo") and info.get("backend") == "sumo" else "",
        f"seed {info['seed']}" if "seed" in info else "",
    ]
    return escape(" · ".join(word for word in words if word))


def _margins(values: Mapping[str, Any]) -> list[tuple[str, str, float, str]]:
    """Of every kind of bound: words, unit, minimum margin, whose it is."""
    found = []
    for name, (words, unit) in BOUNDS.items():
        key = f"bounds.{name}"
        if isinstance(values.get(key), int | float):
            whose = {k.partition("/")[2]: v for k, v in values.items() if k.startswith(f"{key}/") and isinstance(v, int | float)}
            found.append((words, unit, float(values[key]), min(whose, key=lambda k: whose[k]) if whose else ""))
    return found


def _outcome(run: Run) -> str:
    """What failed the run, and what is to be known besides: as on the terminal."""
    lines = summary(run)[:-1] if "violations" in run.info else []
    return "".join(
        f'<p class="verdict{" broken" if line.failed else ""}"><strong>{escape(line.title.capitalize())}</strong>:'
        f" {escape(line.text)}</p>"
        for line in lines
    )


def _of_files(run: Run) -> str:
    """What the files of a SUMO configuration say and the run did not do, and what it did, one line each."""
    parts = []
    for kind, title in (("not_followed", "Not followed exactly"), ("followed", "Followed")):
        lines = [str(e["what"]) for e in run.events if e["kind"] == kind]
        rows = "".join(f"<li>{escape(line)}</li>" for line in lines)
        summary_line = f"<summary>{title}: {len(lines)} {'line' if len(lines) == 1 else 'lines'} of SUMO's files</summary>"
        parts += [f"<details class=left>{summary_line}<ul>{rows}</ul></details>"] if lines else []
    return "".join(parts)


def _verdict(values: Mapping[str, Any], run: Run) -> str:
    """All bounds held, or which was violated first, where and when."""
    margins = _margins(values)
    violated = [words for words, _, margin, _ in margins if margin < -SLACK]
    if not margins:
        return '<p class="verdict"><strong>No bounds</strong> are stated in this scenario.</p>'
    if not violated and run.info.get("checks_failed"):
        return f'<p class="verdict">None of {len(margins)} kinds of bound was violated at a recorded instant.</p>'
    if not violated:
        return f'<p class="verdict held"><strong>All bounds held</strong> ({len(margins)} kinds, at every recorded instant).</p>'
    first = ""
    if isinstance(values.get("bounds.first_violation_s"), int | float):
        who = escape(str(values.get("bounds.first_violation_who", "")))
        first = f" First at {values['bounds.first_violation_s']:g} s: {who}."
    return f'<p class="verdict broken"><strong>{len(violated)} of {len(margins)} kinds of bound violated.</strong>{first}</p>'


def _bounds(values: Mapping[str, Any]) -> str:
    rows = []
    for words, unit, margin, whose in _margins(values):
        held = margin >= -SLACK
        shown = "0" if abs(margin) <= SLACK else three(margin)
        rows.append(
            f"<tr><th scope=row>{words}</th><td class=n>{shown}</td><td>{unit}</td><td class=whose>{escape(whose)}</td>"
            f'<td class="{"held" if held else "broken"}">{"held" if held else "⚠ violated"}</td></tr>'
        )
    return "".join(rows)


def raised(unit: str) -> str:
    """A unit with its powers above the line."""
    return unit.replace("s2", "s²").replace("s3", "s³")


def three(value: float | str | None) -> str:
    """Three significant digits, no exponent between a thousandth and a million; counts and whole seconds as they are."""
    if value is None:
        return "never"
    if isinstance(value, str):
        return value
    if isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e4):
        return f"{value:.0f}"  # a count, or a time of the run
    value = float(f"{value:.2e}")
    if 1e3 <= abs(value) < 1e6:
        return f"{value:,.0f}".replace(",", "\u2009")
    if 1e-3 <= abs(value) < 1e3:
        return f"{value:.{max(0, 2 - int(np.floor(np.log10(abs(value)))))}f}"
    mantissa, _, power = f"{value:.2e}".partition("e")
    return f"{mantissa}·10<sup>{int(power)}</sup>"


def _figures(values: Mapping[str, Any]) -> str:
    """Rows of metrics in words, a line per group before its own; bad values are marked, with the reason."""
    rows = []
    for group, words in FIGURES.items():
        found = [name for name in words if name in values]
        if found:
            rows.append(f"<tr class=group><th scope=rowgroup colspan=4>{group}</th></tr>")
        for name in found:
            value, (unit, definition) = values[name], DEFINITIONS.get(name, ("", ""))
            rule, reason = BAD.get(name, (lambda v: False, ""))
            bad = "not while there were links" if value is None else reason if rule(value) else ""
            mark = f"<td class=broken>⚠ {bad}</td>" if bad else "<td></td>"
            shown = value if isinstance(value, int | float) or value is None else escape(str(value))
            rows.append(
                f'<tr><th scope=row title="{escape(name)}: {escape(definition)}">{words[name]}</th>'
                f"<td class=n>{three(shown)}</td><td>{escape(raised(unit)) if unit != '1' else ''}</td>{mark}</tr>"
            )
    return "".join(rows)


def _cited(drawn: Drawn) -> str:
    """What to cite with the run, one line each."""
    versions = drawn.run.info.get("versions", {})
    found, remarks = works(drawn.known.law, drawn.known.observer or "none", versions, drawn.run.info.get("backend") != "numeric")
    lines = [work.text() for work in found] + [f"({remark})" for remark in remarks]
    return "".join(f"<li>{escape(line)}</li>" for line in lines)


def _events(found: Mapping[str, Any]) -> str:
    """Rows of the table of events; each time is a button that moves the slider there."""
    rows = [
        f'<tr><td class=n><button type=button class=link data-time="{event["time"]:g}">{event["time"]:g}</button></td>'
        f"<td>{escape(str(event['kind']))}</td><td>{escape(event['text'])}</td></tr>"
        for event in found["events"]
    ]
    if found["events_left_out"]:
        rows.append(f"<tr><td></td><td></td><td>and {found['events_left_out']} more in events.jsonl</td></tr>")
    return "".join(rows)
