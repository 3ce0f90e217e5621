"""Pictures on HighwayEnv's road: every environment, every mark, several sizes, and that no picture changes an episode."""

import dataclasses

import gymnasium
import numpy as np
import pytest
import yaml

pytest.importorskip("PIL")
pytest.importorskip("highway_env")

from highway_env.vehicle.graphics import VehicleGraphics

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.pytree import duplicate
from tailgate.core import Kind, draws
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.render import canvas as render_canvas
from tailgate.envs.render import highway as render_highway
from tailgate.envs.render import picture as render
from tailgate.envs.render import viewer as render_viewer
from tailgate.envs.render.stage import LENGTH, stage_of
from tailgate.envs.render.viewer import Viewer
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.replay.replay import play
from tailgate.replay.video import frames, write_video

from . import pictures
from .pictures import with_command, with_estimate

ROADS = ["tailgate/CarFollowing-v0", "tailgate/RadarFollowing-v0", "tailgate/Platoon-v0", "tailgate/Highway-v0"]
SIZES = [(480, 160), (960, 240), (1280, 360)]
FOLLOWING, RADAR, PLATOON, HIGHWAY = ROADS


def made(name=FOLLOWING, **arguments):
    """A vector environment after some steps."""
    return pictures.made(**(gymnasium.spec(name).kwargs | ({"defence": "dkf"} if name == PLATOON else {}) | arguments))


def picture(env, size=None, state=None, frame=None, row=0):
    return render.draw(env.seat.loop, state or env.state, frame or env.frame, row, Viewer("highway", size))


def near(picture, colour, off=12):
    """(H, W) bool: pixels of about this colour."""
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)] if isinstance(colour, str) else colour
    return (np.abs(picture.astype(int) - np.array(wanted)) < off).all(axis=2)


@pytest.mark.thin(5)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", ROADS)
def test_every_road_has_a_picture_at_every_size(name, size, same_tree):
    """Shape and type, the same twice, right after a reset as well; another step is another picture; the state keeps every bit."""
    env = made(name, rows=2, steps=0, viewer="highway", size=size)
    fresh = env.render()
    env.step(np.array([0, 1]))
    before = duplicate(env.state)
    first, second = env.render()
    assert first.shape == (size[1], size[0], 3) and first.dtype == np.uint8 and first.flags.writeable
    assert (first == picture(env, size)).all() and (first != second).any() and (first != fresh[0]).any()
    assert not same_tree(before, env.state)


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", ROADS)
def test_drawing_changes_no_bit_of_an_episode(name):
    """The same observations, rewards and states with a picture of every step and without any, over the end of episodes; no random source moves."""
    arguments = {"scenario": gymnasium.spec(name).kwargs["scenario"], "threat": {"onset": 2, "end": None}}
    drawn, plain = (made(name, rows=2, steps=0, viewer="highway", size=(480, 160), **arguments) for _ in range(2))
    world = np.random.get_state()[1].copy()  # noqa: NPY002 - nobody's own, so nobody may move it
    for k in range(8):
        actions = np.array([1, k % 2])
        drawn.render()
        one, other = drawn.step(actions), plain.step(actions)
        assert all(np.array_equal(a, b) for a, b in zip(one[:4], other[:4], strict=True))
        assert drawn.np_random.bit_generator.state == plain.np_random.bit_generator.state
    assert np.array_equal(world, np.random.get_state()[1])  # noqa: NPY002
    assert all(np.array_equal(getattr(drawn.frame, leaf), getattr(plain.frame, leaf)) for leaf in ("truth", "wires", "control", "applied"))


@pytest.mark.parametrize("name", ROADS)
def test_the_cars_are_highwayenvs_and_where_they_are(name):
    """The middle of each defended car has HighwayEnv's colour for it, at the place that its state says."""
    env = made(name)
    stage, sheet = stage_of(env.seat.loop, env.state, env.frame, 0), render_highway.Sheet(1280, 360)
    sheet.window = render_highway.window_of(stage, sheet)
    green = near(picture(env, (1280, 360)), VehicleGraphics.EGO_COLOR, 30)
    for car in stage.cars:
        x, y = round(sheet.column(car.x)), round(sheet.row(car.y))
        shown = green[y - 1 : y + 2, x - 2 : x + 3]
        assert shown.any() if car.role == "defended" else not shown.any(), car
    ends = [(sheet.column(car.tail), sheet.column(car.nose)) for car in stage.cars if car.role != "driver"]
    assert min(ends)[0] > 0 and max(ends)[1] < 1280


