"""CUDA's text, compiled for this processor, gives the bits of numpy: random graphs, buffers, environments with restarts, whole episodes."""

import copy
from typing import Any

import numpy as np
import pytest

from tailgate.core import draws
from tailgate.engine.cards import playing_on
from tailgate.engine.on_device import CudaProgram
from tailgate.engine.program import traced
from tailgate.play.commanded import commanded
from tailgate.play.rollouts import Rollout, rollout_of
from tailgate.play.trace import Trace, rollout

from . import test_engine_buffers as buffers
from .card import host_card, needs_compiler
from .engines import as_plain, loop_of
from .test_engine import as_numpy, numbers, random_trace

__all__ = ["host_card"]
pytestmark = [needs_compiler, pytest.mark.usefixtures("host_card")]


@pytest.mark.thin(6)
@pytest.mark.parametrize("seed", range(36))
def test_random_graphs(seed: int) -> None:
    trace, uniforms, shapes = random_trace(seed)
    chance = np.random.default_rng(seed + 2000)
    program = CudaProgram(trace, least=int(chance.integers(1, 20)))
    as_numpy(program, uniforms, shapes, 65, None, chance)
    as_numpy(program, uniforms, shapes, 1, {node.attr: numbers(chance, node.dtype, 1)[0] for node in uniforms}, chance)


@pytest.mark.thin(4)
@pytest.mark.parametrize("name", buffers.CASES)
def test_buffers(name: str) -> None:
    function, batch = buffers.CASES[name], 137  # more warps than run at once: they share their rooms
    given = buffers.state(batch)
    with np.errstate(all="ignore"):
        wanted = np.asarray(function(copy.deepcopy(given)))
    trace = traced(lambda held, _: (held, {"out": function(dict(held))}), {k: v[:1] for k, v in given.items()}, {})
    program = CudaProgram(trace)
    rows = program.rows(batch)
    rows.put(given)
    got = program.call(rows)()["out"]
    np.testing.assert_array_equal(buffers.bits(got), buffers.bits(wanted))


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


@pytest.mark.parametrize("arguments", [pytest.param(one, marks=[pytest.mark.long] if i > 1 else [], id=f"{one['scenario']}, {one['defence']}") for i, one in enumerate(ENVIRONMENTS)])  # fmt: skip
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


@pytest.mark.parametrize("scenario, defence, attack, whole", [pytest.param(*one, marks=[pytest.mark.long] if i > 2 else []) for i, one in enumerate(EPISODES)])
def test_whole_episodes(scenario: str, defence: str, attack: str, whole: bool) -> None:
    """Hashes of every signal: with the attack on the card, several steps a launch; and with the attack in plain code."""
    loop, rival = loop_of(scenario, defence, attack, 90 if whole else 40)
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
