"""Traced arrays do what numpy's do: the same code, plain and traced, gives the same bits; what cannot be traced says where and why."""

import copy
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tailgate import num
from tailgate.engine import functions
from tailgate.engine.array import Traced
from tailgate.engine.graph import Graph, Node
from tailgate.engine.operations import FLOAT
from tailgate.engine.parameters import Reading, lifted
from tailgate.engine.program import Call, Program, State
from tailgate.engine.tracing import traced
from tailgate.engine.untraceable import Untraceable

FIXED = np.array([[0.5, -0.0, 2.0], [1.0, 3.0, -1.0]])

LARGE, TABLE = (np.random.default_rng(i).normal(size=size) for i, size in enumerate([(1, 12, 12), (30, 3)]))


def in_place(x: Any, y: Any, m: Any, n: Any) -> Any:
    out = np.zeros((len(x), 3))
    out[:, 0] = x[:, 1] * 2
    out[..., 1:] = y[:, :2, 0]
    out += x
    out[:, ::2] -= 1
    view = out.T
    view[1] = 7
    np.copyto(out, -1.0, where=m)
    return out


def mask_set(x: Any, y: Any, m: Any, n: Any) -> Any:
    out = x.copy()
    out[m] = 0.25
    return out


def some(x: Any, y: Any, m: Any, n: Any) -> Any:
    out = np.empty_like(x)
    out[...] = np.add(x, 1.0, out=np.full(x.shape, 9.0), where=m)
    return out


def kinds(kind: Any) -> Any:
    """Answers and numbers of a choice among constants, also of one that no choice has."""
    answers = (kind == 4) * 1.0 + (2 != kind) * 2.0 + (kind == 3) * 4.0 + (kind >= 2) * 8.0  # noqa: SIM300 - both sides
    return answers + num.take(TABLE[:, 0], kind) * (7 - kind) + np.minimum(kind, np.int8(3)) % 2


def branches_on_shapes(x: Any, y: Any, m: Any, n: Any) -> Any:
    if x.ndim == 2 and x.shape[1] == 3 and len(x):
        return x if FIXED[0, 0] > 0 else -x
    return None


