"""Checkpoints: what a run needs to go on after a kill as if nothing had happened.

SUMO's own saved state is not exact, so it is not used. A checkpoint holds our state; SUMO gets the displacements it was told
before, with new routes and trains that came, from time 0 on, which is exact and takes a fraction of the time of the run. Beside the
run, in ``DIR.partial/checkpoint``:

==============  ======================================================================================================
start.json      what was asked for; with the network, and the trains of a SUMO configuration, as they were read, so that a run
                can begin again from its folder alone; check sums of the files that stand beside it
moves.bin       every displacement SUMO was told, n float64 per step; what lies beyond the last checkpoint is dropped
state.npz       the last checkpoint, with routes and entries, replaced atomically; written after everything it counts on is closed
done.json       all steps are done and closed; only joining, measuring and renaming are left; check sums of SUMO's logs
reserve         room on the disk for the words that say that the disk is full
==============  ======================================================================================================

Arrays and JSON only: reading a checkpoint runs no code of its writer. Everything a run goes on from has a check sum (``sums``): a
damaged folder is refused in words.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trainctl.errors import InputError, SimulatorError
from trainctl.railway.ways import Ways
from trainctl.record.folder import FORMAT, installed
from trainctl.record.recorder import sync
from trainctl.record.sums import PIECE, verify
from trainctl.scenario.model import Model
from trainctl.signals import Floats, Ints, Links, Seen, Start
from trainctl.world import SignalBox, World

if TYPE_CHECKING:
    from trainctl.loop import Loop

FOLDER = "checkpoint"
START, MOVES, STATE, DONE, RESERVE = "start.json", "moves.bin", "state.npz", "done.json", "reserve"

#: Parts of the package that no number of a run depends on.
LOOKS_ON = ("cli", "diff", "figures", "metrics", "record", "report", "runs", "studies")

#: Version of the checkpoint itself.
VERSION = 2

#: Enough for run.json on any file system.
RESERVE_BYTES = 1 << 16

#: What numpy and zipfile say of a damaged archive (RuntimeError: encrypted, or a way of packing that is unknown).
UNREADABLE = (OSError, ValueError, LookupError, TypeError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)

Arrays = Mapping[str, NDArray[Any]]

#: The shape of ``Formed.made_of``: time, own state and links.
MADE_OF: Any = (0.0, np.zeros(0), Links(*[np.zeros(0)] * len(Links._fields)))  # type: ignore[arg-type]


class Saved(NamedTuple):
    """A checkpoint as read."""

    values: dict[str, Any]
    arrays: Arrays


class Tape:
    """A world that remembers what it was told, so that another one can be told the same.

    Parameters
    ----------
    world : World
        SUMO, or the numeric stand-in.
    folder : Path
        Where ``moves.bin`` lies.
    saved : Saved, optional
        What was told before; ``replay`` tells it again.
    """

    def __init__(self, world: World, folder: Path, saved: Saved | None = None) -> None:
        self.world, self.path = world, folder / MOVES
        none: dict[str, Any] = {
            "steps": 0, "trains": 0, "crc": 0, "routes": [], "entries": [], "parked": [], "halted": [], "claims": [],
            "turns": [],
        }  # fmt: skip
        told = saved.values["tape"] if saved else none
        self.steps, self.trains, self.crc = told["steps"], told["trains"], told["crc"]
        self.routes, self.entries, self.parked = list(told["routes"]), list(told["entries"]), list(told["parked"])
        self.halted, self.turns, self.claims = list(told["halted"]), list(told["turns"]), list(told["claims"])
        self.buffer = bytearray()
        size = 8 * self.steps * self.trains
        if saved:
            verify(self.path, [size, self.crc], beginning=True)
        # unbuffered: what did not fit on the disk must not come back when the file is closed
        self.file = open(self.path, "r+b" if saved else "wb", buffering=0)  # noqa: SIM115  closed by close()
        if saved:
            self.file.truncate(size)
            self.file.seek(size)

    def replay(self, step: float) -> None:
        """Tell the world, which has just started, everything once more."""
        told = (self.routes, self.entries, self.parked, self.halted, self.turns)
        routes, entries, parked, halted, turns = (_by_step(one) for one in told)
        claims = dict(self.claims)
        rows = max(1, PIECE // (8 * max(self.trains, 1)))
        with self.path.open("rb") as file:
            for k in range(self.steps):
                if k % rows == 0:
                    piece = np.frombuffer(file.read(8 * self.trains * min(rows, self.steps - k)), "<f8").reshape(-1, self.trains)
                for train, edges in routes.get(k, ()):
                    self.world.route(train, tuple(edges))
                for train, speed in entries.get(k, ()):
                    self.world.insert(train, speed)
                for train, off in parked.get(k, ()):
                    self.world.park(train, off)
                for train, stands in halted.get(k, ()):
                    self.world.halt(train, stands)
                if k in claims:
                    self.world.claim(claims[k])
                for train, (edges, arrival) in turns.get(k, ()):
                    self.world.turn(train, tuple(edges), np.inf if arrival is None else arrival)
                self.world.move(piece[k % rows].copy(), step)

    def start(self, start: Start) -> None:
        """Put the trains on the line."""
        self.trains = len(start.ids)
        self.world.start(start)

    def measure(self) -> Seen:
        """Where every train is now."""
        return self.world.measure()

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route."""
        self.routes.append((self.steps, train, list(edges)))
        self.world.route(train, edges)

    def insert(self, train: int, speed: float) -> None:
        """Put a train on the net."""
        self.entries.append((self.steps, train, speed))
        self.world.insert(train, speed)

    def park(self, train: int, off: bool) -> None:
        """Take a train off its track, or put it back."""
        self.parked.append((self.steps, train, off))
        self.world.park(train, off)

    def turn(self, train: int, edges: tuple[str, ...], arrival: float) -> None:
        """Let a train turn back."""
        self.turns.append((self.steps, train, [list(edges), None if np.isinf(arrival) else arrival]))
        self.world.turn(train, edges, arrival)

    def halt(self, train: int, stands: bool) -> None:
        """Say that a train stands at a stop, or goes on."""
        self.halted.append((self.steps, train, stands))
        self.world.halt(train, stands)

    def claim(self, claims: list[list[int]]) -> None:
        """Say which trains hold which signals."""
        self.claims.append((self.steps, claims))
        self.world.claim(claims)

    @property
    def box(self) -> SignalBox | None:
        """Who sets the signals."""
        return self.world.box

    @property
    def ways(self) -> Ways:
        """Ways of all trains as they are now ordered."""
        return self.world.ways

    def linked(self, links: Links, formation: Ints) -> None:
        """Who receives from whom from now on."""
        self.world.linked(links, formation)

    def move(self, displacement: Floats, step: float) -> None:
        """Let every train move."""
        self.world.move(displacement, step)
        self.buffer += displacement.astype("<f8").tobytes()
        self.steps += 1
        if len(self.buffer) >= PIECE:
            self._flush()

    def _flush(self) -> None:
        piece = bytes(self.buffer)
        self.buffer.clear()
        self.crc = zlib.crc32(piece, self.crc)
        while piece:
            piece = piece[self.file.write(piece) :]

    def save(self) -> dict[str, Any]:
        """Everything told until now, safe on the disk, as a checkpoint names it."""
        self._flush()
        os.fsync(self.file.fileno())
        told = {"routes": self.routes, "entries": self.entries, "parked": self.parked, "halted": self.halted}
        told |= {"claims": self.claims, "turns": self.turns}
        return {"steps": self.steps, "trains": self.trains, "crc": self.crc, **told}

    def close(self) -> None:
        """End the simulation and its logs."""
        self.file.close()
        self.world.close()

    def messages(self) -> list[tuple[float | None, str]]:
        """Warnings the simulator gave."""
        return self.world.messages()

    def collisions(self) -> list[dict[str, Any]]:
        """Collisions the simulator counted."""
        return self.world.collisions()


