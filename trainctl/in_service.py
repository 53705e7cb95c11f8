"""A long roster: the loop over the trains in service only, those that are there or soon due, instead of all of a day.

A step of the loop costs by the trains it is made for. Of 36 000 that run in a day 1000 are there at once, so the loop is made for
these, and made anew every few minutes; the state of the others waits. Trains keep their order, and what follows from all of them
(the rules of protection, the band of speeds of a convoy, what is single track) stays, so the run is the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from trainctl.loop import Loop, State
from trainctl.railway import interlocking
from trainctl.railway.ways import Ways
from trainctl.scenario.events import Event
from trainctl.scenario.model import Model
from trainctl.signals import Floats, Formed, Ints, Links, Messages, References, Seen, Start
from trainctl.stages import record
from trainctl.stages.record import Journal
from trainctl.topology import convoys
from trainctl.world import World

#: A roster of more trains than this is taken in parts.
MANY = 1000

#: A part serves for this time, and holds the trains that are due until so much later [s].
SERVES_S, EARLY_S = 600.0, 120.0

#: Fields of states that have a row per train, parts of ``State`` and of ``Formed``; and those whose rows hold other trains.
EACH = ("own", "rerouters", "traffic", "rule", "demand", "commanded")
FORMED = ("formation", "ahead", "led", "offset")
TRAINS = ("waits_for", "kept_out", "kept_back", "parted", "refused", "formation", "ahead")


def loop_of(p: Model, world: World, journal: Journal) -> Loop:
    """The loop of a scenario: over all trains, or over those in service where the roster is long."""
    return InService(p, world, journal) if len(p.scenario.train) > MANY and divisible(p) else Loop(p, world, journal)


def divisible(p: Model) -> bool:
    """Whether a run may be taken in parts: nothing in it names trains, or remembers more of them than rows of arrays."""
    s = p.scenario
    named = bool(s.event or s.order or s.disturbance or s.fault)
    return p.driven and p.sampled and not (p.has_units or p.remembers or p.obeys or named or p.roster.driven.any())


class _Part(NamedTuple):
    """The loop over the trains in service."""

    trains: Ints  # (k,) ascending
    loop: Loop
    until: float  # s, it serves


class InService(Loop):
    """A loop over a long roster. ``state`` is that of all trains, as of any loop; it is put together when it is asked for."""

    def __init__(self, model: Model, world: World, journal: Journal) -> None:
        self.whole: State
        self.part: _Part | None = None
        self.together = False  # all trains are in service, since somebody outside may name any of them
        super().__init__(model, world, journal)

    @property
    def state(self) -> State:
        """The state of all trains."""
        if self.part is not None and self.part.loop.state.k > self.whole.k:
            self.whole = _put_back(self.p, self.whole, self.part)
        return self.whole

    @state.setter
    def state(self, whole: State) -> None:
        self.whole, self.part = whole, None

    @property
    def k(self) -> int:
        """Steps done."""
        return int((self.whole if self.part is None else self.part.loop.state).k)

    def step(self) -> None:
        """One simulator step."""
        if self.part is None or self.time >= self.part.until:
            self.part = self._taken(self.state)
        self.part.loop.step()
        if self.between is not None:
            self.between()

    def end(self) -> None:
        """The last instant, of all trains."""
        self.state = self.state
        self.journal.serve(None)
        super().end()

    def order(self, event: Event) -> None:
        """Give an order from outside."""
        self.together = True
        super().order(event)

    def _taken(self, s: State) -> _Part:
        """The loop over the trains that are in service for some time from now on."""
        p, going, until = self.p, s.traffic, self.time + SERVES_S
        kept = ~going.left & (going.came | going.entering | (self.p.roster.depart <= until + EARLY_S))
        for named in (going.waits_for, going.kept_out, going.kept_back, s.formed.ahead):
            kept[named[kept & (named >= 0)]] = True
        kept[[i for i, _, _ in going.requests["stretches"]]] = True
        kept[[i for queue in going.requests["joins"].values() for i in queue]] = True
        trains = np.flatnonzero(kept | self.together)
        world = Served(self.world, trains, len(kept))
        some = p.some(trains, np.unique(self.world.ways.edge))
        self.journal.serve(trains)
        loop = Loop(some, world, self.journal, goes_on=True)
        loop.state = _taken(some, s, loop.state, trains)
        return _Part(trains, loop, until)


class Served:
    """The world as far as some trains are concerned, shape (k,); see ``World``."""

    box = None  # where signals are obeyed a roster is not divided

    def __init__(self, world: World, trains: Ints, everybody: int) -> None:
        self.world, self.trains, self.everybody = world, trains, everybody
        self.of: Ways | None = None
        self.seen: Seen | None = None

    @property
    def ways(self) -> Ways:
        """The ways of these trains."""
        whole = self.world.ways
        if whole is not self.of:
            count = np.diff(whole.first)[self.trains]
            first = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
            self.shift = first[:-1] - whole.first[self.trains]
            rows = np.arange(first[-1]) - np.repeat(self.shift, count)
            self.of, self.own = whole, Ways(first, whole.edge[rows], whole.begin[rows])
        return self.own

    def start(self, start: Start) -> None:
        """All trains have started."""

    def measure(self) -> Seen:
        """Where these trains are now."""
        if self.seen is None:
            assert len(self.ways.first) == len(self.trains) + 1  # ``shift`` is that of the present ways
            whole = self.world.measure()
            self.seen = Seen(
                whole.position[self.trains],
                whole.edge[self.trains],
                whole.row[self.trains] + self.shift,
                whole.present[self.trains],
            )
        return self.seen

    def route(self, train: int, edges: tuple[str, ...]) -> None:
        """Give a train another route."""
        self.seen = None
        self.world.route(int(self.trains[train]), edges)

    def insert(self, train: int, speed: float) -> None:
        """Put a train on the net."""
        self.world.insert(int(self.trains[train]), speed)

    def park(self, train: int, off: bool) -> None:
        """Take a train that stands off its track, or put it back."""
        self.world.park(int(self.trains[train]), off)

    def halt(self, train: int, stands: bool) -> None:
        """Say that a train stands at a stop of its own, or goes on."""
        self.world.halt(int(self.trains[train]), stands)

    def claim(self, claims: list[list[int]]) -> None:
        """Where signals are obeyed a roster is not divided."""

    def turn(self, train: int, edges: tuple[str, ...], arrival: float) -> None:
        """Let a train turn back with the next move."""
        self.world.turn(int(self.trains[train]), edges, arrival)

    def linked(self, links: Links, formation: Ints) -> None:
        """Who receives from whom from now on."""
        together = np.arange(self.everybody)
        together[self.trains] = self.trains[formation]
        alone = np.full(self.everybody, -1)
        self.world.linked(_of_all(links, self.trains, np.zeros(self.everybody), alone), together)

    def move(self, displacement: Floats, step: float) -> None:
        """Let every train move, and end the step."""
        self.seen = None
        whole = np.zeros(self.everybody)
        whole[self.trains] = displacement
        self.world.move(whole, step)

    def close(self) -> None:
        """The world of all trains is closed."""

    def messages(self) -> list[tuple[float | None, str]]:
        """The world of all trains has them."""
        return []

    def collisions(self) -> list[dict[str, Any]]:
        """The world of all trains has them."""
        return []


class Between(NamedTuple):
    """From the numbers of all n trains to those of some (k,) and back. Values are arrays, one row per train, in named tuples."""

    trains: Ints  # (k,) ascending
    number: Ints  # (n,) -1: not among them

    @classmethod
    def of(cls, trains: Ints, everybody: int) -> Between:
        """The numbers of ``trains`` in themselves."""
        number = np.full(everybody, -1)
        number[trains] = np.arange(len(trains))
        return cls(trains, number)

    def some(self, whole: Any, name: str = "") -> Any:
        """What is known of some trains, out of what is known of all."""
        if isinstance(whole, np.ndarray):
            rows = whole[self.trains]
            return np.where(rows >= 0, self.number[rows], -1) if name in TRAINS else rows
        if isinstance(whole, dict):
            return _renamed(whole, self.number)
        return type(whole)(*(self.some(part, field) for field, part in zip(whole._fields, whole, strict=True)))

    def everybody(self, whole: Any, some: Any, name: str = "") -> Any:
        """What was known of all trains, with what is known of some now."""
        if isinstance(whole, np.ndarray):
            rows = whole.copy()
            rows[self.trains] = np.where(some >= 0, self.trains[some], -1) if name in TRAINS else some
            return rows
        if isinstance(whole, dict):
            return _renamed(some, self.trains)
        pairs = zip(whole._fields, whole, some, strict=True)
        return type(whole)(*(self.everybody(part, now, field) for field, part, now in pairs))


def _renamed(table: dict[str, Any], number: Ints) -> Any:
    """Requests, or waits told, of trains with other numbers."""
    if "circles" in table:  # who has left has none; how many circles there were counts
        return {**table, "circles": [number[circle].tolist() for circle in table["circles"]]}
    return interlocking.State(
        joins={edge: number[queue].tolist() for edge, queue in table["joins"].items()},
        stretches=[(int(number[i]), edge, granted) for i, edge, granted in table["stretches"]],
        until={str(number[int(i)]): place for i, place in table["until"].items()},
    )


def _taken(p: Model, s: State, fresh: State, trains: Ints) -> State:
    """The state of some ``trains`` (k,), whose model is ``p``, out of that of all; ``fresh`` is that of a loop just made."""
    between, alarms = Between.of(trains, len(s.commanded)), s.watch.alarms
    told = alarms._replace(
        last=alarms.last[trains], waiting=between.some(alarms.waiting), during=alarms.during[:, trains], now=alarms.now[:, trains]
    )
    each = {name: between.some(getattr(s, name), name) for name in EACH}
    formed = s.formed._replace(
        links=None, made_of=None, references=_of_each(between.some(s.formed.references)),
        **{name: between.some(getattr(s.formed, name), name) for name in FORMED},
    )  # fmt: skip
    if s.formed.links is not None and s.formed.made_of is not None:
        (t, own, _), old = s.formed.made_of, s.formed.links
        receiver, order = between.number[old.receiver], between.number[old.order]
        links = old._replace(
            sender=between.number[old.sender], receiver=receiver, slot=old.slot[trains], order=order[order >= 0],
            first=np.searchsorted(receiver, np.arange(len(trains) + 1)).astype(np.int64),
        )  # fmt: skip
        formed = _made(p, formed, t, own[trains], links)
    return fresh._replace(
        k=s.k, orders=s.orders, formed=formed, messages=_sent(s.messages, between.some),
        watch=record.State(told, s.watch.acting[trains]), **each,
    )  # fmt: skip


def _put_back(p: Model, whole: State, part: _Part) -> State:
    """The state of all trains with that of those in service."""
    s, n, trains = part.loop.state, len(whole.commanded), part.trains
    between, alarms, before = Between.of(trains, n), s.watch.alarms, whole.watch.alarms
    told = before._replace(
        last=between.everybody(before.last, alarms.last), waiting=between.everybody(before.waiting, alarms.waiting)
    )
    each = {name: between.everybody(getattr(whole, name), getattr(s, name), name) for name in EACH}
    formed = whole.formed._replace(
        references=_of_each(between.everybody(whole.formed.references, s.formed.references)),
        **{name: between.everybody(getattr(whole.formed, name), getattr(s.formed, name), name) for name in FORMED},
    )  # fmt: skip
    if s.formed.links is not None and s.formed.made_of is not None:
        t, now, _ = s.formed.made_of
        own = (whole.own if formed.made_of is None else formed.made_of[1]).copy()
        own[trains] = now
        slot = np.zeros(n) if formed.links is None else formed.links.slot
        formed = _made(
            p, formed, t, own, _of_all(s.formed.links, trains, between.everybody(slot, s.formed.links.slot), formed.ahead)
        )
    return whole._replace(
        k=s.k, orders=s.orders, formed=formed, watch=record.State(told, between.everybody(whole.watch.acting, s.watch.acting)),
        messages=_sent(s.messages, lambda rows: between.everybody(np.zeros((n, *rows.shape[1:]), rows.dtype), rows)), **each,
    )  # fmt: skip


def _of_each(references: References) -> References:
    """References of which every train has its own."""
    return references._replace(of=np.arange(len(references.breaks)))


def _made(p: Model, formed: Formed, t: float, own: Floats, links: Links) -> Formed:
    """Formations with what their law makes of these links."""
    return formed._replace(links=links, constants=p.law.constants(p.params, p.scene(own, links, t)), made_of=(t, own, links))


def _of_all(links: Links, trains: Ints, slot: Floats, ahead: Ints) -> Links:
    """Links of some trains as those of all, which have a ``slot`` (n,) [m] and follow the one ``ahead`` (n,)."""
    receiver = trains[links.receiver]
    return links._replace(
        sender=trains[links.sender], receiver=receiver, slot=slot, order=convoys.front_to_rear(ahead),
        first=np.searchsorted(receiver, np.arange(len(slot) + 1)).astype(np.int64),
    )  # fmt: skip


def _sent(messages: Messages, of: Callable[[Any], Any]) -> Messages:
    """Messages with what trains have sent as ``of`` has it."""
    said = of(messages.said) if len(messages.said) else messages.said
    quiet = of(messages.quiet) if len(messages.quiet) else messages.quiet
    sent, spoke = (tuple(of(rows) for rows in part) for part in (messages.sent, messages.spoke))
    return messages._replace(sent=sent, spoke=spoke, said=said, quiet=quiet)
