"""Runs in which a law does whatever harm it can: drawn from a seed, driven, and judged by ``judge``.

``drawn(seed, place)`` writes a scenario with its line or net and its law into a folder, ``driven`` runs it and says what became of
it. A start is one from which all can be kept apart: spacings come from braking distances, with room for what disturbs.
"""

from __future__ import annotations

import math
import random
import re
import shutil
import tempfile
import time
import traceback
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import tomli_w
from hostile_nets import NETS
from judge import Findings, Recording, judge

from trainctl import runner
from trainctl.errors import InputError, TrainctlError
from trainctl.loop import Loop
from trainctl.numeric import Numeric
from trainctl.scenario.build import model_of
from trainctl.scenario.model import Model
from trainctl.scenario.reading import examine

LAWS = Path(__file__).parent / "laws"
SAMPLED = (
    "bang", "bang", "attack", "attack", "late", "alternating", "alternating", "wave", "noise", "huge", "first_brakes", "first_brakes",
    "first_brakes", "crawl", "full", "nan",
)  # fmt: skip
CONTINUOUS = (
    "bang", "bang", "attack", "attack", "late", "alternating", "alternating", "apart", "noise", "huge", "first_brakes",
    "first_brakes", "first_brakes", "full", "nan", "inching",
)  # fmt: skip

Plants = tuple[tuple[str, bool, int], ...]

#: Plant, whether a continuous law drives, and how often.
PLANTS: Plants = (
    ("point", False, 30), ("clamped", False, 30), ("coupled_units", False, 12), ("coupled_units", True, 8),
    ("actuated_units", False, 5), ("actuated_units", True, 15),
)  # fmt: skip

#: Those that need no kernel compiled beyond the package's own.
QUICK: Plants = tuple((kind, law, weight) for kind, law, weight in PLANTS if kind in ("point", "clamped"))

GRAVITY = 9.80665


class Case(NamedTuple):
    """A scenario in a folder."""

    seed: int
    kind: str  # railway, plant, style
    folder: Path
    tables: dict[str, Any]


class Outcome(NamedTuple):
    """What became of a run."""

    what: str  # "done", "refused", "died" (exit 3, in words), "crashed"
    words: str  # why it was refused or died
    may_die: bool
    found: Findings | None
    told: bool  # whether the program itself told of trains inside one another
    collisions: int  # in SUMO's log
    steps: int
    seconds: float  # of the processor

    @property
    def failures(self) -> list[str]:
        """What must not be, in words."""
        found = self.found
        bad = [] if found is None else [f"{kind}: {words}" for kind, words in zip(found._fields, found, strict=True) if words]
        if self.what == "crashed" or (self.what == "died" and not self.may_die):
            bad.append(f"{self.what}: {self.words}")
        if self.collisions:
            bad.append(f"collisions: {self.collisions} in SUMO's log")
        if found is not None and found.overlap and not self.told:
            bad.append("silence: trains overlap and no event tells it")
        if found is not None and self.told and not found.overlap:
            bad.append("false alarm: an overlap is told and there is none")
        return bad


class Train(NamedTuple):
    """What a train of a case can do."""

    plant: dict[str, Any]
    type: dict[str, Any]
    length: float  # m
    brakes: float  # m/s2, of the units; inf: without a clamp
    rate: float  # 1/s, of the actuators; inf: none
    mass: float  # kg


