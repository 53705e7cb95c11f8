"""Nets that netconvert has made, kept from run to run: making one takes as long as loading SUMO.

A net is kept under a digest of all it was made from: the texts, the options, and the program itself. Files are written aside and
renamed, so that nobody reads half of one, and each begins with the digest of the rest: what is damaged is made anew.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

#: So many are kept; beyond, the oldest go.
MOST = 100


def key(program: Path, command: Iterable[str], inputs: Iterable[Path]) -> str:
    """What a net is kept under.

    Parameters
    ----------
    program : Path
        Netconvert; by its place, size and time, since to ask for its version takes as long as to make a net.
    command : iterable of str
        Its options.
    inputs : iterable of Path
        The files it reads.
    """
    about, digest = program.stat(), hashlib.sha256()
    for part in (f"{program} {about.st_size} {about.st_mtime_ns}", *command):
        digest.update(part.encode() + b"\0")
    for path in inputs:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def find(name: str) -> bytes | None:
    """The net that is kept under this name, if there is one and it is whole."""
    try:
        head, _, content = (_folder() / name).read_bytes().partition(b"\n")
    except OSError:
        return None
    return content if head == _sealed(content) else None


def keep(name: str, content: bytes) -> None:
    """Keep a net; not where there is no place for it."""
    with suppress(OSError):
        folder = _folder()
        handle, aside = tempfile.mkstemp(dir=folder)
        try:
            with open(handle, "wb") as file:
                file.write(_sealed(content) + b"\n" + content)
            os.replace(aside, folder / name)
        except OSError:
            os.unlink(aside)
            raise
        by_age = sorted((path.stat().st_mtime_ns, path) for path in folder.iterdir())
        for _, path in by_age[:-MOST]:
            path.unlink(missing_ok=True)


def _sealed(content: bytes) -> bytes:
    return hashlib.sha256(content).hexdigest().encode()


def _folder() -> Path:
    """The user's own cache; ``OSError`` where there is none that nobody else can write into."""
    try:
        place = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "trainctl" / "nets"
    except RuntimeError:
        raise OSError("a user without a home") from None
    place.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = place.stat()
    if about.st_uid != os.getuid() or about.st_mode & 0o022:
        raise OSError("others can write there")
    return place
