"""What closing the loop costs beside SUMO alone: one command, one run, side by side.

``python tools/bench.py`` prints a table, ``--json`` a list of rows; ``--trains 1000`` keeps to one size. Every case is a process
of its own, since libsumo holds one simulation per process. These processes run at the same time, but only one of them at work: they
take turns every few steps, so that a busy machine, whose speed changes from second to second, slows all of them alike. The whole is
repeated with new processes, and medians are told: of times, and of ratios within a repeat.

=================  ===============================================================================================================
bare               SUMO stepping the trains, each at the constant commanded speed it starts with
idle               the same, with SUMO's drivers as a run has them: they decide nothing but how to pass the end of an edge
rail               SUMO's own ``Rail`` model drives the same trains on the same net
loop               ours: ``fully_distributed`` on point trains, everything recorded
sparse             the loop with rows, and SUMO's FCD, every 10 s only: what large networks may do with
traci              the same loop through TraCI, SUMO in a process of its own
client             TraCI as people write it: three reads and one command per train and step, no law, no records
coupled_units      numeric: ``fully_distributed`` on trains of four units, sub-steps of 10 ms
finite_time        numeric: ``emu_finite_time`` on the same trains
actuated_units     numeric: ``fault_tolerant`` with its observer on trains of four units with actuators
supervised         numeric: the loop under the supervisor
traffic            numeric: trains that come from two lines each, form up where these merge, and are supervised
ignoring           in SUMO: trains on the same lines, with a signal every 2 km, that is not obeyed
obeying            the same trains obey the signals; less ``ignoring``, it is what obeying costs
=================  ===============================================================================================================

The net is fixed: three parallel tracks cut into edges of 5 km, ``bench_three_tracks``, as long as the trains need. The outputs of
SUMO are those of a run (``trainctl.sumo.commanded_files.OPTIONS``) in all cases with SUMO. A figure is the time from the first step
until the logs are closed, per train and step [us]; ``peak_mb`` is the peak resident memory of the process that steps. Time of the
processor is told too (``cpu_``, all threads): where others use the machine it is the truer figure.

``sparse`` is compared with the bare step that writes FCD in every step. CPU times of ``traci`` and ``client`` hold SUMO's start.

``--against CHECKOUT`` compares this checkout with another one: the same cases, those with our loop, driven through
``trainctl.Simulation`` from either. Both take turns every few steps as the cases do; told are medians of the ratios within a pair,
this checkout over the other, with the minimum and the maximum. Closing the logs is left out.

``--instructions`` counts instead of measuring: instructions per train and step, by valgrind, which must be installed. They are no
times (a cache miss is not seen), but the same whatever else the machine does: they tell whether a change made anything cheaper.
Nothing is closed, and SUMO behind TraCI is not counted.

``--logs`` measures how fast logs are read instead (``tools/bench_logs.py``), ``--country`` what a day of a country costs
(``tools/bench_country.py``), ``--kernels`` trains of units on one core and on two (``tools/bench_kernels.py``).
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).resolve().parent.parent
SIZES = (10, 100, 1000, 10_000)
IN_SUMO = ("bare", "idle", "rail", "loop", "sparse", "traci", "client")
ALONE = ("bare", "idle", "rail", "client")  # without our loop
NUMERIC = ("coupled_units", "finite_time", "actuated_units", "supervised", "traffic")
SIGNALLED = ("ignoring", "obeying")
COMING = ("traffic", *SIGNALLED)  # trains of a SUMO configuration
OURS = ("loop", "sparse", *NUMERIC, *SIGNALLED)  # compared between checkouts
EVERY = (*IN_SUMO, *NUMERIC, *SIGNALLED)
#: Compared to a few per cent; through TraCI everything is many times slower, which one repeat tells.
REPEATED = ("bare", "idle", "rail", "loop", "sparse", *SIGNALLED)
PARTS = ("read", "topology", "control", "plant", "write", "step", "record")
EDGE_M = 5000.0
SPEED_MPS = 80.0
SPACING_M = dict.fromkeys((*IN_SUMO, *NUMERIC), 500.0) | {"finite_time": 900.0, "actuated_units": 900.0}

#: Train-steps of one repeat, about; the slower a case, the fewer.
WORK = {
    "traci": 15_000, "client": 10_000, "coupled_units": 30_000, "finite_time": 20_000, "actuated_units": 9_000,
    "supervised": 60_000, "traffic": 60_000, "ignoring": 60_000, "obeying": 60_000,
}  # fmt: skip
IN_SUMO_WORK = 120_000

#: Steps before those that are measured: until then all trains have come.
BEFORE = {"traffic": 160, "ignoring": 800, "obeying": 800}

#: Steps of the two runs whose instructions are compared; in between, the recorder writes at 1000 trains what 66 steps hold.
COUNTED = (10, 76)

#: Turns the cases take within a repeat: at 1000 trains, some 30 ms of each.
SLICES = 20


def steps_of(case: str, trains: int) -> int:
    """Steps of one repeat."""
    most = 2000 if case in IN_SUMO else 100
    minimum = 10 if case in WORK else 100  # closing takes 30 us per train, once
    return min(most, max(minimum, WORK.get(case, IN_SUMO_WORK) // trains))


# Scenarios


def scenario(case: str, trains: int, steps: int, tracks: int = 3) -> tuple[str, str]:
    """TOML of the scenario and of its line: trains take turns on the tracks, a little off their slots."""
    if case in COMING:
        alone = '[traffic]\ncooperate = []\nsignals = "{}"\n'.format("obey" if case == "obeying" else "ignore")
        run = f"[run]\nduration_s = {steps}\nstep_s = 1.0\ncontrol_period_s = 8.0\n"
        return f"{_TRAFFIC}{run}{alone if case in SIGNALLED else ''}", ""
    spacing, rows = SPACING_M[case], -(-trains // tracks)
    slots = case in ("finite_time", "actuated_units")  # these laws want one slot per train, whatever its track
    front = 1000.0 + (trains if slots else rows) * spacing
    line = (
        f'name = "bench_three_tracks"\ntracks = {[2, 1, *range(3, tracks + 1)]}\n'
        f"length_m = {front + 100.0 * (steps + 2) + 5000.0}\nstart_m = 0.0\n"
        f"max_edge_m = {EDGE_M}\nspeed = [[0.0, 100.0]]\n"
    )
    body = [
        'schema_version = 1\ntitle = "Bench"',
        f"[run]\nduration_s = {steps}\nstep_s = 1.0\nsub_step_s = 0.01" + ("\nrecord_every_s = 10.0" if case == "sparse" else ""),
        '[network]\nline = "line.toml"',
        _LAWS.get(case, _LAWS["loop"]),
    ]
    for i in range(trains):
        wiggle = (i * 7919 % 201 - 100) / 100.0  # -1 .. 1, the same everywhere
        position = front - (i if slots else i // tracks) * spacing + 20.0 * wiggle
        speed = SPEED_MPS + (i * 104_729 % 201 - 100) / 100.0
        track = 1 + (i // rows if slots else i % tracks)
        body.append(f'[[train]]\nid = {i + 1}\ntype = "train"\ntrack = {track}\nposition_m = {position}\nspeed_mps = {speed}')
    return "\n".join(body) + "\n", line


#: Of the railway of ``traffic``: trains per piece, length of the branches and of the line they merge into.
PER_PIECE, BRANCH_M, TRUNK_M = 8, 6000.0, 40_000.0


#: ... and distance of its signals, where it has some; trains then come farther apart.
BLOCK_M, APART_S = 2000.0, 220.0


def railway(folder: Path, trains: int, signals: bool = False) -> None:
    """Pieces of railway beside each other: in each two branches merge; trains come far enough apart to enter at once."""
    from sumo_net.build import program

    nodes, edges, came = [], [], []
    for k in range(-(-trains // PER_PIECE)):
        y = 4000.0 * k
        blocks = round(TRUNK_M / BLOCK_M) if signals else 1
        trunk = [f"t{b}." for b in range(blocks)]
        places = {"w": (0.0, y), "s": (0.0, y - 1500.0), "e": (BRANCH_M + TRUNK_M, y)}
        places |= {name: (BRANCH_M + b * TRUNK_M / blocks, y) for b, name in enumerate(trunk)}
        for name, (x, at) in places.items():
            kind = ' type="rail_signal"' if signals and name in trunk else ""
            nodes.append(f'<node id="{name}{k}" x="{x}" y="{at}"{kind}/>')
        ways = [("west", "w", trunk[0]), ("south", "s", trunk[0])]
        ways += [(f"trunk-{a}", a, b) for a, b in zip(trunk, [*trunk[1:], "e"], strict=True)]
        for name, begin, end in ways:
            edges.append(f'<edge id="{name}{k}" from="{begin}{k}" to="{end}{k}" numLanes="1" speed="40" allow="rail"/>')
    apart = APART_S if signals else 40.0
    for i in range(trains):
        k, turn = divmod(i, PER_PIECE)
        branch, depart = ("west", "south")[turn % 2], apart * (turn // 2) + 0.5 * apart * (turn % 2)
        way = " ".join([f"{branch}{k}", *(f"trunk-{name}{k}" for name in trunk)])
        came.append((depart, i, f'<route edges="{way}"/>'))
    body = "".join(f'<vehicle id="{i}" type="emu" depart="{t}" departSpeed="max">{way}</vehicle>' for t, i, way in sorted(came))
    kind = '<vType id="emu" vClass="rail" length="100" maxSpeed="45"/>'
    (folder / "a.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>", encoding="utf-8")
    (folder / "a.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>", encoding="utf-8")
    (folder / "a.rou.xml").write_text(f"<routes>{kind}{body}</routes>", encoding="utf-8")
    (folder / "a.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/></input></configuration>',
        encoding="utf-8",
    )
    netconvert, environment = program("netconvert")
    files = ["-n", "a.nod.xml", "-e", "a.edg.xml", "-o", "a.net.xml", "--no-turnarounds"]
    subprocess.run([netconvert, *files], cwd=folder, env=environment, check=True, capture_output=True)


_DAVIS = "c0_n_per_kg = 1.176e-2\nc1_ns_per_m_kg = 7.7616e-4\nc2_ns2_per_m2_kg = 1.6e-5\n"
_COUPLERS = "coupler_stiffness_n_per_m = 1.6e5\ncoupler_damping_ns_per_m = 600.0\n"
_EMU = f"[train_type.train]\nunits = 4\nunit_length_m = 80.0\nunit_mass_kg = 80000.0\n{_DAVIS}{_COUPLERS}"
_LAWS = {
    "loop": f"""
