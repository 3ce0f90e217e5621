"""What a face of Gymnasium takes at its door: options, vectors, and objects that a spec says as text."""

import dataclasses
import json

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import tailgate
from tailgate.base.errors import InputError
from tailgate.envs.gym.duel import DefenderEnv
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv
from tailgate.envs.gym.parallel import DuelEnv
from tailgate.envs.gym.specs import in_box
from tailgate.estimators.challenge.steering import Menu
from tailgate.estimators.compose import compose
from tailgate.estimators.filters.kalman import Kalman

ID, DEFENDER = "tailgate/CarFollowing-v0", "tailgate.envs.gym.duel:tailgate/Defender-v0"


@dataclasses.dataclass(frozen=True)
class Mine(Kalman):
    """A defence that nobody registered."""

    name: str = "mine"


OBJECTS = [
    tailgate.make_defence("chi2_kf", eta=7.5), tailgate.make_defence("safe_state"), Mine(gain="steady"),
    tailgate.make_defence("composed", filter={"name": "rkf", "lam": 2.0}, detector="cusum", mitigation={"name": "brake", "linger": 1.0}),
]  # fmt: skip


@pytest.mark.thin(2)
@pytest.mark.parametrize("defence", OBJECTS)
def test_a_spec_says_a_defence_as_text_and_makes_it_again(defence):
    """The JSON of a spec makes an environment with the same card; the spec itself keeps the object."""
    env = gymnasium.make(ID, defence=defence)
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.card()["defence"]["parameters"] == env.unwrapped.card()["defence"]["parameters"]
    assert gymnasium.make(env.spec).unwrapped.card() == env.unwrapped.card()
    vec = gymnasium.make_vec(ID, num_envs=2, defence=defence)
    assert json.loads(vec.spec.to_json())["kwargs"]["defence"] == json.loads(env.spec.to_json())["kwargs"]["defence"]


def test_a_spec_says_attacks_and_menus_too():
    """Of the defender's environment: a list of attacks, objects among them, a menu, and numpy's numbers."""
    some = [tailgate.make_attack("fdi", value=-3.0), "dos_hold"]
    env = gymnasium.make(
        DEFENDER, attack=some, menu=Menu(modes=("normal", "brake")), defence=tailgate.make_defence("chi2_kf", eta=9.0), interval=np.int64(5)
    )
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    one, two = env.unwrapped.card(), again.unwrapped.card()
    assert one["attack"] == two["attack"] and one["seat"]["defence"] == two["seat"]["defence"] and one["seat"]["action"] == two["seat"]["action"]


class Stateful:
    """A defence whose parameters nobody can read."""

    def __init__(self, defence=None):
        self.defence = defence or Kalman()

    def prepare(self, model):
        return self.defence.prepare(model)

    def start(self, plan, prior):
        return self.defence.start(plan, prior)

    def step(self, plan, state, received, known_u, draws):
        return self.defence.step(plan, state, received, known_u, draws)


def _local():
    class Local(Kalman):
        pass

    return Local()


@pytest.mark.parametrize("defence", [_local(), Stateful(Kalman("steady")), compose(*Kalman().parts())])
def test_an_object_without_a_text_is_refused_in_one_line(defence):
    """Only when the JSON is asked for: such an environment plays."""
    env = gymnasium.make(ID, defence=defence)
    env.reset(seed=1)
    with pytest.raises(InputError, match=r"^spec: defence: got .*cannot be written as JSON[^\n]*$"):
        env.spec.to_json()


def test_an_argument_that_is_no_data_is_refused_by_name():
    spec = gymnasium.make(DEFENDER, defence=tailgate.make_defence("chi2_kf"), attack=tailgate.make_attack("fdi")).spec
    spec.kwargs["reward"] = object()
    with pytest.raises(InputError, match=r"spec: reward.*cannot be written as JSON"):
        spec.to_json()


FACES = [
    (lambda: AdversaryEnv(), {"speed": 3}), (lambda: AdversaryVectorEnv(2), {"reset_mask": np.ones(2, bool), "mask": 1}),
    (lambda: DefenderEnv(), {"seed": 1}), (lambda: DuelEnv(), {"max_cycles": 10}),
]  # fmt: skip


@pytest.mark.parametrize(("face", "options"), FACES)
def test_an_unknown_option_of_reset_is_refused(face, options):
    """By its name, in the first episode and in a later one; none and an empty mapping are taken."""
    env = face()
    key = next(name for name in options if name != "reset_mask")
    for _ in range(2):
        taken = "one of these .*: reset_mask" if "reset_mask" in options else "no options: reset takes none"
        with pytest.raises(InputError, match=f"options: unknown key: got '{key}'; expected {taken}$"):
            env.reset(options=options)
        env.reset(options={})
    with pytest.raises(InputError, match="options: got 3; expected a mapping"):
        env.reset(options=3)


def test_an_environment_shows_what_it_is():
    """By its id or, where it has none, by scenario and defence, as the vector environment of Gymnasium does; no address."""
    v1 = "tailgate/CarFollowing-v1"
    assert repr(gymnasium.make(v1).unwrapped) == f"AdversaryEnv({v1})"
    assert repr(gymnasium.make_vec(v1, num_envs=2)) == f"AdversaryVectorEnv({v1}, num_envs=2)"
    assert repr(gymnasium.make(DEFENDER).unwrapped) == "DefenderEnv(tailgate/Defender-v0)"
    assert repr(AdversaryEnv(scenario="radar-braking-v0", defence="kf")) == "AdversaryEnv(radar-braking-v0, kf)"
    assert repr(DuelEnv(scenario="stop-and-go-v0")) == "DuelEnv(stop-and-go-v0, Steered)"


WIDE = [1e9, -1.001, np.inf, np.nan]


@pytest.mark.parametrize("value", WIDE)
def test_a_vector_outside_of_the_space_is_refused(value):
    """In the single environment, in the batch, and for both players of the game; float32's rounding aside."""
    alone, batch, game = AdversaryEnv(action="continuous"), AdversaryVectorEnv(2, action="continuous"), DuelEnv(action="continuous", defender_action="box")
    size, knobs = alone.action_space.shape, game.action_space("defender").shape
    for env in (alone, batch, game):
        env.reset(seed=1)
    with pytest.raises(InputError, match=r"\[-1, 1\]"):
        alone.step(np.full(size, value, np.float32))
    with pytest.raises(InputError, match=r"\[-1, 1\]"):
        batch.step(np.array([np.zeros(size), np.full(size, value)], np.float32))
    for who, shape in (("attacker", game.action_space("attacker").shape), ("defender", knobs)):
        actions = {"attacker": np.zeros(size, np.float32), "defender": np.zeros(knobs, np.float32)}
        with pytest.raises(InputError, match=f"actions.{who}"):
            game.step(actions | {who: np.full(shape, value, np.float32)})
    alone.step(np.full(size, np.nextafter(np.float32(1.0), np.float32(2.0)), np.float32))


def test_the_bounds_of_a_box():
    assert in_box(np.array([1.0, -1.0, 0.0])) and in_box(np.array([1, -1])) and in_box(np.array([np.float32(1.0000001)]))
    assert not in_box(np.array([1.00001])) and not in_box(np.array(["a"])) and not in_box(np.array([None]))


def test_a_limit_of_decisions_is_part_of_the_card():
    """Papers cite its hash; a limit beyond the horizon changes nothing."""
    plain, short, long = (AdversaryVectorEnv(1, scenario="braking-v0", defence="kf", max_episode_steps=most).card() for most in (None, 3, 10_000))
    assert plain == long and plain["hash"] != short["hash"] and short["max_episode_steps"] == 3
