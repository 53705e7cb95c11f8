"""The command line as a user types it."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tomli_w

from trainctl.cli import console
from trainctl.cli import program as cli
from trainctl.cli.console import number
from trainctl.record.folder import run_name
from trainctl.scenario.build import open_scenario
from trainctl.scenario.check import WORDS, facts, in_words
from trainctl.scenario.reading import read

BIN = Path(sys.executable).parent / "trainctl"


def typed(*arguments, cwd=None):
    return subprocess.run([BIN, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("user")
    done = typed("run", "fully_distributed", "--backend", "numeric", "--set", "run.duration_s=50", "--strict", cwd=place)
    assert done.returncode == 0, done.stderr
    assert "runs/fully_distributed+run.duration_s=50" in done.stdout
    return place / "runs" / "fully_distributed+run.duration_s=50"


def test_help_imports_nothing_heavy():
    code = (
        "import sys, trainctl.cli; heavy = {'numpy', 'numba', 'pandas', 'libsumo', 'matplotlib', 'pydantic', 'rich'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_help_names_every_command():
    text = typed("--help").stdout
    for command in ("run", "list", "check", "metrics", "plot", "net", "schema"):
        assert f" {command} " in text


def test_a_finished_run_can_be_replaced_and_leaves_nothing_partial(folder):
    assert (
        typed(
            "run", "fully_distributed", "--backend", "numeric", "--set", "run.duration_s=50", "-q", cwd=folder.parents[1]
        ).returncode
        == 0
    )
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]
    assert json.loads((folder / "run.json").read_text())["status"] == "complete"


def test_strict_is_exit_1_when_a_bound_broke(tmp_path):
    arguments = ("run", "fully_distributed_ratchet", "--backend", "numeric", "--set", "run.duration_s=1010", "-q")
    assert typed(*arguments, "--out", "a", cwd=tmp_path).returncode == 0
    assert typed(*arguments, "--out", "b", "--strict", cwd=tmp_path).returncode == 1


def test_metrics_in_words_and_for_machines(folder):
    values = json.loads(typed("metrics", folder, "--json").stdout)
    assert values["run.duration_s"] == 50.0
    assert "bounds.spacing_lower_margin_m" in typed("metrics", folder).stdout
    assert "bounds.speed_upper_margin_mps" in json.loads(typed("metrics", "--list", "--json").stdout)


def test_list_check_and_schema_are_json_too():
    assert "three_tracks" in {row["name"] for row in json.loads(typed("list", "--json").stdout)}
    facts = json.loads(typed("check", "three_tracks", "--json").stdout)
    assert facts["smallest_control_period_s"] == pytest.approx(6.265, abs=1e-3)
    assert "train_type" in json.loads(typed("schema").stdout)["properties"]


@pytest.mark.parametrize("name", ["three_tracks", "emu_finite_time", "merging"])
def test_the_table_of_check_has_words_and_units_for_people_and_no_keys(name):
    found = facts(open_scenario(name))
    rows = in_words(found)
    assert len(rows) >= 8 and not [words for words, _ in rows if "_" in words or "=" in words]
    assert dict(rows)["step"] == "1 s"
    assert name != "three_tracks" or dict(rows)["input every train can give"] == "-0.8 .. 0.352941 m/s2"
    assert set(WORDS) & set(found)


def test_figures_are_written(folder):
    done = typed("plot", folder)
    assert done.returncode == 0, done.stderr
    files = [Path(line) for line in done.stdout.split()]
    assert {"fig3_positions.png", "fig6_inputs.png", "train_graph.png"} <= {p.name for p in files}
    assert all(p.stat().st_size > 5000 for p in files)


def test_net_is_built_and_shown(tmp_path):
    assert typed("net", "build", "single_track", "--out", tmp_path).returncode == 0
    assert (tmp_path / "single_track.net.xml").is_file()
    assert typed("net", "show", tmp_path / "single_track.net.xml", "--out", tmp_path / "line.png").returncode == 0
    assert (tmp_path / "line.png").stat().st_size > 5000
    assert "three_tracks" in typed("net", "list").stdout


def test_an_interrupted_run_says_so(tmp_path):
    run = subprocess.Popen(
        [BIN, "run", "three_tracks", "--backend", "numeric", "-q", "--set", "run.duration_s=4000", "--out", "r"],
        cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    begun = tmp_path / "r.partial" / "events.jsonl"
    deadline = time.monotonic() + 60
    while not (begun.exists() and begun.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.02)
    run.send_signal(2)
    assert run.wait(30) == 130
    run.stderr.close()
    info = json.loads((tmp_path / "r.partial" / "run.json").read_text())
    assert info["status"] == "interrupted"
    assert not (tmp_path / "r").exists()


def test_titles_and_ids_are_shown_as_text(tmp_path):
    """Words in brackets are no markup, and nothing in a file steers the terminal."""
    title, name = "[/red] \x1b[32mX\x1b]0;pwn\x07", "[bold]a"
    scenario = read("fully_distributed", {"title": title, "run.duration_s": 20.0})[0]
    scenario["train"][0]["id"] = name
    for link in scenario["link"]:
        link["between"] = [name if train == 1 else train for train in link["between"]]
    (tmp_path / "s.toml").write_text(tomli_w.dumps(scenario))
    for command in (["check"], ["run", "--backend", "numeric"]):
        done = typed(*command, "s.toml", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "[/red] \\x1b[32mX\\x1b]0;pwn\\x07" in done.stdout
        assert "\x1b" not in done.stdout + done.stderr
    assert name in typed("check", "s.toml", cwd=tmp_path).stdout


def test_units_in_brackets_stand_in_the_help():
    assert "[ms]" in typed("replay", "--help").stdout
    module = subprocess.run([sys.executable, "-m", "trainctl", "replay", "--help"], capture_output=True, text=True, check=True)
    assert "[ms]" in module.stdout and "python -m trainctl replay" in module.stdout


def test_nothing_of_the_users_is_replaced(tmp_path):
    run = ("run", "fully_distributed", "--backend", "numeric", "--record-every", "10", "--json")
    settings = ("--set", "run.duration_s=20")

    def where(*more):
        done = typed(*run, *settings, *more, cwd=tmp_path)
        return (tmp_path / json.loads(done.stdout)["folder"] if done.returncode == 0 else None), done.stderr

    first, said = where()
    assert first == tmp_path / "runs" / "fully_distributed+run.duration_s=20+run.record_every_s=10.0" and not said
    assert where() == (first, "")  # nothing else lies there, so it is replaced
    (first / "notes.md").write_text("mine")
    assert typed("plot", first, "--out", first / "figures", cwd=tmp_path).returncode == 0
    second, said = where()
    assert second == first.with_name(f"{first.name}-2")
    assert "holds figures/, notes.md beside its run; this run goes to" in said
    assert (first / "notes.md").read_text() == "mine" and not (second / "figures").exists()
    assert where()[0] == second
    stated, said = where("--out", first)
    assert stated is None and "notes.md" in said and "--force" in said
    assert where("--out", first, "--force")[0] == first and not (first / "notes.md").exists()


def test_runs_are_named_by_their_settings():
    assert run_name("a/my.toml") == "my"
    assert run_name("my", ["controller.law=../x.py", "train.1=[1, 2]"]) == "my+controller.law=..-x.py+train.1=[1-2]"
    assert "," not in run_name("my", ["a=1", "b=2,3"])  # SUMO would read two files
    long = [run_name("my", [f"bounds.speed_upper_mps={k}" * 9]) for k in (1, 2)]
    assert len(set(long)) == 2 and all(len(name) <= 120 for name in long)


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (1234.5678, "1235"), (-1.4e-14, "0"), (0.00123456, "0.001235"), (123456.7, "123500"), (1e9, "1.000e+09"), (9.9996, "10"),
        (2.5e-6, "2.500e-06"), (0.5, "0.5"), (3, "3"), (None, "-"), ("steps", "steps"), (math.inf, "inf"), (-0.25, "-0.25"),
    ],
)  # fmt: skip
def test_numbers_are_short(value, shown):
    assert number(value) == shown


def test_metrics_come_in_groups_of_which_one_may_be_asked_for(folder):
    asked = json.loads(typed("metrics", folder, "--only", "energy", "--json").stdout)
    assert asked and all(key.startswith("energy.") for key in asked)
    shown = typed("metrics", folder, "--only", "bounds").stdout
    assert "bounds.broken" in shown and "energy" not in shown
    wrong = typed("metrics", folder, "--only", "speed")
    assert wrong.returncode == 2 and "there are: run, bounds," in wrong.stderr


def test_scenarios_runs_and_keys_are_completed(folder, monkeypatch):
    monkeypatch.chdir(folder.parents[1])
    assert "robust_constrained" in console.scenario_names("ro") and "three_tracks" not in console.scenario_names("ro")
    assert console.run_folders("runs/fu") == [str(folder.relative_to(folder.parents[1]))]
    assert "topology.loss=" in console.settable("topology.l") and console.settable("x") == []
    Path("my.toml").write_text("")
    assert "my.toml" in console.scenario_names("m")


@pytest.mark.parametrize("command", ["check", "run", "schema", "sweep", "tune", "resume", "compare"])
def test_help_says_where_a_laws_file_is_executed(command, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["trainctl", command, "--help"])
    with pytest.raises(SystemExit):
        cli.main()
    assert "A law that is a file is a program: it is executed." in " ".join(capsys.readouterr().out.split())


def test_a_run_imports_no_more_than_it_needs(tmp_path):
    """What only figures, other files or other laws need takes longer to import than the metrics of a short run."""
    code = (
        "import sys; from trainctl.cli import program\n"
        f"sys.argv = ['trainctl', 'run', '--backend', 'numeric', '--set', 'run.duration_s=8', '--quiet', '--out', {str(tmp_path / 'r')!r}]\n"
        "try: program.main()\n"
        "finally: print(sorted({'pandas', 'pyarrow.compute', 'scipy.linalg', 'scipy.sparse', 'matplotlib', 'dask'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