[controller]
law = "fully_distributed"
[plant]
kind = "point"
[reference]
speed_mps = {SPEED_MPS}
[bounds]
speed_lower_mps = 75.0
speed_upper_mps = 85.0
input_lower_mps2 = -11.0
input_upper_mps2 = 11.0
[topology]
desired = "equal"
spacing_m = {SPACING_M["loop"]}
lower_m = 100.0
upper_m = 1500.0
[train_type.train]
unit_mass_kg = 320000.0
{_DAVIS}""",
    "coupled_units": f"""
[controller]
law = "fully_distributed"
eta = "own_speed"
[plant]
kind = "coupled_units"
[reference]
speed_mps = {SPEED_MPS}
[bounds]
speed_lower_mps = 75.0
speed_upper_mps = 85.0
[topology]
desired = "equal"
spacing_m = {SPACING_M["loop"]}
lower_m = 330.0
upper_m = 1500.0
{_EMU}""",
    "finite_time": f"""
[controller]
law = "emu_finite_time"
emergency_distance_m = 200.0
emergency_zone_m = 100.0
[plant]
kind = "coupled_units"
[reference]
speed_mps = {SPEED_MPS}
[topology]
desired = "slots"
spacing_m = {SPACING_M["finite_time"]}
lower_m = 520.0
{_EMU}""",
    "actuated_units": f"""
