"""Every command and snippet of the pages is executed, in the order of the page, as a reader would.

``sh`` blocks line by line, ``python`` blocks in one namespace per page, ``toml`` blocks are written to the file their first line
names (``xml`` blocks too, and ``python`` blocks whose first line is a file's name). Jobs of a CI (``yaml``) are executed but for what
needs a package index. Lines that take too long or need a screen or a network are replaced: REPLACED says by what and why.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import matplotlib
import pytest
import typer
import yaml

import sumo_net
from trainctl.cli import program as cli
from trainctl.diff.tolerance import read_tolerances
from trainctl.scenario.build import open_scenario
from trainctl.studies import sweep
from trainctl.studies.jobs import job_model

ROOT = Path(__file__).parents[2]
PAGES = (
    "README.md",
    "scenarios/README.md",
    "sumo_net/README.md",
    "sumo_net/OSM.md",
    "tools/README.md",
    "tools/gallery/README.md",
    "trainctl/README.md",
    "trainctl/GLOSSARY.md",
    "trainctl/INSTALL.md",
    "trainctl/LIMITS.md",
    "trainctl/PYTHON.md",
    "trainctl/claims/README.md",
    "trainctl/controllers/README.md",
    "trainctl/diff/README.md",
    "trainctl/environment/README.md",
    "trainctl/runs/README.md",
    "trainctl/studies/README.md",
)

#: Line of a page -> (what is executed instead, why). None: not executed.
REPLACED: dict[str, tuple[str | None, str]] = {
    "make run": ("trainctl run --set run.duration_s=24 --out runs/three_tracks", "2400 s take half a minute; making .venv needs a package index"),
    "make test": (None, "this is the test suite"),
    "trainctl run three_tracks": ("trainctl run three_tracks --set run.duration_s=24 --out runs/three_tracks", "the same"),
    "trainctl plot runs/three_tracks": ("trainctl plot runs/three_tracks --out figures", "to see that it writes"),
    "trainctl run fully_distributed --backend numeric": (
        "trainctl run fully_distributed --backend numeric --set run.duration_s=50", "2000 s take too long"),
    "trainctl run three_tracks --set controller.eta=printed --set run.duration_s=600 --out runs/printed": (
        "trainctl run three_tracks --set controller.eta=printed --set run.duration_s=24 --out runs/printed", "600 s take too long"),
    "trainctl run --gui": ("trainctl run --gui --gui-program sumo --set run.duration_s=24", "no screen: the same without a window"),
    "trainctl replay runs/three_tracks --from-s 990": (
        "trainctl replay runs/three_tracks --from-s 9 --gui-program sumo", "no screen; the run above has 24 s"),
    "trainctl run three_tracks --set controller.law=sumo --set controller.block=moving --out runs/moving": (
        "trainctl run three_tracks --set controller.law=sumo --set controller.block=moving --out runs/moving"
        " --set run.duration_s=60", "quicker"),
    "trainctl run three_tracks --set controller.law=sumo --set controller.signals_m=4000 --out runs/fixed": (
        "trainctl run three_tracks --set controller.law=sumo --set controller.signals_m=4000 --out runs/fixed"
        " --set run.duration_s=60", "quicker"),
    "trainctl run fault_tolerant_noise --backend numeric": (
        "trainctl run fault_tolerant_noise --backend numeric --set run.duration_s=10 --out runs/fault_tolerant_noise", "160 s take too long"),
    "trainctl run robust_three_tracks": ("trainctl run robust_three_tracks --set run.duration_s=24 --out runs/robust_three_tracks", "quicker"),
    "trainctl compare capacity": (None, "three minutes; tests/unit/studies/test_capacity.py runs it"),
    "trainctl compare spacing": ("trainctl compare spacing --rows sliding_mode --stops 3 --searched 2", "all laws take ten minutes"),
    "trainctl compare suite": ("trainctl compare suite --rows relative_braking --runs 2", "all laws take minutes"),
    "trainctl run my_law/my_law.toml": ("trainctl run my_law/my_law.toml --set run.duration_s=24", "2400 s take too long"),
    "python -m pytest my_law": (None, "test_new.py runs these tests"),
    "sumo-gui -n nets/three_tracks.net.xml": ("sumo -n nets/three_tracks.net.xml -e 1", "no screen"),
    "trainctl sweep fully_distributed --set topology.loss=0,0.1,0.2 --seeds 0..99": (
        "trainctl sweep fully_distributed --set topology.loss=0,0.1 --set run.duration_s=8 --seeds 0..0 --backend numeric"
        " --workers 1", "300 runs take too long"),
    "trainctl tune robust_constrained --gain h_per_s=0.05..1 --objective settling=1,jerk=100 --set topology.loss=0.3 --seeds 0..19": (
        "trainctl tune robust_constrained --gain h_per_s=0.05..1 --objective settling=1,jerk=100 --set topology.loss=0.3 --seeds 0..1"
        " --set run.duration_s=40 --evaluations 16 --workers 1", "hundreds of candidates"),
    "trainctl sweep monte_carlo": (None, "hundreds of runs; that it can be read is tested in test_sweep.py"),
    'export SUMO_HOME=$(python -c "import sumo; print(sumo.SUMO_HOME)")': (None, "the test knows where it is"),
    "python $SUMO_HOME/tools/osmGet.py --bbox 9.00,47.30,9.45,47.45 --prefix region": (None, "it asks OpenStreetMap"),
    "python3 -m venv .venv && pip install trainctl": (None, "it needs a package index"),
    "source activate": (None, "the test is in the environment"),
    "pip install --no-compile -r light.txt": (None, "it needs a package index; test_installed.py runs what such an install can do"),
    "pip install --no-compile --no-deps trainctl": (None, "the same"),
    "podman build -f tools/Containerfile -t trainctl .": (None, "it needs a registry of images"),
    'podman run --rm --read-only --tmpfs /tmp --network none --user 1000 -v "$PWD:/work:Z" trainctl run three_tracks': (None, "the same"),
    "dask scheduler --scheduler-file s.json &": (None, "a cluster; tests/regression/test_sweep.py starts one"),
    "srun dask worker --scheduler-file s.json --nthreads 1 --nworkers 1 &": (None, "the same"),
    "trainctl sweep monte_carlo --scheduler s.json": (None, "the same"),
}  # fmt: skip

#: Replaced since they take long: by hand they run as they are printed (pytest -m campaign).
LONG = (
    "trainctl run three_tracks", "trainctl run fully_distributed --backend numeric", "trainctl run robust_three_tracks",
    "trainctl run three_tracks --set controller.eta=printed --set run.duration_s=600 --out runs/printed",
    "trainctl run three_tracks --set controller.law=sumo --set controller.block=moving --out runs/moving",
    "trainctl run three_tracks --set controller.law=sumo --set controller.signals_m=4000 --out runs/fixed",
    "trainctl run fault_tolerant_noise --backend numeric",
    "trainctl compare capacity", "trainctl compare spacing", "trainctl compare suite",
    "trainctl sweep fully_distributed --set topology.loss=0,0.1,0.2 --seeds 0..99", "trainctl sweep monte_carlo",
    "trainctl tune robust_constrained --gain h_per_s=0.05..1 --objective settling=1,jerk=100 --set topology.loss=0.3 --seeds 0..19",
)  # fmt: skip

#: Commands that read files of other projects, which are not here; their own tests run them on small files of the same form.
FOREIGN = ("trainctl net import ",)


def blocks(page: str) -> list[tuple[str, str]]:
    """Fenced blocks of a page: (language, text)."""
    return re.findall(r"```(\w+)\n(.*?)```", (ROOT / page).read_text(), re.S)


def lines(text: str) -> list[str]:
    """Commands of a block without comments and the environment's folder."""
    joined = re.sub(r"\\\n\s*", "", text)
    return [found for line in joined.splitlines() if (found := re.sub(r"\s+#.*", "", line).replace(".venv/bin/", "").strip())]


