"""What a CI does with a comparison: results in its own forms, goldens, accepting, and the pytest helpers."""

from __future__ import annotations

import inspect
import json
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree as ET

import mutations
import numpy as np
import pytest

import trainctl.diff
import trainctl.testing
from trainctl.diff.golden import accept, make_golden
from trainctl.diff.page import page
from trainctl.diff.results import github, junit
from trainctl.diff.runs import diff
from trainctl.diff.tolerance import parse_tolerances
from trainctl.errors import InputError

pytest_plugins = ["pytester"]


@pytest.fixture(scope="module")
def pair(finished, tmp_path_factory):
    """A log, and one with a late train, a missing one, and a column in other units."""
    place, frame = tmp_path_factory.mktemp("pair"), mutations.read(finished("merging").folder)
    other = mutations.one_late_one_missing(frame, 7.0)
    other["speed"] *= 3.6
    return mutations.write(frame, place / "a.xml"), mutations.write(other, place / "b.xml")


@pytest.fixture
def report(pair):
    return diff(*pair)


def test_the_findings_of_the_pair(report):
    told = {f.cause: (f.trains, f.columns) for f in report.findings}
    assert len(report.findings) == len(told) == 4
    assert told["late"] == (["fast.1"], ["angle", "distance", "lane", "pos", "x", "y"])
    assert told["missing"] == (["fast.2"], [])
    assert told["units"] == (["fast.0", "branch.0", "branch.1", "stopping"], ["speed"])
    assert told["values"] == (["fast.1"], ["speed"])  # late and in other units: neither explains it alone


# JUnit


def checked_junit(text):
    """A reader of JUnit XML as strict as those of CIs: names, counts that add up, one outcome per case."""
    root = ET.fromstring(text)
    assert root.tag == "testsuites"
    total = {"tests": 0, "failures": 0}
    for suite in root:
        assert suite.tag == "testsuite"
        assert suite.get("name")
        cases = list(suite)
        assert all(case.tag == "testcase" and case.get("name") and case.get("classname") and len(case) <= 1 for case in cases)
        failed = [case for case in cases if case.find("failure") is not None]
        assert (int(suite.get("tests")), int(suite.get("failures")), suite.get("errors")) == (len(cases), len(failed), "0")
        assert all(case.find("failure").get("message") and case.find("failure").get("type") for case in failed)
        assert len({case.get("name") for case in cases}) == len(cases)
        total["tests"] += len(cases)
        total["failures"] += len(failed)
    assert {key: int(root.get(key)) for key in total} == total
    return root


def test_junit_is_read(report, pair):
    root = checked_junit(junit(report))
    failed = {case.get("name"): case.find("failure").get("message") for case in root.iter("testcase") if len(case)}
    assert "train fast.1 late by 7 s" in failed["x"]
    assert "train fast.2 missing" in failed["rows"]
    assert "slope" not in failed
    clean = checked_junit(junit(diff(pair[0], pair[0])))
    assert clean.get("failures") == "0"
    assert int(clean.get("tests")) >= 9


def test_junit_holds_any_name(tmp_path):
    for name, train in (("a", "x"), ("b", "\u0001<&\">'\ud7ff")):
        text = train.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;").replace("\u0001", "")
        (tmp_path / f"{name}.xml").write_text(
            f'<fcd-export><timestep time="0"><vehicle id="{text}" speed="{name}"/></timestep></fcd-export>', encoding="utf-8"
        )
    report = diff(tmp_path / "a.xml", tmp_path / "b.xml")
    checked_junit(junit(report))
    assert "\n" not in github(report)[0]


# GitHub, JSON, HTML


def test_annotations(report, pair):
    lines = github(report)
    assert len(lines) == len(report.findings)
    assert all(re.fullmatch(r"::error file=[^,\n]*,title=[^,\n:]*::[^\n]*", line) for line in lines)
    assert any("train fast.1 late by 7 s" in line for line in lines)
    (clean,) = github(diff(pair[0], pair[0]))
    assert clean.startswith("::notice title=trainctl diff::no difference in 5143 rows")
    noted = github(diff(pair[0], pair[0], parse_tolerances({"columns": {"sped": 1.0}})))
    assert noted[0] == "::notice title=trainctl diff%3A note::tolerance of sped: no such column was compared"