[controller]
law = "fault_tolerant"
leader_error_lower_m = -500.0
leader_error_upper_m = 500.0
[observer]
kind = "asymptotic"
fault_constant_n_per_s = 2e5
fault_sinusoids = [[1.0, 2e5]]
[plant]
kind = "actuated_units"
[reference]
speed_mps = {SPEED_MPS}
[topology]
desired = "slots"
spacing_m = {SPACING_M["actuated_units"]}
lower_m = 400.0
upper_m = 1400.0
[train_type.train]
units = 4
unit_length_m = 26.0
unit_mass_kg = 80000.0
actuator_rate_per_s = 50.0
{_DAVIS}{_COUPLERS}""",
}


_LAWS["supervised"] = _LAWS["loop"] + '[supervisor]\nmode = "on"\n'
_TRAFFIC = f"""schema_version = 1
title = "Bench"
[network]
sumocfg = "a.sumocfg"
[controller]
law = "fully_distributed"
join = "ratchet"
[plant]
kind = "point"
[reference]
speed_mps = 36.0
[bounds]
speed_lower_mps = 30.0
speed_upper_mps = 42.0
input_lower_mps2 = -1.0
input_upper_mps2 = 1.0
[topology]
spacing_m = 500.0
lower_m = 250.0
upper_m = 1600.0
[train_type.emu]
unit_length_m = 100.0
unit_mass_kg = 200000.0
{_DAVIS}"""


# One case, in a process of its own


class Clock:
    """Exclusive time of each part: what runs inside another part is not that part's."""

    def __init__(self) -> None:
        self.spent = dict.fromkeys(PARTS, 0.0)
        self.open: list[str] = []
        self.since = 0.0

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time inside as that of ``name``."""
        self._switch()
        self.open.append(name)
        try:
            yield
        finally:
            self._switch()
            self.open.pop()

    def _switch(self) -> None:
        now = time.perf_counter()
        if self.open:
            self.spent[self.open[-1]] += now - self.since
        self.since = now

    def around(self, owner: Any, name: str, part: str) -> None:
        """Let a function of a module or an object count as ``part``."""
        function = getattr(owner, name)

        def timed(*arguments: Any, **more: Any) -> Any:
            with self.part(part):
                return function(*arguments, **more)

        setattr(owner, name, timed)


def of_this(checkout: Path) -> None:
    """Stop if the code is not that of the checkout."""
    import trainctl

    found = Path(trainctl.__file__).resolve().parent.parent
    if found != checkout:
        raise SystemExit(f"trainctl comes from {found}, not from {checkout}")


def peak_mb() -> float:
    """Peak resident memory of this process [MB]."""
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return next(int(row.split()[1]) / 1024.0 for row in text.splitlines() if row.startswith("VmHWM"))


def inputs(folder: Path, case: str, trains: int, steps: int) -> None:
    """Write what SUMO alone needs into ``folder``: net, trains and configuration, as a run does."""
    import sumo_net
    from trainctl.loop import Loop
    from trainctl.numeric import Numeric
    from trainctl.scenario.build import open_scenario
    from trainctl.stages.record import Journal
    from trainctl.sumo.commanded_files import LOGS, write_configuration, write_routes

    model = open_scenario(str(folder / "scenario.toml"))
    sumo_net.build(model.spec, folder)

    class Writer(Numeric):
        def start(self, start: Any) -> None:
            write_routes(start, folder / "trains.rou.xml")

    Loop(model, Writer(model.line), Journal(folder, model))
    configuration = write_configuration(folder, f"{model.spec.name}.net.xml", "trains.rou.xml", 1.0, steps + 1.0)
    logs = [part for key, name in LOGS.items() for part in (f"--{key}", str(folder / name))]
    (folder / "command.json").write_text(json.dumps(["sumo", "-c", str(configuration), *logs]), encoding="utf-8")
    if case == "rail":
        routes = folder / "trains.rou.xml"
        text = routes.read_text(encoding="utf-8")
        own = text[text.index('minGap="0"') : text.index("/>", text.index("<vType"))]
        routes.write_text(text.replace(own, 'minGap="0" sigma="0" carFollowModel="Rail" trainType="ICE3"'), encoding="utf-8")


class Case(NamedTuple):
    """What is measured."""

    trains: int
    step: Callable[[], Any]
    close: Callable[[], Any]
    clock: Clock


def alone(folder: Path, case: str) -> Case:
    """SUMO without a loop: bare, idle or rail."""
    import libsumo
    import numpy as np

    from trainctl.sumo.idling import IDLE_S, silent
    from trainctl.sumo.session import PLANNED_M

    libsumo.start(json.loads((folder / "command.json").read_text(encoding="utf-8")))
    libsumo.simulationStep()
    vehicle, names, clock = libsumo.vehicle, libsumo.vehicle.getIDList(), Clock()
    place, speed = (np.array([get(name) for name in names]) for get in (vehicle.getLanePosition, vehicle.getSpeed))
    if case != "rail":
        for name in names:
            vehicle.setSpeedMode(name, 32)
            vehicle.setLaneChangeMode(name, 0)
            vehicle.setSpeed(name, vehicle.getSpeed(name))
    clock.around(libsumo, "close", "step")
    step = libsumo.simulationStep  # without the clock: what is compared with must not pay for it

    def timed() -> None:
        with clock.part("step"):
            step()

    def idle() -> None:
        place[:] += speed
        with clock.part("step"):
            for i in np.flatnonzero(place > EDGE_M - PLANNED_M).tolist():
                vehicle.setActionStepLength(names[i], 0.0)
            step()
        place[place > EDGE_M] -= EDGE_M

    if case == "idle":
        with silent():
            libsumo.vehicletype.setActionStepLength(vehicle.getTypeID(names[0]), IDLE_S)
    return Case(len(names), idle if case == "idle" else timed, libsumo.close, clock)


def client(folder: Path, case: str) -> Case:
    """A loop around SUMO through TraCI that asks for and commands one train after the other."""
    api = through_traci()
    api.start(json.loads((folder / "command.json").read_text(encoding="utf-8")))
    api.simulationStep()
    vehicle, names, clock = api.vehicle, api.vehicle.getIDList(), Clock()
    for name in names:
        vehicle.setSpeedMode(name, 32)

    def step() -> None:
        with clock.part("read"):
            seen = {name: (vehicle.getRoadID(name), vehicle.getLanePosition(name), vehicle.getSpeed(name)) for name in names}
        with clock.part("write"):
            for name, (_, _, speed) in seen.items():
                vehicle.setSpeed(name, speed)
        with clock.part("step"):
            api.simulationStep()

    clock.around(api, "close", "step")
    return Case(len(names), step, api.close, clock)


def unrehearsed(case: str) -> None:
    """Leave out the check of the start: it takes 10 ms per train, and is not what is measured."""
    if case == "finite_time":
        from trainctl.controllers import emu_finite_time

        emu_finite_time.REHEARSAL_STEPS = 1


def closed(folder: Path, case: str) -> Case:
    """Our loop: in SUMO, through TraCI, or numeric."""
    if case == "traci":
        sys.modules["libsumo"] = through_traci()
    from trainctl.loop import Loop
    from trainctl.runner import open_world
    from trainctl.scenario.build import open_scenario
    from trainctl.stages.record import Journal

    unrehearsed(case)
    model = open_scenario(str(folder / "scenario.toml"))
    clock = Clock()
    journal = Journal(folder, model)
    world: Any = open_world(model, folder, "sumo" if case in (*IN_SUMO, *SIGNALLED) else "numeric")
    loop = Loop(model, world, journal)
    loop.step()  # compiles or loads what the kernels need
    clock.around(loop, "measured", "read")
    clock.around(loop.topology, "step", "topology")
    clock.around(loop.control, "step", "control")
    clock.around(loop.plant, "step", "plant")
    clock.around(loop, "_check", "plant")
    clock.around(loop.record, "step", "record")
    clock.around(world, "move", "write")
    clock.around(world, "close", "step")
    clock.around(journal, "close", "record")
    if case in (*IN_SUMO, *SIGNALLED):
        import libsumo

        clock.around(world, "_read", "read")
        clock.around(libsumo, "simulationStep", "step")

    def close() -> None:
        world.close()
        journal.close()

    return Case(len(model.scenario.ids), loop.step, close, clock)


def public(folder: Path, case: str) -> Case:
    """Our loop through what every checkout has: ``trainctl.Simulation``."""
    import trainctl

    simulation = trainctl.Simulation.open(
        folder / "scenario.toml", backend="sumo" if case in (*IN_SUMO, *SIGNALLED) else "numeric", out=folder / "run", force=True
    )
    simulation.step()  # compiles or loads what the kernels need
    return Case(len(simulation.trains), simulation.step, lambda: None, Clock())


def through_traci() -> Any:
    """A stand-in for the module libsumo that goes through TraCI."""
    import types

    import traci
    from sumo import SUMO_HOME

    shim: Any = types.ModuleType("libsumo")
    shim.vehicle, shim.vehicletype = traci.vehicle, traci.vehicletype
    shim.TraCIException, shim.FatalTraCIError = traci.TraCIException, traci.FatalTraCIError

    class Domain:
        def __getattr__(self, name: str) -> Any:
            return getattr(traci.simulation, name)

        def isLoaded(self) -> bool:
            return bool(traci.isLoaded())

    def start(command: list[str]) -> None:
        os.environ["SUMO_HOME"] = SUMO_HOME
        traci.start([os.path.join(SUMO_HOME, "bin", "sumo"), *command[1:]], stdout=subprocess.DEVNULL)

    shim.simulation, shim.start, shim.simulationStep, shim.close = Domain(), start, traci.simulationStep, traci.close
    return shim


def child(case: str, folder: Path, kind: Callable[[Path, str], Case]) -> None:
    """What runs in a process of its own: as many steps as each line of its input says; at the end, one JSON object."""
    running = kind(folder, case)
    for _ in range(BEFORE.get(case, 0)):
        running.step()
    running.clock.spent |= dict.fromkeys(PARTS, 0.0)
    seconds, cpu = 0.0, -sum(os.times()[2:4])  # netconvert is behind us
    print("ready", flush=True)
    for line in sys.stdin:
        steps = int(line)
        began, busy = time.perf_counter(), time.process_time()
        for _ in range(steps):
            running.step()
        if not steps:
            running.close()
        seconds += time.perf_counter() - began
        cpu += time.process_time() - busy
        print("done", flush=True)
    cpu += sum(os.times()[2:4])  # SUMO behind TraCI
    print(json.dumps({
        "trains": running.trains, "seconds": seconds, "cpu": cpu, "parts": running.clock.spent, "peak_mb": peak_mb(),
    }))  # fmt: skip


# All cases


def python(*arguments: str, checkout: Path | None = None) -> subprocess.Popen[str]:
    """Start this file in a process of its own, with the code of a checkout."""
    pipe, environment = subprocess.PIPE, os.environ if checkout is None else {**os.environ, "PYTHONPATH": str(checkout)}
    return subprocess.Popen([sys.executable, __file__, *arguments], stdin=pipe, stdout=pipe, text=True, env=environment)


def told(process: subprocess.Popen[str], what: str) -> None:
    """Wait until a process says this."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == what:
            return
    raise SystemExit(f"{process.args!r} ended before it was {what}")