def typed(line: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """Exit code of a command line; ours run in this process, which is quicker."""
    from sumo import SUMO_HOME

    words = shlex.split(line.replace("$SUMO_HOME", SUMO_HOME))
    if words[0] != "trainctl" or words[1] == "sweep":  # Dask starts processes and warns of a port that is taken
        programs = os.environ | {
            "SUMO_HOME": SUMO_HOME,
            "PATH": os.pathsep.join((f"{SUMO_HOME}/bin", str(Path(sys.executable).parent), os.environ["PATH"])),
        }
        return subprocess.run(words, env=programs, check=False, stdout=subprocess.DEVNULL).returncode
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit) as end:
        cli.main()
    return int(end.value.code or 0)


def steps(text: str) -> list[str]:
    """Commands of a CI's job, GitHub's or GitLab's."""
    found = yaml.safe_load(text)
    if "jobs" in found:
        return [step["run"] for job in found["jobs"].values() for step in job["steps"] if "run" in step]
    return [line for job in found.values() for line in job["script"]]


def checked(text: str, folder: Path) -> None:
    """A scenario without mistakes, a line, a sweep, or a piece of another file; written down for the commands that follow."""
    comment, name = re.match(r"# (part of )?([\w/]+\.toml)\n", text), "block.toml"
    if comment and comment[1]:
        assert text.partition("\n")[2].strip() in (folder / comment[2]).read_text()
        return
    if comment:
        name = comment[2]
    (folder / name).write_text(text)
    if name == "tolerances.toml":
        read_tolerances(folder / name)
    elif "tracks" in tomllib.loads(text):
        sumo_net.read_spec(folder / name)
    elif "scenario" in tomllib.loads(text):
        plan = sweep.ready_made(str(folder / name))
        assert plan is not None
        job_model(sweep.jobs(plan)[0])
    else:
        open_scenario(str(folder / name))


