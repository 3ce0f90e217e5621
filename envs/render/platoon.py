"""The picture of a platoon (extra: viz).

The upper strip is the road as it is, the leader on the right. The lower one is the same stretch, with each follower as far behind the true
car ahead as it believes to be. Gaps between bumpers are to scale, cars are not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.render.canvas import (
    ATTACK,
    BELIEF,
    BELIEF_PALE,
    CAR_SHAPE,
    EGO,
    FAR,
    GREY,
    HEADER,
    HEIGHT,
    INK,
    LEADER,
    MARGIN,
    NORMAL,
    SMALL,
    TINY,
    WHITE,
    WIDTH,
    Canvas,
    ended_line,
    header,
    metres,
)

SPANS = (20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0, 2560.0, 5120.0, 10240.0)  # metres of all gaps: few, so that the scale rests
LONGEST, SHORTEST, SHARE = 56.0, 3.0, 0.4  # length of a car [px], and the most of the width that all of them take
TRUE_LINE, WHEELS, STRIP, BELIEVED_LINE, GHOST_WHEELS = 98.0, 146.0, 202.0, 228.0, 288.0  # rows [px]
ROAD = 12.0
DASHES = 24  # dashes of the lane's line


class Place:
    """The places of the cars in the picture: noses and tails (N,) [px], a car's length [px] and the scale [px a metre]."""

    def __init__(self, gaps: Array) -> None:
        count = len(gaps)
        self.length = max(SHORTEST, min(LONGEST, SHARE * (WIDTH - 2 * MARGIN) / count))
        room = WIDTH - 2 * MARGIN - count * self.length
        total = float(np.add.accumulate(np.clip(gaps[1:], 0.0, None))[-1])
        self.scale = room / next((span for span in SPANS if total <= span), max(total, 1.0))
        self.nose = np.full(count, WIDTH - MARGIN)
        for i in range(1, count):
            self.nose[i] = self.nose[i - 1] - self.length - gaps[i] * self.scale

    @property
    def tail(self) -> Array:
        return self.nose - self.length


def believed_gaps(loop: Loop, state: LoopState, row: int) -> Array:
    """Return the gap (N,) that each car believes in [m]; infinite at the leader."""
    model, x = loop.model, state.estimate.x[row]
    assert model.gap is not None
    own = [float(x[i][np.flatnonzero(model.gap[i])[0]]) if model.followers[i] else np.inf for i in range(model.agents)]
    return np.array(own)


def _gap(
    canvas: Canvas, x0: float, x1: float, y: float, words: str, ink: str, dash: float = 0.0, must: bool = False, up: bool = True
) -> None:
    """Draw a dimension line, and its words above it, or below, where they fit or must go."""
    middle, wide = canvas.gap(x0, x1, y, ink, dash), abs(x1 - x0) - 4.0
    size = next((size for size in (NORMAL, SMALL, TINY) if canvas.length(words, size) <= wide), SMALL if must else 0)
    if size:
        canvas.text(middle, y - 7 if up else y + size, words, ink, size, "ms", True, room=(MARGIN, WIDTH - MARGIN))


def _marks(canvas: Canvas, place: Place, attacked: Array, alarm: Array) -> None:
    """Draw over the cars: a lightning on an attacked one, a lamp on one that alarms."""
    size = max(4.0, min(8.0, place.length / 5))
    top = WHEELS - CAR_SHAPE * place.length - 3.0
    for i in range(len(place.nose)):
        middle, both = place.nose[i] - place.length / 2, attacked[i] and alarm[i]
        if attacked[i]:
            canvas.bolt(middle - (size if both else 0.0), top, size)
        if alarm[i]:
            canvas.alarm(middle + (size if both else 0.0), top - size, size)


def _truth(
    canvas: Canvas, place: Place, gaps: Array, speeds: Array, attacked: Array, travelled: float, names: Sequence[str]
) -> None:  # fmt: skip
    canvas.text(MARGIN, HEADER + 16, "THE ROAD AS IT IS", GREY, SMALL)
    canvas.box(0, WHEELS, WIDTH, WHEELS + ROAD, LEADER)
    lane = WIDTH / DASHES
    for x in np.arange(-(travelled * place.scale) % lane - lane, WIDTH, lane):  # the dashes stand on the road: the cars pass them
        canvas.box(x, WHEELS + ROAD / 2 - 1, x + lane / 2, WHEELS + ROAD / 2 + 1, WHITE)
    nearest = int(np.argmin(gaps))
    for i in reversed(range(len(gaps))):
        ink, middle = LEADER if i == 0 else ATTACK if attacked[i] else EGO, place.nose[i] - place.length / 2
        canvas.car(place.nose[i], WHEELS, ink, length=place.length)
        name, speed = names[i], f"{speeds[i]:.1f} m/s"
        pitch = place.length + min(gaps[i : i + 2]) * place.scale  # to the next car
        name = name if canvas.length(name, TINY) < pitch else name.removeprefix("car ") if i else str(i)
        for words, below, size in ((name, 27.0, SMALL), (speed, 42.0, TINY + 2)):
            if canvas.length(words, TINY) < pitch:
                size = size if canvas.length(words, size) < pitch else TINY
                canvas.text(middle, WHEELS + below, words, ink, size, "ms", size == SMALL, room=(2.0, WIDTH - 2.0))
        if i and gaps[i] > 0.0:
            crowded = i == nearest and place.length < LONGEST / 2
            _gap(canvas, place.tail[i - 1], place.nose[i], TRUE_LINE, metres(gaps[i]), INK, must=crowded)


