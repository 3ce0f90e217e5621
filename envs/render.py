"""One picture of one episode for render_mode "rgb_array", and the window that shows it for "human" (extra: viz).

The upper strip is the road as it is, the lower one the same stretch as the car believes it to be. Gaps between bumpers are to scale,
cars are not. Nothing is told by colour alone, and the same state always gives the same picture.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

try:
    from PIL import Image, ImageDraw, ImageFont
except ImportError as error:
    raise ImportError("Pillow is missing, which draws the pictures: pip install 'tailgate[viz]'") from error

from tailgate.core import Array, Frame, Kind, Mode
from tailgate.errors import InputError
from tailgate.loop import Loop, LoopState

HEIGHT, WIDTH = 320, 960  # multiples of 16, which video encoders ask for
ZOOM = 2  # drawn larger and shrunk: Pillow's lines are not smooth
AGENT = 0  # whom the picture follows

# Columns [px]. The ego's nose stays in place; there is twice as much room ahead as behind, as ACC keeps twice a human's headway.
MARGIN, CAR, NOSE, TAIL = 12.0, 84.0, 404.0, 320.0
AHEAD, BEHIND = WIDTH - MARGIN - CAR - NOSE, TAIL - CAR - MARGIN  # room for the two gaps
SPANS = (15.0, 30.0, 60.0, 120.0, 240.0, 480.0)  # metres in AHEAD: few and fixed, so that the scale does not jitter
FAR = 1e6  # beyond any picture; keeps wild beliefs drawable
LANE = AHEAD / 6  # a dash of the lane and its space; also the ruler
BADGE, BUDGET, LAMP, LAMP_TEXT = (150.0, 610.0), 628.0, 780.0, 806.0
# Rows [px] from the top: header, dimension line and wheels of the true strip, then those of the believed strip
HEADER, TRUE_LINE, WHEELS, STRIP, BELIEVED_LINE, GHOST_WHEELS = 54.0, 100.0, 144.0, 200.0, 250.0, 294.0
ROAD, CAR_HEIGHT, WHEEL, LAMP_SIZE = 14.0, 34.0, 7.5, 15.0
FIRST, SECOND, TINY, SMALL, NORMAL, LARGE = 25.0, 43.0, 9, 13, 16, 20  # lines of the header; letters

# Okabe and Ito's colours and darker shades of them, which colour-blind readers can tell apart
INK, GREY, PALE, WHITE, GLASS = "#1a1a1a", "#5f5f5f", "#ececec", "#ffffff", "#dcebf5"
LEADER, EGO, HUMAN, BELIEF, BELIEF_PALE = "#4d4d4d", "#0072b2", "#00805c", "#7a2a6b", "#f8eef5"
ATTACK, WARNING = "#b34700", "#f0e442"

# A car seen from its right-hand side, in units of its length and height
BODY = ((0.0, 0.18), (0.0, 0.6), (0.12, 0.64), (0.26, 1.0), (0.62, 1.0), (0.78, 0.62), (0.97, 0.54), (1.0, 0.18))
WINDOW = ((0.2, 0.66), (0.3, 0.92), (0.59, 0.92), (0.7, 0.66))
AXLES = (0.22, 0.78)
UNITS = {"position": " m", "velocity": " m/s", "acceleration": " m/s\N{SUPERSCRIPT TWO}"}

COMMANDS = {
    Kind.NONE: ("NO ATTACK", "every wire arrives as it was sent"),
    Kind.DOS_JAM: ("ATTACK: DoS jam", "receiver reads "),
    Kind.DOS_HOLD: ("ATTACK: DoS hold", "stuck at the last reading before the first attack: "),
    Kind.DOS_HOLD_FRESH: ("ATTACK: DoS hold (fresh)", "stuck at the last reading before this burst: "),
    Kind.DROPOUT: ("ATTACK: dropout", "nothing arrives from "),
    Kind.FDI: ("ATTACK: false data (FDI)", "adds "),
    Kind.DELAY: ("ATTACK: delay", "old readings, by steps: "),
    Kind.REPLAY: ("ATTACK: replay", "plays the last readings again, window in steps: "),
}
_metres = "{:,.1f} m".format


@lru_cache
def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size=size * ZOOM)


class _Canvas:
    """Pillow's drawing in picture coordinates, whatever the zoom."""

    def __init__(self) -> None:
        self.image = Image.new("RGB", (WIDTH * ZOOM, HEIGHT * ZOOM), WHITE)
        self.pen = ImageDraw.Draw(self.image)

    def box(self, x0: float, y0: float, x1: float, y1: float, fill: str, edge: str | None = None, width: int = 1) -> None:
        self.pen.rectangle((x0 * ZOOM, y0 * ZOOM, x1 * ZOOM, y1 * ZOOM), fill, edge, width * ZOOM)

    def disc(self, x: float, y: float, radius: float, fill: str, edge: str) -> None:
        self.pen.circle((x * ZOOM, y * ZOOM), radius * ZOOM, fill, edge, 2 * ZOOM)

    def shape(self, points: list[tuple[float, float]], fill: str, edge: str | None = None) -> None:
        self.pen.polygon([(x * ZOOM, y * ZOOM) for x, y in points], fill, edge, ZOOM)

    def line(self, x0: float, y0: float, x1: float, y1: float, ink: str, width: int = 2, dash: float = 0.0) -> None:
        """Solid, or dashes of `dash` px with gaps as long."""
        length = max(1.0, math.hypot(x1 - x0, y1 - y0))
        for start in np.arange(0.0, length, 2 * dash or length):
            ends = (start / length, min(1.0, (start + (dash or length)) / length))
            self.pen.line([((x0 + (x1 - x0) * s) * ZOOM, (y0 + (y1 - y0) * s) * ZOOM) for s in ends], ink, width * ZOOM)

    def text(
        self, x: float, y: float, words: str, ink: str = INK, size: int = NORMAL, anchor: str = "ls", bold: bool = False,
        room: tuple[float, float] = (-FAR, FAR), ground: str | None = None,
    ) -> None:  # fmt: skip
        """Letters, shrunk to `room` (left, right) px and moved into it. ground: its colour, where lines pass beneath."""
        while size > TINY and _font(size).getbbox(words)[2] > (room[1] - room[0]) * ZOOM:
            size -= 1
        length = _font(size).getbbox(words)[2] / ZOOM
        x = max(room[0], min(x - {"l": 0.0, "m": 0.5, "r": 1.0}[anchor[0]] * length, room[1] - length))
        at, anchor = (x * ZOOM, y * ZOOM), "l" + anchor[1]
        if ground:
            self.box(x - 3, y - size, x + length + 3, y + size / 4, ground)
        self.pen.text(at, words, ink, _font(size), anchor, stroke_width=ZOOM / 4 if bold else 0)  # the font has one weight

    def head(self, x: float, y: float, way: float, ink: str, size: float = 7.0) -> None:
        """An arrow's head that points right (way 1) or left (-1)."""
        self.shape([(x, y), (x - way * size, y - size * 0.6), (x - way * size, y + size * 0.6)], ink)

    def gap(self, x0: float, x1: float, y: float, ink: str, dash: float = 0.0) -> float:
        """A dimension line between two bumpers, an arrow where it leaves the picture; returns the middle of what is seen."""
        low, high = sorted((x0, x1))
        ends = [max(MARGIN / 2, min(end, WIDTH - MARGIN / 2)) for end in (low, high)]
        self.line(ends[0], y, ends[1], y, ink, dash=dash)
        for end, seen, way in ((low, ends[0], -1), (high, ends[1], 1)):
            if high - low > 2 * MARGIN or end != seen:
                self.head(seen, y, way, ink)
            if end == seen:
                self.line(seen, y - 7, seen, y + 7, ink)
        return sum(ends) / 2

    def car(self, nose: float, wheels: float, colour: str, ghost: bool = False) -> None:
        """A car by the place of its nose and wheels; a ghost is a dashed outline."""
        body, window = ([(nose - CAR + x * CAR, wheels - y * CAR_HEIGHT) for x, y in part] for part in (BODY, WINDOW))
        if ghost:
            for start, end in zip(body, [*body[1:], body[0]], strict=True):
                self.line(*start, *end, colour, dash=4.0)
        else:
            self.shape(body, colour)
            self.shape(window, GLASS)
        for axle in AXLES:
            self.disc(nose - CAR + axle * CAR, wheels - WHEEL, WHEEL, WHITE if ghost else INK, colour)

    def crash(self, x: float, left: float, words: str) -> None:
        """A burst where two cars touch, and a sign above it."""
        y = WHEELS - CAR_HEIGHT / 2
        turns = [(math.pi * i / 9, 10.0 if i % 2 else 24.0) for i in range(18)]
        self.shape([(x + r * math.cos(a), y + r * math.sin(a)) for a, r in turns], WARNING, INK)
        length = _font(LARGE).getbbox(words)[2] / ZOOM + 2 * MARGIN
        self.box(left, HEADER + 20, left + length, HEADER + 48, WARNING, INK, 3)
        self.text(left + MARGIN, HEADER + 41, words, size=LARGE, bold=True)


