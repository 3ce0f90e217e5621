"""What peers expect of Gymnasium's faces: limits of steps, specs, autoreset modes, unknown arguments, names and types of information."""

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import tailgate
from tailgate.base.errors import InputError, UnknownArgument
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv

from .tiny import AUTORESETS, CRASHES, SYSTEMS

CAR, HIGHWAY = "tailgate/CarFollowing-v0", "tailgate/Highway-v0"


def test_an_unknown_argument_is_both_errors():
    """TorchRL looks for a TypeError with these words; Gymnasium raises it again from its text alone."""
    for make in (AdversaryEnv, lambda **a: AdversaryVectorEnv(2, **a), lambda **a: gymnasium.make(CAR, **a), lambda **a: gymnasium.make_vec(CAR, **a)):
        with pytest.raises(InputError) as caught:
            make(frameskip=4)
        assert isinstance(caught.value, TypeError) and isinstance(caught.value, UnknownArgument)
        assert "unexpected keyword argument 'frameskip'" in str(caught.value) and "scenario" in str(caught.value)
        again = pickle.loads(pickle.dumps(caught.value))
        assert str(again) == str(caught.value) and isinstance(again, UnknownArgument)


def test_a_field_of_the_threat_model_is_named_with_its_place():
    with pytest.raises(InputError, match=r"got 'budget'; expected threat=\{'budget': 3\}, or one of .*\(unexpected keyword argument 'budget'\)") as caught:
        AdversaryEnv(budget=3)
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_the_autoreset_mode_is_an_attribute_and_an_argument():
    """By the name, or as Gymnasium's own."""
    for mode in AutoresetMode:
        for given in (mode, mode.name.lower()):
            for word in ("autoreset", "autoreset_mode"):
                env = AdversaryVectorEnv(2, **{word: given})
                assert env.autoreset_mode is env.metadata["autoreset_mode"] is mode
                assert gymnasium.make_vec(CAR, num_envs=2, **{word: given}).unwrapped.autoreset_mode is mode
    with pytest.raises(InputError, match=r"autoreset_mode: got .*; expected a vector environment"):
        AdversaryEnv(autoreset_mode="same_step")
    with pytest.raises(InputError, match=r"autoreset_mode: got 'disabled'; expected none, as autoreset is same_step"):
        AdversaryVectorEnv(2, autoreset="same_step", autoreset_mode="disabled")
    for wrong in ("samestep", ["same_step"]):
        with pytest.raises(InputError, match=r"autoreset_mode: got .*samestep|autoreset_mode: got \['same_step'\]"):
            AdversaryVectorEnv(2, autoreset_mode=wrong)


@pytest.mark.parametrize("word", ["autoreset", "autoreset_mode"])
def test_wrappers_that_reset_in_one_way_refuse_another(word):
    pytest.importorskip("stable_baselines3")
    from tailgate.envs.gym.sb3 import BatchVecEnv

    with pytest.raises(InputError, match=f"{word}: got 'next_step'; expected nothing: Stable-Baselines3"):
        BatchVecEnv(2, **{word: "next_step"})
    pytest.importorskip("torchrl")
    from tailgate.envs.torch import TailgateEnv

    with pytest.raises(InputError, match=f"{word}: got 'next_step'; expected nothing: TorchRL"):
        TailgateEnv(2, **{word: "next_step"})


def test_batches_say_what_they_are():
    pytest.importorskip("stable_baselines3")
    from tailgate.envs.gym.sb3 import BatchVecEnv
    from tailgate.envs.torch import TensorVecEnv

    assert repr(BatchVecEnv(2)) == "BatchVecEnv(AdversaryVectorEnv(num_envs=2))"
    assert repr(TensorVecEnv(2)) == "TensorVecEnv(AdversaryVectorEnv(num_envs=2), device='cpu')"