def test_gaps_are_those_of_the_scene():
    """Bumper to bumper in every scene, and in HighwayEnv's own the cars stand where they are."""
    for name in ROADS:
        env = made(name)
        stage = stage_of(env.seat.loop, env.state, env.frame, 0)
        gaps = env.seat.loop.plant.scene(env.seat.loop.plan.plant, env.state.plant).gap[0]
        for follower in stage.followers:
            assert follower.gap == pytest.approx(gaps[follower.agent])
            if not follower.free:
                nose = stage.cars[follower.car].nose
                ahead = min((car.tail - nose for car in stage.cars if abs(car.tail - nose - follower.gap) < 1e-6), default=None)
                assert ahead is not None, name


@pytest.mark.parametrize("name", ROADS)
def test_true_and_believed_gap_are_said_and_the_ghost_stands_there(name, said):
    """What is believed is the true gap and the error of the measurement's time; a believed gap that is 20 m off moves the ghost by that."""
    env = made(name, steps=4)
    loop, model = env.seat.loop, env.seat.loop.model
    follower = stage_of(loop, env.state, env.frame, 0)
    follower = follower.followers[follower.watched]
    off = float(model.gap_error(env.state.estimate.x, env.frame.truth)[0, follower.agent])
    assert follower.believed == pytest.approx(follower.gap + off)
    x = env.state.estimate.x.copy()
    column = np.flatnonzero(model.gap[follower.agent])[0]
    x[0, follower.agent, column] -= 20.0 * model.gap[follower.agent, column]
    moved = with_estimate(env.state, x=x)
    for size in SIZES:
        said.clear()
        one, other = picture(env, size), picture(env, size, moved)
        assert (one[size[1] // 4 : -size[1] // 4] != other[size[1] // 4 : -size[1] // 4]).any()  # on the road, not only below it
        lines = [line for line in said if "believed" in line and "m/s" in line]
        assert f"believed {follower.believed:,.1f} m ({off:+,.1f} m)" in lines[0] and f"{follower.believed - 20.0:,.1f} m" in lines[1]
        assert f"gap {follower.gap:,.1f} m" in lines[0]


@pytest.mark.parametrize("name", ROADS)
def test_wild_beliefs_are_drawn(name, said):
    """However far off, there is a picture, and what lies outside of it is said."""
    env = made(name)
    loop = env.seat.loop
    agent = 2 if name == PLATOON else 0
    for off in (-1e12, -300.0, 300.0, 1e12):
        x = env.state.estimate.x.copy()
        x[0, agent, np.flatnonzero(loop.model.gap[agent])[0]] += off
        said.clear()
        with np.errstate(all="raise"):
            picture(env, (480, 160), with_estimate(env.state, x=x))
        assert any("out of view" in line for line in said), off


def test_an_attack_an_alarm_and_a_mode_are_marked_without_colour_alone(said):
    """Words in the bar above, and a mark at the car: an outline and a lightning, and a lamp with an exclamation mark."""
    env = made(defence="chi2_kf")
    calm = picture(env)
    for kind, words in ((Kind.FDI, "ATTACK: false data (FDI)"), (Kind.DOS_HOLD, "ATTACK: DoS hold")):
        said.clear()
        one = picture(env, None, with_command(env.state, kind, -4.0))
        assert words in said and (one[60:180] != calm[60:180]).any() and near(one[60:180], render_canvas.ATTACK).any()
    assert not near(calm[60:180], render_canvas.ATTACK).any()
    said.clear()
    alarm = picture(env, None, with_estimate(env.state, alarm=np.ones((1, 1), bool)))
    assert "ALARM" in said and said.count("!") == 2 and (alarm[60:180] != calm[60:180]).any()
    said.clear()
    picture(env)
    assert {"NO ATTACK", "no alarm", "ego", "ahead"} <= set(said)
    picture(env, None, None, env.frame._replace(refused=np.ones(1, bool)))
    assert any("refused" in line for line in said)


def test_attack_and_alarm_stand_at_the_car_of_a_platoon(said):
    """Another car attacked, or alarming, is another picture; the bars name it."""
    env = made(PLATOON)
    shots = [picture(env, None, with_command(env.state, Kind.FDI, 5.0, np.s_[:, [i]])) for i in (1, 3)]
    assert (shots[0][60:180] != shots[1][60:180]).any() and any("of car 3" in line for line in said)
    alarms = []
    for i in (1, 3):
        alarm = np.zeros((1, 5), bool)
        alarm[0, i] = True
        alarms.append(picture(env, None, with_estimate(env.state, alarm=alarm)))
    assert (alarms[0][60:180] != alarms[1][60:180]).any() and "car 3" in said
    assert {"leader", "car 1", "car 4"} <= set(said)


def test_a_challenge_is_marked(said):
    """The radar's waves while it transmits, a crossed circle while it is silent, and words for both."""
    env = made(RADAR, steps=4)
    sent = picture(env, None, env.state._replace(probed=np.ones((1, 1), bool)))
    assert "radar transmits" in said
    silent = picture(env, None, env.state._replace(probed=np.zeros((1, 1), bool)))
    assert "CHALLENGE: radar silent" in said and any(line.startswith("heard") for line in said)
    blue = [near(shot, render_canvas.EGO) for shot in (sent, silent)]
    assert (sent[50:190] != silent[50:190]).any() and blue[1][190:].any() and not blue[0][190:].any() and blue[1][50:190].any()


def test_collisions_are_marked(monkeypatch):
    """A sign with the word, and HighwayEnv's red for the cars that touched; of a platoon the sign names the car."""
    signs, sign = [], render_canvas.Canvas.sign
    monkeypatch.setattr(render_canvas.Canvas, "sign", lambda self, left, top, words, size: (signs.append(words), sign(self, left, top, words, size))[1])
    env = made()
    x = env.state.plant.ego[:, 0, 0]
    for plant in (env.state.plant._replace(lead_x=x - 0.5), env.state.plant._replace(behind=env.state.plant.behind._replace(x=x + 0.5))):
        shot = picture(env, (1280, 360), env.state._replace(plant=plant))
        assert near(shot, VehicleGraphics.RED, 30).sum() > 200
    env = made(PLATOON)
    x = env.state.plant.x.copy(order="K")
    x[:, 3] = x[:, 2] + 0.5
    picture(env, None, env.state._replace(plant=env.state.plant._replace(x=x)))
    assert signs == ["COLLISION", "REAR COLLISION", "COLLISION: car 3"]


@pytest.mark.long
def test_a_collision_among_traffic_is_marked(said):
    """HighwayEnv's own crash ends the episode with a sign."""
    env = made(HIGHWAY, steps=0, scenario="highway-braking-v0", defence="none", value=50.0, threat={"onset": 1, "end": None}, autoreset="disabled")
    attack = next(i for i, mode in enumerate(env.seat.action.modes) if mode.name == "fdi+")
    for _ in range(300):
        if env.step(np.array([attack]))[2].any():
            break
    shot = picture(env, (1280, 360))
    assert "COLLISION" in said and near(shot, VehicleGraphics.RED, 30).sum() > 100
    cars = {car.name: car for car in stage_of(env.seat.loop, env.state, env.frame, 0).cars}
    assert cars["ahead"].crashed and cars["ego"].crashed and cars["ahead"].x > cars["ego"].x and not cars["ahead"].doing


def test_nobody_ahead_is_said(said):
    """A gap of `reach` is not a car."""
    env = made(HIGHWAY)
    reach = env.seat.loop.plant.reach
    plant = env.state.plant
    picture(env, None, env.state._replace(plant=plant._replace(seen=plant.seen._replace(gap=np.full(1, reach)))))
    assert f"nobody within {reach:.1f} m" in said


def test_after_a_reset_nothing_is_believed_yet(said):
    """Neither a ghost nor a figure before the first measurement; the end of the episode before is told."""
    env = made(steps=0)
    env.render()
    assert any("nothing measured yet" in line for line in said) and not any(line.startswith("believed gap") for line in said)
    env.step(np.zeros(1, np.int64))
    over = env.frame._replace(k=env.frame.k + 5, collided=np.ones(1, bool))
    picture(env, None, None, over)
    assert "new episode; the last one ended in a COLLISION" in said


@pytest.mark.long
def test_long_platoons_show_the_watched_car():
    """Of twenty cars those around the one that may be attacked, no smaller than can be seen."""
    place = load_scenario("platoon-braking-v0")
    place = dataclasses.replace(place, plant=dataclasses.replace(place.plant, followers=20)).with_threat(agents=[12])
    loop = place.loop(tailgate.make_defence("dkf"))
    state = loop.start(draws.keys("train", [1]))
    for size in SIZES:
        stage, sheet = stage_of(loop, state, None, 0), render_highway.Sheet(*size)
        sheet.window = render_highway.window_of(stage, sheet)
        car = stage.cars[stage.followers[stage.watched].car]
        assert car.name == "car 12" and 0 < sheet.column(car.x) < size[0] and LENGTH * sheet.window.scale >= 7.9
    assert render.draw(loop, state, None, 0, Viewer(size=size)).shape == (size[1], size[0], 3)


# -- which picture


def test_without_highwayenv_the_plain_picture_is_drawn(monkeypatch):
    """auto falls back to the picture that there was; who asks for the road is told what is missing."""
    env = made()
    plain = render.plain(env.seat.loop, env.state, env.frame, 0)
    assert env.render()[0].shape == (240, 960, 3) and (made(viewer="plain").render()[0] == plain).all()
    monkeypatch.setattr(render_viewer, "find_spec", lambda name: None)
    assert (env.render()[0] == plain).all()
    for arguments in ({"viewer": "highway"}, {"size": (480, 160)}):
        with pytest.raises(ImportError, match=r"pip install 'tailgate\[highway,viz\]'"):
            made(**arguments).render()


def test_a_network_is_drawn_plain():
    """Nothing drives there: auto draws the graph, and the road is refused with a word."""
    network = made("tailgate/SensorNetwork-v0")
    assert network.render()[0].shape == (render.HEIGHT, render.WIDTH, 3)
    with pytest.raises(NotApplicable, match="cars that follow each other"):
        made("tailgate/SensorNetwork-v0", viewer="highway").render()


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"viewer": "highwai"}, "did you mean 'highway'"), ({"viewer": "plain", "size": (480, 160)}, "viewer 'plain'"),
        ({"size": (481, 160)}, "even"), ({"size": (480,)}, "width, height"), ({"size": (100, 20)}, "400 x 144"), ({"size": "large"}, "width, height"),
    ],
)  # fmt: skip
def test_wrong_viewers_and_sizes_are_named(arguments, words):
    """At once, with or without a render mode."""
    with pytest.raises(InputError, match=words):
        AdversaryVectorEnv(1, **arguments)


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", ROADS)
def test_the_window_shows_the_road(name, monkeypatch):
    """Human mode under a dummy video driver shows what rgb_array returns, at the size that was asked for."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame")
    arguments = {"viewer": "highway", "size": (640, 200)} | ({"defence": "dkf"} if name == PLATOON else {})
    env = gymnasium.make(name, render_mode="human", **arguments)
    env.unwrapped.metadata["render_fps"] = 10_000
    twin = gymnasium.make(name, render_mode="rgb_array", **arguments)
    env.reset(seed=3), twin.reset(seed=3)
    for action in (0, 1):
        env.step(action), twin.step(action)
        assert pygame.display.get_surface().get_size() == (640, 200)
        assert (np.moveaxis(pygame.surfarray.array3d(pygame.display.get_surface()), 0, 1) == twin.render()).all()
    env.close()
    assert not pygame.display.get_init()


# -- films


def test_a_film_on_the_road(tmp_path, said):
    """Frames of the size that was asked for, in a file that is read back; who plays is said below the road."""
    image = pytest.importorskip("PIL.Image")
    path = tmp_path / "short.yaml"
    path.write_text(yaml.safe_dump({
        "plant": "car_following", "sensor": "odometry", "controller": "acc", "manoeuvre": "stop_and_go", "horizon": 12,
        "threat_model": {"kinds": ["fdi"], "onset": 3},
    }))  # fmt: skip
    (row,) = run_cell(Cell("s", str(path), None, "kf", "fdi:start_step=4,value=20", 1))
    replay = play(row)
    assert next(frames(replay, 1, Viewer("plain"))).shape == (render.HEIGHT, render.WIDTH, 3)
    write_video(replay, tmp_path / "film.gif", Viewer("highway", (480, 160)))
    with image.open(tmp_path / "film.gif") as film:
        assert film.size == (480, 160) and film.n_frames == 13
    assert "short: kf against fdi start_step=4 value=20" in said and not any(str(tmp_path) in line for line in said)


@pytest.mark.parametrize(("options", "why"), [
    (["--viewer", "plain"], "--video: got None"), (["--video", "f.webp", "--size", "wide"], "--size: got 'wide'"),
    (["--video", "f.webp", "--size", "10x10"], "size: got"),
])  # fmt: skip
def test_a_film_that_cannot_be_is_refused_before_it_is_played(options, why, tmp_path, capsys):
    """Viewer and size belong to a film, and a size is two numbers within limits."""
    from tailgate.cli import main

    assert main(["replay", "rows.jsonl", "--out", str(tmp_path / "page.html"), *options]) == 2
    assert why in capsys.readouterr().err