def _by_step(told: list[Any]) -> dict[int, list[Any]]:
    """What was told before each step: (step, train, what) by step."""
    found: dict[int, list[Any]] = {}
    for k, train, what in told:
        found.setdefault(k, []).append((train, what))
    return found


def write(folder: Path, loop: Loop, more: Mapping[str, Any]) -> None:
    """Replace the checkpoint in ``folder`` by the state between two steps.

    Parameters
    ----------
    folder : Path
        ``DIR.partial/checkpoint``.
    loop : Loop
        Between two steps.
    more : mapping
        Further plain JSON: ``identity``, what ``Recorder.cut`` and ``Tape.save`` returned.
    """
    whole = {"state": loop.state, "made_of": loop.state.formed.made_of, "seen": loop.world.measure()}
    arrays = {name: array for part, value in whole.items() for name, array in leaves(part, value)}
    values = dict(pair for part in ("state", "made_of") for pair in plain(part, whole[part]))
    text = json.dumps({"state": values, **more}).encode()
    packed = io.BytesIO()
    np.savez(packed, allow_pickle=False, **arrays, json=np.frombuffer(text, np.uint8))
    replace(folder / STATE, packed.getvalue())


def replace(path: Path, content: bytes) -> None:
    """Write a file so that a kill, or the power, leaves the old one or the new one."""
    new = path.with_name(path.name + ".new")
    with new.open("wb", buffering=0) as file:
        rest = content
        while rest:
            rest = rest[file.write(rest) :]
        os.fsync(file.fileno())
    os.replace(new, path)
    sync(path.parent)


