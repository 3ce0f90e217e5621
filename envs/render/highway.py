"""A picture on HighwayEnv's road: over it what the defence believes, the attack, the alarm and the challenge (extras: highway, viz).

White and solid is what is true, purple and dashed what is believed. Every mark has a shape or a word: colour is never the only sign.
No word covers another, a mark or a car: a word without a place is left out, the least important first.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.render.bars import lower, upper
from tailgate.envs.render.canvas import ATTACK, BELIEF, BELIEF_PALE, EGO, INK, TINY, WARNING, WHITE, ZOOM, ended, metres
from tailgate.envs.render.labels import Box, Places, along, around, near
from tailgate.envs.render.road import paint
from tailgate.envs.render.sheet import FAR, LEVEL, Sheet, window_of
from tailgate.envs.render.stage import LANE, LENGTH, Car, Follower, Stage, stage_of
from tailgate.envs.render.viewer import SIZE

SHADE = "#464646"  # under words among the cars
SMALL_CAR = 24.0  # [px]: an outline would hide a car that is shorter
RIM = 4.0  # width of an attacked car's outline [px]


class Ruler(NamedTuple):
    """A dimension line from x0 to x1 [px] at the row y, as it is drawn, and its words, the best first."""

    x0: float
    x1: float
    y: float
    words: tuple[str, ...]
    believed: bool

    @property
    def box(self) -> Box:
        return Box(self.x0, self.y - 4.0, self.x1, self.y + 4.0)


def _edges(sheet: Sheet, stage: Stage, x0: float, x1: float) -> tuple[float, float]:
    """Return rows [px] of the dimension lines: above and below the road from x0 to x1 [px]."""
    ends = [max(0.0, min(x, sheet.width)) for x in (x0, x1)]
    places = [sheet.window.x + (ends[0] + (ends[1] - ends[0]) * i / 4 - sheet.width / 2) / sheet.window.scale for i in range(5)]
    rise, fall = (2.7, 3.65) if stage.lanes == 1 else (1.1, 1.2)  # room for the marks and names of one lane
    top = min(sheet.row(stage.middle(x, -0.5)) for x in places) - rise * sheet.small
    low = max(sheet.row(stage.middle(x, stage.lanes - 0.5)) for x in places) + fall * sheet.small
    return max(top, sheet.above + 1.0 * sheet.small), min(low, sheet.below - 1.0 * sheet.small)


def _measure(sheet: Sheet, x0: float, x1: float, y: float, words: tuple[str, ...], believed: bool) -> Ruler:
    """Draw a dimension line from bumper to bumper [px], an arrow where it leaves the picture."""
    ink, halo, dash = (BELIEF_PALE, BELIEF, 4.0) if believed else (WHITE, INK, 0.0)
    ends = [max(4.0, min(x, sheet.width - 4.0)) for x in sorted((x0, x1))]
    sheet.ruled(ends[0], y, ends[1], y, ink, halo, dash)
    for seen, end, way in ((ends[0], min(x0, x1), -1), (ends[1], max(x0, x1), 1)):
        if seen != end:
            sheet.head(seen, y, way, halo, 9.0)
        else:
            sheet.ruled(seen, y - 5, seen, y + 5, ink, halo)
    return Ruler(ends[0], ends[1], y, words, believed)


def _levels(stage: Stage) -> list[int]:
    """Return 0 or 1 for each follower: the other row where its believed gap reaches over that of the car ahead."""
    out: list[int] = []
    for i, follower in enumerate(stage.followers):
        over = i and follower.believed is not None and follower.believed > follower.gap + LENGTH
        out.append(1 - out[-1] if over else 0)
    return out


def _gaps(sheet: Sheet, places: Places, stage: Stage, follower: Follower, level: int) -> list[Ruler]:
    """Draw the true gap above the road, the believed gap below it, and the car ahead at its believed place."""
    car, alone = stage.cars[follower.car], len(stage.followers) == 1
    nose, tail = sheet.column(car.nose), sheet.column(car.nose + follower.gap)
    if (nose < 0.0 and tail < 0.0) or nose > sheet.width:
        return []
    top, low = _edges(sheet, stage, nose, tail)
    low += LEVEL * sheet.small * level
    y, lane = sheet.row(car.y), round((car.y - stage.middle(car.x, 0.0)) / LANE)
    far = sheet.row(stage.middle(car.nose + follower.gap, lane))
    for x, end in ((nose, y), (tail, far)):
        sheet.line(x, top, x, end, WHITE, 1, 3.0)
    reach = metres(follower.gap)
    said = (f"nobody within {reach}",) if follower.free else (f"true gap {reach}", reach) if alone else (reach, f"{follower.gap:.0f}")
    rulers = [_measure(sheet, nose, tail, top, said, False)]
    if follower.believed is None:
        return rulers
    x = car.nose + max(-FAR, min(follower.believed, FAR))
    ghost, figure = sheet.column(x), metres(follower.believed)
    sheet.line(ghost, sheet.row(stage.middle(x, lane)), ghost, low, BELIEF_PALE, 1, 3.0)
    sheet.line(nose, y, nose, low, BELIEF_PALE, 1, 3.0)
    words = (f"believed gap {figure}", figure) if alone else (figure, f"{follower.believed:.0f}")
    if ghost > sheet.width or ghost + LENGTH * sheet.window.scale < 0.0:
        beyond = f"{words[0]}, out of view"
        fits = alone or sheet.length(beyond, sheet.small) < abs(max(0.0, min(ghost, sheet.width)) - nose) - 16.0  # else the arrow says it
        return [*rulers, _measure(sheet, nose, ghost, low, (beyond, "out of view") if fits else words, True)]
    grow = 3.0 if LENGTH * sheet.window.scale < SMALL_CAR else 0.0
    places.take(sheet.outline((x + LENGTH / 2, stage.middle(x + LENGTH / 2, lane)), BELIEF_PALE, BELIEF, 4.0, grow))
    return [*rulers, _measure(sheet, nose, ghost, low, words, True)]


def _waves(sheet: Sheet, car: Car, muted: bool) -> Box:
    """Draw arcs before the nose where the radar transmits, a crossed-out circle where it is silent to listen; return their place."""
    x, y, size = sheet.column(car.nose), sheet.row(car.y), 7.0 * sheet.unit
    if muted:
        sheet.disc(x + size + 4, y, size + 1, WHITE, EGO)
        sheet.line(x + 4, y + size * 0.7, x + 2 * size + 4, y - size * 0.7, EGO, 3)
        return Box(x, y - size - 2, x + 2 * size + 6, y + size + 2)
    for radius in (1.0, 1.7, 2.4):
        turns = [math.radians(angle) for angle in range(-40, 41, 20)]
        points = [(x + radius * size * math.cos(a), y + radius * size * math.sin(a)) for a in turns]
        for start, end in pairwise(points):
            sheet.ruled(*start, *end, WHITE, EGO, width=1)
    return Box(x, y - 1.6 * size, x + 2.5 * size, y + 1.6 * size)


def _symbols(sheet: Sheet, places: Places, stage: Stage, follower: Follower) -> None:
    """Draw on the road at a car: an outline where it is attacked, the radar's waves, a star for a collision."""
    car, size = stage.cars[follower.car], 14.0 * sheet.unit
    if follower.attacked:
        places.take(sheet.outline((car.x, car.y), ATTACK, WHITE, grow=RIM))
    if follower.muted is not None and not follower.hit:
        places.take(_waves(sheet, car, follower.muted))
    if follower.hit:
        x, y = sheet.column(car.nose if follower.hit == "COLLISION" else car.tail), sheet.row(car.y)
        sheet.burst(x, y, size)
        places.take(Box(x - size, y - size, x + size, y + size))


