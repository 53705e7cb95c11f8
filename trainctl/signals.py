"""What the parts of the loop say to each other: arrays and edge lists, no behaviour of their own.

Controllers, plants, observers and topology meet only here. Every array is float64, int64 or bool, C-contiguous, SI.

Counts used in shapes: ``n`` trains, ``U`` units of all trains one after the other, ``L`` links, ``w`` numbers in one message.
A train's units are the rows ``first[i]:first[i + 1]``, head first. A point train has one unit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from trainctl.kernels import keep_by_sources

if TYPE_CHECKING:
    from collections.abc import Sequence

keep_by_sources()  # before anything here or above is decorated

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

#: Columns of ``own``: the state of one unit. FORCE only where the actuator has dynamics (``actuated_units``).
POSITION, SPEED, FORCE = 0, 1, 2

#: Standard gravity [m/s2].
GRAVITY = 9.80665


class Table(BaseModel):
    """One table of a scenario: frozen, unknown keys refused, no infinities or NaN, no silent conversion of text to numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Consists(NamedTuple):
    """Fixed data of all trains: ``first`` has shape (n + 1,), ``davis`` (U, 3), everything else (U,).

    The coupler of row ``u`` joins unit ``u`` to unit ``u + 1``; the last unit of a train has stiffness and damping 0.
    Limits are ``inf`` where there is none.
    """

    first: Ints
    length: Floats  # m, front of this unit to front of the next with the coupler at rest
    mass: Floats  # kg
    rotating: Floats  # inertia / mass, >= 1
    davis: Floats  # c0 [N/kg], c1 [N s/(m kg)], c2 [N s2/(m2 kg)]
    stiffness: Floats  # N/m
    damping: Floats  # N s/m
    traction: Floats  # N
    traction_power: Floats  # W
    braking: Floats  # N, positive
    braking_power: Floats  # W
    actuator_rate: Floats  # 1/s, r of the actuator tau' = -r tau + r demand

    def train_length(self) -> Floats:
        """Length of every train [m], shape (n,)."""
        return np.add.reduceat(self.length, self.first[:-1])

    def train_mass(self) -> Floats:
        """Mass of every train [kg], shape (n,)."""
        return np.add.reduceat(self.mass, self.first[:-1])

    def train_davis(self) -> Floats:
        """Davis coefficients of every train, shape (n, 3): the mean of its units weighted by mass."""
        weighted = np.add.reduceat(self.mass[:, None] * self.davis, self.first[:-1])
        return np.asarray(weighted / self.train_mass()[:, None])


class Links(NamedTuple):
    """Who hears whom now: one row per directed hearing, sorted by receiver. Spacings are front to front, sender minus receiver."""

    sender: Ints  # (L,)
    receiver: Ints  # (L,)
    first: Ints  # (n + 1,) rows first[i]:first[i + 1] are what train i hears
    desired: Floats  # (L,) m
    lower: Floats  # (L,) m, -inf if unbounded
    upper: Floats  # (L,) m, inf if unbounded
    weight: Floats  # (L,)
    heard: Bools  # (L,) False: the last message did not arrive
    slot: Floats  # (n,) m, wanted position relative to the reference (0 or negative); NaN where the scenario has no slots
    order: Ints  # (n,) all trains, every train after those it hears from ahead (front to rear)


class Bounds(NamedTuple):
    """What each train must keep, shape (n,); infinite where unbounded."""

    speed_lower: Floats  # m/s
    speed_upper: Floats  # m/s
    input_lower: Floats  # m/s2, applied force per mass
    input_upper: Floats  # m/s2


class Reference(NamedTuple):
    """The virtual leader: piecewise polynomial position, the common form of constant, stepped, S-curve and tabulated profiles.

    On ``breaks[k] <= t < breaks[k + 1]`` its position is ``sum_p position[k, p] * (t - breaks[k])**p``. The first and the
    last piece extend beyond the ends.
    """

    breaks: Floats  # (K + 1,) s
    position: Floats  # (K, P) m/s^p


class Pace(NamedTuple):
    """Where references are and how they move, shape (R,)."""

    position: Floats  # m
    speed: Floats  # m/s
    acceleration: Floats  # m/s2


