"""The traced engine plays environments as the plain loop does, to the last bit, restarts, resets and what was held included."""

import copy
import dataclasses
import importlib
import json
import pickle
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from tailgate import num
from tailgate.agents.policy.zoo import zoo_card
from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.engine import objects
from tailgate.engine.evaluation import evaluate
from tailgate.engine.program import Call, Program, State
from tailgate.engine.remembered import Remembered
from tailgate.engine.tracing import traced
from tailgate.envs.gym import programs as seats
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv
from tailgate.envs.gym.programs import SeatPrograms
from tailgate.estimators import ChiSquare, Kalman
from tailgate.play import commanded, rollouts, trace
from tailgate.play.commanded import Commanded
from tailgate.play.rollouts import Rollout, rollout_of
from tailgate.play.trace import Trace, rollout

from .engines import as_plain, short

ENVIRONMENTS = [  # beyond those of test_traced_cars.py and test_traced_many.py
    {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf", "action": "mode", "interval": 3,
     "threat": {"kinds": ["delay", "replay", "dropout", "dos_hold_fresh"], "memory": 12}},
    {"scenario": "car-following-lossy-v0", "defence": "kf"},
    {"scenario": "stop-and-go-v0", "defence": "kf", "threat": {"hold_from_onset": True, "kinds": ["dos_hold"]}},
    {"scenario": "stop-and-go-v0", "defence": "chi2_kf_sparse"},
    {"scenario": "stop-and-go-v0", "defence": "chi2_kf", "knowledge": "white", "reward": "error"},
    {"scenario": "platoon-gusty-v0", "defence": "chi2_dkf"},
    {"scenario": "platoon-v2v-v0", "defence": "lasso_dkf"},
    {"scenario": "network-noisy-v0", "defence": "rkf", "reward": "error"},
]  # fmt: skip


@pytest.mark.thin(8)
@pytest.mark.parametrize("arguments", ENVIRONMENTS, ids=lambda a: f"{a['scenario']}-{a['defence']}")
def test_an_environment_is_the_plain_one_to_the_last_bit(arguments, tmp_path):
    as_plain(arguments, 5, tmp_path)


