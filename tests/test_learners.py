"""The learners of Stable-Baselines3 and sb3-contrib: they learn, resume to the bit, and what they export plays as torch predicts."""

import hashlib
import json
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tailgate.agents.learners.learning import LEARNERS, check_action, learner_of
from tailgate.agents.policy.network_policy import PolicyAttack, load_policy
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.schema import build
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.play.trace import rollout
from tailgate.training import train

TASK = """
plant: car_following
sensor: {name: odometry, noise_var: [1.0, 1.0]}
controller: acc
manoeuvre: stop_and_go
horizon: 30
threat_model: {kinds: [fdi], fdi_bound: 6.0, budget: 5, onset: 1}
"""
PAID: dict[str, Any] = {  # six decisions, one of which can attack; only the error at the end pays, so that the last is the best
    "defence": "kf", "value": -6.0, "interval": 5, "reward": "final", "error_scale": 4.0, "gap_shaping": 0.0, "error_shaping": 0.0,
}  # fmt: skip
PPO = {"envs": 64, "rollout": 16, "batch_size": 256, "epochs": 6, "hidden": [16], "learning_rate": 0.003}
REPLAY = {"envs": 64, "hidden": [16], "learning_starts": 512, "batch_size": 64, "gradient_steps": 8, "buffer_size": 40_000}
SMALL: dict[str, tuple[dict[str, Any], str]] = {  # settings, and the action
    "ppo": (PPO, "mode"),
    "maskable_ppo": (PPO, "mode"),
    "recurrent_ppo": (PPO | {"memory": 8}, "mode"),
    "dqn": (REPLAY | {"explore": 8_000, "target_every": 512}, "mode"),
    "sac": (REPLAY, "continuous"),
    "tqc": (REPLAY | {"quantiles": 5}, "increment"),
}
EPISODES = 300


