"""The traced engine: random graphs and array code give the same bits in numpy and in machine code."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.engine import objects
from tailgate.engine.agreement import ROWS, apart
from tailgate.engine.evaluation import evaluate
from tailgate.engine.graph import Graph, Node
from tailgate.engine.operations import BOOL, COMPARISONS, DTYPES, FLOAT
from tailgate.engine.program import Program, _pool
from tailgate.engine.tracing import Trace, traced
from tailgate.play.rollouts import Rollout, rollout_of

SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, 1e-310, -5e-324, 1e308, -1e308, np.inf, -np.inf, np.nan, 2.0**63, -(2.0**63), 3.7, 255.5])


def numbers(chance: np.random.Generator, dtype: np.dtype[Any], size: int) -> np.ndarray:
    """Numbers of a type, the odd ones among them."""
    if dtype == BOOL:
        return chance.random(size) < 0.5
    if dtype.kind == "f":
        plain = np.where(
            chance.random(size) < 0.3, chance.choice(SPECIAL, size), chance.normal(scale=10.0 ** chance.integers(-3, 4), size=size)
        )
        with np.errstate(over="ignore"):
            return plain.astype(dtype)
    held = np.iinfo(dtype)
    small = chance.integers(max(held.min, -20), 20, size, dtype=dtype)
    return np.where(chance.random(size) < 0.7, small, chance.integers(held.min, held.max, size, dtype=dtype, endpoint=True))


def grown(graph: Graph, pool: list[Node], chance: np.random.Generator, count: int) -> None:
    """More nodes, of random operations on those that there are."""

    def one(dtypes: list[np.dtype[Any]]) -> Node:
        fit = [node for node in pool if node.dtype in dtypes]
        late = fit[-12:] if chance.random() < 0.7 else fit
        return late[int(chance.integers(len(late)))]

    for _ in range(count):
        x = one(DTYPES)
        alike = one([x.dtype])
        kind = x.dtype.kind
        ops = ["compare", "select", "select", "cast", "not" if kind in "biu" else "round", "and" if kind in "biu" else "div"]
        op = str(chance.choice([*ops, *(["arithmetic"] * 6 if kind != "b" else []), *(["shift", "rem", "bits"] if kind in "iu" else [])]))
        if op == "compare":
            new = graph.binary(str(chance.choice(list(COMPARISONS))), x, alike)
        elif op == "select":
            new = graph.select(one([BOOL]), x, alike)
        elif op == "cast":
            new = graph.cast(x, DTYPES[int(chance.integers(len(DTYPES)))])
        elif op == "round":
            new = graph.unary(str(chance.choice(["sqrt", "floor", "ceil", "trunc", "rint", "abs", "neg"])), x)
        elif op == "arithmetic":
            new = graph.binary(str(chance.choice(["add", "sub", "mul", "min", "max"])), x, alike)
        elif op == "and":
            new = graph.binary(str(chance.choice(["and", "or", "xor"])), x, alike)
        elif op == "div":
            new = graph.binary("div", x, alike)
        elif op == "not":
            new = graph.unary(str(chance.choice(["not", "neg", "abs"])) if kind != "b" else "not", x)
        elif op == "shift":
            by = graph.const(int(chance.integers(8 * x.dtype.itemsize)), x.dtype)
            new = graph.binary(str(chance.choice(["shl", "shr"])), x, by)
        elif op == "rem":
            new = graph.binary("rem", x, graph.const(int(chance.integers(1, 100)), x.dtype))
        else:
            whole = {8: FLOAT, 4: np.dtype(np.float32)}.get(x.dtype.itemsize, x.dtype)
            new = graph.bits(x, whole)
            new = (
                graph.select(graph.binary("eq", new, new), new, graph.const(0.0, new.dtype)) if new.dtype.kind == "f" else new
            )  # no NaN's bits
        pool.append(new)


def random_trace(seed: int) -> tuple[Trace, list[Node], dict[Any, np.dtype[Any]]]:
    """A trace of random nodes: a state, arguments, and results of all types."""
    chance, graph = np.random.default_rng(seed), Graph()
    shapes = {f"s{i}": DTYPES[int(chance.integers(len(DTYPES)))] for i in range(8)} | {"s8": BOOL, "s9": FLOAT}
    arguments = {f"a{i}": DTYPES[int(chance.integers(len(DTYPES)))] for i in range(4)} | {"a4": FLOAT}

    def inputs(kind: str, named: dict[str, np.dtype[Any]], size: int) -> dict[str, np.ndarray]:
        out = {}
        for name, dtype in named.items():
            out[name] = np.array([[graph.input((kind, name, i), dtype) for i in range(size)]], object)
        return out

    here, args = inputs("state", shapes, 2), inputs("arguments", arguments, 3)
    pool = [node for held in (*here.values(), *args.values()) for node in held.flat]
    uniforms = [graph.uniform(f"u{i}", numbers(chance, dtype, 1)[0]) for i, dtype in enumerate([*DTYPES, FLOAT, FLOAT])]
    pool += uniforms + [graph.const(numbers(chance, dtype, 1)[0], dtype) for dtype in DTYPES]
    grown(graph, pool, chance, int(chance.integers(40, 240)))

    def picked(dtype: np.dtype[Any]) -> Node:
        fit = [node for node in pool[-60:] if node.dtype == dtype] or [node for node in pool if node.dtype == dtype]
        return fit[int(chance.integers(len(fit)))]

    state = {name: (nodes, np.array([[picked(shapes[name]) for _ in nodes[0]]], object)) for name, nodes in here.items()}
    results = {}
    for i in range(6):
        dtype = DTYPES[int(chance.integers(len(DTYPES)))] if i else FLOAT
        results[f"r{i}"] = np.array([[picked(dtype) for _ in range(int(chance.integers(1, 12)))]], object)
    return Trace(graph, state, args, results, None), uniforms, shapes


def same(got: np.ndarray, wanted: np.ndarray) -> bool:
    """Equal to the bit; of NaN the sign and the payload are nobody's."""
    got, wanted = np.broadcast_arrays(got, wanted)
    if got.dtype != wanted.dtype:
        return False
    if got.dtype.kind != "f":
        return bool((got == wanted).all())
    return bool((((got == wanted) & (np.signbit(got) == np.signbit(wanted))) | (np.isnan(got) & np.isnan(wanted))).all())


