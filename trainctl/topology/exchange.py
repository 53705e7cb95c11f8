"""Messages between trains: what of what is said arrives, and when; what a lost message does is each law's own rule.

Each link has a channel of its own. It loses messages independently, or in bursts: Gilbert's and Elliott's two states [1]_, [2]_,
between which it turns with fixed probabilities from exchange to exchange. A message is under way for a fixed time, and a random
one on top; one that is overtaken by a newer one is discarded. Trains whose radio is out neither send nor receive. What is
drawn is a function of the seed, the number of the exchange, the sender and the receiver: the luck of none depends on who else there
is.

References
----------
.. [1] Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 39(5), 1960.
.. [2] Elliott, "Estimates of error rates for codes on burst-noise channels", Bell System Technical Journal 42(5), 1963.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from trainctl import draws
from trainctl.kernels import bare
from trainctl.signals import Bools, Floats, Ints, Links, Messages
from trainctl.topology.graph import reach

#: An exponential delay is cut off at so many of its means.
CUT_OFF = 5.0

#: Row of ``Messages.bad``: it is not known yet in which state a channel is.
UNKNOWN = -1


class Radio(NamedTuple):
    """How messages travel. They are in a frame that moves with the reference, so old ones do not lag behind."""

    loss: float  # in good times
    delay: int  # exchange periods
    radius: float
    key: Ints  # (n, 2) words of the seed of each train's run: see ``draws.key``
    names: Ints  # (n,) a word for each train: see ``draws.word``
    bad_loss: float = 1.0
    turns_bad: float = 0.0  # probability from one exchange to the next
    turns_good: float = 1.0
    spread: float = 0.0  # exchange periods, of the random delay: width, or mean if exponential
    exponential: bool = False
    beyond: float = -1.0  # m, a train sends once its place is off by more; below 0: in every exchange
    silent: int = 0  # exchanges after which it sends anyhow; 0: never
    outages: Floats = np.zeros((0, 3))  # train (-1: all), begin and end [s]

    @property
    def oldest(self) -> int:
        """Maximum age of a message on arrival, in exchange periods."""
        return self.delay + math.ceil(self.spread * (CUT_OFF if self.exponential else 1.0))

    def out(self, t: float, trains: int) -> Bools:
        """Trains (n,) whose radio is out at ``t`` [s]."""
        out = np.zeros(trains, bool)
        for train, begin, end in self.outages.tolist():
            if begin <= t + 1e-9 < end:
                out[slice(None) if train < 0 else int(train)] = True
        return out


def silent() -> Messages:
    """Nothing sent, nothing received."""
    none = np.zeros(0, np.int64)
    return Messages((), np.zeros((0, 0)), np.zeros(0, bool), none, none, (), np.zeros(0), none, np.zeros(2, np.int64))


def relinked(messages: Messages, before: Links | None, now: Links) -> Messages:
    """Carry what old links brought over to the new edge list; a new link has brought nothing yet."""
    rows = len(now.sender)
    heard, ever = np.zeros((rows, messages.heard.shape[1])), np.zeros(rows, bool)
    newest, bad = np.full(rows, -1), np.full(rows, UNKNOWN)
    if before is not None:
        old, new = (k.sender * len(k.slot) + k.receiver for k in (before, now))
        _, was, row = np.intersect1d(old, new, assume_unique=True, return_indices=True)
        heard[row], ever[row] = messages.heard[was], messages.ever[was]
        if len(messages.newest) == len(old):
            newest[row], bad[row] = messages.newest[was], messages.bad[was]
    return messages._replace(heard=heard, ever=ever, newest=newest, bad=bad)


def deliver(
    radio: Radio, messages: Messages, sent: Floats, position: Floats, links: Links, count: int, t: float, place: Floats
) -> tuple[Messages, Bools]:
    """Send what every train says as one exchange.

    Parameters
    ----------
    radio : Radio
        How messages travel.
    messages : Messages
        Before; left as it is.
    sent : ndarray, shape (n, w)
        What every train says, if it sends.
    position : ndarray, shape (n,)
        Where every train believes to be [m].
    links : Links
        Who receives from whom.
    count : int
        Number of the exchange.
    t : float
        Now [s].
    place : ndarray, shape (n,)
        Where every train believes to be relative to its reference [m].

    Returns
    -------
    Messages
        ``heard`` (L, w) holds what each link brought last.
    ndarray of bool, shape (L,)
        Which links received now.
    """
    rows, n = len(links.sender), len(sent)
    known = len(messages.newest) == rows and messages.heard.shape == (rows, sent.shape[1])  # the first message fixes the width
    heard = messages.heard if known else np.zeros((rows, sent.shape[1]))
    ever = messages.ever if len(messages.ever) == rows else np.zeros(rows, bool)
    newest, bad = (messages.newest, messages.bad) if known else (np.full(rows, -1), np.full(rows, UNKNOWN))
    out = radio.out(t, n)
    spoke, said, quiet = _who_sends(radio, messages, place, out)
    under_way = (*messages.sent, sent)[-radio.oldest - 1 :]
    who = (*messages.spoke, spoke)[-radio.oldest - 1 :]
    reaches = reach(position, links, radio.radius) if math.isfinite(radio.radius) else np.zeros(0, bool)
    now_heard, now_ever, now_newest = np.empty_like(heard), np.empty(rows, bool), np.empty(rows, np.int64)
    arrives = np.empty(rows, bool)
    if radio.turns_bad > 0.0:
        bad = bad.copy()
    came = _arrive(
        radio.loss, radio.bad_loss, radio.turns_bad, radio.turns_good, radio.delay, radio.spread, radio.exponential, radio.key,
        radio.names, links.sender, links.receiver, count, _oldest_first(under_way), _oldest_first(who), out, reaches, bad,
        heard, ever, newest, now_heard, now_ever, now_newest, arrives,
    )  # fmt: skip
    counted = messages.counted.copy()
    counted[0] += np.count_nonzero(spoke)
    counted[1] += came
    return Messages(under_way, now_heard, now_ever, now_newest, bad, who, said, quiet, counted), arrives


def _oldest_first(rows: Sequence[Any]) -> Any:
    """The same as one array; of a single one, which is what there is without delays, nothing is copied."""
    return np.array(rows) if len(rows) > 1 else np.ascontiguousarray(rows[0])[None]


def _who_sends(radio: Radio, messages: Messages, place: Floats, out: Bools) -> tuple[Bools, Floats, Ints]:
    """Who sends now; the place each sent last, and for how many exchanges it has been silent, (n,) each."""
    if radio.beyond < 0.0:
        return ~out, messages.said, messages.quiet
    n = len(place)
    said = messages.said if len(messages.said) == n else np.full(n, np.nan)
    quiet = (messages.quiet if len(messages.quiet) == n else np.zeros(n, np.int64)) + 1
    due = ~(np.abs(place - said) <= radio.beyond)
    if radio.silent:
        due |= quiet >= radio.silent
    due &= ~out
    return due, np.where(due, place, said), np.where(due, 0, quiet)


@bare
def _arrive(
    loss: float, bad_loss: float, turns_bad: float, turns_good: float, delay: int, spread: float, exponential: bool, key: Ints,
    names: Ints, sender: Ints, receiver: Ints, count: int, sent: Floats, spoke: Bools, out: Bools, reaches: Bools, bad: Ints,
    heard: Floats, ever: Bools, newest: Ints, now_heard: Floats, now_ever: Bools, now_newest: Ints, arrives: Bools,
) -> int:  # fmt: skip
    """Write what each link has brought by now, and whether it brings something now (L,); how many do. ``bad`` goes on in place.

    ``heard``, ``ever`` and ``newest`` are what it had brought before, as ``Messages`` has them: single arrays, since to hand over a
    tuple of them takes as long as all that is done here.

    ``sent`` (D, n, w) is what was said in the last D exchanges, oldest first, and ``spoke`` (D, n) who did send it. ``reaches`` may
    be empty: all do.
    """
    depth, came = len(spoke), 0
    draws_any = loss > 0.0 or spread > 0.0 or turns_bad > 0.0
    sure = depth == 1 and delay == 0 and not draws_any and len(reaches) == 0 and not out.any() and spoke.all()
    for k in range(len(sender)):
        s, r = sender[k], receiver[k]
        lost, age, last = loss, -1, newest[k]
        if turns_bad > 0.0:
            turn, begin = draws.uniforms(count, draws.BURST, names[s], names[r], key[r, 0], key[r, 1])
            if bad[k] < 0:
                bad[k] = begin < turns_bad / (turns_bad + turns_good)
            else:
                bad[k] = turn >= turns_good if bad[k] else turn < turns_bad
            lost = bad_loss if bad[k] else loss
        if sure:  # all links bring what is said now
            if count > last:
                age, last = 0, count
        elif not (out[s] or out[r]) and (len(reaches) == 0 or reaches[k]):
            for a in range(delay, depth):
                number = count - a
                if number <= last:
                    break
                if not spoke[depth - 1 - a, s]:
                    continue
                takes = delay
                if lost > 0.0 or spread > 0.0:
                    drawn, longer = draws.uniforms(number + delay, draws.LOSS, names[s], names[r], key[r, 0], key[r, 1])
                    if spread > 0.0:
                        more = min(-math.log(1.0 - longer), CUT_OFF) if exponential else longer
                        takes += math.ceil(spread * more)
                    if takes != a or drawn < lost:
                        continue
                elif takes != a:
                    continue
                age, last = a, number
                break
        now_newest[k], arrives[k], now_ever[k] = last, age >= 0, ever[k] or age >= 0
        if age >= 0:
            came += 1
            for c in range(sent.shape[2]):
                now_heard[k, c] = sent[depth - 1 - age, s, c]
        else:
            for c in range(sent.shape[2]):
                now_heard[k, c] = heard[k, c]
    return came
