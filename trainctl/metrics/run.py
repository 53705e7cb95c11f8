"""All metrics of a run, computed from its logs; each name carries its unit.

``metrics(run)`` gives one flat table ``name -> value``. ``group.name_unit`` is the whole run's worst (or total) value,
``group.name_unit/item`` that of one train (``/3``), unit (``/3.1``), pair of trains (``/1-3``, the one ahead first), track or
window of time (``/1000``: from 1000 s to the next change of topology). Metrics that do not apply are absent; None means
"never". ``DEFINITIONS`` says what every name means.
"""

from __future__ import annotations

import numpy as np

from trainctl.errors import InputError
from trainctl.metrics import driving, punctuality, traffic
from trainctl.metrics.values import Values, at_least, at_most, put_worst
from trainctl.monitors.outcome import GAP
from trainctl.runs.known import UNBOUNDED, Facts, facts
from trainctl.runs.run import Run
from trainctl.runs.series import INSTANT, Pairs, Series, pairs, series, turns
from trainctl.signals import Floats, leader_over

#: A bound counts as violated beyond this (m, m/s or m/s2): positions read back from the simulator are exact to 3e-10 m.
SLACK = 1e-6

#: name -> (unit, one-line definition)
DEFINITIONS: dict[str, tuple[str, str]] = {
    "run.duration_s": ("s", "Time from the first recorded instant to the last."),
    "run.trains": ("1", "Trains in the log."),
    "run.train_km": ("km", "Distance covered by all trains together."),
    "bounds.spacing_lower_margin_m": (
        "m", "Minimum spacing minus lower bound of a link, front to front, from one control period after the link was made on "
        "(k >= 1: the first instant is given, not controlled); negative: violated."),
    "bounds.spacing_upper_margin_m": ("m", "Minimum upper bound minus spacing of a link, counted in the same way."),
    "bounds.speed_lower_margin_mps": ("m/s", "Minimum speed minus lower bound."),
    "bounds.speed_upper_margin_mps": ("m/s", "Minimum upper bound minus speed."),
    "bounds.input_lower_margin_mps2": ("m/s2", "Minimum applied input minus lower bound."),
    "bounds.input_upper_margin_mps2": ("m/s2", "Minimum upper bound minus applied input."),
    "bounds.coupler_lower_margin_m": ("m", "Minimum coupler displacement minus lower bound, over all sub-steps."),
    "bounds.coupler_upper_margin_m": ("m", "Minimum upper bound minus coupler displacement, over all sub-steps."),
    "bounds.broken": ("1", f"Number of kinds of bound (the eight margins above) violated by more than {SLACK:g} of their unit."),
    "bounds.first_violation_s": ("s", "Time of the first recorded instant at which a bound is violated; absent if none is."),
    "bounds.first_violation_who": ("text", "Which bound of which train, link or unit is violated at that instant."),
    "formation.settling_s": (
        "s", "Time of the run from which every link that there is stays within the band (default 1 m) of its desired spacing; "
        "None: not by the last link."),
    "formation.last_link_s": ("s", "Time of the run at which a link was recorded last."),
    "formation.window_settling_s": (
        "s", "The same within each window between changes of topology (item: its start), counted from its start; "
        "None: not before its end."),
    "formation.final_error_m": ("m", "Largest distance of a link from its desired spacing at the last instant."),
    "formation.overshoot_m": ("m", "Largest error of a link with the opposite sign to that at the start of its window."),
    "formation.speed_settling_s": (
        "s", "Time after which every train stays within the band (default 2 %) of a constant reference speed, from the start of "
        "that speed (item) on; None: not before its end."),
    "formation.speed_overshoot_mps": (
        "m/s", "Largest speed error with the opposite sign to that at the start of a constant reference speed."),
    "formation.final_speed_error_mps": ("m/s", "Largest distance of a train's speed from the reference at the last instant."),
    "string.l2_gain": (
        "1", "Norm over time of a link's spacing error over that of the link ahead of it (neighbours, common instants); "
        "above 1 errors grow along the formation."),
    "string.peak_gain": ("1", "The same with the largest absolute error as the norm."),
    "watched.<name>_min": ("as named", "Minimum value over all sub-steps of a quantity that the law constrains."),
    "watched.<name>_max": ("as named", "Maximum value over all sub-steps of a quantity that the law constrains."),
    **driving.DEFINITIONS,
    **traffic.DEFINITIONS,
    **punctuality.DEFINITIONS,
}  # fmt: skip


