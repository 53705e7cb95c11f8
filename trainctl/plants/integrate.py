"""Observer, law, limits and plant advanced together: one Runge-Kutta stage is one evaluation of the whole closed loop.

Forces held for 0.1 s make unit-level laws diverge, so everything is integrated jointly in sub-steps of 5 to 10 ms inside
each simulator step, and only the displacement leaves.

What is compiled here neither allocates nor counts references: counting alone took a third of the time of a stage.
"""

from __future__ import annotations

import hashlib
import sys
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
from numba.extending import overload

from trainctl.errors import LawError
from trainctl.kernels import bare
from trainctl.plants import shared
from trainctl.plants.threads import ALONE, Shares
from trainctl.plants.views import CORRECTION, ESTIMATE, OWN, UNITS, block, numbers
from trainctl.signals import FORCE, POSITION, POWERS, SPEED, Bools, Extremes, Floats, Ints, Links, References, evaluate

types: Any = numba.types
typeof: Any = numba.typeof
config: Any = numba.config

#: Whose function ``part`` finds.
LAW, OBSERVER, PLANT = range(3)

#: Held while numba's settings are those of one law.
COMPILING = threading.Lock()


class Parts(NamedTuple):
    """The closed loop, compiled for one law, observer and plant: see ``compiled``."""

    code: str  # whose functions: see ``described``
    advance: Callable[..., None]
    exchange: Callable[..., None]


class Orders(NamedTuple):
    """What is ordered from outside of the law over one simulator step. Arrays of length 0 order nothing."""

    held: shared.Constants  # accelerations (n,) held instead of the law's demand; NaN leaves a train to its law
    lift: Floats  # (U,) N, what holds each unit on its slope: added to the law's demand


#: Nothing is ordered.
NO_ORDERS = Orders(shared.NOBODY, np.zeros(0))


class Inner(NamedTuple):
    """Constants of the three parts, and the orders of this step."""

    law: Any
    observer: Any
    plant: Any
    orders: Orders = NO_ORDERS


class Received(NamedTuple):
    """What links brought, as the kernels take it: of ``Messages`` the newest."""

    heard: Floats  # (L, w) what each link brought
    live: bool  # True: neighbours' data are those of this very instant (the papers); False: ``heard`` is held
    chain: bool  # a message depends on its sender's demand: front to rear, message after demand
    sent_at: float  # s, when ``heard`` was sent, if held


class Scratch(NamedTuple):
    """Work space of one stage, and of the step around it."""

    leader: Floats  # (4,)
    held: Bools  # (U,) the plant holds this unit at standstill; told to observers
    correction: Floats  # (U, c)
    applied: Floats  # (U,)
    own_rate: Floats  # (U, s)
    estimate_rate: Floats  # (U, q)
    power: Floats  # (n, 6)
    sent: Floats  # (n, w)
    limited: Floats  # (n,)
    own: Floats  # (U, s) at the beginning of the step
    own_sum: Floats  # (U, s) weighted sum of the stages' rates
    estimate: Floats  # (U, q)
    estimate_sum: Floats  # (U, q)
    applied_first: Floats  # (U,) at the beginning of ``advance``


def scratch(own: Floats, estimate: Floats, trains: int, corrections: int, message: int) -> Scratch:
    """Work space for these shapes."""
    units = len(own)
    return Scratch(
        np.zeros(4), np.zeros(units, bool), np.zeros((units, corrections)), np.zeros(units), np.zeros_like(own),
        np.zeros_like(estimate), np.zeros((trains, len(POWERS))), np.zeros((trains, message)), np.zeros(trains), np.zeros_like(own),
        np.zeros_like(own), np.zeros_like(estimate), np.zeros_like(estimate), np.zeros(units),
    )  # fmt: skip


@bare(inline="always")
def lead(i, before, references, t, inside, leader):  # type: ignore[no-untyped-def]
    """Let ``leader`` be that of train ``i``; returns which reference that is. ``before``: the one it is of already."""
    r = references.of[i]
    if r != before:
        evaluate(references.breaks[r], references.position[r], t, inside, leader)
    return r