CASES: dict[str, Callable[..., Any]] = {
    "arithmetic": lambda x, y, m, n: (x + 1) * 2.5 / (x - 3) - -x,
    "fixed": lambda x, y, m, n: FIXED[0] * x + FIXED.sum(axis=0) * n[:, None],
    "reflected": lambda x, y, m, n: 1 - (2.0 / (1 + x * x)),
    "powers": lambda x, y, m, n: x**2 + np.abs(x) ** 0.5 + x**1,
    "rounding": lambda x, y, m, n: np.floor(x) + np.ceil(x * 3) + np.rint(x * 2) + np.trunc(x * 5),
    "signs": lambda x, y, m, n: np.sign(x) + np.copysign(2.0, x) + np.signbit(x),
    "finite": lambda x, y, m, n: np.isfinite(1 / x) & ~np.isnan(0 * (1 / x)) | np.isinf(x),
    "types": lambda x, y, m, n: (n.astype(np.int8) + np.int8(100)).astype(np.float32) * np.float32(1.5),
    "weak": lambda x, y, m, n: x.astype(np.float32) * 3 + n.astype(np.float32)[:, None] * 0.1,
    "unsigned": lambda x, y, m, n: (n.astype(np.uint32) * np.uint32(2654435761)) >> np.uint32(7) ^ np.uint32(5),
    "shifts": lambda x, y, m, n: (n << 3) % 7 + (n >> 1) - n % 8,
    "remainders by data": lambda x, y, m, n: n % (np.floor(x[:, 0] * 3).astype(np.int64)) + n.astype(np.uint8) % (n.astype(np.uint8) >> 2),
    "bits": lambda x, y, m, n: (x.view(np.int64) & np.int64(0x7FFFFFFFFFFFFFFF)).view(np.float64),
    "where": lambda x, y, m, n: np.where(m, x, np.where(x > 0, 1, n[:, None])),
    "kinds": lambda x, y, m, n: kinds(np.where(m, np.where(x > 0, 4, 2), np.int8(0)).astype(np.int8)),
    "select": lambda x, y, m, n: np.select([m, x > 0], [x, -x], 4.0),
    "clip": lambda x, y, m, n: np.clip(x, -0.5, 0.5) + x.clip(0.0, 1.0) + np.minimum(x, y[:, :, 0]),
    "logic": lambda x, y, m, n: np.logical_and(x, m) | (np.logical_xor(m, x > 0)) & np.logical_not(n[:, None]),
    "masks": lambda x, y, m, n: m.any(axis=-1) & ~m.all(axis=1) | (m & (x > 0)).any(axis=(1,)),
    "stack": lambda x, y, m, n: np.stack([x[:, 0], n, m[:, 2]], axis=-1),
    "stack first": lambda x, y, m, n: np.stack([x[:, 0], x[:, 1]])[1] + np.stack([x, x], axis=1)[:, 0, 2],
    "concatenate": lambda x, y, m, n: np.concatenate([x, y[..., 0], np.ones((len(x), 1))], axis=-1),
    "column_stack": lambda x, y, m, n: np.column_stack([n, x]),
    "indices": lambda x, y, m, n: x[:, [2, 0]] + y[:, 1, ::-1] - y[..., -1, :] + x[:, None, 1],
    "fixed mask": lambda x, y, m, n: x[:, np.array([True, False, True])],
    "axes": lambda x, y, m, n: np.swapaxes(y, -1, -2)[:, 0] + y.transpose(0, 2, 1)[:, 1] + np.moveaxis(y, 1, 2)[:, 1],
    "last": lambda x, y, m, n: np.ascontiguousarray(y.transpose(1, 2, 0)).transpose(2, 0, 1) * 2,
    "shapes": lambda x, y, m, n: y.reshape(len(y), -1)[:, ::2] + x.reshape(len(x), 3, 1)[..., 0] + np.expand_dims(x, 1).squeeze(1),
    "diagonal": lambda x, y, m, n: y[:, :2, :2].diagonal(axis1=1, axis2=2) + np.broadcast_to(n[:, None], (len(n), 2)),
    "sums": lambda x, y, m, n: x.sum(axis=1) + np.sum(y[:, :, 0], axis=-1) + m.sum(axis=1) + np.count_nonzero(m, axis=1),
    "extremes": lambda x, y, m, n: np.max(x, axis=1) - x.min(axis=-1) + np.argmax(x, axis=1) - np.argmin(y[:, 0], axis=1),
    "kept": lambda x, y, m, n: x / x.max(axis=1, keepdims=True) + np.any(m, axis=1, keepdims=True),
    "accumulate": lambda x, y, m, n: np.add.accumulate(x, axis=1) + np.cumsum(m, axis=1) + np.maximum.accumulate(x, axis=-1),
    "reduce": lambda x, y, m, n: np.add.reduce(x, axis=1) * np.logical_or.reduce(m, axis=1) + np.multiply.reduce(x[:, :2], axis=1),
    "makers": lambda x, y, m, n: np.full((len(x), 3), 2.0) + np.ones(x.shape) * np.zeros_like(x) + np.full_like(x, n[:, None]),
    "repeat": lambda x, y, m, n: np.repeat(x[:, :2], 2, axis=1) + np.roll(np.flip(np.concatenate([x, x[:, :1]], 1), 1), 1, axis=1),
    "casts": lambda x, y, m, n: (x * 1e19).astype(np.int64) + (x * 10).astype(np.int64).astype(np.int32),
    "no numbers": lambda x, y, m, n: np.argmax(np.where(m, x, np.nan), axis=1) * 4 + np.argmin(np.where(m, np.nan, x), axis=1),
    "zeros of a sum": lambda x, y, m, n: 1.0 / np.sum(-0.0 * np.abs(x), axis=1) + 2.0 / np.add.reduce(-0.0 * np.abs(x), axis=1),
    "loops": lambda x, y, m, n: sum(v * k for k, v in enumerate(x.T)),
    "tables": lambda x, y, m, n: num.take(TABLE, n % 30) + num.take(TABLE[:3], n % 3) + num.take(TABLE[:, 0] > 0, n % 30)[:, None],
    "large matrices": lambda x, y, m, n: num.apply(LARGE, np.concatenate([x] * 4, axis=1)[:, None]),
    "networks": lambda x, y, m, n: num.dense(num.dense(x, LARGE[0, :3], LARGE[0, 3], True), LARGE[0, :, :2], FIXED[0, :2], False),
    "functions": lambda x, y, m, n: num.exp(x) + num.log(x) * num.tanh(x) + num.exp(num.log(np.abs(x))),
    "picked": lambda x, y, m, n: num.pick(num.put(x, n % 3, x[:, 0] + 9.0), num.ring_next(n % 3, 3)),
    "inverses": lambda x, y, m, n: num.inverse(num.matmul(y, num.transpose(y)) + np.eye(3)),
    "in place": in_place,
    "x[mask] = a number": mask_set,
    "out and where": some,
    "shapes in Python": branches_on_shapes,
}  # fmt: skip