@pytest.mark.parametrize("page", PAGES)
def test_every_block_of_the_page_runs(page, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "page"}
    with matplotlib.rc_context({"backend": "agg"}):
        for language, text in blocks(page):
            if language == "sh":
                for line in lines(text):
                    executed = REPLACED.get(line, (line, ""))[0]
                    if executed is not None and not executed.startswith(FOREIGN):
                        assert typed(executed, monkeypatch) == 0, f"{line}: {capfd.readouterr().err}"
            elif language == "python" and text.startswith("def demand("):
                law = (ROOT / "trainctl/templates/my_law.py").read_text()
                assert text.partition("\n")[2].replace("  # spacing error of every link [m]", "").strip() in law
            elif language == "python" and (file := re.match(r"# (\S+\.py)\n", text)):
                (tmp_path / file[1]).write_text(text)
            elif language == "yaml":
                for line in steps(text):
                    if "pip install" not in line:
                        assert typed(line, monkeypatch) == 0, f"{line}: {capfd.readouterr().err}"
            elif language == "python":
                exec(compile(text, page, "exec"), names)
            elif language == "toml":
                checked(text, tmp_path)
            elif language == "xml":
                (tmp_path / re.match(r"<!-- (\S+) -->\n", text)[1]).write_text(text)
            elif language == "text":
                pass  # what a command prints
            else:
                raise AssertionError(f"{page}: a block in {language}: how is it executed?")
    if page == "sumo_net/OSM.md":
        assert '"kind":"couple"' in (tmp_path / "runs/region/events.jsonl").read_text(), "the page ends in a running formation"


def test_replacements_are_of_lines_that_exist():
    there = {line for page in PAGES for language, text in blocks(page) if language == "sh" for line in lines(text)}
    assert set(REPLACED) <= there and set(LONG) <= set(REPLACED)


@pytest.mark.campaign
@pytest.mark.parametrize("line", LONG)
def test_a_command_that_takes_long_runs_as_it_is_printed(line, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert typed(line, monkeypatch) == 0, capfd.readouterr().err


def inline(page: str) -> list[str]:
    """Commands in the text, with something in place of what stands for anything."""
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(), flags=re.S)
    return [
        found.replace("KEY=VALUE", "run.duration_s=60") for found in re.findall(r"`(trainctl [^`]+)`", text) if "..." not in found
    ]


@pytest.mark.parametrize("page", PAGES)
def test_commands_in_the_text_exist_with_these_options(page):
    for line in inline(page):
        command, words = typer.main.get_command(cli.app), shlex.split(line)[1:]
        while hasattr(command, "commands") and words:
            assert words[0] in command.commands, f"{page}: {line}"
            command = command.commands[words.pop(0)]
        if words:
            command.make_context("trainctl", list(words))


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text()):
        if not target.startswith("http"):
            assert ((ROOT / page).parent / target).exists(), f"{page}: {target}"


@pytest.mark.parametrize("page", PAGES)
def test_no_page_has_what_a_merge_left(page):
    assert not re.search(r"^(<{7}|={7}|>{7})", (ROOT / page).read_text(), re.M)


def test_the_readme_fits_two_screens():
    """Of 60 lines each; a picture in it takes a third of one."""
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_the_picture_is_small():
    assert 5_000 < (ROOT / "scenarios/three_tracks.png").stat().st_size < 200_000
