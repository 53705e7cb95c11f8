"""Closed-loop testbed for cooperative train control on real rail networks, over SUMO.

In Python: ``trainctl.run``, ``trainctl.open`` and ``trainctl.Simulation``; see ``trainctl.api``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from trainctl.api import Run, Simulation, open, run

__all__ = ["Run", "Simulation", "open", "run"]


def __getattr__(name: str) -> Any:
    """Load what a notebook needs only when it is asked for: the command line stays light."""
    if name in __all__:
        from trainctl import api

        return getattr(api, name)
    raise AttributeError(f"module trainctl has no attribute {name}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
