"""Laws that every face obeys: nothing handed out is used again, copies go on alike, a picture costs no engine."""

import copy
import itertools
import pickle

import gymnasium
import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv
from tailgate.evaluation.cells import Cell, run_cell

from .engines import short as shortened
from .tiny import AUTORESETS, CRASHES, SYSTEMS, write

CAR, HIGHWAY = "tailgate/CarFollowing-v0", "tailgate/Highway-v0"


def spoil(held):
    """Overwrite everything that can be, as a careless caller may."""
    if isinstance(held, dict):
        for value in held.values():
            spoil(value)
        held.clear()
        held["mine"] = 1
    elif isinstance(held, (list, tuple)):
        for value in held:
            spoil(value)
        if isinstance(held, list):
            held[:] = [{"mine": 1}] * len(held)
    elif isinstance(held, np.ndarray) and held.flags.writeable:
        held[...] = np.zeros((), held.dtype) if held.dtype == bool else 77


def arrays(held):
    """Every array that can be written to, however deep."""
    if isinstance(held, np.ndarray):
        return [held] if held.flags.writeable else []
    parts = held.values() if isinstance(held, dict) else held if isinstance(held, (list, tuple)) else ()
    return [array for part in parts for array in arrays(part)]


def alike(one, other):
    """The same types, shapes and bits, through dictionaries and lists."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            alike(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for parts in zip(one, other, strict=True):
            alike(*parts)
    elif isinstance(one, (np.ndarray, np.generic)):
        assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    else:
        assert one == other


class Driver:
    """One face, stepped with the actions of a seed; what it hands out at a step, all in one tuple."""

    def __init__(self, name, arguments, face, seed=0):
        arguments = SYSTEMS[name] | arguments
        self.rng, self.face, self.over = np.random.default_rng(seed), face, False
        if face == "single":
            self.env = AdversaryEnv(**arguments)
        elif face == "sb3":
            from tailgate.envs.gym.sb3 import BatchVecEnv

            self.env = BatchVecEnv(3, name, **arguments)
        else:
            self.env = AdversaryVectorEnv(3, autoreset=face, **arguments)
        if face == "sb3":
            self.env.seed(4)
            self.first = self.env.reset()
        else:
            self.first = self.env.reset(seed=4)

    def step(self):
        env, batch = self.env, getattr(self.env, "batch", self.env)
        actions, masks = self.rng.integers(0, batch.seat.action.size, 3), env.action_masks()
        if self.face == "single":
            out = [env.reset() if self.over else env.step(int(actions[0]))]
            self.over = not self.over and (out[0][2] or out[0][3])
        elif self.face == "sb3":
            out = [env.step(actions)]
        else:
            out = [env.step(actions)]
            if self.face == "disabled" and (done := out[0][2] | out[0][3]).any():
                out.append(env.reset(options={"reset_mask": done.copy()}))
        return [masks, *out]


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    """Stop-and-go traffic for 60 steps."""
    path = tmp_path_factory.mktemp("brief") / "brief.yaml"
    path.write_text(shortened("stop-and-go-v0"))
    return str(path)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """By id and engine: arguments of an environment of ten decisions."""
    written = write(tmp_path_factory.mktemp("scenario"))
    return {(name, engine): written[name] | {"interval": 4, "engine": engine} for name, engine in PLAYED}


FACE_NAMES = ("single", "sb3", *AUTORESETS)
PLAYED = [(name, engine) for name in SYSTEMS for engine in ("auto", "plain") if (name, engine) != (HIGHWAY, "plain")]


@pytest.mark.thin(18)
@pytest.mark.parametrize("face", FACE_NAMES)
@pytest.mark.parametrize("name, engine", PLAYED)
def test_nothing_that_was_handed_out_is_used_again(name, engine, face, tiny):
    """A caller that overwrites all it got changes nothing of what comes; what it keeps is not changed by what comes."""
    if face == "sb3":
        pytest.importorskip("stable_baselines3")
    kind, rough = (Driver(name, tiny[name, engine], face) for _ in range(2))
    kept = [(kind.first, copy.deepcopy(kind.first))]
    spoil(rough.first)
    for _ in range(23 if name != HIGHWAY else 12):
        one, other = kind.step(), rough.step()
        alike(one, other)
        assert not any(np.may_share_memory(a, b) for a, b in itertools.combinations(arrays(one), 2))
        kept.append((one, copy.deepcopy(one)))
        spoil(other)
    for held, before in kept:
        alike(held, before)


def test_rows_that_are_not_reset_are_shown_as_they_are():
    """A reset of one row of many, after a caller has overwritten what it was shown of all."""
    one, other = (AdversaryVectorEnv(150, autoreset="disabled") for _ in range(2))
    for env in (one, other):
        env.reset(seed=4)
    alike(one.step(np.ones(150, np.int64)), held := other.step(np.ones(150, np.int64)))
    spoil(held)
    mask = np.arange(150) == 3
    alike(*(env.reset(options={"reset_mask": mask}) for env in (one, other)))


def test_rows_of_a_cell_share_nothing():
    """Rows are the caller's own, whatever is nested in them."""
    one, other = run_cell(Cell("", "braking-v0", 5, "kf", "none", 2))
    for key, value in one.items():
        if isinstance(value, (dict, list)):
            assert value is not other[key], key


