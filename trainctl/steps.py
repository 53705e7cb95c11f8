"""What a run is driven by, step by step to its end: the closed loop, or the record of trains that drive themselves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from trainctl.scenario.model import Model
from trainctl.stages.record import Journal, Record


class Steps(ABC):
    """One run. ``state`` is where it stands: a named tuple with ``k``, the steps done, and ``watch``, what has been broken.

    Parameters
    ----------
    model : Model
        The scenario as arrays.
    journal : Journal
        Where rows and events go.
    """

    state: Any

    def __init__(self, model: Model, journal: Journal) -> None:
        self.p, self.journal, self.record = model, journal, Record(model, journal)
        self.not_entered = 0
        self.between: Callable[[], Any] | None = None  # called after every step

    @property
    def k(self) -> int:
        """Steps done."""
        return int(self.state.k)

    @property
    def time(self) -> float:
        """Scenario time of the present state [s]."""
        return self.k * self.p.scenario.run.step_s

    @property
    def over(self) -> bool:
        """Whether no step is left."""
        return self.k >= self.p.scenario.run.steps

    def step(self) -> None:
        """One simulator step."""
        self.state = self.after(self.state)
        if self.between is not None:
            self.between()

    @abstractmethod
    def after(self, s: Any) -> Any:
        """The state a step later."""

    @abstractmethod
    def end(self) -> None:
        """The last instant, which nothing acts on."""

    @abstractmethod
    def outcome(self) -> dict[str, Any]:
        """What run.json says of the finished run."""

    def run(self, progress: Callable[[int, int], Any] | None = None) -> None:
        """All steps; ``progress(done, steps)`` is called about a hundred times."""
        steps = self.p.scenario.run.steps
        every = max(1, steps // 100)
        while not self.over:
            self.step()
            if progress is not None and self.k % every == 0:
                progress(self.k, steps)
        self.end()

    def counted(self, collisions: Sequence[Mapping[str, Any]]) -> Iterator[tuple[float, dict[str, Any]]]:
        """Time [s] and fields of events for collisions of the simulator's that were not told before."""
        return self.record.alarms.counted(self.time, collisions, self.state.watch.alarms)
