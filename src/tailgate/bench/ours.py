"""Measurements of this package: one small function for each, all against the public interface."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np

from tailgate import num
from tailgate.base.pytree import put_rows
from tailgate.core import Array, Attack, Command, Defence, Estimate, Mode, Model, Prior, Received, View, draws
from tailgate.core.draws import Draws, Role
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.engine.agreement import Untraced
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.batches import side_by_side
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.envs.gym.programs import Rows, programs_of
from tailgate.envs.gym.rewards import Reward

from .lines import Go, Missing, Sample, repeated
from .peers import at_random, batched, stepped

CAR_FOLLOWING, SCENARIO = "tailgate:tailgate/CarFollowing-v0", "stop-and-go-v0"
INJECTION = "fdi:value=-4"  # what the attacker does where no learner plays
SMALL, LARGE = 2048, 6144  # batches whose difference is what an episode takes


# -- environments


def single() -> Go:
    """Step tailgate/CarFollowing-v0 through gymnasium.make, with random actions."""
    env = gymnasium.make(CAR_FOLLOWING)
    return stepped(env, at_random(env))


def vector(episodes: int) -> Go:
    """Step the native vector environment, with random actions."""
    return batched(gymnasium.make_vec(CAR_FOLLOWING, num_envs=episodes))


# -- the whole step without a learner's interface


class Playing(NamedTuple):
    """A seat whose attacker is a script, and what a step of it needs."""

    seat: Seat
    attack: Attack
    plan: object


def playing(defence: Defence) -> Playing:
    """Return car following under injection by a script."""
    seat = Seat.make(scenario=SCENARIO, defence=defence, reward="min_gap")
    script = Spec("attack", INJECTION).make()
    return Playing(seat, script, script.prepare(seat.loop.brief))


def played(held: Playing, episodes: int) -> Go:
    """Play whole steps: leader, readings, attack, defence, controller, reward, autoreset, random numbers."""
    seat, attack, plan = held
    state = seat.loop.start(draws.keys("tune", range(episodes)))
    tally, over = seat.begin(state), np.zeros(episodes, bool)
    memory = attack.start(plan, episodes, state.keys.at(Role.ATTACK, state.k))
    steps = max(1, 16 // episodes)

    def decide(view: View) -> Command:
        nonlocal memory
        memory, command = attack.decide(plan, memory, view, state.keys.at(Role.ATTACK, view.k))
        return command

    def chunk() -> int:
        nonlocal state, tally, memory
        for _ in range(steps):
            state, tally, outcome, _ = seat.step(state, tally, decide, over)
            ended = outcome.terminated | outcome.truncated
            if ended.any():
                rows = np.flatnonzero(ended)
                state = seat.loop.restart(state, ended)
                fresh = seat.begin(state)
                tally = type(tally)(*(np.where(ended, new, old) for new, old in zip(fresh, tally, strict=True)))
                begun = attack.start(plan, len(rows), state.keys.at(Role.ATTACK, state.k))
                memory = put_rows(memory, rows, begun)
        return steps * episodes

    return repeated(chunk)


HELD = 16  # steps of one call: rewards in each, an observation and restarts after the last


def flown(episodes: int, threads: int = 1) -> Rows:
    """Begin episodes of car following with injection by the learner's action."""
    options: dict[str, Any] = {"action": "timing", "kind": "fdi", "value": -4.0, "interval": HELD, "reward": "min_gap"}
    programs = programs_of(Seat.make(scenario=SCENARIO, defence="chi2_kf", **options))
    assert not isinstance(programs, Untraced)
    rows = Rows(programs, episodes, threads)
    rows.begin(np.ones(episodes, bool), draws.keys("tune", range(episodes)))
    return rows


def decided(rows: Rows) -> int:
    """Take a decision in all rows, which begin again after their end; return its steps."""
    brought, attack = rows.brought, np.ones(rows.batch, np.int64)
    over = brought["terminated"] | brought["truncated"] if "terminated" in brought else np.zeros(rows.batch, bool)
    rows.decide(attack, over, over)
    return HELD * rows.batch


