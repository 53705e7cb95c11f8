"""What happens at a time or place: ``[[event]]`` and ``[[order]]`` of a scenario."""

from __future__ import annotations

from collections import Counter
from typing import Literal

from pydantic import Field, field_validator, model_validator

from trainctl.scenario.keys import Id, NotNegative, Positive
from trainctl.signals import Table


class Event(Table):
    """[[event]]: something that happens at a time or place."""

    kind: Literal["reroute", "brake", "outage"] = Field(
        description="reroute: the train takes a crossover to another track and stays there. brake: it brakes on its own. outage: "
        "its radio neither sends nor receives."
    )
    train: Id = Field(description="The train; for an outage also all.")
    crossover: str | None = Field(
        None, description="Id of the crossover (see `trainctl net show`); default: the next one to to_track."
    )
    to_track: Id | None = Field(None, description="Track to change to, if no crossover is named.")
    to_edge: str | None = Field(
        None,
        description="Edge of the net to go to by the shortest path; from there the train goes on to its former destination"
        " if it can.",
    )
    deceleration_mps2: Positive | None = Field(
        None, description="brake: deceleration, as far as its plant can [m/s2]; default full braking, [supervisor] emergency_mps2."
    )
    until_s: Positive | None = Field(
        None, description="brake: from then on its law drives it again [s], default never; outage: when it is over [s]."
    )
    time_s: NotNegative = Field(
        0.0, description="When it is ordered at the earliest [s]; a train that is rerouted changes track when it gets there."
    )
    position_m: float | None = Field(None, description="... once its front has passed this position [m].")
    gap_below_m: Positive | None = Field(None, description="... once its gap to the train ahead is below this [m].")
    speed_below_mps: Positive | None = Field(None, description="... once its speed is below this [m/s].")

    @model_validator(mode="after")
    def _of_its_kind(self) -> Event:
        ways, conditions = ("crossover", "to_track", "to_edge"), ("position_m", "gap_below_m", "speed_below_mps")
        given = [key for key in (*ways, *conditions, "deceleration_mps2", "until_s") if getattr(self, key) is not None]
        known = {"reroute": (*ways, *conditions), "brake": (*conditions, "deceleration_mps2", "until_s"), "outage": ("until_s",)}
        if strange := [key for key in given if key not in known[self.kind]]:
            raise ValueError(f"{', '.join(strange)}: not with kind = {self.kind}")
        if self.kind == "reroute" and len([key for key in given if key in ways]) != 1:
            raise ValueError("give exactly one of crossover, to_track, to_edge")
        if self.kind == "outage" and self.until_s is None:
            raise ValueError("an outage needs until_s")
        if self.until_s is not None and self.until_s <= self.time_s:
            raise ValueError(f"until_s = {self.until_s:g}: must be after time_s = {self.time_s:g}")
        return self

    @property
    def of_all(self) -> bool:
        """Whether it is of all trains."""
        return self.kind == "outage" and self.train == "all"


class Order(Table):
    """[[order]]: in which order trains pass an edge, whoever is there first."""

    edge: str = Field(description="Edge of the net; an order holds on the same track in the other direction, too.")
    trains: tuple[Id, ...] = Field(min_length=2, description="The trains, the first one first; others may pass between them.")

    @field_validator("trains")
    @classmethod
    def _once(cls, trains: tuple[Id, ...]) -> tuple[Id, ...]:
        twice = sorted(i for i, count in Counter(trains).items() if count > 1)
        if twice:
            raise ValueError(f"{', '.join(twice)} appears more than once")
        return trains
