"""One reader for all of SUMO's logs: every format of one run means the same, and the fast way reads what the strict parser does."""

from __future__ import annotations

import gzip
import random
import subprocess
import sys

import every_log
import fcd_fuzz
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from every_log import FORMS, KINDS, NO_PARQUET
from limits import bounded

from trainctl.diff.runs import diff
from trainctl.diff.tolerance import EXACT, Tolerance, Tolerances, parse_tolerances
from trainctl.errors import InputError
from trainctl.metrics.traffic import metrics_of_fcd
from trainctl.runs import xml_rows as reader
from trainctl.runs.logs import FCD, seconds, sumo_log, vehicles
from trainctl.runs.xml_rows import xml_rows

# One run of SUMO's in all formats

#: What SUMO writes so that nobody can read it: one name for several columns; positions with commas between commas.
REFUSALS = {
    ("plain.csv", "ssm"): "a column appears more than once", ("plain.csv", "persons"): "a column appears more than once",
    ("comma.csv", "ssm"): "not a CSV log", ("comma.csv", "collisions"): "not a CSV log",
}  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Folders with the logs of one run, by form."""
    place = tmp_path_factory.mktemp("sumo")
    every_log.write(place, every_log.FORMS)
    return place


def log_of(place, form, kind):
    return place / form / f"{kind}.{form.rpartition('.')[2].replace('human', 'xml')}"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", [form for form in FORMS if form != "xml"])
def test_every_format_of_a_run_means_the_same(written, kind, form):
    xml, other = log_of(written, "xml", kind), log_of(written, form, kind)
    if form == "parquet" and kind in NO_PARQUET:
        pytest.skip("SUMO does not write it")
    if (form, kind) in REFUSALS:
        with pytest.raises(InputError, match=REFUSALS[form, kind]):
            diff(xml, other)
        return
    name = {"persons": "tripinfo", "walks": "vehroute"}.get(kind, kind)
    assert sumo_log(xml).name == name
    assert sumo_log(other).name == name
    columns = {"stop_duration", "stop_endPos", "stop_ended", "stop_lane", "stop_started"} if kind == "vehroute" else set()
    report = diff(xml, other)
    (table,) = report.tables
    # SUMO leaves stops out of what is no XML
    assert (table.columns, table.missing.count, table.extra.count) == ({}, 0, 0), report.lines()
    assert set(table.lost_columns) <= (columns if form != "human" else set())
    assert not [note for note in report.notes if "only in B" in note]
    assert table.rows


def test_rows_are_what_sumo_says(written):
    """Rows of the tables, counted in the XML by other means."""
    for kind, mark in (("fcd", "<vehicle |<person |<container "), ("tripinfo", "<tripinfo "), ("collisions", "<collision "), ("persons", "<personinfo |<containerinfo "),
                       ("ssm", "<conflict |<globalMeasures "), ("lanedata", "<lane "), ("edgedata", "<edge "), ("emission", "<vehicle "),
                       ("statistics", "<statistics ")):  # fmt: skip
        path = log_of(written, "xml", kind)
        text = path.read_text()
        body = text[text.index("-->") :] if "-->" in text else text
        rows = sum(table.num_rows for table in sumo_log(path).batches())
        assert rows == sum(body.count(word) for word in mark.split("|")), kind


@pytest.mark.parametrize("form", FORMS)
def test_metrics_are_those_of_the_vehicles_in_every_format(written, form):
    values = metrics_of_fcd(log_of(written, form, "fcd"))
    assert values == metrics_of_fcd(log_of(written, "xml", "fcd"))
    assert values["fcd.vehicles"] == 13
    assert values["fcd.spacing_min_m"] > 5.0


def test_a_walk_of_two_legs_is_one_row_whoever_wrote_it(written):
    for form in ("xml", "tag.csv"):
        rows = [row for table in sumo_log(log_of(written, form, "persons")).batches() for row in table.to_pylist()]
        (person,) = [row for row in rows if row["id"] == "p1"]
        assert float(person["walk_arrival"]) == float(person["walk_depart2"])


@pytest.mark.parametrize(("header", "version"), [
    ("on 2022-11-08 10:00:00 by Eclipse SUMO sumo Version 1.15.0", "1.15.0"),
    ("on 2024-04-11T09:00:00.123 by Eclipse SUMO sumo 1.20.0", "1.20.0"),
    ("on 2026-01-01T00:00:00.1+00:00 by Eclipse SUMO sumo v1_28_0+0001-abcdef", "v1_28_0+0001-abcdef"),
    ("by somebody else", None),
])  # fmt: skip
def test_versions_from_the_headers_of_years(tmp_path, header, version):
    """What SUMO 1.15 wrote of an instant has columns less, and none more."""
    old = '<step time="0.00" loaded="2" inserted="1" running="1" waiting="0" ended="0" duration="1"/>'
    (tmp_path / "a.xml").write_text(f"<!-- generated {header}\n-->\n<summary>{old}</summary>")
    log = sumo_log(tmp_path / "a.xml")
    assert (log.name, log.version) == ("summary", version)
    new = old.replace("/>", ' discarded="0"/>')
    (tmp_path / "b.xml").write_text(f"<!-- generated by Eclipse SUMO sumo 1.28.0\n-->\n<summary>{new}</summary>")
    report = diff(tmp_path / "a.xml", tmp_path / "b.xml")
    assert report.same
    assert "summary.discarded: only in B" in report.notes
    assert (f"SUMO {version} -> 1.28.0" in report.notes) == (version is not None)


def test_plain_statistics_of_an_old_version_are_told_apart_by_their_order(tmp_path):
    names = [
        "clockBegin",
        "clockEnd",
        "loaded",
        "inserted",
        "running",
        "waiting",
        "total",
        "jam",
        "collisions",
        "loaded",
        "running",
    ]
    (tmp_path / "a.csv").write_text(";".join(names) + "\n1;2;;;;;;;;;\n;;3;4;5;6;;;;;\n;;;;;;7;8;;;\n;;;;;;;;9;;\n;;;;;;;;;10;11\n")
    (table,) = sumo_log(tmp_path / "a.csv").batches()
    row = {"performance_clockBegin": "1", "vehicles_loaded": "3", "vehicles_running": "5", "teleports_total": "7",
           "safety_collisions": "9", "persons_loaded": "10", "persons_running": "11"}  # fmt: skip
    assert row.items() <= table.to_pylist()[0].items()


def test_rows_of_one_element_are_joined_across_pieces_whatever_their_columns_are_called(tmp_path, monkeypatch):
    rows = "".join(f"p{k};0;5;{leg}\n" for k in range(3) for leg in (1, 2, 3))
    (tmp_path / "a.csv").write_text(f"personinfo_id;personinfo_depart;personinfo_duration;ride_pos2\n{rows}")
    for size in (60, 75, 100, 1 << 20):
        monkeypatch.setattr("trainctl.runs.tables.BLOCK", size)
        found = [row for table in sumo_log(tmp_path / "a.csv").batches() for row in table.to_pylist()]
        assert [[row[name] for name in ("id", "ride_pos2", "ride_pos22", "ride_pos23")] for row in found] == [
            [f"p{k}", "1", "2", "3"] for k in range(3)
        ]


@pytest.mark.parametrize("name", ["fcd.xml", "fcd.csv"])
def test_gzipped(written, tmp_path, name):
    source = log_of(written, {"fcd.xml": "xml", "fcd.csv": "tag.csv"}[name], "fcd")
    (tmp_path / f"{name}.gz").write_bytes(gzip.compress(source.read_bytes()))
    assert diff(source, tmp_path / f"{name}.gz", EXACT).same


def test_a_mesoscopic_log_has_no_lanes_and_is_one_of_vehicles(tmp_path):
    rows = "".join(f"{t}.00;v;5;;AB\n{t}.00;w;9;;AB\n" for t in range(3))
    (tmp_path / "m.csv").write_text(f"timestep_time;vehicle_id;vehicle_speed;vehicle_lane;vehicle_edge\n{rows}")
    assert metrics_of_fcd(tmp_path / "m.csv")["fcd.vehicles"] == 2
    (tmp_path / "m.csv").write_text(f"timestep_time;vehicle_id;vehicle_speed;vehicle_lane;vehicle_edge\n{rows}3.00;x;1;AB_0;\n")
    assert metrics_of_fcd(tmp_path / "m.csv")["fcd.vehicles"] == 1


# Who else writes logs


def frame(lanes=("e_0", "e_0", None, None)):
    """Two vehicles 97 m apart on a lane, two more off any lane 1 m apart."""
    rows = []
    for t in range(3):
        for name, pos, lane in zip("abcd", (100.0 + 10 * t, 3.0 + 10 * t, 5.0, 6.0), lanes, strict=True):
            rows.append((float(t), name, lane, pos, 10.0))
    return pd.DataFrame(rows, columns=["timestep_time", "vehicle_id", "vehicle_lane", "vehicle_pos", "vehicle_speed"])


def xml(rows):
    steps = [
        f'<timestep time="{time}">\n'
        + "".join(f'<vehicle id="{r.vehicle_id}" speed="{r.vehicle_speed}" pos="{r.vehicle_pos}" lane="{r.vehicle_lane if isinstance(r.vehicle_lane, str) else ""}"/>\n'
                  for r in group.itertuples())
        + "</timestep>\n"
        for time, group in rows.groupby("timestep_time")
    ]  # fmt: skip
    return "<fcd-export>\n" + "".join(steps) + "</fcd-export>\n"


@pytest.fixture
def ways(tmp_path):
    """Files of one log, by whoever wrote them."""
    rows = frame()
    text = xml(rows)
    (tmp_path / "plain.xml").write_text(text)
    (tmp_path / "bom.xml").write_bytes(b"\xef\xbb\xbf" + text.encode())
    (tmp_path / "utf16.xml").write_bytes(('<?xml version="1.0" encoding="UTF-16"?>' + text).encode("utf-16"))
    (tmp_path / "latin.xml").write_bytes(b'<?xml version="1.0" encoding="ISO-8859-1"?><!-- \xe9 -->' + text.encode())
    (tmp_path / "comment.xml").write_bytes(
        b'<!-- C:\\Daten\\osobn\xe9\\\xff -- a--b \x01 <timestep time="9"> -->\n' + text.encode()
    )
    middle = text.replace("</timestep>", "</timestep><!-- \udce9 </timestep> <!DOCTYPE -->", 1)
    (tmp_path / "middle.xml").write_bytes(middle.encode("utf-8", "surrogateescape"))
    (tmp_path / "crlf.xml").write_bytes(text.replace("\n", "\r\n").encode())
    (tmp_path / "line.xml").write_text(text.replace("\n", ""))
    rows.to_csv(tmp_path / "pandas.csv", sep=";", index=False)
    rows.to_csv(tmp_path / "bom.csv", sep=";", index=False, encoding="utf-8-sig")
    rows.to_csv(tmp_path / "utf16.csv", sep="\t", index=False, encoding="utf-16")
    rows.to_csv(tmp_path / "index.csv")
    rows.to_csv(tmp_path / "crlf.csv", index=False, lineterminator="\r\n")
    rows.to_csv(tmp_path / "quoted.csv", index=False, quoting=1)
    rows.to_parquet(tmp_path / "pandas.parquet")
    rows.set_index("timestep_time").to_parquet(tmp_path / "time_as_index.parquet")
    rows.sample(frac=1.0, random_state=1).sort_values("timestep_time").to_parquet(tmp_path / "shuffled_index.parquet")
    rows.astype({"vehicle_id": "category", "vehicle_lane": "category"}).to_parquet(tmp_path / "category.parquet")
    return sorted(tmp_path.iterdir())


def test_whoever_wrote_a_log_it_is_read_and_rows_without_lane_have_no_spacing(ways):
    assert len(ways) == 18
    for path in ways:
        values = metrics_of_fcd(path)
        assert (values["fcd.spacing_min_m"], values["fcd.vehicles"], values["fcd.rows"]) == (97.0, 4, 12), path.name
        report = diff(ways[0].with_name("plain.xml"), path, EXACT)
        assert report.same, (path.name, report.lines())
        assert report.notes == [], path.name


def test_one_row_without_a_lane_takes_nothing_else_with_it(tmp_path, monkeypatch):
    """The vehicles are 50 m apart, 20 m in the last steps; one row of these has no lane."""
    steps = [
        f'<timestep time="{t}"><vehicle id="a" speed="1.5" pos="{20 if t >= 90 else 50}" lane="e_0"/>'
        f'<vehicle id="b" speed="1.5" pos="0" lane="{"" if t == 95 else "e_0"}"/></timestep>\n'
        for t in range(100)
    ]
    (tmp_path / "half.xml").write_text(f"<fcd-export>\n{''.join(steps)}</fcd-export>\n")
    for rows in (1 << 15, 7, 1):
        monkeypatch.setattr(reader, "BATCH_ROWS", rows)
        assert metrics_of_fcd(tmp_path / "half.xml")["fcd.spacing_min_m"] == 20.0


REFUSED = {
    "decimal_commas": b"timestep_time;vehicle_id;vehicle_x;vehicle_speed\n" + b"0,0;a;1000,0;10,0\n" * 9,
    "row_too_long": b"timestep_time;vehicle_id;vehicle_speed\n0;a;1\n0;b;1;7\n",
    "not_utf8": b"timestep_time;vehicle_id;vehicle_speed\n0;a\xff;1\n",
    "cut_parquet": b"PAR1 and no more",
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_is_no_log_is_refused(tmp_path, case):
    (tmp_path / "good.xml").write_text(xml(frame()))
    (tmp_path / "bad.csv").write_bytes(REFUSED[case])
    with pytest.raises(InputError, match=r"bad\.csv"):
        diff(tmp_path / "good.xml", tmp_path / "bad.csv")
    with pytest.raises(InputError, match=r"bad\.csv"):
        metrics_of_fcd(tmp_path / "bad.csv")


def test_a_refused_file_never_kills_the_process(tmp_path):
    """Reading threads that outlive the interpreter did, in most runs."""
    (tmp_path / "good.xml").write_text(xml(frame()))
    (tmp_path / "bad.csv").write_bytes(REFUSED["decimal_commas"])
    command = [sys.executable, "-c", "from trainctl.cli import main; main()", "diff", "good.xml", "bad.csv"]
    running = [subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    for one in running:
        _, told = one.communicate(timeout=120)
        assert (one.returncode, told.count("\n")) == (2, 1), told
        assert "bad.csv" in told


def test_empty_logs_are_empty_in_every_format(tmp_path):
    whole = tmp_path / "whole.xml"
    whole.write_text(xml(frame()))
    empty = {
        "e.xml": b"<fcd-export>\n</fcd-export>\n", "none.csv": b"\n", "header.csv": b"timestep_time;vehicle_id;vehicle_speed\n",
        "steps.csv": b"timestep_time\n0.00\n1.00\n", "steps.xml": b'<fcd-export><timestep time="0"/><timestep/></fcd-export>',
        "ends.csv": b"timestep_time;vehicle_id;vehicle_speed\n0.00;;\n1.00;;\n", "zero.xml": b"",
    }  # fmt: skip
    for name, content in empty.items():
        (tmp_path / name).write_bytes(content)
    pq.write_table(pa.table({}), tmp_path / "none.parquet")
    pq.write_table(pa.table({"timestep_time": [0.0, 1.0]}), tmp_path / "steps.parquet")
    for path in (tmp_path / name for name in (*empty, "none.parquet", "steps.parquet")):
        report = diff(whole, path)
        assert (report.tables[0].missing.count, report.tables[0].rows) == (12, 0), path.name
        assert diff(path, tmp_path / "e.xml").same, path.name
        with pytest.raises(InputError, match="no vehicle in this FCD log"):
            metrics_of_fcd(path)


@pytest.mark.parametrize(("text", "told"), [
    ("00:00:01", "1"), ("00:00:02.50", "2.50"), ("1:00:00:02.5", "86402.5"), ("-00:01:00", "-60"), ("12:30", "12:30"),
    ("00:01:00 00:02:00 -1", "60 120 -1"), (":J_0", ":J_0"), ("25:00:00", "90000"), ("a 00:00:01", "a 1"),
])  # fmt: skip
def test_human_readable_times_are_seconds(text, told):
    assert seconds(text) == told


def test_names_that_look_like_times_are_names(tmp_path):
    (tmp_path / "a.xml").write_text(xml(frame()).replace('id="a"', 'id="00:00:07"'))
    (table,) = sumo_log(tmp_path / "a.xml").batches()
    assert "00:00:07" in table["id"].to_pylist()


# The fast way


def tables(path, **how):
    """All rows of a log, by column, or that it is refused."""
    try:
        batches = [table for table in xml_rows(path, FCD, **how) if table.num_rows]
    except InputError as error:
        assert "\n" not in str(error)
        return "refused"
    if not batches:
        return "empty"
    whole = pa.concat_tables(batches, promote_options="permissive")
    return {name: whole[name].to_pylist() for name in sorted(whole.column_names) if whole[name].null_count < len(whole)}


@pytest.fixture
def counted(monkeypatch):
    """How many pieces were regular, and how many were not."""
    seen = {True: 0, False: 0}
    real = reader.regular_rows

    def regular(*arguments):
        table = real(*arguments)
        seen[table is not None] += 1
        return table

    monkeypatch.setattr(reader, "regular_rows", regular)
    return seen


def alike(seed, path, monkeypatch):
    """Both ways to read a damaged log, in pieces of some size."""
    chosen = random.Random(seed)
    path.write_bytes(fcd_fuzz.damaged(fcd_fuzz.log(chosen), chosen))
    monkeypatch.setattr(reader, "BLOCK", chosen.choice((150, 400, 1500, 1 << 22)))
    monkeypatch.setattr(reader, "CHUNK", chosen.choice((7, 100, 1 << 16)))
    rows = chosen.choice(((), ("vehicle",)))
    fast, strict = tables(path, rows=rows), tables(path, rows=rows, strict=True)
    assert fast == strict, seed
    return strict


def test_the_fast_reader_reads_what_the_strict_parser_does(tmp_path, monkeypatch, counted):
    found = [alike(seed, tmp_path / "a.xml", monkeypatch) for seed in range(250)]
    assert counted[True] > 1000 and counted[False] > 300, counted
    assert sum(table == "refused" for table in found) in range(50, 200)


@pytest.mark.campaign
def test_the_fast_reader_reads_what_the_strict_parser_does_ten_thousand_times(tmp_path, monkeypatch):
    for seed in range(1000, 11_000):
        alike(seed, tmp_path / "a.xml", monkeypatch)


def rows_of(n):
    return "".join(f'        <vehicle id="t{k}" x="{k}.00" speed="{k}.50" pos="0.00" lane="a_0"/>\n' for k in range(n))


@pytest.mark.parametrize(("what", "change"), [
    ("entity", lambda s: s.replace('id="t1"', 'id="t&amp;1"')),
    ("comment", lambda s: s.replace("    </timestep>", "<!-- -->    </timestep>")),
    ("other order", lambda s: s.replace('id="t1" x="1.00"', 'x="1.00" id="t1"')),
    ("attributes missing", lambda s: s.replace(chr(32) + "x=\"1.00\"", "").replace(chr(32) + "speed=\"2.50\"", "")),
    ("attribute swapped for one of its length", lambda s: s.replace(' x="1.00"', ' y="1.00"')),
    ("attribute twice", lambda s: s.replace(' x="', ' id="')),
    ("tab in a value", lambda s: s.replace('"t1"', '"t\t1"')),
    ("line in a value", lambda s: s.replace('"t1"', '"t\n1"')),
    ("less in a value", lambda s: s.replace('"t1"', '"<1"')),
    ("end in a value", lambda s: s.replace('"t1"', '"</1"')),
    ("control character", lambda s: s.replace('"t1"', '"t\x011"')),
    ("no character", lambda s: s.replace('"t1"', '"t\uffff1"')),
    ("element inside", lambda s: s.replace('pos="0.00" lane="a_0"/>', 'pos="0.00" lane="a_0"><param key="k"/></vehicle>', 1)),
    ("other element", lambda s: s.replace("<vehicle", "<bicycle")),
    ("end missing", lambda s: s.replace('lane="a_0"/>', 'lane="a_0">', 1)),
    ("single marks", lambda s: s.replace('"t1"', "'t1'")),
    ("space", lambda s: s.replace(' x="1.00"', ' x = "1.00"')),
    ("time of its own", lambda s: s.replace(' x="', ' time="')),
    ("empty line", lambda s: s.replace("/>\n", "/>\n\n", 1)),
    ("step in a step", lambda s: s.replace("    </timestep>\n", "", 1)),
    ("row outside", lambda s: s.replace("    </timestep>\n", "    </timestep>\n" + rows_of(1), 1)),
])  # fmt: skip
def test_what_is_not_regular_is_left_to_the_strict_parser(tmp_path, counted, what, change):
    steps = [f'    <timestep time="{t}.00">\n{rows_of(3)}    </timestep>\n' for t in range(3)]
    text = f"<fcd-export>\n{''.join(steps)}</fcd-export>\n"
    (tmp_path / "a.xml").write_text(text)
    assert len(tables(tmp_path / "a.xml")["id"]) == 9
    assert counted == {True: 1, False: 1}  # the end of the root is no step
    (tmp_path / "b.xml").write_text(change(text))
    assert change(text) != text
    fast = tables(tmp_path / "b.xml")
    assert counted[True] == 1 and counted[False] in (2, 3), (what, counted)  # 2: it is refused, and the rest not read
    assert fast == tables(tmp_path / "b.xml", strict=True)


def test_a_row_belongs_to_the_step_it_stands_in(tmp_path):
    step = f'<timestep time="1.00">{rows_of(1)}<other><vehicle id="in"/></other></timestep>'
    (tmp_path / "a.xml").write_text(f"<fcd-export>{step}</fcd-export>")
    assert tables(tmp_path / "a.xml")["time"] == ["1.00", "1.00"]
    (tmp_path / "a.xml").write_text(f'<fcd-export>{step}<vehicle id="out"/></fcd-export>')
    with pytest.raises(InputError, match="a vehicle outside any timestep"):
        list(xml_rows(tmp_path / "a.xml", FCD))


def test_what_stands_behind_a_row_is_not_in_it(tmp_path):
    text = '<tripinfos><tripinfo id="a"><emissions CO_abs="1"/></tripinfo><note text="x"/><tripinfo id="b"/></tripinfos>'
    (tmp_path / "a.xml").write_text(text)
    (table,) = sumo_log(tmp_path / "a.xml").batches()
    assert table.to_pylist() == [{"id": "a", "emissions_CO_abs": "1"}, {"id": "b", "emissions_CO_abs": None}]


def test_persons_among_vehicles_other_line_ends_and_empty_steps_are_regular(tmp_path, counted):
    rows = rows_of(2) + '        <person id="p" x="1.00" edge="e"/>\n' + rows_of(1)
    step = f'    <timestep time="0.00"/>\n    <timestep time="1.00">\n{rows}    </timestep>\n    <timestep time="2.00">\n    </timestep>\n'
    for end in ("\n", "\r\n"):
        (tmp_path / "a.xml").write_bytes(f"<fcd-export>\n{step}</fcd-export>\n".replace("\n", end).encode())
        found = tables(tmp_path / "a.xml")
        assert found == tables(tmp_path / "a.xml", strict=True)
        assert found["id"] == ["t0", "t1", "p", "t0"]
        assert found["edge"] == [None, None, "e", None]
        assert tables(tmp_path / "a.xml", rows=("person",))["id"] == ["p"]
    assert counted == {True: 4, False: 4}


def test_a_comment_across_pieces_hides_what_looks_like_steps(tmp_path, monkeypatch):
    step = f'    <timestep time="1.00">\n{rows_of(3)}    </timestep>\n'
    (tmp_path / "a.xml").write_text(f"<fcd-export>\n{step}<!-- {step * 4} --><![CDATA[{step * 4}]]>{step}</fcd-export>\n")
    for size in (100, 300, 450, 500, 1 << 20):
        monkeypatch.setattr(reader, "BLOCK", size)
        assert len(tables(tmp_path / "a.xml")["id"]) == 6


def test_lines_are_told_as_they_stand_in_the_file(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "BLOCK", 300)
    steps = [f'    <timestep time="{t}.00">\n{rows_of(3)}    </timestep>\n' for t in range(20)]
    (tmp_path / "a.xml").write_text(f"<fcd-export>\n{''.join(steps)}<oops\n")
    with pytest.raises(InputError, match=r"line 10[23]"):
        list(xml_rows(tmp_path / "a.xml", FCD))


# Damage


def damage(place, written, chosen):
    """A log of some form with damage, and the whole one."""
    form, kind = chosen.choice(list(FORMS)), chosen.choice(KINDS)
    whole = log_of(written, form, kind)
    if not whole.exists():
        return None
    content = whole.read_bytes()
    begin = chosen.randrange(len(content)) if len(content) > 60_000 else len(content)  # a short log is read sooner
    content = fcd_fuzz.damaged(content[:begin] if chosen.random() < 0.5 else content, chosen)
    target = place / whole.name
    target.write_bytes(gzip.compress(content) if chosen.random() < 0.1 else content)
    return whole, target


LOOSE = parse_tolerances({"absolute": 0.5, "time_s": 2.0, "columns": {"x": {"range": 0.01}}})


def break_nothing(seeds, written, place):
    for seed in seeds:
        pair = damage(place, written, random.Random(seed))
        if pair is not None:
            for one, other in (pair, pair[::-1]):
                with bounded():
                    report = diff(one, other, LOOSE if seed % 2 else None)
                    assert all("\n" not in line for line in report.lines())
            with bounded():
                metrics_of_fcd(pair[1])


def test_no_damage_breaks_a_reader(written, tmp_path):
    break_nothing(range(120), written, tmp_path)


@pytest.mark.campaign
def test_ten_thousand_damaged_logs_break_no_reader(written, tmp_path):
    break_nothing(range(1000, 11_000), written, tmp_path)


def test_vehicles_come_in_whole_steps(tmp_path, monkeypatch):
    (tmp_path / "a.xml").write_text(xml(frame()))
    monkeypatch.setattr(reader, "BATCH_ROWS", 3)
    pieces = [table["time"].to_pylist() for table in vehicles(tmp_path / "a.xml")]
    assert [time for times in pieces for time in times] == [0.0] * 4 + [1.0] * 4 + [2.0] * 4
    assert len(pieces) > 1 and all(len(times) % 4 == 0 for times in pieces)


def test_a_level_below_the_tolerance_is_the_same_in_two_formats(written):
    loose = Tolerances(Tolerance(0.01, stated=True))
    assert diff(log_of(written, "xml", "fcd"), log_of(written, "parquet", "fcd"), loose).same
    assert not diff(log_of(written, "xml", "fcd"), log_of(written, "parquet", "fcd"), EXACT).same