@pytest.mark.thin(2)
@pytest.mark.parametrize("engine", ["auto", "plain"])
@pytest.mark.parametrize("autoreset", AUTORESETS)
def test_a_limit_of_steps_is_that_of_gymnasium(autoreset, engine):
    """`make_vec(max_episode_steps=n)`: row i equals `make(max_episode_steps=n)`, through ends and collisions; the spec says n."""
    vec = gymnasium.make_vec(CAR, num_envs=3, max_episode_steps=7, autoreset=autoreset, engine=engine, **CRASHES)
    assert vec.spec.max_episode_steps == 7
    vec.reset(seed=20)
    rng, log = np.random.default_rng(0), []
    for _ in range(50):
        actions = rng.integers(0, vec.single_action_space.n, 3)
        log.append((actions, *vec.step(actions)))
        over = log[-1][3] | log[-1][4]
        if autoreset == "disabled" and over.any():
            log.append((None, vec.reset(options={"reset_mask": over})[0], over))
    for i in range(3):
        env = gymnasium.make(CAR, max_episode_steps=7, engine=engine, **CRASHES)
        env.reset(seed=20 + i)
        over, ends = False, 0
        for entry in log:
            if entry[0] is None:
                if entry[2][i]:
                    assert np.array_equal(env.reset()[0], entry[1][i])
                continue
            if over and autoreset == "next_step":
                assert np.array_equal(env.reset()[0], entry[1][i])
                over = False
                continue
            seen, reward, terminated, truncated, _ = env.step(entry[0][i])
            over = terminated or truncated
            assert (reward, terminated, truncated) == (entry[2][i], entry[3][i], entry[4][i])
            if over and autoreset == "same_step":
                assert np.array_equal(entry[5]["final_obs"][i], seen)
                seen = env.reset()[0]
            assert np.array_equal(seen, entry[1][i])
            ends += over
        assert ends >= 6


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.thin(6)
def test_the_spec_says_the_horizon(name):
    """`spec.max_episode_steps` is the number of decisions; a spec that is made again ends at the same one."""
    few = {"defence": "dkf"} if name == "tailgate/SensorNetwork-v0" else {}  # its default takes long to compile
    env, vec = gymnasium.make(name, interval=20, **few), gymnasium.make_vec(name, num_envs=2, interval=20, **few)
    decisions = env.unwrapped.batch.seat.decisions
    assert env.spec.max_episode_steps == env.unwrapped.spec.max_episode_steps == vec.spec.max_episode_steps == decisions
    assert gymnasium.make(name, interval=20, max_episode_steps=5, **few).spec.max_episode_steps == 5
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.spec.max_episode_steps == decisions and again.unwrapped.card() == env.unwrapped.card()
    if name != HIGHWAY:
        again.reset(seed=1)
        ends = [again.step(0)[2:4] for _ in range(decisions)]
        assert not any(any(end) for end in ends[:-1]) and ends[-1] == (False, True)


@pytest.mark.parametrize("bad", [0, -3, 2.5, True, "7"])
def test_a_bad_limit_is_refused(bad):
    with pytest.raises(InputError, match=r"max_episode_steps.*not below 1"):
        AdversaryVectorEnv(2, max_episode_steps=bad)


@pytest.mark.thin(6)
@pytest.mark.parametrize("name", SYSTEMS)
def test_information_has_one_set_of_names_and_types(name):
    """Single, vector and Stable-Baselines3's face: the same keys, and NumPy's types, so that a reader may ask for a dtype."""
    pytest.importorskip("stable_baselines3")
    from tailgate.envs.gym.sb3 import BatchVecEnv

    few = SYSTEMS[name] | ({"defence": "dkf"} if name == "tailgate/SensorNetwork-v0" else {})  # its default takes long to compile
    env, vec, batch = AdversaryEnv(**few), AdversaryVectorEnv(2, **few), BatchVecEnv(2, name, max_episode_steps=2, **few)
    _, info = env.reset(seed=0)
    _, told = vec.reset(seed=0)
    batch.reset()
    names = {key for key in told if not key.startswith("_")}
    infos = [info, env.step(0)[4]]
    batch.step(np.zeros(2, np.int64))
    last = batch.step(np.zeros(2, np.int64))[3][0]
    assert {"terminal_observation", "TimeLimit.truncated", "episode"} == last.keys() - names
    for one in (*infos, {key: last[key] for key in names}):
        assert one.keys() == names and {"collided", "rear_collided", "illegal", "allowed", "step"} < names
        for key, value in one.items():
            assert value.dtype == told[key].dtype and value.shape == told[key].shape[1:], key
    assert last["TimeLimit.truncated"] is True and not last["collided"]
    assert tailgate.envs.gym.gymnasium_env.AdversaryEnv.row(told)["step"] == 1
