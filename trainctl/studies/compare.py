"""Several runs: one table, on the terminal and in LaTeX, and figures with all of them in one axis.

``alternatives`` puts the other laws in front of the same traffic: trains, network, events, reference, bounds and links stay, the
law and what belongs to it (plant, observer, periods) changes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from trainctl.errors import InputError
from trainctl.figures import style
from trainctl.figures.overlay import QUANTITIES, overlay
from trainctl.figures.trains import drawable
from trainctl.laws import compared, find_law, find_plant, plants_of
from trainctl.metrics.run import DEFINITIONS
from trainctl.metrics.versions import current
from trainctl.runs.run import Run

#: Rows of the table, as far as they apply to any of the runs.
ROWS = (
    "bounds.broken", "bounds.spacing_lower_margin_m", "bounds.spacing_upper_margin_m", "bounds.speed_lower_margin_mps",
    "bounds.speed_upper_margin_mps", "bounds.input_lower_margin_mps2", "bounds.input_upper_margin_mps2",
    "bounds.coupler_lower_margin_m", "bounds.coupler_upper_margin_m", "bounds.first_violation_s", "formation.settling_s",
    "formation.last_link_s", "formation.final_error_m", "formation.overshoot_m",
    "formation.final_speed_error_mps", "formation.speed_overshoot_mps",
    "string.l2_gain", "units.force_min_n", "units.force_max_n", "units.coupler_stroke_m", "units.saturated_share",
    "energy.traction_kwh", "energy.net_kwh_per_train_km", "comfort.acceleration_max_mps2", "comfort.jerk_max_mps3",
    "comfort.jerk_rms_mps3", "traffic.gap_min_m", "traffic.headway_min_s", "traffic.trains_per_hour",
)  # fmt: skip


def table(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """One row per metric: ``metric, unit, values`` (one per run, None where it does not apply)."""
    columns = [current(run) for run in runs]
    return [
        {"metric": name, "unit": DEFINITIONS.get(name, ("", ""))[0], "values": [column.get(name) for column in columns]}
        for name in ROWS if any(name in column for column in columns)
    ]  # fmt: skip


def names(runs: Sequence[Run]) -> list[str]:
    """A name per run: its folder's, with as much of the path as tells them apart."""
    for depth in range(1, 5):
        found = ["/".join(run.folder.resolve().parts[-depth:]) for run in runs]
        if len(set(found)) == len(found):
            return found
    return [f"{k + 1}: {run.folder.name}" for k, run in enumerate(runs)]


def figures(runs: Sequence[Run], labels: Sequence[str], out: Path, formats: Sequence[str] = ("png",)) -> list[Path]:
    """Write ``compare_<what>`` for speeds, inputs, spacing errors and positions relative to the reference."""
    out.mkdir(parents=True, exist_ok=True)
    written = []
    with style.styled():
        drawn = [drawable(run) for run in runs]
        if not any(one.trains.names for one in drawn):
            raise InputError("compare: no train was recorded in any of the runs")
        origin = "; ".join(one.origin for one in drawn)
        for what in QUANTITIES:
            title = f"{what} of {', '.join(labels)}"
            written += style.save(overlay(drawn, labels, what), out / f"compare_{what}", formats, title, origin)
    return written


