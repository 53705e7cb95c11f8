"""Messages between trains: range, seeded loss and delay act on links; what a lost message does is each law's own rule."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from trainctl import draws
from trainctl.signals import Bools, Floats, Ints, Links, Messages
from trainctl.topology.graph import reach


class Radio(NamedTuple):
    """How messages travel. They are in a frame that moves with the reference, so old ones do not lag behind."""

    loss: float
    delay: int  # exchange periods
    radius: float
    key: Ints  # (n, 2) words of the seed of each train's run: see ``draws.key``
    names: Ints  # (n,) a word for each train: see ``draws.word``


def silent() -> Messages:
    """Nothing sent, nothing received."""
    return Messages((), np.zeros((0, 0)), np.zeros(0, bool))


def relinked(messages: Messages, before: Links | None, now: Links) -> Messages:
    """Carry what old links brought over to the new edge list; a new link has brought nothing yet."""
    heard, ever = np.zeros((len(now.sender), messages.heard.shape[1])), np.zeros(len(now.sender), bool)
    if before is not None:
        old, new = (k.sender * len(k.slot) + k.receiver for k in (before, now))
        _, was, row = np.intersect1d(old, new, assume_unique=True, return_indices=True)
        heard[row], ever[row] = messages.heard[was], messages.ever[was]
    return messages._replace(heard=heard, ever=ever)


def deliver(radio: Radio, messages: Messages, sent: Floats, position: Floats, links: Links, count: int) -> tuple[Messages, Bools]:
    """Send what every train says as one exchange.

    Parameters
    ----------
    radio : Radio
        How messages travel.
    messages : Messages
        Before; left as it is.
    sent : ndarray, shape (n, w)
        What every train says.
    position : ndarray, shape (n,)
        Where every train believes to be [m].
    links : Links
        Who hears whom.
    count : int
        Number of the exchange: losses are a function of the seed, the count, the sender and the receiver.

    Returns
    -------
    Messages
        ``heard`` (L, w) holds what each link brought last.
    ndarray of bool, shape (L,)
        Which links heard now.
    """
    rows = len(links.sender)
    # the first message tells its width
    heard = messages.heard.copy() if messages.heard.shape == (rows, sent.shape[1]) else np.zeros((rows, sent.shape[1]))
    ever = messages.ever if len(messages.ever) == rows else np.zeros(rows, bool)
    under_way = (*messages.sent, sent)[-radio.delay - 1 :]
    if len(under_way) <= radio.delay:
        return Messages(under_way, heard, ever), np.zeros(rows, bool)  # the first messages are still under way
    arrives = np.ones(rows, bool)
    if np.isfinite(radio.radius):
        arrives &= reach(position, links, radio.radius)
    if radio.loss > 0.0:
        _lose(radio.loss, radio.key, radio.names, links.sender, links.receiver, count, arrives)
    np.copyto(heard, under_way[0][links.sender], where=arrives[:, None])
    return Messages(under_way, heard, ever | arrives), arrives


@njit(cache=True)
def _lose(loss: float, key: Ints, names: Ints, sender: Ints, receiver: Ints, count: int, arrives: Bools) -> None:
    """Strike out of ``arrives`` (L,) what is lost in exchange ``count``."""
    for k in range(len(arrives)):
        s, r = sender[k], receiver[k]
        drawn, _ = draws.uniforms(count, draws.LOSS, names[s], names[r], key[r, 0], key[r, 1])
        arrives[k] = arrives[k] and drawn >= loss
