"""Rewards: shaping, what each pays, peaks of the error."""

import dataclasses

import gymnasium
import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.gym.rewards import NEAR, Reward
from tailgate.envs.gym.sb3 import BatchVecEnv
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout


def _episode(interval=1, shaped=True, **options):
    """Environments with the same episodes, with shaping if asked and without it: first themselves, then their outputs per step."""
    envs = []
    for extra in ([{}] if shaped else []) + [{"gap_shaping": 0.0, "error_shaping": 0.0}]:
        options |= {"scenario": "gusty-stop-and-go-v0", "value": -20.0, "interval": interval}
        env = AdversaryVectorEnv(8, engine="plain", autoreset="disabled", **options, **extra)
        env.seat = env.episodes.seat = dataclasses.replace(env.seat, loop=dataclasses.replace(env.seat.loop, horizon=240))
        env.reset(seed=0)
        envs.append(env)
    yield envs, None
    rng = np.random.default_rng(0)
    while True:
        actions = rng.integers(0, envs[0].seat.action.size, 8)
        pair = [env.step(actions) for env in envs]
        yield envs, pair
        if (pair[0][2] | pair[0][3]).any():
            return


@pytest.mark.parametrize("ends", [False, True])
@pytest.mark.parametrize("interval", [1, 5])
@pytest.mark.parametrize("reward", ["collision", "min_gap", "error", "stealth"])
@pytest.mark.thin(9)
def test_shaping_telescopes(reward, interval, ends):
    """Shaping adds gamma^T Phi(end) - Phi(start) in all. Phi(end) is 0 at an end for good, so no policy gains; a cut-off end keeps it."""
    total, discount = np.zeros(8), 1.0
    episode = _episode(reward=reward, gamma=0.97, interval=interval, horizon_ends=ends)
    (shaped, _), _ = next(episode)
    start = shaped.tally.potential.copy()
    assert start.min() > 0.05
    for _, (one, two) in episode:
        total += discount * (one[1] - two[1])
        discount *= 0.97
        terminated = one[2]
    assert (terminated ^ one[3]).all() and (terminated.all() if ends else one[3].any())
    end = np.where(terminated, 0.0, shaped.tally.potential)
    np.testing.assert_allclose(total, discount * end - start, atol=1e-12)


@pytest.mark.parametrize("interval", [1, 5])
@pytest.mark.thin(2)
def test_raw_rewards(interval):
    """collision pays 1 at a crash; min_gap also the fall of the smallest gap below 20 m, over 20 m; error and stealth per second."""
    paid = {name: np.zeros(8) for name in ("collision", "min_gap", "error", "stealth")}
    for name in paid:
        least, alarms, crashed = np.full(8, 20.0), np.zeros(8), np.zeros(8, bool)
        episode = _episode(reward=name, interval=interval, shaped=False)
        (bare,), _ = next(episode)
        for _, (two,) in episode:
            paid[name] += two[1]
            crashed |= two[2]
            least = np.minimum(least, bare.frame.scene.gap[:, 0])
            alarms += 0.1 * bare.frame.estimate.alarm[:, 0]
        if name == "collision":
            np.testing.assert_array_equal(paid[name], crashed.astype(float))
        if name == "min_gap" and interval == 1:
            np.testing.assert_allclose(paid[name], crashed + 1.0 - np.maximum(least, 0.0) / 20.0, atol=1e-12)
    assert (paid["error"] > 0).all()
    if interval == 1:
        np.testing.assert_allclose(paid["error"] - paid["stealth"], alarms, atol=1e-9)


@pytest.mark.parametrize("engine", ["plain", "auto"])
def test_a_collision_pays_once_where_it_ends_nothing(engine):
    """Cars that overlap for many steps have collided once; Stable-Baselines3's information counts the episode as one with a collision."""
    scenario = dataclasses.replace(load_scenario("gusty-stop-and-go-v0"), ends_on_collision=False)
    arguments = {"scenario": scenario, "defence": "kf", "value": -20.0, "interval": 20, "engine": engine, "reward": "collision"}
    env = BatchVecEnv(8, **arguments, gap_shaping=0.0, error_shaping=0.0)
    env.reset()
    earned, overlapping, told = np.zeros(8), np.zeros(8), None
    while not told:
        _, reward, done, infos = env.step(np.ones(8, int))
        earned += reward
        overlapping += env.batch.episodes.facts().damage <= 0.0
        told = infos if done.all() else None
    assert overlapping.max() > 2 and set(earned) == {1.0}, (earned, overlapping)
    assert all(info["episode"]["crashed"] and info["TimeLimit.truncated"] for info in told)