def test_json_has_the_findings(report):
    found = json.loads(json.dumps(report.as_dict()))
    late = next(f for f in found["findings"] if f["cause"] == "late")
    assert (late["by"], late["trains"], late["tables"]) == (7.0, ["fast.1"], ["fcd"])
    assert late["largest"]["column"] == "distance"
    assert late["values"] > 1000


def test_a_date_in_a_scenario_is_text(finished, tmp_path):
    run = finished("three_tracks", "numeric", **{"run.duration_s": 40}).folder
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    text = (copy / "scenario.toml").read_text()
    (copy / "scenario.toml").write_text(text.replace("duration_s = 40.0", "duration_s = 2020-01-01"))
    found = diff(run, copy).as_dict()
    assert json.loads(json.dumps(found))["settings"] == [{"key": "scenario.run.duration_s", "a": 40.0, "b": "2020-01-01"}]


def test_the_page_stands_alone(report):
    text = page(report)
    assert len(text) < 1_000_000
    assert not re.search(r"https?://(?!www\.w3\.org)", text)
    assert text.count("<svg") >= 2
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    assert len(data) == text.count("<svg")
    assert {"a", "b", "lower", "upper"} <= data[0].keys()


def test_the_page_escapes(tmp_path):
    for name, lane in (("a", "1"), ("b", "&lt;script&gt;alert(1)&lt;/script&gt;")):
        (tmp_path / f"{name}.xml").write_text(
            f'<fcd-export><timestep time="0"><vehicle id="&lt;/script&gt;" speed="1" lane="{lane}"/></timestep></fcd-export>'
        )
    text = page(diff(tmp_path / "a.xml", tmp_path / "b.xml"))
    assert "alert(1)" in text
    assert "<script>alert" not in text


def test_the_page_draws_the_tube_in_time(pair):
    text = page(diff(*pair, parse_tolerances({"absolute": 1.0, "time_s": 3.0})))
    assert "tolerance 1, within 3 s" in text


# The command


def test_exit_codes_and_files(typed, pair, tmp_path, capsys):
    a, b = pair
    code, _ = typed("diff", a, b, "--junit", tmp_path / "out/r.xml", "--html", tmp_path / "out/r.html", "--format", "github")
    assert code == 1
    checked_junit((tmp_path / "out/r.xml").read_text())
    assert (tmp_path / "out/r.html").read_text().startswith("<!doctype html>")
    assert typed("diff", a, a, "--junit", tmp_path / "r.xml")[0] == 0
    code, told = typed("diff", a, a, "--junit", a / "r.xml")
    assert (code, len(told)) == (2, 1)
    code, told = typed("diff", a, a, "--time-tolerance", "-1", "--tolerance", "nan")
    assert (code, len(told)) == (2, 2)


def test_rows_behind_a_finding(pair, monkeypatch, capsys):
    from trainctl.cli import program as cli

    monkeypatch.setattr("sys.argv", ["trainctl", "diff", *map(str, pair), "--rows"])
    with pytest.raises(SystemExit):
        cli.main()
    out = capsys.readouterr().out
    assert re.search(r"fcd: 141 s, id fast\.2: row only in A", out)
    assert re.search(r"fcd: \d+ s, id fast\.1: x [\d.]+ -> [\d.]+", out)


def test_options_that_exclude_each_other_are_refused(typed, pair):
    for options in (("--zero", "--tolerance", "1"), ("--json", "--format", "github"), ("--rows", "--format", "github")):
        code, told = typed("diff", *pair, *options)
        assert (code, len(told)) == (2, 1)
        assert "give one of them" in told[0]


def test_rows_behind_a_finding_in_json(pair, monkeypatch, capsys):
    from trainctl.cli import program as cli

    found = {}
    for options in ((), ("--rows",)):
        monkeypatch.setattr("sys.argv", ["trainctl", "diff", *map(str, pair), "--json", *options])
        with pytest.raises(SystemExit):
            cli.main()
        found[options] = json.loads(capsys.readouterr().out)["findings"]
    assert not any("behind" in f for f in found[()])
    missing = {"table": "fcd", "time_s": 141.0, "who": "id fast.2", "column": "", "a": "row", "b": None}
    assert missing in [row for f in found["--rows",] for row in f["behind"]]


