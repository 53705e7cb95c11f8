"""A run that is resumed from a damaged folder: refused in words, or it ends with the same bytes as an undamaged one."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pyarrow.parquet as pq
import pytest

from trainctl import runner
from trainctl.cli import program as cli
from trainctl.errors import InputError
from trainctl.scenario.build import open_scenario

ROOT = Path(__file__).parents[3]

#: A law in a file, trains that come, form a convoy and stop; its net goes into the checkpoint.
SCENARIO = """extends = "merging"
[run]
duration_s = 320
record_every_s = 4.0
[controller]
law = "my_law.py"
"""


#: Times of the computer in run.json and in SUMO's logs.
CLOCKS = rb'"wall_time_s": [^,]*,|<performance [^>]*/>|<!--.*?-->|\bduration="\d+"(?=\s*/>)'


class Bases(NamedTuple):
    """Run folders as kills leave them, and what the runs they belong to leave."""

    midway: Path
    midway_whole: Path
    ended: Path
    ended_whole: Path


@pytest.fixture(scope="module")
def bases(tmp_path_factory) -> Bases:
    """``midway``: after three checkpoints; ``ended``: all steps are done, one table is joined, and SUMO's logs lie there."""
    place = tmp_path_factory.mktemp("bases")
    shutil.copy(ROOT / "trainctl/templates/my_law.py", place)
    (place / "s.toml").write_text(SCENARIO)
    p = open_scenario(str(place / "s.toml"))
    midway, midway_whole, ended, ended_whole = (place / name for name in ("midway", "midway_whole", "ended", "ended_whole"))

    def copied(done: int, steps: int) -> None:
        if done >= 280 and not midway.exists():
            shutil.copytree(place / "midway_whole.partial", midway)

    runner.run(p, midway_whole, "numeric", command_line=["x"], progress=copied, checkpoint_every_s=80)
    ends = runner._complete

    def killed(p, partial, info, done, journal):
        journal.join()
        shutil.copytree(partial, ended)
        ends(p, partial, info, done, journal)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_complete", killed)
        runner.run(p, ended_whole, "sumo", command_line=["x"], checkpoint_every_s=80)
    return Bases(midway, midway_whole, ended, ended_whole)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut_a_byte(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def flipped_at_the_end(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-9] ^= 1
    path.write_bytes(content)


def zeros(path: Path) -> None:
    """What a power failure leaves of what was not on the disk yet."""
    path.write_bytes(bytes(path.stat().st_size))


def removed(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def a_folder(path: Path) -> None:
    removed(path)
    path.mkdir()


def elsewhere(path: Path) -> None:
    other = path.parent.parent / "elsewhere"
    os.replace(path, other)
    path.symlink_to(other)


def longer(path: Path) -> None:
    with path.open("ab") as file:
        file.write(b"\n{}")


def exchanged(path: Path) -> None:
    """The one segment in the place of the other."""
    other = path.with_name(path.name.replace("00000", "00001"))
    content = path.read_bytes()
    path.write_bytes(other.read_bytes())
    other.write_bytes(content)


def planted(path: Path) -> None:
    path.mkdir() if path.suffix == ".d" else path.write_text("planted")


def complete(path: Path) -> None:
    """run.json says that all is done."""
    path.write_text(json.dumps({**json.loads(path.read_text()), "status": "complete"}))


def without_a_status(path: Path) -> None:
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "status"}))


def another_seed(path: Path) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), "seed": 99, "backend": "nobody"}))


