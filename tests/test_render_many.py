"""Pictures of platoons and networks: every agent is drawn, what is attacked, alarmed or wrong is seen at its agent."""

import gymnasium
import numpy as np
import pytest

pytest.importorskip("PIL")

from tailgate.base.pytree import duplicate
from tailgate.core import Kind
from tailgate.envs.render import canvas as render_canvas
from tailgate.envs.render import network as render_network
from tailgate.envs.render import picture as render
from tailgate.envs.render import platoon as render_platoon

from .pictures import HEADER, differ, made, picture, with_command, with_estimate

PLATOON = {"scenario": "platoon-braking-v0", "defence": "dkf", "viewer": "plain", "threat": {"onset": 1, "targets": ["distance", "velocity"]}}
NETWORK = {"scenario": "thesis-ch5-v0", "defence": "dkf", "reward": "error", "threat": {"onset": 1}}
STRIPS = {"road": np.s_[HEADER : int(render_platoon.STRIP)], "belief": np.s_[int(render_platoon.STRIP) + 2 :]}
HALVES = {"graph": np.s_[HEADER:, : int(render_network.SPLIT)], "bars": np.s_[HEADER:, int(render_network.SPLIT) + 2 :]}


def _agents(state, name, rows):
    """The state with an estimate's bools at some agents."""
    value = np.zeros(state.estimate.alarm.shape, bool)
    value[:, rows] = True
    return with_estimate(state, **{name: value})


@pytest.mark.parametrize("kind", [PLATOON, NETWORK])
def test_the_picture_of_many_agents_is_a_picture(kind, same_tree):
    """Shape and type, the same twice, after a reset and under attack; drawing changes nothing."""
    env = made(rows=2, steps=0, **kind)
    fresh = env.render()
    for _ in range(3):
        env.step(np.array([0, 1]))
    before = duplicate(env.state)
    first, second = env.render()
    assert first.shape == (render.HEIGHT, render.WIDTH, 3) and first.dtype == np.uint8
    assert (first == picture(env, row=0)).all() and (first != second).any() and (first != fresh[0]).any()
    assert not same_tree(before, env.state)


def test_every_car_of_a_platoon_is_drawn(said, monkeypatch):
    """A car and its speed for each agent, a ghost for each follower, the gaps to scale from bumper to bumper, true and believed."""
    cars, car = [], render_canvas.Canvas.car
    monkeypatch.setattr(render_canvas.Canvas, "car", lambda self, *a, **k: (cars.append((a, k)), car(self, *a, **k))[1])
    env = made(**PLATOON)
    picture(env)
    ghosts = [a[0] for a, k in cars if k.get("ghost")]
    noses = [a[0] for a, k in cars if not k.get("ghost")]
    assert len(ghosts) == 4 and len(noses) == 5 and {"leader", "car 1", "car 4"} <= set(said)
    place = render_platoon.Place(env.frame.scene.gap[0])
    assert sorted(noses) == sorted(place.nose) and place.nose[0] == render.WIDTH - render_canvas.MARGIN
    np.testing.assert_allclose(place.tail[:-1] - place.nose[1:], env.frame.scene.gap[0, 1:] * place.scale)
    believed = render_platoon.believed_gaps(env.seat.loop, env.state, 0)
    np.testing.assert_allclose(sorted(ghosts), sorted(place.tail[:-1] - believed[1:] * place.scale))
    for gap in (*env.frame.scene.gap[0, 1:], *believed[1:]):
        assert render_canvas.metres(gap) in said


def test_an_attack_on_a_car_is_marked_at_the_car_and_named(said):
    """Badge and road change; the badge says which wires of which cars."""
    env = made(**PLATOON)
    calm = picture(env)
    said.clear()
    assert differ(calm, picture(env, with_command(env.state, Kind.FDI, 7.0, np.s_[:, [1, 3], :1])), STRIPS) == {"badge", "road"}
    assert any("distance +7 m of cars 1, 3" in words for words in said)


@pytest.mark.parametrize("kind, regions", [(PLATOON, STRIPS), (NETWORK, HALVES)])
def test_an_alarm_stands_at_the_lamp_and_at_its_agent(kind, regions, said):
    """Lamp, words and the agent's own mark; another agent's alarm is another picture."""
    env = made(**kind)
    calm = picture(env)
    one, two = picture(env, _agents(env.state, "alarm", [1])), picture(env, _agents(env.state, "alarm", [1, 2]))
    assert {"lamp", next(iter(regions))} <= differ(calm, one, regions) and differ(one, two, regions)
    noun = "car" if kind is PLATOON else "agent"
    assert f"{noun} 1" in said and f"{noun}s 1, 2" in said


