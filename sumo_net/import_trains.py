"""Rolling stock of TTOBench and railtoolkit as a ``[train_type.NAME]`` table.

Symbols
-------
F, P         maximum tractive effort [N] and power [W] of our trains: effort min(F, P / v)
c0, c1, c2   Davis coefficients per mass [N/kg], [N s/(m kg)], [N s2/(m2 kg)]
v00, dv      100 km/h and the 15 km/h of head wind of railtoolkit's resistance formula [m/s]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_net.importing import Imported, Options, Place, chosen, remark, word
from sumo_net.spec import LineError

Floats = NDArray[np.float64]

#: Standard gravity [m/s2].
GRAVITY = 9.80665

V00, HEAD_WIND = 100.0 / 3.6, 15.0 / 3.6

#: Digits of what is written: the files have four or five.
DIGITS = 9


class Fit(NamedTuple):
    """An effort curve as min(F, P / v), and what that costs."""

    force: float  # N
    power: float  # W
    rms: float  # N
    most_above: float  # N, where min(F, P / v) exceeds the curve most
    most_above_at: float  # m/s
    most_below: float  # N, positive
    most_below_at: float  # m/s


def ttobench(data: Place, options: Options) -> Imported:
    """A TTOBench train: one rigid unit, or ``options.units`` equal ones."""
    name = word(options.name or data["metadata"]["id"].text())
    lacking = []
    length = data["length"].quantity("length", above=0.0) if data.has("length") else options.length_m
    if length is None:
        lacking.append("length: missing: give --length-m")
    lacking += _couplers_lacking(options.units, options)
    if lacking:
        raise LineError([f"{data.file}: {line}" for line in lacking])
    assert length is not None
    mass = data["mass"].quantity("mass", above=0.0)
    rotating = _rotating(data["rho"]) if data.has("rho") else 1.0
    r0 = data["rolling resistance r0"].quantity("force", minimum=0.0)
    r1 = data["rolling resistance r1"].quantity("force per speed", minimum=0.0)
    r2 = data["rolling resistance r2"].quantity("force per speed squared", minimum=0.0)
    brake, brake_power, said = _ttobench_brakes(data, mass * rotating)
    notes = [said, "the comfort limit of acceleration is left out: keep it with the reference" * data.has("max acceleration")]
    values = {
        "unit_length_m": length, "unit_mass_kg": mass, "rotating_mass_factor": rotating,
        "c0_n_per_kg": r0 / mass, "c1_ns_per_m_kg": r1 / mass, "c2_ns2_per_m2_kg": r2 / mass,
        "traction_n": data["max traction force"].quantity("force", above=0.0),
        "traction_power_w": data["max traction power"].quantity("power", above=0.0),
        "braking_n": brake, "braking_power_w": brake_power,
    }  # fmt: skip
    if data.has("max speed"):
        notes.append(_top_speed(3.6 * data["max speed"].quantity("speed", above=0.0)))
    notes += [f"{key} is left out" for key in ("tunnel resistance", "ETCS braking data") if data.has(key)]
    n = options.units
    if n > 1:
        notes.append(f"mass, length, forces and powers are shared equally by {n} units")
        shared = ("unit_length_m", "unit_mass_kg", "traction_n", "traction_power_w", "braking_n", "braking_power_w")
        values |= {key: value / n for key, value in values.items() if key in shared and value is not None}
    source = "; ".join(
        f"{key}: {remark(data['metadata'][key].text())}"
        for key in ("id", "created by", "library version", "license")
        if data["metadata"].has(key)
    )
    return _train(name, f"From TTOBench, {source}.", n, values, [note for note in notes if note], options)


def _top_speed(kmh: float) -> str:
    return f"top speed {kmh:g} km/h: keep it with the reference or the bounds"


def _rotating(rho: Place) -> float:
    """Inertia over mass: per cent to be added, or the factor itself."""
    value = rho["value"].number(minimum=0.0)
    return 1.0 + value * rho["unit"].factor("share") if rho["unit"].value == "%" else max(1.0, value * rho["unit"].factor("share"))


def _ttobench_brakes(data: Place, inertia: float) -> tuple[float, float | None, str]:
    """Braking effort [N], braking power [W] or None, and how they came about."""
    force = data["max reg braking force"].quantity("force", minimum=0.0)
    power: float | None = data["max reg braking power"].quantity("power", minimum=0.0)
    said = "braking: electric brakes alone"
    if data.has("max pn braking force"):
        force, power = force + data["max pn braking force"].quantity("force", minimum=0.0), None
        said = "braking: electric and pneumatic brakes together, hence without a power limit"
    if data.has("max deceleration"):
        most = data["max deceleration"].quantity("acceleration", above=0.0) * inertia
        if most < force:
            force, said = most, f"{said}; cut to the comfort limit of {most / inertia:g} m/s2"
    if force <= 0.0:
        raise data.wrong("no brakes: max reg braking force is 0 and max pn braking force missing or 0")
    return force, power, said


def railtoolkit(data: Place, options: Options) -> Imported:
    """A train of railtoolkit rolling stock.

    Its resistance is that of TrainRuns.jl: driving axles at base, carrying axles at rolling resistance, air at
    ((v + 15 km/h) / 100 km/h)^2, all per mil of the weight; wagons with a linear rolling term. Multiple units become one unit each.
    A train with unpowered vehicles becomes one rigid unit: our laws drive units, and those have no force of their own.
    """
    train = chosen(data["trains"].items(), "train", options)
    known = {v["id"].text(): v for v in data["vehicles"].items()}
    ids = [i.text() for i in train["formation"].items()]
    missing = [i for i in dict.fromkeys(ids) if i not in known]
    if missing:
        raise train["formation"].wrong(f"{', '.join(missing)}: no such vehicle; there are: {', '.join(known)}")
    formation = [known[i] for i in ids]
    powered = [v for v in formation if v["vehicle_type"].text() in ("traction unit", "multiple unit")]
    lacking = [] if powered else ["trains.formation: no traction unit or multiple unit in it"]
    lacking += [f"{v.key}.tractive_effort: missing" for v in {id(v): v for v in powered}.values() if not v.has("tractive_effort")]
    brakes = {abs(v["a_braking"].number()) for v in powered if v.has("a_braking")}
    deceleration = options.deceleration_mps2 or (min(brakes) if brakes else None)
    if deceleration is None:
        lacking.append("a_braking: missing in every powered vehicle: give --deceleration-mps2")
    split = len(powered) == len(formation) > 1
    lacking += _couplers_lacking(len(formation) if split else 1, options)
    if lacking:
        raise LineError([f"{data.file}: {line}" for line in lacking])
    assert deceleration is not None

    notes = [f"loaded to {100 * options.load_share:g} % of the load limit (--load-share)"]
    rows = [_vehicle(v, options.load_share) for v in formation]
    if split:
        units = [[row] for row in rows]
    else:
        units = [rows]
        if len(rows) > 1:
            notes.append(f"{len(rows)} vehicles as one rigid unit: those without traction have no force of their own")
    if options.units != 1:
        raise data.wrong("--units: this file lists the vehicles; leave it out", "")
    fits = {id(v): fitted(_effort(v)) for v in powered}
    for fit in dict.fromkeys(fits.values()):
        notes.append(
            f"tractive effort as min({fit.force:.0f} N, {fit.power:.0f} W / v): rms error {fit.rms:.0f} N; at most"
            f" {fit.most_above:.0f} N above the curve ({3.6 * fit.most_above_at:.0f} km/h) and {fit.most_below:.0f} N below it"
            f" ({3.6 * fit.most_below_at:.0f} km/h)"
        )
    notes.append(f"braking: {deceleration:g} m/s2 of the loaded train, without a power limit")
    top = min((v["speed_limit"].number(above=0.0) for v in formation if v.has("speed_limit")), default=None)
    if top is not None:
        notes.append(_top_speed(top))
    motors = [[fits[id(v)] for v in part if id(v) in fits] for part in ([[v] for v in formation] if split else [formation])]
    table = [_unit(part, motor, deceleration) for part, motor in zip(units, motors, strict=True)]
    values: dict[str, Any] = {key: [row[key] for row in table] for key in table[0]}
    source = f"From railtoolkit rolling stock, train {remark(train['id'].text())}: {remark(train['name'].text())}."
    return _train(word(options.name or train["id"].text()), source, len(table), values, notes, options)


class Vehicle(NamedTuple):
    """One vehicle in SI; resistance F0 + F1 v + F2 v^2 in newton."""

    length: float
    mass: float  # loaded
    inertia: float
    resistance: Floats  # (3,)


def _vehicle(v: Place, load_share: float) -> Vehicle:
    empty = 1e3 * v["mass"].number(above=0.0)
    loaded = empty + 1e3 * load_share * (v["load_limit"].number(minimum=0.0) if v.has("load_limit") else 0.0)
    base, rolling, air = (
        v[key].number(minimum=0.0) * 1e-3 * GRAVITY if v.has(key) else 0.0
        for key in ("base_resistance", "rolling_resistance", "air_resistance")
    )
    kind = v["vehicle_type"].text()
    wind = 0.0 if kind == "freight" else HEAD_WIND
    square = air * np.array([wind**2, 2.0 * wind, 1.0]) / V00**2
    if kind in ("traction unit", "multiple unit"):
        driving = 1e3 * v["mass_traction"].number(above=0.0) if v.has("mass_traction") else empty
        if driving > empty * (1.0 + 1e-9):
            raise v["mass_traction"].wrong(f"{driving:g} kg: exceeds the vehicle's mass, {empty:g} kg")
        resistance = np.array([base * driving + rolling * (empty - driving), 0.0, 0.0]) + empty * square
    else:
        resistance = loaded * (np.array([base, rolling / V00, 0.0]) + square)
    factor = v["rotation_mass"].number(minimum=1.0) if v.has("rotation_mass") else 1.0
    return Vehicle(v["length"].number(above=0.0), loaded, factor * empty + loaded - empty, resistance)


def _unit(part: Sequence[Vehicle], motors: Sequence[Fit], deceleration: float) -> dict[str, float]:
    """Several vehicles as one rigid unit."""
    mass, inertia = sum(v.mass for v in part), sum(v.inertia for v in part)
    davis = np.sum([v.resistance for v in part], axis=0) / mass
    return {
        "unit_length_m": sum(v.length for v in part), "unit_mass_kg": mass, "rotating_mass_factor": inertia / mass,
        "c0_n_per_kg": davis[0], "c1_ns_per_m_kg": davis[1], "c2_ns2_per_m2_kg": davis[2],
        "traction_n": sum(f.force for f in motors), "traction_power_w": sum(f.power for f in motors),
        "braking_n": deceleration * inertia,
    }  # fmt: skip


def _effort(v: Place) -> Floats:
    rows = [row.row(2) for row in v["tractive_effort"].items()]
    curve = np.array(sorted((a.number(minimum=0.0) / 3.6, b.number(minimum=0.0)) for a, b, *_ in rows))
    if len(curve) < 3 or curve[-1, 0] <= 0.0 or curve[:, 1].max() <= 0.0:
        raise v["tractive_effort"].wrong("must have at least three pairs [speed in km/h, force in N], with forces above 0")
    return curve


def fitted(curve: Floats) -> Fit:
    """Minimum squares of min(F, P / v) to an effort curve, evenly over its range of speed.

    Parameters
    ----------
    curve : ndarray, shape (k, 2)
        Speed [m/s], ascending, and tractive effort [N].

    Returns
    -------
    Fit
    """
    v = np.linspace(0.0, curve[-1, 0], 401)
    wanted = np.interp(v, curve[:, 0], curve[:, 1])
    span_force = (0.3 * wanted.max(), 1.05 * wanted.max())
    span_power = (0.3 * (wanted * v).max(), 1.5 * (wanted * v).max())
    with np.errstate(divide="ignore"):
        for _ in range(5):  # a grid, refined around its best point: the error has kinks that gradients stumble over
            force, power = np.linspace(*span_force, num=41), np.linspace(*span_power, num=41)
            error = np.minimum(force[:, None, None], power[:, None] / v) - wanted
            a, b = np.unravel_index(np.argmin((error**2).mean(axis=-1)), error.shape[:2])
            span_force = (force[a] - 2.0 * (force[1] - force[0]), force[a] + 2.0 * (force[1] - force[0]))
            span_power = (power[b] - 2.0 * (power[1] - power[0]), power[b] + 2.0 * (power[1] - power[0]))
    best = error[a, b]
    up, down = int(np.argmax(best)), int(np.argmin(best))
    return Fit(
        float(force[a]), float(power[b]), float(np.sqrt((best**2).mean())),
        float(best[up]), float(v[up]), float(-best[down]), float(v[down]),
    )  # fmt: skip


def _couplers_lacking(units: int, options: Options) -> list[str]:
    """What a train of several units needs and no file tells."""
    if units == 1:
        return []
    given = {
        "--coupler-stiffness-n-per-m": options.coupler_stiffness_n_per_m,
        "--coupler-damping-ns-per-m": options.coupler_damping_ns_per_m,
    }
    return [f"couplers: missing, {units} units need them: give {key}" for key, value in given.items() if value is None]


def _train(name: str, source: str, units: int, values: dict[str, Any], notes: Sequence[str], options: Options) -> Imported:
    lines = [f"# {source}"] + [f"# Note: {n}." for n in notes] + [f"[train_type.{name}]", f"units = {units}"]
    if units > 1:
        couplers = {
            "coupler_stiffness_n_per_m": options.coupler_stiffness_n_per_m,
            "coupler_damping_ns_per_m": options.coupler_damping_ns_per_m,
        }
        values = values | couplers
    lines += [f"{key} = {_toml(value)}" for key, value in values.items() if value is not None]
    return Imported("train", name, "\n".join(lines) + "\n", tuple(notes))


def _toml(value: float | Sequence[float]) -> str:
    """A number with nine significant digits, or a list of them; one number if all are the same."""
    if isinstance(value, list):
        return _toml(value[0]) if len(set(value)) == 1 else "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(float(f"{value:.{DIGITS}g}"))