Damage = Callable[[Path], None]
ANY: tuple[Damage, ...] = (cut, flipped, emptied, removed)
MIDWAY: dict[str, tuple[Damage, ...]] = {
    "run.json": (*ANY, a_folder, complete, without_a_status, another_seed),
    "scenario.toml": ANY,
    "my_law.py": (flipped, removed, elsewhere),
    "events.jsonl": (*ANY, cut_a_byte, zeros, a_folder, elsewhere, longer),
    "segments": (removed,),
    "segments/trains-00000.parquet": (*ANY, cut_a_byte, flipped_at_the_end, zeros, a_folder, exchanged),
    "segments/links-00001.parquet": (cut, removed),
    "segments/trains-abc.parquet": (planted,),
    "segments/trains-77777.parquet": (planted,),
    "segments/trains-00009.d": (planted,),
    "trains.parquet": (planted,),
    "metrics.json": (planted,),
    "checkpoint": (removed,),
    "checkpoint/start.json": (*ANY, zeros),
    "checkpoint/state.npz": (*ANY, cut_a_byte, flipped_at_the_end, zeros, a_folder),
    "checkpoint/moves.bin": (*ANY, cut_a_byte, zeros, a_folder, longer),
    "checkpoint/reserve": (removed, a_folder),
    "checkpoint/my_law.py": (flipped, removed),
    "checkpoint/merging.net.xml": ANY,
}
ENDED: dict[str, tuple[Damage, ...]] = {
    "run.json": (cut, complete, another_seed),
    "events.jsonl": (cut, flipped),
    "trains.parquet": (cut, flipped, removed),
    "links.parquet": (cut, removed),
    "stops.parquet": (flipped, removed),
    "segments/trains-00001.parquet": (flipped, removed),
    "segments": (removed,),
    "sumo/fcd.parquet": (cut, flipped, removed),
    "sumo/tripinfo.xml": (flipped,),
    "checkpoint/done.json": (*ANY, a_folder),
    "checkpoint/start.json": (flipped,),
}
KINDS = [(state, file, d) for state, table in (("midway", MIDWAY), ("ended", ENDED)) for file, ds in table.items() for d in ds]


def content(path: Path) -> bytes:
    """The bytes of a file without the time on the clock; of SUMO's Parquet logs the rows, of its messages, full of times, nothing."""
    if path.parent.name == "sumo" and path.suffix == ".parquet":
        return str(pq.read_table(path).to_pydict()).encode()
    return b"" if path.name == "messages.log" else re.sub(CLOCKS, b"", path.read_bytes(), flags=re.DOTALL)


def files(folder: Path) -> dict[str, bytes]:
    """What stands in a run folder."""
    return {str(path.relative_to(folder)): content(path) for path in folder.rglob("*") if path.is_file()}


def resumed(folder: Path) -> str:
    """The words in which it is refused; "" if it is not."""
    try:
        runner.resume(folder)
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("state", "file", "damage"), KINDS, ids=[f"{s} {f} {d.__name__}" for s, f, d in KINDS])
def test_damage_is_told_in_words_or_does_no_harm(state, file, damage, bases, tmp_path):
    partial = tmp_path / "run.partial"
    shutil.copytree(getattr(bases, state), partial)
    damage(partial / file)
    before = {path: path.read_bytes() for path in (tmp_path / "elsewhere",) if path.exists()}
    words = resumed(tmp_path / "run")
    if words:
        assert "\n" not in words and "run.partial" in words
        assert not (tmp_path / "run").exists()
    else:
        assert files(tmp_path / "run") == files(getattr(bases, f"{state}_whole"))
    assert {path: path.read_bytes() for path in before} == before


def test_there_are_fifty_kinds_and_the_undamaged_folders_end_as_they_should(bases, tmp_path):
    assert len(KINDS) >= 50
    for state in ("midway", "ended"):
        shutil.copytree(getattr(bases, state), tmp_path / f"{state}.partial")
        assert resumed(tmp_path / state) == ""
        assert files(tmp_path / state) == files(getattr(bases, f"{state}_whole"))
    assert {"trains-00000.parquet", "links-00001.parquet"} <= {path.name for path in (bases.midway / "segments").iterdir()}


def test_what_was_recorded_is_on_the_disk_before_the_checkpoint_that_counts_on_it(bases, tmp_path, monkeypatch):
    """Every segment is synced, and the folder with their names, before state.npz is written."""
    synced, real = [], os.fsync

    def noted(number: int) -> None:
        synced.append(os.path.basename(os.readlink(f"/proc/self/fd/{number}")))
        real(number)

    monkeypatch.setattr(os, "fsync", noted)
    shutil.copytree(bases.midway, tmp_path / "run.partial")
    runner.resume(tmp_path / "run")
    first = synced.index("state.npz.new")
    assert {"segments", "events.jsonl", "moves.bin"} <= set(synced[:first])
    assert any(name.startswith("trains-") for name in synced[:first])


def test_the_command_refuses_with_exit_code_2(bases, tmp_path, monkeypatch, capsys):
    shutil.copytree(bases.midway, tmp_path / "run.partial")
    cut(tmp_path / "run.partial/events.jsonl")
    monkeypatch.setattr("sys.argv", ["trainctl", "resume", str(tmp_path / "run")])
    with pytest.raises(SystemExit) as end:
        cli.main()
    told = capsys.readouterr().err
    assert end.value.code == 2 and "events.jsonl: damaged" in told and told.count("\n") == 1