class References(NamedTuple):
    """References of R formations, each as in ``Reference``, and which of them every train follows."""

    breaks: Floats  # (R, K + 1) s
    position: Floats  # (R, K, P) m/s^p
    of: Ints  # (n,)

    @classmethod
    def one(cls, reference: Reference, trains: int) -> References:
        """One reference for all trains."""
        return cls(reference.breaks[None], reference.position[None], np.zeros(trains, np.int64))

    @property
    def pace(self) -> Pace:
        """Position, speed and acceleration at the beginning of the first pieces; the first two may be written to."""
        first = self.position[:, 0]
        return Pace(first[:, 0], first[:, 1], 2.0 * first[:, 2])

    def leader(self, t: float) -> Floats:
        """Position, speed, acceleration and jerk at ``t``: (4,) where all follow one reference, else of each train (4, n)."""
        out = np.empty((len(self.breaks), 4))
        for r in range(len(self.breaks)):
            evaluate(self.breaks[r], self.position[r], t, t, out[r])
        return out[0] if len(out) == 1 else np.ascontiguousarray(out[self.of].T)


@njit(cache=True)
def evaluate(breaks: Floats, position: Floats, t: float, inside: float, out: Floats) -> None:
    """Write position, speed, acceleration and jerk of a piecewise polynomial at ``t`` into ``out`` (4,).

    ``inside`` is any time within the piece meant: at a break the two sides differ, and an integrator's step must see one.
    """
    k = min(max(np.searchsorted(breaks, inside, side="right") - 1, 0), position.shape[0] - 1)
    s = t - breaks[k]
    for d in range(4):
        value = 0.0
        for p in range(position.shape[1] - 1, d - 1, -1):
            factor = position[k, p]
            for q in range(d):
                factor *= p - q
            value = value * s + factor
        out[d] = value


@njit(cache=True)
def leader_at(reference: Reference, t: float, inside: float, out: Floats) -> None:
    """Write position, speed, acceleration and jerk of the virtual leader at ``t`` into ``out`` (4,), see ``evaluate``."""
    evaluate(reference.breaks, reference.position, t, inside, out)


@njit(cache=True)
def leader_over(reference: Reference, times: Floats) -> Floats:
    """Position, speed, acceleration and jerk of the virtual leader at ``times`` (k,), the later side of a jump: (4, k)."""
    out = np.empty((len(times), 4))
    for k in range(len(times)):
        evaluate(reference.breaks, reference.position, times[k], times[k], out[k])
    return np.ascontiguousarray(out.T)


class Trains(NamedTuple):
    """What each train knows of itself when a sampled law is evaluated, shape (n,)."""

    position: Floats  # m, front
    speed: Floats  # m/s
    resistance: Floats  # N/kg, running resistance and gradient at this speed and place, as the train believes them


class Demand(NamedTuple):
    """What a sampled law asks for, shape (n,)."""

    acceleration: Floats  # m/s2, held over the control period; the input is this plus the resistance
    saturated: Bools  # one of the law's saturations acted


class Scene(NamedTuple):
    """All a law needs to check its assumptions and to prepare its constants, at the start or at a change of topology."""

    trains: Sequence[str]  # ids, length n
    consists: Consists
    own: Floats  # (U, 2) or (U, 3)
    links: Links
    bounds: Bounds
    reference: Reference
    time: float  # s
    step: float  # s, of the simulator
    control_period: float  # s, a multiple of step
    lead: float  # theta: x(k+1) = x + ((1 - theta) v(k) + theta v(k+1)) T_c in the plant that carries the trains
    sub_step: float  # s, of the integrator; equal to step for discrete plants


def restrict(scene: Scene, members: Ints) -> Scene:
    """Return the scene of one formation alone; ``members`` (k,) are its trains, nobody else hears them."""
    new = np.full(len(scene.trains), -1)
    new[members] = np.arange(len(members))
    count = np.diff(scene.consists.first)
    units = np.repeat(new, count) >= 0
    first = np.concatenate(([0], np.cumsum(count[members])))
    links, rows = scene.links, new[scene.links.receiver] >= 0
    kept = {name: getattr(links, name)[rows] for name in ("desired", "lower", "upper", "weight", "heard")}
    receiver = new[links.receiver[rows]]
    return scene._replace(
        trains=[scene.trains[i] for i in members.tolist()],
        consists=type(scene.consists)(first, *(row[units] for row in scene.consists[1:])),
        own=scene.own[units],
        links=links._replace(
            sender=new[links.sender[rows]], receiver=receiver, first=np.searchsorted(receiver, np.arange(len(members) + 1)),
            slot=links.slot[members], order=new[links.order[new[links.order] >= 0]], **kept,
        ),
        bounds=type(scene.bounds)(*(row[members] for row in scene.bounds)),
    )  # fmt: skip


