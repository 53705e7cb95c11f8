"""What a law, an observer and a plant must provide: modules of these shapes, which mypy checks.

Counts used in shapes are those of ``signals``, whose values they take and give.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, Protocol

from trainctl.signals import Bools, Bounds, Consists, Demand, Floats, Ints, Links, Reliance, Scene, Trains

if TYPE_CHECKING:
    from collections.abc import Sequence


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
    per-unit arrays in it are indexed from its own ``first[i]``. Nothing is written into it but the fields that ``WORK`` names,
    of which every thread has its own; a law without ``WORK``, a tuple of names, is integrated by one thread. ``leader`` is (4,):
    position, speed, acceleration, jerk of the reference now; ``slot`` the train's nominal position relative to it [m].
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

        ``desired`` (k,) and ``heard`` (k, w) are the rows of the k links to train ``i``; ``age`` [s] is how old ``heard`` is
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

    def turned(self, params: Any, estimate: Floats, before: Floats, after: Floats) -> Floats:
        """Estimates (k, width) of units of a train that has turned round: fronts ``before`` (k,) are ``after`` [m] now.

        Forward is backward then. An actuator's fault pushes the way its train runs, so its estimate stays.
        """

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
