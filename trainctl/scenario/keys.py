"""Kinds of values that keys of a scenario have."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

#: Integers of TOML and of our tables have 64 bits.
MOST_SEED = 2**63 - 1


def _name(value: Any) -> Any:
    """Ids are text; a number may stand for one."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Id = Annotated[str, BeforeValidator(_name, json_schema_input_type=int | str)]
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]
PerUnit = float | tuple[float, ...]