def read(folder: Path, p: Model) -> Saved | None:
    """The checkpoint in ``folder``, None if none was reached.

    Raises
    ------
    InputError
        It was made by other versions or another scenario, or is damaged.
    """
    path = folder / STATE
    if not os.path.lexists(path):
        return None
    try:
        with path.open("rb") as whole:
            with zipfile.ZipFile(whole) as parts:  # as written: nothing in it is larger than it is in the file
                if any(part.compress_type != zipfile.ZIP_STORED for part in parts.infolist()):
                    raise ValueError("packed")
            whole.seek(0)
            with np.load(whole, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        values = json.loads(bytes(arrays.pop("json")))
        if not isinstance(values, dict):
            raise TypeError("no table")
    except UNREADABLE as error:
        raise InputError(f"{path}: not a checkpoint of trainctl: {error}") from None
    now = identity(p)
    wrong = [
        f"{path}: {key} = {values.get(key)}: cannot be resumed with {now[key]}; run it again with `trainctl run`"
        for key in now
        if values.get(key) != now[key]
    ]
    if wrong:
        raise InputError(wrong)
    return Saved(values, arrays)


def identity(p: Model) -> dict[str, Any]:
    """What a checkpoint and whoever resumes it must agree on, to the last bit of every number."""
    line = hashlib.sha256()
    for part in (p.line.start_m, p.line.length_m, p.line.gradient.breaks, p.line.gradient.slope):
        line.update(np.ascontiguousarray(part, float).tobytes())
    line.update(json.dumps([p.line.edges, p.line.tracks, p.line.crossovers], default=float).encode())
    return {
        "format": f"{FORMAT}, checkpoint",
        "version": VERSION,
        "scenario": p.scenario.hash(),
        "line": line.hexdigest(),
        **{name: installed(package) for name, package in (("trainctl", "trainctl"), ("SUMO", "libsumo"), ("numpy", "numpy"))},
        "numba": installed("numba"),
        "sources": sources(p),
    }


def sources(p: Model) -> str:
    """Digest of the law's file and of all code of ours that a run's numbers depend on."""
    here, digest = Path(__file__).parent.parent, hashlib.sha256()
    own = (path for path in here.rglob("*.py") if path.relative_to(here).parts[0] not in LOOKS_ON)
    law = getattr(p.law, "__file__", None)
    for path in [*sorted(own), *([Path(law)] if law else [])]:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def leaves(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """All arrays in a (named) tuple of (named) tuples, under their places in it."""
    if isinstance(value, np.ndarray):
        yield name, value
    elif isinstance(value, tuple):
        for k, part in enumerate(value):
            yield from leaves(f"{name}.{k}", part)


def plain(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """What of (named) tuples is no array: numbers, words, tables and lists, under their places; lengths of plain tuples."""
    if isinstance(value, tuple):
        if not hasattr(value, "_fields"):
            yield f"{name}.length", len(value)
        for k, part in enumerate(value):
            yield from plain(f"{name}.{k}", part)
    elif value is None or isinstance(value, bool | int | float | str | dict | list):
        yield name, value


def again(name: str, value: Any, arrays: Arrays, values: Mapping[str, Any]) -> Any:
    """``value`` with its leaves as they were saved; what is neither an array nor plain stays."""
    if isinstance(value, np.ndarray):
        if name not in arrays:
            raise InputError(f"checkpoint: {name} is missing; run it again with `trainctl run`")
        return arrays[name].copy()
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*(again(f"{name}.{k}", part, arrays, values) for k, part in enumerate(value)))
    if isinstance(value, tuple):
        length = values[f"{name}.length"]
        known = f"{name}.0" in values  # numbers, or arrays
        parts = [*value, *([0 if known else np.zeros(0)] * (length - len(value)))][:length]
        return tuple(again(f"{name}.{k}", part, arrays, values) for k, part in enumerate(parts))
    return values.get(name, value)


def restore(loop: Loop, tape: Tape, saved: Saved) -> None:
    """Bring a loop that has just started, and its world, to where the checkpoint was made."""
    tape.replay(loop.p.scenario.run.step_s)
    seen = loop.world.measure()
    if not (np.array_equal(seen.position, saved.arrays["seen.0"]) and np.array_equal(seen.edge, saved.arrays["seen.1"])):
        raise SimulatorError("the simulator did not return to its state at the checkpoint: other versions or another network")
    values = saved.values["state"]
    going = again(f"state.{loop.state._fields.index('traffic')}", loop.state.traffic, saved.arrays, values)
    if going.leg.any():
        loop.runs_round(going.leg, [], loop.state.watch)
    # What law and plant made of the last change of topology has shapes and parts of its own: made again, then filled.
    made = again("made_of", MADE_OF, saved.arrays, values)
    scene = loop.p.scene(made[1], made[2], made[0])
    formed = loop.state.formed._replace(links=made[2], made_of=made, constants=loop.p.law.constants(loop.p.params, scene))
    memory = loop.p.law.initial(loop.p.params, scene) if loop.p.remembers else ()
    units = loop.plant.relinked(scene, formed.constants, loop.state.plant)
    loop.state = again("state", loop.state._replace(formed=formed, memory=memory, plant=units), saved.arrays, values)
    assert loop.state.formed.links is not None
    loop.world.linked(loop.state.formed.links, loop.state.formed.formation)