def place(root: Path, case: str, trains: int) -> Path:
    """Folder with what a case needs, made once."""
    folder, steps = root / f"{case}-{trains}", steps_of(case, trains)
    if not folder.exists():
        folder.mkdir()
        text, line = scenario(case, trains, steps + 2 + BEFORE.get(case, 0))
        (folder / "scenario.toml").write_text(text, encoding="utf-8")
        (folder / "line.toml").write_text(line, encoding="utf-8")
        if case in COMING:
            railway(folder, trains, case in SIGNALLED)
        if case in ALONE:
            process = python("--inputs", case, str(folder), str(trains), str(steps))
            process.communicate()
            if process.returncode:
                raise SystemExit(f"{process.args!r} failed")
    for old in ("sumo", "segments"):
        shutil.rmtree(folder / old, ignore_errors=True)
    for table in folder.glob("*.parquet"):  # a run that ended would not be joined again
        table.unlink()
    return folder


def together(root: Path, cases: list[str], trains: int) -> dict[str, dict[str, Any]]:
    """One repeat of these cases, which take turns every few steps."""
    running = {case: python("--case", case, str(place(root, case, trains))) for case in cases}
    return by_turns(running, {case: steps_of(case, trains) for case in cases})


def by_turns(running: dict[str, subprocess.Popen[str]], steps: dict[str, int]) -> dict[str, dict[str, Any]]:
    """Let processes do so many steps each, every few steps the next one; what they tell at the end."""
    for process in running.values():
        told(process, "ready")
    for slice_ in range(SLICES + 1):  # the last one closes
        for name, process in running.items():
            assert process.stdin is not None
            share = steps[name] * (slice_ + 1) // SLICES - steps[name] * slice_ // SLICES if slice_ < SLICES else 0
            if share or slice_ == SLICES:
                process.stdin.write(f"{share}\n")
                process.stdin.flush()
                told(process, "done")
    found = {}
    for name, process in running.items():
        said, _ = process.communicate()
        found[name] = {"steps": steps[name], **json.loads(said.splitlines()[-1])}
    return found


