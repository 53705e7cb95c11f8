"""Mutated scenarios, lines, imports, nets, logs and run folders: one line per mistake, never a traceback, a hang, or a gigabyte.

500 examples by default; ``pytest -m campaign tests/property/test_fuzz.py`` runs 10 000.
"""

from __future__ import annotations

import copy
import datetime
import gzip
import json
import math
import shutil
import tomllib
from functools import cache
from xml.etree import ElementTree as ET

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import tomli_w
import yaml
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from limits import bounded

import sumo_net
from sumo_net import Line
from sumo_net.importing import Options, convert
from trainctl.diff.page import page
from trainctl.diff.results import junit
from trainctl.diff.runs import diff
from trainctl.diff.tolerance import parse_tolerances
from trainctl.metrics.run import metrics
from trainctl.metrics.traffic import metrics_of_fcd
from trainctl.runs.run import Run
from trainctl.scenario.build import open_scenario
from trainctl.scenario.check import facts
from trainctl.scenario.reading import read, shipped

# Values and trees


NUMBERS = st.one_of(
    st.sampled_from([0, -1, 1, 2, 10**30, -(2**63), 0.0, -0.0, 1e-300, 5e-324, 1e308, -1e308, math.nan, math.inf, -math.inf, 1e9, 0.1]),
    st.integers(-1000, 1000), st.floats(-1e6, 1e6),
)  # fmt: skip
TEXTS = st.one_of(
    st.sampled_from(["", "1", "nan", "\x00", "../x.toml", "a" * 5000, "emu", "point", "links", "é\n"]), st.text(max_size=8)
)
LEAVES = st.one_of(NUMBERS, TEXTS, st.booleans(), st.just(datetime.date(2020, 1, 1)), st.just(datetime.time(1, 2)))
VALUES = st.one_of(
    LEAVES, st.lists(LEAVES, max_size=4), st.lists(st.lists(NUMBERS, max_size=3), max_size=3),
    st.dictionaries(st.sampled_from(["a", "id", "law", "kind", "units", ""]), LEAVES, max_size=3),
)  # fmt: skip
CHANGES = ["replace", "replace", "delete", "scale", "double", "add", "rename", "swap", "wrap", "empty"]