def latex(rows: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> str:
    """The table as a ``tabular`` of booktabs, three significant digits, a dash where a metric does not apply."""
    lines = [" & ".join(["metric", "unit", *map(escaped, labels)]), *(
        " & ".join([escaped(row["metric"]), _unit(row["unit"]), *map(_number, row["values"])]) for row in rows
    )]  # fmt: skip
    body = " \\\\\n".join([f"{lines[0]} \\\\\n\\midrule\n{lines[1]}" if len(lines) > 1 else lines[0], *lines[2:]])
    columns = "ll" + "r" * len(labels)
    return f"% \\usepackage{{booktabs}}\n\\begin{{tabular}}{{{columns}}}\n\\toprule\n{body} \\\\\n\\bottomrule\n\\end{{tabular}}\n"


def escaped(text: str) -> str:
    """Text whose signs mean nothing to TeX."""
    signs = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    return "".join(signs.get(sign, f"\\{sign}" if sign in "&%$#_{}" else sign) for sign in text)


def _unit(text: str) -> str:
    return re.sub(r"(?<=[a-z])(\d)", r"$^\1$", escaped(text)) if text != "1" else ""


def _number(value: Any) -> str:
    if value is None:
        return "--"
    if isinstance(value, bool | str) or not isinstance(value, int | float):
        return escaped(str(value))
    value = float(f"{value:.2e}")
    if value == 0.0 or 1e-3 <= abs(value) < 1e6:
        return f"${value:,g}$".replace(",", r"\,")
    mantissa, _, power = f"{value:.2e}".partition("e")
    return f"${mantissa} \\cdot 10^{{{int(power)}}}$" if power else f"${value}$"


# --- the other laws on the same traffic -------------------------------------------------------------------------------------------


def alternatives(data: Mapping[str, Any], known: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The scenario under every law that comes with trainctl.

    Parameters
    ----------
    data : mapping
        Tables of the scenario as they stand.
    known : sequence of str
        Names of the laws there are.

    Returns
    -------
    dict
        Name of the row -> tables of its scenario. Keys of the laws' own that have a counterpart in the scenario's bounds are
        derived from it; all others are the law's defaults (the paper's), or what ``[alternative.ROW]`` of the scenario says.
    """
    name = str(data["controller"]["law"])
    return {
        row: dict(data) if name == _name(law) and row == _row(law, data["controller"]) else _under(row, _name(law), law, data)
        for row, law in compared().items() if _name(law) in known
    }  # fmt: skip


def others(
    data: Mapping[str, Any], known: Sequence[str], folder: Path, files: Sequence[str] = ()
) -> tuple[dict[str, dict[str, Any]], dict[str, list[str]]]:
    """The scenario under laws that do not come with trainctl: its own, those of other packages, and files.

    Parameters
    ----------
    data, known
        As in ``alternatives``.
    folder : Path
        Where the path of the scenario's law starts.
    files : sequence of str
        Paths of further laws, from the current directory.

    Returns
    -------
    dict
        Name of the row -> tables of its scenario.
    dict
        Rows that are left out -> why.
    """
    own = str(data["controller"]["law"])
    ours = {_name(law) for law in compared().values()}
    places = {own: folder, **{str(Path(file).resolve()): Path() for file in files}, **dict.fromkeys(known, Path())}
    found: dict[str, dict[str, Any]] = {}
    left_out: dict[str, list[str]] = {}
    for name, where in places.items():
        if name in ours:
            continue
        label = Path(name).stem if name.endswith(".py") else name
        try:
            law = find_law(name, where)
        except InputError as error:
            left_out[label] = list(error.mistakes)
            continue
        for row in getattr(law, "COMPARED", {label: {}}):
            its = row if row not in found else f"{row}_{len(found) + 1}"
            found[its] = dict(data) if name == own else _under(row, name, law, data)
    return found, left_out


def strange(data: Mapping[str, Any], rows: Sequence[str]) -> list[str]:
    """Rows that ``[alternative]`` names and no run has."""
    known = ", ".join(rows)
    return [f"alternative.{row}: no such row; there are: {known}" for row in data.get("alternative", {}) if row not in rows]


def _name(law: Any) -> str:
    """How a scenario names a law of ours."""
    return str(law.__name__).rpartition(".")[2]


def _row(law: Any, controller: Mapping[str, Any]) -> str:
    """The row of its law a scenario is as it stands: the last whose keys it has, else the first."""
    rows: dict[str, dict[str, Any]] = law.COMPARED
    fitting = [row for row, keys in rows.items() if all(controller.get(key) == value for key, value in keys.items())]
    return (fitting or list(rows))[-1 if fitting else 0]


def _under(row: str, name: str, law: Any, data: Mapping[str, Any]) -> dict[str, Any]:
    """The scenario under another law, on a plant the law runs on where there is one of the same sort."""
    changed: dict[str, Any] = {key: value for key, value in data.items() if key not in ("controller", "observer")}
    changed["title"] = f"{row.replace('_', ' ')} on the traffic of: {data.get('title', '')}"
    changed["run"] = {"step_s": 1.0, **{key: value for key, value in data["run"].items() if key != "control_period_s"}}
    changed["topology"] = dict(data.get("topology", {}))
    changed["controller"] = {"law": name, **getattr(law, "COMPARED", {}).get(row, {})}
    plant = {"kind": "point", **data.get("plant", {})}
    module, usual = find_plant(str(plant["kind"])), plants_of(law)
    if plant["kind"] not in usual:
        plant = next(({"kind": kind} for kind in usual if find_plant(kind).UNITS == module.UNITS), plant)
    if getattr(law, "CLAMPED", False):  # its model clamps, where the plant can do so by itself it does
        clamps = find_plant(str(plant["kind"])).CLAMPS
        plant |= {key: value for key, value in data.get("bounds", {}).items() if key in clamps}
    changed["plant"] = plant
    changed |= law.alternative(changed) if hasattr(law, "alternative") else {}
    return {**changed, "controller": {**changed["controller"], **data.get("alternative", {}).get(row, {})}}