COPIES = {"pickle": lambda env: pickle.loads(pickle.dumps(env)), "deepcopy": copy.deepcopy}


@pytest.mark.thin(31)
@pytest.mark.parametrize("how", COPIES)
@pytest.mark.parametrize("face", FACE_NAMES)
@pytest.mark.parametrize("name, engine", PLAYED)
def test_a_copy_goes_on_as_its_original(name, engine, face, how, tiny):
    """Copied in mid-episode, both play on to the same observations, rewards, flags, infos and masks, through ends; neither moves the other."""
    if face == "sb3":
        pytest.importorskip("stable_baselines3")
    driver = Driver(name, tiny[name, engine], face)
    for _ in range(3):
        driver.step()
    other = copy.copy(driver)
    other.env, other.rng = COPIES[how](driver.env), copy.deepcopy(driver.rng)
    steps = 20 if name != HIGHWAY else 8
    alike([driver.step() for _ in range(steps)], [other.step() for _ in range(steps)])


@pytest.mark.long
@pytest.mark.parametrize("action", ["continuous", "increment"])
def test_a_copy_before_the_first_reset_and_of_vectors(action):
    """An environment that has not begun, one with frames, and the generator of its spaces and seeds."""
    env = AdversaryVectorEnv(2, action=action, frames=3, interval=10)
    early = copy.deepcopy(env)
    alike(env.reset(seed=1), early.reset(seed=1))
    late = pickle.loads(pickle.dumps(env))
    actions = np.full((2, env.seat.action.size), 0.25, np.float32)
    for _ in range(70):
        alike(env.step(actions), late.step(actions))
    alike(env.reset(), late.reset())
    assert not late._present["_gap"].flags.writeable


class Elsewhere(type(tailgate.make_defence("kf"))):
    opaque = "its state lies in another process"


@pytest.mark.parametrize("how", COPIES)
def test_a_defence_whose_state_lies_elsewhere_is_not_copied(how):
    """As one in a sandbox: one error that says why."""
    env = AdversaryEnv(defence=Elsewhere(), engine="plain")
    env.reset(seed=0)
    with pytest.raises(InputError, match=r"copy: got 'Elsewhere'.*copied in mid-episode: its state lies in another process"):
        COPIES[how](env)


