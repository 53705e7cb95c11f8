"""Messages between trains: range, seeded loss and delay act on links; what a lost message does is each law's own rule."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np

from trainctl.signals import Bools, Floats, Links
from trainctl.topology.graph import reach

#: Stream of the run's seed that decides which messages are lost.
LOSS_STREAM = 1


@dataclass
class Exchange:
    """The air: what was sent, and what each link brought last.

    ``delay`` counts exchange periods. Messages are in a frame that moves with the reference, so old ones do not lag behind.
    """

    loss: float
    delay: int
    radius: float
    seed: int
    sent: deque[Floats] = field(default_factory=deque)
    heard: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    ever: Bools = field(default_factory=lambda: np.zeros(0, bool))

    def copy(self) -> Exchange:
        """The same at this moment, to come back to."""
        return replace(self, sent=self.sent.copy(), heard=self.heard.copy(), ever=self.ever.copy())

    @property
    def perfect(self) -> bool:
        """Nothing is ever lost, late or out of reach."""
        return self.loss == 0.0 and self.delay == 0 and np.isinf(self.radius)

    def relink(self, before: Links | None, now: Links) -> None:
        """Carry what old links brought over to the new edge list; a new link has brought nothing yet."""
        heard, ever = np.zeros((len(now.sender), self.heard.shape[1])), np.zeros(len(now.sender), bool)
        if before is not None:
            old, new = (k.sender * len(k.slot) + k.receiver for k in (before, now))
            _, was, row = np.intersect1d(old, new, assume_unique=True, return_indices=True)
            heard[row], ever[row] = self.heard[was], self.ever[was]
        self.heard, self.ever = heard, ever

    def deliver(self, sent: Floats, position: Floats, links: Links, count: int) -> Bools:
        """Send what every train says, ``sent`` (n, w), as exchange number ``count``; returns which links heard, shape (L,).

        ``self.heard`` (L, w) then holds what each link brought last. Losses are a function of (seed, count) alone.
        """
        if self.heard.shape != (len(links.sender), sent.shape[1]):  # the first message tells its width
            self.heard = np.zeros((len(links.sender), sent.shape[1]))
        if len(self.ever) != len(links.sender):
            self.ever = np.zeros(len(links.sender), bool)
        self.sent.append(sent)
        if len(self.sent) > self.delay + 1:
            self.sent.popleft()
        if len(self.sent) <= self.delay:
            return np.zeros(len(links.sender), bool)  # the first messages are still under way
        arrives = np.ones(len(links.sender), bool)
        if np.isfinite(self.radius):
            arrives &= reach(position, links, self.radius)
        if self.loss > 0.0:
            arrives &= np.random.default_rng([self.seed, LOSS_STREAM, count]).random(len(arrives)) >= self.loss
        np.copyto(self.heard, self.sent[0][links.sender], where=arrives[:, None])
        self.ever |= arrives
        return arrives