def machine(draw: random.Random, kind: str, units: bool, length: float) -> Train:
    """A plant and a type of train of this length."""
    brakes, pulls, mass = draw.uniform(0.7, 1.5), draw.uniform(0.3, 1.2), 5e4
    davis = {"c0_n_per_kg": 0.01176, "c1_ns_per_m_kg": 7.7616e-4, "c2_ns2_per_m2_kg": 1.6e-5}
    if not units:
        plant: dict[str, Any] = {"kind": "point"}
        if kind == "clamped":
            plant |= {"input_lower_mps2": -brakes, "input_upper_mps2": pulls}
            plant |= draw.choice(
                [{}, {"speed_lower_mps": 0.0}, {"speed_lower_mps": 0.0, "speed_upper_mps": draw.uniform(30.0, 60.0)}]
            )
        elif draw.random() < 0.5:
            plant["speed_lower_mps"] = 0.0
        return Train(plant, {"unit_mass_kg": 2e5, "unit_length_m": length} | davis, length,
                     brakes if kind == "clamped" else math.inf, math.inf, 2e5)  # fmt: skip
    number = draw.choice([1, 2, 4, 4, 8])
    type_ = {
        "units": number, "unit_length_m": length / number, "unit_mass_kg": mass, "rotating_mass_factor": draw.choice([1.0, 1.0, 1.08]),
        "traction_n": pulls * mass, "braking_n": brakes * mass,
    } | davis  # fmt: skip
    if number > 1:
        type_ |= {"coupler_stiffness_n_per_m": 1.6e5, "coupler_damping_ns_per_m": draw.choice([600.0, 2e4])}
    if draw.random() < 0.2:
        type_["traction_power_w"] = pulls * mass * draw.uniform(10.0, 30.0)
    rate = math.inf
    if kind == "actuated_units":
        rate = math.exp(draw.uniform(math.log(0.33), math.log(50.0)))
        type_["actuator_rate_per_s"] = rate
    return Train({"kind": kind}, type_, length, brakes / type_["rotating_mass_factor"], rate, number * mass)


AMPLITUDES = {  # channel: key, unit, maximum
    "position": ("m", 0.05), "speed": ("mps", 0.02), "input": ("mps2", 0.12), "resistance": ("percent", 40.0), "measurement": ("m", 15.0)
}  # fmt: skip


def disturbance(draw: random.Random, step: float, sampled: bool, ids: list[str], far: float) -> dict[str, Any]:
    """One entry of [[disturbance]]; those of position and speed, which are per step, grow with the step."""
    on = draw.choice([c for c in AMPLITUDES if sampled or c != "measurement"])
    unit, maximum = AMPLITUDES[on]
    value = round(draw.choice([-1, 1]) * draw.uniform(0.2, 1.0) * maximum * (step if on in ("position", "speed") else 1.0), 6)
    key = "error_percent" if on == "resistance" else f"amplitude_{unit}"
    shape = draw.choice(["constant", "alternating", "sine", "square", "uniform", "gaussian", "step", "gust", "table"])
    entry: dict[str, Any] = {"on": on, "shape": shape, key: value}
    if draw.random() < 0.5:
        entry["train"] = draw.sample(ids, draw.randint(1, len(ids)))
    if shape == "gaussian":
        entry |= {key: abs(value), f"std_{unit}": abs(value) / 2.0}
        if draw.random() < 0.1:
            del entry[key]  # without a bound nothing can be promised
    elif shape in ("sine", "square"):
        entry["period_s"] = draw.uniform(2.0, 120.0)
    elif shape == "step":
        entry["from_s"] = draw.uniform(0.0, 60.0)
    elif shape == "gust":
        entry |= {"from_m": draw.uniform(0.3, 0.6) * far, "to_m": draw.uniform(0.7, 1.0) * far}
    elif shape == "table":
        entry["values"] = [round(draw.uniform(-1.0, 1.0), 3) for _ in range(draw.randint(5, 60))]
    return entry


def fault(draw: random.Random, train: Train, ids: list[str]) -> dict[str, Any]:
    """One entry of [[fault]]."""
    unit = draw.randint(1, train.type["units"])
    entry: dict[str, Any] = {
        "train": draw.choice(ids),
        "unit": unit,
        "kind": draw.choice(["constant", "sinusoid", "effectiveness"]),
    }
    start = draw.choice([0.0, draw.uniform(0.0, 60.0)])
    entry |= {"start_s": start, "end_s": start + draw.uniform(20.0, 400.0)}
    bias = draw.uniform(-0.1, 0.1) * train.type["braking_n"]
    if entry["kind"] == "effectiveness":
        entry["effectiveness"] = draw.choice([0.0, draw.uniform(0.3, 1.0), draw.uniform(0.3, 1.0)])
    else:
        entry["amplitude_n_per_s"] = bias * train.rate
    if entry["kind"] == "sinusoid":
        entry |= {"omega_rad_per_s": draw.uniform(0.05, 3.0), "phase_rad": draw.uniform(0.0, 6.0)}
    return entry


