"""The traced engine beside the plain loop, for the tests of each plant."""

import dataclasses

import numpy as np

from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.play.commanded import Commanded, commanded
from tailgate.play.trace import Trace, rollout


def loop_of(scenario, defence, attack, horizon=200, beyond=None, **threat):
    """`beyond`: changes of the threat model that no file may make."""
    made = Spec("attack", attack)
    changes = {"knowledge": getattr(made.make(), "knowledge", made.entry.knowledge)} | threat
    guard = Spec("defence", defence)
    place = load_scenario(scenario).with_threat(**changes)
    place = dataclasses.replace(place, threat_model=dataclasses.replace(place.threat_model, **(beyond or {})))
    loop = place.loop(guard.make(), guard.entry.uses)
    object.__setattr__(loop, "horizon", min(horizon, place.horizon))
    return loop, made.make()


def same(one, two):
    if isinstance(one, dict):
        assert one.keys() == two.keys()
        for key in one:
            same(one[key], two[key])
    else:
        assert one.dtype == two.dtype and np.array_equal(one, two, equal_nan=True)


def told(loop, rival, keys, terminate=True):
    """Episodes of a traced loop under an attack in plain code."""
    program = commanded(loop)
    assert isinstance(program, Commanded), program
    return Trace(loop.model, loop.horizon, *program.play(rival, keys, terminate), loop.controller.desired_gap)


def trace_as_plain(loop, rival):
    """67 episodes, no whole number of vectors: every signal's hash, and the lengths. -> the plain loop's trace."""
    keys = draws.keys("report", range(67))
    fast, plain = told(loop, rival, keys), rollout(loop, rival, keys, plain=True)
    assert np.array_equal(fast.length, plain.length)
    assert [fast.trace_hash(b) for b in range(67)] == [plain.trace_hash(b) for b in range(67)]
    assert {name: column.dtype for name, column in fast.signals.items()} == {name: column.dtype for name, column in plain.signals.items()}
    assert all(np.array_equal(fast.first[name], plain.first[name]) for name in plain.first)
    return plain


def as_plain(arguments, rows, folder, engine="traced", device="cpu"):
    """So many rows of both engines, in a scenario so short that all begin again; some are reset by a mask, one in two of them with a seed."""
    text = folder / "short.yaml"
    text.write_text(short(arguments["scenario"]))
    arguments = arguments | {"scenario": str(text)}
    one, two = AdversaryVectorEnv(rows, engine=engine, device=device, **arguments), AdversaryVectorEnv(rows, engine="plain", **arguments)
    assert (one.engine, two.engine) == (engine, "plain") and (one.device, two.device) == (device, "cpu")
    for first, second in zip(one.reset(seed=3), two.reset(seed=3), strict=True):
        same(first, second)
    rng, ended = np.random.default_rng(0), 0
    for t in range(130):
        if one.seat.action.discrete:
            actions = np.where(rng.random(rows) < 0.6, 0, rng.integers(0, one.seat.action.size, rows))
        else:
            actions = np.clip(rng.uniform(-1.2, 1.2, (rows, one.seat.action.size)), -1.0, 1.0).astype(np.float32)  # the ends among them
        results = one.step(actions), two.step(actions)
        for first, second in zip(*results, strict=True):
            same(*(value if isinstance(value, dict) else np.asarray(value) for value in (first, second)))
        ended += int((results[0][2] | results[0][3]).sum())
        if t == 60:
            mask = np.arange(rows) % 3 == 0
            seeds = [int(i) if here and i % 2 == 0 else None for i, here in enumerate(mask)]
            for first, second in zip(*(env.reset(seed=seeds, options={"reset_mask": mask}) for env in (one, two)), strict=True):
                same(first, second)
        if t == 90:
            kept = one.episodes.held()
            one.step(actions)
            one.episodes.put(kept)
            one.observed, one.over = two.observed.copy(), two.over.copy()
    assert ended >= rows and np.array_equal(one.episode, two.episode)


def short(name):
    """A scenario of 60 steps, so that rows begin again."""
    from importlib.resources import files

    import yaml

    data = yaml.safe_load(files("tailgate.configs").joinpath(f"scenarios/{name}.yaml").read_text())
    data["horizon"] = 60
    data["threat_model"] = data["threat_model"] | {"onset": 5, "end": 55}
    return yaml.safe_dump(data)
