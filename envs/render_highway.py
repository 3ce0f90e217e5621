"""A picture on HighwayEnv's road: over it what the defence believes, the attack, the alarm and the challenge (extras: highway, viz).

White and solid is what is true, purple and dashed what is believed. Every mark has a shape or a word: nothing is told by colour alone.
"""

from __future__ import annotations

import math
from itertools import pairwise

from tailgate.core import Array, Frame, Kind
from tailgate.loop import Loop, LoopState

from .render_canvas import (
    ATTACK,
    BELIEF,
    BELIEF_PALE,
    COMMANDS,
    EGO,
    GREY,
    INK,
    PALE,
    TINY,
    WARNING,
    WHITE,
    ZOOM,
    Canvas,
    aimed,
    alarmed,
    ended,
    metres,
)
from .render_road import Window, paint
from .render_stage import LANE, LENGTH, Car, Follower, Stage, stage_of
from .render_viewer import SIZE

SPANS = (60.0, 90.0, 130.0, 190.0, 280.0, 420.0, 630.0, 950.0)  # metres from left to right: few and fixed, so that the scale rests
STRING = (60.0, 90.0, 130.0, 190.0, 240.0, 300.0, 360.0, 430.0, 520.0, 630.0, 780.0, 950.0)  # of a platoon, whose length varies little
FORE = 0.64  # share of them that lies ahead of the car
TRAFFIC = 130.0  # the least span of a road with others on it [m]
LEAST = 1.6  # pixels a metre: a car is 8 px long
SEEN_OFF = 60.0  # a belief that is farther off than this is left out of view [m]
LEVEL = 1.5  # lines of believed gaps that would lie on each other are so many letters apart
EDGE = 8.0  # room beyond the first and the last car [m]
CAR_WIDTH = 2.0  # as HighwayEnv has it [m]
FAR = 1e5  # keeps wild beliefs drawable [px]
TARMAC, SHADE = "#646464", "#464646"  # HighwayEnv's ground, and what lies under words among traffic
SMALL_CAR = 24.0  # [px]: an outline would hide a car that is shorter
NOISE_FLOOR = -90.0  # what is heard below it is nothing [dB]


