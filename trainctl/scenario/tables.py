"""One TOML file is one run: its tables, and the rules each key must keep. ``trainctl.scenario.reading`` reads the files."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from functools import cached_property
from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, field_validator, model_validator

from trainctl.laws import moves_points
from trainctl.plants.disturbance import Disturbance
from trainctl.plants.faults import Fault
from trainctl.railway.supervisor import Params as Supervisor
from trainctl.scenario.channel import Channel
from trainctl.scenario.events import Event, Order
from trainctl.scenario.keys import Id, NotNegative, PerUnit, Positive, Seed
from trainctl.scenario.reference import Profile
from trainctl.signals import Bounds, Consists, Floats, Table

SCHEMA_VERSION = 1


#: More are none: beyond, a number of steps is not exact.
MOST_STEPS = 1e15


class RunTable(Table):
    """[run]: time."""

    duration_s: Positive = Field(description="Length of the run [s].")
    step_s: float = Field(1.0, ge=0.001, description="Step of the simulator T [s], whole milliseconds.")
    control_period_s: Positive | None = Field(
        None, description="Control period T_c of sampled laws [s], a multiple of step_s; default step_s."
    )
    sub_step_s: float = Field(
        0.01, ge=1e-6, description="Largest integration step inside a simulator step [s]; not used by the point plant."
    )
    record_every_s: Positive | None = Field(
        None,
        description="Time between rows of trains, units, links and SUMO's FCD [s]; default every step. Extremes stay exact.",
    )
    seed: Seed | None = Field(None, description="Seed of everything random; required as soon as something is.")

    @model_validator(mode="after")
    def _multiples(self) -> RunTable:
        for key in ("duration_s", "control_period_s", "record_every_s"):
            value = getattr(self, key)
            steps = min(value / self.step_s, MOST_STEPS) if value is not None else 0.0
            if value is not None and abs(value / self.step_s - round(steps)) > 1e-6:
                raise ValueError(f"{key} = {value:g}: must be a multiple of step_s = {self.step_s:g}")
        if abs(self.step_s * 1000 - round(self.step_s * 1000)) > 1e-9:
            raise ValueError(f"step_s = {self.step_s:g}: SUMO counts time in whole milliseconds")
        return self

    @property
    def steps(self) -> int:
        """Number of simulator steps."""
        return round(self.duration_s / self.step_s)

    @property
    def held_steps(self) -> int:
        """Simulator steps per control period, m."""
        return round((self.control_period_s or self.step_s) / self.step_s)

    @property
    def recorded_steps(self) -> int:
        """Simulator steps between two recorded rows."""
        return round((self.record_every_s or self.step_s) / self.step_s)

    @property
    def sub_steps(self) -> int:
        """Integration steps per simulator step."""
        return max(1, math.ceil(self.step_s / self.sub_step_s - 1e-9))


class Network(Table):
    """[network]: where the trains run; exactly one of the keys."""

    line: str | None = Field(None, description="Name of a shipped line (see `trainctl net list`) or path of a line TOML.")
    net: str | None = Field(None, description="Path of a SUMO net built by `trainctl net build`.")
    sumocfg: str | None = Field(
        None, description="Path of a SUMO configuration with rail traffic: trains, routes and stops are taken from it."
    )

    @model_validator(mode="after")
    def _one(self) -> Network:
        if sum(key is not None for key in (self.line, self.net, self.sumocfg)) != 1:
            raise ValueError("give exactly one of line, net, sumocfg")
        return self


class TrafficTable(Table):
    """[traffic]: how trains of a SUMO configuration are driven outside of formations, and when they form one."""

    def below(self, limit: Floats) -> Floats:
        """Speed the driver keeps where the limit is ``limit`` [m/s]."""
        below: Floats = np.maximum(limit - self.below_limit_mps, 0.2 * limit)
        return below

    cooperate: tuple[str, ...] = Field(
        ("*",), description="Trains that join formations, by id; * matches anything. The others drive alone."
    )
    others: Literal["driven", "sumo"] = Field(
        "driven",
        description="Trains that do not cooperate: driven: by our driver, on our plants; sumo: by SUMO, with their own vTypes.",
    )
    signals: Literal["ignore", "obey"] | None = Field(
        None,
        description="Rail signals of the net: obey: they decide who goes first; ignore: our own interlocking does. Default: obey"
        " where SUMO drives some trains, or where none is missing and some do not cooperate or run several rounds.",
    )
    acceleration_mps2: Positive = Field(0.4, description="Acceleration of a train or formation that is driven [m/s2].")
    deceleration_mps2: Positive = Field(0.5, description="Braking for limits, stops and trains ahead, positive [m/s2].")
    below_limit_mps: NotNegative = Field(1.0, description="Driven this far below the limits, so that a law has room above [m/s].")
    catch_up_mps: NotNegative = Field(3.0, description="At most this faster than the reference to catch up with a formation [m/s].")
    join_range_m: Positive = Field(20000.0, description="A train farther behind does not try to catch up [m].")
    join_band_m: Positive = Field(50.0, description="A train joins once its spacing is right within this, and in its bounds [m].")
    join_band_mps: Positive = Field(0.5, description="... and its speed that of the formation within this [m/s].")
    wait_limit_s: Positive = Field(
        600.0, description="Waiting for another train, a switch or its entry, but not at its own stop, is logged beyond this [s]."
    )


class BoundsTable(Table):
    """[bounds]: what every train must keep; a [[train]] may state its own."""

    speed_lower_mps: float | None = Field(None, description="Minimum speed [m/s].")
    speed_upper_mps: float | None = Field(None, description="Maximum speed [m/s].")
    input_lower_mps2: float | None = Field(None, description="Minimum input, applied force per mass [m/s2], negative.")
    input_upper_mps2: float | None = Field(None, description="Maximum input, applied force per mass [m/s2].")
    coupler_lower_m: float | None = Field(None, lt=0, description="Minimum coupler displacement (compression) [m], negative.")
    coupler_upper_m: float | None = Field(None, gt=0, description="Maximum coupler displacement (stretch) [m].")


class Topology(Table):
    """[topology]: who receives from whom, at which spacing."""

    rule: Literal["same_track", "links"] = Field(
        "same_track", description="same_track: neighbours on one track receive from each other; links: just the [[link]] tables."
    )
    desired: Literal["slots", "equal"] = Field(
        "slots",
        description="slots: every train keeps its place in the order of the starts, front to rear, a hole stays where one leaves; "
        "equal: neighbours keep spacing_m, the hole closes.",
    )
    spacing_m: Positive | None = Field(None, description="Desired spacing of consecutive trains, front to front [m].")
    lower_m: float | None = Field(None, description="Minimum spacing of consecutive trains, front to front [m]; default none.")
    upper_m: Positive | None = Field(None, description="Maximum spacing of consecutive trains [m]; default none.")
    weight: float = Field(1.0, description="Weight of links that state none (laws with weighted graphs).")
    first_slot_m: float = Field(0.0, description="Nominal position of the first train relative to the reference [m].")
    range_m: Positive | None = Field(None, description="Messages do not reach farther than this [m]; default unlimited.")
    loss: float = Field(0.0, ge=0, lt=1, description="Probability that a message is lost, independent, seeded.")
    delay_s: NotNegative = Field(0.0, description="Age of a message when it arrives [s], a multiple of the exchange period.")
    communication_period_s: Positive | None = Field(
        None,
        description="Time between two messages of continuous laws [s]; default: exchanged in every instant, as their papers do.",
    )


class Link(Table):
    """[[link]]: states one link's numbers; also makes the link where rule = "links" or extra = true."""

    between: tuple[Id, Id] | None = Field(None, description="Two trains, the one ahead first, that receive from each other.")
    sender: Id | None = Field(None, description="With receiver, instead of between: a link in one direction.")
    receiver: Id | None = Field(None, description="The train that receives.")
    desired_m: float | None = Field(None, description="Desired x_first - x_second (sender - receiver) [m]; default from the slots.")
    lower_m: float | None = Field(None, description="Minimum spacing [m]; default the sum over the consecutive links it spans.")
    upper_m: float | None = Field(None, description="Maximum spacing [m]; default the sum over the consecutive links it spans.")
    weight: float | None = Field(None, description="Weight a_ij of this link.")
    extra: bool = Field(
        False, description="With rule = same_track: exists whenever both trains are on one track, neighbours or not."
    )

    @model_validator(mode="after")
    def _ends(self) -> Link:
        pair = self.sender is not None and self.receiver is not None
        if (self.between is None) == (not pair) or (self.between is not None and (self.sender or self.receiver)):
            raise ValueError("give either between = [ahead, behind] or both sender and receiver")
        first, second = self.ends
        if first == second:
            raise ValueError(f"joins train {first} with itself")
        return self

    @property
    def ends(self) -> tuple[str, str]:
        """(sender, receiver), or (ahead, behind)."""
        return self.between or (self.sender or "", self.receiver or "")