def batch(episodes: int, threads: int = 1) -> Go:
    """Play whole steps of car following under a learner's action: rewards included, an observation and restarts every HELD steps."""
    rows = flown(episodes, threads)
    return repeated(lambda: decided(rows))


def several(scenario: Scenario, defence: str, value: float, reward: str, episodes: int) -> Go:
    """Play whole steps of several agents under a learner's action, as in `batch`."""
    named, spec = Spec("defence", defence), ActionSpec("timing", "fdi", value, interval=HELD)
    loop = scenario.loop(named.make(), named.entry.uses)
    seat = Seat(loop, ActionCodec(spec, loop.brief), ObservationCodec(loop.brief), Reward(reward), {})
    rows, attack, over = side_by_side(seat), np.ones(episodes, np.int64), np.zeros(episodes, bool)
    rows.begin(draws.keys("tune", range(episodes)))

    def chunk() -> int:
        nonlocal over
        outcome = rows.decide(attack, over, restart=True)
        over = outcome.terminated | outcome.truncated
        return HELD * episodes

    return repeated(chunk)


def platoon(episodes: int, followers: int = 4, defence: str = "dkf") -> Go:
    """Play whole steps of a platoon, each car with an estimator of the whole state; one gap is attacked."""
    scenario = load_scenario("platoon-braking-v0").with_threat(agents=(min(2, followers),), targets=("distance",))
    scenario = dataclasses.replace(scenario, plant=dataclasses.replace(scenario.plant, followers=followers))
    return several(scenario, defence, 60.0, "min_gap", episodes)


def network(episodes: int, sensors: int) -> Go:
    """Play whole steps of chapter 5's network of ten agents under the norm-penalised estimator; one is attacked."""
    scenario = load_scenario("thesis-ch5-v0").with_threat(agents=(0,))
    scenario = dataclasses.replace(scenario, sensor=dataclasses.replace(scenario.sensor, sensors=sensors))
    return several(scenario, "norm_resilient", 60.0, "error", episodes)


# -- a defence by somebody else


class _Belief(NamedTuple):
    x: Array  # (B, N, n)


@dataclass(frozen=True)
class Saturated:
    """A steady observer whose correction saturates, in plain numpy: the plug-in of docs/new-defence.md."""

    gain: float = 0.2
    limit: float = 0.5

    def prepare(self, model: Model) -> Model:
        return model

    def start(self, plan: Model, prior: Prior) -> _Belief:
        return _Belief(prior.mean)

    def step(self, plan: Model, state: _Belief, received: Received, known_u: Array, draws: Draws) -> tuple[_Belief, Estimate]:
        x = num.matvec(plan.A, state.x) + num.matvec(plan.B, known_u) + plan.c
        r = np.where(received.valid, received.y - num.matvec(plan.C, x), 0.0)
        x = x + num.matvec(np.swapaxes(plan.C, -1, -2), np.clip(self.gain * r, -self.limit, self.limit))
        score = num.dot(r, r)
        quiet = np.zeros(score.shape, bool)
        return _Belief(x), Estimate(x, score, quiet, num.full(score.shape, Mode.NORMAL, np.int8), ~quiet)


def plug_in(episodes: int) -> Go:
    """Play whole steps with a defence that is plain numpy."""
    return played(playing(Saturated()), episodes)


# -- cores


def on_cores(episodes: int, cores: int) -> Go:
    """Play whole steps on several cores at once, by the wall clock: one thread for each, which plays its share of the blocks."""
    if (os.cpu_count() or 1) < cores:
        raise Missing(f"this machine has {os.cpu_count()} cores, not {cores}")
    rows = flown(episodes, cores)

    def go(seconds: float) -> Sample:
        done, started = 0, time.perf_counter()
        while done == 0 or time.perf_counter() - started < seconds:
            done += decided(rows)
        return Sample(done, time.perf_counter() - started)

    return go