def plugin(tmp_path, monkeypatch, name="saturated_plugin"):
    """The class of docs/new-defence.md, word for word."""
    text = (Path(__file__).parent.parent / "docs/new-defence.md").read_text()
    code = text.split("```python\n")[1].split("```")[0]
    (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    return importlib.import_module(name)


def test_a_strangers_defence_is_traced_as_it_stands(tmp_path, monkeypatch):
    made = plugin(tmp_path, monkeypatch).Saturated(gain=0.1)
    env = AdversaryVectorEnv(1, defence=made)
    assert (env.engine, env.engine_why) == ("traced", "")
    as_plain({"scenario": "stop-and-go-v0", "defence": made}, 5, tmp_path)


@pytest.mark.thin(7)
@pytest.mark.parametrize("terminate", [True, False])
@pytest.mark.parametrize(("scenario", "defence", "rival"), [
    ("stop-and-go-v0", "mine", "fdi:value=5"), ("car-following-lossy-v0", "chi2_kf", "dos_hold"), ("gusty-stop-and-go-v0", "chi2_kf_sparse", "none"),
    ("radar-following-v0", "cra", "noise_jam"), ("stop-and-go-v0", "steered", "fdi_then_jam"), ("gusty-stop-and-go-v0", "chi2_kf_sparse", "zoo:name=car-following-chi2_kf-0"),
])  # fmt: skip
def test_a_rollout_has_the_plain_ones_hashes(scenario, defence, rival, terminate, tmp_path, monkeypatch):
    if defence == "mine":
        loop = load_scenario(scenario).loop(plugin(tmp_path, monkeypatch).Saturated())
    else:
        spec, threat = Spec("defence", defence), dict(zoo_card(rival[9:])["threat"]) if rival.startswith("zoo") else {}
        threat.pop("class", None)
        loop = load_scenario(scenario).with_threat(**threat).loop(spec.make(), spec.entry.uses)
    attack, keys = Spec("attack", rival).make(), draws.keys("report", range(11))
    program = rollout_of(loop, attack)
    assert isinstance(program, Rollout), program
    fast = Trace(loop.model, loop.horizon, *program.play(keys, terminate), loop.controller.desired_gap)
    plain = rollout(loop, attack, keys, terminate=terminate, plain=True)
    assert np.array_equal(fast.length, plain.length)
    assert {name: (held.shape, held.dtype) for name, held in fast.signals.items()} == {
        n: (x.shape, x.dtype) for n, x in plain.signals.items()
    }
    assert [fast.trace_hash(i) for i in range(11)] == [plain.trace_hash(i) for i in range(11)]
    assert all(np.array_equal(fast.first[name], held) for name, held in plain.first.items())


@pytest.mark.long
def test_who_plays_a_rollout_depends_on_its_size(monkeypatch, tmp_path):
    """Tracing takes longer than small ones do; an attack is traced for many steps alone."""
    loop, played = load_scenario("stop-and-go-v0").loop(plugin(tmp_path, monkeypatch).Saturated()), []
    for kind in (Rollout, Commanded):
        monkeypatch.setattr(kind, "play", lambda self, *rest, kind=kind, play=kind.play: played.append(kind) or play(self, *rest))
    hashes = [rollout(loop, NoAttack(), draws.keys("report", range(4))).trace_hash(3)]  # of 600 steps
    monkeypatch.setattr(trace, "LONG", 601)
    hashes += [rollout(loop, NoAttack(), draws.keys("report", range(n))).trace_hash(3) for n in (10, 50, 1700)]
    assert len(set(hashes)) == 1 and played == [Commanded, Commanded, Rollout]


@dataclass
class Turning:
    """A defence whose gain somebody changes between two rollouts."""

    made: object
    gain: float = 0.1

    def prepare(self, model):
        return model

    def start(self, plan, prior):
        return self.made.start(plan, prior)

    def step(self, plan, state, received, known_u, draws):
        return dataclasses.replace(self.made, gain=self.gain).step(plan, state, received, known_u, draws)


@pytest.mark.long
def test_an_object_that_is_changed_is_traced_again(tmp_path, monkeypatch):
    turning, hashes = Turning(plugin(tmp_path, monkeypatch).Saturated()), []
    attack, (loop, keys) = NoAttack(), (load_scenario("stop-and-go-v0").loop(turning), draws.keys("report", range(40)))
    for gain in (0.1, 0.3):
        turning.gain = gain
        hashes.append([rollout(loop, attack, keys, plain=plain).trace_hash(3) for plain in (False, True)])
    assert hashes[0][0] == hashes[0][1] != hashes[1][0] == hashes[1][1]


class Branching(Kalman):
    """A filter that decides by the first row."""

    def step(self, plan, state, received, known_u, draws):
        state, estimate = super().step(plan, state, received, known_u, draws)
        if estimate.score[0, 0] > 3.0:
            estimate = estimate._replace(alarm=~estimate.alarm)
        return state, estimate


class Deceiving(Kalman):
    """A filter that is another one when it is traced."""

    def step(self, plan, state, received, known_u, draws):
        state, estimate = super().step(plan, state, received, known_u, draws)
        return state, estimate._replace(score=estimate.score + (0.0 if type(estimate.score) is np.ndarray else 1e-9))


def test_what_cannot_be_traced_is_played_plain_and_says_why():
    env = AdversaryVectorEnv(16, defence=Branching())
    line = Branching.step.__code__.co_firstlineno + 2
    assert env.engine == "plain" and f"test_traced.py:{line}: " in env.engine_why and "write it for all rows" in env.engine_why
    with pytest.raises(InputError, match=rf"engine: got 'traced'; expected plain or auto: .*test_traced.py:{line}"):
        AdversaryVectorEnv(16, defence=Branching(), engine="traced")
    for name, why in (("filterpy_kf", "one episode after the other"),):
        assert why in AdversaryVectorEnv(16, defence=name).engine_why


def test_other_parameters_need_no_other_code():
    """Thresholds, noises, gains and rewards are numbers that all episodes share."""

    def made(defence, **options):
        return SeatPrograms(Seat.make("gusty-stop-and-go-v0", defence, **options)).decide

    one, other = made("chi2_kf:eta=20"), made("chi2_kf:eta=7.5", gap_shaping=0.1, threat={"jam_range": [-50.0, 70.0]})
    assert one.text == other.text and not other.function.fresh
    assert sorted(one.uniforms().tolist()) != sorted(other.uniforms().tolist())
    assert made("kf").text != one.text


def test_parameters_of_other_values_are_traced_once(monkeypatch):
    """Budgets, thresholds and times of attacks are no part of the code; an answer that Python code asked for is."""
    made = []
    monkeypatch.setattr(rollouts, "traced", lambda *arguments: made.append(1) or traced(*arguments))
    keys = draws.keys("report", range(5))

    def play(defence, rival, budget, method=None):
        place = dataclasses.replace(load_scenario("gusty-stop-and-go-v0").with_threat(budget=budget), horizon=150)
        loop, attack = place.loop(Spec("defence", defence).make()), Spec("attack", rival).make()
        found, wanted = rollout_of(loop, attack), rollout(loop, attack, keys, plain=True)
        got = Trace(loop.model, loop.horizon, *found.play(keys, True), loop.controller.desired_gap)
        assert [got.trace_hash(i) for i in range(5)] == [wanted.trace_hash(i) for i in range(5)]
        return len(made)

    monkeypatch.setattr(rollouts, "_made", Remembered())
    assert play("chi2_kf", "fdi:trigger=near,threshold=50,value=3", 20) == 1
    assert play("chi2_kf:eta=9", "fdi:trigger=near,threshold=41.5,value=-2", 7) == 1
    assert play("chi2_kf", "fdi:trigger=near,threshold=50,value=3", 0) in (1, 2)
    before = len(made)
    assert play("kf", "fdi:trigger=near,threshold=50,value=3", 20) == before + 1  # another class
    assert play("kf", "fdi:trigger=near,threshold=50,value=3,targets=[position]", 20) == before + 2  # an answer to a question of Python's
    shifted = ChiSquare.step
    monkeypatch.setattr(ChiSquare, "step", lambda *arguments: shifted(*arguments))
    assert play("chi2_kf", "fdi:trigger=near,threshold=50,value=3", 20) == before + 3  # other functions


@pytest.mark.long
@pytest.mark.parametrize("names", [("car-following-noisy-v0", "car-following-late-v0"), ("car-following-lossy-v0", "car-following-noisy-v0")])
def test_a_state_of_another_form_has_another_program(names, monkeypatch):
    """A perfect link has no state, and nothing but the state says so to the code of a step."""
    monkeypatch.setattr(rollouts, "_made", Remembered())
    monkeypatch.setattr(commanded, "_made", Remembered())
    keys, attack = draws.keys("report", range(3)), NoAttack()
    for name in names:
        loop = dataclasses.replace(load_scenario(name), horizon=150).loop(Spec("defence", "chi2_kf").make())
        wanted = rollout(loop, attack, keys, plain=True)
        for made in (rollout_of(loop, attack), commanded.commanded(loop)):
            played = made.play(keys, True) if isinstance(made, Rollout) else made.play(attack, keys, True)
            got = Trace(loop.model, loop.horizon, *played, loop.controller.desired_gap)
            assert [got.trace_hash(i) for i in range(3)] == [wanted.trace_hash(i) for i in range(3)]


@pytest.mark.long
def test_intervals_share_code_and_not_their_length():
    """Decisions of 12 and 5 steps have one program, and each plays its own number of them."""
    for interval in (12, 5, 1, 5):
        one, other = (AdversaryVectorEnv(3, engine=engine, interval=interval) for engine in ("traced", "plain"))
        for env in (one, other):
            env.reset(seed=4)
        for t in range(12):
            (*got, info), (*wanted, _) = (env.step(np.array([0, 1, t % 3])) for env in (one, other))
            assert all(np.array_equal(x, y) for x, y in zip(got, wanted, strict=True)) and info["step"][0] == 1 + interval * (t + 1)


def test_copies_of_a_traced_environment_are_not_traced_again(monkeypatch):
    env = AdversaryVectorEnv(16, scenario="gusty-stop-and-go-v0", defence="chi2_kf", engine="traced")
    env.reset(seed=3)
    env.step(np.zeros(16, np.int64))
    monkeypatch.setattr(seats, "traced", None)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    actions = np.arange(16) % env.seat.action.size
    wanted = env.step(actions)
    for other in copies:
        got = other.step(actions)
        assert other.engine == "traced" and all(np.array_equal(x, y) for x, y in zip(got[:4], wanted[:4], strict=True))


def test_threads_change_no_bit():
    several = [AdversaryVectorEnv(4200, scenario="gusty-stop-and-go-v0", defence="chi2_kf", engine="traced", threads=n) for n in (1, 2)]
    chance = np.random.default_rng(0)
    seen = [env.reset(seed=2)[0] for env in several]
    assert [len(env.episodes.rows._decide._parts) for env in several] == [1, 2]
    for _ in range(30):
        assert np.array_equal(*seen)
        actions = chance.integers(0, several[0].seat.action.size, 4200)
        told = [env.step(actions) for env in several]
        assert all(np.array_equal(x, y) for x, y in zip(*(one[1:4] for one in told), strict=True))
        seen = [one[0] for one in told]


@pytest.mark.thin(3)
@pytest.mark.parametrize("arguments", [
    {"scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf"},
    {"scenario": "platoon-gusty-v0", "defence": "chi2_dkf", "action": "continuous"},
    {"scenario": "radar-following-v0", "defence": "cra", "frames": 2},
])  # fmt: skip
def test_a_single_environment(arguments, tmp_path):
    """Its short way to the code gives what a batch of one gives, types included."""
    (tmp_path / "short.yaml").write_text(short(arguments["scenario"]))
    arguments = arguments | {"scenario": str(tmp_path / "short.yaml")}
    one, other = (AdversaryEnv(engine=engine, **arguments) for engine in ("traced", "plain"))
    chance = np.random.default_rng(0)
    for seed in (4, None, 9):
        moves = [(env.reset(seed=seed)) for env in (one, other)]
        over = False
        while not over:
            for mine, theirs in zip(*moves, strict=True):
                assert type(mine) is type(theirs)
                if isinstance(mine, dict):
                    assert {k: (type(v), np.asarray(v).tolist()) for k, v in mine.items()} == {
                        k: (type(v), np.asarray(v).tolist()) for k, v in theirs.items()
                    }
                else:
                    assert np.array_equal(mine, theirs)
            space = one.action_space
            action = int(chance.integers(space.n)) if hasattr(space, "n") else chance.uniform(-1, 1, space.shape)
            if len(moves[0]) == 5 and moves[0][4]["step"] % 40 == 0:
                one = pickle.loads(pickle.dumps(one))
            moves = [env.step(action) for env in (one, other)]
            over = moves[0][2] or moves[0][3]
        with pytest.raises(InputError, match="reset"):
            one.step(action)


def test_code_that_differs_from_the_plain_loop_is_not_used():
    env = AdversaryVectorEnv(16, defence=Deceiving())
    assert env.engine == "plain" and "differ in loop.estimate.score, decision 0" in env.engine_why


class Growing(Kalman):
    """A filter that overflows where its reading is far off."""

    def step(self, plan, state, received, known_u, draws):
        state, estimate = super().step(plan, state, received, known_u, draws)
        return state, estimate._replace(score=estimate.score * 1e295)


def test_a_class_that_was_changed_is_compared_again(tmp_path, monkeypatch):
    """Its machine code is the same, its plain course is another one."""
    code = (
        "import numpy as np\nfrom tailgate.estimators import Kalman\n\n\nclass Mine(Kalman):\n"
        "    def step(self, plan, state, received, known_u, draws):\n"
        "        state, estimate = super().step(plan, state, received, known_u, draws)\n"
        "        return state, estimate._replace(score=estimate.score + (OFF if type(estimate.score) is np.ndarray else 0.25))\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    file = tmp_path / "changed_defence.py"
    file.write_text(code.replace("OFF", "0.25"))
    made = importlib.import_module("changed_defence")
    assert AdversaryVectorEnv(16, defence=made.Mine()).engine == "traced"
    file.write_text(code.replace("OFF", "0.75"))
    env = AdversaryVectorEnv(16, defence=importlib.reload(made).Mine())
    assert env.engine == "plain" and "differ in" in env.engine_why


def test_what_is_not_finite_is_refused_as_in_the_plain_loop(tmp_path):
    """The same error, which names step and row."""
    said = []
    for engine in ("traced", "plain"):
        env = AdversaryVectorEnv(5, engine=engine, defence=Growing(), action="timing", value=1e9, threat={"fdi_bound": 1e9, "onset": 1})
        env.reset(seed=0)
        with pytest.raises(InputError, match="defence output score: got 'NaN or infinity in step") as caught:
            for t in range(9):
                env.step((np.arange(5) == min(t, 3)).astype(int))
        said.append(str(caught.value))
    assert said[0] == said[1]


def test_objects_that_are_damaged_or_cannot_be_kept_are_made_again(tmp_path, monkeypatch):
    monkeypatch.setenv("TAILGATE_CACHE", str(tmp_path / "cache"))
    text = "define i64 @step(ptr %a, ptr %b, ptr %c, ptr %r, ptr %s, i64 %d, i64 %e, i64 %f) {\n  ret i64 %d\n}\n"

    def call():
        made = objects.Function(text)
        assert made.call(None, None, None, None, None, 7, 0, 0) == 7
        return made

    assert call().fresh and not call().fresh
    (kept,) = (tmp_path / "cache/objects").iterdir()
    kept.write_bytes(kept.read_bytes()[:-3] + b"abc")
    assert call().fresh and not call().fresh
    objects.prove([kept.name])
    assert objects.proved([kept.name]) and not objects.proved([kept.name, "other"])
    monkeypatch.setattr(objects, "KEPT", 2)
    objects.prove(["another"])
    assert len(list((tmp_path / "cache/objects").iterdir())) == 2 and objects.proved([kept.name, "another"])
    (tmp_path / "cache/objects").chmod(0o777)  # somebody else could write here
    assert call().fresh and not objects.proved([kept.name])
    monkeypatch.setenv("TAILGATE_CACHE", "/proc/nowhere")
    assert call().fresh and call().fresh


def test_explain_names_the_engine_and_the_line(capsys):
    assert main(["explain", "engine", "--json", "--scenario", "car-following-lossy-v0", "--attack", "dos_hold"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert all("operations" in held["size"] for held in found.values()) and len(found) == 3
    assert main(["explain", "engine", "--defence", "filterpy_kf", "--json"]) == 0
    assert "one episode after the other" in capsys.readouterr().out
    assert main(["explain", "engine", "--defence", "filterpy_kf"]) == 0
    assert "environments" in capsys.readouterr().out  # how a cell of the table is broken depends on the length of the paths in it
    assert main(["explain", "engine", "--defence", "nobody"]) == 2


def test_until_goes_on_for_each_row():
    """Newton's square roots: every row stops where it would by itself."""

    def roots(x, a):
        def step(m, n):
            y = 0.5 * m + a / m * 0.5
            return np.abs(y - m) > 1e-12, (y, n + 1)

        return num.until(step, (x, np.zeros(x.shape, np.int64)), a > 20.0, 50)

    chance = np.random.default_rng(0)
    x, a = chance.uniform(1.0, 9.0, (37, 2)), chance.uniform(0.1, 90.0, (37, 2))
    wanted = roots(x, a)
    assert len(set(wanted[1].ravel().tolist())) > 3 and 0 in wanted[1]
    for lanes in (2, 4, 8):
        trace = traced(lambda state, held: ((), dict(zip("mn", roots(held["x"], held["a"]), strict=True))), (), {"x": x[:1], "a": a[:1]})
        program = Program(trace, lanes)
        call = Call(program, State(program, 37))
        call.arguments["x"][...], call.arguments["a"][...] = x, a
        results = call()
        assert np.array_equal(results["m"], wanted[0]) and np.array_equal(results["n"], wanted[1])
        given = {("arguments", key, (i,)): value[:, i] for key, value in (("x", x), ("a", a)) for i in range(2)}
        for name, held in zip("mn", wanted, strict=True):
            assert np.array_equal(np.stack(evaluate(trace.graph, list(trace.results[name].flat), given), 1), held)
