"""The Gymnasium faces: both checkers without a warning, batch equal to single, autoreset, masks, cards and errors."""

import json
import re
import subprocess
import sys
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.registry import entries
from tailgate.core.schema import fields_of
from tailgate.envs.gym.actions import ActionName, ActionSpec
from tailgate.envs.gym.gymnasium_env import FACES, AdversaryEnv, AdversaryVectorEnv
from tailgate.envs.gym.rewards import Reward

from .tiny import SYSTEMS, write

ID = "tailgate/CarFollowing-v0"
ROOT = Path(__file__).parents[1]
RADAR, PLATOON, NETWORK = "tailgate/RadarFollowing-v0", "tailgate/Platoon-v0", "tailgate/SensorNetwork-v0"
ACTIONS = get_args(ActionName)
def here(name):
    """Return whether the library that an id's plant needs is installed."""
    return "Highway" not in name or find_spec("highway_env") is not None


def needs(name):
    """Skip the test where the library that an id's plant needs is missing."""
    if not here(name):
        pytest.skip(f"{name} needs the extra highway")


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Arguments of each id with its scenario of 40 steps."""
    return write(tmp_path_factory.mktemp("scenario"))


@pytest.fixture(scope="module")
def brief_scenario(tiny):
    """A car-following scenario of 40 steps."""
    return tiny[ID]["scenario"]


@pytest.fixture
def strict(monkeypatch):
    """Every warning is an error, Gymnasium's own too."""

    def shout(message, *arguments, **_):
        if "out of date" not in message:  # -v0 stays next to -v1
            raise AssertionError(f"gymnasium warns: {message % arguments if arguments else message}")

    monkeypatch.setattr(gymnasium.logger, "warn", shout)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*out of date")
        yield


@pytest.mark.thin(16)
@pytest.mark.parametrize("turn, knowledge", [(0, "black"), (1, "grey"), (2, "white")])
@pytest.mark.parametrize("action", ACTIONS)
def test_both_checkers_pass_without_a_warning(action, turn, knowledge, strict, brief_scenario):
    """gymnasium's and Stable-Baselines3's check_env, for every action with every knowledge and every reward."""
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    for reward in list(entries("reward"))[turn::3]:
        arguments = dict(scenario=brief_scenario, action=action, knowledge=knowledge, reward=reward)
        check_env(gymnasium.make(ID, **arguments).unwrapped, skip_render_check=True)
        sb3.check_env(gymnasium.make(ID, **arguments), warn=True)


@pytest.mark.thin(46)
@pytest.mark.parametrize("knowledge, sees", [("black", True), ("white", False)])
@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("name", [RADAR, PLATOON, NETWORK])
def test_both_checkers_pass_on_every_system(name, action, knowledge, sees, strict, tiny):
    """Radar, platoon and network: modes of single agents and wires, vectors, intervals, every reward that can be earned there."""
    sb3 = pytest.importorskip("stable_baselines3.common.env_checker")
    rewards = [r for r in list(entries("reward")) if name != NETWORK or r not in ("min_gap", "collision")]
    turn = ACTIONS.index(action) + (knowledge == "white")  # every reward with every system, though not with every action
    for reward in {rewards[turn % len(rewards)], rewards[(turn + 2) % len(rewards)]}:
        arguments = tiny[name] | dict(action=action, knowledge=knowledge, reward=reward, threat={"sees_measurement": sees}, interval=3, per_agent=True)
        check_env(gymnasium.make(name, **arguments).unwrapped, skip_render_check=True)
        sb3.check_env(gymnasium.make(name, **arguments), warn=True)


@pytest.mark.thin(6)
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_checker_passes_with_its_render_check(name, strict, monkeypatch):
    """Each id as it comes, every declared render mode included."""
    needs(name)
    pytest.importorskip("PIL")
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    check_env(gymnasium.make(name).unwrapped)


