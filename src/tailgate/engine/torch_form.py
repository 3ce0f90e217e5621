"""The torch form of a trace: the same numbers, with derivatives, for operations that `adjoint` has no rule for. It is not the scored path.

Machine code computes the numbers that no differentiated argument reaches; the others are float64 tensors on the processor.
Each operation gives the bits that numpy gives. Comparisons, roundings and conversions to whole numbers have derivative 0.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from typing import Any

import numpy as np

from tailgate.engine.adjoint import FLAT, moving
from tailgate.engine.evaluation import Evaluation, multiplied
from tailgate.engine.graph import Graph, Node, computed, ordered
from tailgate.engine.operations import FLOAT, Array
from tailgate.engine.program import Program
from tailgate.engine.tracing import Trace

try:
    import torch as torch  # for those who differentiate
except ImportError as error:
    raise ImportError("derivatives of a loop need PyTorch: pip install 'tailgate[train]'") from error

Rule = Callable[[torch.Tensor], tuple[torch.Tensor, ...]]
_DERIVATIVES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"log": torch.reciprocal}  # of routines on the bits of a number


class _Ruled(torch.autograd.Function):
    """A value of numpy, with a rule for its derivatives."""

    @staticmethod
    def forward(ctx: Any, value: Array, rule: Rule, *inputs: torch.Tensor) -> torch.Tensor:
        ctx.rule = rule
        return tensor(value)

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        return None, None, *ctx.rule(grads[0])


def ruled(value: Array, rule: Rule, *inputs: torch.Tensor) -> torch.Tensor:
    """Return a value with a rule: from its gradient, the gradients of the inputs."""
    return _Ruled.apply(value, rule, *inputs)  # type: ignore[no-any-return, no-untyped-call]


def tensor(x: Any) -> torch.Tensor:
    """Return x as a tensor; arrays that may be written are shared."""
    if isinstance(x, torch.Tensor):
        return x
    held = np.asarray(x)
    return torch.from_numpy(held if held.flags.writeable and min(held.strides, default=0) >= 0 else held.copy())


def plain(x: Any) -> Any:
    """Return the numbers of a tensor."""
    return x.detach().numpy() if isinstance(x, torch.Tensor) else x


def _differentiated(args: Sequence[Any]) -> bool:
    for x in args:  # noqa: SIM110 - faster than `any`, and this is asked of every operation
        if isinstance(x, torch.Tensor):
            return True
    return False


class TorchEvaluation(Evaluation):
    """The values of some roots; tensors among the inputs (B,) are differentiated."""

    def __init__(self, graph: Graph, roots: Sequence[Node], moving: Container[int] | None = None) -> None:
        """Take the graph and its roots; `moving` has the numbers of the nodes to compute, the others are given."""
        super().__init__(graph, roots)
        if moving is not None:
            self._order = [node for node in self._order if node.id in moving]
        self._parts_of: dict[int, tuple[torch.Tensor, Sequence[torch.Tensor]]] = {}

    def compute(self, node: Node, args: Sequence[Any]) -> Any:
        """Return the value of an operation: a tensor if one of its arguments is one and the operation has a derivative."""
        if node.op == "pick" and isinstance(args[0], torch.Tensor):
            return self._parted(node.args[0], args[0])[node.attr]
        if not _differentiated(args):
            return super().compute(node, args)
        if node.op in FLAT or (node.op == "cast" and node.dtype != FLOAT):
            return super().compute(node, [plain(a) for a in args])
        if node.op == "invert":
            return _inverted(node, args[0])
        if node.op == "blend":
            return _select(args[0], *map(self.aligned, args[1:]))
        return _OPERATIONS[node.op](*args)

    def multiply(self, matrix: Array, there: Array | None, x: Any, base: Any) -> Any:
        """Return base + matrix x, see `Evaluation.multiply`."""
        if not _differentiated([x, base]):
            return super().multiply(matrix, there, x, base)
        right, begin = tensor(x), tensor(base)
        factor = tensor(matrix if there is None else np.where(there, matrix, 0.0))
        sizes = right.shape, begin.shape

        def rule(grad: torch.Tensor) -> tuple[torch.Tensor, ...]:
            return torch.tensordot(factor.T, grad, 1).sum_to_size(sizes[0]), grad.sum_to_size(sizes[1])

        return ruled(multiplied(matrix, there, plain(right), plain(begin)), rule, right, begin)

    def stack(self, columns: Sequence[Any]) -> Any:
        """Return a buffer of numbers that broadcast."""
        if not _differentiated(columns):
            return super().stack(columns)
        return self.aligned(torch.stack(torch.broadcast_tensors(*map(tensor, columns))))  # type: ignore[no-untyped-call]

    def join(self, buffers: Sequence[Any]) -> Any:
        """Return one buffer of several."""
        if not _differentiated(buffers):
            return super().join(buffers)
        shape = np.broadcast_shapes(*(tuple(x.shape[1:]) for x in buffers))
        return torch.cat([tensor(x).expand(len(x), *shape) for x in buffers])

    def spread(self, made: Any, rounds: int) -> Any:
        """Return the results of a sweep as a buffer."""
        if isinstance(made, torch.Tensor) and made.shape[1] != rounds:
            made = made.expand(len(made), rounds, *made.shape[2:])
        return super().spread(made, rounds)

    def taken(self, buffer: Any, places: Array) -> Any:
        """Return the numbers of a buffer at some places."""
        if not isinstance(buffer, torch.Tensor):
            return super().taken(buffer, places)
        return buffer if np.array_equal(places, np.arange(len(buffer))) else buffer.index_select(0, torch.from_numpy(places))

    def _parted(self, node: Node, buffer: torch.Tensor) -> Sequence[torch.Tensor]:
        """Return the numbers of a buffer; parting it once has a faster derivative than a choice of each."""
        held = self._parts_of.get(node.id)
        if held is None or held[0] is not buffer:
            held = self._parts_of[node.id] = buffer, buffer.unbind()
        return held[1]

    def call(self, routine: Any, args: Sequence[Any]) -> list[Any]:
        """Return the results of a routine."""
        derivative = _DERIVATIVES.get(routine.name)  # its operations on bits would not show it
        if derivative and _differentiated(args):
            (x,) = args
            slope = derivative(x.detach())
            return [ruled(value, lambda grad: (grad * slope,), x) for value in routine.values([plain(x)])]
        return super().call(routine, args)


def _select(where: Any, x: Any, y: Any) -> torch.Tensor:
    return torch.where(tensor(where), tensor(x), tensor(y))


def _divide(x: Any, y: Any) -> torch.Tensor:
    """Return x / y; where y is 0 the derivative is 0, because such a quotient is never selected."""
    left, right = tensor(x), tensor(y)
    if not (zero := right.detach() == 0.0).any():
        return torch.div(left, right)
    with np.errstate(all="ignore"):
        held = tensor(np.true_divide(plain(left), plain(right)))
    return torch.where(zero, held, torch.div(left, torch.where(zero, 1.0, right)))


def _root(x: torch.Tensor) -> torch.Tensor:
    """Return the square root, with derivative 0 at 0; the library's own is not rounded as numpy's."""
    value = np.sqrt(plain(x))
    slope = tensor(np.where(value == 0.0, 0.0, 0.5 / value))
    return ruled(value, lambda grad: (grad * slope,), x)


def _least(x: Any, y: Any) -> torch.Tensor:
    a, b = plain(x), plain(y)
    return _select((a < b) | (a != a), x, y)


def _most(x: Any, y: Any) -> torch.Tensor:
    a, b = plain(x), plain(y)
    return _select((a > b) | (a != a), x, y)


def _inverted(node: Node, numbers: torch.Tensor) -> torch.Tensor:
    """Return the inverses of symmetric matrices; a change D of one changes its inverse S by -S D S."""
    q = node.attr
    value = np.stack(computed(node, [list(plain(numbers))]))

    def matrices(x: torch.Tensor) -> torch.Tensor:
        return x.movedim(0, -1).reshape(*x.shape[1:], -1, q, q)

    inverse = matrices(tensor(value)).mT

    def rule(grad: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return (-(inverse @ matrices(grad) @ inverse).reshape(*grad.shape[1:], -1).movedim(-1, 0),)

    return ruled(value, rule, numbers)


_OPERATIONS: dict[str, Callable[..., Any]] = {
    "add": lambda x, y: torch.add(tensor(x), tensor(y)), "sub": lambda x, y: torch.sub(tensor(x), tensor(y)),
    "mul": lambda x, y: torch.mul(tensor(x), tensor(y)), "div": _divide, "min": _least, "max": _most,
    "neg": torch.neg, "abs": torch.abs, "sqrt": _root, "select": _select, "cast": lambda x: x,
}  # fmt: skip


class TorchForm:
    """The steps of a trace. Only what a differentiated argument reaches is torch; machine code computes the other numbers, once."""

    def __init__(self, trace: Trace, results: Sequence[str]) -> None:
        """Keep what the named results of all steps need.

        Parameters
        ----------
        trace : of a function that maps a state and arguments to the next state and results
        results : names of results, one number of an episode each
        """
        trace = trace.pruned({name: trace.results[name] for name in results})
        asked = {name: nodes.item() for name, nodes in trace.results.items()}
        pairs = [pair for name in trace.state for pair in trace.pairs(name)]
        nodes = ordered([*asked.values(), *(new for _, new in pairs)])
        reached = moving(nodes, [node for held in trace.arguments.values() for node in held.flat], pairs)
        self._arguments, self._large = trace.arguments, {now.attr for now, _ in trace.large.values()}
        self._state = {now.attr: new for now, new in pairs if now.id in reached}
        self._results = {name: node for name, node in asked.items() if node.id in reached}
        self._evaluation = TorchEvaluation(trace.graph, [*self._results.values(), *self._state.values()], reached)
        given = {a.id: a for node in nodes if node.id in reached for a in node.args if not a.fixed and a.id not in reached}
        self._given: dict[str, list[Node]] = {}  # what machine code hands over, by type
        for node in given.values():
            self._given.setdefault(f"given {node.dtype}", []).append(node)
        self._program = _program(trace, {name: node for name, node in asked.items() if node.id not in reached}, self._given)

    @property
    def numbers(self) -> int:
        """The numbers that derivatives keep of a step, about."""
        return self._evaluation.operations + sum(node.size or 1 for nodes in self._given.values() for node in nodes)

    def start(self, leaves: dict[str, Array]) -> Differentiated:
        """Return episodes that begin with these leaves (B, ...), by dotted name."""
        return Differentiated(self, leaves)


class Differentiated:
    """Episodes that are played with derivatives."""

    def __init__(self, form: TorchForm, leaves: dict[str, Array]) -> None:
        self._form, self._moving = form, {}
        for name in form._state:
            leaf = leaves[name[1]]
            numbers = leaf.reshape(len(leaf), -1).T if name in form._large else leaf[(slice(None), *name[2])]
            self._moving[name] = np.array(numbers, order="C")
        state = form._program.rows(len(next(iter(leaves.values()))))
        for name in form._program.places:
            state.put_leaf(name, leaves[name])
        self._call = form._program.call(state)

    def step(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """Play a step; return the results (B,), for arguments (B, ...), arrays or tensors."""
        form, given = self._form, dict(self._moving)
        for name, nodes in form._arguments.items():
            self._call.arguments[name][...] = plain(arguments[name])
            for place in np.ndindex(*nodes.shape[1:]):
                given[nodes[(0, *place)].attr] = arguments[name][(slice(None), *place)]
        made = self._call()
        known: dict[int, Any] = {}
        for name, given_here in form._given.items():
            columns = iter(made.pop(name).T)
            known |= {node.id: np.array([next(columns) for _ in range(node.size)]) if node.size else next(columns) for node in given_here}
        found = form._evaluation(given, known)
        self._moving = dict(zip(form._state, found[len(form._results) :], strict=True))
        return made | dict(zip(form._results, found, strict=False))


def _program(trace: Trace, results: dict[str, Node], given: dict[str, list[Node]]) -> Program:
    """Return the machine code of named numbers, and of groups of numbers and buffers."""
    wanted = {name: np.array([node], object) for name, node in results.items()}
    for name, nodes in given.items():
        wanted[name] = np.array([[one for node in nodes for one in (trace.graph.picks(node) if node.size else [node])]], object)
    return Program(trace.pruned(wanted))