@bare()
def add(lift, sign, a, b, applied):  # type: ignore[no-untyped-def]
    """Add ``sign`` times the lift, if there is one, to the forces of units ``a`` to ``b``."""
    if len(lift) > 0:
        for u in range(a, b):
            applied[u] += sign * lift[u]


@bare(cache=False, forceinline=True)
def stage(code, loop, first, links, references, received, t, inside, own, estimate, work, low, high):  # type: ignore[no-untyped-def]
    """Evaluate the closed loop of trains ``low`` to ``high`` at one instant: fills ``work`` with forces and rates.

    The weight along the track is known and made up for: it is added to what the law demands, within the limits. Observers, which
    know of no slopes, see the rest.
    """
    demand, message = part(code, LAW, "demand"), part(code, LAW, "message")
    correction, estimate_rate = part(code, OBSERVER, "correction"), part(code, OBSERVER, "rate")
    limit, rate = part(code, PLANT, "limit"), part(code, PLANT, "rate")
    observed = estimate.shape[1] > 0
    follows = -1  # whose reference ``work.leader`` is
    age = 0.0 if received.live else t - received.sent_at
    held, lift, talk = loop.orders.held.acceleration, loop.orders.lift, talking(received)
    ordered = len(held) > 0
    for i in range(low, high):
        a, b = first[i], first[i + 1]
        x, q = block(code, OWN, own, a, b), block(code, ESTIMATE, estimate, a, b)
        if observed:
            still, x_rate = block(code, UNITS, work.held, a, b), block(code, OWN, work.own_rate, a, b)
            standing = False
            for j in range(len(x)):
                still[j] = x[j, SPEED] <= 0.0
                standing = standing or still[j]
            if standing and own.shape[1] > FORCE:  # where the forces are a state they say whether a standing unit moves off
                rate(i, loop.plant, t, inside, x, block(code, UNITS, work.applied, a, b), x_rate, work.power[i])
                for j in range(len(x)):
                    still[j] = x[j, SPEED] < 0.0 or (x[j, SPEED] == 0.0 and x_rate[j, SPEED] <= 0.0)
            correction(i, loop.observer, x, q, still, block(code, CORRECTION, work.correction, a, b))
        if talk and not received.chain:
            follows = lead(i, follows, references, t, inside, work.leader)
            q_rate = block(code, ESTIMATE, work.estimate_rate, a, b)
            message(i, loop.law, work.leader, links.slot[i], x, q, q_rate, work.sent[i])
    for p in range(low, high):
        i = links.order[p] if talk else p
        a, b = first[i], first[i + 1]
        e, f = links.first[i], links.first[i + 1]
        x, q, applied = block(code, OWN, own, a, b), block(code, ESTIMATE, estimate, a, b), block(code, UNITS, work.applied, a, b)
        x_rate, q_rate = block(code, OWN, work.own_rate, a, b), block(code, ESTIMATE, work.estimate_rate, a, b)
        corrected = block(code, CORRECTION, work.correction, a, b)
        if talk:
            for k in range(e, f):
                for w in range(received.heard.shape[1]):
                    received.heard[k, w] = work.sent[links.sender[k], w]
        follows = lead(i, follows, references, t, inside, work.leader)
        demand(
            i, loop.law, work.leader, age, links.slot[i], x, q, corrected, links.desired[e:f], received.heard[e:f], applied,
        )  # fmt: skip
        if ordered and held[i] == held[i]:  # not NaN
            shared.demand(
                i, loop.orders.held, work.leader, age, 0.0, x, q, corrected, links.desired[e:f], received.heard[e:f], applied,
            )  # fmt: skip
        else:
            add(lift, 1.0, a, b, work.applied)
        work.limited[i] = 1.0 if limit(i, loop.plant, x, applied) else 0.0
        if observed:
            add(lift, -1.0, a, b, work.applied)
            estimate_rate(i, loop.observer, x, q, block(code, UNITS, work.held, a, b), corrected, applied, q_rate)
            add(lift, 1.0, a, b, work.applied)
        if talk and received.chain:
            message(i, loop.law, work.leader, links.slot[i], x, q, q_rate, work.sent[i])
        rate(i, loop.plant, t, inside, x, applied, x_rate, work.power[i])