@pytest.mark.thin(7)
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_id_works_in_a_fresh_interpreter(name):
    """Gymnasium alone imports the module that the id names."""
    needs(name)
    code = (
        f"import gymnasium; e = gymnasium.make('tailgate:{name}'); o, i = e.reset(seed=1);"
        "print(e.step(e.action_space.sample())[0].shape == e.observation_space.shape)"
    )
    done = subprocess.run([sys.executable, "-W", "error", "-W", "ignore:.*out of date", "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout == "True\n", done.stderr


def test_the_defaults_of_an_id_hold_everywhere(tiny):
    """make, make_vec and the VecEnv of one id are the same environment; what is said wins over the default."""
    sb3 = pytest.importorskip("tailgate.envs.gym.sb3")
    for name, defaults in ((name, defaults) for name, defaults in SYSTEMS.items() if here(name)):
        plain = {"engine": "plain"}  # a card needs no code
        cards = [gymnasium.make(name, **plain).unwrapped.card(), gymnasium.make_vec(name, num_envs=2, **plain).unwrapped.card(), sb3.BatchVecEnv(2, name, **plain).batch.card()]
        assert cards[0] == cards[1] == cards[2]
        assert cards[0]["scenario"]["name"] == defaults["scenario"] and cards[0]["defence"]["spec"] == defaults["defence"]
        other = gymnasium.make(name, reward="stealth", **plain, **tiny[name]).unwrapped.card()
        assert other["reward"]["reward"] == "stealth" and other["scenario"]["horizon"] == 40
    assert AdversaryEnv().card() == gymnasium.make(ID).unwrapped.card()
    with pytest.raises(InputError, match=r"id.*'tailgate/Plato'.*tailgate/Platoon-v0"):
        sb3.BatchVecEnv(2, "tailgate/Plato")


@pytest.mark.long
def test_info_is_finite_and_has_what_the_system_has(tiny):
    """On a road the smallest gap; without one the largest error of an agent, 0 at the start of an episode."""
    for name in filter(here, SYSTEMS):
        vec = gymnasium.make_vec(name, num_envs=3, **tiny[name])
        _, info = vec.reset(seed=2)
        assert ("gap" in info) == (name != NETWORK) and ("error" in info) == (name == NETWORK)
        for _ in range(45):
            assert all(np.isfinite(value).all() for value in info.values())
            if name == NETWORK:
                assert ((info["error"] == 0.0) == (info["step"] == 1)).all()
            *_, info = vec.step(vec.action_space.sample())


def test_a_batch_of_4096_steps():
    """make_vec is native: shapes, types and spaces of 4096 rows."""
    vec = gymnasium.make_vec(ID, num_envs=4096)
    assert isinstance(vec.unwrapped, AdversaryVectorEnv)
    observation, _ = vec.reset(seed=0)
    for _ in range(5):
        assert vec.observation_space.contains(observation) and len(np.unique(observation, axis=0)) == 4096
        observation, reward, terminated, truncated, info = vec.step(vec.action_space.sample())
    assert reward.shape == terminated.shape == truncated.shape == info["illegal"].shape == (4096,)
    assert reward.dtype == np.float64 and terminated.dtype == truncated.dtype == bool


def _actions(vec, steps, seed=0):
    vec.action_space.seed(seed)
    return [vec.action_space.sample() for _ in range(steps)]


SEEDED = [*((ID, action, interval) for action in ACTIONS for interval in (1, 3)), (PLATOON, "mode", 1), (PLATOON, "increment", 3), (NETWORK, "ramp", 3), (NETWORK, "continuous", 1)]


@pytest.mark.thin(14)
@pytest.mark.parametrize("name, action, interval", SEEDED)
def test_row_i_is_the_single_environment_of_seed_s_plus_i(name, action, interval, tiny, same_bits):
    """Two whole episodes: observation, reward, flags and info of every row, bit for bit; autoreset adds 1 to the episode."""
    arguments = tiny[name] | dict(action=action, value=-8.0, knowledge="white", reward="stealth", interval=interval)
    vec = gymnasium.make_vec(name, num_envs=4, **arguments)
    start, _ = vec.reset(seed=70)
    steps = [(a, *vec.step(a)) for a in _actions(vec, 81)]
    for i in range(4):
        env = gymnasium.make(name, **arguments)
        first, _ = env.reset(seed=70 + i)
        assert same_bits(first, start[i])
        over, episodes = False, 1
        for action_, observation, reward, terminated, truncated, info in steps:
            if over:
                alone = (*env.reset(), 0.0, False, False)
                alone = (alone[0], *alone[2:], alone[1])
                episodes += 1
            else:
                alone = env.step(action_[i])
            assert same_bits(alone[0], observation[i])
            assert alone[1:4] == (reward[i], terminated[i], truncated[i])
            for key, value in alone[4].items():
                assert np.array_equal(value, info[key][i]), key
            over = alone[2] or alone[3]
        assert episodes >= 2
        assert vec.unwrapped.episode[i] == episodes - 1 == env.unwrapped.batch.episode[0]


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", SYSTEMS)
def test_next_step_same_step_and_disabled_are_one_core(name, tiny, same_bits):
    """NEXT_STEP spends a step on the reset, SAME_STEP reports the last observation as final_obs, DISABLED waits for a mask."""
    needs(name)
    modes = ("next_step", "same_step", "disabled")
    rows, steps, ends = (2, 45, 1) if "Highway" in name else (6, 120, 2)
    faces = {mode: AdversaryVectorEnv(rows, autoreset=mode, **(SYSTEMS[name] | tiny[name] | {"value": -20.0})) for mode in modes}
    for mode, face in faces.items():
        assert face.metadata["autoreset_mode"] == AutoresetMode[mode.upper()]
        face.reset(seed=3)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(steps):
        actions = rng.integers(0, faces["disabled"].seat.action.size, rows)
        plain = faces["disabled"].step(actions)
        same = faces["same_step"].step(actions)
        following = faces["next_step"].step(actions)
        done = plain[2] | plain[3]
        for other in (same, following):
            assert all(np.array_equal(plain[j], other[j]) for j in (1, 2, 3))
        assert same_bits(plain[0], following[0]) and same_bits(plain[0][~done], same[0][~done])
        if not done.any():
            assert "final_obs" not in same[4]
            continue
        ended += int(done.sum())
        assert same_bits(same[4]["final_obs"], plain[0]) and np.array_equal(same[4]["_final_obs"], done)
        assert np.array_equal(same[4]["final_info"]["collided"], plain[4]["collided"])
        with pytest.raises(InputError, match=r"step: got \[.*reset_mask"):
            faces["disabled"].step(actions)
        fresh, _ = faces["disabled"].reset(options={"reset_mask": done})
        assert same_bits(fresh, same[0])
        faces["next_step"].reset(options={"reset_mask": done})
    assert ended >= ends * rows and len({tuple(f.episode) for f in faces.values()}) == 1


def test_next_step_ignores_the_action_of_a_resetting_row(brief_scenario):
    """The step after an end: reward 0, no flag, no illegal command, the first observation of the next episode."""
    vec = AdversaryVectorEnv(3, scenario=brief_scenario, threat={"end": 3}, illegal_penalty=1.0)
    vec.reset(seed=0)
    for _ in range(200):
        out = vec.step(np.ones(3, np.int64))
        if (done := out[2] | out[3]).any():
            break
    assert vec.episode.max() == 0
    after = vec.step(np.ones(3, np.int64))
    assert not after[1][done].any() and not (after[2] | after[3])[done].any() and not after[4]["illegal"][done].any()
    assert (after[4]["step"][done] == 1).all() and (vec.episode == done).all()


@pytest.mark.parametrize("mask", [[True], np.zeros(3, bool), np.ones(3), np.ones((3, 1), bool), "all"])
def test_a_bad_reset_mask_is_refused(mask, brief_scenario):
    """reset_mask is a bool array (B,) with at least one True."""
    vec = AdversaryVectorEnv(3, autoreset="disabled", scenario=brief_scenario)
    vec.reset(seed=0)
    with pytest.raises(InputError, match=r"options\.reset_mask.*shape \(3,\)"):
        vec.reset(options={"reset_mask": mask})


def test_a_reset_with_seeds_by_row(brief_scenario, same_bits):
    """A list of seeds: rows with one restart under it, rows without go on to their next episode."""
    vec = AdversaryVectorEnv(3, scenario=brief_scenario)
    vec.reset(seed=0)
    observation, _ = vec.reset(seed=[9, None, 5])
    single = AdversaryEnv(scenario=brief_scenario)
    assert same_bits(observation[0], single.reset(seed=9)[0]) and same_bits(observation[2], single.reset(seed=5)[0])
    single.reset(seed=1)
    assert same_bits(observation[1], single.reset()[0])
    with pytest.raises(InputError, match=r"seed.*one seed per row \(3\)"):
        vec.reset(seed=[1, 2])


def test_the_spec_survives_a_round_trip(brief_scenario, same_bits):
    """gymnasium.make(env.spec) is the same environment: same card, same episode."""
    env = gymnasium.make(ID, scenario=brief_scenario, defence="chi2_kf:eta=9", action="timing", knowledge="grey", threat={"budget": 5})
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert env.unwrapped.card() == again.unwrapped.card() == gymnasium.make(env.spec).unwrapped.card()
    assert same_bits(env.reset(seed=4)[0], again.reset(seed=4)[0])
    assert all(same_bits(env.step(k % 2)[0], again.step(k % 2)[0]) for k in range(20))


CHANGES = [
    {"scenario": "braking-v0"}, {"defence": "kf"}, {"defence": "chi2_kf:eta=19"}, {"knowledge": "grey"}, {"threat": {"budget": 5}},
    {"threat": {"sees_measurement": True}}, {"action": "timing"}, {"kind": "dropout"}, {"value": -3.0}, {"rate": 0.4},
    {"per_sensor": True}, {"per_agent": True}, {"error_scale": 5.0}, {"interval": 2}, {"reward": "error"}, {"gap_shaping": 0.1}, {"error_shaping": 0.1}, {"gamma": 0.9},
    {"illegal_penalty": 0.2}, {"shares": [0.5, 1.0]},
    {"attack_cost": 0.1}, {"steps": 7}, {"power": 0.05}, {"delay": 3.0}, {"horizon_ends": True},
]  # fmt: skip


def test_the_card_names_everything():
    """JSON, stable, and another hash for every changed argument; nothing that moves between processes."""
    card = AdversaryEnv().card()
    assert json.loads(json.dumps(card)) == card == AdversaryVectorEnv(7, autoreset="same_step").card()
    hashes = [AdversaryEnv(engine="plain", **change).card()["hash"] for change in CHANGES]
    assert len({card["hash"], *hashes}) == len(CHANGES) + 1
    named = {key for change in CHANGES for key in change}
    assert named == {"scenario", "defence", "threat", "knowledge", *fields_of(ActionSpec), *fields_of(Reward)}
    assert AdversaryEnv(defence=tailgate.make_defence("chi2_kf")).card()["defence"]["parameters"] == card["defence"]["parameters"]


def test_the_card_of_an_adapted_filter_is_the_same_in_every_process():
    """No memory address of a user's object gets into the card."""
    text = json.dumps(AdversaryEnv(defence=tailgate.per_episode(_OneEpisode)).card())
    assert "0x" not in text and "_OneEpisode" in text


class _OneEpisode:
    def reset(self, model, prior):
        self.x = prior.mean

    def step(self, y, valid, u):
        return self.x, 0.0


BAD = [
    ({"defense": "kf"}, ["defense", "did you mean 'defence'", "reward"]),
    ({"defence": "chi2_kff"}, ["defence", "'chi2_kff'", "did you mean 'chi2_kf'"]),
    ({"defence": "chi2_kf:eta=-1"}, ["chi2_kf.eta", "-1", "greater than 0"]), ({"defence": 3}, ["defence", "3", "prepare, start and step"]),
    ({"scenario": "stop-and-go"}, ["scenario", "'stop-and-go'", "stop-and-go-v0"]), ({"scenario": 3}, ["scenario", "3", "name"]),
    ({"knowledge": "blue"}, ["threat_model.knowledge", "'blue'", "'black'"]), ({"reward": "fame"}, ["reward", "'fame'", "stealth"]),
    ({"threat": {"budget": -1}}, ["threat_model.budget", "-1", "than or equal to 0"]), ({"action": "x"}, ["action", "'x'", "'mode'"]),
    ({"threat": {"bugdet": 1}}, ["threat", "'bugdet'", "did you mean 'budget'"]), ({"value": 1e3}, ["value", "1000.0", "fdi_bound (50.0)"]),
    ({"value": float("nan")}, ["value", "nan", "finite"]), ({"render_mode": "ansi"}, ["render_mode", "'ansi'", "rgb_array"]),
    ({"threat": {"kinds": ["fdi"]}, "action": "timing", "kind": "dropout"}, ["action", "dropout", "fdi"]),
    ({"frames": 0}, ["frames", "0", "1 to 64"]), ({"frames": 2.0}, ["frames", "2.0", "whole"]),
    ({"threat": {"agents": [1]}}, ["agents", "1", "0 to 0"]), ({"scenario": "thesis-ch5-v0", "defence": "dkf"}, ["reward", "'min_gap'", "error, peak, stealth or final"]),
    ({"threat": {"targets": ["speed"]}}, ["targets", "'speed'", "velocity"]), ({"gamma": 0}, ["gamma", "0", "greater than 0"]),
]  # fmt: skip


@pytest.mark.parametrize("arguments, words", BAD)
def test_bad_arguments_name_field_value_and_expectation(arguments, words):
    """InputError with the field, what was given and what was expected, from both faces."""
    for make in (AdversaryEnv, lambda **a: AdversaryVectorEnv(2, **a)):
        with pytest.raises(InputError) as caught:
            make(**arguments)
        text = str(caught.value)
        assert all(word in text for word in words) and "expected" in text and "\n" not in text


def test_bad_calls_are_refused(brief_scenario):
    """A step before the reset, wrong shapes, numbers out of range, NaN."""
    env, box = AdversaryEnv(scenario=brief_scenario), AdversaryEnv(scenario=brief_scenario, action="continuous")
    for early in (lambda: env.step(0), env.action_masks):
        with pytest.raises(InputError):
            early()
    _ = env.reset(seed=0), box.reset(seed=0)
    size = env.action_space.n
    for bad, words in ((size, f"0 to {size - 1}"), (-1, "whole"), (0.5, "whole"), ([0], "shape"), (np.nan, "whole")):
        with pytest.raises(InputError, match=f"actions.*{words}"):
            env.step(bad)
    for bad, words in ((np.full(3, np.nan), "finite"), (np.full(3, np.inf), "finite"), (np.zeros(2), "shape"), (0.0, "shape")):
        with pytest.raises(InputError, match=f"actions.*{words}"):
            box.step(bad)
    with pytest.raises(InputError, match=r"action_masks.*discrete"):
        box.action_masks()
    for arguments in ({"num_envs": 0}, {"num_envs": 1.5}, {"autoreset": "now"}):
        with pytest.raises(InputError, match=next(iter(arguments))):
            AdversaryVectorEnv(**({"num_envs": 1} | arguments))


@pytest.mark.parametrize("learned", [pytest.param(True, marks=pytest.mark.long), False])
def test_the_documentation_runs_as_written(learned, tmp_path):
    """Every Python example of the page, those that learn with fewer decisions; its names of ids and fields exist."""
    pytest.importorskip("stable_baselines3")
    text = (ROOT / "docs/environment.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, flags=re.S)
    assert len(blocks) == 6 and all("learn(150_000)" in block for block in blocks[1:3])
    code = "\n".join(blocks[1:4] if learned else [blocks[0], *blocks[4:]]).replace("learn(150_000)", "learn(3_000)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "mine.json").is_file() is (tmp_path / "mine.safetensors").is_file() is learned
    assert set(re.findall(r"tailgate/\w+-v\d", text)) == set(FACES)
    named = {name for cell in re.findall(r"^\| (`[^|]*) \|", text, flags=re.M) for name in re.findall(r"`(\w+)`", cell)}
    assert set(fields_of(ActionSpec)) | set(fields_of(Reward)) <= named
    for name, defaults in SYSTEMS.items():
        assert f"| `{name}` |" in text and f"| `{defaults['scenario']}` | `{defaults['defence']}` |" in text


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_frames_show_the_last_decisions(autoreset):
    """The newest frame is the plain observation, frame j the one of j decisions before; an episode begins with its first in every place."""
    config = {"scenario": "gusty-stop-and-go-v0", "defence": "kf", "interval": 40, "threat": {"kinds": ["fdi"], "fdi_bound": 30.0}, "value": -30.0}
    plain, stacked = (AdversaryVectorEnv(6, autoreset=autoreset, **config, **more) for more in ({}, {"frames": 3}))
    width = plain.single_observation_space.shape[0]
    seen, observed = plain.reset(seed=4)[0], stacked.reset(seed=4)[0]
    assert observed.shape == (6, 3 * width) and stacked.seat.observation.names[width] == stacked.seat.observation.names[0] + "@1"
    history, ended, over = [[row] * 3 for row in seen], 0, np.zeros(6, bool)
    for k in range(40):
        for i in range(6):
            assert np.array_equal(observed[i], np.concatenate(history[i]))
        action = np.full(6, 2 if k % 3 else 0)
        seen, _, terminated, truncated, info = plain.step(action)
        observed, *_, other = stacked.step(action)
        done = terminated | truncated
        if autoreset == "same_step" and done.any():
            for i in np.flatnonzero(done):
                assert np.array_equal(other["final_obs"][i], np.concatenate([info["final_obs"][i], *history[i][:2]]))
        fresh = done if autoreset == "same_step" else over
        history = [[row] * 3 if fresh[i] else [row, *history[i][:2]] for i, row in enumerate(seen)]
        ended, over = ended + fresh.sum(), done
    assert ended > 6
