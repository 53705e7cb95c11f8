"""The run folder as a whole: where it may be written, how it becomes final, and ``run.json``, which says what happened.

A run works in ``DIR.partial`` and is renamed to ``DIR`` when it is complete; an earlier finished run at ``DIR`` stays until
then. A run that failed stays at ``DIR.partial`` with what it had recorded.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from trainctl.errors import InputError

#: Version of every file of a run folder: in run.json and in each Parquet footer.
SCHEMA_VERSION = 1
#: What makes a run.json ours.
FORMAT = "trainctl run"
INFO = "run.json"
#: Characters of a run's name; file systems take 255 bytes.
NAME_AT_MOST = 120


def partial_of(folder: Path) -> Path:
    """``DIR.partial`` of ``DIR``: where a run works until it is complete."""
    return folder.parent / f"{folder.name}.partial"


def ours(folder: Path) -> bool:
    """True if the folder holds a run of ours, of whatever status."""
    try:
        return bool(json.loads((folder / INFO).read_text(encoding="utf-8"))["format"] == FORMAT)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def free(folder: Path) -> bool:
    """True if nothing is lost by writing there: it does not exist, or is an empty directory, or a run killed at its first word."""
    if not os.path.lexists(folder):
        return True
    return folder.is_dir() and not folder.is_symlink() and all(path.name == f"{INFO}.new" for path in folder.iterdir())


def written(folder: Path) -> list[str]:
    """All files below a run folder, as paths within it."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())


def beside(folder: Path) -> list[str]:
    """What stands in the folder of a complete run that the run did not write: figures, pages, notes; files or whole folders."""
    try:
        info = json.loads((folder / INFO).read_text(encoding="utf-8"))
        own = set(info["files"]) if info["status"] == "complete" else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return []
    if own is None:
        return []
    strange = [path for path in written(folder) if path not in own]
    return list(dict.fromkeys(f"{path.partition('/')[0]}/" if "/" in path else path for path in strange))


def run_name(scenario: str | Path, settings: Sequence[str] = ()) -> str:
    """Name of a run by its scenario and the settings ``KEY=VALUE`` that were changed; long ones end in a digest.

    Without commas: SUMO reads them as the ends of file names.
    """
    name = "+".join([Path(scenario).stem, *(re.sub(r"[^\w.=+\[\]-]+", "-", setting) for setting in settings)])
    if len(name) <= NAME_AT_MOST:
        return name
    return f"{name[: NAME_AT_MOST - 9]}~{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def place_for(folder: Path) -> tuple[Path, str]:
    """Where a run for ``folder`` goes so that nothing else is lost by it, and why elsewhere, in words.

    The folder itself, else the first free one of ``DIR-2``, ``DIR-3``, ...
    """
    place, number, why = folder, 1, ""
    while not free(place) and (not ours(place) or beside(place)):
        if not why:
            others = beside(place)
            held_there = f"holds {', '.join(others[:4])}{' and more' if len(others) > 4 else ''} beside its run" if others else ""
            why = f"{place}: {held_there or 'exists and is not a run of trainctl'}"
        number += 1
        place = folder.with_name(f"{folder.name}-{number}")
    return place, f"{why}; this run goes to {place}" if why else ""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Keep other processes from writing a run folder; the hold ends with the process, however that ends."""
    try:
        at = os.open(folder, os.O_RDONLY)
    except FileNotFoundError:
        yield
        return
    try:
        try:
            fcntl.flock(at, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"{folder}: another process is writing there") from None
        yield
    finally:
        os.close(at)


def open_partial(folder: Path | str, force: bool = False) -> Path:
    """Make an empty ``DIR.partial`` and return it, or refuse.

    Parameters
    ----------
    folder : Path
        ``DIR``. A run of ours there (or in ``DIR.partial``) is going to be replaced; anything else, or more, is refused.
    force : bool
        Replace anything, except a directory that holds the current one.

    Raises
    ------
    InputError
        ``DIR`` is not ours to replace, or cannot be written.
    """
    folder = Path(os.path.abspath(folder))
    partial = partial_of(folder)
    for place in (folder, partial):
        if place == Path.cwd() or place in Path.cwd().parents:
            raise InputError(f"{place}: holds the current directory: choose another --out")
        if not (free(place) or ours(place) or force):
            raise InputError(f"{place}: exists and is not a run of trainctl: choose another --out, or --force to replace it")
        if not force and (others := beside(place)):
            raise InputError(
                f"{place}: holds {', '.join(others)} beside its run: choose another --out, or --force to replace all of it"
            )
    try:
        with held(partial):
            remove(partial)
        partial.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{partial}: cannot be written: {error.strerror}") from error
    return partial


def finish(folder: Path | str) -> None:
    """Rename ``DIR.partial`` to ``DIR``; what was at ``DIR`` is removed only after the new run stands there."""
    folder = Path(os.path.abspath(folder))
    old = folder.with_name(folder.name + ".old")
    if os.path.lexists(folder):
        remove(old)
        folder.rename(old)
    partial_of(folder).rename(folder)
    remove(old)


def remove(place: Path) -> None:
    """Remove a file, a link or a directory with all in it; nothing there is fine. Of a run, run.json goes last: it says whose."""
    if place.is_dir() and not place.is_symlink():
        for path in place.iterdir() if (place / INFO).is_file() else ():
            if path.name != INFO:
                remove(path)
        shutil.rmtree(place)
    elif os.path.lexists(place):
        place.unlink()


def about_run(scenario: str, seed: int, command_line: Sequence[str], **more: Any) -> dict[str, Any]:
    """The content of run.json at the start of a run: status ``running``.

    Later changes are made with ``write_info(folder, {**info, "status": "complete", "steps": ..., "wall_time_s": ...})``; a
    failed run carries ``failure = {"reason": ..., "time_s": ...}``. Status: running, complete, failed, interrupted.

    Parameters
    ----------
    scenario : str
        Text of the scenario as resolved (scenario.toml).
    seed : int
        Seed of the run.
    command_line : sequence of str
        What was typed.
    **more
        Further entries.
    """
    return {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "status": "running",
        "scenario_sha256": hashlib.sha256(scenario.encode()).hexdigest(),
        "seed": seed,
        "versions": {
            name: installed(package)
            for name, package in (("trainctl", "trainctl"), ("sumo", "libsumo"), ("numpy", "numpy"), ("numba", "numba"))
        },
        "command_line": list(command_line),
        **more,
    }


def installed(package: str) -> str | None:
    """Version of an installed package, None if it is not there."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def write_info(folder: Path, info: Mapping[str, Any]) -> None:
    """Write run.json so that a reader sees the old one or the new one, never half of it."""
    write_json(folder / INFO, info)


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file atomically; numbers that are not finite become null."""
    new = path.with_name(path.name + ".new")
    new.write_text(json.dumps(plain(content), indent=2) + "\n", encoding="utf-8")
    os.replace(new, path)


def plain(value: Any) -> Any:
    """The same in what JSON knows: numpy arrays as lists, numpy numbers as numbers, NaN and infinities as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(item) for item in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float) and not -float("inf") < value < float("inf"):
        return None
    if isinstance(value, Path):
        return str(value)
    return value