def compared(root: Path, checkout: Path, sizes: list[int], cases: list[str], pairs: int) -> list[dict[str, Any]]:
    """Rows of how long this checkout takes over how long another one does, for all cases at all sizes."""
    code, rows = {"here": HERE, "there": checkout}, []
    for name in code:
        (root / name).mkdir()
    for trains in sizes:
        for case in cases:
            found = []
            for turn in range(pairs):
                print(f"{trains} trains, {case}: pair {turn + 1} of {pairs}", file=sys.stderr)
                folders = {name: place(root / name, case, trains) for name in (code if turn % 2 else reversed(code))}
                running = {
                    name: python("--public", case, str(folder), str(code[name]), checkout=code[name])
                    for name, folder in folders.items()
                }
                try:
                    found.append(by_turns(running, dict.fromkeys(running, steps_of(case, trains))))
                except SystemExit as error:  # an older checkout may not know the case
                    for process in running.values():
                        process.kill()
                    print(f"{trains} trains, {case}: left out: {error}", file=sys.stderr)
                    break
            rows += [paired(case, trains, found)] if len(found) == pairs else []
    if not rows:
        raise SystemExit("nothing could be compared")
    return rows


def paired(case: str, trains: int, pairs: list[dict[str, dict[str, Any]]]) -> dict[str, Any]:
    """Median, minimum and maximum of the ratios within the pairs of one case."""
    ratios = [pair["here"]["seconds"] / pair["there"]["seconds"] for pair in pairs]
    cpu = [pair["here"]["cpu"] / pair["there"]["cpu"] for pair in pairs]
    scale = 1e6 / trains
    typical = {name: statistics.median(p[name]["seconds"] / p[name]["steps"] * scale for p in pairs) for name in ("here", "there")}
    return {
        "case": case, "trains": trains, "pairs": len(pairs), "ratio": round(statistics.median(ratios), 3),
        "least_ratio": round(min(ratios), 3), "greatest_ratio": round(max(ratios), 3),
        "cpu_ratio": round(statistics.median(cpu), 3),
        "here_us": round(typical["here"], 3), "there_us": round(typical["there"], 3),
    }  # fmt: skip