@pytest.fixture(scope="session")
def paid(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("task") / "task.yaml"
    path.write_text(TASK)
    return PAID | {"scenario": str(path)}


def learner(name: str, environment: dict[str, Any], seed: int = 0, **changes: Any) -> Any:
    settings, action = SMALL[name]
    module = learner_of(name)
    return module.Learner(seed, 0.99, build(module.Config, settings | changes, name), {"action": action} | environment)


def earned(path: Path | None, environment: dict[str, Any], action: str) -> float:
    """Mean return of fresh episodes under an exported policy, or at rest."""
    env = AdversaryVectorEnv(EPISODES, autoreset="disabled", engine="plain", **({"action": action} | environment))
    env.reset(seed=500_000_000)
    loop, total = env.seat.loop, np.zeros(EPISODES)
    rest = np.zeros(EPISODES, int) if env.seat.action.discrete else np.full((EPISODES, env.seat.action.size), -1.0)
    chosen = rest
    if path is not None:
        attack, start = PolicyAttack(path), draws.keys("train", range(EPISODES)).at(draws.Role.ATTACK, np.zeros(EPISODES))
        plan = attack.prepare(loop.brief)
        state = attack.start(plan, EPISODES, start)
    for _ in range(env.seat.decisions):
        if path is not None:
            state = attack.consider(plan, state, loop.sense(env.state), start)
            chosen = state.action
        _, reward, *_ = env.step(chosen)
        total += reward
    return float(total.mean())


@pytest.mark.parametrize(("name", "decisions"), [
    ("ppo", 14_000), pytest.param("maskable_ppo", 14_000, marks=pytest.mark.long), pytest.param("recurrent_ppo", 12_000, marks=pytest.mark.long),
    pytest.param("dqn", 24_000, marks=pytest.mark.long),
])  # fmt: skip
def test_it_learns_when_to_attack(name: str, decisions: int, paid: dict[str, Any], tmp_path: Path) -> None:
    """An attack at the last decision earns 0.68, one before it at most 0.45, rest 0.005: above 0.47 the timing is learned."""
    run = learner(name, paid)
    run.learn(decisions, lambda progress: None)
    assert earned(None, paid, "mode") < 0.02
    assert earned(run.export(tmp_path / "policy", {}), paid, "mode") > 0.47
    assert [entry["steps"] for entry in run.curve] == sorted({entry["steps"] for entry in run.curve}) and len(run.curve) > 3


def test_ppo_expects_nothing_behind_a_horizon_that_ends(paid: dict[str, Any]) -> None:
    """The buffer of Stable-Baselines3 holds the rewards of the environment; at a horizon that truncates, it adds a guess of what follows."""
    for ends in (True, False):
        run = learner("ppo", paid | {"horizon_ends": ends})
        wait, paid_out = run.env.step_wait, []

        def step_wait() -> Any:
            out = wait()  # noqa: B023
            paid_out.append(out[1].copy())  # noqa: B023 - it adds in place
            return out

        run.env.step_wait = step_wait
        run.learn(PPO["envs"] * PPO["rollout"], lambda progress: None)
        assert np.array_equal(run.model.rollout_buffer.rewards, paid_out) == ends


@pytest.mark.long
@pytest.mark.parametrize(("name", "least"), [("sac", 1.0), ("tqc", 0.35)])
def test_it_learns_what_to_inject(name: str, least: float, paid: dict[str, Any], tmp_path: Path) -> None:
    """Where every second of error pays: rest earns 0.19, and the policy much more; tqc moves a value by at most 0.5 in a step."""
    action, environment = SMALL[name][1], paid | {"reward": "error"}
    run = learner(name, environment)
    run.learn(7_000, lambda progress: None)
    assert earned(None, environment, action) < 0.25
    assert earned(run.export(tmp_path / "policy", {}), environment, action) > least


@pytest.mark.thin(6)
@pytest.mark.parametrize("name", SMALL)
def test_a_resumed_run_gives_the_policy_of_an_uninterrupted_one(name: str, paid: dict[str, Any], tmp_path: Path, same_bits: Any) -> None:
    """To the last bit, in networks, buffer, environments and curve: the interruption falls into the middle of episodes."""
    part, whole = 1200, 2200
    straight = learner(name, paid)
    straight.learn(whole, lambda progress: None)
    first = learner(name, paid)
    first.learn(part, lambda progress: None, tmp_path / "c.safetensors")
    assert part <= first.steps < whole and (first.env.batch.episodes.facts().step > 1).any()
    second = learner(name, paid)
    np.random.rand(5)  # noqa: NPY002 - a restarted process has other global states
    torch.rand(3)
    second.load(tmp_path / "c.safetensors")
    assert second.steps == first.steps
    second.learn(whole, lambda progress: None)
    modules, optimisers, single = straight._parts()
    again, _, others = second._parts()
    for module in modules:
        for key, value in modules[module].state_dict().items():
            assert same_bits(value.numpy(), again[module].state_dict()[key].numpy()), key
    assert optimisers and all(torch.equal(value, others[key]) for key, value in single.items())
    one, two = straight.held(), second.held()
    assert one.keys() == two.keys() and all(same_bits(one[key], two[key]) for key in one)
    one, two = straight.env.batch.episodes.held(), second.env.batch.episodes.held()
    assert all(same_bits(one[key], two[key]) for key in one)
    assert straight.curve == second.curve and straight.curve and straight.ended == second.ended
    a, b = straight.export(tmp_path / "a", {}), second.export(tmp_path / "b", {})
    assert a.with_suffix(".safetensors").read_bytes() == b.with_suffix(".safetensors").read_bytes()


@pytest.mark.long
@pytest.mark.parametrize("name", SMALL)
def test_two_runs_of_one_seed_are_equal_and_of_two_seeds_are_not(
    name: str, paid: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the digest of the policy's file; and a run leaves nothing among temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    digests = []
    for seed in (3, 3, 4):
        run = learner(name, paid, seed)
        run.learn(1000, lambda progress: None)
        digests.append(json.loads(run.export(tmp_path / "policy", {}).read_text())["sha256"])
        assert digests[-1] == hashlib.sha256((tmp_path / "policy.safetensors").read_bytes()).hexdigest()
    assert digests[0] == digests[1] != digests[2] and not [*(tmp_path / "temporary").iterdir()]


def predicted(run: Any, observation: Any, memory: Any, first: bool, mask: Any) -> tuple[Any, Any, Any]:
    """Torch's own deterministic action, what its output layer gives, and the memory after it."""
    model, seen = run.model, []
    head = {"dqn": lambda: model.q_net.q_net[-1], "sac": lambda: model.actor.mu, "tqc": lambda: model.actor.mu}
    hook = head.get(run.name, lambda: model.policy.action_net)().register_forward_hook(lambda layer, given, out: seen.append(out.detach().numpy()))
    if run.name == "recurrent_ppo":
        action, memory = model.predict(observation, memory, np.full(len(observation), first), deterministic=True)
    elif run.name == "maskable_ppo":
        action, memory = model.predict(observation, deterministic=True, action_masks=mask)
    else:
        action, memory = model.predict(observation, deterministic=True)
    hook.remove()
    return action, memory, np.tanh(seen[-1]) if run.name in ("sac", "tqc") else seen[-1]


PLAYED = [*((name, SMALL[name][1]) for name in SMALL), ("ppo", "increment"), ("recurrent_ppo", "continuous")]


@pytest.mark.thin(6)
@pytest.mark.parametrize(("name", "action"), PLAYED, ids=lambda value: str(value))
def test_what_is_exported_is_what_torch_predicts(name: str, action: str, paid: dict[str, Any], tmp_path: Path) -> None:
    """Over whole episodes: outputs within 1e-5, and the same actions; the policy played as an attack gives the very trace."""
    environment = paid | {"action": action, "interval": 2, "threat": {"cooldown": 4}}
    run = learner(name, environment)
    run.learn(1000, lambda progress: None)
    path = run.export(tmp_path / "policy", {})
    header, network = load_policy(path)
    assert header.masked == (name == "maskable_ppo") and header.recurrent == (name == "recurrent_ppo") and header.squashed == (name in ("sac", "tqc"))
    rows = 24
    env = AdversaryVectorEnv(rows, autoreset="disabled", engine="plain", **environment)
    attack, keys = PolicyAttack(path), draws.keys("train", range(rows))
    observation, _ = env.reset(seed=0)
    plan, start = attack.prepare(env.seat.loop.brief), keys.at(draws.Role.ATTACK, np.zeros(rows))
    state, memory, kinds = attack.start(plan, rows, start), None, []
    for k in range(env.seat.decisions):
        mask = env.action_masks() if env.seat.action.discrete else None
        state = attack.consider(plan, state, env.seat.loop.sense(env.state), start)
        expected, memory, outputs = predicted(run, observation, memory, k == 0, mask)
        mine = network(state.seen if state.memory is None else state.memory.hidden)
        np.testing.assert_allclose(mine, outputs, atol=1e-5)
        np.testing.assert_allclose(state.action, expected, atol=1e-5)
        if header.masked:
            assert mask[np.arange(rows), state.action].all()
        observation, *_ = env.step(state.action)
        kinds.append(env.frame.command.kind)
    played = rollout(env.seat.loop, PolicyAttack(path), keys)
    assert np.array_equal(np.array(kinds), played.kind[1::2])
    assert np.array_equal(env.frame.truth, played.truth[-1])


def test_the_masks_in_training_are_those_of_the_channel(paid: dict[str, Any]) -> None:
    """Nothing that MaskablePPO did was refused, though the budget was spent; PPO's choices are refused."""
    refused = {}
    for name in ("maskable_ppo", "ppo"):
        run = learner(name, paid, rest=0.5)
        episodes: Any = run.env.batch.episodes
        decide, count = episodes.decide, []

        def counted(*given: Any, decide: Any = decide, count: Any = count) -> Any:
            out = decide(*given)
            count.append(out.illegal.sum())
            return out

        episodes.decide = counted
        run.learn(2000, lambda progress: None)
        refused[name] = sum(count)
    assert refused["maskable_ppo"] == 0 < refused["ppo"]


@pytest.mark.parametrize("name", ["maskable_ppo", "dqn", "sac", "tqc"])
def test_a_learner_of_another_action_is_refused_at_once(name: str, paid: dict[str, Any]) -> None:
    """By one error that names the learner, the action, and what it can decide."""
    actions = learner_of(name).Learner.actions
    action = "mode" if "increment" in actions else "increment"
    with pytest.raises(InputError, match=rf"learner.*'{name}'.*action {action}.*{actions[0]}"):
        check_action(name, Seat.make(**(paid | {"action": action})))
    with pytest.raises(InputError, match="learner"):
        learner(name, paid | {"action": action})
    for free in ("ppo", "cem", "recurrent_ppo"):
        check_action(free, Seat.make(**(paid | {"action": action})))


@pytest.mark.parametrize(
    ("name", "field", "value"),
    [
        ("dqn", "buffer_size", 100), ("sac", "batch_size", 1), ("tqc", "drop", 5), ("maskable_ppo", "batch_size", 100), ("recurrent_ppo", "batch_size", 1),
        ("dqn", "epsilon", 2.0), ("sac", "entropy", 0.0), ("ppo", "envs", 2_000_000), ("recurrent_ppo", "memory", 0),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit_are_refused(name: str, field: str, value: Any, paid: dict[str, Any]) -> None:
    """By the name of learner and field."""
    with pytest.raises(InputError, match=rf"{name}\.{field}"):
        learner(name, paid, **{field: value})


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "action", "rate"),
    [
        ("ppo", "continuous", 1e30), ("ppo", "mode", 1e30), ("maskable_ppo", "mode", 1e30),
        ("sac", "continuous", 1e30),
    ],
)  # fmt: skip
def test_a_policy_that_diverges_is_an_error_of_the_step_size(name: str, action: str, rate: float, paid: dict[str, Any], tmp_path: Path) -> None:
    """Whatever torch says of it; no checkpoint is left at the end."""
    run = learner(name, paid | {"action": action}, learning_rate=rate)
    with pytest.raises(InputError, match=rf"config\.{name}\.learning_rate: got {re.escape(str(rate))}; expected .* stays finite"):
        run.learn(4000, lambda progress: None, tmp_path / "c.safetensors")
    assert not (tmp_path / "c.safetensors").exists()
    with pytest.raises(InputError, match=r"learning_rate: got 1e\+38; expected less"):
        learner(name, paid | {"action": action}, learning_rate=1e38)


@pytest.mark.long
def test_a_policy_that_is_not_finite_is_found_where_nothing_fails(paid: dict[str, Any], tmp_path: Path) -> None:
    """The largest of values that are no numbers is a choice like any other: DQN plays on, and its end says so."""
    run = learner("dqn", paid)

    def spoil(progress: Any) -> None:
        with torch.no_grad():
            run.model.q_net.q_net[-1].bias.fill_(torch.nan)

    with pytest.raises(InputError, match=r"config\.dqn\.learning_rate: got 0\.001; expected .* stays finite"):
        run.learn(2000, spoil, tmp_path / "c.safetensors")
    assert run.steps >= 2000 and not (tmp_path / "c.safetensors").exists()


def test_other_errors_in_training_stay_what_they_are(paid: dict[str, Any]) -> None:
    """An error of a callback is not blamed on the step size."""

    def report(progress: Any) -> None:
        raise RuntimeError("the line is dead")

    with pytest.raises(RuntimeError, match="the line is dead"):
        learner("ppo", paid).learn(2000, report)


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", ["maskable_ppo", "recurrent_ppo", "dqn", "sac"])
def test_a_checkpoint_that_does_not_fit_is_refused(name: str, paid: dict[str, Any], tmp_path: Path) -> None:
    """Cut off, of another seed, of other settings, of another learner."""
    path = tmp_path / "c.safetensors"
    learner(name, paid).learn(800, lambda progress: None, path)
    other = {"maskable_ppo": "ppo", "recurrent_ppo": "ppo", "dqn": "ppo", "sac": "tqc"}[name]
    for stranger in (learner(name, paid, seed=1), learner(name, paid, learning_rate=0.1), learner(other, paid)):
        with pytest.raises(InputError, match="checkpoint"):
            stranger.load(path)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(InputError, match="checkpoint"):
        learner(name, paid).load(path)


def test_random_actions_rest_more_often_than_not(paid: dict[str, Any]) -> None:
    """They attack in the share that the settings say, row by row, and use every attack and every value."""
    for name in ("dqn", "sac"):
        explorer = learner(name, paid, attack=0.2).model.explorer
        drawn = explorer.actions(20_000)
        trigger = drawn if name == "dqn" else drawn[:, 0]
        assert np.mean(trigger > 0) == pytest.approx(0.2, abs=3.3 * 0.2 * 0.8**0.5 / 0.2**0.5 / 20_000**0.5)
        if name == "dqn":
            assert set(np.unique(drawn)) == {0, 1, 2}
        else:
            assert drawn.dtype == np.float32 and np.abs(drawn[:, 1:].mean(axis=0)).max() < 3.3 / 3**0.5 / 20_000**0.5


def test_every_learner_can_be_configured() -> None:
    """Its defaults fit, and a run's configuration has a field for it."""
    for name in LEARNERS:
        config = learner_of(name).Config()
        config.check()
        assert hasattr(train.TrainConfig(), name)
    assert set(SMALL) | {"cem"} == set(LEARNERS)