def test_options_say_instead_of_the_file(tmp_path):
    from trainctl.cli.diff import chosen_tolerances

    (tmp_path / "t.toml").write_text("relative = 0.1\n[columns]\nspeed = 0.5\npos = {absolute = 1.0, time_s = 9.0}\n")
    told = chosen_tolerances(tmp_path / "t.toml", 0.25, 2.0, False)
    assert (told.of("fcd", "x").absolute, told.of("fcd", "x").relative, told.of("fcd", "x").time_s) == (0.25, 0.0, 2.0)
    assert (told.of("fcd", "speed").absolute, told.of("fcd", "speed").time_s) == (0.5, 2.0)
    assert (told.of("fcd", "pos").absolute, told.of("fcd", "pos").time_s) == (1.0, 9.0)
    assert told.time.time_s == 2.0


def test_a_tolerance_in_time_lets_a_late_train_pass(typed, finished, tmp_path):
    frame = mutations.read(finished("merging").folder)
    rows = frame[frame.id == "fast.1"]
    late = mutations.later(rows, rows.time.iloc[0], 2.0, False)
    other = mutations.ordered([frame[frame.id != "fast.1"], late], frame.time.max())
    a, b = mutations.write(frame, tmp_path / "a.xml"), mutations.write(other, tmp_path / "b.xml")
    assert typed("diff", a, b)[0] == 1
    assert typed("diff", a, b, "--time-tolerance", "1")[0] == 1
    assert typed("diff", a, b, "--time-tolerance", "2")[0] == 0


def test_the_example_of_the_page_is_what_is_printed(finished, tmp_path, monkeypatch, capsys):
    from trainctl.cli import program as cli

    frame = mutations.read(finished("merging").folder)
    other = mutations.one_late_one_missing(frame, 20.0)
    a, b = mutations.write(frame, tmp_path / "a.xml"), mutations.write(other, tmp_path / "b.xml")
    (tmp_path / "t.toml").write_text("absolute = 1.0\ntime_s = 5.0\n")
    monkeypatch.setattr("sys.argv", ["trainctl", "diff", str(a), str(b), "--tolerances", str(tmp_path / "t.toml")])
    with pytest.raises(SystemExit):
        cli.main()
    page = (Path(trainctl.diff.__file__).parent / "README.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```text\n(.*?)```", page, re.S)
    assert capsys.readouterr().out == example


# Accepting and goldens


def test_a_log_is_accepted(typed, pair, tmp_path, capsys):
    a, b = (Path(shutil.copy(path, tmp_path)) for path in pair)
    assert typed("diff", a, b, "--accept")[0] == 0
    assert a.read_bytes() == b.read_bytes()
    assert typed("diff", a, b, "--zero")[0] == 0
    assert typed("diff", a, b, "--accept")[0] == 0


def test_another_format_is_not_accepted(typed, pair, finished, tmp_path):
    a = Path(shutil.copy(pair[0], tmp_path))
    before = a.read_bytes()
    other = mutations.write(mutations.read(finished("merging").folder).iloc[:100], tmp_path / "b.csv")
    code, told = typed("diff", a, other, "--accept")
    assert (code, "not in the format of" in told[0]) == (2, True)
    assert a.read_bytes() == before


def test_a_golden_of_a_log(typed, pair, tmp_path):
    a, b = pair
    golden = tmp_path / "golden"
    assert typed("golden", "make", a, golden, "--every-s", "10")[0] == 0
    size = sum(p.stat().st_size for p in golden.iterdir())
    assert size < 0.05 * a.stat().st_size, "thinned and compressed"
    assert typed("golden", "check", a, golden)[0] == 0
    assert typed("golden", "check", b, golden)[0] == 1
    assert typed("golden", "update", b, golden)[0] == 0
    assert typed("golden", "check", b, golden)[0] == 0
    assert typed("golden", "check", a, golden)[0] == 1
    # the form stays: thinned as before
    assert json.loads((golden / "golden.json").read_text())["every_s"] == 10.0
    assert diff(golden, b).tables[0].rows < 600


