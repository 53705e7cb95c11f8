"""Where it is installed: without SUMO, read-only, for a user without a home, in folders and locales of all kinds."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from trainctl.errors import LEFT_OUT

ROOT = Path(__file__).parents[2]
NOBODY = 65534

#: Types commands one after the other; the last line it prints is a list of exit codes and of what each said on stderr.
SEVERAL = """
import contextlib, io, json, sys
from trainctl.cli import main
found = []
for line in sys.argv[1:]:
    sys.argv, said, code = ["trainctl", *line.split()], io.StringIO(), 0
    with contextlib.redirect_stderr(said):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
    found.append([code, said.getvalue()])
print(json.dumps(found))
"""

#: The same where some packages cannot be found, as if they were not installed.
WITHOUT = f"""
import sys, importlib.util
hidden = {sorted(LEFT_OUT)!r}
class Nowhere:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in hidden:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
real = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in hidden else real(name, package)
sys.meta_path.insert(0, Nowhere())
{SEVERAL}"""


def typed(code: str, lines: Iterable[str], folder: Path, *python: str, **more: Any) -> list[tuple[int, str]]:
    """Exit code and words on stderr of every command."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*(python or (sys.executable,)), "-c", code, *lines],
        cwd=folder,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
        **{"env": environment, **more},
    )
    assert done.returncode == 0, done.stderr
    return [(found[0], found[1]) for found in json.loads(done.stdout.splitlines()[-1])]


def test_without_sumo_logs_are_read_and_numeric_runs_are_made(tmp_path):
    """In order: later commands look at what earlier ones left."""
    fine = (
        "list", "--version", "net list", "check three_tracks", "run fully_distributed --backend numeric --set run.duration_s=40 --out a -q",
        "metrics a", "diff a a", "golden make a gold", "cite a", "export a --out sheets", "new controller my_law",
    )  # fmt: skip
    for line, (code, said) in zip(fine, typed(WITHOUT, fine, tmp_path), strict=True):
        assert code == 0, f"{line}: {said}"
    refused = {
        "run fully_distributed --out b": "SUMO: libsumo is not installed", "replay a": "SUMO: ", "plot a": "figures: matplotlib",
        "report a": "figures: matplotlib", "compare a a": "figures: ", "sweep fully_distributed --seeds 0..0 --backend numeric": "sweeps: ",
        "net build three_tracks --out nets": "netconvert: not found", "check merging": "not found; install eclipse-sumo",
    }  # fmt: skip
    outside = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": "/nowhere"}
    for (line, words), (code, said) in zip(refused.items(), typed(WITHOUT, refused, tmp_path, env=outside), strict=True):
        assert (code, said.count("\n")) == (2, 1) and words in said, f"{line}: {said}"
    assert not (tmp_path / "b").exists() and not (tmp_path / "b.partial").exists()


def test_the_light_list_is_all_that_is_needed_but_what_is_said_to_be_left_out():
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    names = {line: re.split(r"[=<>]", line)[0] for line in needed}
    light = [line for line in (ROOT / "tools/light.txt").read_text().splitlines() if not line.startswith("#")]
    assert light == [line for line in needed if names[line] in light_names(light)]
    assert set(names.values()) - light_names(light) == set(LEFT_OUT) - {"sumo"} | {"eclipse-sumo"}


def light_names(light: list[str]) -> set[str]:
    return {re.split(r"[=<>]", line)[0] for line in light}


def strangers_python() -> str:
    """A Python of this version that a user without rights may run; skips where there is none."""
    if os.getuid() != 0:
        pytest.skip("only root becomes another user")
    for python in (sys.executable, shutil.which(f"python3.{sys.version_info[1]}", path="/usr/bin:/usr/local/bin")):
        if python is not None:
            tried = (
                subprocess.run(
                    [python, "-c", ""], user=NOBODY, group=NOBODY, extra_groups=[], cwd="/", check=False, stderr=subprocess.DEVNULL
                )
                if readable(python)
                else None
            )
            if tried is not None and tried.returncode == 0:
                return python
    pytest.skip("no Python of this version that another user may run")