def sure(train: Train, slope: float, disturbances: list[dict[str, Any]], faults: list[dict[str, Any]], step: float) -> float:
    """Deceleration left for certain [m/s2] by a slope (rise / run), by what disturbs and by what fails."""
    lost = sum(abs(d.get("amplitude_mps2", d.get("std_mps2", 0.0) * 4.0)) for d in disturbances)
    lost += sum(abs(d.get("amplitude_mps", d.get("std_mps", 0.0) * 4.0)) / step for d in disturbances)
    if math.isinf(train.brakes):
        return 2.0 - lost
    units = train.type.get("units", 1)
    failing = sum((1.0 - f["effectiveness"]) if f["kind"] == "effectiveness" else 0.1 for f in faults) / units
    return train.brakes * (1.0 - failing) - GRAVITY * max(-slope, 0.0) - lost


def supervisor(draw: random.Random, braking: float) -> dict[str, Any]:
    """[supervisor], on; one in twelve asks for what its trains may not have."""
    table: dict[str, Any] = {"mode": "on", "margin_m": draw.choice([20.0, draw.uniform(2.0, 60.0)])}
    table["curve"] = draw.choice(["relative", "relative", "absolute"])
    if draw.random() < 1.0 / 12.0:
        return table
    emergency = round(min(braking, 1.6) * draw.uniform(0.6, 0.95), 3)
    table |= {"emergency_mps2": emergency, "service_mps2": round(emergency * draw.uniform(0.4, 1.0), 3)}
    if draw.random() < 0.5:
        table["greatest_mps2"] = round(draw.uniform(0.3, 1.5), 3)
    return table


def base(draw: random.Random, seed: int, kind: str, continuous: bool) -> dict[str, Any]:
    """What scenarios on lines and on nets have in common: law, time, messages."""
    law = "hostile_units.py" if continuous else "hostile.py"
    style = draw.choice(CONTINUOUS if continuous else SAMPLED)
    controller = {"law": str(LAWS / law), "style": style, "seed": seed}
    controller |= {"big_n": draw.choice([3e4, 1e6])} if continuous else {"big_mps2": draw.choice([1.0, 3.0, 10.0, 1000.0])}
    step = draw.choice([0.1, 0.2, 0.5, 1.0, 1.0, 1.0, 2.0, 2.0, 5.0, 10.0])
    run = {"step_s": step, "seed": seed}
    if not continuous and draw.random() < 0.3:
        run["control_period_s"] = step * draw.choice([2, 5])
    if kind.endswith("units"):
        run["sub_step_s"] = 0.02 if kind == "actuated_units" else 0.05
    tables: dict[str, Any] = {"schema_version": 1, "title": f"hostile {seed}", "run": run, "controller": controller, "topology": {}}
    if draw.random() < 0.3:
        period = step if continuous else run.get("control_period_s", step)
        tables["topology"] |= {"loss": draw.choice([0.0, 0.3, 0.9]), "delay_s": period * draw.choice([0, 1, 5])}
        tables["topology"] |= {"communication_period_s": period} if continuous else {}
    if kind == "actuated_units" and continuous:
        # The intermediate observer diverges on most trains drawn here, its gains are its paper's; that ends a run early, in words.
        tables["observer"] = {"kind": draw.choice(["none", "asymptotic", "none"])}
    return tables


def drawn(seed: int, place: Path, plants: Plants = PLANTS) -> Case:
    """Draw a case into ``place/SEED``; nets are laid once into ``place/nets``."""
    draw = random.Random(f"hostile {seed}")
    folder = place / str(seed)
    folder.mkdir(parents=True, exist_ok=True)
    kind, continuous, _ = draw.choices(plants, [weight for *_, weight in plants])[0]
    on_net = draw.random() < 0.4
    tables = base(draw, seed, kind, continuous)
    where = net_case(draw, place, folder, tables, kind) if on_net else line_case(draw, folder, tables, kind, continuous)
    return written(draw, seed, f"{where} {kind}{' continuous' if continuous else ''}", folder, tables)


def written(draw: random.Random, seed: int, kind: str, folder: Path, tables: dict[str, Any]) -> Case:
    """The case, its scenario in its folder."""
    controller = tables["controller"]
    every = tables["run"]["step_s"] if controller["style"] == "inching" else draw.uniform(8.0, 60.0)
    controller["every_m"] = tables["reference"]["speed_mps"] * every
    law = Path(controller["law"])
    shutil.copy(law, folder)  # so that the folder stands for itself; runs here share what was compiled of the one module
    (folder / "s.toml").write_text(tomli_w.dumps(tables | {"controller": controller | {"law": law.name}}))
    return Case(seed, f"{kind} {controller['style']}", folder, tables)