def test_a_golden_of_a_folder_of_logs(pair, finished, tmp_path):
    logs = tmp_path / "logs"
    shutil.copytree(finished("merging").folder / "sumo", logs)
    golden = make_golden(logs, tmp_path / "golden", 30.0)
    report = diff(golden, logs)
    assert report.same, report.lines()
    assert {t.table for t in report.tables} >= {"fcd", "tripinfo", "vehroute", "statistics", "summary"}
    again = make_golden(logs, tmp_path / "again", 30.0)
    names = sorted(p.name for p in golden.iterdir())
    assert all((golden / n).read_bytes() == (again / n).read_bytes() for n in names), "no clock in it"


def test_a_golden_of_a_run_is_accepted_as_it_was_thinned(finished, tmp_path):
    a = finished("three_tracks", "numeric", **{"run.duration_s": 40})
    b = finished("three_tracks", "numeric", **{"run.duration_s": 40, "controller.eta": "printed"})
    golden = make_golden(a, tmp_path / "golden", 10.0)
    moved = diff(golden, b.folder)
    accept(golden, b.folder)
    assert diff(golden, b.folder).same
    assert {t.table: t.rows for t in diff(golden, b.folder).tables}["trains"] == {t.table: t.rows for t in moved.tables}["trains"]


def test_what_is_no_golden_is_not_replaced(pair, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "text").write_text("mine")
    with pytest.raises(InputError, match="thesis: is no golden"):
        make_golden(pair[0], tmp_path / "thesis")
    with pytest.raises(InputError, match="neither a run folder nor logs"):
        make_golden(tmp_path / "thesis", tmp_path / "golden")
    with pytest.raises(InputError, match="every_s = 0"):
        make_golden(pair[0], tmp_path / "golden", 0)


# For test suites


def test_the_example_of_the_module_runs(tmp_path, monkeypatch):
    """The docstring of ``trainctl.testing``, as it stands: its test is collected and called."""
    monkeypatch.chdir(tmp_path)
    text = inspect.cleandoc(trainctl.testing.__doc__).split("::\n", 1)[1]
    code = inspect.cleandoc("\n".join(line for line in text.splitlines() if line.startswith("    ") or not line))
    names: dict[str, object] = {}
    exec(compile(code, "docstring", "exec"), names)
    names["test_three_tracks"](tmp_path)
    assert (tmp_path / "goldens/three_tracks/run.json").exists()


CONFTEST = 'pytest_plugins = ["trainctl.testing_pytest"]'
TEST = """
import shutil
def test_log(golden_run):
    golden_run({path!r}, "log", {{"absolute": 1e-3}}, every_s=10.0)
"""


def test_the_fixture_regenerates_on_demand_only(pytester, pair):
    pytester.makeconftest(CONFTEST)
    pytester.makepyfile(TEST.format(path=str(pair[0])))
    run = lambda *arguments: pytester.runpytest_inprocess("-p", "no:cacheprovider", *arguments)  # noqa: E731
    run().stdout.fnmatch_lines(["*no such golden: write it with pytest --force-regen*"])
    run("--force-regen").assert_outcomes(failed=1)  # written: nobody renews without noticing
    run().assert_outcomes(passed=1)
    run("--force-regen").assert_outcomes(passed=1)  # nothing to renew
    pytester.makepyfile(TEST.format(path=str(pair[1])))
    result = run()
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*does not match*", "*train fast.2 missing*"])
    run("--force-regen").stdout.fnmatch_lines(["*renewed; what moved:*"])
    run().assert_outcomes(passed=1)


def test_an_assertion_names_the_findings(pair):
    with pytest.raises(AssertionError, match=r"train fast\.1 late by 7 s"):
        trainctl.testing.assert_run_matches(pair[1], pair[0])
    assert np.isfinite(trainctl.testing.assert_run_matches(pair[0], pair[0]).tables[0].rows)
