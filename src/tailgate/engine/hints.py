"""Queries of plain code on a batch, which traced code answers for each episode (docs/engine.md). `tailgate.num` exports them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import cast

import numpy as np

from tailgate.base.errors import InputError
from tailgate.engine.array import Traced, chosen, lifted
from tailgate.engine.functions import gathered, picked
from tailgate.engine.loops import chosen_apart
from tailgate.engine.operations import Array, Mask


def some(mask: Array) -> bool:
    """Return True if any is true; traced code always takes the branch.

    It is a hint: the branch may be computed for all rows, and must keep the bits of rows outside the mask.
    """
    return bool(mask.values().any()) if isinstance(mask, Traced) and mask.fixed else isinstance(mask, Traced) or bool(mask.any())


def every(mask: Array) -> bool:
    """Return True if all are true; traced code never takes the branch, which may only skip work that changes no bit."""
    return bool(mask.values().all()) if isinstance(mask, Traced) and mask.fixed else not isinstance(mask, Traced) and bool(mask.all())


def elsewhere(mask: Mask, x: Array, function: Callable[..., Array], *arrays: Array) -> Array:
    """Return x (B, N, ...) where a mask (B, N) is true, else function(*arrays) of arrays (B or 1, N, ...). N may be missing.

    Plain code calls the function with the places that need it, (M, 1, ...), if any; traced code with each agent, (1, 1, ...).
    """
    mask = cast(Array, mask)
    if mask.ndim == 1:
        return elsewhere(mask[:, None], x[:, None], function, *(array[:, None] for array in arrays))[:, 0]
    if isinstance(mask, Traced) and not mask.fixed:
        return chosen_apart(mask, x, function, arrays)
    held = mask.values() if isinstance(mask, Traced) else mask
    if held.all():
        return x
    b, i = np.nonzero(~held)
    given = [array[b if len(array) > 1 else 0, i][:, None] for array in arrays]
    out = np.array(x, order="K")
    out[b, i] = function(*given)[:, 0]
    return out


def present(values: Array, candidates: Iterable[int]) -> list[int]:
    """Return the candidates that occur among whole numbers; in traced code, all candidates."""
    if isinstance(values, Traced) and not values.fixed:
        return list(candidates)
    held = set((values.values() if isinstance(values, Traced) else values).ravel().tolist())
    return [one for one in candidates if one in held]


def pick(ring: Array, place: Array) -> Array:
    """Return ring[..., place] of a ring (B, ..., L) and whole numbers from -L to L - 1 that broadcast to (B, ...)."""
    if not isinstance(ring, Traced):
        if ring.ndim == 2 and np.ndim(place) == 1:
            return ring[np.arange(len(ring)), place]
        return np.take_along_axis(ring, np.broadcast_to(place, ring.shape[:-1])[..., None], axis=-1)[..., 0]
    return picked(ring, _counted(place, ring.shape[-1]))


def put(ring: Array, place: Array, value: Array) -> Array:
    """Return the ring (B, ..., L) with `value` (B, ...) at `place`, from -L to L - 1, which broadcasts to (B, ...)."""
    if isinstance(ring, Traced):
        sent = lifted(ring.graph, value, ring.dtype).astype(ring.dtype, copy=False)
        return chosen(_counted(place, ring.shape[-1])[..., None] == np.arange(ring.shape[-1]), sent[..., None], ring, ring.dtype)
    out = ring.copy(order="K")
    if ring.ndim == 2 and np.ndim(place) == 1:
        out[np.arange(len(ring)), place] = value
        return out
    np.put_along_axis(out, np.broadcast_to(place, ring.shape[:-1])[..., None], np.asarray(value)[..., None], axis=-1)
    return out


def ring_next(place: Array, size: int) -> Array:
    """Return the index after `place` in a ring of a size."""
    return np.where(place + 1 == size, 0, place + 1)


def demand(
    condition: Array, field: str, found: str, wanted: str, k: Array, values: Array | None = None, over: Array | None = None
) -> None:  # fmt: skip
    """Raise InputError unless a condition (B, ...) holds in all rows, which are at steps k (B,). Traced code checks after its step.

    The error says what is `found`; in plain code it shows `values`, if given. Rows that are `over` (B,) are not looked at.
    """
    if not isinstance(condition, Traced) and condition.all():
        return
    rows = condition.reshape(len(condition), -1).all(axis=1)
    rows = rows if over is None else rows | over
    if isinstance(rows, Traced):
        rows.graph.demands.append((field, found, wanted, rows.nodes[0]))
    elif not rows.all() and values is not None:
        raise InputError(field, np.unique(values).tolist(), wanted)
    elif not rows.all():
        raise broken(np.asarray(~rows), field, found, wanted, k)


def broken(rows: Array, field: str, found: str, wanted: str, k: Array) -> InputError:
    """Return the error for rows (B,) bool at steps k (B,) that break a demand."""
    first = int(np.flatnonzero(rows)[0])
    where = f"{found} in step {k[first]}, in {np.count_nonzero(rows)} of {len(rows)} rows, the first of them row {first}"
    error = InputError(field, where, wanted)
    error.rows = tuple(np.flatnonzero(rows).tolist())
    return error


def _counted(place: Array, size: int) -> Array:
    """Return places counted from the first one, where negative ones count from behind the last, as numpy does."""
    if not isinstance(place, Traced) or place.dtype.kind in "ub":
        return place
    place = place.astype(np.int64, copy=False)  # a narrow number may not hold the size
    return np.where(place < 0, place + size, place)


LISTED = 8  # entries of a table that traced code compares one by one


def take(table: Array, index: Array) -> Array:
    """Return table[index] of a table (K, ...) and whole numbers from -K to K - 1."""
    if not isinstance(index, Traced):
        return table[index]
    if isinstance(index := _counted(index, len(table)), Traced) and len(table) > LISTED and not index.fixed:
        return gathered(table, index)
    wide = index[(..., *(None,) * (table.ndim - 1))]
    out: Array = np.broadcast_to(table[0], (*index.shape, *table.shape[1:]))
    for k in range(1, len(table)):
        out = np.where(wide == k, table[k], out)
    return out