@bare()
def exchange_kernel(code, loop, first, links, references, received, t, own, estimate, work):  # type: ignore[no-untyped-def]
    """See ``exchange``."""
    message = part(code, LAW, "message")
    stage(code, loop, first, links, references, received, t, t, own, estimate, work, 0, len(first) - 1)
    follows = -1
    for i in range(len(first) - 1):
        a, b = first[i], first[i + 1]
        follows = lead(i, follows, references, t, t, work.leader)
        message(i, loop.law, work.leader, links.slot[i], own[a:b], estimate[a:b], work.estimate_rate[a:b], work.sent[i])


@bare(cache=False)
def see(code, loop, first, length, links, references, t, inside, own, work, extremes, low, high):  # type: ignore[no-untyped-def]
    """Widen ``extremes`` of trains ``low`` to ``high`` by the state and the forces of this instant; what is NaN widens nothing."""
    watch = part(code, LAW, "watch")
    follows = -1
    for i in range(low, high):
        a, b = first[i], first[i + 1]
        for u in range(a, b):
            force = own[u, FORCE] if own.shape[1] > FORCE else work.applied[u]  # what the actuator gives, where it has dynamics
            widen(extremes.force_min, extremes.force_max, u, force)
            if u + 1 < b:
                widen(extremes.coupler_min, extremes.coupler_max, u, own[u, 0] - own[u + 1, 0] - length[u])
        if extremes.watched.shape[1] > 0:
            follows = lead(i, follows, references, t, inside, work.leader)
            watch(i, loop.law, work.leader, first, own, links, extremes.watched[i])
            for q in range(extremes.watched.shape[1]):
                widen(extremes.watched_min[i], extremes.watched_max[i], q, extremes.watched[i, q])


@bare(inline="always")
def widen(low, high, k, value):  # type: ignore[no-untyped-def]
    """Let ``low[k]`` and ``high[k]`` enclose ``value``."""
    if value < low[k]:
        low[k] = value
    if value > high[k]:
        high[k] = value


@bare(inline="always")
def along(out, base, factor, direction):  # type: ignore[no-untyped-def]
    """``out = base + factor * direction`` for tables, without temporaries."""
    o, b, d = out.reshape(out.size), base.reshape(base.size), direction.reshape(direction.size)  # one loop, so that it vectorises
    for k in range(o.size):
        o[k] = b[k] + factor * d[k]


@bare(inline="always")
def copy(out, table):  # type: ignore[no-untyped-def]
    """``out = table``."""
    o, b = out.reshape(out.size), table.reshape(table.size)
    for k in range(o.size):
        o[k] = b[k]


@bare(inline="always")
def talking(received):  # type: ignore[no-untyped-def]
    """Whether trains receive from each other within a stretch of integration."""
    return received.live and received.heard.shape[1] > 0


@bare()
def advance_kernel(  # type: ignore[no-untyped-def]
    code, loop, first, length, links, references, received, t, h, n, breaks, own, estimate, work, extremes, blocks
):  # fmt: skip
    """See ``advance``. ``blocks`` are the trains that blocks begin with, and the one behind the last: each stays in the cache."""
    for k in range(len(blocks) - 1):
        stretch(
            code, loop, first, length, links, references, received, t, h, n, breaks, own, estimate, work, extremes, blocks[k],
            blocks[k + 1],
        )  # fmt: skip