@pytest.mark.parametrize("off", [-1e12, -300.0, -20.0, 5.0, 80.0, 3000.0, 1e12])
def test_a_wild_belief_of_a_car_stays_in_the_lower_strip(off, said):
    """However far off, the picture is drawn, and what lies outside of it is said."""
    env = made(**PLATOON)
    x = env.state.estimate.x.copy()
    x[:, 2, 7] += off
    with np.errstate(all="raise"):
        wild = picture(env, with_estimate(env.state, x=x))
    assert differ(picture(env), wild, STRIPS) == {"belief"}
    assert any("out of view" in words for words in said) == (abs(off) >= 3000.0 or off == -300.0)


def test_a_collision_in_a_platoon_is_marked(monkeypatch):
    """The sign names the car that hit the one ahead."""
    signs, sign = [], render_canvas.Canvas.sign
    monkeypatch.setattr(render_canvas.Canvas, "sign", lambda self, left, top, words: (signs.append(words), sign(self, left, top, words))[1])
    env = made(**PLATOON)
    x = env.state.plant.x.copy(order="K")
    x[:, 3] = x[:, 2] + 0.5
    picture(env, env.state._replace(plant=env.state.plant._replace(x=x)))
    assert signs == ["COLLISION: car 3"]


@pytest.mark.parametrize("cars", [1, 2, 20, 100])
def test_long_platoons_fit(cars):
    """From one follower to a hundred: every car is inside, and none is longer than the room."""
    rng = np.random.default_rng(cars)
    for size in (0.2, 6.0, 65.0, 400.0):
        place = render_platoon.Place(np.concatenate([[np.inf], size * rng.uniform(0.5, 1.5, cars)]))
        assert place.tail.min() >= render_canvas.MARGIN - 1e-6 and place.nose.max() <= render.WIDTH
        assert (np.diff(place.nose) < 0.0).all() and place.length >= render_platoon.SHORTEST


def test_a_network_is_shaded_by_its_errors(said):
    """Darker for larger errors, the figures beside the bars; what is attacked has a ring and a lightning."""
    greys = [int(render_network.shade(e)[1:3], 16) for e in (0.0, 1e-2, 1.0, 50.0, 1e3, 1e9, np.inf)]
    assert greys == sorted(greys, reverse=True) and len(set(greys)) >= 5
    env = made(**NETWORK)
    calm = picture(env)
    sizes = env.seat.loop.model.error(env.frame.estimate.x, env.frame.truth)[0]
    assert {render_network._short(size) for size in sizes} <= set(said)
    assert differ(calm, picture(env, with_command(env.state, Kind.FDI, -4.0, np.s_[:, 4])), HALVES) == {"badge", "graph", "bars"}
    x = env.frame.estimate.x.copy()
    x[:, 4] += 100.0
    worse = env.frame._replace(estimate=env.frame.estimate._replace(x=x))
    assert differ(calm, picture(env, frame=worse), HALVES) == {"graph", "bars"}


def test_a_network_without_an_estimate_says_so(said):
    """Right after a reset there is no error to show."""
    env = made(steps=0, **NETWORK)
    env.render()
    assert "no estimate yet" in said


def test_the_badge_of_many_wires_is_short(said):
    """Fourteen readings of six agents with values of their own: their number and their range, within the badge."""
    env = made(**NETWORK)
    shape = env.state.channel.last.value.shape
    values = np.linspace(-900.0, 800.0, shape[1] * shape[2]).reshape(shape)
    picture(env, with_command(env.state, Kind.FDI, values, np.s_[:, [0, 1, 2, 4, 7, 9]]))
    (words,) = [line for line in said if line.startswith("adds")]
    assert words.startswith("adds 14 readings of agents 0, 1, 2, 4, 7, 9: -900 to +")


@pytest.mark.parametrize("name", ["tailgate/Platoon-v0", "tailgate/SensorNetwork-v0"])
def test_other_systems_have_a_window(name, monkeypatch):
    """Human mode shows what rgb_array returns."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    env = gymnasium.make(name, render_mode="human", engine="plain")
    env.unwrapped.metadata["render_fps"] = 10_000
    twin = gymnasium.make(name, render_mode="rgb_array", engine="plain")
    env.reset(seed=3), twin.reset(seed=3)
    env.step(0), twin.step(0)
    assert (np.moveaxis(pygame.surfarray.array3d(pygame.display.get_surface()), 0, 1) == twin.render()).all()
    env.close()
