"""Pictures of episodes: what is shown changes the picture where it is shown, and nothing else does."""

import importlib.util
import sys
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest

pytest.importorskip("PIL")

from gymnasium.utils.env_checker import check_env

from tailgate.base.pytree import duplicate
from tailgate.core import Kind, Mode
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.render import canvas as render_canvas
from tailgate.envs.render import following as render_following
from tailgate.envs.render import picture as render

from . import pictures
from .pictures import HEADER, differ, picture, with_estimate

STRIPS = {"road": np.s_[HEADER : int(render_following.STRIP)], "belief": np.s_[int(render_following.STRIP) + 2 :]}
ROLLS = {"scenario": "stop-and-go-v0", "defence": "kf", "viewer": "plain"}
CRASHES = {"value": -30.0, "threat": {"onset": 1}} | ROLLS  # an unguarded filter: 30 m of false data end in a collision


made = partial(pictures.made, **ROLLS)
changed = partial(differ, regions=STRIPS)
with_command = partial(pictures.with_command, at=np.s_[..., :2])


def with_gaps(state, gap=None, rear_gap=None):
    plant = state.plant
    x = plant.ego[:, 0, 0]
    if gap is not None:
        plant = plant._replace(lead_x=x + gap)
    if rear_gap is not None:
        plant = plant._replace(behind=plant.behind._replace(x=x - rear_gap))
    return state._replace(plant=plant)


def test_shape_type_and_repetition():
    env = made()
    one = picture(env)
    assert one.shape == (render.HEIGHT, render.WIDTH, 3) and one.dtype == np.uint8
    assert one.flags.writeable and len(np.unique(one.reshape(-1, 3), axis=0)) > 10
    assert (one == picture(env)).all()
    twin = made()
    assert (one == picture(twin)).all()


def test_drawing_leaves_the_state_alone(same_tree):
    env = made()
    before = duplicate(env.state)
    picture(env)
    assert not same_tree(before, env.state)


def test_without_pillow_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    spec = importlib.util.spec_from_file_location("without_pillow", render_canvas.__file__)
    with pytest.raises(ImportError, match=r"pip install 'tailgate\[viz\]'"):
        spec.loader.exec_module(importlib.util.module_from_spec(spec))


def test_every_command_has_its_own_badge():
    env = made()
    pictures = [picture(env, with_command(env.state, kind, -4.0)) for kind in Kind]
    for i, one in enumerate(pictures):
        for other in pictures[:i]:
            assert changed(one, other) == {"badge"}
    for kind in (Kind.FDI, Kind.DOS_JAM):
        assert changed(picture(env, with_command(env.state, kind, -4.0)), picture(env, with_command(env.state, kind, 4.0))) == {"badge"}
    refused = env.frame._replace(refused=np.ones(1, bool))
    assert changed(picture(env), picture(env, frame=refused)) == {"badge"}


def test_alarm_and_mode_are_at_the_lamp():
    env = made()
    calm = picture(env)
    assert changed(calm, picture(env, with_estimate(env.state, alarm=np.ones((1, 1), bool)))) == {"lamp"}
    modes = [picture(env, with_estimate(env.state, mode=np.full((1, 1), mode, np.int8))) for mode in Mode]
    assert (modes[0] == calm).all()
    for i, one in enumerate(modes):
        for other in modes[:i]:
            assert changed(one, other) == {"lamp"}


@pytest.mark.parametrize("off", [-1e12, -3000.0, -300.0, -20.0, 5.0, 80.0, 300.0, 3000.0, 1e12])
def test_belief_has_its_own_strip_however_wild(off):
    env = made()
    x = env.state.estimate.x.copy()
    x[..., 0] += off
    with np.errstate(all="raise"):
        wild = picture(env, with_estimate(env.state, x=x))
    assert changed(picture(env), wild) == {"belief"}


def test_belief_is_the_gap_that_the_controller_heard():
    env = made()
    wires = env.frame.wires.copy()
    wires[..., env.seat.loop.model.wires.index("leader_position")] += 30.0
    assert changed(picture(env), picture(env, frame=env.frame._replace(wires=wires))) == {"belief"}


def test_budget_is_shown_only_where_there_is_one():
    free, bound = made(), made(threat={"budget": 7})
    assert changed(picture(free), picture(bound)) == {"budget"}
    spent = bound.state._replace(channel=bound.state.channel._replace(used=np.array([3])))
    assert changed(picture(bound), picture(bound, spent)) == {"budget"}


