"""Policies with memory, under masks, or squashed."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tailgate.agents.policy.network_policy import PolicyAttack, Yoked, choose, load_policy, save_policy
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.neural import Lstm, Memory, Network
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.play.trace import rollout

THREAT: dict[str, Any] = {"budget": 20, "kinds": ["dos_jam", "fdi"], "fdi_bound": 5.0}
SEEDS = list(range(12))
PLACE = dataclasses.replace(load_scenario("gusty-stop-and-go-v0"), horizon=240).with_threat(**THREAT, knowledge="black")


def _special(path: Path, kind: str, seed: int = 1) -> Path:
    """A random policy with an LSTM, under masks, or squashed, that attacks now and then."""
    brief, rng = PLACE.brief(), np.random.default_rng(seed)
    spec = ActionSpec(action="increment" if kind == "squashed" else "mode", interval=3)
    codec, names, width = ActionCodec(spec, brief), ObservationCodec(brief).names, 8
    lstm = Lstm(rng.normal(size=(len(names) + width, 4 * width)), rng.normal(size=4 * width)) if kind == "recurrent" else None
    inputs = width if lstm else len(names)
    network = Network((2.0 * rng.normal(size=(inputs, codec.size)),), (rng.normal(size=codec.size),), None, lstm, kind == "squashed")
    header = {"action": spec, "observation": names, "knowledge": "black", "masked": kind == "masked", "greedy": kind == "squashed"}
    return save_policy(path / "policy", network, header)


@pytest.mark.thin(3)
@pytest.mark.parametrize("kind", ["recurrent", "masked", "squashed"])
def test_a_policy_of_every_kind_plays_alone_as_in_company_and_steps_as_it_plays(tmp_path: Path, kind: str, same_bits: Any) -> None:
    """A batch of 1 and a row of 64 agree to the bit, and so do the environment stepped by hand and the attack."""
    path = _special(tmp_path, kind)
    header, network = load_policy(path)
    assert (header.recurrent, header.masked, header.squashed) == (kind == "recurrent", kind == "masked", kind == "squashed")
    loop, keys = PLACE.loop(Spec("defence", "kf").make()), draws.keys("train", range(64))
    together = rollout(loop, PolicyAttack(path), keys)
    assert (together.kind != 0).any() and len({together.trace_hash(i) for i in range(64)}) == 64
    assert [rollout(loop, PolicyAttack(path), draws.keys("train", [i])).trace_hash(0) for i in (0, 1, 63)] == [together.trace_hash(i) for i in (0, 1, 63)]
    env = AdversaryVectorEnv(64, scenario=PLACE, defence="kf", threat=THREAT, autoreset="disabled", engine="plain", action=header.action.action, interval=3)
    observation, _ = env.reset(seed=0)
    memory = None if network.lstm is None else network.lstm.blank(64)
    attacked = []
    for _ in range(env.seat.decisions):
        read = observation
        if memory is not None:
            memory = network.lstm(observation, memory)
            read = memory.hidden
        mask = env.action_masks() if header.masked else None
        observation, *_ = env.step(choose(network, env.seat.action, read, mask=mask))
        attacked.append(env.frame.command.kind)
        env.over[:] = False
    alive = rollout(loop, PolicyAttack(path), keys, terminate=False)
    assert same_bits(np.array(attacked), alive.kind[2::3])


@pytest.mark.thin(2)
@pytest.mark.parametrize("kind", ["recurrent", "masked", "squashed"])
def test_a_yoked_policy_of_every_kind_attacks_when_its_schedule_says(tmp_path: Path, kind: str) -> None:
    """The memory goes on, the masks give way: the schedule is one of attacks that were accepted."""
    loop, keys = PLACE.loop(Spec("defence", "kf").make()), draws.keys("report", SEEDS)
    schedule = np.zeros((loop.horizon, len(SEEDS)), bool)
    for row in range(len(SEEDS)):
        schedule[100 + 10 * row : 105 + 10 * row, row] = True
    trace = rollout(loop, Yoked(PolicyAttack(_special(tmp_path, kind)), schedule), keys, terminate=False)
    assert np.array_equal(trace.kind != 0, schedule)


def test_an_lstm_is_that_of_its_definition() -> None:
    """c+ = s(f) c + s(i) tanh(g), h+ = s(o) tanh(c+), with the gates in the order i, f, g, o; large inputs saturate."""
    rng = np.random.default_rng(0)
    lstm = Lstm(rng.normal(size=(7, 16)), rng.normal(size=16))
    x, h, c = rng.normal(size=(5, 3)), rng.normal(size=(5, 4)), rng.normal(size=(5, 4))
    i, f, g, o = np.split(np.concatenate([x, h], axis=1) @ lstm.weight + lstm.bias, 4, axis=1)
    cell = c / (1 + np.exp(-f)) + np.tanh(g) / (1 + np.exp(-i))
    after = lstm(x, Memory(h, c))
    np.testing.assert_allclose(after.cell, cell, atol=1e-14)
    np.testing.assert_allclose(after.hidden, np.tanh(cell) / (1 + np.exp(-o)), atol=1e-14)
    assert np.isfinite(lstm(1e6 * x, Memory(h, c)).hidden).all()


def test_a_memory_starts_anew_with_an_episode(tmp_path: Path) -> None:
    """At step 1 nothing is left of what the row remembered before."""
    path = _special(tmp_path, "recurrent")
    loop, keys = PLACE.loop(Spec("defence", "kf").make()), draws.keys("train", range(6))
    attack, start = PolicyAttack(path), keys.at(draws.Role.ATTACK, np.ones(6))
    plan, view = attack.prepare(loop.brief), loop.sense(loop.start(keys))
    blank = attack.start(plan, 6, start)
    assert blank.memory is not None
    used = blank._replace(memory=Memory(blank.memory.hidden + 0.7, blank.memory.cell - 2.0))
    fresh, again = (attack.consider(plan, state, view, start) for state in (blank, used))
    assert fresh.memory is not None and again.memory is not None
    assert np.array_equal(fresh.memory.hidden, again.memory.hidden) and np.array_equal(fresh.memory.cell, again.memory.cell)


@pytest.mark.parametrize("damage", ["missing", "other width", "no gates", "not finite", "bias", "log_std"])
def test_tensors_that_do_not_fit_are_refused(tmp_path: Path, damage: str) -> None:
    """Of an LSTM as of a layer, in one error that names the tensor."""
    path = _special(tmp_path, "recurrent")
    tensors = dict(load_tensors(path.with_suffix(".safetensors").read_bytes()))
    weight = tensors["lstm.weight"]
    match damage:
        case "missing":
            del tensors["lstm.bias"]
        case "other width":
            tensors["lstm.weight"] = np.vstack([weight, weight[:1]])
        case "no gates":
            tensors |= {"lstm.weight": np.ascontiguousarray(weight[:, :-1]), "lstm.bias": tensors["lstm.bias"][:-1].copy()}
        case "not finite":
            tensors["lstm.weight"] = np.where(weight == weight.max(), np.nan, weight)
        case "bias":
            tensors["lstm.bias"] = tensors["lstm.bias"][:-1].copy()
        case "log_std":
            tensors["log_std"] = np.zeros(9)
    blob = save_tensors(tensors)
    path.with_suffix(".safetensors").write_bytes(blob)
    path.write_text(json.dumps(json.loads(path.read_text()) | {"sha256": hashlib.sha256(blob).hexdigest()}))
    with pytest.raises(InputError, match="log_std" if damage == "log_std" else "lstm"):
        load_policy(path)


def test_a_policy_without_a_distribution_is_not_drawn_from(tmp_path: Path) -> None:
    """And masks and squashing belong to the kind of action that they are made for."""
    path = _special(tmp_path, "squashed")
    with pytest.raises(InputError, match=r"stochastic.*no distribution"):
        PolicyAttack(path, stochastic=True).prepare(PLACE.brief())
    path.write_text(json.dumps(json.loads(path.read_text()) | {"masked": True}))
    with pytest.raises(InputError, match=r"masked.*increment"):
        PolicyAttack(path).prepare(PLACE.brief())
    path = _special(tmp_path, "masked")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"squashed": True, "masked": False}))
    with pytest.raises(InputError, match=r"squashed.*mode"):
        PolicyAttack(path).prepare(PLACE.brief())
