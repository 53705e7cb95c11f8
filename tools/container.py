"""The container of tools/Containerfile by hand, where no container program is at hand: python tools/container.py [--python PYTHON].

A fresh environment gets the project and the locked versions, and the kernels are compiled once. Then the commands below run in
namespaces of their own, as in ``podman run --read-only --network none --user 1000``: another user, no home, no network but the
loopback, a root of which nothing can be written, and two folders that can: /tmp and the folder of the runs. Needs Linux, root,
``unshare``, ``setpriv``, and a package index for the set-up.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
USER = 1000

#: Runs that compile the kernels, and how long they are [s], as in the Containerfile.
COMPILED = (("three_tracks", 8), ("merging", 60))

#: What a stranger types, in this order; {env} is the folder of the environment. All must end with exit code 0.
COMMANDS = (
    "trainctl --version",
    "trainctl list",
    "trainctl check three_tracks",
    "trainctl run three_tracks --set run.duration_s=60 --quiet",
    "trainctl run merging --set run.duration_s=120 --out runs/merging --quiet",
    "trainctl plot runs/three_tracks+run.duration_s=60",
    "trainctl report runs/merging",
    "trainctl metrics runs/merging",
    "trainctl diff runs/merging runs/merging",
    "trainctl golden make runs/merging golden",
    "trainctl export runs/merging --out sheets",
    "trainctl cite runs/merging",
    "trainctl net build single_track --out nets",
    "trainctl net show single_track",
    "trainctl film runs/merging --seconds 1",
    "trainctl new controller my_law",
    "trainctl check my_law/my_law.toml",
    "trainctl sweep fully_distributed --set run.duration_s=16 --seeds 0..1 --workers 1 --quiet",
)

#: What must fail: a look outside, and writing where nothing may be written.
MUST_FAIL = (
    "{env}/bin/python -c \"import socket; socket.create_connection(('192.0.2.1', 80), 2)\"",
    "touch {env}/lib/written",
    "touch /written",
)

#: Makes the root in namespaces that end with it, then becomes the stranger: its arguments are the new root, the folder of the runs,
#: the environment, the Python it rests on, the script to run.
ENTER = r"""
set -e
root=$1 runs=$2 env=$3 base=$4 script=$5
mount -t tmpfs -o mode=755 tmpfs "$root"
mkdir -p "$root/tmp" "$root/work" "$root/proc" "$root/dev"
mount -t tmpfs -o mode=1777 tmpfs "$root/tmp"
for place in /usr /bin /lib /lib64 /etc/fonts /etc/passwd /etc/ld.so.cache "$base" "$env"; do
    [ -e "$place" ] || continue
    mkdir -p "$root$(dirname "$place")"
    if [ -d "$place" ]; then mkdir -p "$root$place"; else touch "$root$place"; fi
    mount --bind "$place" "$root$place"
    mount -o remount,bind,ro "$root$place"
done
for device in null zero urandom random; do touch "$root/dev/$device"; mount --bind "/dev/$device" "$root/dev/$device"; done
mkdir "$root/dev/shm"; mount -t tmpfs -o mode=1777 tmpfs "$root/dev/shm"
mount -t proc proc "$root/proc"
mount --bind "$runs" "$root/work"
cp "$script" "$root/script"
# The loopback exists where a container has no network, and is up.
"$env/bin/python" -c 'import fcntl, socket, struct
s = socket.socket()
fcntl.ioctl(s, 0x8914, struct.pack("16sh14x", b"lo", 1))'
mount -o remount,ro "$root"
exec chroot "$root" setpriv --reuid=USER --regid=USER --clear-groups /bin/sh /script
""".replace("USER", str(USER))


class Found(NamedTuple):
    """What came of one command."""

    line: str
    code: int
    must_fail: bool
    said: str

    @property
    def wrong(self) -> bool:
        """Whether it ended otherwise than it must."""
        return (self.code != 0) != self.must_fail or (not self.must_fail and "Traceback" in self.said)


def install(place: Path, python: str) -> Path:
    """A fresh environment with the project and the locked versions, as the Containerfile makes it; also its kernels."""
    env = place / "env"
    pip = (env / "bin/python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-cache-dir")
    _do(python, "-m", "venv", env)
    _do(*pip, "--constraint", ROOT / "requirements.lock", ROOT)
    for number, (name, seconds) in enumerate(COMPILED):
        run = (env / "bin/trainctl", "run", name, "--backend", "numeric", "--set", f"run.duration_s={seconds}")
        _do("env", f"NUMBA_CACHE_DIR={env}/kernels", *run, "--out", place / f"first{number}", "--quiet")
    _do("chmod", "-R", "a+rX,a-w", env)
    return env


def _do(*words: object) -> None:
    subprocess.run([str(word) for word in words], check=True)


def as_stranger(place: Path, env: Path, lines: list[str]) -> list[tuple[int, str]]:
    """Exit code of every line and what it said, in the container; the lines share one folder, place/runs."""
    runs, root, script = place / "runs", place / "root", place / "script"
    for folder in (runs, root):
        folder.mkdir(exist_ok=True)
    runs.chmod(0o777)
    place.chmod(0o755)
    head = (
        f"export PATH={env}/bin:/usr/bin:/bin NUMBA_CACHE_DIR=/tmp/kernels MPLCONFIGDIR=/tmp/matplotlib\n"
        f"unset HOME\ncd /work && cp -r {env}/kernels /tmp/kernels && chmod -R u+w /tmp/kernels\n"
    )
    body = "".join(f"( {line} ) >said.{k} 2>&1; echo $? >code.{k}\n" for k, line in enumerate(lines))
    script.write_text(head + body, encoding="utf-8")
    base = _base(env)
    enter = ["unshare", "--mount", "--net", "--pid", "--ipc", "--uts", "--fork", "sh", "-c", ENTER, "enter"]
    subprocess.run([*enter, *map(str, (root, runs, env, base, script))], check=True, env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin"})
    return [
        (int((runs / f"code.{k}").read_text()), (runs / f"said.{k}").read_text(encoding="utf-8", errors="replace"))
        for k in range(len(lines))
    ]


def _base(env: Path) -> str:
    """Where the Python lies that an environment was made from."""
    code = "import sys; print(sys.base_prefix)"
    return subprocess.run([env / "bin/python", "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def tried(place: Path, python: str) -> list[Found]:
    """Install, and type every command as a stranger."""
    env = install(place, python)
    lines = [line.format(env=env) for line in (*COMMANDS, *MUST_FAIL)]
    answers = as_stranger(place, env, lines)
    return [Found(line, code, k >= len(COMMANDS), said) for k, (line, (code, said)) in enumerate(zip(lines, answers, strict=True))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", default=sys.executable, help="the Python the environment is made from")
    with tempfile.TemporaryDirectory(prefix="container-") as folder:
        found = tried(Path(folder), parser.parse_args().python)
        for one in found:
            print(f"{'WRONG' if one.wrong else 'right'}  {one.line}: exit code {one.code}")
            if one.wrong:
                print(one.said)
        subprocess.run(["chmod", "-R", "u+w", folder], check=True)
    sys.exit(any(one.wrong for one in found))