def _scale(gap: float, rear_gap: float) -> float:
    """Pixels a metre: the least span that holds the leader, or the next one if that shows the car behind."""
    first = next((i for i, span in enumerate(SPANS) if gap <= span), len(SPANS) - 1)
    scales = [AHEAD / span for span in SPANS[first : first + 2]]
    return next((scale for scale in scales if rear_gap * scale <= BEHIND), scales[0])


def _header(canvas: _Canvas, loop: Loop, state: LoopState, row: int, refused: bool) -> None:
    steps, dt, last = int(state.k[row]) - 1, loop.model.dt, state.channel.last
    canvas.box(0, 0, WIDTH, HEADER, PALE)
    canvas.text(MARGIN, FIRST, f"t = {steps * dt:.{1 if dt >= 0.1 else 2}f} s", size=LARGE, bold=True)
    canvas.text(MARGIN, SECOND, f"step {steps} of {loop.horizon}", GREY, SMALL)
    kind, wires = Kind(int(last.kind[row])), []
    title, does = COMMANDS[kind]
    for i in np.flatnonzero(last.target[row, AGENT]):
        name, unit = loop.model.wires[i].replace("_", " "), UNITS.get(loop.model.wires[i].split("_")[-1], "")
        value = last.value[row, AGENT, i]
        signed = f" {value:+.4g}{unit}"
        wires.append(name + {Kind.DOS_JAM: signed, Kind.FDI: signed, Kind.DELAY: f" {value:g}", Kind.REPLAY: f" {value:g}"}.get(kind, ""))
    on, does = kind != Kind.NONE, does + ", ".join(wires)
    canvas.box(BADGE[0], 5, BADGE[1], HEADER - 5, ATTACK if on else WHITE, INK if on else GREY, 2 if on else 1)
    room, ink = (BADGE[0] + MARGIN, BADGE[1] - MARGIN), WHITE if on else GREY
    canvas.text(room[0], FIRST, title + ("  (a command was refused)" if refused else ""), ink, bold=on)
    canvas.text(room[0], SECOND, does, ink, SMALL, room=room)
    if loop.threat.budget is not None:
        canvas.text(BUDGET, FIRST, f"{loop.threat.budget - int(state.channel.used[row])} of {loop.threat.budget}", bold=True)
        canvas.text(BUDGET, SECOND, "attack steps left", GREY, SMALL)
    alarm, mode = bool(state.estimate.alarm[row, AGENT]), Mode(int(state.estimate.mode[row, AGENT]))
    ink = INK if alarm else GREY
    if alarm:
        canvas.box(LAMP - 2 * LAMP_SIZE, 5, WIDTH - 6, HEADER - 5, WARNING, INK, 2)
    canvas.disc(LAMP, HEADER / 2, LAMP_SIZE, INK if alarm else WHITE, ink)
    canvas.text(LAMP, HEADER / 2, "!" if alarm else "", WARNING, LARGE, "mm", True)
    canvas.text(LAMP_TEXT, FIRST if mode else FIRST + 9, "ALARM" if alarm else "no alarm", ink, LARGE, bold=alarm)
    canvas.text(LAMP_TEXT, SECOND, f"defence's mode: {mode.name}" if mode else "", INK, SMALL, room=(LAMP_TEXT, WIDTH - MARGIN))