class TrainType(Table):
    """[train_type.NAME]: fixed data of a train; a list gives each unit its own value, a number serves all."""

    units: int = Field(1, ge=1, le=64, description="Number of power units (or carriages).")
    unit_length_m: PerUnit = Field(0.0, description="Front of the unit to the front of the next, couplers at rest [m]; 0: a point.")
    unit_mass_kg: PerUnit = Field(description="Mass [kg].")
    rotating_mass_factor: PerUnit = Field(1.0, description="Inertia over mass, at least 1.")
    c0_n_per_kg: PerUnit = Field(description="Davis resistance, constant part [N/kg].")
    c1_ns_per_m_kg: PerUnit = Field(description="Davis resistance, linear part [N s/(m kg)].")
    c2_ns2_per_m2_kg: PerUnit = Field(description="Davis resistance, square part [N s2/(m2 kg)].")
    coupler_stiffness_n_per_m: PerUnit = Field(0.0, description="Stiffness of the coupler behind each unit but the last [N/m].")
    coupler_damping_ns_per_m: PerUnit = Field(0.0, description="Damping of that coupler [N s/m].")
    traction_n: PerUnit | None = Field(None, description="Maximum tractive effort [N]; default unlimited.")
    traction_power_w: PerUnit | None = Field(None, description="Maximum traction power [W]; default unlimited.")
    braking_n: PerUnit | None = Field(None, description="Maximum braking effort, positive [N]; default unlimited.")
    braking_power_w: PerUnit | None = Field(None, description="Maximum braking power [W]; default unlimited.")
    actuator_rate_per_s: PerUnit = Field(0.0, description="r of the actuator tau' = -r tau + r demand [1/s] (actuated_units).")
    force_share: Literal["mass", "installed"] | None = Field(
        None,
        description="How the units share a train's force under a law for whole trains. mass, the default: each"
        " carries its own mass, couplers stay at rest; installed: each gives the same part of its traction_n or braking_n (0: a"
        " trailer), and couplers carry the difference.",
    )
    mass_error_percent: float | None = Field(
        None, gt=-50.0, lt=100.0, description="True mass less the stated one [%], which law, observer and train go by; default 0."
    )

    driven_acceleration_mps2: Positive | None = Field(
        None, description="How trains of this type accelerate where they are driven [m/s2]; default as [traffic] says."
    )
    driven_deceleration_mps2: Positive | None = Field(
        None, description="How they brake where they are driven, positive [m/s2]; default as [traffic] says."
    )

    #: Keys whose list may be one shorter than the units: couplers.
    _couplers = ("coupler_stiffness_n_per_m", "coupler_damping_ns_per_m")
    #: Keys of the train as a whole.
    _whole = ("units", "force_share", "mass_error_percent", "driven_acceleration_mps2", "driven_deceleration_mps2")
    #: Keys by which the force of a train is shared out.
    _shared = ("traction_n", "braking_n")

    @model_validator(mode="after")
    def _per_unit(self) -> TrainType:
        wrong = []
        for key in type(self).model_fields:
            value = getattr(self, key)
            if key in self._whole or value is None:
                continue
            if isinstance(value, tuple):
                lengths = (self.units, self.units - 1) if key in self._couplers else (self.units,)
                if len(value) not in lengths:
                    wrong.append(f"{key} has {len(value)} values: units = {self.units} of them are needed (or one number for all)")
            minimum = min(np.atleast_1d(value), default=0.0)
            if key == "unit_mass_kg" and minimum <= 0:
                wrong.append(f"{key} = {minimum:g}: must be above 0")
            elif key == "rotating_mass_factor" and minimum < 1:
                wrong.append(f"{key} = {minimum:g}: must be at least 1")
            elif (
                self.force_share == "installed" and key in ("traction_n", "braking_n") and minimum == 0 < max(np.atleast_1d(value))
            ):
                continue  # a trailer, or a car without brakes
            elif key in ("traction_n", "traction_power_w", "braking_n", "braking_power_w") and minimum <= 0:
                wrong.append(f"{key} = {minimum:g}: must be above 0 (leave it out for no limit)")
            elif minimum < 0:
                wrong.append(f"{key} = {minimum:g}: must not be negative")
        if self.force_share == "installed":
            wrong += [
                f"{key}: missing, and force_share = installed goes by it" for key in self._shared if getattr(self, key) is None
            ]
        if self.units > 1 and min(np.atleast_1d(self.unit_length_m)) <= 0:
            wrong.append("unit_length_m: a train of several units needs lengths above 0")
        if wrong:
            raise ValueError("; ".join(wrong))
        return self

    def per_unit(self, key: str, missing: float = math.inf) -> np.ndarray[Any, np.dtype[Any]]:
        """The key's value for every unit, shape (units,); couplers padded with 0 behind the last, installed force True."""
        value = getattr(self, key)
        if key == "force_share":
            return np.full(self.units, value == "installed")
        if key in self._couplers:
            row = np.zeros(self.units)
            row[: self.units - 1] = value if not isinstance(value, tuple) else value[: self.units - 1]
            return row
        return np.full(self.units, missing) if value is None else np.broadcast_to(np.asarray(value, float), self.units).copy()