class SampledLaw(Protocol):
    """A train-level law evaluated once per control period: a module of this shape in ``trainctl.controllers``.

    ``demand`` must be local: the input of a train depends on its own rows and on what the links bring it.

    One that keeps something from one control instant to the next is a ``RememberingLaw``.
    """

    CLOCK: Literal["sampled"]
    Params: Any  # frozen pydantic model: the keys of the scenario's [controller] table

    def violations(self, params: Any, scene: Scene) -> list[str]:
        """Every assumption and start condition that fails, as ``key = value: rule`` in words and numbers."""

    def constants(self, params: Any, scene: Scene) -> Any:
        """The law's constants as arrays; called again when the topology changes."""

    def message(self, constants: Any, own: Trains, leader: Floats) -> Floats:
        """What every train sends, shape (n, w), in the frame that moves with the leader, so that old data do not lag."""

    def demand(self, constants: Any, own: Trains, leader: Floats, links: Links, heard: Floats) -> Demand:
        """The law. ``heard`` (L, w) is what each link brought last; rows with ``links.heard`` False are stale."""


class RememberingLaw(Protocol):
    """A sampled law that keeps a state from one control instant to the next: otherwise like ``SampledLaw``.

    The state is arrays and numbers in (named) tuples, one row per train. It lies in the loop's and in every checkpoint, and must
    not be written into.
    """

    CLOCK: Literal["sampled"]
    Params: Any

    def violations(self, params: Any, scene: Scene) -> list[str]:
        """As in ``SampledLaw``."""

    def constants(self, params: Any, scene: Scene) -> Any:
        """As in ``SampledLaw``."""

    def initial(self, params: Any, scene: Scene) -> Any:
        """The state at the first instant."""

    def message(self, constants: Any, own: Trains, leader: Floats, state: Any) -> Floats:
        """As in ``SampledLaw``; the state is that of the instant before."""

    def demand(self, constants: Any, own: Trains, leader: Floats, links: Links, heard: Floats, state: Any) -> tuple[Demand, Any]:
        """As in ``SampledLaw``, with the state for the next instant."""


class ContinuousLaw(Protocol):
    """A unit-level law evaluated in every Runge-Kutta stage; its functions are compiled with ``numba.njit(cache=True)``.

    Arrays ``own``, ``estimate``, ``correction`` and ``out`` hold the units of train ``i`` only, ``desired`` and ``heard``
    what its links bring: locality by construction. ``constants`` is a NamedTuple of floats and arrays made by ``constants()``;
    per-unit arrays in it are indexed from its own ``first[i]``. ``leader`` is (4,): position, speed, acceleration, jerk of the
    reference now; ``slot`` the train's wanted position relative to it [m].
    """

    CLOCK: Literal["continuous"]
    ORDER: Literal["parallel", "chain"]  # chain: a train's message may depend on its demand in the same instant
    MESSAGE: int  # w
    WATCHED: tuple[str, ...]  # names (with unit) of the constrained quantities per train that ``watch`` writes
    Params: Any

    def violations(self, params: Any, scene: Scene) -> list[str]:
        """As in ``SampledLaw``."""

    def constants(self, params: Any, scene: Scene) -> Any:
        """The law's constants as a NamedTuple numba understands; called again when the topology changes."""

    def demand(
        self, i: int, constants: Any, leader: Floats, age: float, slot: float, own: Floats, estimate: Floats,
        correction: Floats, desired: Floats, heard: Floats, out: Floats,
    ) -> None:  # fmt: skip
        """Write the demanded force of each unit [N] into ``out``.

        ``desired`` (k,) and ``heard`` (k, w) are the rows of the k links train ``i`` hears on; ``age`` [s] is how old ``heard`` is
        (0 in the exact mode).
        """

    def message(
        self, i: int, constants: Any, leader: Floats, slot: float, own: Floats, estimate: Floats, estimate_rate: Floats, out: Floats
    ) -> None:
        """Write what train ``i`` sends into ``out`` (w,)."""

    def watch(self, i: int, constants: Any, leader: Floats, first: Ints, own: Floats, links: Links, out: Floats) -> None:
        """Write the constrained quantities of train ``i`` into ``out``; here ``own`` is that of all trains (this is a monitor)."""

    def watched_bounds(self, params: Any, scene: Scene) -> tuple[Floats, Floats]:
        """Lower and upper bounds of the quantities ``watch`` writes, (n, q) each; a law that watches nothing needs none."""