class Sheet(Canvas):
    """A canvas with a bar above and one below, the road between them, and letters by its size."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__(width, height)
        self.unit = max(0.65, min(0.5 * (width / SIZE[0] + height / SIZE[1]), 1.5))
        self.big, self.small = max(TINY + 1, round(16 * self.unit)), max(TINY, round(12 * self.unit))
        self.bar = round(self.big + self.small + 12 * self.unit)
        self.above, self.below = float(self.bar), float(height - self.bar)
        self.window = Window(0.0, 0.0, 1.0)

    def column(self, x: float) -> float:
        """Pixels from the left of x [m]."""
        return max(-FAR, min(self.width / 2 + (x - self.window.x) * self.window.scale, FAR))

    def row(self, y: float) -> float:
        """Pixels from the top of y [m]."""
        return (self.above + self.below) / 2 + (y - self.window.y) * self.window.scale

    @property
    def lines(self) -> tuple[float, float]:
        """Room [px] that the lines and words above and below the road need."""
        return 2.4 * self.small, 4.4 * self.small

    def ruled(self, x0: float, y0: float, x1: float, y1: float, ink: str, halo: str, dash: float = 0.0, width: int = 2) -> None:
        """A line that is seen on any ground."""
        self.line(x0, y0, x1, y1, halo, width + 2)
        self.line(x0, y0, x1, y1, ink, width, dash)

    def outline(self, car: tuple[float, float], ink: str, halo: str, dash: float = 0.0, grow: float = 0.0) -> None:
        """As large as a car and `grow` px more to each side, its middle at (x, y) [m]."""
        x, y = self.column(car[0]), self.row(car[1])
        a, b = LENGTH / 2 * self.window.scale + grow, max(CAR_WIDTH / 2 * self.window.scale, 3.0) + grow
        corners = [(x - a, y - b), (x + a, y - b), (x + a, y + b), (x - a, y + b), (x - a, y - b)]
        for width, colour, dashes in ((4, halo, 0.0), (2, ink, dash)):
            for start, end in pairwise(corners):
                self.line(*start, *end, colour, width, dashes)

    def chip(self, x0: float, x1: float, first: str, second: str, fill: str, ink: str, bold: bool, up: bool = True) -> None:
        """Two lines of words in a box of the upper or the lower bar."""
        top = 3.0 if up else self.below + 3.0
        self.box(x0, top, x1, top + self.bar - 6.0, fill, INK if bold else GREY, 2 if bold else 1)
        room, pad = (x0 + 6 * self.unit, x1 - 6 * self.unit), self.big if second else (self.bar - 6.0) / 2 + 0.36 * self.big
        self.text(room[0], top + pad, first, ink, self.big, bold=bold, room=room)
        self.text(room[0], top + self.bar - 6.0 - 3.5 * self.unit, second, ink, self.small, room=room)


def window_of(stage: Stage, sheet: Sheet) -> Window:
    """The stretch that is seen: from a fixed set of spans the least that holds the cars of interest, and the road in height."""
    above, below = sheet.lines
    below += LEVEL * sheet.small if len(stage.followers) > 1 else 0.0
    room = sheet.below - sheet.above - above - below
    width, first, watched = sheet.width, stage.cars[0], stage.followers[stage.watched]

    def fits(span: float) -> bool:
        heights = [stage.middle(first.x + span * part / 8, 0.0) for part in range(-8, 9)]
        return (max(heights) - min(heights)) / 2 + stage.lanes * LANE <= room * span / width

    if first.role == "leader":
        wanted, most = first.nose - stage.cars[-1].tail + 2 * EDGE, width / LEAST
        span = next((span for span in STRING if wanted <= span <= most and fits(span)), most)
        x = first.nose + EDGE - span / 2
        if wanted > span:  # a long string: the car that is watched and its neighbours
            x = stage.cars[watched.car].x
    else:
        rear = [first.tail - car.tail for car in stage.cars if car.role == "driver" and car.x < first.x] if stage.lanes == 1 else []
        believed = watched.gap if watched.believed is None else watched.believed
        far = watched.gap if believed > watched.gap + SEEN_OFF else max(watched.gap, believed)
        ahead, least = (0.0 if watched.free else far) + LENGTH + EDGE, TRAFFIC if stage.lanes > 1 else 0.0
        spans = [span for span in SPANS if span >= least and ahead <= FORE * span and fits(span)][:2] or [SPANS[-1]]
        shown = (span for span in spans if not rear or max(rear) + LENGTH + EDGE <= (1.0 - FORE) * span)
        span = next(shown, spans[0])  # the next one if that shows the driver behind
        x = first.nose + (FORE - 0.5) * span
    shift = (below - above) / 2 * span / width  # more is written below the road
    return Window(x, stage.middle(x, (stage.lanes - 1) / 2) + shift, width / span)


def _edges(sheet: Sheet, stage: Stage, x0: float, x1: float) -> tuple[float, float]:
    """Rows [px] of the dimension lines: above and below the road from x0 to x1 [px]."""
    ends = [max(0.0, min(x, sheet.width)) for x in (x0, x1)]
    places = [sheet.window.x + (ends[0] + (ends[1] - ends[0]) * i / 4 - sheet.width / 2) / sheet.window.scale for i in range(5)]
    top = min(sheet.row(stage.middle(x, -0.5)) for x in places) - 1.1 * sheet.small
    low = max(sheet.row(stage.middle(x, stage.lanes - 0.5)) for x in places) + (3.3 if stage.lanes == 1 else 1.2) * sheet.small
    return max(top, sheet.above + 1.0 * sheet.small), min(low, sheet.below - 1.0 * sheet.small)


def _measure(sheet: Sheet, x0: float, x1: float, y: float, words: tuple[str, ...], believed: bool) -> None:
    """A dimension line from bumper to bumper [px] with the longest of `words` that fits on it, or the last of them."""
    ink, halo, ground, dash = (BELIEF_PALE, BELIEF, BELIEF_PALE, 4.0) if believed else (WHITE, INK, WHITE, 0.0)
    ends = [max(4.0, min(x, sheet.width - 4.0)) for x in sorted((x0, x1))]
    sheet.ruled(ends[0], y, ends[1], y, ink, halo, dash)
    for seen, end, way in ((ends[0], min(x0, x1), -1), (ends[1], max(x0, x1), 1)):
        if seen != end:
            sheet.head(seen, y, way, halo, 9.0)
        else:
            sheet.ruled(seen, y - 5, seen, y + 5, ink, halo)
    wide = ends[1] - ends[0] - 8.0
    said = next((line for line in words if sheet.length(line, sheet.small) <= wide), words[-1])
    room = (4.0, sheet.width - 4.0)
    sheet.text(sum(ends) / 2, y + 0.36 * sheet.small, said, BELIEF if believed else INK, sheet.small, "ms", True, room, ground)


def _levels(stage: Stage) -> list[int]:
    """0 or 1 for each follower: the other row where its believed gap reaches over that of the car ahead."""
    out: list[int] = []
    for i, follower in enumerate(stage.followers):
        over = i and follower.believed is not None and follower.believed > follower.gap + LENGTH
        out.append(1 - out[-1] if over else 0)
    return out


def _gaps(sheet: Sheet, stage: Stage, follower: Follower, alone: bool, level: int) -> None:
    """True gap above the road, believed gap below it, and the car ahead where the defence believes it to be."""
    car = stage.cars[follower.car]
    nose, tail = sheet.column(car.nose), sheet.column(car.nose + follower.gap)
    if nose < 0.0 and tail < 0.0:
        return
    if nose > sheet.width:
        return
    top, low = _edges(sheet, stage, nose, tail)
    low += LEVEL * sheet.small * level
    y, lane = sheet.row(car.y), round((car.y - stage.middle(car.x, 0.0)) / LANE)
    far = sheet.row(stage.middle(car.nose + follower.gap, lane))
    for x, end in ((nose, y), (tail, far)):
        sheet.line(x, top, x, end, WHITE, 1, 3.0)
    reach = metres(follower.gap)
    said = (f"nobody within {reach}",) if follower.free else (f"true gap {reach}", reach) if alone else (reach, f"{follower.gap:.0f}")
    _measure(sheet, nose, tail, top, said, False)
    if follower.believed is None:
        return
    x = car.nose + max(-FAR, min(follower.believed, FAR))
    ghost, figure = sheet.column(x), metres(follower.believed)
    sheet.line(ghost, sheet.row(stage.middle(x, lane)), ghost, low, BELIEF_PALE, 1, 3.0)
    sheet.line(nose, y, nose, low, BELIEF_PALE, 1, 3.0)
    hidden = ghost > sheet.width or ghost + LENGTH * sheet.window.scale < 0.0
    words = (f"believed gap {figure}", figure) if alone else (figure, f"{follower.believed:.0f}")
    _measure(sheet, nose, ghost, low, (f"{words[0]}, out of view", "out of view") if hidden else words, True)
    if not hidden:
        grow = 3.0 if LENGTH * sheet.window.scale < SMALL_CAR else 0.0
        sheet.outline((x + LENGTH / 2, stage.middle(x + LENGTH / 2, lane)), BELIEF_PALE, BELIEF, 4.0, grow)


def _waves(sheet: Sheet, car: Car, muted: bool) -> None:
    """Arcs before the nose where the radar transmits; a crossed-out circle where it is silent to listen."""
    x, y, size = sheet.column(car.nose), sheet.row(car.y), 7.0 * sheet.unit
    if muted:
        sheet.disc(x + size + 4, y, size + 1, WHITE, EGO)
        sheet.line(x + 4, y + size * 0.7, x + 2 * size + 4, y - size * 0.7, EGO, 3)
        return
    for radius in (1.0, 1.7, 2.4):
        turns = [math.radians(angle) for angle in range(-40, 41, 20)]
        points = [(x + radius * size * math.cos(a), y + radius * size * math.sin(a)) for a in turns]
        for start, end in pairwise(points):
            sheet.ruled(*start, *end, WHITE, EGO, width=1)


def _marks(sheet: Sheet, stage: Stage, follower: Follower) -> None:
    """At the car: an outline and a lightning for an attack, a lamp for an alarm, the radar's waves, a star for a collision."""
    car, size = stage.cars[follower.car], 7.0 * sheet.unit
    x, top = sheet.column(car.x), sheet.row(car.y - CAR_WIDTH / 2) - 3.0
    if not -size < x < sheet.width + size:
        return
    if follower.attacked:
        sheet.outline((car.x, car.y), ATTACK, WHITE, grow=4.0)
        place = x - (size * 1.4 if follower.alarm else 0.0)
        sheet.disc(place, top - 1.4 * size, 1.3 * size, WHITE, ATTACK)
        sheet.bolt(place, top - 0.4 * size, size)
    if follower.alarm:
        place = x + (size * 1.4 if follower.attacked else 0.0)
        sheet.disc(place, top - 1.4 * size, 1.3 * size, WARNING, INK)
        sheet.text(place, top - 1.4 * size, "!", INK, round(size * 2.2), "mm", True)
    if follower.muted is not None and not follower.hit:
        _waves(sheet, car, follower.muted)
    if follower.hit:
        at = car.nose if follower.hit == "COLLISION" else car.tail
        sheet.burst(sheet.column(at), sheet.row(car.y), 14.0 * sheet.unit)


