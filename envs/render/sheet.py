"""A canvas with a bar above and one below, and between them the stretch of road that is seen (extras: highway, viz)."""

from __future__ import annotations

import math
from itertools import pairwise

from tailgate.envs.render.canvas import GREY, INK, TINY, Canvas
from tailgate.envs.render.labels import Box
from tailgate.envs.render.road import Window
from tailgate.envs.render.stage import LANE, LENGTH, Car, Stage
from tailgate.envs.render.viewer import SIZE

SPANS = (60.0, 90.0, 130.0, 190.0, 280.0, 420.0, 630.0, 950.0)  # metres from left to right: few and fixed, so that the scale rests
STRING = (60.0, 90.0, 130.0, 190.0, 240.0, 300.0, 360.0, 430.0, 520.0, 630.0, 780.0, 950.0)  # for platoons: their length varies little
FORE = 0.64  # share of them that lies ahead of the car
TRAFFIC = 130.0  # the least span of a road with others on it [m]
LEAST = 1.6  # pixels a metre: a car is 8 px long
SEEN_OFF = 60.0  # a belief that is farther off than this is left out of view [m]
LEVEL = 1.5  # lines of believed gaps that would lie on each other are that many letters apart
EDGE = 8.0  # room beyond the first and the last car [m]
CAR_WIDTH = 2.0  # as HighwayEnv has it [m]
PITCH = 1.2  # distance of lines, in letters
FAR = 1e5  # keeps wild beliefs drawable [px]


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
        """Return pixels from the left of x [m]."""
        return max(-FAR, min(self.width / 2 + (x - self.window.x) * self.window.scale, FAR))

    def row(self, y: float) -> float:
        """Return pixels from the top of y [m]."""
        return (self.above + self.below) / 2 + (y - self.window.y) * self.window.scale

    def lines(self, lanes: int) -> tuple[float, float]:
        """Return the room [px] that lines and words above and below the road need; in one lane also that of marks and names."""
        return (3.4 * self.small, 4.3 * self.small) if lanes == 1 else (2.2 * self.small, 2.8 * self.small)

    def seat(self, car: Car) -> Box:
        """Return the box of a car, or of its outline."""
        a, b = abs(math.cos(car.heading)), abs(math.sin(car.heading))
        half = self.window.scale / 2
        wide, high = (LENGTH * a + CAR_WIDTH * b) * half, (LENGTH * b + CAR_WIDTH * a) * half
        x, y = self.column(car.x), self.row(car.y)
        return Box(x - wide, y - max(high, 3.0), x + wide, y + max(high, 3.0))

    def label(self, box: Box, lines: tuple[str, ...], ink: str, size: int, ground: str) -> None:
        """Draw words that fill a box of `extent`, each line in its middle."""
        self.box(*box, ground)
        for i, line in enumerate(lines, start=1):
            self.text((box.x0 + box.x1) / 2, box.y0 + PITCH * size * i - size / 4, line, ink, size, "ms", True)

    def extent(self, lines: tuple[str, ...], size: int) -> tuple[float, float]:
        """Return width and height [px] of words on their ground."""
        return max(self.length(line, size) for line in lines) + 6.0, PITCH * size * len(lines)

    def ruled(self, x0: float, y0: float, x1: float, y1: float, ink: str, halo: str, dash: float = 0.0, width: int = 2) -> None:
        """Draw a line that is visible on any ground."""
        self.line(x0, y0, x1, y1, halo, width + 2)
        self.line(x0, y0, x1, y1, ink, width, dash)

    def outline(self, car: tuple[float, float], ink: str, halo: str, dash: float = 0.0, grow: float = 0.0) -> Box:
        """Draw an outline `grow` px larger than a car on each side, its middle at (x, y) [m]; return the box that it covers."""
        x, y = self.column(car[0]), self.row(car[1])
        a, b = LENGTH / 2 * self.window.scale + grow, max(CAR_WIDTH / 2 * self.window.scale, 3.0) + grow
        corners = [(x - a, y - b), (x + a, y - b), (x + a, y + b), (x - a, y + b), (x - a, y - b)]
        for width, colour, dashes in ((4, halo, 0.0), (2, ink, dash)):
            for start, end in pairwise(corners):
                self.line(*start, *end, colour, width, dashes)
        return Box(x - a, y - b, x + a, y + b).grown(2.0)

    def chip(self, x0: float, x1: float, first: str, second: str, fill: str, ink: str, bold: bool, up: bool = True) -> None:
        """Draw two lines of words in a box of the upper or the lower bar."""
        top = 3.0 if up else self.below + 3.0
        self.box(x0, top, x1, top + self.bar - 6.0, fill, INK if bold else GREY, 2 if bold else 1)
        room, pad = (x0 + 6 * self.unit, x1 - 6 * self.unit), self.big if second else (self.bar - 6.0) / 2 + 0.36 * self.big
        self.text(room[0], top + pad, first, ink, self.big, bold=bold, room=room)
        self.text(room[0], top + self.bar - 6.0 - 3.5 * self.unit, second, ink, self.small, room=room)


def window_of(stage: Stage, sheet: Sheet) -> Window:
    """Return the visible stretch: the least of a fixed set of spans that holds the cars of interest, and the road in height."""
    above, below = sheet.lines(stage.lanes)
    below += LEVEL * sheet.small if len(stage.followers) > 1 else 0.0
    room = sheet.below - sheet.above - above - below
    width, first, watched = sheet.width, stage.cars[0], stage.followers[stage.watched]

    def fits(span: float) -> bool:
        bend = stage.bend * math.sin(min(math.pi * span / stage.period, math.pi / 2))  # wherever the car is: the scale shall rest
        return bend / 2 + stage.lanes * LANE <= room * span / width

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