def _belief(canvas: Canvas, place: Place, gaps: Array, believed: Array, attacked: Array, names: Sequence[str]) -> None:
    canvas.box(0, STRIP, WIDTH, HEIGHT, BELIEF_PALE)
    canvas.line(0, STRIP, WIDTH, STRIP, BELIEF, 1)
    canvas.line(0, GHOST_WHEELS, WIDTH, GHOST_WHEELS, BELIEF, 1, dash=3.0)
    canvas.text(WIDTH - MARGIN, HEIGHT - 9, "WHERE EACH CAR BELIEVES IT IS, BEHIND THE TRUE CAR AHEAD", BELIEF, SMALL, "rs")
    worst = 1 + int(np.argmax(np.abs(believed[1:] - gaps[1:])))
    lines, level, reached = 0, 0, FAR
    for i in range(1, len(gaps)):
        tail, ghost = place.tail[i - 1], max(-FAR, min(place.tail[i - 1] - believed[i] * place.scale, FAR))
        canvas.line(tail, TRUE_LINE, tail, GHOST_WHEELS, LEADER, 1, dash=3.0)  # the same bumper in both strips
        must = bool(attacked[i]) or (i == worst and place.length < LONGEST / 2)
        level = 1 - level if max(tail, ghost) > reached + 1.0 else 0  # lines that would lie on each other
        reached = min(tail, ghost)
        _gap(canvas, tail, ghost, BELIEVED_LINE + 20.0 * level, metres(believed[i]), BELIEF, 5.0, must, not level)
        if ghost > 0.0 and ghost - place.length < WIDTH:
            canvas.car(ghost, GHOST_WHEELS, BELIEF, ghost=True, length=place.length)
        elif lines < 1:
            way, lines = 1 if ghost > 0.0 else -1, lines + 1
            x = WIDTH - MARGIN if way > 0 else MARGIN
            canvas.head(x, GHOST_WHEELS - 10, way, BELIEF, 18.0)
            words = f"{names[i]} is out of view: {metres(abs(believed[i] - gaps[i]))} off"
            canvas.text(x - way * 24, GHOST_WHEELS - 5, words, BELIEF, SMALL, "rs" if way > 0 else "ls", ground=BELIEF_PALE)
    unit = next(size for size in (500.0, 200.0, 100.0, 50.0, 20.0, 10.0, 5.0, 2.0, 1.0) if size * place.scale < 120.0 or size == 1.0)
    canvas.gap(MARGIN, MARGIN + unit * place.scale, HEIGHT - 14, GREY)
    canvas.text(MARGIN + unit * place.scale + 8, HEIGHT - 9, f"{unit:g} m", GREY, SMALL)


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """Return (H, W, 3) uint8: row `row` after `frame`, or right after a reset."""
    scene = loop.plant.scene(loop.plan.plant, state.plant)
    gaps, speeds, believed = scene.gap[row], scene.speed[row], believed_gaps(loop, state, row)
    refused = frame is not None and bool(frame.k[row] + 1 == state.k[row]) and bool(frame.refused[row])
    attacked, alarm = np.any(state.channel.last.target[row], axis=1), state.estimate.alarm[row]
    first = 1
    if loop.model.followers[0]:  # the leader is no agent: it is drawn before them
        first = 0
        gaps, believed = (np.concatenate([[np.inf], values]) for values in (gaps, believed))
        speeds = np.concatenate([scene.lead_speed[row, :1], speeds])
        attacked, alarm = (np.concatenate([[False], values]) for values in (attacked, alarm))
    canvas, place = Canvas(), Place(gaps)
    header(canvas, loop, state, row, refused)
    names = ["leader", *(f"car {i}" for i in range(first, len(gaps)))]
    _belief(canvas, place, gaps, believed, attacked, names)
    _truth(canvas, place, gaps, speeds, attacked, float(scene.position[row, 0]), names)
    _marks(canvas, place, attacked, alarm)
    hit = np.flatnonzero(gaps <= 0.0)
    for i in hit:
        canvas.burst(place.nose[i], WHEELS - CAR_SHAPE * place.length / 2, max(10.0, place.length * 0.3))
    if len(hit):
        words = f"COLLISION: {', '.join(names[i] for i in hit[:3])}"
        canvas.sign(min(max(place.nose[hit[0]] - 90.0, MARGIN), WIDTH - 260.0), HEADER + 20, words)
    ended_line(canvas, loop, state, frame, row)
    return canvas.done()
