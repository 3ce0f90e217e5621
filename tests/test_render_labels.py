"""Nothing written in a picture on the road covers another word, a mark or a car: measured on the letters that are drawn."""

import functools

import gymnasium
import numpy as np
import pytest

pytest.importorskip("PIL")
pytest.importorskip("highway_env")

from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.render import canvas as render_canvas
from tailgate.envs.render import highway as render_highway
from tailgate.envs.render.labels import Box, Places, along, around
from tailgate.envs.render.stage import stage_of

SIZES = [(400, 144), (480, 160), (640, 200), (960, 240), (1280, 400), (1920, 540)]
EARLY = {"onset": 5, "end": None}
SCENES = {  # an environment's arguments and the action of the attack
    "following": ("CarFollowing", "fdi-", {"defence": "chi2_kf", "value": 15.0}),
    "believed": ("CarFollowing", "fdi-", {"defence": "kf", "value": 15.0}),
    "radar": ("RadarFollowing", "echo_delay", {"defence": "cra", "delay": 30.0}),
    "platoon": ("Platoon", "fdi+:distance", {"defence": "chi2_dkf", "value": 30.0, "per_sensor": True}),
    "all": ("Platoon", "fdi+", {"defence": "chi2_dkf", "value": 12.0}),
    "highway": ("Highway", "fdi+", {"scenario": "highway-cut-in-v0", "defence": "chi2_kf", "value": 20.0}),
    "braking": ("Highway", "fdi+", {"scenario": "highway-braking-v0", "defence": "none", "value": 40.0}),
}  # fmt: skip
SHOTS = 5  # pictures of an episode, and of its attacked steps, the first and the last among them


class Witness:
    """A pen that notes the boxes of the letters and discs that it draws, in pixels of the picture."""

    def __init__(self, pen):
        self.pen, self.words, self.discs = pen, [], []

    def text(self, at, words, ink, font, anchor, **options):
        if words.strip():
            box = self.pen.textbbox(at, words, font, anchor)
            self.words.append((words, Box(*(edge / render_canvas.ZOOM for edge in box))))
        self.pen.text(at, words, ink, font, anchor, **options)

    def circle(self, at, radius, *options):
        x, y, r = (value / render_canvas.ZOOM for value in (*at, radius))
        self.discs.append(Box(x - r, y - r, x + r, y + r))
        self.pen.circle(at, radius, *options)

    def __getattr__(self, name):
        return getattr(self.pen, name)


@pytest.fixture
def witness(monkeypatch):
    """The pens of the next pictures, the last one last."""
    pens, begin = [], render_canvas.Canvas.__init__

    def observed(self, *size):
        begin(self, *size)
        self.pen = Witness(self.pen)
        pens.append(self.pen)

    monkeypatch.setattr(render_canvas.Canvas, "__init__", observed)
    return pens


@functools.cache
def episode(name):
    """(loop, state, frame) at some steps of an episode that is attacked from early on, right after its reset and at its end among them."""
    face, action, arguments = SCENES[name]
    defaults = gymnasium.spec(f"tailgate/{face}-v0").kwargs
    env = AdversaryVectorEnv(1, render_mode="rgb_array", engine="plain", autoreset="disabled", threat=EARLY, **(defaults | arguments))
    env.reset(seed=4)
    attack = next(i for i, held in enumerate(env.seat.card()["actions"]) if held == action)
    shots = [(env.seat.loop, env.state, None)]
    for k in range(env.seat.loop.horizon):
        over = env.step(np.array([attack if k >= 4 else 0]))[2].any()
        shots.append((env.seat.loop, env.state, env.frame))
        if over:
            break
    attacked = [i for i, (_, state, _) in enumerate(shots) if state.channel.last.kind[0]]
    chosen = {round(i) for i in np.linspace(0, len(shots) - 1, SHOTS)} | {attacked[round(i)] for i in np.linspace(0, len(attacked) - 1, SHOTS)}
    return [shots[i] for i in sorted(chosen)]


def seats(stage, sheet):
    """The boxes of the cars that are seen."""
    return [(car, sheet.seat(car)) for car in stage.cars if -20 < sheet.column(car.x) < sheet.width + 20]