def arrays(batch: int, seed: int = 3) -> dict[str, np.ndarray]:
    chance = np.random.default_rng(seed)
    x = np.where(chance.random((batch, 3)) < 0.2, 0.0, chance.normal(size=(batch, 3)))
    return {"x": x, "y": chance.normal(size=(batch, 3, 2)), "m": chance.random((batch, 3)) < 0.5, "n": chance.integers(0, 50, batch)}


@pytest.mark.parametrize("kind", [np.int32, np.int8, np.uint64, np.uint16])
def test_a_float_becomes_no_narrow_number(kind: Any) -> None:
    """Numpy's answer to a number that does not fit depends on the machine."""
    with pytest.raises(Untraceable, match=r"write x\.astype\(np\.int64\)"):
        traced(lambda _, held: ((), {"out": held["x"].astype(kind)}), (), {"x": np.ones((1, 3))})


def test_code_that_is_compiled_while_another_is_traced(monkeypatch: pytest.MonkeyPatch) -> None:
    """The outer code goes on with traced arrays."""
    monkeypatch.setattr(num.exp, "_code", None)  # as if this process had not used it yet

    def step(_: Any, held: Any) -> Any:
        weight = num.exp(np.arange(4000.0) / 4000.0)  # machine code, from some length on
        out = np.zeros(held["x"].shape)
        out[..., 0] = held["x"][..., 0] * weight[3]
        return (), {"out": out}

    assert next(iter(traced(step, (), {"x": np.ones((1, 3))}).results)) == "out"


def test_a_comparison_of_parameters_is_no_number() -> None:
    def step(_: Any, held: Any) -> Any:
        eta, size = lifted(held["x"], (2.0, 3))
        return (), {"out": (eta > 1.0) & (held["x"] > 0.0) & (size + eta > 4.5)}

    assert next(iter(traced(step, (), {"x": np.ones((1, 3))}).results)) == "out"


def test_a_number_of_pythons_does_what_python_does() -> None:
    """A list is repeated, a dictionary is read, and numpy's functions return numbers of numpy's."""
    found: list[Any] = []

    def step(_: Any, held: Any) -> Any:
        p, n = lifted(held["x"], (2.5, 3))
        found[:] = [n * [0.0], [1] * n, {3: "three"}[n], f"{p:.2f} {n}", isinstance(p, float), isinstance(n, int), isinstance(held["x"], np.ndarray)]
        found.append(list(map(int, (round(p), 2**n, *divmod(n, 2), (p > 1) + (n > 1), -(p > 1)))))
        with pytest.raises(ZeroDivisionError):
            p / (n - 3)
        return (), {"out": held["x"].astype(np.float32) * np.sqrt(p), "narrow": held["x"].astype(np.float32) * (p * n)}

    results = traced(step, (), {"x": np.ones((1, 3))}).results
    assert found == [[0.0] * 3, [1] * 3, "three", "2.50 3", True, True, True, [2, 8, 1, 1, 2, -1]]
    assert [results[name].item(0).dtype for name in ("out", "narrow")] == [np.float64, np.float32]


@pytest.mark.parametrize("name", CASES)
def test_numpys_functions(name: str) -> None:
    function, given = CASES[name], arrays(13)
    with np.errstate(all="ignore"):
        wanted = np.asarray(function(**copy.deepcopy(given)))
    trace = traced(
        lambda state, held: ((), {"out": function(**{k: held[k].copy() for k in held})}), (), {k: v[:1] for k, v in given.items()}
    )
    program = Program(trace)
    call = Call(program, State(program, 13))
    for key, value in given.items():
        call.arguments[key][...] = value
    got = call()["out"]
    assert got.dtype == wanted.dtype and got.shape == wanted.shape
    bits = np.dtype(f"u{got.dtype.itemsize}")
    if got.dtype.kind == "f":  # of NaN the sign and the payload are nobody's
        got, wanted = (np.where(np.isnan(held), np.nan, held) for held in (got, wanted))
    np.testing.assert_array_equal(np.ascontiguousarray(got).view(bits), np.ascontiguousarray(wanted).view(bits))


