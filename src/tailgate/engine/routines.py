"""Routines: elementwise functions that machine code calls, instead of repeating their code at each use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import update_wrapper
from typing import Any, TypeVar, cast

from tailgate.engine.array import Traced, each, lifted, shared_batch, typed
from tailgate.engine.buffers import boxed
from tailgate.engine.evaluation import evaluate
from tailgate.engine.graph import Graph, Node
from tailgate.engine.operations import FLOAT, ArrayLike

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(eq=False)
class Routine:
    """A function of numbers of given types, traced by itself."""

    name: str
    function: Callable[..., Any]
    graph: Graph
    inputs: list[Node]
    outputs: list[Node]
    cost: int = field(init=False)

    def __post_init__(self) -> None:
        self.cost = len(self.graph.nodes)

    def values(self, args: list[Any]) -> list[Any]:
        """Return the results by numpy."""
        return evaluate(self.graph, self.outputs, dict(zip((node.attr for node in self.inputs), args, strict=True)))


class _Called:
    """A function that becomes a routine when its arguments are traced."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self._made: dict[tuple[Any, ...], tuple[Routine, bool]] = {}
        update_wrapper(self, function)

    def __call__(self, *args: ArrayLike) -> Any:
        found = next((x for x in args if isinstance(x, Traced)), None)
        if found is None:
            return self.function(*args)
        graph = found.graph
        arrays = [lifted(graph, x, found.dtype) for x in args]
        arrays = [typed(graph, x, FLOAT) if x.dtype.kind == "f" else x for x in arrays]  # as the plain functions compute
        routine, several = self._routine(tuple(x.dtype for x in arrays))
        back, out = shared_batch(arrays), []
        for i, result in enumerate(routine.outputs):
            nodes = each(graph, lambda *nodes: graph.pick(graph.call(routine, nodes), i, result.dtype), *(x.nodes for x in arrays))  # noqa: B023
            out.append(Traced(graph, nodes, result.dtype, None if back is None else nodes.ndim + back))
        return tuple(out) if several else out[0]

    def _routine(self, dtypes: tuple[Any, ...]) -> tuple[Routine, bool]:
        if dtypes not in self._made:
            graph = Graph()
            inputs = [graph.input(i, dtype) for i, dtype in enumerate(dtypes)]
            made = self.function(*(Traced(graph, boxed(node), node.dtype) for node in inputs))
            several = isinstance(made, tuple)
            outputs = [part.nodes.item() for part in (made if several else (made,))]
            self._made[dtypes] = Routine(self.function.__name__, self.function, graph, inputs, outputs), several
        return self._made[dtypes]


def routine(function: F) -> F:
    """Decorate an elementwise function of arrays that returns an array or a tuple of them."""
    return cast(F, _Called(function))


def bound() -> str:
    """Return the text of `bound`: `step` with the address of its arguments, because Python calls it faster with one argument than eight."""
    kinds = ["ptr"] * 5 + ["i64"] * 3
    lines = ["define i64 @bound(ptr %arguments) #0 {"]
    for i, kind in enumerate(kinds):
        lines += [f"  %at{i} = getelementptr i64, ptr %arguments, i64 {i}", f"  %a{i} = load {kind}, ptr %at{i}, align 8"]
    given = ", ".join(f"{kind} %a{i}" for i, kind in enumerate(kinds))
    return "\n".join([*lines, f"  %broken = call i64 @step({given})", "  ret i64 %broken", "}"])
