"""Where trains are, seen from the loop: SUMO (``trainctl.sumo``) or plain arithmetic on the same line (``--backend numeric``).

``SelfDriven`` is a simulator that decides by itself how its trains move.
"""

from __future__ import annotations

from typing import Any, Protocol

from trainctl.railway.ways import Ways
from trainctl.signals import Bools, Floats, Ints, Links, Observed, Seen, Start


class SignalBox(Protocol):
    """Whoever sets the rail signals that trains obey, and drives trains of its own among them."""

    def green(self, signals: Ints) -> Bools:
        """Whether signals (Q,), by their numbers in the roster, show green, shape (Q,)."""

    def blocker(self, signal: int) -> int:
        """A train because of which a signal is red, -1 if none is known."""

    def kept_parked(self) -> list[int]:
        """Trains that were to come back to their tracks with the last move, and found no place: they are parked still."""

    def speeds(self) -> Floats:
        """Speed of every train that it drives itself [m/s], shape (n,), NaN for the others."""

    def stopped(self) -> Bools:
        """Which trains that it drives itself stand at a stop, shape (n,)."""


class World(Protocol):
    """The simulator as the loop needs it."""

    @property
    def ways(self) -> Ways:
        """The ways of all trains as they are now ordered."""

    @property
    def box(self) -> SignalBox | None:
        """What sets the signals; None: none are obeyed."""

    def start(self, start: Start) -> None:
        """Put the trains on the line; afterwards ``measure`` gives their initial positions."""

    def measure(self) -> Seen:
        """Where every train is now."""

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route; ``edges`` begins with the edge it is on, internal ones included."""

    def insert(self, train: int, speed: float) -> None:
        """Put a train on the net where it was to start; it is there after the next ``move``, or signals keep it out."""

    def park(self, train: int, off: bool) -> None:
        """Take a train that stands off its track, or put it back: both come with the next ``move``, in which it stands.

        Where signals are obeyed it may not be let back, see ``SignalBox.kept_parked``; then it is to be told again.
        """

    def halt(self, train: int, stands: bool) -> None:
        """Say that a train stands at a stop of its own, or goes on: where signals are obeyed, it asks for none meanwhile."""

    def claim(self, claims: list[list[int]]) -> None:
        """Say which trains hold which signals from now on, as pairs of train and signal: nobody else gets what they need there."""

    def turn(self, train: int, edges: tuple[str, ...], arrival: float) -> None:
        """Let a train that stands turn back with the next ``move``, in which it stands: its rear becomes its front.

        ``edges``, internal ones included, begins with the twin of the edge it is on; ``arrival`` is where it leaves on the last of
        them [m], inf: at its end.
        """

    def linked(self, links: Links, formation: Ints) -> None:
        """Who receives from whom from now on, and which formation (n,) every train is in: for simulators that show it."""

    def move(self, displacement: Floats, step: float) -> None:
        """Let every train move by ``displacement`` (n,) [m] within one step, and end the step."""

    def close(self) -> None:
        """End the simulation and its logs."""

    def messages(self) -> list[tuple[float | None, str]]:
        """Warnings the simulator gave, with the time each names, if any; complete after ``close``."""

    def collisions(self) -> list[dict[str, Any]]:
        """Collisions the simulator counted, complete after ``close``: time_s, trains (the one run into first), edge, edge_m."""


class SelfDriven(Protocol):
    """A simulator that drives its trains itself, as ``trainctl.watched`` needs it."""

    @property
    def ways(self) -> Ways:
        """The ways of all trains as they are now ordered."""

    @property
    def planned(self) -> Floats:
        """When every train is to enter [s], shape (n,)."""

    @property
    def stops(self) -> tuple[str, ...]:
        """What the stop is called at which each train stands now, "" if at none, n of them."""

    @property
    def parked(self) -> Bools:
        """Which trains are off their tracks at that stop, shape (n,)."""

    @property
    def over(self) -> bool:
        """Whether every train has left, and none is still to come."""

    def start(self) -> None:
        """Let the first trains in; afterwards ``measure`` gives the state at time 0."""

    def measure(self) -> Observed:
        """Where every train is now, how fast, and behind whom."""

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route; ``edges`` begins with the edge it is on, internal ones included."""

    def step(self) -> None:
        """Go on by one step."""

    def close(self) -> None:
        """End the simulation and its logs."""

    def messages(self) -> list[tuple[float | None, str]]:
        """As of ``World``."""

    def collisions(self) -> list[dict[str, Any]]:
        """As of ``World``."""
