"""Classes of somebody else, who has not read about the engine, are traced as they stand, to the bits of the plain loop."""

import dataclasses

import gymnasium
import numpy as np
import pytest

from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base.errors import InputError
from tailgate.core import Command, Kind, draws
from tailgate.core.scenario import load_scenario
from tailgate.core.threat import ThreatModel
from tailgate.engine.parameters import Parameters
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv
from tailgate.play.metrics import METRICS, UNITS, measure
from tailgate.play.rollouts import Rollout, rollout_of
from tailgate.play.trace import Trace, rollout

from . import strangers
from .engines import as_plain, trace_as_plain
from .strangers import Gyroscope, Nudge, Pendulum, Scare, Upright, stubborn

for _columns in (METRICS, UNITS):
    _columns.pop("largest_lean", None)  # other tests know the built-in ones only
THREAT = ThreatModel(kinds=("fdi",), fdi_bound=1.0, onset=20, sees_measurement=True)


def _loop(defence=None, **changes):
    place = dataclasses.replace(
        load_scenario("scalar-hold-v0"), plant=Pendulum(), sensor=Gyroscope(), controller=Upright(), horizon=150, threat_model=THREAT
    )
    return dataclasses.replace(place, **changes).loop(defence or stubborn())


@pytest.mark.parametrize("rival", [NoAttack(), Nudge()], ids=["alone", "attacked"])
def test_a_plant_with_its_sensor_controller_and_defence(rival):
    trace = trace_as_plain(_loop(), rival)
    attacked = isinstance(rival, Nudge)
    assert (np.abs(trace.truth[..., 0]).max() == 1.5) == attacked and (trace.kind != 0).any() == attacked  # pushed, the rod falls


def test_an_attack_is_in_the_program():
    """Machine code of plant, sensor, defence, controller and attack in one."""
    loop, keys = _loop(), draws.keys("report", range(67))
    program = rollout_of(loop, Nudge())
    assert isinstance(program, Rollout), program
    fast = Trace(loop.model, loop.horizon, *program.play(keys, True), loop.controller.desired_gap)
    plain = rollout(loop, Nudge(), keys, plain=True)
    assert [fast.trace_hash(row) for row in range(67)] == [plain.trace_hash(row) for row in range(67)]
    assert np.unique(plain.value[plain.kind != 0]).size > 100


def test_other_numbers_of_a_strangers_classes_are_not_traced_again(monkeypatch):
    rollout_of(_loop(), Nudge())
    monkeypatch.setattr("tailgate.engine.tracing.traced", lambda *_: pytest.fail("traced again"))
    monkeypatch.setattr("tailgate.play.rollouts.traced", lambda *_: pytest.fail("traced again"))
    loop, keys = _loop(stubborn(eta=5.0), plant=Pendulum(pull=0.5), sensor=Gyroscope((0.02, 0.03))), draws.keys("report", range(5))
    program = rollout_of(loop, Nudge(gain=0.9))
    assert isinstance(program, Rollout), program
    fast = Trace(loop.model, loop.horizon, *program.play(keys, True), loop.controller.desired_gap)
    plain = rollout(loop, Nudge(gain=0.9), keys, plain=True)
    assert [fast.trace_hash(row) for row in range(5)] == [plain.trace_hash(row) for row in range(5)]


@dataclasses.dataclass(frozen=True)
class Reads:
    """An attack whose size is a global, a constant of its class, and what a function that it calls reads."""

    limit = 0.2

    def prepare(self, brief):
        return brief

    def start(self, plan, batch, draws):
        return np.zeros(batch)

    def decide(self, plan, memory, view, draws):
        size = np.minimum(GAIN, self.limit) + _more()
        target = np.broadcast_to((view.k >= 30)[:, None, None], (len(view.k), *plan.granted.shape)) & plan.granted
        kind = np.where(target.any(axis=(1, 2)), Kind.FDI.value, 0).astype(np.int8)
        return memory, Command(kind, target, np.where(target, size, 0.0))


