"""CUDA's text, compiled for this processor, gives the bits of numpy: random graphs, buffers, environments with restarts, whole episodes."""

import copy
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate import num
from tailgate.core import draws
from tailgate.engine.cards import playing_on
from tailgate.engine.evaluation import evaluate
from tailgate.engine.graph import Graph
from tailgate.engine.matrices import dense
from tailgate.engine.on_device import CudaProgram
from tailgate.engine.operations import BINARY, BOOL, COMPARISONS, DTYPES, UNARY
from tailgate.engine.parameters import lifted
from tailgate.engine.tracing import Trace as Nodes
from tailgate.engine.tracing import traced
from tailgate.play.commanded import commanded
from tailgate.play.rollouts import Rollout, rollout_of
from tailgate.play.trace import Trace, rollout

from . import test_engine_arrays as arrays
from . import test_engine_buffers as buffers
from .card import HostCard, host_card, needs_compiler
from .engines import as_plain, loop_of
from .test_engine import as_numpy, numbers, random_trace
from .test_engine import same as alike

__all__ = ["host_card"]
pytestmark = [needs_compiler, pytest.mark.usefixtures("host_card")]


@pytest.mark.thin(9)
@pytest.mark.parametrize("seed", range(36))
def test_random_graphs(seed: int) -> None:
    trace, uniforms, shapes = random_trace(seed)
    chance = np.random.default_rng(seed + 2000)
    program = CudaProgram(trace, least=int(chance.integers(1, 20)))
    as_numpy(program, uniforms, shapes, 65, None, chance)
    as_numpy(program, uniforms, shapes, 1, {node.attr: numbers(chance, node.dtype, 1)[0] for node in uniforms}, chance)


def test_every_operation() -> None:
    """On odd numbers of every type: with each other, with a constant, and with a number that all episodes share."""
    graph, chance, batch = Graph(), np.random.default_rng(4), 300
    inputs, results, given = {}, {}, {}
    for dtype in DTYPES:
        key = dtype.str[1:]
        nodes = [graph.input(("arguments", key, i), dtype) for i in range(2)]
        inputs[key] = np.array([nodes], object)
        given |= {node.attr: numbers(chance, dtype, batch) for node in nodes}
        seven = graph.uniform(f"u{key}", np.array(7 if dtype.kind in "iu" else 1).astype(dtype))
        others = [nodes[1], graph.const(3 if dtype.kind in "iu" else 1, dtype), seven]
        made = [graph.unary(op, nodes[0]) for op in UNARY if _fits(op, dtype)]
        for other in others:
            made += [graph.binary(op, *pair) for op in (*BINARY, *COMPARISONS) for pair in ((nodes[0], other), (other, nodes[0])) if _fits(op, dtype, pair[1])]
            made.append(graph.select(graph.input(("arguments", "b1", 0), BOOL), nodes[0], other))
        made += [graph.cast(nodes[0], to) for to in DTYPES]
        for i, node in enumerate(made):
            results[f"{key} {i} {node.op}"] = np.array([[node]], object)
    program = CudaProgram(Nodes(graph, {}, inputs, results, None))
    call = program.call(program.rows(batch))
    for key, nodes in inputs.items():
        for i, node in enumerate(nodes[0]):
            call.arguments[key][:, i] = given[node.attr]
    got = call()
    for name, nodes in results.items():
        (wanted,) = evaluate(graph, [nodes[0, 0]], given)
        assert alike(got[name][:, 0], np.asarray(wanted)), (name, nodes[0, 0])


def _fits(op: str, dtype: np.dtype[Any], by: Any = None) -> bool:
    """An operation is defined for a type; shifts and remainders are by constants."""
    if op in ("sqrt", "floor", "ceil", "trunc", "rint", "div"):
        return dtype.kind == "f"
    if op in ("shl", "shr", "rem"):
        return dtype.kind in "iu" and by is not None and by.op == "const"
    if op in ("and", "or", "xor", "not"):
        return dtype.kind in "biu"
    return dtype != BOOL or op in COMPARISONS


