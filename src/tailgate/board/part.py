"""Base class and common fields of the nouns of a board's formats."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from tailgate.core.threat import KNOWLEDGE, Knowledge

Level = Knowledge
LEVELS: tuple[Level, ...] = KNOWLEDGE  # what an attacker knows, from the least
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Share = Annotated[float, Field(strict=True, ge=0.0, le=1.0)]
Text = Annotated[str, Field(strict=True)]
Count = Annotated[int, Field(strict=True, ge=0)]
Dose = Count | None  # None: the scenario's own budget
Data = dict[str, Any]  # JSON data of a board, or of a part of it


class Part(BaseModel):
    """A part of a format; fields that it does not name are let through."""

    model_config = ConfigDict(extra="allow", strict=True)