@pytest.mark.thin(60)
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("name", SCENES)
def test_no_word_covers_another_or_a_car(name, size, witness):
    """Of all letters in the picture, bars and all, and of the marks; what counts most is never left out."""
    for loop, state, frame in episode(name):
        render_highway.draw(loop, state, frame, 0, size, "who plays: a line of some length that says so")
        words = witness[-1].words
        for i, (one, box) in enumerate(words):
            assert box.x0 >= 0.0 and box.y0 >= 0.0 and box.x1 <= size[0] and box.y1 <= size[1], one
            assert [other for other, there in words[:i] if box.meets(there)] == [], one
            assert one == "!" or not any(box.meets(disc) for disc in witness[-1].discs), one
        stage, sheet = stage_of(loop, state, frame, 0), render_highway.Sheet(*size)
        sheet.window = render_highway.window_of(stage, sheet)
        road = [(one, box) for one, box in words if sheet.above < box.y0 and box.y1 < sheet.below]
        for car, seat in seats(stage, sheet):
            assert [one for one, box in road if box.meets(seat)] == [], car
        said = [one for one, _ in road]
        seen = [follower for follower in stage.followers if 0.0 <= sheet.column(stage.cars[follower.car].x) <= size[0]]
        discs = [disc for disc in witness[-2].discs if sheet.above < disc.y0 and disc.y1 < sheet.below]  # this sheet has the last pen
        silent = sum(follower.muted is True and not follower.hit for follower in seen)
        assert said.count("!") == sum(follower.alarm for follower in seen)
        assert len(discs) == silent + sum(follower.attacked + follower.alarm for follower in seen)
        watched = stage.followers[stage.watched]
        if not watched.hit and not watched.free:
            assert any(f"{watched.gap:,.1f} m" in one or one == f"{watched.gap:.0f}" for one in said), said
        if watched.hit:
            assert any("COLLISION" in one for one in said)
        assert any("m/s" in one or one.startswith(("ego", "car")) for one in said) or watched.hit


def test_the_witness_sees_what_overlaps(witness):
    """A picture in which two words lie on each other, and one on a car, would be noticed."""
    canvas = render_canvas.Canvas()
    canvas.text(100, 100, "one word")
    canvas.text(120, 104, "another")
    (_, one), (_, other) = witness[-1].words
    assert one.meets(other) and not one.meets(other.grown(-20.0))


def test_the_first_free_place_is_taken_and_no_other():
    """What is asked first has the choice; what finds nothing is left out; a place that is taken stays so."""
    places = Places(Box(0.0, 0.0, 100.0, 60.0))
    car = Box(40.0, 25.0, 60.0, 35.0)
    places.take(car)
    found = [places.find(30.0, 10.0, around(car, 30.0, 10.0, 8.0)) for _ in range(40)]
    kept = [box for box in found if box]
    assert kept[0] == Box(35.0, 35.0, 65.0, 45.0) and kept[1] == Box(35.0, 15.0, 65.0, 25.0) and found[-1] is None
    every = [car, *kept]
    assert not any(one.meets(other) for i, one in enumerate(every) for other in every[:i])
    assert all(box.x0 >= 0.0 and box.x1 <= 100.0 and box.y0 >= 0.0 and box.y1 <= 60.0 for box in kept)


def test_words_of_a_line_stand_on_it_where_they_fit():
    """On their own line, though it is taken; of another line clear; beside one that is too short."""
    places, line, other = Places(Box(0.0, 0.0, 200.0, 60.0)), Box(50.0, 26.0, 120.0, 34.0), Box(130.0, 26.0, 140.0, 34.0)
    places.take(line, other)
    assert places.find(40.0, 12.0, along(50.0, 120.0, 30.0, 40.0, 12.0), line) == Box(65.0, 24.0, 105.0, 36.0)
    beside = places.find(40.0, 12.0, along(130.0, 140.0, 30.0, 40.0, 12.0), other)
    assert beside is not None and not beside.meets(other) and not beside.meets(line)