def _names_in_traffic(sheet: Sheet, stage: Stage) -> None:
    """Name and speed under a car, or above it, beside its marks, where they would lie on another's."""
    taken: list[tuple[float, float]] = []
    for car in stage.cars:
        x, words = sheet.column(car.x), f"{car.name} {car.speed:.1f} m/s"
        if not car.name or not 0.0 <= x <= sheet.width:
            continue
        y, wide = sheet.row(car.y + CAR_WIDTH / 2) + 1.1 * sheet.small + 5.0, sheet.length(words, sheet.small) + 8.0
        if near := [other for other, row in taken if abs(x - other) < wide and abs(y - row) < 1.3 * sheet.small]:
            x, y = max(x, max(near) + 24.0 * sheet.unit + wide / 2), sheet.row(car.y - CAR_WIDTH / 2) - 0.5 * sheet.small
        taken.append((x, y))
        sheet.text(x, y, words, WHITE, sheet.small, "ms", True, (2.0, sheet.width - 2.0), SHADE)


def _names(sheet: Sheet, stage: Stage) -> None:
    """Names and speeds under the lane, as far as they fit between the cars."""
    places = sorted(sheet.column(car.x) for car in stage.cars)
    room = (2.0, sheet.width - 2.0)
    for car in stage.cars:
        x = sheet.column(car.x)
        if not 0.0 <= x <= sheet.width:
            continue
        pitch = min((abs(x - other) for other in places if other != x), default=float(sheet.width))
        words = [car.name, f"{car.speed:.1f} m/s"]
        if sheet.length(words[0], TINY) > pitch:
            words = [car.name.removeprefix("car ")]
        y = sheet.row(car.y + LANE / 2) + 2.0
        for ground in (TARMAC, None):  # no line's ground over the letters of another
            for i, line in enumerate(words, start=1):
                size = next((size for size in (sheet.small, TINY) if sheet.length(line, size) <= pitch - 4), 0)
                if size:
                    sheet.text(x, y + 1.1 * i * sheet.small, line, WHITE, size, "ms", room=room, ground=ground)


