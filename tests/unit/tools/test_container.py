"""The container by hand: commands of another user, without a home, a network, or a folder of the package to write in."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


def load():
    spec = importlib.util.spec_from_file_location("container", ROOT / "tools/container.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["container"] = module
    spec.loader.exec_module(module)
    return module


container = load()


def in_namespaces() -> bool:
    """Whether this user may make namespaces, and become another one in them."""
    if os.getuid() != 0 or shutil.which("setpriv") is None or shutil.which("unshare") is None:
        return False
    words = ["unshare", "--mount", "--net", "--pid", "--ipc", "--uts", "--fork", "true"]
    return subprocess.run(words, check=False, stderr=subprocess.DEVNULL).returncode == 0


def test_it_does_what_the_containerfile_does():
    """The same commands make the kernels, and the same user and options are named."""
    file = (ROOT / "tools/Containerfile").read_text()
    assert f"--user {container.USER}" in file and "--network none" in file and "--read-only" in file
    compiled = re.findall(r"trainctl run (\w+) --backend numeric --set run.duration_s=(\d+)", file)
    assert compiled == [(name, str(seconds)) for name, seconds in container.COMPILED]


@pytest.mark.skipif(not in_namespaces(), reason="it takes root and namespaces to become another user without a network")
def test_in_it_nothing_can_be_written_or_reached(tmp_path):
    """The root that is made: without a package in it, of this Python."""
    env = tmp_path / "env"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", env], check=True)
    (env / "kernels").mkdir()
    lines = [line.format(env=env) for line in container.MUST_FAIL]
    lines += [
        "id -u",
        "echo home ${HOME-none}",
        "touch here",
        "touch /tmp/there",
        f"{env}/bin/python -c 'import socket; socket.create_server((\"127.0.0.1\", 0))'",
    ]
    answers = container.as_stranger(tmp_path, env, lines)
    failing = len(container.MUST_FAIL)
    assert all(code != 0 for code, _ in answers[:failing]), answers
    assert [code for code, _ in answers[failing:]] == [0] * (len(lines) - failing), answers
    assert answers[failing][1] == f"{container.USER}\n" and answers[failing + 1][1] == "home none\n"


@pytest.mark.campaign
@pytest.mark.skipif(not in_namespaces(), reason="it takes root and namespaces to become another user without a network")
def test_a_stranger_types_every_command(tmp_path):
    """Installs everything anew; some minutes, and a package index is needed."""
    try:
        found = container.tried(tmp_path, sys.executable)
    finally:
        subprocess.run(["chmod", "-R", "u+w", tmp_path], check=True)
    assert not [one for one in found if one.wrong]
