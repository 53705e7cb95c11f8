"""Who receives from whom from now on, and the law's constants for it; made anew only when a formation changed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from trainctl.scenario.model import Model
from trainctl.signals import Floats, Formed, Links, Messages, Scene, Seen
from trainctl.stages.convoys import Convoys
from trainctl.stages.record import Journal
from trainctl.stages.slots import Slots
from trainctl.stages.traffic import Around
from trainctl.stages.traffic import State as Traffic
from trainctl.topology import exchange, graph


class Sorted(NamedTuple):
    """What an instant's topology comes to."""

    rule: Any  # state of the formation rule
    formed: Formed
    messages: Messages
    own: Floats  # (U, s), moved where a train that couples is measured along another route
    seen: Seen  # with positions along the formations
    scene: Scene | None  # of the new links; None: they are the old ones


class Topology:
    """A formation rule, and what new links mean to messages and law."""

    def __init__(self, p: Model, journal: Journal) -> None:
        self.p, self.journal = p, journal
        self.rule = Slots(p, journal) if p.placed else Convoys(p, journal)

    def step(
        self, t: float, seen: Seen, own: Floats, around: Around, traffic: Traffic, rule: Any, formed: Formed, messages: Messages
    ) -> Sorted:
        """Sort the trains, and relink where something changed."""
        rule, formed, own, along, links = self.rule.step(t, seen, own, around, traffic, rule, formed)
        scene = None
        if links is not None:
            formed, messages, scene = self._relinked(t, seen, own, formed, links, messages)
        return Sorted(rule, formed, messages, own, along, scene)

    def _relinked(
        self, t: float, seen: Seen, own: Floats, formed: Formed, links: Links, messages: Messages
    ) -> tuple[Formed, Messages, Scene | None]:
        p, before, formation = self.p, formed.links, formed.formation
        formed = formed._replace(links=links)
        if before is not None:
            unheard = before._replace(heard=links.heard)  # a lost message is no change of the edge list
            if all(np.array_equal(a, b) for a, b in zip(unheard, links, strict=True)):
                return formed, messages, None
        scene = p.scene(own, links, t)
        rank = np.argsort(links.order)
        ahead = np.full(len(rank), -1)
        behind = links.order[1:][formation[links.order[1:]] == formation[links.order[:-1]]]
        ahead[behind] = links.order[rank[behind] - 1]
        formed = formed._replace(ahead=ahead, constants=p.law.constants(p.params, scene), made_of=(t, own.copy(), links))
        groups = graph.components(len(rank), links.sender, links.receiver)
        check = before is not None and self.rule.CHECKS
        self.journal.event(
            t,
            "topology",
            edges=graph.edges(links, p.scenario.ids),
            formations=[[p.scenario.ids[i] for i in sorted(group)] for group in groups if seen.present[list(group)].any()],
            start_condition=p.law.violations(p.params, scene) if check else [],
        )
        return formed, exchange.relinked(messages, before, links), scene