class Train(Table):
    """[[train]]: one train, in the order of the formation, front first."""

    id: Id = Field(description="Name of the train; SUMO's vehicle id.")
    type: str = Field(description="Name of a [train_type.NAME] table.")
    track: Id = Field(description="Track it starts on.")
    position_m: float = Field(description="Position of its front on the line [m].")
    speed_mps: NotNegative = Field(description="Speed [m/s].")
    unit_speed_mps: tuple[float, ...] | None = Field(None, description="Speed of each unit [m/s]; default speed_mps.")
    coupler_m: tuple[float, ...] | None = Field(None, description="Displacement of each coupler at the start [m]; default at rest.")
    speed_lower_mps: float | None = Field(
        None, description="Own minimum speed; the tighter of this, [bounds] and [plant] acts [m/s]."
    )
    speed_upper_mps: float | None = Field(
        None, description="Own maximum speed; the tighter of this, [bounds] and [plant] acts [m/s]."
    )
    input_lower_mps2: float | None = Field(
        None, description="Own minimum input; the tighter of this, [bounds] and [plant] acts [m/s2]."
    )
    input_upper_mps2: float | None = Field(
        None, description="Own maximum input; the tighter of this, [bounds] and [plant] acts [m/s2]."
    )


class Module(Table):
    """A table whose further keys belong to the module it names."""

    model_config = ConfigDict(extra="allow")

    def keys(self) -> dict[str, Any]:
        """The further keys, as read."""
        return dict(self.__pydantic_extra__ or {})