@bare(cache=False)
def stretch(code, loop, first, length, links, references, received, t, h, n, breaks, own, estimate, work, extremes, low, high):  # type: ignore[no-untyped-def]
    """Integrate trains ``low`` to ``high``."""
    a, b = first[low], first[high]
    x, q, energy, power = own[a:b], estimate[a:b], extremes.energy[low:high], work.power[low:high]
    x_0, x_rate, x_sum = work.own[a:b], work.own_rate[a:b], work.own_sum[a:b]
    q_0, q_rate, q_sum = work.estimate[a:b], work.estimate_rate[a:b], work.estimate_sum[a:b]
    for k in range(n):
        begin, end = t + k * h, t + (k + 1) * h
        while begin < end:
            stop = end
            for jump in breaks:
                if begin + 1e-9 < jump < end - 1e-9:
                    stop = jump
                    break
            dt = stop - begin
            copy(x_0, x)
            copy(q_0, q)
            for s in range(4):
                ahead = 0.0 if s == 0 else (dt if s == 3 else 0.5 * dt)
                if s > 0:
                    along(x, x_0, ahead, x_rate)
                    along(q, q_0, ahead, q_rate)
                stage(
                    code, loop, first, links, references, received, begin + ahead, begin + 0.5 * dt, own, estimate, work, low, high
                )
                if s == 0:
                    see(
                        code, loop, first, length, links, references, begin, begin + 0.5 * dt, own, work, extremes, low, high
                    )  # fmt: skip
                    for i in range(low, high):
                        extremes.limited[i] += dt * work.limited[i]
                    if k == 0 and begin == t:
                        for u in range(a, b):
                            work.applied_first[u] = work.applied[u]
                    copy(x_sum, x_rate)
                    copy(q_sum, q_rate)
                else:
                    along(x_sum, x_sum, 2.0 if s < 3 else 1.0, x_rate)
                    along(q_sum, q_sum, 2.0 if s < 3 else 1.0, q_rate)
                along(energy, energy, (dt if s in (0, 3) else 2.0 * dt) / 6.0, power)
            along(x, x_0, dt / 6.0, x_sum)
            along(q, q_0, dt / 6.0, q_sum)
            stay(x, x_0)
            begin = stop


@bare(inline="always")
def stay(own, before):  # type: ignore[no-untyped-def]
    """Hold units at standstill that a step would have driven backwards: neither speed nor position falls below it."""
    for u in range(len(own)):
        if own[u, SPEED] < 0.0:
            own[u, SPEED] = 0.0
            if own[u, POSITION] < before[u, POSITION]:
                own[u, POSITION] = before[u, POSITION]


def part(code: str, owner: int, name: str) -> Any:
    """Find the function ``name`` of the law (``owner`` 0), the observer (1) or the plant (2) that ``code`` describes.

    In compiled code the choice is made while compiling: the functions are inlined into the stage. Handed over as arguments
    they would have their own arguments, hundreds of words, copied for each train and stage; that took a third of the time.
    """
    return getattr(sys.modules[code.split()[owner]], name)


@overload(part, prefer_literal=True)
def part_compiled(code, owner, name):  # type: ignore[no-untyped-def]
    """Say what ``part`` is in compiled code."""
    function = part(*(argument.literal_value for argument in (code, owner, name)))
    return lambda code, owner, name: function


@cache
def described(*modules: Any) -> str:
    """Names of these modules, then digests of their text: kernels are compiled for, and cached by, this."""
    for module in modules:
        if sys.modules.get(module.__name__) is not module:
            raise LawError(f"{module.__file__}: was read again since this scenario was opened: open it again")
    sources = (getattr(module, "SOURCE", None) or Path(module.__file__).read_bytes() for module in modules)
    return " ".join([*(module.__name__ for module in modules), *(hashlib.sha256(s).hexdigest()[:16] for s in sources)])


