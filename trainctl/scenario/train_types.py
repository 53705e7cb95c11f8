"""Train types from the vTypes of a SUMO configuration."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import ValidationError

from trainctl.scenario.tables import TrainType
from trainctl.traffic.files import bad_number
from trainctl.traffic.kinds import RAIL_MODEL, Kind

#: What a vType must say to be a plant of ours, in SUMO's units: kg, kW, kN, and kN with m/s.
_CONSTANTS = ("mass", "maxPower", "maxTraction", "resCoef_constant", "resCoef_linear", "resCoef_quadratic")


def train_type(kind: Kind, rest: TrainType | None = None) -> TrainType | list[str]:
    """Physical data of a vType; else what it lacks, one line. ``rest`` stands for what it does not say, ``[train_type."*"]``.

    Notes
    -----
    SUMO's Rail model takes ``maxPower`` in kW, ``maxTraction`` and ``resCoef_*`` in kN with speeds in m/s, ``mass`` in kg; the
    traction is the smaller of ``maxTraction`` and ``maxPower`` over the speed, ``decel`` is braking effort over inertia. The train
    types built into SUMO are tables of speed and force, in whose place the constants fitted to them stand, see ``fitted``.
    """
    said = kind.attributes
    rail, base = said.get("carFollowModel") == "Rail", said.get("trainType", "NGT400")
    built = RAIL_MODEL.get(base, RAIL_MODEL["custom"])
    # Any other model takes notice of the mass alone.
    value = {key: said[key] for key in _CONSTANTS if key in said and (rail or key == "mass")}
    if rail and base != "custom" and base in RAIL_MODEL:
        tables = (built.mass_kg, built.power_kw, built.traction_kn, *built.resistance)
        value = dict(zip(_CONSTANTS, map(str, tables), strict=True)) | value
    if lacking := [f"no {key}" for key in _CONSTANTS if key not in value]:
        if rest is not None:
            return _of_rest(kind, rest)
        return [
            f'vType {kind.id}: {", ".join(lacking)}: add [train_type.{kind.id}] or, for all such types, [train_type."*"] to the'
            f' scenario, or carFollowModel="Rail" trainType="custom" with {", ".join(_CONSTANTS)} to the vType'
        ]
    checked = {key: said[key] for key in ("massFactor", "decel") if key in said} | value
    if mistakes := [
        f"vType {kind.id}: {key} = {text}: must be a number, not negative" for key, text in checked.items() if bad_number(text)
    ]:
        return mistakes
    mass, power, traction, c0, c1, c2 = (float(value[key]) for key in _CONSTANTS)
    if mass <= 0:
        return [f"vType {kind.id}: mass = {mass:g}: must be above 0"]
    factor = float(said.get("massFactor", built.mass_factor))
    try:
        return TrainType(
            unit_length_m=kind.length_m,
            unit_mass_kg=mass,
            rotating_mass_factor=factor,
            c0_n_per_kg=1e3 * c0 / mass,
            c1_ns_per_m_kg=1e3 * c1 / mass,
            c2_ns2_per_m2_kg=1e3 * c2 / mass,
            traction_n=1e3 * traction,
            traction_power_w=1e3 * power,
            braking_n=float(said.get("decel", built.deceleration_mps2)) * mass * factor,
        )
    except ValidationError as error:
        return [f"vType {kind.id}: {e['msg'].removeprefix('Value error, ')}" for e in error.errors()]


def _of_rest(kind: Kind, rest: TrainType) -> TrainType | list[str]:
    """What stands for all types without data of their own, with the length, the mass and the brakes that the vType states."""
    said = {key: kind.attributes[key] for key in ("mass", "decel") if key in kind.attributes}
    if mistakes := [
        f"vType {kind.id}: {key} = {text}: must be a number above 0"
        for key, text in said.items()
        if bad_number(text) or float(text) == 0.0
    ]:
        return mistakes
    mass = rest.per_unit("unit_mass_kg")
    own: dict[str, object] = {"unit_length_m": kind.length_m / rest.units}
    if "mass" in said:
        mass = mass * (float(said["mass"]) / mass.sum())
        own["unit_mass_kg"] = tuple(mass.tolist())
    if "decel" in said:
        own["braking_n"] = tuple((float(said["decel"]) * mass * rest.per_unit("rotating_mass_factor")).tolist())
    return rest.model_copy(update=own)


def fitted(kinds: Iterable[Kind]) -> list[str]:
    """Which vTypes have constants fitted to SUMO's tables, with the largest error: one line."""
    found = [
        f"{kind.id} ({base}, acceleration within {RAIL_MODEL[base].error_mps2:g} m/s2)"
        for kind in kinds
        if kind.attributes.get("carFollowModel") == "Rail"
        for base in [kind.attributes.get("trainType", "NGT400")]
        if base != "custom" and base in RAIL_MODEL and not {*_CONSTANTS[1:]} <= kind.attributes.keys()
    ]
    return [f"train types fitted to the tables SUMO has of them: {', '.join(found)}"] if found else []