def length_of(draw: random.Random) -> float:
    """Length of a train [m]."""
    return draw.choice([100.0, 100.0, draw.uniform(25.0, 400.0), draw.uniform(400.0, 1500.0)])


def line_case(draw: random.Random, folder: Path, tables: dict[str, Any], kind: str, continuous: bool) -> str:
    """Trains one behind the other on a line with slopes and limits."""
    step, count = tables["run"]["step_s"], draw.randint(2, 6)
    ids = [str(i + 1) for i in range(count)]
    units = kind.endswith("units")
    while True:
        train = machine(draw, kind, units, length_of(draw))
        steep = draw.choice([0.0, 0.0, draw.uniform(2.0, 35.0)])
        troubles = [disturbance(draw, step, not continuous, ids, 60_000.0) for _ in range(draw.choice([0, 0, 0, 1, 2]))]
        faults = []
        if kind == "actuated_units" and draw.random() < 0.4:
            faults = [fault(draw, train, ids)]
        braking = sure(train, -steep / 1000.0, troubles, faults, step)
        if braking > 0.25:
            break
    rules = supervisor(draw, braking)
    b = 0.7 * min(rules.get("emergency_mps2", 1.0), braking)
    top = draw.choice([draw.uniform(10.0, 30.0), draw.uniform(30.0, 70.0)])
    lag = 0.0 if math.isinf(train.rate) else 1.0 / train.rate
    doubt = sum(
        abs(d.get("amplitude_m", 4.0 * d.get("std_m", 0.0))) * (1.0 if d["on"] == "measurement" else 10.0) for d in troubles
    )
    held = tables["run"].get("control_period_s", step)
    same = draw.random() < 0.5
    speeds = [0.9 * top * (0.8 if same else draw.random() * (draw.random() < 0.9)) for _ in ids]

    def way(v: float, rate: float) -> float:
        return v * v / (2.0 * rate) + v * (2.0 * step + 2.0 * lag)

    tight, places = draw.random() < 0.7, [0.0]
    for v, ahead in zip(speeds[1:], speeds, strict=False):
        gap = way(v, b) - (ahead * ahead / (2.0 * 2.0) if tight else 0.0)
        gap = max(gap, v * (held + 2.0 * step)) if tight else gap
        places.append(places[-1] - train.length - max(gap, 0.0) - rules["margin_m"] - 2.0 * doubt - draw.uniform(5.0, 100.0))
    first = train.length - places[-1] + 1000.0
    quiet = first + way(speeds[0], 0.4 * b) + 3.0 * top * step + 500.0
    steps = draw.randint(100, 400) if step >= 0.5 else draw.randint(300, 600)
    far = quiet + steps * step * top * draw.choice([1.1, 1.1, 0.5]) + 5000.0
    speed, gradient, x = [[0.0, round(top, 3)]], [[0.0, 0.0]], quiet
    while x < far - 1.0 and len(speed) < 60:
        if draw.random() < 0.6:
            speed.append([round(x, 1), round(draw.uniform(5.0, 1.2 * top), 3)])
        x += draw.uniform(200.0, 4000.0)
    x = draw.uniform(500.0, 6000.0)
    while steep and x < far - 1.0 and len(gradient) < 60:
        gradient.append([round(x, 1), round(draw.choice([-1.0, -0.5, 0.0, 0.7, 1.0]) * steep, 2)])
        x += draw.uniform(500.0, 6000.0)
    line = {"name": "drawn", "tracks": ["1"], "length_m": round(far, 1), "speed": speed, "gradient": gradient}
    (folder / "line.toml").write_text(tomli_w.dumps(line))
    mean = min(max(0.3 * top, 3.0), (far - first) / (steps * step) * 0.9)
    tables["run"]["duration_s"] = steps * step
    tables |= {
        "network": {"line": "line.toml"}, "reference": {"speed_mps": mean}, "plant": train.plant, "train_type": {"emu": train.type},
        "supervisor": rules, "disturbance": troubles, "fault": faults,
        "train": [
            {"id": i, "type": "emu", "track": 1, "position_m": first + x, "speed_mps": v}
            for i, x, v in zip(ids, places, speeds, strict=True)
        ],
    }  # fmt: skip
    tables["topology"]["spacing_m"] = 500.0 + train.length
    return "line"