def _car(canvas: _Canvas, nose: float, colour: str, name: str, speed: float, room: tuple[float, float]) -> None:
    """A car with its name and speed, or an arrow at the edge that it is beyond."""
    way = 1 if nose > WIDTH - MARGIN + 1 else -1 if nose < MARGIN + CAR - 1 else 0
    middle = (nose - CAR / 2, WIDTH - MARGIN, MARGIN)[way]
    if way:
        canvas.head(middle, WHEELS - CAR_HEIGHT / 2, way, colour, 16.0)
    else:
        canvas.car(nose, WHEELS, colour)
    canvas.text(middle, WHEELS + 29, name + " (out of view)" * abs(way), colour, SMALL, "ms", room=room)
    canvas.text(middle, WHEELS + 45, f"{speed:.1f} m/s", colour, SMALL, "ms", True, room=room)


def _truth(canvas: _Canvas, road: dict[str, float], scale: float, ended: bool) -> None:
    leader, rear = NOSE + road["gap"] * scale, TAIL - road["rear_gap"] * scale
    canvas.text(MARGIN, HEADER + 17, "THE ROAD AS IT IS", GREY, SMALL)
    canvas.box(0, WHEELS, WIDTH, WHEELS + ROAD, LEADER)
    for x in np.arange(-(road["position"] * scale) % LANE - LANE, WIDTH, LANE):  # the dashes stand on the road: the car passes them
        canvas.box(x, WHEELS + ROAD / 2 - 1, x + LANE / 2, WHEELS + ROAD / 2 + 1, WHITE)
    if math.isfinite(road["rear_gap"]):
        _car(canvas, rear, HUMAN, "human driver", road["rear_speed"], (MARGIN, TAIL - 4))
    _car(canvas, leader + CAR, LEADER, "leader", road["lead_speed"], (NOSE + 2, WIDTH - MARGIN))
    _car(canvas, NOSE, EGO, "ego (ACC)", road["speed"], (TAIL, NOSE))
    edge = TAIL + CAR / 4  # keeps the texts apart where both gaps are small
    if road["rear_gap"] <= 0.0:
        canvas.crash(TAIL, TAIL - 2 * CAR, "REAR COLLISION")
    elif math.isfinite(road["rear_gap"]):
        middle = canvas.gap(TAIL, rear, TRUE_LINE, HUMAN)
        canvas.text(middle, TRUE_LINE - 9, "gap behind " + _metres(road["rear_gap"]), HUMAN, SMALL, "ms", room=(MARGIN, edge))
    if road["gap"] <= 0.0 or (ended and road["rear_gap"] > 0.0):
        canvas.crash(NOSE, NOSE - CAR / 4, "COLLISION")
    else:
        middle, words = canvas.gap(NOSE, leader, TRUE_LINE, INK), "true gap " + _metres(road["gap"])
        canvas.text(middle, TRUE_LINE - 9, words, INK, LARGE, "ms", True, room=(edge + MARGIN, WIDTH - MARGIN))