def readable(path: str) -> bool:
    """Whether everybody may come to a file."""
    real = Path(path).resolve()
    return all(place.stat().st_mode & 0o005 == 0o005 for place in (real, *real.parents, *Path(path).absolute().parents))


def without_network() -> tuple[str, ...]:
    """What takes the network from a command, where this machine lets us."""
    tried = subprocess.run(["unshare", "--net", "true"], check=False, stderr=subprocess.DEVNULL)
    return ("unshare", "--net") if tried.returncode == 0 else ()


def test_another_user_without_a_home_works_with_a_package_that_cannot_be_written(tmp_path_factory):
    """Nothing but one folder is writable, and there is no network: list, check, run, plot, report, diff."""
    python, site = strangers_python(), str(Path(pytest.__file__).parents[1])
    if not readable(site):
        pytest.skip("the packages are in a folder that another user may not read")
    place = Path(subprocess.run(["mktemp", "-d"], capture_output=True, text=True, check=True).stdout.strip())
    try:
        for name in ("trainctl", "sumo_net", "scenarios"):
            shutil.copytree(ROOT / name, place / "package" / name, ignore=shutil.ignore_patterns("__pycache__", "*.nb[ci]"))
        (place / "work").mkdir()
        shutil.chown(place / "work", NOBODY, NOBODY)
        place.chmod(0o755)
        code = f"import sys; sys.path[:0] = [{str(place / 'package')!r}, {site!r}]\n{SEVERAL}"
        environment = {"PATH": "/usr/bin:/bin", "HOME": "/nonexistent", "TMPDIR": str(place / "work")}
        lines = (
            "list", "check fully_distributed", "run fully_distributed --set run.duration_s=20 --out run -q", "plot run", "report run",
            "diff run run",
        )  # fmt: skip
        stranger = (*without_network(), "setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", python)
        for line, (number, said) in zip(lines, typed(code, lines, place / "work", *stranger, env=environment), strict=True):
            assert number == 0, f"{line}: {said}"
        assert not list((place / "package").rglob("*.nb?")) and not list((place / "package").rglob("__pycache__"))
        assert (place / "work/run/report.html").exists() and list((place / "work/run/figures").iterdir())
    finally:
        shutil.rmtree(place)


def test_umlauts_in_paths_do_no_harm_in_a_plain_locale(tmp_path):
    folder = tmp_path / "Züge nach Köln ✓"
    folder.mkdir()
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("LC_", "LANG", "PYTHONUTF8", "PYTHONIOENCODING"))}
    environment |= {"LC_ALL": "C", "PYTHONPATH": str(ROOT)}
    (folder / "Öl.toml").write_text('extends = "fully_distributed"\ntitle = "Züge ✓"\n[run]\nduration_s = 20\n', encoding="utf-8")
    run = "Läufe/größer"
    lines = (
        "check Öl.toml", f"run Öl.toml --out {run}", f"metrics {run}", f"plot {run}", f"report {run}", f"diff {run} {run}",
        f"export {run} --out Bögen",
    )  # fmt: skip
    for line, (code, said) in zip(lines, typed(SEVERAL, lines, folder, env=environment), strict=True):
        assert code == 0, f"{line}: {said}"
    assert (folder / run / "report.html").exists() and (folder / "Bögen/trains.csv").exists()


def test_a_cache_that_numba_is_told_of_and_cannot_write_is_not_taken(tmp_path):
    if os.getuid() == 0:
        place = "/proc/nowhere"
    else:
        (tmp_path / "mine").mkdir(mode=0o500)
        place = str(tmp_path / "mine")
    code = "import trainctl.signals, numba; print(numba.config.CACHE_DIR)"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": place}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert "kernels-" in done.stdout
