"""A law of one's own, from `trainctl new controller` to a run, and laws of other packages."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

import trainctl
from trainctl import laws
from trainctl.controllers import emu_finite_time
from trainctl.errors import InputError, LawError
from trainctl.laws import find_law
from trainctl.new import controller
from trainctl.plants.integrate import described, part
from trainctl.runner import keep_law
from trainctl.scenario.build import open_scenario

BIN = Path(sys.executable).parent / "trainctl"


def typed(*arguments, cwd, **environment):
    return subprocess.run(
        [BIN, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, check=False, env=os.environ | environment
    )


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    place = tmp_path_factory.mktemp("mine")
    done = typed("new", "controller", "gentle", cwd=place)
    assert done.returncode == 0, done.stderr
    assert "trainctl run gentle/gentle.toml" in done.stdout
    return place / "gentle"


def test_the_law_is_short(project):
    code = [line for line in (project / "gentle.py").read_text().splitlines() if line.strip() and not line.startswith("#")]
    assert "my_law" not in "".join(path.read_text() for path in project.iterdir())
    assert len(code) < 60


def test_its_tests_pass(project):
    # its run on three_tracks is repeated below, at full length
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-W", "error", str(project)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=project, check=False)
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout


def test_it_runs_on_three_tracks_and_keeps_every_bound(project, tmp_path):
    run = trainctl.run(project / "gentle.toml", backend="numeric", out=tmp_path / "r")
    assert run.metrics["bounds.broken"] == 0
    assert run.metrics["formation.final_error_m"] < 1.0
    assert {e["kind"] for e in run.events} >= {"join", "leave", "topology"}
    # the run folder has all it needs to be run again
    (project / "elsewhere").mkdir()
    again = trainctl.run(run.folder / "scenario.toml", backend="numeric", out=tmp_path / "again", **{"run.duration_s": 40})
    short = run.trains[run.trains["time_s"] < 40.0]["position_m"]
    assert (again.trains["position_m"].to_numpy()[: len(short)] == short.to_numpy()).all()


def test_it_runs_on_sumo(project, tmp_path):
    run = trainctl.run(project / "gentle.toml", out=tmp_path / "r", **{"run.duration_s": 30})
    assert (run.info["status"], run.info["violations"]) == ("complete", 0)


def test_a_separately_installed_package_brings_its_law_by_name(project, tmp_path):
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index",
           "--disable-pip-version-check", "--root-user-action", "ignore", "--target", str(tmp_path / "site"), str(project)]  # fmt: skip
    done = subprocess.run(pip, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (tmp_path / "by_name.toml").write_text('extends = "three_tracks"\n\n[controller]\nlaw = "gentle"\nh_per_s = 0.05\n')
    arguments = ("run", "by_name.toml", "--backend", "numeric", "--set", "run.duration_s=30", "--json")
    done = typed(*arguments, cwd=tmp_path, PYTHONPATH=str(tmp_path / "site"))
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["status"] == "complete"
    assert "no such law" in typed("check", "by_name.toml", cwd=tmp_path).stderr


@pytest.mark.parametrize("name", ["two words", "Upper", "class", "fully_distributed", "1st"])
def test_names_that_cannot_be_used(name, tmp_path):
    with pytest.raises(InputError):
        controller(name, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_nothing_is_overwritten(project):
    before = {path.name: path.read_bytes() for path in project.iterdir() if path.is_file()}
    assert typed("new", "controller", "gentle", cwd=project.parent).returncode == 2
    assert {path.name: path.read_bytes() for path in project.iterdir() if path.is_file()} == before


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("def broken(:\n", "SyntaxError"),
        ("import nothing_of_the_kind\n", "nothing_of_the_kind"),
        ("x = 1\n", "CLOCK = None"),
        ('CLOCK = "sampled"\nParams = None\n', "a sampled law needs violations, constants, message, demand"),
    ],
)
def test_a_file_that_is_no_law_is_one_line(text, says, tmp_path):
    (tmp_path / "odd.py").write_text(text)
    (tmp_path / "odd.toml").write_text('extends = "fully_distributed"\n[controller]\nlaw = "odd.py"\n')
    with pytest.raises(InputError) as caught:
        open_scenario(str(tmp_path / "odd.toml"))
    assert len(caught.value.mistakes) == 1
    assert says in caught.value.mistakes[0]
    with pytest.raises(InputError, match="no such file"):
        find_law("missing.py", tmp_path)


def test_a_law_offered_by_a_package_must_be_a_module(monkeypatch):
    offered = EntryPoint("odd", "types:SimpleNamespace", "trainctl.controllers")
    monkeypatch.setattr(laws.importlib.metadata, "entry_points", lambda **_: [offered])
    with pytest.raises(InputError, match=r"controller.law = odd: is a type: a law must be a module"):
        find_law("odd")


def test_a_law_read_again_is_not_mixed_with_the_one_before(tmp_path):
    """Kernels are compiled of what the names of modules stand for, and cached by the text these were made of."""
    source = Path(emu_finite_time.__file__).read_text()
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "my law.py").write_text(source)
    here, there = (find_law("my law.py", tmp_path / folder) for folder in ("here", "there"))
    assert part(described(here), 0, "demand") is here.demand
    assert part(described(there), 0, "demand") is there.demand
    assert find_law("my law.py", tmp_path / "here") is here
    (tmp_path / "here" / "my law.py").write_text(source + "\n")
    again, before = find_law("my law.py", tmp_path / "here"), described(here)
    (tmp_path / "here" / "my law.py").unlink()
    assert described(again) != before
    (tmp_path / "there" / "my law.py").write_text(source + "\n")
    described.cache_clear()
    find_law("my law.py", tmp_path / "there")
    with pytest.raises(LawError, match=r"my law\.py: was read again since this scenario was opened"):
        described(there)


def test_a_law_that_cannot_be_read_is_not_taken_for_known(tmp_path):
    (tmp_path / "odd.py").write_text('CLOCK = "sampled"\nraise ValueError("not yet")\n')
    for _ in range(2):
        with pytest.raises(InputError, match="ValueError: not yet"):
            find_law("odd.py", tmp_path)


def test_a_run_keeps_the_law_that_ran(tmp_path):
    """Whatever the file says by then."""
    controller("mine", tmp_path)
    prepared = open_scenario(str(tmp_path / "mine.toml"))
    law = tmp_path / "mine.py"
    source = law.read_bytes()
    law.write_text("changed")
    keep_law(prepared, tmp_path)
    assert law.read_bytes() == source