def test_numpys_functions() -> None:
    """All of a component's language in one program: loops until convergence, tables, rings, choices, reductions."""
    given, batch = arrays.arrays(45), 45
    with np.errstate(all="ignore"):
        wanted = {name: np.asarray(function(**copy.deepcopy(given))) for name, function in arrays.CASES.items()}
    trace = traced(
        lambda _, held: ((), {name: function(**{k: held[k].copy() for k in held}) for name, function in arrays.CASES.items()}),
        (), {k: v[:1] for k, v in given.items()},
    )  # fmt: skip
    program = CudaProgram(trace)
    call = program.call(program.rows(batch))
    for key, value in given.items():
        call.arguments[key][...] = value
    for name, got in call().items():
        assert got.shape == wanted[name].shape and alike(got, wanted[name]), name


def test_loops_products_and_shared_numbers() -> None:
    """Rows stop in different rounds; a dense matrix that is not square; numbers that change between calls, in tables too."""
    weights, batch = np.random.default_rng(1).normal(size=(10, 7)), 40
    table = np.random.default_rng(2).normal(size=(300, 2))

    def step(held: Any, scale: Any = 1.0, weights: Any = weights, table: Any = table) -> Any:
        def halve(x: Any, n: Any) -> Any:
            return x > 2.0, [x * 0.5, n + 1]

        count = num.until(halve, [held["x"], np.zeros(len(held["x"]), np.int64)], held["x"] > 1.0, 30)
        layer = dense(held["v"], weights, table[0, :1] + np.zeros(7))
        return {"n": count[1], "y": layer * scale, "t": num.take(table, held["i"])}

    chance = np.random.default_rng(0)
    given = {"x": chance.uniform(0.1, 5000.0, batch), "v": chance.normal(size=(batch, 10)), "i": chance.integers(0, 300, batch)}

    def shared(state: Any, held: Any) -> Any:
        return state, step(held, *lifted(held["x"], (3.0, weights, table)))

    program = CudaProgram(traced(shared, (), {k: v[:1] for k, v in given.items()}))
    call = program.call(program.rows(batch))
    for key, value in given.items():
        call.arguments[key][...] = value
    for scale, factor in ((3.0, 1.0), (0.5, 2.0)):
        values = [np.array([scale]), (weights * factor).ravel(), (table * factor).ravel()]
        call.uniforms[:] = program.uniforms(values)
        got, wanted = call(), step(given, scale, weights * factor, table * factor)
        for name, value in wanted.items():
            assert alike(got[name], np.asarray(value)), name
    assert len(set(wanted["n"])) > 5


@pytest.mark.long
def test_nothing_is_undefined_in_c(tmp_path: Any) -> None:
    """No overflow with a sign, no conversion beyond a type, no shift too far: a card would do otherwise than this processor."""
    checks = "-fsanitize=undefined -fsanitize=float-cast-overflow -fsanitize-undefined-trap-on-error"
    some = "every_operation or numpys_functions or shared_numbers or (random_graphs and 0)"
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__, "-k", some]
    made = {"HOST_OPTIONS": checks, "TAILGATE_CACHE": str(tmp_path)}
    done = subprocess.run(words, env=os.environ | made, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]


OFTEN = ("elementwise", "types", "sparse", "dense", "inverses", "rare", "in a loop", "read in other places")


@pytest.mark.thin(6)
@pytest.mark.parametrize("name", [pytest.param(name, marks=[] if name in OFTEN else [pytest.mark.long]) for name in buffers.CASES])
def test_buffers(name: str, host_card: HostCard) -> None:
    function, batch = buffers.CASES[name], 137  # more warps than run at once: they share their rooms
    given = buffers.state(batch)
    with np.errstate(all="ignore"):
        wanted = np.asarray(function(copy.deepcopy(given)))
    trace = traced(lambda held, _: (held, {"out": function(dict(held))}), {k: v[:1] for k, v in given.items()}, {})
    program = CudaProgram(trace)
    rows = program.rows(batch)
    rows.put(given)
    call = program.call(rows)
    got = call()["out"]
    np.testing.assert_array_equal(buffers.bits(got), buffers.bits(wanted))
    if program.room:  # each warp has its own
        held = np.zeros(call._room.size, np.uint8)
        host_card.fetch(held, call._room.at)
        assert held.reshape(-1, program.room)[: host_card.warps].any(axis=1).all()