def railway(draw: random.Random, place: Path) -> tuple[str, Path, list[str]]:
    """Name, net file and routes of a net, laid now if it was not before."""
    name = draw.choice(sorted(NETS))
    lay, variants = NETS[name]
    variant = draw.randrange(variants)
    folder = place / "nets" / f"{name}.{variant}"
    if not folder.is_dir():
        folder.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as work:
            routes = lay(Path(work) / "net", random.Random(f"{name} {variant}"))
            (Path(work) / "net" / "routes").write_text("\n".join(routes))
            with suppress(OSError):  # another process was faster
                (Path(work) / "net").rename(folder)
    return f"{name}.{variant}", folder / "a.net.xml", (folder / "routes").read_text().splitlines()


class Fleet(NamedTuple):
    """What runs on a net."""

    trains: dict[str, Train]  # by type
    troubles: list[dict[str, Any]]  # [[disturbance]]
    faults: list[dict[str, Any]]  # [[fault]]
    braking: float  # m/s2, that can be relied on


def coarser(draw: random.Random, tables: dict[str, Any]) -> float:
    """Steps as they are on nets, and what is a multiple of them; the step [s]."""
    run, top = tables["run"], tables["topology"]
    run["step_s"] = step = max(run["step_s"], 0.5)
    continuous = tables["controller"]["law"].endswith("hostile_units.py")
    if "control_period_s" in run:
        run["control_period_s"] = step * draw.choice([2, 5])
    period = run.get("control_period_s", step)
    if "delay_s" in top:
        top["delay_s"] = period * draw.choice([0, 1, 5])
        top |= {"communication_period_s": period} if continuous else {}
    return step


def fleet(draw: random.Random, tables: dict[str, Any], kind: str, steep: float, ids: list[str], faulty: float = 0.0) -> Fleet:
    """Trains of one or two types on slopes of up to ``steep`` per mil, ``faulty``: how often with faults."""
    step, sampled = tables["run"]["step_s"], tables["controller"]["law"].endswith("hostile.py")
    while True:
        trains = {f"k{k}": machine(draw, kind, kind.endswith("units"), length_of(draw)) for k in range(draw.choice([1, 2]))}
        for other in list(trains)[1:]:  # one plant for all
            trains[other] = trains[other]._replace(plant=trains["k0"].plant, brakes=min(t.brakes for t in trains.values()))
        troubles = [disturbance(draw, step, sampled, ids, 12_000.0) for _ in range(draw.choice([0, 0, 0, 1, 2]))]
        faults = []
        if faulty and kind == "actuated_units" and draw.random() < faulty:
            faults = [fault(draw, min(trains.values(), key=lambda t: t.type["units"]), ids)]
        braking = min(sure(t, -steep / 1000.0, troubles, faults, step) for t in trains.values())
        if braking > 0.25:
            return Fleet(trains, troubles, faults, braking)