def places(value, above=()):
    """Every place in a tree, as a path."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*above, key)
        yield from places(item, (*above, key))


def at(tree, place):
    for key in place:
        tree = tree[key]
    return tree


@st.composite
def mutated(draw, base, most=5):
    """A tree with some values replaced, deleted, doubled, renamed, exchanged, ..."""
    tree = copy.deepcopy(base)
    for _ in range(draw(st.integers(1, most))):
        found = list(places(tree))
        if not found:
            break
        place = found[draw(st.integers(0, len(found) - 1))]
        *above, key = place
        parent, value, how = at(tree, above), at(tree, place), draw(st.sampled_from(CHANGES))
        if how == "delete":
            del parent[key]
        elif how == "scale" and isinstance(value, int | float) and not isinstance(value, bool):
            parent[key] = value * draw(st.sampled_from([-1, 0, 1000, 1e-6, 1e12, 1.01, math.nan]))
        elif how == "double" and isinstance(parent, list):
            parent.insert(key, copy.deepcopy(value))
        elif how == "add" and isinstance(value, dict):
            value[draw(st.sampled_from(["x", "seed", "units", "extends", "loss", "delay_s", "id"]))] = draw(VALUES)
        elif how == "rename" and isinstance(parent, dict):
            parent[draw(TEXTS)] = parent.pop(key)
        elif how == "swap":
            other = found[draw(st.integers(0, len(found) - 1))]
            if other[: len(place)] != place and place[: len(other)] != other:
                there = at(tree, other[:-1])
                parent[key], there[other[-1]] = there[other[-1]], value
        elif how == "wrap":
            parent[key] = [value]
        elif how == "empty" and isinstance(value, dict | list):
            parent[key] = type(value)()
        else:
            parent[key] = draw(VALUES)
    return tree


@st.composite
def scarred(draw, content, most=4):
    """Bytes with some of them cut, doubled, or replaced."""
    out = bytearray(content)
    for _ in range(draw(st.integers(1, most))):
        i = draw(st.integers(0, len(out)))
        n = draw(st.sampled_from([0, 1, 2, 8, 100, 10_000]))
        junk = draw(
            st.sampled_from([b"", b"\x00", b"\xff\xfe", b"<", b'"', b"&x;", b"nan", b"-1e400", b"\n", b";", b"]]>", b"9" * 400])
        )
        how = draw(st.sampled_from(["replace", "double", "cut", "flip"]))
        if how == "replace":
            out[i : i + n] = junk
        elif how == "double":
            out[i:i] = out[i : i + n]
        elif how == "cut":
            del out[i if draw(st.booleans()) else i + n :]
        elif i < len(out):
            out[i] ^= draw(st.integers(1, 255))
    return bytes(out)


# What is fuzzed


@cache
def scenario_tables(name):
    return read(name)[0]


def fuzz_scenario(data, place, sumo):
    """Check of a scenario."""
    base = scenario_tables(data.draw(st.sampled_from(sorted(shipped()))))
    tree = data.draw(mutated(base))
    text = tomli_w.dumps(tree).encode("utf-8", "surrogatepass")
    if data.draw(st.integers(0, 9)) == 0:
        text = data.draw(scarred(text))
    file = place / "s.toml"
    file.write_bytes(text)
    with bounded():
        facts(open_scenario(str(file)))


def fuzz_line(data, place, sumo):
    """A line description."""
    base = tomllib.loads(data.draw(st.sampled_from(list(sumo_net.shipped().values()))).read_text())
    text = tomli_w.dumps(data.draw(mutated(base))).encode("utf-8", "surrogatepass")
    if data.draw(st.integers(0, 9)) == 0:
        text = data.draw(scarred(text))
    (place / "l.toml").write_bytes(text)
    with bounded():
        Line.of(sumo_net.read_spec(place / "l.toml"))


@st.composite
def elements(draw, content, most=4):
    """XML with lines doubled, moved or dropped, attributes changed, or a document type put before it."""
    lines = content.split("\n")
    for _ in range(draw(st.integers(1, most))):
        i = draw(st.integers(0, len(lines) - 1))
        how = draw(st.sampled_from(["drop", "double", "move", "value", "value", "value", "name", "bomb", "nest"]))
        if how == "drop":
            del lines[i]
        elif how == "double":
            lines.insert(i, lines[draw(st.integers(0, len(lines) - 1))])
        elif how == "move":
            lines.insert(draw(st.integers(0, len(lines) - 1)), lines.pop(i))
        elif how in ("value", "name"):
            parts = lines[i].split('"')
            if len(parts) > 2:
                k = draw(st.integers(0, len(parts) // 2 - 1)) * 2 + (how == "value")
                parts[k] = (
                    str(draw(LEAVES)).replace('"', "").replace("<", "") if how == "value" else f" x{draw(st.integers(0, 3))}="
                )
                lines[i] = '"'.join(parts)
        elif how == "bomb":
            entities = "".join(f'<!ENTITY e{k} "{f"&e{k - 1};" * 10 if k else "x" * 100}">' for k in range(9))
            lines.insert(0, f"<!DOCTYPE x [{entities}]>")
            lines[i] = lines[i].replace('="', '="&e8;', 1)
        else:
            lines[i] = "<a>" * draw(st.sampled_from([3, 5000, 100_000])) + lines[i]
        if not lines:
            break
    return "\n".join(lines)


def mutated_log(data, file, place):
    """A mutated log beside the whole one."""
    content = file.read_bytes()
    target = place / f"mutated{''.join(file.suffixes)}"
    packed = content[:2] == b"\x1f\x8b"
    if file.suffix == ".parquet" and data.draw(st.booleans()):
        write_mutated(data, file, target)
        return target
    raw = gzip.decompress(content) if packed else content
    if b"\x00" not in raw and data.draw(st.integers(0, 3)):
        raw = data.draw(elements(raw.decode())).encode("utf-8", "surrogatepass")
    else:
        raw = data.draw(scarred(raw))
    target.write_bytes(
        data.draw(scarred(gzip.compress(raw))) if packed and data.draw(st.booleans()) else gzip.compress(raw) if packed else raw
    )
    return target


def write_mutated(data, file, target):
    """A Parquet file with columns dropped, renamed, doubled or of other types and rows dropped, doubled or shuffled."""
    table = pq.read_table(file)
    for _ in range(data.draw(st.integers(1, 4))):
        if not table.num_columns:
            break
        k = data.draw(st.integers(0, table.num_columns - 1))
        name, rows = table.column_names[k], table.num_rows
        how = data.draw(st.sampled_from(["drop", "rename", "double", "type", "rows", "value", "null"]))
        if how == "drop":
            table = table.remove_column(k)
        elif how == "rename":
            table = table.rename_columns([data.draw(TEXTS) if j == k else n for j, n in enumerate(table.column_names)])
        elif how == "double":
            table = table.append_column(name, table.column(k))
        elif how == "type":
            kinds = [
                pa.string(),
                pa.int32(),
                pa.float32(),
                pa.bool_(),
                pa.timestamp("s"),
                pa.list_(pa.int64()),
                pa.binary(),
                pa.decimal128(38),
            ]
            table = table.set_column(k, name, pa.nulls(rows, data.draw(st.sampled_from(kinds))))
        elif how == "rows":
            i, n = data.draw(st.integers(0, rows)), data.draw(st.integers(0, 50))
            table = pa.concat_tables([table.slice(i, n), table.slice(0, n)])
        elif rows:
            values = table.column(k).to_pylist()
            value = None if how == "null" else data.draw(LEAVES)
            values[data.draw(st.integers(0, rows - 1))] = value
            try:
                column = pa.array(values)
            except (pa.ArrowException, OverflowError):
                column = pa.array([str(v) for v in values])
            table = table.set_column(k, name, column)
    pq.write_table(table, target)


def compared(a, b):
    """Compare in both ways, and put the findings into words."""
    for tolerances in (None, parse_tolerances({"time_s": 1.5, "range": 0.01})):
        report = diff(a, b, tolerances)
        json.dumps(report.as_dict())
        ET.fromstring(junit(report))
        page(report)
        assert report.same or report.findings


def fuzz_log(data, place, sumo):
    """diff of a log with its mutation; metrics of an FCD log."""
    file = sumo[data.draw(st.sampled_from(sorted(sumo)))]
    target = mutated_log(data, file, place)
    with bounded():
        compared(file, target)
    with bounded():
        metrics_of_fcd(target)


def fuzz_net(data, place, sumo):
    """A net file."""
    target = mutated_log(data, sumo["net.xml"], place)
    with bounded():
        Line.read(target)


def fuzz_run(data, place, sumo):
    """A run folder with one file mutated: diff and metrics."""
    whole = sumo["trains"].parent
    copied = place / "run"
    shutil.copytree(whole, copied)
    name = data.draw(
        st.sampled_from(["run.json", "scenario.toml", "events.jsonl", "trains.parquet", "links.parquet", "units.parquet"])
    )
    file = copied / name
    if name == "scenario.toml" and data.draw(st.booleans()):
        file.write_text(tomli_w.dumps(data.draw(mutated(tomllib.loads(file.read_text())))), errors="surrogatepass")
    elif file.suffix == ".parquet" and data.draw(st.integers(0, 3)):
        write_mutated(data, file, file)
    else:
        file.write_bytes(data.draw(scarred(file.read_bytes())))
    with bounded():
        compared(whole, copied)
    with bounded():
        metrics(Run(copied))


PERMIL = {"position": "m", "slope": "permil"}
EFFORT = [[v, min(100e3, 6.5e6 / (v + 1))] for v in range(0, 141, 20)]
IMPORTS = [
    {
        "metadata": {"id": "Hill"}, "stops": {"unit": "m", "values": [0.0, 2000.0, 9000.0]},
        "speed limits": {"units": {"position": "m", "velocity": "km/h"}, "values": [[0.0, 90], [4000.0, 126]]},
        "gradients": {"units": PERMIL, "values": [[0.0, 10.0], [3000.0, -20.5]]},
    },
    {
        "metadata": {"id": "Swift"}, "length": {"value": 60.0, "unit": "m"}, "mass": {"value": 120.0, "unit": "t"},
        "rho": {"value": 10, "unit": "%"}, "max traction power": {"value": 2.6, "unit": "MW"},
        "max traction force": {"value": 200.0, "unit": "kN"}, "max reg braking power": {"value": 2600.0, "unit": "kW"},
        "max reg braking force": {"value": 150.0, "unit": "kN"}, "max speed": {"value": 160, "unit": "km/h"},
        "rolling resistance r0": {"value": 2.4, "unit": "kN"}, "rolling resistance r1": {"value": 0.017, "unit": "kN/(km/h)"},
        "rolling resistance r2": {"value": 0.0009, "unit": "kN/(km/h)^2"},
    },
    {
        "schema": "https://railtoolkit.org/schema/running-path.json",
        "paths": [{"id": "valley", "characteristic_sections": [[100.0, 36.0, 0.0], [400.0, 36.0, 5.0], [1100.0, 72.0, 0.0]]}],
    },
    {
        "schema": "https://railtoolkit.org/schema/rolling-stock.json", "trains": [{"id": "T1", "formation": ["motor", "motor"]}],
        "vehicles": [{
            "id": "motor", "vehicle_type": "multiple unit", "length": 40.0, "mass": 60.0, "load_limit": 10.0, "mass_traction": 40.0,
            "rotation_mass": 1.1, "base_resistance": 3.0, "rolling_resistance": 1.5, "air_resistance": 4.0, "a_braking": -0.5,
            "speed_limit": 120, "tractive_effort": EFFORT,
        }],
    },
]  # fmt: skip


def fuzz_import(data, place, sumo):
    """A line or a train of another project."""
    tree = data.draw(mutated(data.draw(st.sampled_from(IMPORTS))))
    packed = json.dumps(tree, default=str)
    if "metadata" not in tree:
        packed = yaml.safe_dump(json.loads(packed))
    content = packed.encode("utf-8", "surrogatepass")
    if data.draw(st.integers(0, 4)) == 0:
        content = data.draw(scarred(content))
    (place / "import.txt").write_bytes(content)
    with bounded():
        convert(place / "import.txt", Options(coupler_stiffness_n_per_m=1e6))


@pytest.fixture(scope="module")
def sumo(finished, tmp_path_factory):
    """Logs of SUMO's in all formats, a net, and the tables of a run."""
    run = finished("three_tracks", "sumo", **{"run.duration_s": 40})
    place = tmp_path_factory.mktemp("logs")
    from trainctl.diff.sources import sumo_log

    (table,) = [pa.concat_tables(sumo_log(run.folder / "sumo" / "fcd.parquet").batches())]
    lines = ["<fcd-export>"]
    for time in sorted(set(table["time"].to_pylist())):
        rows = [r for r in table.to_pylist() if r["time"] == time]
        lines.append(f'<timestep time="{time:.2f}">')
        lines += ["<vehicle " + " ".join(f'{k}="{v}"' for k, v in r.items() if k != "time" and v is not None) + "/>" for r in rows]
        lines.append("</timestep>")
    xml = "\n".join([*lines, "</fcd-export>"])
    (place / "fcd.xml").write_text(xml)
    (place / "fcd.xml.gz").write_bytes(gzip.compress(xml.encode()))
    pq.read_table(run.folder / "sumo" / "fcd.parquet").to_pandas().to_csv(place / "fcd.csv", sep=";", index=False)
    (place / "fcd.csv.gz").write_bytes(gzip.compress((place / "fcd.csv").read_bytes()))
    sumo_net.build(sumo_net.read_spec(sumo_net.shipped()["single_track"]), place)
    logs = {name: run.folder / "sumo" / f"{name}.xml" for name in ("tripinfo", "summary", "statistics", "collisions", "vehroute")}
    logs |= {name: place / name for name in ("fcd.xml", "fcd.xml.gz", "fcd.csv", "fcd.csv.gz")}
    return logs | {
        "fcd.parquet": run.folder / "sumo" / "fcd.parquet", "net.xml": place / "single_track.net.xml", "trains": run.folder / "trains.parquet"
    }  # fmt: skip


#: examples by default; the campaign runs twenty times as many
EXAMPLES = {fuzz_scenario: 200, fuzz_line: 50, fuzz_import: 50, fuzz_log: 120, fuzz_net: 40, fuzz_run: 40}


def fuzzed(case, examples, tmp_path_factory, sumo, seed=None):
    place = tmp_path_factory.mktemp("fuzz")

    @settings(
        max_examples=examples, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck),
        print_blob=False, phases=[Phase.generate],  # shrinking a hang takes for ever
    )  # fmt: skip
    @given(st.data())
    def examine(data):
        shutil.rmtree(place)
        place.mkdir()
        case(data, place, sumo)

    examine()


@pytest.mark.parametrize("case", EXAMPLES)
def test_no_input_breaks_a_command(case, tmp_path_factory, sumo):
    fuzzed(case, EXAMPLES[case], tmp_path_factory, sumo)


@pytest.mark.campaign
@pytest.mark.parametrize("case", EXAMPLES)
def test_ten_thousand_inputs_break_no_command(case, tmp_path_factory, sumo):
    fuzzed(case, 20 * EXAMPLES[case], tmp_path_factory, sumo)


def test_examples_are_five_hundred():
    assert sum(EXAMPLES.values()) == 500
