"""The window of render_mode human."""

import importlib.util
import sys

import gymnasium
import numpy as np
import pytest

pytest.importorskip("PIL")

from tailgate.base.errors import InputError
from tailgate.envs.gym.gymnasium_env import AdversaryEnv, AdversaryVectorEnv
from tailgate.envs.render import picture as render

ROLLS = {"scenario": "stop-and-go-v0", "defence": "kf", "viewer": "plain"}


@pytest.fixture
def screen(monkeypatch):
    """pygame on a screen that is not there."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    yield pygame
    pygame.display.quit()


@pytest.fixture
def watched(screen):
    """A single environment in human mode, without its waiting."""

    def make(**arguments):
        env = gymnasium.make("tailgate:tailgate/CarFollowing-v0", render_mode="human", **(ROLLS | arguments))
        env.unwrapped.metadata["render_fps"] = 10_000
        return env

    return make


def shown(pygame):
    return np.moveaxis(pygame.surfarray.array3d(pygame.display.get_surface()), 0, 1)


def test_the_window_shows_the_picture_of_each_step_by_itself(watched, screen):
    """No window before the first frame; reset() and step() show what rgb_array returns; render() returns None; close() closes."""
    env, twin = watched(), AdversaryEnv(render_mode="rgb_array", **ROLLS)
    assert env.render_mode == "human" and not screen.display.get_init()
    env.reset(seed=5), twin.reset(seed=5)
    assert (shown(screen) == twin.render()).all()
    for action in (0, 1, 1):
        env.step(action), twin.step(action)
        assert (shown(screen) == twin.render()).all()
        assert env.render() is None
    env.close()
    assert not screen.display.get_init()
    env.close()
    env.reset(seed=6)  # opens anew
    assert screen.display.get_init()
    env.close()


def test_human_mode_changes_no_bit_of_an_episode(watched):
    """Observations and rewards with and without a window are the same."""
    env, twin = watched(), AdversaryEnv(**ROLLS)
    assert (env.reset(seed=5)[0] == twin.reset(seed=5)[0]).all()
    for action in (0, 1, 1, 0):
        one, other = env.step(action), twin.step(action)
        assert (one[0] == other[0]).all() and one[1:4] == other[1:4]
    env.close()


def test_a_frame_is_shown_once_and_at_the_frame_rate(watched, screen, monkeypatch):
    """render() after step() shows nothing anew, and each frame waits for the rate."""
    env, calls = watched(), []
    monkeypatch.setattr(render.Window, "show", lambda self, picture: calls.append(self.fps))
    env.reset(seed=1)
    env.step(0)
    env.render()
    assert calls == [10_000, 10_000]
    env.close()
    window = render.Window(20)
    monkeypatch.undo()
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    blank = np.zeros((render.HEIGHT, render.WIDTH, 3), np.uint8)
    window.show(blank)
    start = screen.time.get_ticks()
    for _ in range(4):
        window.show(blank)
    assert screen.time.get_ticks() - start >= 150  # four frames of 50 ms, the first of them begun before
    window.close()


@pytest.mark.parametrize("event", ["QUIT", "WINDOWCLOSE"])
def test_a_window_that_its_reader_closes_stays_closed(watched, screen, event):
    """The episode goes on without it, and later frames open no other."""
    env = watched()
    env.reset(seed=5)
    screen.event.post(screen.event.Event(getattr(screen, event)))
    env.step(0)
    assert not screen.display.get_init()
    _, _, terminated, truncated, _ = env.step(0)
    assert not terminated and not truncated and not screen.display.get_init()
    env.reset()
    assert not screen.display.get_init()
    env.close()


def test_two_environments_share_the_one_display(watched, screen):
    """Closing one does not break the other."""
    one, other = watched(), watched()
    one.reset(seed=1), other.reset(seed=2)
    one.close()
    other.step(0)
    assert screen.display.get_init()
    other.close()


def test_the_picture_follows_the_size_of_the_window(watched, screen):
    """A reader who makes it smaller sees all of the picture, its shape kept; another environment's size is its own."""
    env, twin = watched(), AdversaryEnv(render_mode="rgb_array", **ROLLS)
    env.reset(seed=5), twin.reset(seed=5)
    assert screen.display.get_surface().get_flags() & screen.RESIZABLE
    screen.display.set_mode((render.WIDTH // 2, render.HEIGHT // 2 + 200), screen.RESIZABLE)
    env.step(1), twin.step(1)
    seen, wanted = shown(screen), twin.render()
    assert seen.shape == (render.HEIGHT // 2 + 200, render.WIDTH // 2, 3) and not seen[:100].any() and not seen[-100:].any()
    small = wanted.astype(float).reshape(render.HEIGHT // 2, 2, render.WIDTH // 2, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - seen[100:-100]).max() < 2.0
    road = gymnasium.make("tailgate:tailgate/CarFollowing-v0", render_mode="human", viewer="highway", size=(640, 200))
    road.unwrapped.metadata["render_fps"] = 10_000
    if importlib.util.find_spec("highway_env"):
        road.reset(seed=5)
        assert screen.display.get_surface().get_size() == (640, 200)
    env.close(), road.close()


def test_without_pygame_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = AdversaryEnv(render_mode="human", **ROLLS)
    with pytest.raises(ImportError, match=r"pip install 'tailgate\[viz\]'"):
        env.reset(seed=0)


def test_without_a_screen_the_error_says_so(screen, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "no_such_driver")
    screen.display.quit()
    env = AdversaryEnv(render_mode="human", **ROLLS)
    with pytest.raises(InputError, match=r"render_mode.*human.*screen.*rgb_array"):
        env.reset(seed=0)
    env.close()


def test_a_vector_environment_has_no_window():
    for make in (lambda **a: AdversaryVectorEnv(2, **a), lambda **a: gymnasium.make_vec("tailgate:tailgate/CarFollowing-v0", num_envs=2, **a)):
        with pytest.raises(InputError, match=r"render_mode.*'human'.*rgb_array.*one episode: gymnasium\.make"):
            make(render_mode="human")