def as_numpy(program: Program, uniforms: list[Node], shapes: dict[str, Any], batch: int, values: Any, chance: np.random.Generator) -> None:
    """Three steps of a random trace, for other values of the numbers that all share if given."""
    trace, graph = program.trace, program.trace.graph
    if values:  # what the reference goes by
        graph._values = {node.id: values[node.attr] for node in uniforms}
    memory = program.rows(batch)
    call = program.call(memory)
    call.uniforms[:] = program.uniforms(values)
    state = {name: numbers(chance, dtype, 2 * batch).reshape(batch, 2) for name, dtype in shapes.items()}
    memory.put(state)
    for _ in range(3):
        given: dict[Any, np.ndarray] = {}
        for name, nodes in trace.arguments.items():
            held = call.arguments[name]
            held[...] = numbers(chance, held.dtype, held.size).reshape(held.shape)
            given |= {node.attr: held[:, i] for i, node in enumerate(nodes.flat)}
        given |= {node.attr: state[name][:, i] for name, (nodes, _) in trace.state.items() for i, node in enumerate(nodes.flat)}
        results = call()
        after = {name: evaluate(graph, list(new.flat), given) for name, (_, new) in trace.state.items()}
        held_state = memory.get(state)
        for name, columns in after.items():
            wanted = np.stack([np.broadcast_to(column, batch) for column in columns], 1).astype(shapes[name])
            assert same(held_state[name], wanted), (program.lanes, batch, name)
        for name, nodes in trace.results.items():
            for i, column in enumerate(evaluate(graph, list(nodes.flat), given)):
                assert same(results[name][:, i], np.asarray(column)), (program.lanes, batch, name, i, nodes.flat[i])
        state = held_state


@pytest.mark.thin(2)
@pytest.mark.parametrize("seed", range(24))
def test_random_graphs(seed: int) -> None:
    trace, uniforms, shapes = random_trace(seed)
    chance = np.random.default_rng(seed + 1000)
    batches = [1, 65, *(int(n) for n in chance.integers(2, 65, 2))]
    others = {node.attr: numbers(chance, node.dtype, 1)[0] for node in uniforms}
    for lanes in (2, 4, 8):
        program = Program(trace, lanes, least=int(chance.integers(1, 20)))
        for batch, values in zip(batches, (None, others, None, others), strict=True):
            as_numpy(program, uniforms, shapes, batch, values, chance)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_has_threads_of_its_own() -> None:
    """It would wait for those of its parent."""
    assert _pool(1).submit(int).result() == 0
    if child := os.fork():
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        return
    try:
        _pool(1).submit(int).result(timeout=20.0)
        os._exit(0)
    finally:
        os._exit(1)


def test_a_user_without_a_home_keeps_no_objects(monkeypatch: pytest.MonkeyPatch) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    for name in ("TAILGATE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert objects.folder() is None


def test_the_comparison_with_the_plain_loop_reaches_late_steps():
    """Code that is wrong from step 90 on is found, although the comparison plays 24 steps."""

    def played(late):
        def step(held, _=None):
            loop = held["loop"]
            x = loop["x"] + np.where(loop["k"] >= 90, late, 1.0)
            return {"loop": {"k": loop["k"] + 1, "x": x}}, {"x": x}

        return step

    def begun(rows):
        return {"loop": {"k": np.zeros(rows, np.int64), "x": np.arange(rows) * 1.0}}

    def later(held, steps):
        return {"loop": held["loop"] | {"k": held["loop"]["k"] + steps}}

    program = Program(traced(played(2.0), begun(1), {}))
    assert apart(program, begun(ROWS), played(2.0), 120, later) == ""
    assert apart(program, begun(ROWS), played(3.0), 120, later) == "loop.x, step 13"


@pytest.mark.parametrize("scenario, defence, attack", [("radar-following-v0", "kf", "echo_delay:trigger=near,threshold=60,delay=60"), ("stop-and-go-v0", "chi2_kf", "dos_hold:start_step=90")])
def test_an_attack_equals_the_plain_loop_at_late_steps(scenario, defence, attack):
    """At the later step the radar measures again. Traced code measures in every row, so an old reading would differ from it."""
    spec = Spec("defence", defence)
    loop = load_scenario(scenario).with_threat(budget=5).loop(spec.make(), spec.entry.uses)
    assert isinstance(rollout_of(loop, Spec("attack", attack).make()), Rollout)
