"""Emergency stops side by side: the question of ``studies.spacing``, and what comes of one spacing.

How close trains may follow each other under a law: the smallest desired spacing at which no trains touch in any emergency stop.

The question is the same for all laws. Trains on a level line run at one speed, at their desired spacing but for small errors.
Then the first one brakes as hard as it can, by an order of its own, to a stand; the reference of the others does not change, so
they learn of it by messages alone. Messages come a period late, and some not at all, mostly in bursts. Brakes and running
resistance are unlike from train to train, and no law is told by how much; an unknown force acts on each, and measured
positions are off (for continuous laws they are exact: such a law has no instants to measure at). Nothing protects the trains.

A stop fails if two trains touch, or one is faster than the line. The **smallest safe spacing** is found by bisection with the
first ``searched`` stops; that spacing and some per cent less and more are then run with all of them, for safety need not be
monotone. A spacing below the start condition of a law is *refused*, not unsafe.

Stops are run side by side: each is a track of one line, with a formation of its own, in one closed loop without a simulator. What
is random in a stop is a function of its number and of the seed alone.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
import tomli_w

from trainctl.errors import InputError, LawError
from trainctl.railway.supervisor import stopping_distance
from trainctl.signals import POSITION, SPEED
from trainctl.stages.record import Record
from trainctl.studies.capacity import ICE3, LAW_ROWS
from trainctl.studies.results import wilson

if TYPE_CHECKING:
    from trainctl.loop import Loop
    from trainctl.scenario.model import Model
    from trainctl.signals import Bools
    from trainctl.stages.record import Journal
    from trainctl.world import World

ROWS = tuple(LAW_ROWS)

#: A train this slow stands, but for what disturbs it [m/s]; all must for this long before a stop is over [s].
STANDS_MPS, STANDS_S = 0.1, 20.0

#: A train may be this much faster than its line before its stop fails [m/s].
ROUNDING_MPS = 0.01

#: What comes of a spacing.
SAFE, UNSAFE, REFUSED = "safe", "unsafe", "refused"


class StopsPlan(NamedTuple):
    """What is asked."""

    trains: int = 6
    speed_mps: float = 82.333  # of the reference
    line_mps: float = 83.333
    stops: int = 200
    searched: int = 20
    from_m: float = 250.0  # the spacings that are looked at
    to_m: float = 32_000.0
    within: float = 0.01  # the smallest is found up to this share of it
    seed: int = 1
    brake_scatter: float = 0.05  # brakes of a train, either way
    resistance_scatter: float = 0.2
    input_mps2: float = 0.02  # unknown force, uniform, drawn anew every second
    measured_m: float = 2.0  # error of measured positions, uniform
    position_error_m: float = 5.0  # at the start, uniform
    speed_error_mps: float = 0.2
    brakes_s: float = 20.0  # when the first train brakes
    delay_s: float = 1.0
    loss: float = 0.02  # of messages in good times; in bad ones none arrives
    good_s: float = 60.0  # mean length of good times
    bad_s: float = 3.0

    @property
    def undisturbed(self) -> StopsPlan:
        """The same without anything that differs from train to train or is random, but for the brakes."""
        return self._replace(
            resistance_scatter=0.0, input_mps2=0.0, measured_m=0.0, position_error_m=0.0, speed_error_mps=0.0, loss=0.0, bad_s=0.0
        )

    @property
    def brakes_mps2(self) -> float:
        """What the brakes of a train give that are as they should be."""
        return ICE3["braking_n"] / (ICE3["unit_mass_kg"] * ICE3["rotating_mass_factor"])

    @property
    def sure_mps2(self) -> float:
        """Deceleration every train gives, running resistance not counted on."""
        return self.brakes_mps2 * (1.0 - self.brake_scatter)

    @property
    def best_mps2(self) -> float:
        """Deceleration the best brakes give, without running resistance."""
        return self.brakes_mps2 * (1.0 + self.brake_scatter)

    @property
    def braking(self) -> tuple[float, float]:
        """Full braking of the worst and of the best brakes [m/s2]."""
        return self.sure_mps2, self.best_mps2

    @property
    def duration_s(self) -> float:
        """A stop is over by then."""
        return math.ceil(self.brakes_s + 2.0 * self.speed_mps / self.sure_mps2 + 60.0)


def line(plan: StopsPlan, spacing: float, stops: int) -> dict[str, Any]:
    """A track for every stop."""
    length = plan.trains * spacing + plan.line_mps * plan.duration_s + 20_000.0
    return {
        "name": "stops", "tracks": [f"s{k}" for k in range(stops)], "length_m": math.ceil(length), "max_edge_m": 100_000.0,
        "speed": [[0.0, plan.line_mps]],
    }  # fmt: skip


def scenario(plan: StopsPlan, row: str, spacing: float, stops: Sequence[int], slowest: float = 0.0) -> dict[str, Any]:
    """Tables of a row's scenario of these stops, by their numbers, but for ``network``.

    ``slowest`` [m/s] is the minimum speed that laws with bounds of speed are told.
    """
    first = plan.trains * spacing + 5000.0
    trains, types, events, percent = [], {}, [], []
    for track, k in enumerate(stops):
        off = np.random.default_rng([plan.seed, k]).uniform(-1.0, 1.0, (plan.trains, 4))
        for i, (place, speed, brakes, resistance) in enumerate(off.tolist()):
            name = f"{k}.{i + 1}"
            types[f"t{name}"] = {**ICE3, "braking_n": ICE3["braking_n"] * (1.0 + plan.brake_scatter * brakes)}
            percent.append(100.0 * plan.resistance_scatter * resistance)
            trains.append({
                "id": name, "type": f"t{name}", "track": f"s{track}",
                "position_m": first - i * spacing + plan.position_error_m * place,
                "speed_mps": plan.speed_mps + plan.speed_error_mps * speed,
            })  # fmt: skip
        events.append({"kind": "brake", "train": f"{k}.1", "time_s": plan.brakes_s, "deceleration_mps2": 5.0})
    law = LAW_ROWS[row]
    tables: dict[str, Any] = {
        "schema_version": 1,
        "title": f"{len(stops)} emergency stops of the first train under {row.replace('_', ' ')}, {spacing:.6g} m apart",
        "run": {"duration_s": plan.duration_s, "step_s": 1.0, "sub_step_s": 0.1, "seed": plan.seed, "record_every_s": 60.0},
        "plant": {"kind": "coupled_units"},
        "reference": {"speed_mps": plan.speed_mps, "position_m": first},
        "bounds": {"speed_upper_mps": plan.line_mps},
        "topology": {
            "desired": "equal", "spacing_m": spacing, "lower_m": ICE3["unit_length_m"], "upper_m": 2.0 * spacing, "loss": plan.loss,
            "delay_s": plan.delay_s,
        },
        "controller": {"law": law.__name__.rpartition(".")[2], **law.COMPARED[row]},
        "train_type": types, "train": trains, "event": events,
    }  # fmt: skip
    band = {"speed_lower_mps": slowest, "speed_upper_mps": plan.line_mps}
    tables |= law.in_stops(tables, band, plan.braking) if hasattr(law, "in_stops") else law.on_a_line(tables, band)
    period = tables["run"].get("control_period_s", 1.0)
    tables["topology"] = {**tables["topology"], "delay_s": math.ceil(plan.delay_s / period) * period}
    if plan.bad_s > 0.0:
        tables["channel"] = {"good_s": max(plan.good_s, period), "bad_s": max(plan.bad_s, period)}
    tables["disturbance"] = []
    if plan.input_mps2 > 0.0:
        tables["disturbance"].append({"on": "input", "shape": "uniform", "amplitude_mps2": plan.input_mps2})
    if plan.resistance_scatter > 0.0:
        tables["disturbance"].append({"on": "resistance", "shape": "constant", "error_percent": percent})
    if law.CLOCK != "sampled":
        tables["topology"]["communication_period_s"] = 1.0
    elif plan.measured_m > 0.0:
        tables["disturbance"].append({"on": "measurement", "shape": "uniform", "amplitude_m": plan.measured_m})
    return tables


class Outcome(NamedTuple):
    """What came of some stops at one spacing."""

    spacing_m: float
    what: str  # SAFE, UNSAFE or REFUSED
    failed: int  # stops that failed
    of: int  # stops
    contacts: int  # of those that failed: trains touched
    gap_m: float  # minimum over all of them
    why: str  # where it was refused, or a law diverged
    failures: tuple[int, ...] = ()  # numbers of the stops that failed

    def plain(self) -> dict[str, Any]:
        """For machines, with the interval of the share that failed."""
        return {
            **self._asdict(),
            "gap_m": self.gap_m if math.isfinite(self.gap_m) else None,
            "interval_95": wilson(self.failed, self.of),
        }


class Silent:
    """A journal that keeps nothing."""

    def event(self, time: float, kind: str, **fields: Any) -> None:
        """Not kept."""


class Unwatched(Record):
    """Of stops side by side nothing is recorded, and no alarm is raised: ``Watch`` looks."""

    def relinked(self, t: float, scene: Any, formed: Any, s: Any) -> None:
        """Nothing is reported."""

    def tell(self, row: Any, ways: Any, here: Any, due: bool, s: Any) -> None:
        """Nothing is reported."""

    def waits(self, t: float, here: Any, speed: Any, traffic: Any, around: Any, due: Any, s: Any) -> None:
        """No train waits."""


def unwatched(p: Model, world: World | None = None) -> Loop:
    """The closed loop of a scenario of which nothing is kept, without a simulator unless ``world`` is one."""
    from trainctl.loop import Loop
    from trainctl.numeric import Numeric

    journal = cast("Journal", Silent())
    loop = Loop(p, world or Numeric(p.line), journal)
    loop.record = Unwatched(p, journal)
    return loop


def has_sumo() -> bool:
    """Whether SUMO is here; a light install is without."""
    return find_spec("libsumo") is not None


@contextmanager
def sumo(p: Model, folder: Path) -> Iterator[World]:
    """SUMO for this scenario; its files lie in ``folder`` while the block runs. There is one at a time in a process."""
    from trainctl.runner import open_world
    from trainctl.sumo.idling import silent

    with tempfile.TemporaryDirectory(dir=folder, prefix="sumo-") as place, silent():  # it warns of every contact
        world = open_world(p, Path(place), "sumo")
        try:
            yield world
        finally:
            world.close()


def prepared(plan: StopsPlan, row: str, spacing: float, stops: Sequence[int], folder: Path) -> Model:
    """The scenario of these stops, checked; its files lie in ``folder``."""
    from trainctl.scenario.build import open_scenario

    (folder / "stops.toml").write_text(tomli_w.dumps(line(plan, spacing, len(stops))), encoding="utf-8")
    tables = {**scenario(plan, row, spacing, stops), "network": {"line": "stops.toml"}}
    file = folder / f"{row}.toml"
    file.write_text(tomli_w.dumps(tables), encoding="utf-8")
    return open_scenario(str(file))


def stopped(
    plan: StopsPlan, row: str, spacing: float, stops: Sequence[int], folder: Path, in_sumo: bool = False
) -> tuple[Outcome, Loop | None]:
    """Run these stops side by side, without a simulator or in SUMO; what came of them, and the loop at its end."""
    try:
        p = prepared(plan, row, spacing, stops, folder)
    except InputError as error:
        return Outcome(spacing, REFUSED, 0, len(stops), 0, math.inf, error.mistakes[0].partition(": ")[2]), None
    if not in_sumo:
        return _run(plan, unwatched(p), spacing, stops)
    with sumo(p, folder) as world:
        return _run(plan, unwatched(p, world), spacing, stops)


def _run(plan: StopsPlan, loop: Loop, spacing: float, stops: Sequence[int]) -> tuple[Outcome, Loop]:
    watch = Watch(plan, loop.p, len(stops))
    try:
        while not loop.over and not watch.over(loop):
            loop.step()
    except LawError as error:
        return Outcome(spacing, UNSAFE, len(stops), len(stops), int(watch.touched.sum()), watch.gap, str(error)), loop
    failed = watch.touched | watch.fast
    numbers = tuple(k for k, wrong in zip(stops, failed.tolist(), strict=True) if wrong)
    what = UNSAFE if numbers else SAFE
    return Outcome(spacing, what, len(numbers), len(stops), int(watch.touched.sum()), watch.gap, "", numbers), loop


class Watch:
    """Gaps and speeds of all stops, step by step; trains are rows, ``trains`` of them for each stop, the first one first."""

    def __init__(self, plan: StopsPlan, p: Model, stops: int) -> None:
        self.plan, self.leading, self.length = plan, p.leading, p.consists.train_length().reshape(stops, -1)
        self.step = p.scenario.run.step_s
        self.touched, self.fast, self.gap, self.since = np.zeros(stops, bool), np.zeros(stops, bool), math.inf, 0.0

    def over(self, loop: Loop) -> bool:
        """Take in the present instant; whether every stop has ended, by a stand or by a contact."""
        own = loop.state.own[self.leading]
        position, speed = (own[:, k].reshape(self.length.shape) for k in (POSITION, SPEED))
        gaps = position[:, :-1] - self.length[:, :-1] - position[:, 1:]
        nearest = gaps.min(axis=1)
        self.gap = min(self.gap, float(nearest[~self.touched].min(initial=math.inf)))  # what comes after a contact is no motion
        self.touched |= nearest < 0.0
        self.fast |= speed.max(axis=1) > self.plan.line_mps + ROUNDING_MPS
        stands: Bools = (speed < STANDS_MPS).all(axis=1) | self.touched
        self.since = self.since + self.step if stands.all() else 0.0
        return bool(self.touched.all()) or self.since >= STANDS_S


def reference_lines(plan: StopsPlan) -> dict[str, float]:
    """Spacings that braking distances ask for [m], front to front, with the message's delay, a period and the supervisor's margin.

    ``absolute``: the train ahead may stand at once. ``relative``: it brakes as hard as the best brakes can, the one behind as
    hard as the worst. The distances are those of ``railway.supervisor``, in steps of 1 s.
    """
    v, step = np.array([plan.speed_mps]), 1.0
    ways = [float(stopping_distance(v, b, step, 0.5)[0]) for b in plan.braking]
    other = ICE3["unit_length_m"] + 20.0 + plan.speed_mps * (plan.delay_s + step)
    return {"absolute": ways[0] + other, "relative": ways[0] - ways[1] + other}


def wrong(plan: StopsPlan) -> list[str]:
    """Numbers of a plan that make no sense, as options of the command."""
    rules = (
        ("trains", "at least 2", plan.trains >= 2),
        ("stops", "at least 1", plan.stops >= 1),
        ("searched", "at least 1, at most --stops", 1 <= plan.searched <= plan.stops),
        ("from-m", f"above {ICE3['unit_length_m']:g}, the length of a train", plan.from_m > ICE3["unit_length_m"]),
        ("to-m", "above --from-m", plan.to_m > plan.from_m),
        ("speed-mps", f"above 1, at most {plan.line_mps:g}", 1.0 < plan.speed_mps < plan.line_mps),
        ("loss", "0 .. 0.99", 0.0 <= plan.loss <= 0.99),
        ("delay-s", "at least 0", plan.delay_s >= 0.0),
        ("bad-s", "0, no bad times, or at least 1", plan.bad_s == 0.0 or plan.bad_s >= 1.0),
        ("brake-scatter", "0 .. 0.5", 0.0 <= plan.brake_scatter <= 0.5),
    )
    return [f"--{key}: must be {rule}" for key, rule, holds in rules if not holds]