def metrics(run: Run, *, band_m: float = 1.0, speed_band: float = 0.02, section_m: float | None = None) -> Values:
    """All metrics of a run.

    Parameters
    ----------
    run : Run
        A run folder, finished or not.
    band_m : float
        Band around the desired spacing for settling [m].
    speed_band : float
        Band around the reference speed for settling, relative.
    section_m : float, optional
        Kilometrage at which trains per hour are counted [m]; default the middle of the stretch that all trains covered.

    Returns
    -------
    dict
        See the module's head; numbers, None or text.
    """
    known = facts(run)
    trains, links = series(run.rows("trains"), "train"), pairs(run.rows("links"))
    time = trains.column("time_s") if trains.names else np.zeros(1)
    turned = turns(trains, run.events)
    values: Values = {
        "run.duration_s": float(np.ptp(time)),
        "run.trains": len(trains.names),
        "run.train_km": sum(driving.distance(trains, rows, turned) for _, rows in trains.slices()) / 1000,
    }
    units = series(run.rows("units", missing_is_empty=True), "train", "unit")
    values |= of_bounds(trains, units, links, known)
    values |= of_formation(links, windows(run, time.min()), band_m)
    values |= of_reference(trains, known, speed_band)
    values |= of_strings(links)
    values |= of_watched(trains)
    values |= driving.of_units(trains, units)
    values |= driving.of_energy(trains, units, known, run.events)
    values |= driving.of_comfort(trains)
    inside = [float(event["value"]) for event in run.events if event["kind"] == "violation" and event.get("bound") == GAP]
    values |= traffic.of_trains(trains, section_m, inside, turned)
    values |= punctuality.of_entries(run.events)
    values |= punctuality.of_stops(run.rows("stops", missing_is_empty=True), float(time.max()))
    try:
        values |= traffic.of_sumo(run.folder / "sumo")
    except InputError:
        if run.info.get("status") == "complete":
            raise
        # a killed simulator leaves its logs torn
    return values


def of_bounds(trains: Series, units: Series, links: Series, known: Facts) -> Values:
    """Minimum margin to every bound, and the first instant at which one is violated."""
    values: Values = {}
    violated: list[tuple[float, str]] = []
    kinds: set[str] = set()

    def margins(name: str, split: Series, margin: Floats, what: str) -> None:
        finite = np.isfinite(margin)
        if finite.any():
            put_worst(values, f"bounds.{name}", split, np.where(finite, margin, np.inf), np.minimum)
        hit = np.flatnonzero(margin < -SLACK)
        if len(hit):
            kinds.add(name)
            time = split.column("time_s")[hit]
            k = int(np.argmin(time))
            where = split.names[int(split.labels()[hit[k]])]
            violated.append((float(time[k]), f"{what} of {where} by {-margin[hit[k]]:.6g}"))

    if links.names:
        counted = links.column("age_s") >= known.control_period_s - INSTANT
        counted &= links.column("age_s") > 0  # also where the period is not known
        for name, margin, side in (
            ("spacing_lower_margin_m", links.column("spacing_m") - links.column("lower_m"), "lower"),
            ("spacing_upper_margin_m", links.column("upper_m") - links.column("spacing_m"), "upper"),
        ):
            margins(name, links, np.where(counted, margin, np.nan), f"{side} spacing bound [m] of link")
    for name, column, unit, limits in (
        ("speed", "speed_mps", "mps", known.speed_mps),
        ("input", "input_mps2", "mps2", known.input_mps2),
    ):
        if trains.names:
            lower, upper = np.repeat([limits.get(n, UNBOUNDED) for n in trains.names], np.diff(trains.first), axis=0).T
            value = trains.column(column)
            if "in_formation" in trains.numbers:  # a train alone is not driven by the law
                value = np.where(trains.column("in_formation") > 0.5, value, np.nan)
            margins(f"{name}_lower_margin_{unit}", trains, value - lower, f"lower {name} bound of train")
            margins(f"{name}_upper_margin_{unit}", trains, upper - value, f"upper {name} bound of train")
    if units.names:
        lowest, highest = at_most(units, "coupler_min_m", "coupler_m"), at_least(units, "coupler_max_m", "coupler_m")
        margins("coupler_lower_margin_m", units, lowest - known.coupler_m[0], "lower coupler bound [m] behind unit")
        margins("coupler_upper_margin_m", units, known.coupler_m[1] - highest, "upper coupler bound [m] behind unit")
    values["bounds.broken"] = len(kinds)
    if violated:
        values["bounds.first_violation_s"], values["bounds.first_violation_who"] = min(violated)
    return values


def windows(run: Run, begin: float) -> Floats:
    """Starts of the windows: the beginning and every change of topology [s]."""
    changes = [float(event["time_s"]) for event in run.events if event["kind"] == "topology"]
    return np.unique(np.round([begin, *(t for t in changes if t > begin)], 6))