def _marks(sheet: Sheet, places: Places, stage: Stage, follower: Follower) -> None:
    """Draw next to the car: a lightning for an attack, a lamp for an alarm."""
    car, size = stage.cars[follower.car], 7.0 * sheet.unit
    marks = [on for on, shown in (("bolt", follower.attacked), ("lamp", follower.alarm)) if shown]
    if not marks or not -size < sheet.column(car.x) < sheet.width + size:
        return
    radius = 1.3 * size
    wide, high = 2.0 * radius + 2.0, 2.0 * radius + 2.0
    seat = sheet.seat(car).grown(RIM + 2.0)
    box = places.find(wide * len(marks), high, around(seat, wide * len(marks), high, 0.3 * sheet.height, up=True))
    for i, mark in enumerate(marks if box else ()):
        assert box is not None
        x, y = box.x0 + wide * (i + 0.5), (box.y0 + box.y1) / 2
        if mark == "bolt":
            sheet.disc(x, y, radius, WHITE, ATTACK)
            sheet.bolt(x, y + size, size)
        else:
            sheet.disc(x, y, radius, WARNING, INK)
            sheet.text(x, y, "!", INK, round(size * 2.2), "mm", True)


def _figure(sheet: Sheet, places: Places, ruler: Ruler) -> None:
    """Draw the words of a dimension line: on it where they fit, else next to it."""
    ink, ground = (BELIEF, BELIEF_PALE) if ruler.believed else (INK, WHITE)
    for words in ruler.words:
        width, height = sheet.extent((words,), sheet.small)
        if box := places.find(width, height, along(ruler.x0 + 3, ruler.x1 - 3, ruler.y, width, height), ruler.box):
            sheet.label(box, (words,), ink, sheet.small, ground)
            return


def _said(stage: Stage, car: Car) -> list[tuple[str, ...]]:
    """Return the possible texts of a car's label, the best first: in one lane the speed below the name, among traffic after it."""
    speed = f"{car.speed:.1f} m/s"
    if stage.lanes == 1:
        return [(car.name, speed), (car.name,), (car.name.removeprefix("car "),)]
    if not car.name:
        return [(car.doing,)]
    full = f"{car.name} {speed}"
    return [(f"{full}, {car.doing}",), (full,), (car.name,)] if car.doing else [(full,), (car.name,)]