REFUSED: dict[str, tuple[Callable[..., Any], str]] = {
    "a branch": (lambda x: 1 if x[0, 0] > 0 else 2, "one row out of the batch"),
    "a branch on a mask": (lambda x: 1 if (x > 0).any() else 2, "num.some"),
    "a branch on one": (lambda x: 1 if x[:, 0] > 0 else 2, "np.where"),
    "a float": (lambda x: float(x[:, 0]), "keep the array"),
    "rows of a mask": (lambda x: x[x[:, 0] > 0], "np.where"),
    "rows of an index": (lambda x: x[:, x[:, 0].astype(int)], "num.take"),
    "a sum over the episodes": (lambda x: x.sum(axis=0), "over the episodes"),
    "a mean of all": (lambda x: x.max(), "all episodes"),
    "a long sum": (lambda x: np.concatenate([x, x, x], axis=1).sum(axis=1), "num.dot"),
    "a library's function": (lambda x: np.exp(x), "num.exp"),
    "a matrix product": (lambda x: x @ FIXED.T, "num.matmul"),
    "episodes against agents": (lambda x: x + np.zeros((4, 3)), "longer one"),
    "episodes as the last axis": (lambda x: x[:, 0] + x, "another axis"),
    "a flat array": (lambda x: np.concatenate([x, x], 1).reshape(2, 3), "keep the episodes"),
    "sorting": (lambda x: np.sort(x, axis=1), "np.sort"),
    "a shift by data": (lambda x: np.int64(3) << x[:, 0].astype(int), "constants"),
    "a remainder of floats": (lambda x: x % 2.0, "np.floor"),
    "a remainder by nothing": (lambda x: x[:, 0].astype(int) % 0, "from 1"),
    "a power": (lambda x: x**3, "products"),
    "a loop over what there is": (lambda x: [k for k in set((x > 0).tolist())], "a loop over all possible values"),
    "into numpy's own array": (lambda x: np.add(x, 1, out=CASES and FIXED), "np.zeros"),
    "one row written": (lambda x: np.zeros((len(x), 3)).__setitem__(0, 1.0), "one row|some of the episodes"),
    "rows joined": (lambda x: np.concatenate([x, x], axis=0), "several rows"),
    "rows repeated": (lambda x: np.repeat(x, 2, axis=0), "several rows"),
    "rows in another order": (lambda x: np.roll(x, 1, axis=0), "another order"),
    "a sum of what came through a view": (lambda x: [z := np.zeros((len(x), 3)), np.copyto(z[:, 0], x[:, 1]), z.sum(axis=0)][2], "over the"),
    "another keyword": (lambda x: np.argmax(x, axis=1, keepdims=True), "np.argmax: got an unexpected keyword"),
    "another method": (lambda x: x.std(axis=1), "x.std; write it with"),
    "half precision": (lambda x: x * np.float16(1), "float16"),
    "complex numbers": (lambda x: x * 1j, "real numbers"),
    "a list of objects": (lambda x: np.add(x, [object()] * 3), "use numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_traced_says_where_and_what_to_write(name: str) -> None:
    function, says = REFUSED[name]
    with pytest.raises(Untraceable, match=says) as caught:
        traced(lambda state, held: ((), {"out": function(held["x"])}), (), {"x": np.zeros((1, 3))})
    assert caught.value.place.startswith(f"{__file__}:{function.__code__.co_firstlineno}")


def test_inputs_are_not_written_to() -> None:
    def writes(state: Any, held: Any) -> Any:
        held["x"][:, 0] = 1.0
        return (), {}

    with pytest.raises(ValueError, match="read-only"):
        traced(writes, (), {"x": np.zeros((1, 3))})


def test_numpy_is_itself_elsewhere_and_afterwards() -> None:
    """Another thread, and this one after a failure, get plain arrays."""
    before, found = np.zeros, []

    def function(state: Any, held: Any) -> Any:
        other = threading.Thread(target=lambda: found.append(type(np.zeros(3))))
        other.start()
        other.join()
        found.append(type(np.zeros((1, 3))))
        raise KeyError("on the way")

    with pytest.raises(KeyError):
        traced(function, (), {"x": np.zeros((1, 3))})
    assert found == [np.ndarray, Traced]
    assert np.zeros is before and type(np.asarray([1.0])) is np.ndarray


def test_a_choice_among_constants_is_decided_while_it_is_traced() -> None:
    """A comparison of an attack's kind leaves nothing where no choice has that kind."""

    def function(state: Any, given: Any) -> Any:
        kind = np.where(given["x"][:, 0] > 0.0, np.where(given["x"][:, 1] > 0.0, 4, 2), 0).astype(np.int8)
        return (), {"never": kind == 3, "other": kind == 4, "same": np.where(kind == 5, given["x"][:, 0], given["x"][:, 1])}

    trace = traced(function, (), {"x": np.zeros((1, 2))})
    never, other, same = (trace.results[name].item() for name in ("never", "other", "same"))
    assert never.op == "const" and not never.attr and other.op == "select" and other.args[2].attr == np.False_
    assert same is trace.arguments["x"][0, 1]


def test_choices_do_not_multiply() -> None:
    """A counter of thirty questions has as many operations as its lines, not one for each way through them."""

    def function(state: Any, given: Any) -> Any:
        count = np.zeros(1, np.int64)
        for k in range(30):
            count = np.where(given["x"][:, 0] > k, count + 1, count)
        return (), {"count": count}

    trace = traced(function, (), {"x": np.zeros((1, 1))})
    assert trace.graph.operations < 120
    program = Program(trace)
    call = Call(program, State(program, 40))
    call.arguments["x"][:, 0] = np.arange(40) - 4.5
    assert call()["count"].tolist() == np.clip(np.arange(40) - 4, 0, 30).tolist()


def test_a_pruned_trace_keeps_what_its_results_need() -> None:
    """A leaf that nothing reads is no part of the program; one that a later step reads is."""

    def function(state: Any, given: Any) -> Any:
        following = {"total": state["total"] + state["pace"], "pace": state["pace"] * 0.5, "count": state["count"] + 1, "wide": state["wide"] + 1.0}
        return following, {"out": state["total"]}

    begun = {"total": np.ones(7), "pace": np.full(7, 2.0), "count": np.zeros(7, np.int64), "wide": np.zeros((7, 200))}
    whole = traced(function, {name: leaf[:1] for name, leaf in begun.items()}, {})
    assert [set(whole.pruned(keep=keep).state) for keep in ((), ("count",))] == [{"total", "pace"}, {"total", "pace", "count"}]
    assert set(whole.pruned({}, ["wide"]).state) == {"wide"} == set(whole.pruned({}, ["wide"]).large)
    program = Program(whole.pruned())
    state = State(program, 7)
    state.put(begun)
    call = Call(program, state)
    assert [call()["out"].tolist() for _ in range(3)] == [[1.0] * 7, [3.0] * 7, [4.0] * 7]


def test_parameters_are_no_part_of_the_code() -> None:
    """A uniform number can be asked for while it is traced; other values need no other code."""

    def trace(gain: float) -> Program:
        graph = Graph()
        nodes = np.array([[graph.input(("arguments", "x", (0,)), FLOAT)]], object)
        x = Traced(graph, nodes, FLOAT, 0)
        (k,) = lifted(x, (gain,))
        with functions.makers(graph):
            out = x * (k * 2 + 1) + (1.0 if k > 0 else -1.0) if k < 5 else x
        from tailgate.engine.tracing import Trace

        return Program(Trace(graph, {}, {"x": nodes}, {"out": out.nodes}, None))

    one, other = trace(0.3), trace(0.7)
    assert one.text == other.text and not other.function.fresh
    assert trace(-0.3).text != one.text  # another side of a Python branch
    for program, gain in ((one, 0.3), (other, 0.7)):
        call = Call(program, State(program, 5))
        call.arguments["x"][:, 0] = np.arange(5.0)
        assert (call()["out"][:, 0] == np.arange(5.0) * (gain * 2 + 1) + 1.0).all()


def test_tables_are_converted_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers that depend on no parameter, as those of a recorded road, cost nothing in a call with other values."""
    graph = Graph()
    graph.parameters.append(np.array([0.3]))
    gain, road = graph.uniform((0, 0), 0.3), [graph.const(float(i), FLOAT) for i in range(50)]
    doubled = graph.binary("mul", gain, graph.const(2.0, FLOAT))
    reading = Reading(graph, [*road, doubled, graph.binary("add", road[3], road[4])])
    computed: list[str] = []
    first = graph.recomputed

    def counted(node: Node, values: dict[int, Any]) -> Any:
        computed.append(node.op)
        return first(node, values)

    monkeypatch.setattr(graph, "recomputed", counted)
    for value in (0.3, 0.7):
        assert reading.bits([np.array([value])]).view(float).tolist() == [*range(50), 2 * value, 7.0]
    assert computed == ["mul", "mul"]