def net_case(draw: random.Random, place: Path, folder: Path, tables: dict[str, Any], kind: str) -> str:
    """Trains of two lengths that come, join, part and leave, on a net."""
    name, net, routes = railway(draw, place)
    shutil.copy(net, folder / "a.net.xml")
    step, run, top = coarser(draw, tables), tables["run"], tables["topology"]
    ids = [f"t{k}" for k in range(draw.randint(2, 9))]
    trains, troubles, _, braking = fleet(draw, tables, kind, 35.0 if name.startswith("hills") else 0.0, ids)
    steps = draw.randint(150, 400)
    duration = steps * step
    depart, rows = 0.0, []
    for i in ids:
        kind_of = draw.choice(sorted(trains))
        said = {"type": kind_of, "departSpeed": draw.choice(["max", "max", "10", "0"])}
        if draw.random() < 0.3:
            said["departPos"] = f"{draw.uniform(1.0, min(trains[kind_of].length, 300.0)):.1f}"
        route = draw.choice(routes)
        stop = ""
        if draw.random() < 0.2:
            stop = (
                f'<stop lane="{route.split()[-1]}_0" endPos="{draw.uniform(300.0, 1500.0):.0f}" duration="{draw.randint(5, 60)}"/>'
            )
        more = " ".join(f'{k}="{v}"' for k, v in said.items())
        depart = min(depart, 0.6 * duration)
        rows.append(f'<vehicle id="{i}" depart="{depart:.0f}" {more}><route edges="{route}"/>{stop}</vehicle>')
        depart += draw.choice([0.0, draw.uniform(0.0, 30.0), draw.uniform(10.0, 80.0)])
    types = "".join(f'<vType id="{k}" vClass="rail" length="{t.length}" maxSpeed="45"/>' for k, t in trains.items())
    (folder / "a.rou.xml").write_text(f"<routes>{types}{''.join(rows)}</routes>")
    (folder / "a.sumocfg").write_text(
        '<configuration><input><net-file value="a.net.xml"/><route-files value="a.rou.xml"/></input>'
        f'<time><end value="{duration:.0f}"/></time></configuration>'
    )
    run["duration_s"] = duration
    top |= {"spacing_m": draw.uniform(300.0, 1200.0) + max(t.length for t in trains.values()), "upper_m": 20_000.0, "lower_m": 50.0}
    tables |= {
        "network": {"sumocfg": "a.sumocfg"}, "reference": {"speed_mps": draw.choice([15.0, 25.0, 35.0])}, "plant": trains["k0"].plant,
        "train_type": {k: t.type for k, t in trains.items()}, "supervisor": supervisor(draw, braking), "disturbance": troubles,
        "traffic": {"join_band_m": draw.choice([400.0, 4000.0]), "join_band_mps": draw.choice([5.0, 40.0])},
    }  # fmt: skip
    return name


class Deaf:
    """A journal that writes nothing and remembers whether trains inside one another were told of."""

    def __init__(self) -> None:
        self.told = False

    def event(self, time: float, kind: str, **fields: Any) -> None:
        """One event."""
        self.told |= kind == "collision" or (kind == "violation" and fields.get("bound") == "gap_m")

    def call(self, train: int, call: Any, edge: int) -> None:
        """One stop."""

    def write(self, row: Any) -> None:
        """One instant."""

    def turned(self, p: Model) -> None:
        """Trains that run the other way round."""


def opened(case: Case, mode: str) -> Model:
    """The scenario, checked."""
    tables = case.tables | {"supervisor": case.tables["supervisor"] | {"mode": mode}}
    scenario, found = examine(tables)
    if scenario is None:
        raise InputError(found)
    return model_of(scenario, "s.toml", case.folder, found)


def driven(case: Case, mode: str = "on", backend: str = "numeric") -> Outcome:
    """Run a case and judge it."""
    began = time.process_time()
    try:
        p = opened(case, mode)
    except InputError as error:
        return Outcome("refused", str(error), True, None, False, 0, 0, time.process_time() - began)
    recording, journal = Recording(p), Deaf()
    what, words, collisions = "done", "", 0
    world = None
    folder = case.folder / f"out_{mode}"
    try:
        if backend == "numeric":
            world = Numeric(p.line)
        else:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            world = runner.open_world(p, folder, "sumo")
        sim = Loop(p, world, journal)  # type: ignore[arg-type]
        recording.look(sim)
        while sim.k < p.scenario.run.steps:
            sim.step()
            recording.look(sim)
        sim.end()
    except InputError as error:
        what, words = "refused", f"on the way: {error}"
    except TrainctlError as error:
        what, words = "died", f"{type(error).__name__}: {error}"
    except Exception as error:  # whatever it is, it is not what a user should see
        last = traceback.extract_tb(error.__traceback__)[-1]
        what, words = "crashed", f"{error!r} in {Path(last.filename).name}, line {last.lineno}"
    finally:
        if world is not None:
            world.close()
    log = folder / "sumo" / "collisions.xml"
    if backend == "sumo" and log.is_file():
        collisions = log.read_text().count("<collision ")
    steps = len(recording.rows) - 1
    found = judge(p, recording.tracks()) if recording.rows else None
    may_die = mode == "off" or case.tables["controller"]["style"] == "nan"
    return Outcome(what, words, may_die, found, journal.told, collisions, steps, time.process_time() - began)


def reason(words: str) -> str:
    """The key that a refusal names, without the numbers and the names of trains."""
    first = words.splitlines()[0].removeprefix("s.toml: ")
    return re.sub(r"\[[^\]]*\]", "[]", re.split(r" = |: ", first)[0])[:60]


def forget(case: Case) -> None:
    """Remove a case's folder."""
    shutil.rmtree(case.folder)
