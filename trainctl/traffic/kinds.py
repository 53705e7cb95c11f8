"""The vTypes of a SUMO configuration, with what SUMO itself knows of vehicle classes and of the trains of its Rail model."""

from __future__ import annotations

import re
from typing import NamedTuple
from xml.etree.ElementTree import Element

#: Length [m] and maximum speed [m/s] of SUMO's vehicle classes.
_CLASS = {
    "rail": (135.0, 160 / 3.6), "rail_electric": (200.0, 220 / 3.6), "rail_fast": (200.0, 330 / 3.6),
    "rail_urban": (109.5, 100 / 3.6),
    "tram": (22.0, 80 / 3.6), "subway": (109.5, 100 / 3.6), "cable_car": (5.0, 200 / 3.6),
}  # fmt: skip


class Built(NamedTuple):
    """What SUMO's Rail model knows of a train type; its tables of effort and resistance over speed as the constants of ours.

    The constants are fitted to what a train of SUMO 1.28 does, pulling and braking with all it has, up to its maximum speed: its
    acceleration then is that of SUMO within ``error_mps2`` at every speed.
    """

    length_m: float
    speed_mps: float
    mass_kg: float
    mass_factor: float
    deceleration_mps2: float
    traction_kn: float = 0.0
    power_kw: float = 0.0
    resistance: tuple[float, float, float] = (0.0, 0.0, 0.0)  # kN, kN s/m, kN s2/m2
    error_mps2: float = 0.0


#: Train types of SUMO's Rail model; the mass of "custom" stands for no train, and it has no tables.
RAIL_MODEL = {
    "NGT400": Built(200.0, 500 / 3.6, 384e3, 1.04, 0.9, 647.21, 15835.3, (1.859, 0.0575, 0.007934), 0.173),
    "NGT400_16": Built(200.0, 430 / 3.6, 384e3, 1.04, 0.9, 273.95, 15969.8, (5.517, 0.07548, 0.00798), 0.003),
    "ICE1": Built(358.0, 250 / 3.6, 876e3, 1.1, 0.5, 381.11, 9163.76, (10.67, 0.5549, 0.01532), 0.021),
    "ICE3": Built(200.0, 300 / 3.6, 420e3, 1.04, 0.5, 292.0, 7827.71, (7.414, 0.05191, 0.008664), 0.019),
    "REDosto7": Built(207.0, 160 / 3.6, 425.5e3, 1.1, 0.5, 296.36, 5582.32, (8.266, 0.1486, 0.01289), 0.009),
    "RB425": Built(67.5, 160 / 3.6, 138e3, 1.04, 1.0, 144.81, 2183.76, (2.542, 0.08772, 0.006158), 0.065),
    "RB628": Built(46.0, 120 / 3.6, 72.2e3, 1.04, 0.5, 55.037, 269.442, (1.311, 0.04771, 0.005653), 0.069),
    "Freight": Built(512.0, 120 / 3.6, 1440e3, 1.06, 0.3, 287.59, 6030.61, (3.116, 0.9055, 0.1001), 0.013),
    "MireoPlusB": Built(46.56, 160 / 3.6, 105.5e3, 1.05, 1.1, 105.25, 1731.09, (1.05, 0.004309, 0.006698), 0.010),
    "MireoPlusH": Built(46.56, 160 / 3.6, 105.4e3, 1.05, 1.1, 103.67, 1702.95, (1.053, 0.00389, 0.006706), 0.009),
    "custom": Built(100.0, 200 / 3.6, 100e3, 1.05, 1.0),
}


class Kind(NamedTuple):
    """A vType."""

    id: str
    vclass: str
    length_m: float
    max_speed_mps: float
    speed_factor: float
    attributes: dict[str, str]  # all attributes and params


def kind_of(element: Element) -> Kind:
    """A vType as SUMO takes it: what it does not say is that of its trainType or its vClass."""
    said = dict(element.attrib) | {p.get("key", ""): p.get("value", "") for p in element.iter("param")}
    for child in element:  # the old way: <carFollowing-Rail trainType="..."/>
        if child.tag.startswith("carFollowing-"):
            said |= {"carFollowModel": child.tag.partition("-")[2], **child.attrib}
    vclass = said.get("vClass", "passenger")
    length, speed = _CLASS.get(vclass, (5.0, 200 / 3.6))
    if said.get("carFollowModel") == "Rail" and (built := RAIL_MODEL.get(said.get("trainType", "NGT400"))) is not None:
        length, speed = built.length_m, built.speed_mps
    # A distribution, norm(mean, deviation) or normc(mean, ...): its mean.
    factor = re.search(r"[-+.\d][-+.\deE]*", said.get("speedFactor", "1"))
    return Kind(
        id=said.get("id", ""),
        vclass=vclass,
        length_m=float(said.get("length", length)),
        max_speed_mps=float(said.get("maxSpeed", speed)),
        speed_factor=float(factor[0]) if factor else 1.0,
        attributes=said,
    )


def default_types() -> dict[str, Element]:
    """The vTypes SUMO has of its own that a train may be of."""
    return {"DEFAULT_VEHTYPE": Element("vType", id="DEFAULT_VEHTYPE"),
            "DEFAULT_RAILTYPE": Element("vType", id="DEFAULT_RAILTYPE", vClass="rail")}  # fmt: skip