class Observer(Protocol):
    """Estimates per unit, integrated with plant and law; compiled like a continuous law.

    ``width(params)`` columns of ``estimate`` and ``CORRECTIONS`` columns of ``correction`` per unit; none if there is no observer.
    """

    CORRECTIONS: int
    Params: Any

    def width(self, params: Any) -> int:
        """Columns of ``estimate`` per unit."""

    def violations(self, params: Any, scene: Scene) -> list[str]:
        """As in ``SampledLaw``."""

    def constants(self, params: Any, scene: Scene) -> Any:
        """As in ``ContinuousLaw``."""

    def initial(self, params: Any, own: Floats) -> Floats:
        """Estimates at the start, shape (U, width)."""

    def correction(self, i: int, constants: Any, own: Floats, estimate: Floats, held: Bools, out: Floats) -> None:
        """Write the corrections of train ``i``, which the law may read, into ``out`` (units, CORRECTIONS).

        ``held`` (units,) are units the plant holds at standstill: they stay, whatever forces act on them.
        """

    def rate(
        self, i: int, constants: Any, own: Floats, estimate: Floats, held: Bools, correction: Floats, applied: Floats, out: Floats
    ) -> None:
        """Write d(estimate)/dt into ``out``; ``applied`` [N] is what the limits left of the demand, ``held`` as above."""

    def fault_estimate(self, constants: Any, estimate: Floats) -> Floats:
        """What it takes the faults for [m/s3], (U,), for logs; NaN where it estimates none."""

    def acceleration_estimate(self, constants: Any, estimate: Floats) -> Floats:
        """Estimated acceleration [m/s2], (U,), for logs; NaN where it estimates none."""


class Reliance(NamedTuple):
    """What protection may rely on of every train, shape (n,)."""

    braking: Floats  # m/s2, what brakes, faults and slope leave of the braking that is ordered
    pull: Floats  # m/s2, maximum force per mass at the maximum speed; inf if there is no limit
    bias: Floats  # m/s2, what faulty actuators add to the input
    late: Floats  # m/s2, how much running resistance may fall until actuators have followed
    noise: Floats  # m/s2, maximum of the plant's own
    lag: Floats  # s, of actuators


class Plant(Protocol):
    """What moves the trains: a module of this shape in ``trainctl.plants``, and of that of ``PointPlant`` or ``UnitPlant``."""

    UNITS: bool  # trains of units, integrated in sub-steps with law and observer; else points, moved by an exact map
    STATES: int  # columns of ``own``
    COLUMNS: tuple[str, ...]  # what a plant of units adds to units.parquet
    CLAMPS: tuple[str, ...]  # keys of [plant] and [bounds] at which the plant clamps by itself
    Params: Any  # frozen pydantic model: the keys of [plant]; for units, those of ``coupled_units`` are among them

    def violations(self, params: Any, scene: Scene, faults: Sequence[Any]) -> list[str]:
        """Every rule about this plant and its ``[[fault]]`` tables that fails, as in ``SampledLaw``."""

    def lead(self, steps: int) -> float:
        """Theta of ``Scene.lead`` where an acceleration is held for ``steps`` steps of the simulator."""

    def balanced(self, own: Floats, consists: Consists, gradient: Floats | None = None) -> Floats:
        """State (U, STATES) at the positions and speeds of ``own`` (U, 2 or 3); forces, if they are a state, accelerate nothing."""

    def noise_hold(self, params: Any) -> float | None:
        """Time for which a sample of the plant's own noise is held [s]; None: it has none, and needs no seed."""

    def room(self, consists: Consists, lower: Floats, upper: Floats) -> tuple[Floats, Floats]:
        """Minimum and maximum input [m/s2], (n,) each, every train can give in the speed band ``lower`` to ``upper`` (n,)."""

    def sure_braking(self, params: Any, consists: Consists, top: Floats) -> Floats:
        """Deceleration [m/s2], (n,), every train can give on the level at any speed up to ``top`` (n,); inf if unlimited."""

    def relied_on(
        self, params: Any, consists: Consists, faults: Sequence[Any], trains: Sequence[str], braking: float, top: Floats,
        fall: Floats, deviations: float,
    ) -> Reliance:  # fmt: skip
        """What protection may rely on where it orders ``braking`` [m/s2], up to the speed ``top`` (n,) [m/s].

        ``fall`` (n,) [m/s2] is gravity on the steepest descent; unbounded noise counts as so many standard ``deviations``.
        """


