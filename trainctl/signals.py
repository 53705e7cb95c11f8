"""What the parts of the loop say to each other: arrays and edge lists, no behaviour of their own.

Controllers, plants, observers and topology meet only here. Every array is float64, int64 or bool, C-contiguous, SI.

Counts used in shapes: ``n`` trains, ``U`` units of all trains one after the other, ``L`` links, ``w`` numbers in one message.
A train's units are the rows ``first[i]:first[i + 1]``, leading unit first. A point train has one unit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from trainctl.kernels import bare, keep_by_sources

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
    installed: Bools = np.zeros(0, np.bool_)  # the force of this unit's train is shared out by installed force; empty: no train

    def by_installed_force(self) -> Bools:
        """Whether the force of every train is shared out by what its units have installed, shape (n,); else it goes by mass."""
        return self.installed[self.first[:-1]] if len(self.installed) else np.zeros(len(self.first) - 1, np.bool_)

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

    def turned(self, turned: Bools) -> Consists:
        """The same with the units of some trains (n,) in the opposite order."""
        rows, between = (turned_rows(self.first, turned, couplers) for couplers in (False, True))
        return self._replace(
            length=self.length[rows], mass=self.mass[rows], rotating=self.rotating[rows], davis=self.davis[rows],
            stiffness=self.stiffness[between], damping=self.damping[between],
            traction=self.traction[rows], traction_power=self.traction_power[rows],
            braking=self.braking[rows], braking_power=self.braking_power[rows], actuator_rate=self.actuator_rate[rows],
        )  # fmt: skip


def turned_rows(first: Ints, turned: Bools, couplers: bool = False) -> Ints:
    """Rows (U,) of units, or of the ``couplers`` behind them, in the order of trains of which some (n,) are turned round."""
    rows = np.arange(first[-1])
    for i in np.flatnonzero(turned).tolist():
        part = slice(int(first[i]), int(first[i + 1]) - couplers)  # nothing is coupled behind the last unit
        rows[part] = rows[part][::-1].copy()
    return rows


class Links(NamedTuple):
    """Who receives from whom now: one row per direction, sorted by receiver. Spacings are front to front, sender minus receiver."""

    sender: Ints  # (L,)
    receiver: Ints  # (L,)
    first: Ints  # (n + 1,) rows first[i]:first[i + 1] are the links train i receives on
    desired: Floats  # (L,) m
    lower: Floats  # (L,) m, -inf if unbounded
    upper: Floats  # (L,) m, inf if unbounded
    weight: Floats  # (L,)
    heard: Bools  # (L,) False: the last message did not arrive
    slot: Floats  # (n,) m, nominal position relative to the reference (0 or negative); NaN where the scenario has no slots
    order: Ints  # (n,) all trains, every train after those ahead that it receives from (front to rear)


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
        if len(self.breaks) == 1:
            out = np.empty(4)
            evaluate(self.breaks[0], self.position[0], t, t, out)
            return out
        each, out = np.empty((len(self.breaks), 4)), np.empty((4, len(self.of)))
        _leaders(self, t, each, out)
        return out


@njit(cache=True)
def evaluate(breaks: Floats, position: Floats, t: float, inside: float, out: Floats) -> None:
    """Write position, speed, acceleration and jerk of a piecewise polynomial at ``t`` into ``out`` (4,).

    ``inside`` is any time within the piece meant: at a break the two sides differ, and an integrator's step must see one.
    """
    pieces, k = position.shape[0], 0
    if pieces > 1:
        k = min(max(np.searchsorted(breaks, inside, side="right") - 1, 0), pieces - 1)
    s = t - breaks[k]
    x = v = a = jerk = 0.0
    for p in range(position.shape[1] - 1, -1, -1):
        factor = position[k, p]
        x = x * s + factor
        if p > 0:
            factor *= p
            v = v * s + factor
        if p > 1:
            factor *= p - 1
            a = a * s + factor
        if p > 2:
            factor *= p - 2
            jerk = jerk * s + factor
    out[0], out[1], out[2], out[3] = x, v, a, jerk


@bare
def _leaders(references: References, t: float, each: Floats, out: Floats) -> None:
    """Write position, speed, acceleration and jerk at ``t`` of every reference (R, 4), and of every train's (4, n)."""
    of = references.of
    for r in range(len(each)):
        evaluate(references.breaks[r], references.position[r], t, t, each[r])
    for d in range(4):
        for i in range(len(of)):
            out[d, i] = each[of[i], d]


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
    """Return the scene of one formation alone; ``members`` (k,) are its trains, no other train receives from them."""
    new = np.full(len(scene.trains), -1)
    new[members] = np.arange(len(members))
    count = np.diff(scene.consists.first)
    units = np.repeat(new, count) >= 0
    first = np.concatenate(([0], np.cumsum(count[members])))
    links, rows = scene.links, new[scene.links.receiver] >= 0
    kept = {name: getattr(links, name)[rows] for name in ("desired", "lower", "upper", "weight", "heard")}
    receiver = new[links.receiver[rows]]
    of_units: list[Any] = [row[units] if len(row) else row for row in scene.consists[1:]]
    return scene._replace(
        trains=[scene.trains[i] for i in members.tolist()],
        consists=type(scene.consists)(first, *of_units),
        own=scene.own[units],
        links=links._replace(
            sender=new[links.sender[rows]], receiver=receiver, first=np.searchsorted(receiver, np.arange(len(members) + 1)),
            slot=links.slot[members], order=new[links.order[new[links.order] >= 0]], **kept,
        ),
        bounds=type(scene.bounds)(*(row[members] for row in scene.bounds)),
    )  # fmt: skip


class Reliance(NamedTuple):
    """What protection may rely on of every train, shape (n,)."""

    braking: Floats  # m/s2, what brakes, faults and slope leave of the braking that is ordered
    pull: Floats  # m/s2, maximum force per mass at the maximum speed; inf if there is no limit
    bias: Floats  # m/s2, what faulty actuators add to the input
    late: Floats  # m/s2, how much running resistance may fall until actuators have followed
    noise: Floats  # m/s2, maximum of the plant's own
    lag: Floats  # s, of actuators


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

    def turned(self, first: Ints, turned: Bools) -> Extremes:
        """The same with the units of some trains (n,) in the opposite order."""
        units, between = (turned_rows(first, turned, couplers) for couplers in (False, True))
        return self._replace(
            coupler_min=self.coupler_min[between], coupler_max=self.coupler_max[between],
            force_min=self.force_min[units], force_max=self.force_max[units],
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
    newest: Ints  # (L,) number of the exchange in which that was sent, -1: none
    bad: Ints  # (L,) whether the channel is in its bad state, -1: not known yet
    spoke: tuple[Bools, ...]  # (n,) each, as ``sent``: who sent at all
    said: Floats  # (n,) m, place relative to the reference when it last sent
    quiet: Ints  # (n,) exchanges since
    counted: Ints  # (2,) messages sent and received since the start


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
