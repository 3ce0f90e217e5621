"""Large arrays are played in loops, from buffer to buffer: the bits are numpy's, at every width of a vector and in every order of branches."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tailgate import num
from tailgate.base.pytree import leaves
from tailgate.engine import matrices, sweeps
from tailgate.engine.buffers import WIDE
from tailgate.engine.evaluation import evaluate
from tailgate.engine.program import Call, Program, State
from tailgate.engine.tracing import traced
from tailgate.engine.untraceable import Untraceable

CHANCE = np.random.default_rng(5)
AGENTS, N, Q = 3, 9, 5
SPARSE = np.where(CHANCE.random((N, N)) < 0.4, CHANCE.normal(size=(N, N)), 0.0)
DENSE, EACH = CHANCE.normal(size=(N, N)), np.where(CHANCE.random((AGENTS, Q, N)) < 0.7, CHANCE.normal(size=(AGENTS, Q, N)), 0.0)
TABLE = CHANCE.normal(size=(AGENTS, N, N))
FRESH = CHANCE.normal(size=(16, N))
STEADY = np.stack([np.eye(Q) + 0.1 * (part @ part.T) for part in CHANCE.normal(size=(AGENTS, Q, Q))])
Row = dict[str, Any]


def state(batch: int) -> Row:
    chance = np.random.default_rng(7)
    half = chance.normal(size=(batch, AGENTS, N, N))
    return {
        "P": half @ np.swapaxes(half, -1, -2) + np.eye(N),
        "Z": np.where(chance.random((batch, AGENTS, N, N)) < 0.3, -0.0, chance.normal(size=(batch, AGENTS, N, N))),
        "n": chance.integers(-9, 9, (batch, AGENTS, N, N)).astype(np.int8),
        "b": chance.random((batch, AGENTS, N, N)) < 0.5,
        "x": chance.normal(size=(batch, AGENTS, N)),
        "w": chance.random((batch, AGENTS)),
        "m": chance.random((batch, AGENTS)) < 0.8,
        "one": chance.random(batch) < 0.3,
    }


def loops(s: Row) -> Any:
    out = np.zeros_like(s["P"])
    for i in range(AGENTS):
        for j in range(i, AGENTS):
            out[:, i] += s["w"][:, j, None, None] * s["Z"][:, j]
        out[:, i, range(N), range(N)] = s["P"][:, i, range(N), range(N)]
    return out


def rare(s: Row) -> Any:
    far = num.inverse(s["P"] + s["Z"] * s["Z"])
    return np.where(s["one"][:, None, None, None], far, s["Z"])


def both(s: Row) -> Any:
    mask = s["one"][:, None, None, None]
    return np.where(mask, num.inverse(s["P"]), num.matmul(SPARSE, s["Z"])) + np.where(mask, s["Z"], s["P"] * 2)


def steady(s: Row) -> Any:
    """A covariance that is the same for all episodes but where something is missing, and its inverse."""
    S = np.broadcast_to(STEADY, (len(s["x"]), AGENTS, Q, Q))
    keep = s["x"][..., :Q] < 1.0
    out = num.elsewhere(keep.all(axis=-1), S, lambda S, keep: S * (keep[..., None] & keep[..., None, :]) + np.eye(Q), S, keep)
    return num.inverse(out)


def corrected(s: Row) -> Any:
    W, keep = num.inverse(s["P"][..., :Q, :Q]), s["x"][..., :Q] > 0
    x, P = num.corrected(EACH, W, s["x"], s["P"], s["x"][..., :Q] * 2, keep)
    return P + x[..., None]


def fused(s: Row) -> Any:
    heard = np.tri(AGENTS, dtype=bool)
    mean, spread = num.fused(heard, s["x"], s["P"], step=(DENSE, np.eye(N)))
    return spread + mean[..., None]


def turned(x: Any) -> Any:
    """Numbers that are read at other places than they are made."""
    return np.swapaxes(x, -1, -2) + x[..., ::-1] * x[:, ::-1]


def rings(s: Row) -> Any:
    """Rings of nine numbers, of which each row and agent reads and writes another place, and all agents of a row the same one."""
    own, common = s["n"][..., 0].astype(np.int64) % N, s["n"][:, :1, :1, 1].astype(np.int64) % N
    ring = num.put(num.put(s["P"], own, s["x"]), common, -s["x"])
    return np.stack([num.pick(ring, own), num.pick(ring, common), num.pick(s["Z"], num.ring_next(own, N))], axis=-1)


def many(x: Any) -> Any:
    return (x + 1.0) * (x - 1.0) * (x + 2.0) * (x - 2.0) * (x + 3.0)


CASES: dict[str, Callable[[Row], Any]] = {
    "elementwise": lambda s: (s["P"] * 2 - s["Z"]) / (1.0 + s["Z"] * s["Z"]) + np.sqrt(np.abs(s["P"])),
    "broadcast": lambda s: s["P"] * s["w"][..., None, None] + s["x"][..., None] * s["x"][..., None, :],
    "fixed": lambda s: s["P"] + TABLE * s["w"][..., None, None] - TABLE[0],
    "transposed": lambda s: 0.5 * (s["P"] + np.swapaxes(s["Z"], -1, -2)) + np.repeat(s["Z"][:, ::-1, ::2], 2, axis=2)[:, :, 1:],
    "types": lambda s: (s["n"].astype(np.int64) << 2) - s["n"] + s["b"] + (s["P"] > s["Z"]),
    "bytes": lambda s: (s["n"] + np.int8(100)) * s["n"],
    "masks": lambda s: np.where(s["b"], s["P"], np.where(s["m"][..., None, None], s["Z"], 1.0)),
    "parts": lambda s: s["P"][:, 1, 2:5] * s["Z"][:, 0, :3],
    "reductions": lambda s: np.max(s["P"], axis=-1) + s["b"].any(axis=-2) + s["Z"].min(axis=1)[:, None, 0],
    "mixtures": lambda s: np.stack([s["P"][:, 0], s["Z"][:, 1], s["P"][:, 2] + s["Z"][:, 2]], axis=1) * 2.0,
    "in a loop": loops,
    "functions": lambda s: num.exp(s["Z"]) + num.log(s["P"] * s["P"] + 0.1),
    "sparse": lambda s: num.matmul(SPARSE, s["P"]),
    "dense": lambda s: num.matmul(DENSE, s["Z"]),
    "each agent's": lambda s: num.matmul(EACH, s["P"]),
    "products": lambda s: num.matmul(s["P"], s["Z"]),
    "vectors": lambda s: num.matvec(s["P"], s["x"]) + num.apply(SPARSE[None], s["x"]),
    "congruence": lambda s: num.congruent(SPARSE, s["P"], np.eye(N)),
    "inverses": lambda s: num.inverse(s["P"]),
    "moments": lambda s: num.moment([s["w"], 1 - s["w"]], [s["P"], s["Z"]], [s["x"], -s["x"]]),
    "corrected": corrected,
    "fused": fused,
    "rare": rare,
    "both sides": both,
    "steady": steady,
    "read in other places": lambda s: turned(s["P"] * 2.0 - s["Z"]),
    "read by many": lambda s: many(s["P"] * 2.0),
    "rings": rings,
}  # fmt: skip


def bits(x: np.ndarray) -> np.ndarray:
    held = np.where(np.isnan(x), np.nan, x) if x.dtype.kind == "f" else x  # of NaN the sign and the payload are nobody's
    return np.ascontiguousarray(held).view(f"u{held.dtype.itemsize}")


@pytest.mark.thin(12)
@pytest.mark.parametrize("name", CASES)
def test_numpys_bits(name: str) -> None:
    function, batch = CASES[name], 13
    given = state(batch)
    with np.errstate(all="ignore"):
        wanted = np.asarray(function(copy.deepcopy(given)))
    trace = traced(lambda held, _: (held, {"out": function(dict(held))}), {k: v[:1] for k, v in given.items()}, {})
    assert any(node.size for node in trace.graph.nodes)
    places = {key: value.reshape(batch, -1).T for key, value in given.items()}
    inputs = {("state", key): list(rows) for key, rows in places.items() if len(rows) >= WIDE}
    for key, (nodes, _) in trace.state.items():
        inputs |= {node.attr: row for node, row in zip(nodes.flat, places[key], strict=True) if node.op == "input"}
    roots = list(trace.results["out"].flat)
    found = np.stack([np.broadcast_to(x, batch) for x in evaluate(trace.graph, roots, inputs)], axis=-1).reshape(wanted.shape)
    np.testing.assert_array_equal(bits(found.astype(wanted.dtype)), bits(wanted), "evaluated by numpy")
    for lanes in (2, 4, 8):
        program = Program(trace, lanes)
        rows = State(program, batch)
        rows.put(given)
        got = Call(program, rows)()["out"]
        assert got.dtype == wanted.dtype
        np.testing.assert_array_equal(bits(got), bits(wanted), f"{lanes} lanes")


@pytest.mark.parametrize("lanes", [2, 4, 8])
def test_states_that_move_between_buffers(lanes: int) -> None:
    """Exchanged, kept, begun again and grown: a place is not written to before it has been read."""

    def step(held: Row, given: Row) -> Any:
        a, b, again = held["a"], held["b"], given["again"][:, None, None]
        c = held["c"] + 0.5 * a
        return {"a": np.where(again, FRESH, b), "b": a, "c": np.where(again, b, c), "d": held["d"]}, {"sum": a * b}

    chance, batch = np.random.default_rng(2), 11
    wide = {key: chance.normal(size=(batch, 16, N)) for key in "abcd"}
    program = Program(traced(step, {k: v[:1] for k, v in wide.items()}, {"again": np.zeros(1, bool)}), lanes)
    rows = State(program, batch)
    rows.put(wide)
    call = Call(program, rows)
    for _ in range(6):
        again = chance.random(batch) < 0.3
        call.arguments["again"][...] = again
        got = call()
        wide, wanted = step(wide, {"again": again})
        np.testing.assert_array_equal(bits(got["sum"]), bits(wanted["sum"]))
        for key, leaf in leaves(wide).items():
            np.testing.assert_array_equal(bits(rows.get_leaf(key)), bits(np.ascontiguousarray(leaf)))


def test_inverses_know_what_is_the_same_for_all() -> None:
    """The inverse of a choice is a choice of inverses: that of constants is one."""
    given = state(1)
    graph = traced(lambda held, _: (held, {"out": steady(dict(held))}), given, {}).graph
    inverted = [node for node in graph.nodes if node.op == "div" and not node.fixed]
    assert len(inverted) == AGENTS * Q  # those of the other side
    assert matrices.LOOPED <= WIDE


def test_what_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweeps, "ROOM", 1e5)
    large = {"x": np.zeros((1, 10_000))}
    with pytest.raises(Untraceable, match="use smaller ones"):
        Program(traced(lambda held, _: ({"x": held["x"] * 2.0 + 1.0}, {}), large, {}), 8)


def test_a_number_that_is_read_once_is_never_in_memory() -> None:
    """Only the result of a chain of elementwise operations has room."""
    given = state(1)
    trace = traced(lambda held, _: (held, {"out": np.sqrt(np.abs((held["P"] + 1.0) * 2.0 - held["Z"])) + 3.0}), given, {})
    assert sum(node.op == "sweep" for node in trace.graph.nodes) > 4
    program = Program(trace, 4)
    assert program.room == -(-given["P"].size * 8 * 4 // 64) * 64