def of_formation(links: Series, starts: Floats, band_m: float) -> Values:
    """Settling, final error and overshoot of the spacings."""
    if not links.names:
        return {}
    values: Values = {}
    time, error, label = links.column("time_s"), links.column("error_m"), links.labels()
    instants, where = np.unique(np.round(time / INSTANT), return_inverse=True)
    worst = np.zeros(len(instants))
    np.maximum.at(worst, where, np.abs(error))
    instants *= INSTANT
    after = settled(instants, worst, band_m)
    values["formation.settling_s"] = None if after is None else float(instants[0] + after)
    values["formation.last_link_s"] = float(instants[-1])
    for begin, end in zip(starts, [*starts[1:], np.inf], strict=True):
        inside = (instants >= begin - INSTANT / 2) & (instants < end - INSTANT / 2)
        if inside.any():
            after = settled(instants[inside], worst[inside], band_m)
            values[f"formation.window_settling_s/{begin:g}"] = (
                None if after is None else float(after - (begin - instants[inside][0]))
            )
    last = np.abs(time - time.max()) < INSTANT
    put_worst(values, "formation.final_error_m", links, np.where(last, np.abs(error), -np.inf), np.maximum)
    window = np.searchsorted(starts, time + INSTANT / 2, side="right")
    begin_rows = np.flatnonzero(np.concatenate([[True], (np.diff(window) != 0) | (np.diff(label) != 0)]))
    side = np.repeat(np.sign(error[begin_rows]), np.diff([*begin_rows, len(error)]))
    beyond = np.where(side == 0, np.abs(error), np.maximum(-side * error, 0.0))
    put_worst(values, "formation.overshoot_m", links, beyond, np.maximum)
    return values


def settled(time: Floats, size: Floats, band: float) -> float | None:
    """Time from the first instant to the one after the last outside the band; None if the last instant is outside."""
    outside = np.flatnonzero(~(size <= band))
    if not len(outside):
        return 0.0
    return None if outside[-1] == len(time) - 1 else float(time[outside[-1] + 1] - time[0])


def of_reference(trains: Series, known: Facts, band: float) -> Values:
    """Speeds against the reference: per stretch of constant reference speed."""
    if known.reference is None or not trains.names:
        return {}
    values: Values = {}
    time, speed = trains.column("time_s"), trains.column("speed_mps")
    error = speed - leader_over(known.reference, time)[1]
    last = np.abs(time - time.max()) < INSTANT
    put_worst(values, "formation.final_speed_error_mps", trains, np.where(last, np.abs(error), -np.inf), np.maximum)
    overshoot = np.zeros(len(time))
    for k, (begin, end) in enumerate(zip(known.reference.breaks[:-1], known.reference.breaks[1:], strict=True)):
        level = known.reference.position[k, 1]
        inside = (time >= begin - INSTANT) & (time < end - INSTANT)
        if np.any(known.reference.position[k, 2:]) or not inside.any():
            continue
        outside = inside & (np.abs(error) > band * abs(level))
        instants = np.unique(np.round(time[inside] / INSTANT)) * INSTANT
        late = time[outside].max(initial=-np.inf)
        after = instants[instants > late + INSTANT / 2]
        values[f"formation.speed_settling_s/{begin:g}"] = float(after[0] - max(begin, instants[0])) if len(after) else None
        for _, rows in trains.slices():
            here = error[rows][inside[rows]]
            if len(here):
                side = np.sign(here[0])
                overshoot[rows][inside[rows]] = np.abs(here) if side == 0 else np.maximum(-side * here, 0.0)
    put_worst(values, "formation.speed_overshoot_mps", trains, overshoot, np.maximum)
    return values


def of_strings(links: Pairs) -> Values:
    """Growth of the spacing error from link to link; between neighbours only: of all links to a train the shortest."""
    if not links.names:
        return {}
    rows = dict(links.slices())
    values: Values = {}
    time, error = np.round(links.column("time_s") / INSTANT), links.column("error_m")
    for behind, before, name in nearest(links):
        _, a, b = np.intersect1d(time[rows[before]], time[rows[name]], assume_unique=True, return_indices=True)
        front, back = error[rows[before]][a], error[rows[name]][b]
        for kind, norm in (("l2", np.linalg.norm), ("peak", lambda e: np.max(np.abs(e), initial=0.0))):
            if norm(front) > SLACK:
                key, gain = f"string.{kind}_gain", float(norm(back) / norm(front))
                values[f"{key}/{behind}"] = gain
                values[key] = max(gain, float(values.get(key) or 0.0))
    return values


def nearest(links: Pairs) -> list[tuple[str, str, str]]:
    """Links of neighbours that follow each other: the train behind, and the names of the link ahead and of its own."""
    found: dict[str, tuple[float, str, str]] = {}  # of each train: length, ahead, name of its shortest link ahead
    for (ahead, behind), (name, part) in zip(links.ends, links.slices(), strict=True):
        length = float(np.median(links.column("desired_m")[part]))
        found[behind] = min(found.get(behind, (np.inf, "", "")), (length, ahead, name))
    return [(behind, found[ahead][2], name) for behind, (_, ahead, name) in found.items() if ahead in found]


def of_watched(trains: Series) -> Values:
    """Extremes of what the law constrains: the columns ``<name>_min`` and ``<name>_max``."""
    values: Values = {}
    for column in trains.numbers if trains.names else ():
        stem, _, end = column.rpartition("_")
        if end in ("min", "max") and {f"{stem}_min", f"{stem}_max"} <= set(trains.numbers):
            put_worst(values, f"watched.{column}", trains, trains.column(column), np.minimum if end == "min" else np.maximum)
    return values
