"""What the tests of the loop's stages share: scenarios that are prepared but not run, a journal in memory, and views made by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nets
import numpy as np
import tomli_w

from trainctl.loop import Loop
from trainctl.numeric import Numeric
from trainctl.railway import supervisor
from trainctl.railway.along import Ahead
from trainctl.railway.authority import View
from trainctl.railway.supervisor import Limits, Targets
from trainctl.record.columns import Call
from trainctl.scenario.build import open_scenario
from trainctl.scenario.model import Model
from trainctl.signals import POSITION, SPEED, Bools, Floats, Formed, Seen
from trainctl.stages.traffic import Around


class Told(list[tuple[str, dict[str, Any]]]):
    """A journal of events, as (kind, fields)."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[int, Call, int]] = []

    def event(self, time: float, kind: str, **fields: Any) -> None:
        """One event."""
        self.append((kind, {"time_s": time, **fields}))

    def write(self, row: Any) -> None:
        """One instant; the last one is kept."""
        self.row = row

    def call(self, train: int, call: Call, edge: int) -> None:
        """One stop; all are kept."""
        self.calls.append((train, call, edge))

    def kinds(self) -> list[tuple[str, str]]:
        """Kind and train of every event."""
        return [(kind, fields.get("train", "")) for kind, fields in self]


def prepared(folder: Path, law: str, **changes: Any) -> Model:
    """The scenario of ``a.sumocfg`` in ``folder`` under a law."""
    (folder / "s.toml").write_text(tomli_w.dumps(nets.scenario(law, 100, **changes)))
    return open_scenario(str(folder / "s.toml"))


def started(p: Model) -> tuple[Loop, Told]:
    """A loop whose trains have been put on the railway, and what it told."""
    told = Told()
    return Loop(p, Numeric(p.line), told), told  # type: ignore[arg-type]


def view(
    ahead: list[int],
    spacing: list[float],
    limits: Limits | None = None,
    targets: Targets | None = None,
    clear: Targets | None = None,
) -> View:
    """What is ahead of trains that nothing else is in the way of."""
    n, targets = len(ahead), supervisor.no_targets() if targets is None else targets
    return View(
        Ahead(np.array(ahead), np.array(spacing)), targets, targets if clear is None else clear,
        supervisor.no_limits() if limits is None else limits, np.full(n, np.inf), np.full(n, -1), np.zeros(n, bool),
    )  # fmt: skip


def target(train: int, room: float, speed: float, kind: int, moving: bool = False, other: int = -1) -> Targets:
    """One thing ahead of one train."""
    return Targets(*(np.array([x]) for x in (train, room, speed, moving, kind, other)))


def around(view: View, stops: tuple[list[int], list[float]] = ([], []), soon: Bools | None = None) -> Around:
    """An instant at which nobody comes."""
    n = len(view.ahead.train)
    where = np.array(stops[0], np.int64), np.array(stops[1])
    return Around((), where, np.zeros(n, bool) if soon is None else soon, None, {}, view)


def side_by_side(p: Model, spacings: list[float], speed: float) -> tuple[Seen, Floats]:
    """Every train on the net, each so far behind the one before."""
    own, n = p.own.copy(), len(p.scenario.ids)
    own[p.leading, POSITION], own[:, SPEED] = -np.cumsum([0.0, *spacings]), speed
    nowhere = np.zeros(n, np.int64)
    return Seen(own[p.leading, POSITION].copy(), nowhere, nowhere, np.ones(n, bool)), own


def chained(formed: Formed, ahead: list[int]) -> Formed:
    """The same trains in these chains; ``ahead`` is the train each is coupled to."""
    from trainctl.stages.convoys import led
    from trainctl.topology.convoys import fronts

    coupled = np.array(ahead)
    return formed._replace(ahead=coupled, led=led(coupled), formation=fronts(coupled))