@pytest.mark.long
@pytest.mark.parametrize(("scenario", "defence"), [("network-restless-v0", "dkf"), ("platoon-gusty-v0", "dkf"), ("stop-and-go-v0", "kf")])
def test_the_rises_of_the_peak_add_up_to_the_largest_error(scenario, defence):
    """What `peak` pays for in an episode is `max_error` over error_scale, however many steps a decision lasts."""
    scale = 7.0
    seat = Seat.make(scenario, defence, {"budget": 5}, reward="peak", error_scale=scale, gap_shaping=0.0, error_shaping=0.0, interval=3)
    loop, attack, rows = seat.loop, Spec("attack", "fdi:start_step=60,value=-3").make(), keys("report", range(6))
    plan = attack.prepare(loop.brief)
    state, memory = loop.start(rows), attack.start(plan, 6, rows.at(Role.ATTACK, np.zeros(6, np.int64)))
    tally, over, total = seat.begin(state), np.zeros(6, bool), np.zeros(6)

    def chosen(view):
        nonlocal memory
        memory, command = attack.decide(plan, memory, view, rows.at(Role.ATTACK, view.k))
        return command

    for _ in range(seat.decisions):
        state, tally, outcome, _ = seat.step(state, tally, chosen, over)
        total += outcome.reward
        over = over | outcome.terminated | outcome.truncated
    wanted = METRICS["max_error"](rollout(loop, attack, rows))
    assert wanted.min() > 1.0
    np.testing.assert_allclose(total * scale, wanted, rtol=1e-12)


def test_the_smallest_gap_of_any_car_counts():
    """min_gap and the potentials look at the worst car; the leader, whom nothing is ahead of, is none."""
    reward = Reward(gap_shaping=1.0, error_shaping=1.0)
    gap = np.array([[np.inf, 50.0, 12.0, 80.0], [np.inf, 50.0, 40.0, 30.0]])
    assert reward.least(gap).tolist() == [12.0, NEAR] and reward.least(gap, np.array([5.0, 5.0])).tolist() == [5.0, 5.0]
    belief = np.array([[0.0, -3.0, 7.0, 0.0], [0.0, 0.0, 0.0, -9.0]])
    np.testing.assert_allclose(reward.potential(gap, belief), [0.88 + 0.7, 0.7])


@pytest.mark.long
def test_belief_is_positive_where_a_car_thinks_it_has_more_room():
    """Added distance makes a follower believe in a larger gap: the shaping potential rises."""
    env = AdversaryVectorEnv(2, scenario="platoon-braking-v0", defence="dkf", value=20.0, gap_shaping=0.0, gamma=1.0, reward="collision",
                             threat={"targets": ["distance"], "kinds": ["fdi"], "onset": 1})  # fmt: skip
    env.reset(seed=0)
    paid = sum(env.step(np.array([1, 2]))[1] for _ in range(20))
    assert paid[0] > 0.3 and paid[1] <= 0.05


def test_a_payment_is_given_as_an_object_too():
    """It is paid as the name that it is registered under; shaping and costs are those of the arguments. Anything else is one error."""
    from tailgate.envs.gym.rewards import MinGap

    def played(reward):
        env = gymnasium.make("tailgate:tailgate/CarFollowing-v1", reward=reward, gap_shaping=0.3, value=-3.0)
        env.reset(seed=1)
        return [env.step(1)[1] for _ in range(8)], env.unwrapped.engine

    assert played(MinGap()) == played("min_gap")
    for wrong in (3, MinGap, lambda step: 0.0):
        with pytest.raises(InputError, match="an object of a subclass of Payment or Reward"):
            played(wrong)