def _more():
    return EXTRA["more"]


GAIN, EXTRA = 0.1, {"more": 0.05}


@pytest.mark.parametrize("change", ["nothing", "global", "class", "dict"])
def test_what_a_strangers_code_reads_may_change(monkeypatch, change):
    """A program that was made with other numbers is not used."""
    loop, keys = _loop(), draws.keys("report", range(5))
    assert isinstance(first := rollout_of(loop, Reads()), Rollout), first
    if change == "global":
        monkeypatch.setitem(globals(), "GAIN", 0.15)
    if change == "class":
        monkeypatch.setattr(Reads, "limit", 0.07)
    if change == "dict":
        monkeypatch.setitem(EXTRA, "more", 0.01)
        monkeypatch.setitem(EXTRA, "itself", EXTRA)
    program = rollout_of(loop, Reads())
    fast = Trace(loop.model, loop.horizon, *program.play(keys, True), loop.controller.desired_gap)
    plain = rollout(loop, Reads(), keys, plain=True)
    assert [fast.trace_hash(row) for row in range(5)] == [plain.trace_hash(row) for row in range(5)]
    assert (program.program is first.program) == (change == "nothing")


def test_bits_and_defaults_are_part_of_a_key():
    def made(gain, other):
        def law(x, gain=gain, *, other=other):
            return x * gain + other

        return law

    keys = [Parameters((made(*pair), number)).key for pair, number in (((1.0, 2.0), np.float64(0.0)), ((1.0, 2.0), np.float64(-0.0)))]
    assert keys[0] != keys[1]
    first, second = (Parameters(made(*pair)) for pair in ((1.0, 2.0), (3.0, 4.0)))
    assert np.concatenate(first.values).tolist() == [1.0, 2.0] and np.concatenate(second.values).tolist() == [3.0, 4.0]


def test_a_reward(tmp_path):
    """It is part of the program of the environment, and its numbers are the plain loop's."""
    arguments = {"scenario": "stop-and-go-v0", "defence": "chi2_kf", "reward": Scare(comfort=0.0)}
    as_plain(arguments, 7, tmp_path)
    env, usual = (AdversaryVectorEnv(4, **(arguments | {"reward": reward})) for reward in (Scare(comfort=0.0), "min_gap"))
    assert env.engine == AdversaryEnv(**arguments).engine == "traced" and env.seat.card()["reward"]["comfort"] == 0.0
    paid = []
    for one in (env, usual):
        one.reset(seed=0)
        paid.append(sum(one.step(np.full(4, 1))[1] for _ in range(60)))
    assert (paid[0] > paid[1]).any() and (paid[0] >= paid[1]).all()


def test_a_reward_takes_its_options_with_it():
    with pytest.raises(InputError, match=r"error_scale: got 3\.0; expected no such option: Scare"):
        AdversaryVectorEnv(1, reward=Scare(), error_scale=3.0)


def test_a_reward_has_the_shaping_of_its_id():
    """Ids of -v1 shape nothing, whatever the object's own default; its other fields stay."""
    env = gymnasium.make("tailgate:tailgate/CarFollowing-v1", reward=Scare(comfort=0.25)).unwrapped
    reward = env.batch.seat.reward
    assert (type(reward), reward.comfort, reward.gap_shaping, reward.error_shaping) == (Scare, 0.25, 0.0, 0.0)


def test_a_metric(monkeypatch):
    """It is a column of every trace, also of one that machine code made."""
    monkeypatch.setitem(METRICS, "largest_lean", strangers.largest_lean)
    loop, keys = _loop(), draws.keys("report", range(67))
    program = rollout_of(loop, Nudge())
    fast = Trace(loop.model, loop.horizon, *program.play(keys, True), loop.controller.desired_gap)
    plain = rollout(loop, Nudge(), keys, plain=True)
    assert np.array_equal(measure(fast)["largest_lean"], measure(plain)["largest_lean"])
    assert measure(fast)["largest_lean"].max() == 1.5
