"""Large arrays as buffers: work on each of their numbers, rows or matrices is a sweep, which machine code runs in loops.

Straight code for thousands of numbers takes long to compile. The nodes of a large array are picks, each of one place of its buffer.
Code that needs a single number reads it there.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from tailgate.engine.graph import Graph, Node, Piece, Source
from tailgate.engine.operations import Array

WIDE = 128  # numbers from which an array is a buffer
SHORT = 3  # numbers that are stored one by one
_inside: list[Graph] = []  # graphs that trace the body of a sweep, in which no array is a buffer


def wide(graph: Graph, *arrays: Array, size: int = 0) -> bool:
    """Return True if an elementwise function of these arrays, or an array of `size` made from them, becomes a buffer."""
    made = math.prod(common_shape(*arrays))
    return max(size, made) >= WIDE and graph not in _inside and not all(_fixed(a) for a in arrays)


def common_shape(*arrays: Array) -> tuple[int, ...]:
    """Return the shape that arrays broadcast to; tracing asks for it often, and most arrays are alike."""
    first = arrays[0].shape if arrays else ()
    return first if all(a.shape == first for a in arrays) else np.broadcast_shapes(*(a.shape for a in arrays))


def _fixed(nodes: Array) -> bool:
    return all(node.fixed for node in nodes.flat)


@contextlib.contextmanager
def _body(graph: Graph) -> Iterator[None]:
    _inside.append(graph)
    try:
        yield
    finally:
        _inside.remove(graph)


def swept(graph: Graph, function: Callable[..., Any], lead: Sequence[int], arrays: Sequence[Array], nested: bool = False) -> Array:
    """Apply a function to the trailing axes of arrays of nodes, for each index of their leading axes.

    Parameters
    ----------
    function : of arrays of nodes, or of single nodes where no axis is left; returns the same
    lead : the shape that the leading axes broadcast to
    arrays : arrays of nodes (*lead, ...)
    nested : the function may make buffers itself

    Returns
    -------
    Nodes (*lead, ...).
    """
    n = len(lead)
    held = [a[(None,) * (n - a.ndim)] if a.ndim < n else a for a in arrays]
    held = [a[tuple(slice(1) if a.strides[i] == 0 or a.shape[i] == 1 else slice(None) for i in range(n))] for a in held]
    found = [a if a.size == 1 or a.shape[:n] == (1,) * n or _alike(a) else _source(graph, a) for a in held]
    kept = [i for i in range(n) if lead[i] > 1]
    carried: list[Node] = []
    sources: list[Source] = []
    given = []
    for nodes, source in zip(held, found, strict=True):
        rest = nodes.shape[n:]
        if not isinstance(source, Source):
            given.append(_of_one(nodes[(0,) * n] if nodes.shape[:n] == (1,) * n else nodes.ravel()[0], rest))
            continue
        those = np.empty(rest, object)
        for place in np.ndindex(*rest):
            at = source.offset + sum(i * s for i, s in zip(place, source.strides[n:], strict=True))
            one = nodes[(*(0,) * n, *place)]
            those[place] = new = graph.carried(boxed(one)).item()
            carried.append(new)
            sources.append(Source(source.held, at, tuple(source.strides[i] if nodes.shape[i] > 1 else 0 for i in kept)))
        given.append(those if rest else those.item())
    with contextlib.nullcontext() if nested else _body(graph):
        result = function(*given)
    made = result if isinstance(result, np.ndarray) else boxed(result)
    shape, sources = _fewer([lead[i] for i in kept], sources)
    buffer = graph.sweep(shape, carried, sources, list(made.flat))
    return graph.picks(buffer).copy().reshape(*lead, *made.shape)  # code may write to it


def boxed(node: object) -> Array:
    """Return an array without axes that holds one node."""
    out = np.empty((), object)
    out[()] = node
    return out


def _of_one(nodes: Array | Node, rest: tuple[int, ...]) -> Array | Node:
    """Return nodes that no round changes as an array of the trailing axes."""
    return np.broadcast_to(boxed(nodes), rest) if rest and isinstance(nodes, Node) else nodes


def _alike(nodes: Array) -> bool:
    first = nodes.flat[0]
    return all(node is first for node in nodes.flat)


def _source(graph: Graph, nodes: Array) -> Source:
    """Return the place of an array's numbers with a stride per axis; copy them to one buffer if they have none."""
    if found := _strided(nodes):
        return found
    return Source(graph.packed(tuple(_pieces(nodes)), nodes.flat[0].dtype), 0, steps(nodes.shape))