def _belief(canvas: _Canvas, gap: float, believed: float, scale: float) -> None:
    leader, off = NOSE + gap * scale, gap - believed
    ghost = max(-FAR, min(NOSE + off * scale, FAR))
    canvas.box(0, STRIP, WIDTH, HEIGHT, BELIEF_PALE)
    canvas.line(0, STRIP, WIDTH, STRIP, BELIEF, 1)
    canvas.line(0, GHOST_WHEELS, WIDTH, GHOST_WHEELS, BELIEF, 1, dash=3.0)
    canvas.line(leader, TRUE_LINE, leader, GHOST_WHEELS, LEADER, 1, dash=3.0)  # the same bumper in both strips
    canvas.text(MARGIN, STRIP + 17, "WHERE THE EGO BELIEVES IT IS", BELIEF, SMALL)
    middle, words = canvas.gap(ghost, leader, BELIEVED_LINE, BELIEF, dash=5.0), f"believed gap {_metres(believed)}"
    canvas.text(middle, BELIEVED_LINE - 11, words, BELIEF, LARGE, "ms", True, (MARGIN, WIDTH - MARGIN), BELIEF_PALE)
    if ghost > 0.0 and ghost - CAR < WIDTH:
        canvas.car(ghost, GHOST_WHEELS, BELIEF, ghost=True)
    else:
        way, x, y = 1 if ghost > 0.0 else -1, WIDTH - MARGIN if ghost > 0.0 else MARGIN, GHOST_WHEELS - CAR_HEIGHT / 2
        canvas.head(x, y, way, BELIEF, 20.0)
        words = f"out of view: {_metres(abs(off))} {'ahead of' if way > 0 else 'behind'} where it really is"
        canvas.text(x - way * 26, y + 5, words, BELIEF, anchor="rs" if way > 0 else "ls", ground=BELIEF_PALE)
    canvas.gap(MARGIN, MARGIN + LANE, HEIGHT - 10, GREY)
    canvas.text(MARGIN + LANE + 8, HEIGHT - 5, f"{LANE / scale:g} m", GREY, SMALL)


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """(H, W, 3) uint8: row `row` after `frame`. frame is None right after a reset, be it of other rows."""
    at, model = (row, AGENT), loop.model
    road = {name: float(leaf[at]) for name, leaf in loop.plant.scene(loop.plan.plant, state.plant)._asdict().items()}
    # The belief that the controller acted on is one step older than the road, and so is the leader's position that goes with it.
    leader, refused, past = road["position"] + road["gap"] - road["lead_speed"] * model.dt, False, ""
    if frame is not None and frame.k[row] + 1 == state.k[row]:
        refused = bool(frame.refused[row])
        if "leader_position" in model.v2v:  # as the controller heard it
            leader = float(frame.wires[at][model.wires.index("leader_position")])
    elif frame is not None and frame.k[row] <= loop.horizon and frame.collided[row] | frame.rear_collided[row]:
        past = "COLLISION" if frame.collided[row] else "REAR COLLISION"  # of the episode that an autoreset has just replaced
    canvas, scale = _Canvas(), _scale(road["gap"], road["rear_gap"])
    _header(canvas, loop, state, row, refused)
    _belief(canvas, road["gap"], leader - float(state.estimate.x[at][0]), scale)
    _truth(canvas, road, scale, bool(state.ended[row]))
    if past:
        canvas.text(WIDTH - MARGIN, HEADER + 17, f"new episode; the last one ended in a {past}", INK, SMALL, "rs", True)
    return np.array(canvas.image.reduce(ZOOM), np.uint8)