@pytest.mark.parametrize("gap", [0.01, 6.0, 14.9, 15.1, 90.0, 470.0, 5000.0])
@pytest.mark.parametrize("rear_gap", [0.01, 3.0, 42.0, 900.0])
def test_cars_stay_in_the_picture_or_are_said_to_be_out_of_it(monkeypatch, gap, rear_gap):
    env, words, noses = made(), [], []
    canvas = render_canvas.Canvas
    text, car = canvas.text, canvas.car
    monkeypatch.setattr(canvas, "text", lambda self, x, y, said, *a, **k: (words.append(said), text(self, x, y, said, *a, **k))[1])
    monkeypatch.setattr(canvas, "car", lambda self, nose, *a, **k: (noses.append(nose), car(self, nose, *a, **k))[1])
    picture(env, with_gaps(env.state, gap, rear_gap))
    out = sum(said in ("ahead (out of view)", "behind (out of view)") for said in words)
    real = [nose for nose in noses[-(3 - out) :]]  # the ghost is drawn before them
    assert all(render_canvas.CAR <= nose <= render.WIDTH for nose in real) and len(real) + out == 3
    assert ("ahead (out of view)" in words) == (gap > render_following.SPANS[-1])


def test_scale_comes_from_a_fixed_set():
    scales = {render_following.scale_of(gap, rear) for gap in np.linspace(-2.0, 2000.0, 400) for rear in (0.0, 10.0, 50.0, 1000.0, np.inf)}
    assert scales == {render_following.AHEAD / span for span in render_following.SPANS}


def test_no_driver_behind():
    env = made(scenario="thesis-ch4-v0")
    assert picture(env).shape == (render.HEIGHT, render.WIDTH, 3)


def _signs(monkeypatch):
    said = []
    sign = render_canvas.Canvas.sign
    monkeypatch.setattr(render_canvas.Canvas, "sign", lambda self, left, top, words: (said.append(words), sign(self, left, top, words))[1])
    return said


@pytest.mark.parametrize(
    "gap, rear_gap, ended, signs",
    [
        (1.0, 1.0, False, []),
        (-0.5, 1.0, True, ["COLLISION"]),
        (1.0, -0.5, True, ["REAR COLLISION"]),
        (-0.5, -0.5, True, ["REAR COLLISION", "COLLISION"]),
        (3.0, 3.0, True, ["COLLISION"]),
    ],
)
def test_collisions_are_marked(monkeypatch, gap, rear_gap, ended, signs):
    env, said = made(), _signs(monkeypatch)
    state = with_gaps(env.state, gap, rear_gap)
    one = picture(env, state._replace(ended=np.array([ended])))
    assert said == signs
    if ended:
        assert "road" in changed(one, picture(env, with_gaps(env.state, 1.0, 1.0)))


def test_right_after_a_reset():
    env = made(rows=2, steps=0)
    assert env.frame is None
    fresh = env.render()
    assert len(fresh) == 2
    env.step(np.zeros(2, np.int64))
    stepped = env.render()
    env.reset(options={"reset_mask": np.array([True, False])})
    assert env.frame is None  # which the other row must survive
    again = env.render()
    assert changed(stepped[1], again[1]) <= {"belief"}
    assert changed(stepped[0], again[0])


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
def test_autoreset_shows_the_crash_then_the_new_episode(monkeypatch, autoreset):
    said, env = _signs(monkeypatch), AdversaryVectorEnv(2, render_mode="rgb_array", autoreset=autoreset, engine="plain", **CRASHES)
    env.reset(seed=5)
    attack = next(i for i, mode in enumerate(env.seat.action.modes) if mode[0] == "fdi-")
    for _ in range(env.seat.loop.horizon):
        _, _, terminated, _, _ = env.step(np.array([0, attack]))
        if terminated[1]:
            break
    assert terminated.tolist() == [False, True]
    env.render()
    if autoreset == "next_step":
        assert said == ["COLLISION"]
        env.step(np.array([0, attack]))
        said.clear()
    assert env.state.k[1] == 1
    other, new = env.render()
    assert said == [] and (other != new).any()
    plain = picture(env, frame=env.frame._replace(collided=np.zeros(2, bool), rear_collided=np.zeros(2, bool)), row=1)
    assert "road" in changed(new, plain)  # a line about how the last episode ended
    env.step(np.array([0, 0]))
    assert said == [] and env.render()[1].shape == new.shape


def test_every_row_has_its_own_picture():
    env = made(rows=4, steps=0)
    env.step(np.arange(4) % env.single_action_space.n)
    pictures = env.render()
    assert len(pictures) == 4
    for row, one in enumerate(pictures):
        assert (one == picture(env, row=row)).all()
        assert all((one != other).any() for other in pictures[:row])


def test_gymnasium_accepts_it(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("tailgate:tailgate/CarFollowing-v1", render_mode="rgb_array", viewer="plain")
        check_env(env.unwrapped)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        assert env.render().shape == (render.HEIGHT, render.WIDTH, 3)
        env.close()


# -- the window


# -- Gymnasium's own recording


def test_gymnasium_records_a_video(tmp_path):
    """RecordVideo writes a file with something in it."""
    pytest.importorskip("moviepy")
    env = gymnasium.make("tailgate:tailgate/CarFollowing-v0", render_mode="rgb_array", **ROLLS)
    env = gymnasium.wrappers.RecordVideo(env, str(tmp_path / "films"), video_length=6)
    env.reset(seed=0)
    for _ in range(8):
        env.step(env.action_space.sample())
    env.close()
    (film,) = tmp_path.glob("films/*.mp4")
    assert film.stat().st_size > 2000