def _tie(seat: Box, top: float, bottom: float) -> Box | None:
    """Return the line from a car to words above or below it; None where they are next to it."""
    x = (seat.x0 + seat.x1) / 2
    if top > seat.y1 + 1.0:
        return Box(x - 1.0, seat.y1 - 5.0, x + 1.0, top)
    return Box(x - 1.0, bottom, x + 1.0, seat.y0 + 5.0) if bottom < seat.y0 - 1.0 else None


def _crosses(tie: Box | None, cars: list[Box]) -> bool:
    return tie is not None and any(tie.meets(car) for car in cars)


def _name(sheet: Sheet, places: Places, stage: Stage, car: Car) -> None:
    """Draw name and speed below a car, or around it where there is room; add a line if that is not next to the car."""
    if not (car.name or car.doing) or not 0.0 <= sheet.column(car.x) <= sheet.width:
        return
    seat, one, others = sheet.seat(car).grown(RIM + 2.0), stage.lanes == 1, [sheet.seat(other) for other in stage.cars if other is not car]
    if one:  # clear of the lane
        seat = seat._replace(y0=min(seat.y0, sheet.row(car.y - LANE / 2) - 2.0), y1=max(seat.y1, sheet.row(car.y + LANE / 2) + 2.0))
    for lines in _said(stage, car):
        for size in dict.fromkeys((sheet.small, TINY) if one else (sheet.small,)):
            width, height = sheet.extent(lines, size)
            spots = around(seat, width, height, 0.0 if one else 0.25 * sheet.height)
            box = places.find(width, height, (spot for spot in spots if not _crosses(_tie(seat, spot[1], spot[1] + height), others)))
            if box is None:
                continue
            if tie := _tie(seat, box.y0, box.y1):
                sheet.line(tie.x0 + 1.0, tie.y0, tie.x0 + 1.0, tie.y1, WHITE, 1)
            sheet.label(box, lines, WHITE, size, SHADE)
            return


def _sign(sheet: Sheet, places: Places, stage: Stage) -> None:
    """Draw the word COLLISION where there is one, next to the star."""
    hit = [follower for follower in stage.followers if follower.hit]
    if not hit:
        return
    who = "" if len(stage.followers) == 1 else ": " + ", ".join(stage.cars[follower.car].name for follower in hit[:3])
    words, size = hit[0].hit + who, max(sheet.big, round(20 * sheet.unit))
    seat = sheet.seat(stage.cars[hit[0].car]).grown(14.0 * sheet.unit)
    width, height = sheet.sign_size(words, size)
    if box := places.find(width, height, near(seat, width, height, 0.5 * sheet.width)):
        sheet.sign(box.x0, box.y0, words, size)


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int, size: tuple[int, int] | None = None, caption: str = "") -> Array:
    """Return (H, W, 3) uint8: row `row` after `frame`, which is None right after a reset. caption: a line about who plays."""
    stage, sheet = stage_of(loop, state, frame, row), Sheet(*(size or SIZE))
    sheet.window = window_of(stage, sheet)
    height = round(sheet.below - sheet.above)
    zoomed = sheet.window._replace(scale=sheet.window.scale * ZOOM)
    sheet.paste(paint(stage, zoomed, sheet.width * ZOOM, height * ZOOM), round(sheet.above))
    places = Places(Box(2.0, sheet.above + 1.0, sheet.width - 2.0, sheet.below - 1.0))
    places.take(*(sheet.seat(car).grown(1.0) for car in stage.cars))
    watched = stage.followers[stage.watched]
    rulers = [
        (follower is not watched, ruler)
        for follower, level in zip(stage.followers, _levels(stage), strict=True)
        for ruler in _gaps(sheet, places, stage, follower, level)
    ]
    for follower in stage.followers:
        _symbols(sheet, places, stage, follower)
    places.take(*(ruler.box for _, ruler in rulers))
    _sign(sheet, places, stage)
    for follower in stage.followers:
        _marks(sheet, places, stage, follower)
    for _, ruler in sorted(rulers, key=lambda one: (one[0], one[1].believed)):
        _figure(sheet, places, ruler)
    mine = stage.cars[watched.car]
    for car in sorted(stage.cars, key=lambda car: (car is not mine, not car.name, abs(car.x - mine.x))):
        _name(sheet, places, stage, car)
    if len(stage.followers) > 1:
        for words, ink, ground, top in (("true gaps", INK, WHITE, True), ("believed gaps", BELIEF, BELIEF_PALE, False)):
            wide, high = sheet.extent((words,), sheet.small)
            y = sheet.above + 2.0 if top else sheet.below - high - 2.0
            if box := places.find(wide, high, ((5.0, y), (sheet.width - 5.0 - wide, y))):
                sheet.label(box, (words,), ink, sheet.small, ground)
    upper(sheet, loop, state, frame, row)
    lower(sheet, stage, caption, ended(loop, state, frame, row))
    return sheet.done()
