"""Indices of traced arrays, without traced parts."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.engine.operations import BOOL
from tailgate.engine.untraceable import Untraceable

if TYPE_CHECKING:
    from tailgate.engine.array import Traced

ALL = (slice(None), slice(0, None), slice(None, None, 1), slice(0, None, 1))


def known_index(part: Traced) -> Any:
    """Return a part of an index as plain numbers; a number shows a view, as in numpy, and an array a copy."""
    if part.dtype == BOOL:
        return part.known("rows of a mask", "write np.where(mask, x, y) for all rows")
    found = part.known("an index", "write num.take(x, index)")
    return found if found.ndim else operator.index(found[()])


def check_whole(x: Traced, key: tuple[Any, ...], written: bool = False) -> None:
    """Raise Untraceable for a slice that takes some of the episodes, or in another order, or for one episode that is `written` to."""
    batch = 0 if written and x.batch is None and x.ndim > 1 and x.shape[0] == 1 else x.batch  # of np.zeros((len(y), 3)), maybe
    if batch is None:
        return
    parts = [part for part in key if part is not None]
    wide = [0 if part is Ellipsis else np.ndim(part) if getattr(part, "dtype", None) == BOOL else 1 for part in parts]
    axis = 0
    for part, size in zip(parts, wide, strict=True):
        size = x.ndim - sum(wide) if part is Ellipsis else size
        one = written and isinstance(part, (int, np.integer)) and not isinstance(part, bool)
        if axis <= batch < axis + size and (one or (isinstance(part, slice) and part not in ALL)):
            raise Untraceable("some of the episodes, or another order of them", "write it for all rows")
        axis += size