class Window:
    """A window on the screen, opened by its first picture. One that its reader has closed stays closed."""

    def __init__(self, fps: int) -> None:
        self.fps = fps
        self.open = False
        self.dismissed = False  # by its reader
        self._pygame: Any = None
        self._clock: Any = None

    def show(self, picture: Array) -> None:
        """Show a picture (H, W, 3) uint8, no sooner than the frame rate allows. Raises InputError where there is no screen."""
        if self.dismissed:
            return
        if not self.open or self._pygame.display.get_surface() is None:  # also where another environment has closed the one display
            self._start()
        pygame = self._pygame
        if any(event.type in (pygame.QUIT, pygame.WINDOWCLOSE) for event in pygame.event.get()):
            self.dismissed = True
            self.close()
            return
        screen = pygame.display.get_surface()
        screen.blit(pygame.image.frombuffer(np.ascontiguousarray(picture), (WIDTH, HEIGHT), "RGB"), (0, 0))
        pygame.display.flip()
        self._clock.tick(self.fps)

    def close(self) -> None:
        """Close the window, if it is open."""
        if self.open:
            self.open = False
            self._pygame.display.quit()

    def _start(self) -> None:
        try:
            import pygame
        except ImportError as error:
            raise ImportError("pygame is missing, which opens the window: pip install 'tailgate[viz]'") from error
        try:
            pygame.display.init()
            pygame.display.set_mode((WIDTH, HEIGHT))
        except pygame.error as error:
            raise InputError("render_mode", "human", f"a screen for the window ({error}); 'rgb_array' needs none") from None
        pygame.display.set_caption("Tailgate: car following")
        self._pygame, self._clock, self.open = pygame, pygame.time.Clock(), True