def unequal(episodes: int = 4096, threads: int = 2) -> Go:
    """Count the bytes of the episodes that differ between one thread and several."""

    def go(seconds: float) -> Sample:
        one, several = flown(episodes), flown(episodes, threads)
        for rows in (one, several):
            for _ in range(4):
                decided(rows)
        alike = several.held()
        return Sample(sum(int(np.count_nonzero(_bytes(x) != _bytes(alike[name]))) for name, x in one.held().items()), 1.0)

    return go


def _bytes(x: Array) -> Array:
    return np.ascontiguousarray(x).reshape(-1).view(np.uint8)


# -- what is not a rate

_FIRST = """
import time
started = time.perf_counter()
import gymnasium
env = gymnasium.make("tailgate:tailgate/CarFollowing-v0")
env.reset(seed=0)
env.step(env.action_space.sample())
print(time.perf_counter() - started)
"""


def _first_step(cache: str, bytecode: bool = False) -> float:
    """Measure the seconds in a fresh process from the first import to the end of the first step, compiled code being cached in this folder.

    With `bytecode`, that of Python as well, as everybody has it whose environment does not forbid it.
    """
    environment = os.environ | {"TAILGATE_CACHE": cache}
    if bytecode:
        environment = {k: v for k, v in environment.items() if k != "PYTHONDONTWRITEBYTECODE"} | {"PYTHONPYCACHEPREFIX": cache}
    done = subprocess.run([sys.executable, "-c", _FIRST], capture_output=True, text=True, check=True, env=environment)
    return float(done.stdout)


def start_cached() -> Go:
    """Time import and first step with compiled kernels and Python's bytecode in the cache."""
    folder = tempfile.TemporaryDirectory(prefix="tailgate-")
    _first_step(folder.name, True)

    def go(seconds: float) -> Sample:
        return Sample(_first_step(folder.name, True), 1.0)

    return go


def start_cold() -> Go:
    """Time import and first step with an empty cache of compiled code."""

    def go(seconds: float) -> Sample:
        with tempfile.TemporaryDirectory(prefix="tailgate-") as folder:
            return Sample(_first_step(folder), 1.0)

    return go


def _peak(episodes: int) -> int:
    """Return bytes that a vector environment takes at most, from its making to its third step."""
    tracemalloc.start()
    try:
        env = gymnasium.make_vec(CAR_FOLLOWING, num_envs=episodes)
        env.reset(seed=0)
        for _ in range(3):
            env.step(env.action_space.sample())
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def memory() -> Go:
    """Measure the bytes that an episode of a vector environment takes at most: the difference between two batches."""
    _peak(1)  # what is imported on the way counts for neither

    def go(seconds: float) -> Sample:
        return Sample(_peak(LARGE) - _peak(SMALL), LARGE - SMALL)

    return go


class _Timed:
    """A method that is timed."""

    def __init__(self, method: Callable[..., object]) -> None:
        self.method, self.seconds = method, 0.0

    def __call__(self, *arguments: object) -> object:
        started = time.process_time()
        try:
            return self.method(*arguments)
        finally:
            self.seconds += time.process_time() - started


def environment_share() -> Go:
    """Time the environment's share of a training by PPO of Stable-Baselines3: 1024 x 32 steps, batches of 8192, 4 epochs."""
    try:
        from tailgate.agents.learners.ppo import Config, Learner
    except ImportError as error:
        raise Missing(str(error)) from None
    config = Config(envs=1024, rollout=32, batch_size=8192, epochs=4)
    learner = Learner(0, 0.99, config, {"scenario": SCENARIO, "defence": "chi2_kf"})
    env: Any = learner.env
    env.step_wait = timed = _Timed(env.step_wait)
    learner.learn(learner.round, lambda progress: None)

    def go(seconds: float) -> Sample:
        timed.seconds, started, until = 0.0, time.process_time(), time.perf_counter() + seconds
        while timed.seconds == 0.0 or time.perf_counter() < until:
            learner.learn(learner.steps + learner.round, lambda progress: None)
        return Sample(timed.seconds, time.process_time() - started)

    return go