def compiled(law: Any, observer: Any, plant: Any, arguments: tuple[Any, ...], exchanges: bool = True) -> Parts:
    """Make the functions of the closed loop ready for ``arguments``, those of ``advance`` after ``parts``.

    Where no train ``exchanges`` messages at instants, ``exchange`` is not made ready: that takes seconds.

    They serve as long as the types of the arguments stay: new values, links and constants of the same shape of data need no
    new call. Compiled code is cached on disk between processes.
    """
    _, first, *_, own, estimate, work, _ = arguments
    code = f"{described(law, observer, plant)} {numbers(first, own, estimate, work.correction)}"
    if config.DISABLE_JIT:
        return Parts(code, advance_kernel, exchange_kernel)
    loop, first, length, links, references, received, t, h, n, breaks, own, estimate, work, extremes = (
        typeof(a) for a in arguments
    )
    text = types.literal(code)
    to_advance = (
        text,
        loop,
        first,
        length,
        links,
        references,
        received,
        t,
        h,
        n,
        breaks,
        own,
        estimate,
        work,
        extremes,
        typeof(np.zeros(0, np.int64)),
    )
    to_exchange = (text, loop, first, links, references, received, t, own, estimate, work)
    place = hashlib.sha256(" ".join(m.__file__ for m in (law, observer, plant)).encode()).hexdigest()[:16]
    exchange = from_cache(exchange_kernel, place, to_exchange) if exchanges else exchange_kernel
    return Parts(code, from_cache(advance_kernel, place, to_advance), exchange)


def from_cache(kernel: Any, place: str, arguments: tuple[Any, ...]) -> Callable[..., None]:
    """Compile for these types, or load what was compiled before and kept in the folder ``place``.

    One folder per law, observer and plant: an index names the types of laws, and none of it can be read where one of them is gone.
    """
    with COMPILING:
        kept, config.CACHE_DIR = config.CACHE_DIR, str(Path(config.CACHE_DIR) / place)
        try:
            kernel.enable_caching()
            return kernel.compile(arguments)  # type: ignore[no-any-return]
        finally:
            config.CACHE_DIR = kept


def advance(
    parts: Parts, loop: Inner, first: Ints, length: Floats, links: Links, references: References, received: Received,
    t: float, h: float,
    n: int, breaks: Floats, own: Floats, estimate: Floats, work: Scratch, extremes: Extremes, shares: Shares = ALONE,
) -> Floats:  # fmt: skip
    """Integrate ``own`` and ``estimate`` in place over ``n`` classic Runge-Kutta steps of ``h`` seconds from ``t``.

    Steps are split at ``breaks`` (ascending times where the reference or a fault jumps): across a jump the order of the
    integrator is lost. Returns the forces applied at ``t``, shape (U,). ``shares`` are the trains by threads, and by blocks.

    The arguments must be of the types ``compiled`` was given (a float stays a float): nothing is checked here, since numba's own
    check of so many arguments takes 0.4 ms.
    """
    mine, *others = shares.blocks or (np.array([0, len(first) - 1]),)
    over_it, further = (t, h, n, breaks, own, estimate), []
    for blocks in others:
        assert shares.pool is not None
        space = {name: getattr(loop.law, name).copy() for name in shares.space}
        apart = loop._replace(law=loop.law._replace(**space)) if space else loop
        arguments = (
            apart,
            first,
            length,
            links,
            references,
            received,
            *over_it,
            work._replace(leader=np.zeros(4)),
            extremes,
            blocks,
        )
        further.append(shares.pool.submit(parts.advance, parts.code, *arguments))
    parts.advance(parts.code, loop, first, length, links, references, received, *over_it, work, extremes, mine)
    for one in further:
        one.result()
    return work.applied_first.copy()


def exchange(
    parts: Parts, loop: Inner, first: Ints, links: Links, references: References, received: Received,
    t: float, own: Floats, estimate: Floats,
    work: Scratch,
) -> None:  # fmt: skip
    """Fill ``work.sent`` with what every train sends at ``t``, each from what it had heard until then."""
    parts.exchange(parts.code, loop, first, links, references, received, t, own, estimate, work)