@pytest.mark.long
def test_the_game_is_copied_in_mid_episode():
    """PettingZoo's environment, the defender's, and both go on alike."""
    pytest.importorskip("pettingzoo")
    from tailgate.envs.gym.parallel import parallel_env

    env = parallel_env(interval=20)
    env.reset(seed=2)
    for _ in range(3):
        env.step({"attacker": 1, "defender": 0})
    others = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(10):
        whole = env.step({"attacker": 1, "defender": 1})
        for other in others:
            alike(whole, other.step({"attacker": 1, "defender": 1}))
    defender = gymnasium.make("tailgate/Defender-v0", interval=20, attack=["fdi", "dos_jam"]).unwrapped
    defender.reset(seed=3)
    twin, over = pickle.loads(pickle.dumps(defender)), False
    while not over:
        result = defender.step(1)
        alike(result, twin.step(1))
        over = result[2] or result[3]
    alike(defender.reset(), twin.reset())


def test_the_game_has_what_pettingzoo_expects(monkeypatch):
    """A window, a limit of cycles, a state of both, and a mask for either."""
    parallel = pytest.importorskip("tailgate.envs.gym.parallel")
    env = parallel.parallel_env(interval=5, max_cycles=3)
    env.reset(seed=1)
    for cycle in range(3):
        seen, _, terminated, truncated, infos = env.step({"attacker": 0, "defender": 0})
        assert np.array_equal(env.state(), np.concatenate([seen["attacker"], seen["defender"]])) and env.state_space.contains(env.state())
        assert infos["defender"]["action_mask"].tolist() == [1] * env.action_space("defender").n
        assert truncated == dict.fromkeys(env.possible_agents, cycle == 2) and not any(terminated.values())
        assert all(np.asarray(value).dtype == value.dtype for info in infos.values() for value in info.values())
    assert env.agents == []
    env.reset()
    assert env.cycles == 0 and env.agents == env.possible_agents
    with pytest.raises(InputError, match=r"max_cycles.*not below 1"):
        parallel.parallel_env(max_cycles=0)
    with pytest.raises(InputError, match=r"state.*reset\(\) first"):
        parallel.parallel_env().state()
    assert "action_mask" not in parallel.parallel_env(defender_action="box").reset(seed=1)[1]["defender"]


def test_the_game_is_shown_in_a_window(monkeypatch):
    """Human mode opens a window at reset, shows each step once, and changes no bit."""
    parallel, pygame = pytest.importorskip("tailgate.envs.gym.parallel"), pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env, twin = (parallel.parallel_env(interval=5, render_mode=mode, viewer="plain") for mode in ("human", "rgb_array"))
    env.metadata["render_fps"] = 10_000
    for one in (env, twin):
        one.reset(seed=1)
    for _ in range(2):
        alike(*(one.step({"attacker": 1, "defender": 0}) for one in (env, twin)))
        shown = np.moveaxis(pygame.surfarray.array3d(pygame.display.get_surface()), 0, 1)
        assert env.render() is None and (shown == twin.render()).all()
    env.close()
    assert not pygame.display.get_init()


# -- pictures


@pytest.mark.long
@pytest.mark.parametrize("autoreset", AUTORESETS)
def test_pictures_of_the_fast_engine_are_those_of_the_plain_loop(autoreset, brief):
    """Looked at now and then, through collisions, ends and resets by mask: the same pixels, and not one bit of another step."""
    pytest.importorskip("PIL")
    config = CRASHES | {"scenario": brief}
    fast, plain, bare = (
        AdversaryVectorEnv(2, autoreset=autoreset, viewer="plain", engine=engine, render_mode=mode, **config)
        for engine, mode in (("auto", "rgb_array"), ("plain", "rgb_array"), ("auto", None))
    )
    assert (fast.engine, plain.engine) == ("traced", "plain") and fast.render() is None
    envs, rng, ends = (fast, plain, bare), np.random.default_rng(1), 0
    for env in envs:
        env.reset(seed=5)
    for t in range(130):
        if t % 17 in (0, 1, 2) or 60 <= t < 68:
            assert all((one == other).all() for one, other in zip(fast.render(), plain.render(), strict=True)), t
        actions = rng.integers(0, fast.seat.action.size, 2)
        results = [env.step(actions) for env in envs]
        alike(results[0], results[2])
        over = results[0][2] | results[0][3]
        ends += int(over.sum())
        if autoreset == "disabled" and over.any():
            for env in envs:
                env.reset(options={"reset_mask": over})
        if t == 50:
            for env in envs:
                env.reset(seed=[None, 8], options={"reset_mask": np.array([False, True])})
        if t == 100:
            for env in envs:
                env.reset()
    assert ends >= 6 and fast.engine == "traced"