def bench(root: Path, sizes: list[int], cases: list[str], repeats: int) -> list[dict[str, Any]]:
    """Rows of all cases at all sizes."""
    rows = []
    for trains in sizes:
        found: list[dict[str, dict[str, Any]]] = []
        for turn in range(repeats):
            now = [case for case in cases if turn == 0 or case in REPEATED]
            print(f"{trains} trains, {turn + 1} of {repeats}: {', '.join(now)}", file=sys.stderr)
            if now:
                found.append(together(root, now, trains))
        rows += [row(case, trains, [results for results in found if case in results]) for case in cases]
    return rows


def instructions(root: Path, case: str, trains: int) -> dict[str, Any]:
    """Instructions per train and step: those of a longer run of a case without those of a shorter one."""
    folder, counts = place(root, case, trains), []
    # valgrind knows no AVX-512; kernels are compiled in a run of their own
    environment = {"NUMBA_CPU_NAME": "x86-64-v2", "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(root / "kernels")}
    command, counter = [sys.executable, __file__, "--case", case, str(folder)], ["valgrind", "--tool=callgrind"]
    for tool, steps in (([], 0), *(([*counter, f"--callgrind-out-file={os.devnull}"], steps) for steps in COUNTED)):
        place(root, case, trains)  # without what the run before left
        done = subprocess.run(
            [*tool, *command], input=f"{steps}\n" if steps else "", env={**os.environ, **environment}, capture_output=True,
            text=True, check=False,
        )  # fmt: skip
        found = re.search(r"Collected : (\d+)", done.stderr)
        if done.returncode or (tool and found is None):
            raise SystemExit(f"{' '.join([*tool, *command])} failed:\n{done.stderr[-2000:]}")
        counts += [int(found.group(1))] if found else []
    return {"case": case, "trains": trains, "instructions": round((counts[1] - counts[0]) / trains / (COUNTED[1] - COUNTED[0]))}


def counted(root: Path, sizes: list[int], cases: list[str]) -> list[dict[str, Any]]:
    """Rows of instructions, and how they compare with the bare step."""
    if shutil.which("valgrind") is None:
        raise SystemExit("--instructions: valgrind is not installed")
    rows = []
    for trains in sizes:
        found = []
        for case in cases:
            print(f"{trains} trains: instructions of {case}", file=sys.stderr)
            found.append(instructions(root, case, trains))
        bare = next((r["instructions"] for r in found if r["case"] == "bare"), None)
        rows += [{**r, "ratio_to_bare": round(r["instructions"] / bare, 3) if bare else None} for r in found]
    return rows


def row(case: str, trains: int, repeats: list[dict[str, dict[str, Any]]]) -> dict[str, Any]:
    """Medians of the repeats of one case; each repeat has the results of all cases that ran."""

    def each(case: str, key: str) -> list[float]:
        return [r[case][key] * 1e6 / trains / r[case]["steps"] for r in repeats]

    def to_bare(key: str) -> float | None:
        if not all("bare" in r for r in repeats):
            return None
        return round(statistics.median(a / b for a, b in zip(each(case, key), each("bare", key), strict=True)), 3)

    times, scale = each(case, "seconds"), 1e6 / trains / repeats[0][case]["steps"]
    parts = {p: statistics.median(r[case]["parts"].get(p, 0.0) * scale for r in repeats) for p in PARTS}
    typical = statistics.median(times)
    return {
        "case": case, "trains": trains, "us_per_train_step": round(typical, 3), "ratio_to_bare": to_bare("seconds"),
        "cpu_ratio_to_bare": to_bare("cpu"), "least_us": round(min(times), 3), "most_us": round(max(times), 3),
        "cpu_us_per_train_step": round(statistics.median(each(case, "cpu")), 3),
        "times_real_time": round(1e6 / (typical * trains), 1),
        "peak_mb": round(max(r[case]["peak_mb"] for r in repeats), 1),
        **{f"{part}_us": round(spent, 3) for part, spent in parts.items()},
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Rows in columns, with how the cost grows with the number of trains."""
    named = {
        "case": "case", "trains": "trains", "instructions": "instructions", "us_per_train_step": "us/train-step",
        "ratio_to_bare": "to bare", "cpu_us_per_train_step": "CPU us", "cpu_ratio_to_bare": "CPU to bare",
        "times_real_time": "x real time", "peak_mb": "peak MB", **{f"{p}_us": p for p in PARTS}, "pairs": "pairs",
        "ratio": "here/there", "least_ratio": "minimum", "greatest_ratio": "maximum", "cpu_ratio": "CPU here/there",
        "here_us": "here us/train-step", "there_us": "there us/train-step",
    }  # fmt: skip
    columns = [c for c in named if c in rows[0]]
    lines = [[named[c] for c in columns], *(["" if r[c] is None else str(r[c]) for c in columns] for r in rows)]
    width = [max(len(line[k]) for line in lines) for k in range(len(columns))]
    text = [
        "  ".join(c.ljust(w) if k == 0 else c.rjust(w) for k, (c, w) in enumerate(zip(line, width, strict=True))) for line in lines
    ]
    for case in dict.fromkeys(r["case"] for r in rows if "us_per_train_step" in r):
        own = {r["trains"]: r["us_per_train_step"] for r in rows if r["case"] == case}
        if {100, 10_000} <= own.keys():
            text.append(f"{case}: cost per train-step grows {own[10_000] / own[100]:.2f} times from 100 to 10000 trains")
    return "\n".join(text)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="What closing the loop costs beside SUMO alone.")
    parser.add_argument("--trains", type=int, action="append", help="number of trains; repeatable; default 10, 100, 1000, 10000")
    parser.add_argument(
        "--only", action="append", choices=[*IN_SUMO, *NUMERIC, *SIGNALLED], help="this case; repeatable; default all"
    )
    parser.add_argument("--repeats", type=int, help="repeats of each case, default 3; of pairs, default 10; the median is shown")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="compare with the code there; default 1000 trains")
    parser.add_argument("--instructions", action="store_true", help="count instructions with valgrind: repeatable, but slow")
    parser.add_argument("--logs", type=float, nargs="?", const=40.0, metavar="MB", help="how fast logs of this size are read")
    parser.add_argument("--ensembles", type=int, nargs="?", const=1000, metavar="RUNS", help="how fast runs side by side are")
    parser.add_argument("--environment", type=int, nargs="?", const=1000, metavar="RUNS", help="how fast agents step")
    parser.add_argument(
        "--country", type=float, nargs="?", const=1.0, metavar="HOURS", help="a day of a country, so many hours of it"
    )
    parser.add_argument(
        "--kernels", type=int, nargs="?", const=999, metavar="TRAINS", help="trains of units on one core and on two"
    )
    parser.add_argument("--json", action="store_true", help="print a list of rows for machines")
    parser.add_argument("--case", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--public", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--inputs", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--roster", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--kernel", nargs=3, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.inputs:
        case, folder, trains, steps = asked.inputs
        inputs(Path(folder), case, int(trains), int(steps))
    elif asked.case:
        case, folder = asked.case
        child(case, Path(folder), client if case == "client" else alone if case in ALONE else closed)
    elif asked.public:
        case, folder, checkout = asked.public
        of_this(Path(checkout))
        child(case, Path(folder), public)
    elif asked.roster:
        import bench_country

        bench_country.of_roster(Path(asked.roster[0]), asked.roster[1:])
    elif asked.kernel:
        import bench_kernels

        bench_kernels.child(*asked.kernel)
    elif asked.kernels is not None:
        import bench_kernels

        with tempfile.TemporaryDirectory(prefix="trainctl-bench-") as root:
            rows = bench_kernels.rows(Path(root), asked.kernels, asked.repeats or 5, asked.against and asked.against.resolve())
        print(json.dumps(rows, indent=2) if asked.json else bench_kernels.table(rows))
    elif asked.country is not None:
        import bench_country

        with tempfile.TemporaryDirectory(prefix="trainctl-bench-") as root:
            rows = bench_country.rows(Path(root), asked.country, asked.repeats or 3)
        print(json.dumps(rows, indent=2) if asked.json else bench_country.table(rows))
    elif asked.ensembles is not None:
        import bench_ensembles

        rows = bench_ensembles.ensembles(asked.ensembles, asked.repeats or 3)
        print(json.dumps(rows, indent=2) if asked.json else bench_ensembles.table(rows))
    elif asked.environment is not None:
        import bench_environment

        rows = bench_environment.environment(asked.environment, asked.repeats or 5)
        print(json.dumps(rows, indent=2) if asked.json else bench_environment.table(rows))
    elif asked.logs is not None:
        import bench_logs

        with tempfile.TemporaryDirectory(prefix="trainctl-bench-") as root:
            rows = bench_logs.logs(Path(root), asked.logs, asked.repeats)
        print(json.dumps(rows, indent=2) if asked.json else bench_logs.table(rows))
    else:
        with tempfile.TemporaryDirectory(prefix="trainctl-bench-") as root:
            sizes, cases = asked.trains or list(SIZES), asked.only
            if asked.against:
                wrong = [case for case in cases or () if case not in OURS]
                if wrong or not (asked.against / "trainctl").is_dir():
                    parser.error(f"--only {wrong[0]}: has no loop of ours" if wrong else f"--against {asked.against}: no checkout")
                rows = compared(
                    Path(root), asked.against.resolve(), asked.trains or [1000], cases or list(OURS), asked.repeats or 10
                )
            elif asked.instructions:
                rows = counted(Path(root), asked.trains or [1000], cases or ["bare", "rail", "loop"])
            else:
                rows = bench(Path(root), sizes, cases or list(EVERY), asked.repeats or 3)
        print(json.dumps(rows, indent=2) if asked.json else table(rows))


if __name__ == "__main__":
    main()