def steps(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the strides of contiguous numbers."""
    return tuple(int(np.prod(shape[i + 1 :], dtype=int)) for i in range(len(shape)))


def _strided(nodes: Array) -> Source | None:
    """Return the place of an array's numbers if they are all fixed, or in one buffer with strides; else None."""
    first = nodes.flat[0]
    if _fixed(nodes):
        return Source(tuple(nodes.flat), 0, steps(nodes.shape))
    if not (is_pick(first) and all(is_pick(node) and node.args[0] is first.args[0] for node in nodes.flat)):
        return None
    places = np.array([node.attr for node in nodes.flat]).reshape(nodes.shape)
    strides = [int(places.take(1, i).flat[0]) - first.attr if n > 1 else 0 for i, n in enumerate(nodes.shape)]
    straight = first.attr + sum(np.arange(n).reshape(-1, *(1,) * (nodes.ndim - i - 1)) * strides[i] for i, n in enumerate(nodes.shape))
    return Source(first.args[0], first.attr, tuple(strides)) if np.array_equal(straight, places) else None


def _pieces(nodes: Array) -> Iterator[Piece]:
    """Yield an array as few parts with strides."""
    if found := _strided(nodes):
        yield Piece(found, nodes.shape)
    elif nodes.ndim > 1:
        for part in nodes:
            yield from _pieces(part)
    else:
        for part in _runs(nodes):
            found = _strided(part) if len(part) > SHORT else None
            yield from [Piece(found, part.shape)] if found else [Piece(node) for node in part]


def _runs(nodes: Array) -> list[Array]:
    """Split an array of one axis where its origin or stride changes."""
    origin = np.array([node.args[0].id if is_pick(node) else -1 - i for i, node in enumerate(nodes)])
    place = np.array([node.attr if is_pick(node) else 0 for node in nodes])
    cuts, begin = [], 0
    for i in range(1, len(nodes)):
        if origin[i] != origin[i - 1] or (i - begin > 1 and place[i] - place[i - 1] != place[i - 1] - place[i - 2]):
            cuts.append(i)
            begin = i
    return np.split(nodes, cuts)


def is_pick(node: Node) -> bool:
    """Return True if the node is a number of a buffer in machine code."""
    return node.op == "pick" and node.args[0].size > 0 and not node.fixed


def _fewer(shape: list[int], sources: list[Source]) -> tuple[tuple[int, ...], list[Source]]:
    """Merge neighbouring axes that are contiguous in all sources."""
    strides = [list(source.strides) for source in sources]
    for i in reversed(range(len(shape) - 1)):
        if all(s[i] == s[i + 1] * shape[i + 1] for s in strides):
            shape[i : i + 2] = [shape[i] * shape[i + 1]]
            for s in strides:
                del s[i]
    return tuple(shape), [Source(source.held, source.offset, tuple(s)) for source, s in zip(sources, strides, strict=True)]


def buffer_of(graph: Graph, nodes: Array) -> Node:
    """Return a buffer that holds the numbers of an array contiguously."""
    source = _source(graph, nodes.ravel())
    if isinstance(source.held, Node) and source.held.size == nodes.size and source.offset == 0 and source.strides[0] == 1:
        return source.held
    if isinstance(source.held, Node) and source.held.op == "pack":
        return source.held
    return _copied(graph, nodes.ravel())


def table_of(graph: Graph, nodes: Array) -> Node:
    """Return the buffer of fixed nodes, which is fixed too and not part of the machine code."""
    return graph.packed((Piece(Source(tuple(nodes.flat), 0, (1,)), (nodes.size,)),), nodes.flat[0].dtype)


def copied(graph: Graph, buffer: Node) -> Node:
    """Return a copy of a buffer."""
    return _copied(graph, graph.picks(buffer))


def _copied(graph: Graph, nodes: Array) -> Node:
    made: Node = swept(graph, lambda node: node, nodes.shape, [nodes]).flat[0].args[0]
    if _fixed(nodes):
        graph.copies[made.id] = nodes
    return made


def blended(graph: Graph, where: Node, x: Array, y: Array) -> Array:
    """Return the array x where `where` is true, else y."""
    return graph.picks(graph.blend(where, buffer_of(graph, x), buffer_of(graph, y))).copy().reshape(x.shape)


def sides(graph: Graph, nodes: Array) -> tuple[Node, Array, Array] | None:
    """Return (mask, x, y) if one mask selects the whole array from x and y, of which one is constant; else None."""
    first = nodes.flat[0]
    if first.op == "select" and all(node.op == "select" and node.args[0] is first.args[0] for node in nodes.flat):
        held = [_map(lambda node, i=i: node.args[i], nodes) for i in (1, 2)]  # type: ignore[misc]
    elif is_pick(first) and first.args[0].op == "blend" and _strided(nodes) == Source(first.args[0], 0, steps(nodes.shape)):
        first = first.args[0]
        held = []
        if first.size == nodes.size:
            both = [graph.copies[side.id] if side.id in graph.copies else graph.picks(side) for side in first.args[1:]]
            held = [side.reshape(nodes.shape) for side in both]
    else:
        return None
    return (first.args[0], *held) if any(_fixed(side) for side in held) else None


def _map(function: Callable[[Node], Node], nodes: Array) -> Array:
    out = np.empty(nodes.shape, object)
    out[...] = np.frompyfunc(function, 1, 1)(nodes)
    return out
