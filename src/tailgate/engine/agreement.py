"""What is not traced, and why; and when two engines agree."""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tailgate.engine.graph import Array
from tailgate.engine.untraceable import Untraceable


class Untraced(NamedTuple):
    """Why the plain loop plays what somebody asked the engine for."""

    why: str


def explained(error: Exception) -> str:
    """What a failure says, and where: the line of the code that is traced."""
    if isinstance(error, Untraceable):
        return str(error)
    steps = traceback.extract_tb(error.__traceback__)
    own = [step for step in steps if not step.filename.startswith(str(Path(__file__).parent)) and "/numpy/" not in step.filename]
    place = f"{own[-1].filename}:{own[-1].lineno}: " if own else ""
    return f"{place}{type(error).__name__}: {' '.join(str(error).split())[:300]}"


def same(got: Array, wanted: Array) -> bool:
    """Equal to the bit, NaN's sign and payload apart."""
    if got.dtype != wanted.dtype or got.shape != wanted.shape or not np.array_equal(got, wanted, equal_nan=got.dtype.kind == "f"):
        return False
    return got.dtype.kind != "f" or bool(((np.signbit(got) == np.signbit(wanted)) | (got != got)).all())
