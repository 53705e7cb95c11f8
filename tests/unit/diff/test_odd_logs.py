"""Odd and hostile logs: each is read right, or refused in one line; and what is said of it is a line each, of printable characters."""

from __future__ import annotations

import gzip
import os

import numpy as np
import pandas as pd
import pytest

from trainctl.diff.behind import rows_behind
from trainctl.diff.page import page
from trainctl.diff.results import github, junit
from trainctl.diff.runs import diff, told
from trainctl.diff.tolerance import parse_tolerances
from trainctl.errors import InputError


def two(t):
    return [("a", 100 + 20 * t, 20), ("b", 10 * t, 10)]


def exchanged(t):
    return [("a" if name == "b" else "b", *rest) for name, *rest in two(t)]


def fcd(rows=two, times=range(20), step=1.0):
    lines = ['<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n']
    for t in times:
        row = '        <vehicle id="{}" x="{:.2f}" y="0.00" speed="{:.2f}" pos="{:.2f}" lane="e_0"/>\n'
        rows_ = "".join(row.format(name, x, v, x) for name, x, v in rows(t))
        lines.append(f'    <timestep time="{t * step:.2f}">\n{rows_}    </timestep>\n')
    return "".join([*lines, "</fcd-export>\n"])


BASE = fcd()
SAME: list[str] = []
MISSING = ["trains a, b missing"]
#: A log -> what it says of it, held against the one above; a text: it is refused with it.
CASES = {
    "names exchanged": (fcd(exchanged), ["another order at e from 0 s on: b runs as a did, and a as b"]),
    "names exchanged later": (fcd(lambda t: two(t) if t < 10 else exchanged(t)),
                              ["another order at e from 10 s on: b runs as a did, and a as b"]),
    "one id twice": (fcd(lambda t: [*two(t), ("a", 5, 5)]), ["20 rows doubled of train a from 0 s to 19 s"]),
    "every row twice": (fcd(lambda t: two(t) * 2), ["40 rows doubled of trains a, b from 0 s to 19 s"]),
    "half the step": (fcd(lambda t: two(t / 2), range(40), 0.5), ["40 rows only in B of trains a, b from 0.5 s to 19.5 s"]),
    "begins later": (fcd(times=range(10, 20)), ["trains a, b begin later than in the reference: 20 rows from 0 s to 9 s"]),
    "begins before 0": (fcd(times=range(-10, 20)), ["trains a, b begin earlier than in the reference: 20 rows from -10 s to -1 s"]),
    "one row less": (BASE.replace('<vehicle id="a" x="140', '<other id="a" x="140'), ["1 row dropped of train a at 2 s"]),
    "resumed, and both logs in one": (fcd(times=[*range(15), *range(10, 20)]), "time does not ascend: 10 s after 14 s"),
    "two logs in one": (BASE + BASE, "junk after document element"),
    "backwards": (fcd(times=range(19, -1, -1)), "time does not ascend: 18 s after 19 s"),
    "cut": (BASE[: len(BASE) // 2], "not well-formed XML"),
    "a namespace": (BASE.replace("<fcd-export>", '<fcd-export xmlns="http://sumo.dlr.de/x" xmlns:q="u" q:v="1">'), SAME),
    "a namespace on one row": (BASE.replace('<vehicle id="a"', '<vehicle xmlns:q="u" id="a"', 1), SAME),
    "a prefix": (BASE.replace("fcd-export", "s:fcd-export"), "not a log that can be compared"),
    "UTF-16": (BASE.replace("UTF-8", "UTF-16").encode("utf-16"), SAME),
    "UTF-16 that says UTF-8": (BASE.encode("utf-16"), "encoding specified in XML declaration is incorrect"),
    "an encoding of one byte": (BASE.replace("UTF-8", "windows-1252").replace('"a"', '"\xe4"').encode("cp1252"), ["train a is called ä"]),
    "an encoding that is not there": (BASE.replace("UTF-8", "klingon"), "unknown encoding: klingon"),
    "an encoding of several bytes": (BASE.replace("UTF-8", "shift_jis"), "multi-byte encodings are not supported"),
    "not its encoding": (BASE.replace('"a"', '"\xe4"').encode("latin-1"), "invalid token"),
    "nothing": ("", MISSING), "blanks": ("  \n", MISSING), "zeros": (bytes(1000), "not a log"),
    "an id of a megabyte": (BASE.replace('"a"', '"' + "a" * 1_000_000 + '"', 1),
                            ["train " + "a" * 57 + "... not in the reference", "train a begins later than in the reference: 1 row at 0 s"]),
    "an id of two lines": (BASE.replace('"a"', '"a&#10;b"'), ["train a is called a\\nb"]),
    "an id of marks": (BASE.replace('"a"', '"[/red]&lt;b&gt;"'), ["train a is called [/red]<b>"]),
    "no id": (BASE.replace(' id="a"', ""), ['train a is called ""']),
    "an empty id": (BASE.replace(' id="a"', ' id=""'), ['train a is called ""']),
    "3000 attributes": (BASE.replace("<vehicle ", "<vehicle " + " ".join(f'k{k}="1"' for k in range(3000)) + " ", 1), "more than 1000"),
    "a document type": ('<!DOCTYPE x [<!ENTITY a "b">]>' + BASE, "has a document type or entities"),
    "no number": (BASE.replace('speed="20.00"', 'speed="nan"'), ["speed of train a differs from 0 s on"]),
    "a word": (BASE.replace('speed="20.00"', 'speed="fast"'), ["speed of train a differs from 0 s on"]),
    "a number beyond all": (BASE.replace('x="100.00"', 'x="1e400"', 1), ["x of train a differs from 0 s on"]),
    "numbers whose difference is beyond all": (BASE.replace('x="300.00"', 'x="-1e308"').replace('x="320.00"', 'x="1e308"'),
                                               ["x of train a differs by up to 1e+308 from 10 s on"]),
    "a time that is a word": (BASE.replace('time="3.00"', 'time="three"'), "time = three: must be a time in seconds"),
    "a time beyond all": (BASE.replace('time="19.00"', 'time="1e300"'), "time = 1e300: must be a time in seconds"),
    "no time": (BASE.replace(' time="3.00"', ""), "outside any timestep with a time"),
    "decimal commas": (BASE.replace('.00"', ',00"'), "time = 0,00: must be a time in seconds"),
    "gzipped in two": (gzip.compress(BASE[:99].encode()) + gzip.compress(BASE[99:].encode()), SAME),
    "gzipped and cut": (gzip.compress(BASE.encode())[:-20], "damaged gzip"),
    "gzipped twice": (gzip.compress(gzip.compress(BASE.encode())), "not text"),
}  # fmt: skip


@pytest.fixture
def base(tmp_path):
    (tmp_path / "base.xml").write_text(BASE)
    return tmp_path / "base.xml"


IN_TIME = parse_tolerances({"absolute": 0.5, "time_s": 2.0, "ends": "common", "columns": {"x": {"range": 0.01}}})


def said(a, b):
    for report in (diff(a, b, IN_TIME), diff(a, b)):
        for line in [*report.lines(), *(f.words for f in report.findings)]:
            assert line.isprintable() and len(line) < 400, line
        for f in report.findings:
            rows_behind(f, report.tables, report.tolerances, 20)
        page(report), junit(report), github(report)
    return [f.words for f in report.findings]


@pytest.mark.parametrize("case", CASES)
def test_an_odd_log_is_read_right_or_refused(base, case):
    content, words = CASES[case]
    other = base.with_name("other.xml")
    other.write_bytes(content if isinstance(content, bytes) else content.encode())
    if isinstance(words, str):
        for a, b in ((base, other), (other, base)):
            with pytest.raises(InputError, match=words) as told:
                diff(a, b)
            assert len(told.value.mistakes) == 1
            assert told.value.mistakes[0].startswith(str(other))
        return
    assert said(base, other) == words
    assert bool(said(other, base)) == bool(words)  # and as the reference


def test_what_is_no_number_has_no_distance(base):
    other = base.with_name("other.xml")
    other.write_text(BASE.replace('speed="20.00"', 'speed="nan"'))
    report = diff(base, other)
    (only,) = report.findings
    assert only.first is not None
    assert told(only.first.place) == "20 -> no number"
    assert report.first == "fcd: 0 s, id a: speed 20 -> no number"
    assert "inf" not in "".join(report.lines())


def test_logs_of_two_kinds_are_refused(base):
    other = base.with_name("other.xml")
    other.write_text(BASE.replace("fcd-export", "emission-export"))
    with pytest.raises(InputError, match=r"base\.xml is a log of fcd, .*other\.xml of emission: they cannot be compared"):
        diff(base, other)


def frame():
    rows = [(float(t), name, float(x), 0.0, float(v), float(x), "e_0") for t in range(20) for name, x, v in two(t)]
    names = ["timestep_time", "vehicle_id", "vehicle_x", "vehicle_y", "vehicle_speed", "vehicle_pos", "vehicle_lane"]
    return pd.DataFrame(rows, columns=names)


def spans(rows):
    return rows.assign(timestep_time=pd.to_timedelta(rows.timestep_time, unit="s"))


TABLES = {
    "times as spans": (spans, SAME),
    "times as whole numbers": (lambda rows: rows.astype({"timestep_time": "int64"}), SAME),
    "times as dates": (lambda rows: rows.assign(timestep_time=pd.Timestamp("2026-01-01")), "time = 2026-01-01"),
    "no time": (lambda rows: rows.assign(timestep_time=[np.nan, *rows.timestep_time[1:]]), "time = nothing: must be a time in seconds"),
    "float32": (lambda rows: rows.astype({"vehicle_x": "float32", "vehicle_pos": "float32"}), SAME),
    "both keys as index": (lambda rows: rows.set_index(["timestep_time", "vehicle_id"]), SAME),
    "ids as numbers": (lambda rows: rows.assign(vehicle_id=rows.vehicle_id.map({"a": 1, "b": 2})),
                       ["train a is called 1", "train b is called 2"]),
    "a terminal's colours": (lambda rows: rows.assign(vehicle_id=rows.vehicle_id.map({"a": "\x1b[31ma", "b": "b"})),
                             ["train a is called \\x1b[31ma"]),
    "sorted by train": (lambda rows: rows.sort_values("vehicle_id", kind="stable"), "time does not ascend: 0 s after 19 s"),
    "a column of another name": (lambda rows: rows.rename(columns={"vehicle_speed": "Speed"}), ["column speed is missing"]),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLES)
def test_an_odd_table_is_read_right_or_refused(base, case):
    change, words = TABLES[case]
    other = base.with_name("other.parquet")
    change(frame()).to_parquet(other)
    if isinstance(words, str):
        with pytest.raises(InputError, match=words):
            diff(base, other)
    else:
        assert said(base, other) == words


def test_what_is_no_file_is_refused_before_it_hangs(base):
    os.mkfifo(base.with_name("pipe"))
    with pytest.raises(InputError, match="pipe: not a file"):
        diff(base, base.with_name("pipe"))
    packed = base.with_name("a.parquet.gz")
    frame().to_parquet(base.with_name("a.parquet"))
    packed.write_bytes(gzip.compress(base.with_name("a.parquet").read_bytes()))
    with pytest.raises(InputError, match="a gzipped Parquet file: unpack it"):
        diff(base, packed)
