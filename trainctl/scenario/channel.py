"""``[channel]``: what the radio does to messages beyond the loss and delay of ``[topology]``, and when trains send at all."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from trainctl.scenario.keys import NotNegative, Positive
from trainctl.signals import Table

Share = Annotated[float, Field(ge=0, le=1)]


class Channel(Table):
    """[channel]: bursts, random delays, and sending by events. Each link has a channel of its own."""

    good_s: Positive | None = Field(
        None, description="Mean length of good times [s]: with bad_s the channel has two states (Gilbert-Elliott); default one."
    )
    bad_s: Positive | None = Field(None, description="Mean length of bad times [s].")
    bad_loss: Share | None = Field(
        None, description="Probability that a message is lost in bad times, default 1; in good ones it is topology.loss."
    )
    delay_spread_s: NotNegative = Field(
        0.0,
        description="Random delay on top of topology.delay_s: width if uniform, mean if exponential (up to five means) [s].",
    )
    delay_shape: Literal["uniform", "exponential"] = Field("uniform", description="How the random delay is distributed.")
    send_beyond_m: Positive | None = Field(
        None,
        description="A train sends only once its position relative to the reference is off by more than this from what it sent last"
        " [m]; default: in every exchange.",
    )
    send_every_s: Positive | None = Field(
        None, description="With send_beyond_m: it sends at least this often [s]; default: no such limit."
    )

    @model_validator(mode="after")
    def _together(self) -> Channel:
        if (self.good_s is None) != (self.bad_s is None):
            raise ValueError("good_s and bad_s: give both or none")
        if self.bad_s is None and self.bad_loss is not None:
            raise ValueError(f"bad_loss = {self.bad_loss:g}: only with good_s and bad_s")
        if self.send_every_s is not None and self.send_beyond_m is None:
            raise ValueError(f"send_every_s = {self.send_every_s:g}: only with send_beyond_m")
        return self

    @property
    def random(self) -> str:
        """The key that makes it random; "" if none does."""
        return "bad_s" if self.bad_s is not None else "delay_spread_s" if self.delay_spread_s > 0.0 else ""

    @property
    def usual(self) -> bool:
        """Whether it says nothing."""
        return self == Channel()

    def too_short(self, period: float) -> list[str]:
        """Times that no exchange can tell; ``period`` [s] is that of the exchanges."""
        known = {key: getattr(self, key) for key in ("good_s", "bad_s", "send_every_s")}
        return [
            f"channel.{key} = {value:g}: must be at least the exchange period of {period:g} s"
            for key, value in known.items()
            if value is not None and value < period - 1e-9
        ]


def exchanges(seconds: float, period: float) -> int:
    """So many exchanges until at least ``seconds`` have passed."""
    return math.ceil(seconds / period - 1e-9)