class PointPlant(Plant, Protocol):
    """Trains as points, moved from step to step by an exact map: see ``plants.point`` for ``Kick`` and ``Mapped``."""

    def constants(
        self, params: Any, consists: Consists, resistance_factor: Floats | None = None, gradient: Floats | None = None,
        clamps: Bounds | None = None,
    ) -> Any:  # fmt: skip
        """Arrays of all trains; those of ``plants.point.Constants`` are among them, and what clamps each train."""

    def advance(self, constants: Any, own: Floats, acceleration: Floats, step: float, kick: Any) -> Any:
        """One step of all trains that are asked for ``acceleration`` (n,)."""


class UnitPlant(Plant, Protocol):
    """Motion of the units of train ``i``; ``limit`` and ``rate`` are compiled like a continuous law."""

    def constants(
        self, params: Any, consists: Consists, gradient: Floats | None = None, resistance_factor: Floats | None = None,
        faults: Sequence[Any] = (), trains: Sequence[str] = (),
    ) -> Any:  # fmt: skip
        """For numba, with ``first`` and ``units``, whose first columns are those of ``coupled_units``; ``gradient`` as there."""

    def make_noise(self, params: Any, constants: Any, seed: int, sample: int | None) -> None:
        """Write the sample of that number of the plant's own noise into ``constants``, or none."""

    def columns(
        self, constants: Any, t: float, own: Floats, applied: Floats, fault_estimate: Floats, acceleration_estimate: Floats
    ) -> tuple[Floats, ...]:
        """Values of ``COLUMNS`` at ``t``, (U,) each; ``applied`` (U,) is what the limits left of the demand [N]."""

    def limit(self, i: int, constants: Any, own: Floats, applied: Floats) -> bool:
        """Clip ``applied`` [N] to what the units can do, in place; True if a limit acted."""

    def rate(
        self, i: int, constants: Any, t: float, inside: float, own: Floats, applied: Floats, out: Floats, power: Floats
    ) -> None:
        """Write d(own)/dt into ``out``, the train's ``POWERS`` [W] into ``power`` (6,); ``inside`` as in ``leader_at``."""


#: What ``Plant.rate`` writes into ``power``; each is the rate of an energy [W]. Kinetic plus coupler energy changes by
#: traction - braking - resistance - damping - gradient + disturbance.
POWERS = ("traction", "braking", "resistance", "damping", "gradient", "disturbance")


class Start(NamedTuple):
    """Trains as they are put on the line, one row per train."""

    ids: Sequence[str]
    edge: Ints  # (n,) index into line.edges
    lane_position: Floats  # (n,) m, front, from the beginning of the edge
    speed: Floats  # (n,) m/s
    length: Floats  # (n,) m
    unit_length: Sequence[Floats]  # m, of each train's units, for the picture
    routes: Sequence[tuple[str, ...]]  # edge ids from the edge a train starts on, internal ones included
    present: Bools  # (n,) the others come later
    vclass: Sequence[str]  # SUMO's class of vehicle
    arrival: Floats | None = None  # (n,) m, from the beginning of the last edge, where a train leaves; None, inf: at its end