def _upper(sheet: Sheet, loop: Loop, state: LoopState, frame: Frame | None, row: int) -> None:
    """Time, attack, attack steps left, alarm."""
    width, dt, steps, last = sheet.width, loop.model.dt, int(state.k[row]) - 1, state.channel.last
    fresh = frame is not None and frame.k[row] + 1 == state.k[row]
    refused = frame is not None and fresh and bool(frame.refused[row])
    kind = Kind(int(last.kind[row]))
    title, does = COMMANDS[kind]
    sheet.box(0, 0, width, sheet.bar, PALE)
    on, left = kind != Kind.NONE, 0.15 * width
    room = (5.0, left - 5.0)
    sheet.text(5.0, sheet.big + 3.0, f"t = {steps * dt:.{1 if dt >= 0.1 else 2}f} s", INK, sheet.big, bold=True, room=room)
    budget = [f"step {steps} of {loop.horizon}"]
    if loop.threat.budget is not None:
        share = f"{loop.threat.budget - int(state.channel.used[row])} of {loop.threat.budget}"
        budget = [f"attack steps left: {share}", f"left: {share}"]
    line = next((line for line in budget if sheet.length(line, sheet.small) <= left - 10.0), budget[-1])
    sheet.text(5.0, sheet.bar - 6.5 * sheet.unit, line, GREY, sheet.small, room=room)
    words = title + (" (a command was refused)" if refused else "")
    sheet.chip(left, 0.66 * width, words, does + aimed(loop, last, row), ATTACK if on else WHITE, WHITE if on else GREY, on)
    alarm, second = bool(state.estimate.alarm[row].any()), alarmed(loop, state, row)
    size = 0.36 * sheet.bar
    sheet.chip(0.67 * width, width - 3.0, "", "", WARNING if alarm else WHITE, INK, alarm)
    sheet.alarm(0.67 * width + size + 4.0, sheet.bar / 2, size - 3.0, alarm)
    room = (0.67 * width + 2 * size + 6.0, width - 8.0)
    first = sheet.big + 3.0 if second else (sheet.bar + sheet.big) / 2 - 2.0
    sheet.text(room[0], first, "ALARM" if alarm else "no alarm", INK if alarm else GREY, sheet.big, bold=alarm, room=room)
    sheet.text(room[0], sheet.bar - 6.5 * sheet.unit, second, INK, sheet.small, room=room)