@pytest.mark.long
def test_a_single_environment_that_may_be_drawn_stays_fast():
    """As `make_vec_env` makes it: render_mode is set and nobody looks. The first picture, and each later one, is the plain loop's."""
    pytest.importorskip("PIL")
    fast, plain = (gymnasium.make(CAR, render_mode="rgb_array", viewer="plain", engine=engine, **CRASHES).unwrapped for engine in ("auto", "plain"))
    for env in (fast, plain):
        env.reset(seed=5)
    assert fast.batch.engine == "traced"
    for t in range(75):
        one, other = fast.step(t % 3), plain.step(t % 3)
        alike(one, other)
        if t in (30, 31, 74):
            assert (fast.render() == plain.render()).all()
        if one[2] or one[3]:
            alike(fast.reset(), plain.reset())
            assert (fast.render() == plain.render()).all()
    assert fast.batch.engine == "traced" and fast._alone is not None


@pytest.mark.long
def test_decisions_are_kept_for_two_episodes_at_most(brief):
    """A run of many episodes that nobody looks at stays small; a look then is right, and costs the present episodes alone."""
    pytest.importorskip("PIL")
    config = CRASHES | {"scenario": brief, "interval": 12}
    fast, plain = (AdversaryVectorEnv(3, viewer="plain", engine=engine, render_mode="rgb_array", **config) for engine in ("auto", "plain"))
    for env in (fast, plain):
        env.reset(seed=5)
    for t in range(150):
        for env in (fast, plain):
            env.step(np.array([0, 1, t % 4]))
        assert len(fast.episodes.shadow.events) <= 64 + 4 * 5
    assert fast.episodes.shadow.dropped >= 70
    assert all((one == other).all() for one, other in zip(fast.render(), plain.render(), strict=True))


def test_a_copy_is_drawn_as_its_original():
    """Also where its episode began before the copy."""
    pytest.importorskip("PIL")
    env = AdversaryEnv(render_mode="rgb_array", viewer="plain", **CRASHES)
    env.reset(seed=5)
    for _ in range(9):
        env.step(1)
    other = pickle.loads(pickle.dumps(env))
    assert (env.render() == other.render()).all()
    kept = other.batch.episodes.held()
    other.batch.episodes.put(kept)
    with pytest.raises(InputError, match=r"render.*reset\(\) first"):
        other.render()
    other.batch.reset()
    assert other.batch.render()[0].shape == env.render().shape


def test_the_batch_of_stable_baselines_keeps_its_contract():
    """Each row gets its own part of an array, and all rows the same card. Unknown options are refused. Each row has a picture."""
    pytest.importorskip("stable_baselines3")
    from tailgate.envs.gym.sb3 import BatchVecEnv

    env = BatchVecEnv(3, render_mode="rgb_array")
    env.seed(4)
    env.reset()
    assert env.env_method("card") == [env.batch.card()] * 3 and len(env.env_method("action_masks", indices=[0, 2])) == 2
    assert [type(one) for one in env.get_attr("over")] == [np.bool_] * 3
    assert len(env.get_images()) == 3 and env.get_images()[0].dtype == np.uint8
    env.set_options({"nothing": 1})
    with pytest.raises(InputError, match="nothing"):
        env.reset()
    env.reset()
