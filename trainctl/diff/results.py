"""A comparison for machines: JUnit XML for a CI's list of tests, annotations for GitHub."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree as ET

from trainctl.diff.findings import Finding, short
from trainctl.diff.runs import Report, told
from trainctl.errors import InputError

#: What XML cannot hold.
FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit(report: Report) -> str:
    """The comparison as JUnit XML.

    A test suite for each log with a test case for every column and one for its rows; a suite "run" for what is none of these. A
    case fails with the findings it is part of.
    """
    suites = ET.Element("testsuites", name="trainctl diff")
    cases: dict[str, dict[str, list[Finding]]] = {}
    for t in report.tables:
        cases[t.table] = {name: [] for name in ["rows", *sorted(t.compared)]}
    for f in report.findings:
        for table in f.tables or ["run"]:
            suite = cases.setdefault(table, {})
            names = [*(c for c in f.columns if c in suite or f.cause == "column"), *(["rows"] if f.rows or not f.columns else [])]
            for name in names or ["rows"]:
                suite.setdefault(name, []).append(f)
    total = failed = 0
    for table, tests in cases.items():
        wrong = sum(bool(found) for found in tests.values())
        total, failed = total + len(tests), failed + wrong
        suite_ = ET.SubElement(
            suites, "testsuite", name=table, tests=str(len(tests)), failures=str(wrong), errors="0", skipped="0", time="0"
        )
        for name, found in tests.items():
            case = ET.SubElement(suite_, "testcase", classname=f"trainctl.diff.{table}", name=_clean(name), time="0")
            if found:
                failure = ET.SubElement(case, "failure", type=found[0].cause, message=_clean("; ".join(f.words for f in found)))
                failure.text = _clean("\n".join(line for f in found for line in _about(f)) + f"\nA: {report.a}\nB: {report.b}")
    for key, value in (("tests", total), ("failures", failed), ("errors", 0)):
        suites.set(key, str(value))
    ET.indent(suites)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(suites, encoding="unicode") + "\n"


def _about(f: Finding) -> Iterable[str]:
    yield f"{f.words} [{f.where}]" if f.where else f.words
    for label, d in (("first", f.first), ("largest", f.largest)):
        if d is not None:
            at = "" if d.place.time_s is None else f"{d.place.time_s:.10g} s, "
            yield f"  {label}: {at}{short(d.place.who)}: {short(d.column)} {told(d.place)}"


def _clean(text: str) -> str:
    return FORBIDDEN.sub("?", text)


def github(report: Report) -> list[str]:
    """The findings as GitHub's workflow commands: an error each, a notice if there are none, and one for each note."""
    notes = [f"::notice title=trainctl diff%3A note::{_message(note)}" for note in report.notes]
    if report.same:
        rows = sum(t.rows for t in report.tables)
        return [*notes, f"::notice title=trainctl diff::{_message(f'no difference in {rows} rows: {report.b} matches {report.a}')}"]
    return [*notes, *(
        f"::error file={_property(report.a)},title={_property(f'trainctl diff: {f.cause}')}::{_message(chr(10).join(_about(f)))}"
        for f in report.findings
    )]  # fmt: skip


def _message(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _message(text).replace(":", "%3A").replace(",", "%2C")


def write(path: Path, text: str) -> None:
    """Write a result, or one clear line."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
