"""Checkpoints: what a run needs to go on after a kill as if nothing had happened.

SUMO's own saved state is not exact, so it is not used. A checkpoint holds our state; SUMO gets the displacements it was told
before, with new routes and trains that came, from time 0 on, which is exact and takes a fraction of the time of the run. Beside the
run, in ``DIR.partial/checkpoint``:

==============  ======================================================================================================
start.json      what was asked for; with the network, and the trains of a SUMO configuration, as they were read, so that a run
                can begin again from its folder alone
moves.bin       every displacement SUMO was told, n float64 per step; what lies beyond the last checkpoint is dropped
state.npz       the last checkpoint, with routes and entries, replaced atomically; written after everything it counts on is closed
done.json       all steps are done and closed; only joining, measuring and renaming are left
reserve         room on the disk for the words that say that the disk is full
==============  ======================================================================================================

Arrays and JSON only: reading a checkpoint runs no code of its writer.
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
from trainctl.motion import Units
from trainctl.plants.integrate import Extremes
from trainctl.prepare import Prepared
from trainctl.record.folder import FORMAT, installed
from trainctl.signals import Demand, Floats, Ints, Links
from trainctl.topology.ways import Ways
from trainctl.world import Seen, Start, World

if TYPE_CHECKING:
    from trainctl.loop import Simulation

FOLDER = "checkpoint"
START, MOVES, STATE, DONE, RESERVE = "start.json", "moves.bin", "state.npz", "done.json", "reserve"

#: Version of the checkpoint itself.
VERSION = 1

#: Enough for run.json on any file system.
RESERVE_BYTES = 1 << 16

#: Displacements are written in pieces of about this size [bytes].
PIECE = 1 << 20

Arrays = Mapping[str, NDArray[Any]]


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
        told: dict[str, Any] = saved.values["tape"] if saved else {"steps": 0, "trains": 0, "crc": 0, "routes": [], "entries": []}
        self.steps, self.trains, self.crc = told["steps"], told["trains"], told["crc"]
        self.routes, self.entries = list(told["routes"]), list(told["entries"])
        self.buffer = bytearray()
        # unbuffered: what did not fit on the disk must not come back when the file is closed
        self.file = open(self.path, "r+b" if saved else "wb", buffering=0)  # noqa: SIM115  closed by close()
        if saved:
            try:
                self._rewind(8 * self.steps * self.trains)
            except InputError:
                self.file.close()
                raise

    def _rewind(self, size: int) -> None:
        crc, left = 0, size
        while left and (piece := self.file.read(min(PIECE, left))):
            crc, left = zlib.crc32(piece, crc), left - len(piece)
        if left or crc != self.crc:
            raise InputError(f"{self.path}: damaged: not what the checkpoint counts on")
        self.file.truncate(size)
        self.file.seek(size)

    def replay(self, step: float) -> None:
        """Tell the world, which has just started, everything once more."""
        routes, entries = _by_step(self.routes), _by_step(self.entries)
        rows = max(1, PIECE // (8 * max(self.trains, 1)))
        with self.path.open("rb") as file:
            for k in range(self.steps):
                if k % rows == 0:
                    piece = np.frombuffer(file.read(8 * self.trains * min(rows, self.steps - k)), "<f8").reshape(-1, self.trains)
                for train, edges in routes.get(k, ()):
                    self.world.route(train, tuple(edges))
                for train, speed in entries.get(k, ()):
                    self.world.insert(train, speed)
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

    @property
    def ways(self) -> Ways:
        """Ways of all trains as they are now ordered."""
        return self.world.ways

    def linked(self, links: Links, formation: Ints) -> None:
        """Who hears whom from now on."""
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
        return {"steps": self.steps, "trains": self.trains, "crc": self.crc, "routes": self.routes, "entries": self.entries}

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


class Unheard:
    """Where a simulation that starts once more tells what was told before."""

    def event(self, time: float, kind: str, **fields: Any) -> None:
        """Nobody writes it down."""


def write(folder: Path, simulation: Simulation, more: Mapping[str, Any]) -> None:
    """Replace the checkpoint in ``folder`` by the state between two steps.

    Parameters
    ----------
    folder : Path
        ``DIR.partial/checkpoint``.
    simulation : Simulation
        Between two steps.
    more : mapping
        Further plain JSON: ``identity``, what ``Recorder.cut`` and ``Tape.save`` returned.
    """
    values, whole = state(simulation)
    arrays = {name: array for part, value in whole.items() for name, array in leaves(part, value)}
    text = json.dumps({**values, **more}).encode()
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
    at = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(at)
    finally:
        os.close(at)


def read(folder: Path, p: Prepared) -> Saved | None:
    """The checkpoint in ``folder``, None if none was reached.

    Raises
    ------
    InputError
        It was made by other versions or another scenario, or is damaged.
    """
    path = folder / STATE
    if not path.exists():
        return None
    try:
        with path.open("rb") as whole, np.load(whole, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        values = json.loads(bytes(arrays.pop("json")))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
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


def identity(p: Prepared) -> dict[str, Any]:
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


def sources(p: Prepared) -> str:
    """Digest of the law's file and of all code of ours that a run's numbers depend on."""
    here, digest = Path(__file__).parent, hashlib.sha256()
    own = (path for path in here.rglob("*.py") if "record" not in path.parts and not path.name.startswith("cli"))
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


def state(simulation: Simulation) -> tuple[dict[str, Any], dict[str, Any]]:
    """Everything that changes while a run goes on: plain values, and (named) tuples of arrays."""
    s, motion = simulation, simulation.motion
    assert s.relinked is not None
    t, own, links = s.relinked
    seen = s.world.measure()
    values: dict[str, Any] = {
        "k": s.k, "pending": [number for number, _ in s.reroutes.pending], "relinked_s": t, "sent": len(s.exchange.sent),
        "alarms": s.alarms.values(),
    }  # fmt: skip
    arrays: dict[str, Any] = {
        "own": s.own, "track": s.track, "formation": s.formation, "ahead": s.ahead, "links": s.links, "demand": s.demand,
        "relinked_own": own, "relinked_links": links, "constants": s.constants, "alarms": s.alarms.arrays(),
        "sent": tuple(s.exchange.sent), "heard": s.exchange.heard, "ever": s.exchange.ever, "outside": s.outside, "seen": seen,
        "acting": s.supervision.acting,
    }  # fmt: skip
    if s.lookout is not None:
        values |= {"claims": s.lookout.claims}
        arrays |= {"waits_for": s.lookout.waits_for}
    if s.service is not None:
        arrays |= {"service": s.service.state()}
    if isinstance(motion, Units):
        values |= {"counted": motion.counted, "sent_at": motion.air.sent_at}
        arrays |= {
            "estimate": motion.estimate, "extremes": motion.extremes, "work": motion.work, "air": motion.air.heard,
            "loop": motion.loop,
        }  # fmt: skip
    return values, arrays


def restore(simulation: Simulation, tape: Tape, saved: Saved) -> None:
    """Bring a simulation that has just started, and its world, to where the checkpoint was made."""
    s, values, arrays = simulation, saved.values, saved.arrays
    tape.replay(s.p.scenario.run.step_s)
    seen = s.world.measure()
    if not (np.array_equal(seen.position, arrays["seen.0"]) and np.array_equal(seen.edge, arrays["seen.1"])):
        raise SimulatorError("the simulator did not come back to where it was: other versions or another network")

    def taken(kind: Any, part: str) -> Any:
        return kind(*(arrays[f"{part}.{k}"].copy() for k in range(len(kind._fields))))

    s.k, s.own, s.track, s.formation = values["k"], arrays["own"].copy(), arrays["track"].copy(), arrays["formation"].copy()
    s.reroutes.pending = [one for one in s.reroutes.pending if one[0] in values["pending"]]
    s.links, s.ahead, s.demand = taken(Links, "links"), arrays["ahead"].copy(), taken(Demand, "demand")
    relinked = values["relinked_s"], arrays["relinked_own"].copy(), taken(Links, "relinked_links")
    s.relinked = relinked
    scene = s.p.scene(relinked[1], relinked[2], relinked[0])
    s.constants = s.p.law.constants(s.p.params, scene)
    refill("constants", s.constants, arrays)
    s.alarms.restore(values["alarms"], [arrays[f"alarms.{k}"] for k in range(len(s.alarms.arrays()))])
    s.outside, s.supervision.acting = arrays["outside"].copy(), arrays["acting"].copy()
    if s.lookout is not None:
        s.lookout.claims, s.lookout.waits_for = values["claims"], arrays["waits_for"].copy()
    if s.service is not None:
        refill("service", s.service.state(), arrays)
    s.exchange.heard, s.exchange.ever = arrays["heard"].copy(), arrays["ever"].copy()
    s.exchange.sent.extend(arrays[f"sent.{k}"].copy() for k in range(values["sent"]))
    motion = s.motion
    if isinstance(motion, Units):
        motion.estimate = arrays["estimate"].copy()
        motion.relink(scene, s.constants)
        motion.extremes, motion.counted = taken(Extremes, "extremes"), values["counted"]
        motion.air = motion.air._replace(heard=arrays["air"].copy(), sent_at=float(values["sent_at"]))
        refill("work", motion.work, arrays)
        refill("loop", motion.loop, arrays)
    s.world.linked(s.links, s.formation)


def refill(name: str, value: Any, arrays: Arrays) -> None:
    """Overwrite all arrays in a tuple of tuples with the saved ones: laws and plants may keep state in their constants."""
    for place, array in leaves(name, value):
        saved = arrays.get(place)
        if saved is None or saved.shape != array.shape:
            raise InputError(f"checkpoint: {place} is missing or of another shape; run it again with `trainctl run`")
        if array.flags.writeable:
            array[...] = saved
