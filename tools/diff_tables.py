"""Write the generated parts of trainctl/diff/README.md: the causes of findings, and every table's columns with unit and type.

Usage: python tools/diff_tables.py

Columns of our own tables come from a run, those of SUMO's logs from the schemas of the SUMO that is installed.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree as ET

import pyarrow as pa
import pyarrow.parquet as pq
from sumo import SUMO_HOME

from trainctl.diff.findings import CAUSES
from trainctl.diff.sources import KINDS
from trainctl.runner import run
from trainctl.runs.kinds import Kind
from trainctl.scenario.build import open_scenario

PAGE = Path(__file__).resolve().parent.parent / "trainctl" / "diff" / "README.md"
SCHEMAS = Path(SUMO_HOME) / "data" / "xsd"
XSD = "{http://www.w3.org/2001/XMLSchema}"

#: Endings of our columns. What ends in none of them is 1 or a name.
ENDINGS = {
    "_s": "s", "_m": "m", "_mps": "m/s", "_mps2": "m/s2", "_mps3": "m/s3", "_n": "N", "_j": "J", "_w": "W", "_km": "km",
    "_m_max": "m", "_m_min": "m", "_mps_min": "m/s", "_mps_max": "m/s", "_mps2_min": "m/s2", "_mps2_max": "m/s2",
}  # fmt: skip

#: Units of SUMO's attributes that are no times, by the words they begin or end with; the first that fits.
UNITS = (
    (r"speedFactor|.*[Rr]elative|.*Factor|share", "1"), (r"occupancy", "%"), (r"flow", "1/h"), (r".*[Dd]ensity", "1/km"),
    (r"electricity_normed", "Wh/(km h)"), (r".*_normed", "g/(km h)"), (r"electricity_perVeh", "Wh"), (r".*_perVeh", "mg"),
    (r"(.*_)?(x|y|z|.*[Pp]os(Lat)?|.*[Ll]ength|.*[Dd]istance|odometer|.*Gap|.*(Front|Back))", "m"),
    (r".*[Aa]cceleration(Lat)?|.*[Dd]ecel", "m/s2"),
    (r".*[Ss]peed(Lat)?", "m/s"),
    (r"angle|slope", "deg"),
    (r".*(CO|CO2|HC|PMx|NOx|fuel)_abs", "mg"), (r".*electricity_abs", "Wh"),
    (r"CO|CO2|HC|PMx|NOx|fuel", "mg/s"), (r"electricity", "Wh/s"), (r"noise", "dB"),
    (r".*(actualBatteryCapacity|totalEnergyConsumed|totalEnergyRegenerated|energy.*)", "Wh"),
    (r"meanTravelTime|meanWaitingTime|.*[Tt]ime.*|.*[Dd]uration|.*[Dd]elay.*|traveltime|sampledSeconds|.*Loss", "s"),
)  # fmt: skip

#: Columns around the rows.
AROUND = {"time": ("s", "number"), "begin": ("s", "number"), "end": ("s", "number"), "interval_id": ("", "text"),
          "edge_id": ("", "text")}  # fmt: skip

#: Columns that the schemas do not know, or of which their types tell too little: by log, "name unit type".
BESIDES = {
    "emission": ("waiting s number",),
    "summary": ("discarded 1 number", "duration ms number"),
    "personsummary": ("discarded 1 number", "duration ms number"),
    "stops": ("started s number",),
    # the schema of routes is that of all that is read
    "vehroute": (
        "id - text", "type - text", "depart s number", "departLane - text", "departPos m text", "departSpeed m/s text",
        "arrival s number", "route_edges - text", "route_exitTimes s text", "stop_lane - text", "stop_endPos m number",
        "stop_duration s number", "stop_started s number", "stop_ended s number", "walk_edges - text", "walk_exitTimes s text",
        "walk_started s number", "walk_ended s number",
    ),
    # there is none
    "ssm": (
        "ego - text", "foe - text", "begin s number", "end s number", "timeSpan_values s text",
        *(f"{name}Span_values {unit} text" for name, unit in (
            ("BR", "m/s2"), ("SGAP", "m"), ("TGAP", "s"), ("TTC", "s"), ("DRAC", "m/s2"), ("PPET", "s"), ("MDRAC", "m/s2"),
            ("type", "1"),
        )),
        *(f"{name}_{rest}" for name, unit, last in (
            ("maxBR", "m/s2", ()), ("minSGAP", "m", ("leader - text",)), ("minTGAP", "s", ("leader - text",)),
            *((conflict, unit, ("type 1 number", "speed m/s number")) for conflict, unit in (
                ("minTTC", "s"), ("maxDRAC", "m/s2"), ("PET", "s"), ("minPPET", "s"), ("maxMDRAC", "m/s2"))),
        ) for rest in ("time s number", "position m text", f"value {unit} number", *last)),
    ),
}  # fmt: skip


def ours() -> dict[str, list[tuple[str, str, str]]]:
    """Columns of the tables of a run: name, unit, type."""
    out: dict[str, list[tuple[str, str, str]]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        done = run(open_scenario("three_tracks", {"run.duration_s": 8}), Path(scratch) / "run", "numeric")
        stops = run(open_scenario("merging", {"run.duration_s": 240}), Path(scratch) / "stops", "numeric")
        tables = {name: done.folder / f"{name}.parquet" for name in ("trains", "units", "links")}
        for table, file in (tables | {"calls": stops.folder / "stops.parquet"}).items():
            for field in pq.read_schema(file):
                unit = next((u for end, u in sorted(ENDINGS.items(), key=lambda e: -len(e[0])) if field.name.endswith(end)), None)
                number = pa.types.is_floating(field.type) or pa.types.is_integer(field.type)
                kind = "number" if number else "true or false" if pa.types.is_boolean(field.type) else "text"
                out.setdefault(table, []).append((field.name, unit or ("1" if number else ""), kind))
    out["events"] = [("time_s", "s", "number"), ("kind", "", "text"), ("train", "", "text"), ("whatever the kind says", "", "text")]
    return out


def unit_of(name: str, typed: str) -> str:
    """Unit of one of SUMO's attributes."""
    if typed.startswith("timeType"):
        return "s"
    return next((unit for pattern, unit in UNITS if re.fullmatch(pattern, name)), "1")