class Seen(NamedTuple):
    """What is measured of all trains, shape (n,). Of trains that are not there it is where they will come or have left."""

    position: Floats  # m on the line, front
    edge: Ints  # index into line.edges
    row: Ints  # of the edge it is on in the ways
    present: Bools


class Observed(NamedTuple):
    """What a simulator says of trains that it drives itself, shape (n,)."""

    seen: Seen
    speed: Floats  # m/s, NaN of trains that are not there
    ahead: Ints  # train ahead, -1: none
    spacing: Floats  # m, to its front; NaN: none


class Disturbed(NamedTuple):
    """What acts in one step, shape (n,)."""

    position: Floats  # w1 [m]
    speed: Floats  # w2 [m/s]
    input: Floats  # w3 [m/s2]
    resistance: Floats  # true over believed resistance, 1 if undisturbed
    measurement: Floats  # measured minus true position [m]

    def calm(self) -> Disturbed:
        """The same step without what disturbs the motion: what can be known of it before."""
        none = np.zeros_like(self.position)
        return Disturbed(none, none, none, np.ones_like(none), self.measurement)


class Extremes(NamedTuple):
    """Over the sub-steps since they were last reset: a once-a-second sample hides peaks."""

    coupler_min: Floats  # (U,) m
    coupler_max: Floats
    force_min: Floats  # (U,) N
    force_max: Floats
    watched_min: Floats  # (n, q) the law's constrained quantities
    watched_max: Floats
    limited: Floats  # (n,) s, time during which a unit limit acted
    energy: Floats  # (n, 6) J, see signals.POWERS
    watched: Floats  # (n, q) the constrained quantities when last seen

    @classmethod
    def fresh(cls, trains: int, units: int, watched: int) -> Extremes:
        """Nothing seen yet."""
        low, high = np.full(units, np.inf), np.full(units, -np.inf)
        return cls(
            low, high, low.copy(), high.copy(), np.full((trains, watched), np.inf), np.full((trains, watched), -np.inf),
            np.zeros(trains), np.zeros((trains, len(POWERS))), np.full((trains, watched), np.nan),
        )  # fmt: skip


class Motion(NamedTuple):
    """One simulator step of all trains."""

    displacement: Floats  # (n,) m, what SUMO is told to do
    input: Floats  # (n,) m/s2, force of the whole train per mass at the beginning of the step
    acceleration: Floats  # (n,) m/s2, mean over the step
    asked: Floats  # (n,) m/s2, what drives the train, as the supervisor judges it
    limited: Bools  # (n,) a limit of the plant acted
    clipped: Bools  # (n,) the train would have moved backwards
    force: Floats | None  # (U,) N at the beginning of the step
    extras: dict[str, Floats]  # further columns of the units, (U,) each


class Messages(NamedTuple):
    """Messages between trains: under way, and what each link brought last."""

    sent: tuple[Floats, ...]  # (n, w) each, oldest first
    heard: Floats  # (L, w)
    ever: Bools  # (L,) it has brought something


class Formed(NamedTuple):
    """Who drives with whom: the formations, their links and references, and what the law made of them."""

    links: Links | None  # None: not sorted yet
    formation: Ints  # (n,) equal for members of one formation
    ahead: Ints  # (n,) train ahead in the formation, -1: none
    led: Bools  # (n,) the law drives it
    offset: Floats  # (n,) m, added to the position along the own route, so that spacings in a formation are right
    references: References  # one for all trains, or one of each formation's own
    constants: Any  # of the law
    made_of: tuple[float, Floats, Links] | None  # time, own state and links that the constants were made of


class Row(NamedTuple):
    """One instant: the state that holds at ``time`` and what is applied from then on (None at the end)."""

    time: float  # s
    seen: Seen
    track: Ints  # (n,)
    own: Floats  # (U, s)
    speed: Floats  # (n,) m/s, of the leading units
    ahead: Ints  # (n,) train ahead in the formation, -1 for the first
    links: Links
    motion: Motion | None
    saturated: Bools  # (n,)
    extremes: Extremes | None  # over the sub-steps since the last row
    disturbed: Disturbed | None  # what acts from this instant on
    led: Bools  # (n,) trains the law drives
    spacing: Floats | None = None  # (n,) m, to the train ahead, as the simulator has it; None: difference of the positions