class Controller(Module):
    """[controller]: the law and its parameters (`trainctl schema --law NAME`)."""

    law: str = Field(description="Module in trainctl.controllers, or the name of an entry point `trainctl.controllers`.")


class Observer(Module):
    """[observer]: for laws that need one."""

    kind: str = Field("none", description="Module in trainctl.observers.")


class Plant(Module):
    """[plant]: what moves the trains."""

    kind: str = Field("point", description="Module in trainctl.plants.")

    def too_many(self, name: str, of: TrainType) -> list[str]:
        """What is wrong with trains of several units on a plant of points."""
        if of.units == 1 or not moves_points(self.kind):
            return []
        return [f"train_type.{name}.units = {of.units}: the {self.kind} plant has one unit per train"]


class Scenario(Table):
    """A whole scenario file."""

    schema_version: Literal[1] = Field(description="Version of this format.")
    title: str = Field(description="One line: what the run shows.")
    run: RunTable
    network: Network
    controller: Controller
    observer: Observer = Observer()
    plant: Plant = Plant()
    reference: Profile
    bounds: BoundsTable = BoundsTable()
    topology: Topology = Topology()
    channel: Channel = Channel()
    supervisor: Supervisor | None = Field(None, description="Protection; default: off, on with network.sumocfg.")
    traffic: TrafficTable | None = Field(None, description="Only with network.sumocfg.")
    train_type: dict[str, TrainType] = Field({}, description="With network.sumocfg: by the ids of its vTypes.")
    train: tuple[Train, ...] = ()
    link: tuple[Link, ...] = ()
    event: tuple[Event, ...] = ()
    order: tuple[Order, ...] = ()
    disturbance: tuple[Disturbance, ...] = ()
    fault: tuple[Fault, ...] = ()
    alternative: dict[str, dict[str, Any]] = Field(
        {}, description="Keys of [controller] for rows of `trainctl compare NAME --controllers all`, by the name of the row."
    )

    @field_validator("train")
    @classmethod
    def _unique(cls, trains: tuple[Train, ...]) -> tuple[Train, ...]:
        ids = [t.id for t in trains]
        twice = sorted(i for i, count in Counter(ids).items() if count > 1)
        if twice:
            raise ValueError(f"id {', '.join(twice)} appears more than once")
        return trains

    @cached_property
    def ids(self) -> tuple[str, ...]:
        """Train ids in the order of the tables."""
        return tuple(t.id for t in self.train)

    def cross_references(self, resolved: bool = False) -> list[str]:
        """Mistakes between tables of this file: names that do not exist, lists of the wrong length.

        A scenario as ``resolved`` has the trains of its SUMO configuration; in a user's file they would be another word for them.
        """
        found = self._of_the_network(resolved)
        if self.network.sumocfg is not None and not resolved:
            return found
        ids, types = dict.fromkeys(self.ids), self.train_type
        for t in self.train:
            if t.type not in types:
                found.append(f"train[{t.id}].type = {t.type}: no [train_type.{t.type}]; there are: {', '.join(types)}")
                continue
            units = types[t.type].units
            if t.unit_speed_mps is not None and len(t.unit_speed_mps) != units:
                found.append(f"train[{t.id}].unit_speed_mps: has {len(t.unit_speed_mps)} values, the type has {units} units")
            if t.coupler_m is not None and len(t.coupler_m) != units - 1:
                found.append(f"train[{t.id}].coupler_m: has {len(t.coupler_m)} values, the type has {units - 1} couplers")
        for k, link in enumerate(self.link, 1):
            found += [f"link[{k}]: train {i} does not exist; there are: {', '.join(ids)}" for i in link.ends if i not in ids]
        for k, event in enumerate(self.event, 1):
            if event.train not in ids and not event.of_all:
                found.append(f"event[{k}].train = {event.train}: no such train; there are: {', '.join(ids)}")
        if self.topology.loss > 0 and self.run.seed is None:
            found.append(f"topology.loss = {self.topology.loss:g}: losses are random, so the run needs [run] seed")
        if (key := self.channel.random) and self.run.seed is None:
            found.append(f"channel.{key} = {getattr(self.channel, key):g}: the channel is random, so the run needs [run] seed")
        for name in sorted({t.type for t in self.train if t.type in types}):
            found += self.plant.too_many(name, types[name])
        return found

    def _of_the_network(self, resolved: bool) -> list[str]:
        """Tables that do not go with where the trains come from."""
        if self.network.sumocfg is None:
            found = [] if self.train else ["train: missing; a scenario needs at least one [[train]], or network.sumocfg"]
            found += [] if self.train_type else ["train_type: missing; there must be a [train_type.NAME] for the trains"]
            if self.traffic is not None:
                found.append("traffic: only with network.sumocfg; the trains of [[train]] are in formations from the start")
            if self.order:
                found.append("order: only with network.sumocfg; the trains of [[train]] keep the order they are placed in")
            return found
        found = [
            f"{key}: not with network.sumocfg, whose {what}"
            for key, what in (("train", "own trains run"), ("link", "formations make their links as they form"))
            if getattr(self, key) and not (resolved and key == "train")
        ]
        top = self.topology
        for key, usual in (("rule", "same_track"), ("desired", "slots"), ("first_slot_m", 0.0)):
            if getattr(top, key) != usual:
                value = getattr(top, key)
                found.append(f"topology.{key} = {value}: not with network.sumocfg; neighbours are those along the routes")
        if top.spacing_m is None:
            found.append("topology.spacing_m: missing; trains of a SUMO configuration form up at one desired spacing")
        if self.reference.speed_mps is None or self.reference.follow_line:
            found.append("reference: with network.sumocfg give speed_mps, the cruising speed; limits and stops are obeyed anyway")
        for k, entry in enumerate(self.event, 1):
            if entry.kind == "reroute" and entry.to_edge is None:
                found.append(f"event[{k}]: with network.sumocfg give to_edge")
        return found

    def consists(self) -> Consists:
        """Fixed data of all trains as arrays."""
        types = [t.type for t in self.train]

        def rows(key: str) -> Any:
            of = {name: self.train_type[name].per_unit(key) for name in set(types)}
            return np.concatenate([of[name] for name in types])

        return Consists(
            first=np.concatenate([[0], np.cumsum([self.train_type[name].units for name in types])]).astype(np.int64),
            length=rows("unit_length_m"),
            mass=rows("unit_mass_kg"),
            rotating=rows("rotating_mass_factor"),
            davis=np.ascontiguousarray(np.stack([rows("c0_n_per_kg"), rows("c1_ns_per_m_kg"), rows("c2_ns2_per_m2_kg")], axis=1)),
            stiffness=rows("coupler_stiffness_n_per_m"),
            damping=rows("coupler_damping_ns_per_m"),
            traction=rows("traction_n"),
            traction_power=rows("traction_power_w"),
            braking=rows("braking_n"),
            braking_power=rows("braking_power_w"),
            actuator_rate=rows("actuator_rate_per_s"),
            installed=rows("force_share"),
        )

    def mass_factor(self) -> Floats:
        """True over stated mass of every unit, shape (U,)."""
        kinds = [self.train_type[t.type] for t in self.train]
        return np.repeat([1.0 + 0.01 * (kind.mass_error_percent or 0.0) for kind in kinds], [kind.units for kind in kinds])

    def bounds_of_trains(self) -> Bounds:
        """The tighter of [bounds] and what each train says, infinite where nothing is said."""

        def row(key: str, missing: float) -> Any:
            tighter = max if missing < 0.0 else min
            said = [[v for v in (getattr(t, key), getattr(self.bounds, key)) if v is not None] for t in self.train]
            return np.array([tighter(values, default=missing) for values in said], float)

        return Bounds(
            speed_lower=row("speed_lower_mps", -math.inf),
            speed_upper=row("speed_upper_mps", math.inf),
            input_lower=row("input_lower_mps2", -math.inf),
            input_upper=row("input_upper_mps2", math.inf),
        )

    def toml(self) -> str:
        """The scenario as resolved, as TOML text."""
        import tomli_w

        return tomli_w.dumps(_without_none(self.model_dump(mode="json")))

    def hash(self) -> str:
        """SHA-256 of the resolved scenario."""
        return hashlib.sha256(self.toml().encode()).hexdigest()


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    if isinstance(value, list):
        return [_without_none(v) for v in value]
    return value