def _lower(sheet: Sheet, stage: Stage, caption: str, note: str) -> None:
    """The figures of the car that is watched, the caption, and what the radar did."""
    follower, width, right = stage.followers[stage.watched], float(sheet.width), sheet.width - 5.0
    sheet.box(0, sheet.below, width, sheet.height, PALE)
    if follower.muted is not None:
        heard = f"heard {follower.heard:+.1f} dB over the noise" if follower.heard > NOISE_FLOOR else "heard nothing"
        first, second = ("CHALLENGE: radar silent", heard) if follower.muted else ("radar transmits", "")
        right = 0.67 * width
        fill, ink = (EGO, WHITE) if follower.muted else (WHITE, GREY)
        sheet.chip(right, width - 3.0, first, second, fill, ink, follower.muted, False)
        right -= 6.0
    who = "" if len(stage.followers) == 1 else f"{stage.cars[follower.car].name}: "
    figures = f"{who}gap {metres(follower.gap)}"
    if follower.believed is None:
        figures += ", nothing measured yet"
    else:
        figures += f", believed {metres(follower.believed)} ({follower.believed - follower.gap:+,.1f} m)"
    figures += f", speed {stage.cars[follower.car].speed:.1f} m/s"
    room = (5.0, right)
    sheet.text(5.0, sheet.below + sheet.big + 2.0, figures, INK, sheet.big, bold=True, room=room)
    sheet.text(5.0, sheet.height - 5.5 * sheet.unit, note or caption, INK if note else GREY, sheet.small, bold=bool(note), room=room)


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int, size: tuple[int, int] | None = None, caption: str = "") -> Array:
    """(H, W, 3) uint8: row `row` after `frame`, which is None right after a reset. caption: a line about who plays."""
    stage, sheet = stage_of(loop, state, frame, row), Sheet(*(size or SIZE))
    sheet.window = window_of(stage, sheet)
    height = round(sheet.below - sheet.above)
    zoomed = sheet.window._replace(scale=sheet.window.scale * ZOOM)
    sheet.paste(paint(stage, zoomed, sheet.width * ZOOM, height * ZOOM), round(sheet.above))
    alone = len(stage.followers) == 1
    for follower, level in zip(stage.followers, _levels(stage), strict=True):
        _gaps(sheet, stage, follower, alone, level)
    if stage.lanes == 1:
        _names(sheet, stage)
    else:
        _names_in_traffic(sheet, stage)
    for follower in stage.followers:
        _marks(sheet, stage, follower)
    if not alone:
        sheet.text(5.0, sheet.above + 1.2 * sheet.small, "true gaps", INK, sheet.small, ground=WHITE)
        sheet.text(5.0, sheet.below - 0.5 * sheet.small, "believed gaps", BELIEF, sheet.small, ground=BELIEF_PALE)
    hit = [follower for follower in stage.followers if follower.hit]
    if hit:
        who = "" if alone else ": " + ", ".join(stage.cars[follower.car].name for follower in hit[:3])
        sheet.sign(min(max(sheet.column(stage.cars[hit[0].car].x) - 80.0, 8.0), sheet.width - 190.0), sheet.below - 34.0, hit[0].hit + who)
    _upper(sheet, loop, state, frame, row)
    _lower(sheet, stage, caption, ended(loop, state, frame, row))
    return sheet.done()