@pytest.mark.parametrize("steps", [1, 5])
def test_states_that_move_between_buffers(steps: int) -> None:
    """Exchanged, kept, begun again and grown, in both kernels."""

    def step(held: buffers.Row, given: buffers.Row) -> Any:
        a, b, again = held["a"], held["b"], given["again"][:, None, None]
        c, k = held["c"] + 0.5 * a, held["k"]
        new = {"a": np.where(again, buffers.FRESH, b), "b": a, "c": np.where(again, b, c), "d": held["d"], "k": held["l"], "l": k + 1}
        return new, {"sum": a * b, "k": k}

    chance, batch = np.random.default_rng(2), 37
    wide: dict[str, Any] = {key: chance.normal(size=(batch, 16, buffers.N)) for key in "abcd"}
    wide |= {"k": chance.integers(0, 9, batch), "l": chance.integers(0, 9, batch)}
    program = CudaProgram(traced(step, {k: v[:1] for k, v in wide.items()}, {"again": np.zeros(1, bool)}))
    rows = program.rows(batch)
    rows.put(wide)
    call = program.call(rows, steps)
    for _ in range(3):
        again = chance.random((steps, batch)) < 0.3
        call.arguments["again"][...] = again if steps > 1 else again[0]
        got = call()
        for i in range(steps):
            wide, wanted = step(wide, {"again": again[i]})
            for key, value in wanted.items():
                np.testing.assert_array_equal(got[key][i] if steps > 1 else got[key], value)
        for key, leaf in wide.items():
            np.testing.assert_array_equal(rows.get_leaf(key), leaf)


ENVIRONMENTS = [
    {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf"},
    {"scenario": "radar-following-v0", "defence": "cra"},
    {"scenario": "platoon-gusty-v0", "defence": "lasso_dkf"},
    {"scenario": "network-noisy-v0", "defence": "dkf", "reward": "error", "action": "mode", "interval": 3},
    {"scenario": "gusty-stop-and-go-v0", "defence": "imm", "action": "continuous"},
    {"scenario": "platoon-gusty-v0", "defence": "chi2_dkf"},
    {"scenario": "platoon-lossy-v0", "defence": "norm_resilient"},
    {"scenario": "thesis-ch5-v0", "defence": "norm_resilient", "reward": "error"},
]


@pytest.mark.long
@pytest.mark.parametrize("arguments", [pytest.param(one, marks=[pytest.mark.long] if i > 0 else [], id=f"{one['scenario']}, {one['defence']}") for i, one in enumerate(ENVIRONMENTS)])  # fmt: skip
def test_environments(arguments: dict[str, Any], tmp_path: Any) -> None:
    as_plain(arguments, 67, tmp_path, device="cuda")


EPISODES = [
    ("gusty-stop-and-go-v0", "chi2_kf", "fdi_ramp:start_step=20,rate=0.3", True),
    ("platoon-gusty-v0", "dkf", "fdi:start_step=20,value=30", True),
    ("radar-following-v0", "cra", "dos_jam:start_step=30,low=-3,high=3", False),
    ("network-noisy-v0", "dkf", "none", True),
    ("platoon-gusty-v0", "lasso_dkf", "dropout:start_step=30,probability=0.5", False),
    ("platoon-20-v0", "saturated_dkf", "fdi:start_step=20,value=-50", True),
]


@pytest.mark.thin(4)
@pytest.mark.parametrize("scenario, defence, attack, whole", [pytest.param(*one, marks=[pytest.mark.long] if i > 2 else []) for i, one in enumerate(EPISODES)])
def test_whole_episodes(scenario: str, defence: str, attack: str, whole: bool) -> None:
    """Hashes of every signal: with the attack on the card, several steps a launch; and with the attack in plain code."""
    loop, rival = loop_of(scenario, defence, attack, 60 if whole else 40)
    keys = draws.keys("report", range(67))
    plain = rollout(loop, rival, keys, plain=True)
    with playing_on("cuda"):
        if whole:
            made = rollout_of(loop, rival)
            assert isinstance(made, Rollout) and isinstance(made.program, CudaProgram), made
            fast = rollout(loop, rival, keys)
        else:
            fast = Trace(loop.model, loop.horizon, *commanded(loop).play(rival, keys, True), loop.controller.desired_gap)
    assert np.array_equal(fast.length, plain.length)
    assert [fast.trace_hash(b) for b in range(67)] == [plain.trace_hash(b) for b in range(67)]
