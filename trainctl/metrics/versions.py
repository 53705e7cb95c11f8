"""Which definitions the numbers of a run were computed by."""

from __future__ import annotations

from trainctl.metrics.run import metrics
from trainctl.metrics.values import Values
from trainctl.runs.run import Run

#: What changed in the definitions, by version; a run says in metrics.json by which its numbers were computed.
CHANGES: dict[int, str] = {
    1: "The first ones; runs that state no version have them.",
    2: "`formation.settling_s` is a time of the run, no longer counted from the first link; `formation.last_link_s` is new."
    " `traffic.gap_min_m` is negative where trains overlap, also between two rows. `punctuality.*` are new;"
    " `traffic.sumo_depart_delay_mean_s` is gone, and the other `traffic.sumo_*` count only trips that arrived.",
}

#: The definitions of ``metrics.run.DEFINITIONS``.
VERSION = max(CHANGES)


def current(run: Run) -> Values:
    """The metrics of a run by the present definitions: as they stand in its folder, or computed anew from its logs."""
    return run.metrics if run.definitions == VERSION else metrics(run)