def of_schema(kind: Kind) -> list[tuple[str, str, str]]:
    """Columns of one of SUMO's logs: attributes of its rows, and of the elements in them with their names in front."""
    out = {column: AROUND[column] for columns in kind.around.values() for column in columns.values()}
    out |= _in_schema(kind)
    for text in BESIDES.get(kind.name, ()):
        column, unit, typed = text.split(" ")
        out[column] = (unit.replace("-", ""), typed)
    return [(column, *rest) for column, rest in out.items()]


def _in_schema(kind: Kind) -> dict[str, tuple[str, str]]:
    if kind.name in ("vehroute", "ssm"):
        return {}
    schemas = map(_whole, sorted(SCHEMAS.glob("*_file.xsd")))
    schema = next(s for s in schemas if any(e.get("name") == kind.root for e in s.findall(f"{XSD}element")))
    every = {e.get("name"): e for e in schema.iter(f"{XSD}element") if e.get("name")}
    types = {e.get("name"): e for e in schema.iter(f"{XSD}complexType") if e.get("name")}
    rows = {row for other in KINDS if other.root == kind.root for row in other.rows}
    out: dict[str, tuple[str, str]] = {}

    def attributes(element: ET.Element, front: str, depth: int) -> Iterator[tuple[str, str]]:
        body = types.get(element.get("type"), element)
        for attribute in _own(body, types):
            yield f"{front}{attribute.get('name')}", attribute.get("type") or "xsd:string"
        for child in body.iter(f"{XSD}element"):
            inner = every.get(child.get("ref") or child.get("name"))
            if inner is None or inner is element or depth == 2 or inner.get("name") in {"example_device", *rows}:
                continue
            yield from attributes(inner, f"{inner.get('name')}_", depth + 1)

    for row in kind.rows:
        if row in every:
            for column, typed in attributes(every[row], "", 0):
                text = typed.startswith(("xsd:string", "position")) and not column.endswith("Speed")
                unit = unit_of(column, typed)
                out.setdefault(column, ("" if text and unit == "1" else unit, "text" if text else "number"))
    return out


def _whole(path: Path) -> ET.Element:
    """A schema with what it includes."""
    schema = ET.parse(path).getroot()
    for include in schema.findall(f"{XSD}include"):
        schema.extend(_whole(path.parent / include.attrib["schemaLocation"]))
    return schema


def _own(body: ET.Element, types: dict[str | None, ET.Element]) -> Iterator[ET.Element]:
    """Attributes of an element, not of those in it."""
    for child in body:
        if child.tag == f"{XSD}attribute":
            yield child
        elif child.tag != f"{XSD}element":
            if child.get("base") in types:
                yield from _own(types[child.get("base")], types)
            yield from _own(child, types)


def tables() -> str:
    """All tables as Markdown."""
    found = ours() | {kind.name: of_schema(kind) for kind in KINDS}
    out = []
    for table, columns in found.items():
        where = "a run folder's" if table in ("trains", "units", "links", "events") else "SUMO's"
        where = "stops.parquet of a run folder; `stops` is a log of SUMO's" if table == "calls" else where
        out += [f"\n**{table}** ({where})\n", "| column | unit | type |", "| --- | --- | --- |"]
        out += [f"| `{column}` | {unit} | {kind} |" for column, unit, kind in columns]
    return "\n".join(out).strip() + "\n"


def causes() -> str:
    """The causes of findings as Markdown."""
    return (
        "\n".join(["| cause | what it says |", "| --- | --- |", *(f"| `{name}` | {text} |" for name, text in CAUSES.items())])
        + "\n"
    )


def page() -> str:
    """The page with its generated parts renewed."""
    text = PAGE.read_text(encoding="utf-8")
    for name, part in (("causes", causes()), ("tables", tables())):
        text = re.sub(rf"(<!-- {name} -->\n).*?(<!-- end of {name} -->)", lambda m, part=part: m[1] + part + m[2], text, flags=re.S)
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    sys.exit(0)
