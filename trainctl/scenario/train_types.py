"""Train types from the vTypes of a SUMO configuration."""

from __future__ import annotations

from pydantic import ValidationError

from trainctl.scenario.tables import TrainType
from trainctl.traffic.files import bad_number
from trainctl.traffic.kinds import RAIL_MODEL, Kind

#: What a vType must say to be a plant of ours, in SUMO's units: kg, kW, kN, and kN with m/s.
_CONSTANTS = ("mass", "maxPower", "maxTraction", "resCoef_constant", "resCoef_linear", "resCoef_quadratic")


def train_type(kind: Kind) -> TrainType | list[str]:
    """Physical data of a vType with SUMO's Rail model and constants of its own; else what it lacks, one line.

    Notes
    -----
    SUMO's Rail model takes ``maxPower`` in kW, ``maxTraction`` and ``resCoef_*`` in kN with speeds in m/s, ``mass`` in kg; the
    traction is the smaller of ``maxTraction`` and ``maxPower`` over the speed, ``decel`` is braking effort over inertia. The train
    types built into SUMO are tables of speed and force, which no key of ours can hold.
    """
    said = kind.attributes
    rail, base = said.get("carFollowModel") == "Rail", said.get("trainType", "NGT400")
    built = RAIL_MODEL.get(base, RAIL_MODEL["custom"])
    # Any other model takes notice of the mass alone.
    value = {key: said[key] for key in _CONSTANTS if key in said and (rail or key == "mass")}
    if rail and base != "custom" and base in RAIL_MODEL:
        value.setdefault("mass", str(built.mass_kg))
    if lacking := [f"no {key}" for key in _CONSTANTS if key not in value]:
        why = f" (SUMO has trainType {base} as tables)" if rail and base != "custom" and base in RAIL_MODEL else ""
        return [
            f"vType {kind.id}: {', '.join(lacking)}{why}: add [train_type.{kind.id}] to the scenario, or"
            f' carFollowModel="Rail" trainType="custom" with {", ".join(_CONSTANTS)} to the vType'
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
