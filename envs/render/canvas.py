"""The common parts of all pictures: the canvas, its colours, cars, marks, and the header (extra: viz)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

try:
    from PIL import Image, ImageDraw, ImageFont
except ImportError as error:
    raise ImportError("Pillow is missing, which draws the pictures: pip install 'tailgate[viz]'") from error

from tailgate.core import Array, Command, Frame, Kind, Mode
from tailgate.core.kinds import EFFECTS
from tailgate.core.loop import Loop, LoopState

HEIGHT, WIDTH = 320, 960  # multiples of 16, which video encoders ask for
ZOOM = 2  # drawn larger and shrunk: Pillow's lines are not smooth
FAR = 1e6  # beyond any picture; keeps wild beliefs drawable
MARGIN = 12.0
BADGE, BUDGET, LAMP, LAMP_TEXT = (150.0, 610.0), 628.0, 780.0, 806.0  # columns of the header [px]
HEADER, FIRST, SECOND = 54.0, 25.0, 43.0  # its height and its lines
LAMP_SIZE = 15.0
TINY, SMALL, NORMAL, LARGE = 9, 13, 16, 20  # letters
FEW = 4  # wires that the header lists one by one

# Okabe and Ito's colours and darker shades of them, which colour-blind readers can tell apart
INK, GREY, PALE, WHITE, GLASS = "#1a1a1a", "#5f5f5f", "#ececec", "#ffffff", "#dcebf5"
LEADER, EGO, HUMAN, BELIEF, BELIEF_PALE = "#4d4d4d", "#0072b2", "#00805c", "#7a2a6b", "#f8eef5"
ATTACK, WARNING = "#b34700", "#f0e442"

# A car seen from its right-hand side, in units of its length and height
BODY = ((0.0, 0.18), (0.0, 0.6), (0.12, 0.64), (0.26, 1.0), (0.62, 1.0), (0.78, 0.62), (0.97, 0.54), (1.0, 0.18))
WINDOW = ((0.2, 0.66), (0.3, 0.92), (0.59, 0.92), (0.7, 0.66))
AXLES = (0.22, 0.78)
UNITS = {
    "position": " m", "distance": " m", "velocity": " m/s", "acceleration": " m/s^2", "command": " m/s^2",  # the font has no raised two
    "speed": " m/s",
}

CAR = 84.0  # length of a car [px]
CAR_SHAPE, WHEEL_SHAPE = 34.0 / 84.0, 7.5 / 84.0  # its height and wheels, of its length

COMMANDS = {
    Kind.NONE: ("NO ATTACK", "every wire arrives as it was sent"),
    Kind.DOS_JAM: ("ATTACK: DoS jam", "receiver reads "),
    Kind.DOS_HOLD: ("ATTACK: DoS hold", "stuck at the last reading before the first attack: "),
    Kind.DOS_HOLD_FRESH: ("ATTACK: DoS hold (fresh)", "stuck at the last reading before this burst: "),
    Kind.DROPOUT: ("ATTACK: dropout", "nothing arrives from "),
    Kind.FDI: ("ATTACK: false data (FDI)", "adds "),
    Kind.DELAY: ("ATTACK: delay", "old readings, by steps: "),
    Kind.REPLAY: ("ATTACK: replay", "plays the last readings again, window in steps: "),
    Kind.NOISE_JAM: ("ATTACK: noise jamming", "over the air: noise of "),
    Kind.ECHO_DELAY: ("ATTACK: late echo", "over the air: the probe's answer comes back from farther away, by "),
    Kind.INSIDER: ("ATTACK: insider", "the car's own law, its gains times "),
}
metres = "{:,.1f} m".format


@lru_cache
def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size=size * ZOOM)


class Canvas:
    """Pillow's drawing in picture coordinates, whatever the zoom."""

    def __init__(self, width: int = WIDTH, height: int = HEIGHT) -> None:
        self.width, self.height = width, height
        self.image = Image.new("RGB", (width * ZOOM, height * ZOOM), WHITE)
        self.pen = ImageDraw.Draw(self.image)

    def box(self, x0: float, y0: float, x1: float, y1: float, fill: str, edge: str | None = None, width: int = 1) -> None:
        self.pen.rectangle((x0 * ZOOM, y0 * ZOOM, x1 * ZOOM, y1 * ZOOM), fill, edge, width * ZOOM)

    def disc(self, x: float, y: float, radius: float, fill: str, edge: str) -> None:
        self.pen.circle((x * ZOOM, y * ZOOM), radius * ZOOM, fill, edge, 2 * ZOOM)

    def shape(self, points: list[tuple[float, float]], fill: str, edge: str | None = None) -> None:
        self.pen.polygon([(x * ZOOM, y * ZOOM) for x, y in points], fill, edge, ZOOM)

    def line(self, x0: float, y0: float, x1: float, y1: float, ink: str, width: int = 2, dash: float = 0.0) -> None:
        """Draw a line: solid, or dashes of `dash` px with gaps as long."""
        length = max(1.0, math.hypot(x1 - x0, y1 - y0))
        for start in np.arange(0.0, length, 2 * dash or length):
            ends = (start / length, min(1.0, (start + (dash or length)) / length))
            self.pen.line([((x0 + (x1 - x0) * s) * ZOOM, (y0 + (y1 - y0) * s) * ZOOM) for s in ends], ink, width * ZOOM)

    def text(
        self, x: float, y: float, words: str, ink: str = INK, size: int = NORMAL, anchor: str = "ls", bold: bool = False,
        room: tuple[float, float] = (-FAR, FAR), ground: str | None = None,
    ) -> None:  # fmt: skip
        """Draw letters, shrunk to `room` (left, right) px and moved into it. ground: its colour, where lines pass beneath."""
        while size > TINY and _font(size).getbbox(words)[2] > (room[1] - room[0]) * ZOOM:
            size -= 1
        while len(words) > 4 and _font(size).getbbox(words)[2] > (room[1] - room[0]) * ZOOM:
            words = words.removesuffix("...")[:-1] + "..."
        length = _font(size).getbbox(words)[2] / ZOOM
        x = max(room[0], min(x - {"l": 0.0, "m": 0.5, "r": 1.0}[anchor[0]] * length, room[1] - length))
        at, anchor = (x * ZOOM, y * ZOOM), "l" + anchor[1]
        if ground:
            self.box(x - 3, y - size, x + length + 3, y + size / 4, ground)
        self.pen.text(at, words, ink, _font(size), anchor, stroke_width=ZOOM / 4 if bold else 0)  # the font has one weight

    def length(self, words: str, size: int) -> float:
        """Return the width of letters [px]."""
        return float(_font(size).getbbox(words)[2]) / ZOOM

    def head(self, x: float, y: float, way: float, ink: str, size: float = 7.0) -> None:
        """Draw an arrow's head that points right (way 1) or left (-1)."""
        self.shape([(x, y), (x - way * size, y - size * 0.6), (x - way * size, y + size * 0.6)], ink)

    def gap(self, x0: float, x1: float, y: float, ink: str, dash: float = 0.0) -> float:
        """Draw a dimension line between two bumpers, an arrow where it leaves the picture; return the middle of the visible part."""
        low, high = sorted((x0, x1))
        ends = [max(MARGIN / 2, min(end, WIDTH - MARGIN / 2)) for end in (low, high)]
        self.line(ends[0], y, ends[1], y, ink, dash=dash)
        for end, seen, way in ((low, ends[0], -1), (high, ends[1], 1)):
            if high - low > 2 * MARGIN or end != seen:
                self.head(seen, y, way, ink)
            if end == seen:
                self.line(seen, y - 7, seen, y + 7, ink)
        return sum(ends) / 2

    def car(self, nose: float, wheels: float, colour: str, ghost: bool = False, length: float = CAR) -> None:
        """Draw a car by the place of its nose and wheels; a ghost is a dashed outline."""
        height, wheel = CAR_SHAPE * length, WHEEL_SHAPE * length
        body, window = ([(nose - length + x * length, wheels - y * height) for x, y in part] for part in (BODY, WINDOW))
        if ghost:
            for start, end in zip(body, [*body[1:], body[0]], strict=True):
                self.line(*start, *end, colour, dash=4.0)
        else:
            self.shape(body, colour)
            self.shape(window, GLASS)
        for axle in AXLES:
            self.disc(nose - length + axle * length, wheels - wheel, wheel, WHITE if ghost else INK, colour)

    def burst(self, x: float, y: float, size: float = 24.0) -> None:
        """Draw a star where two cars touch."""
        turns = [(math.pi * i / 9, size * 10.0 / 24.0 if i % 2 else size) for i in range(18)]
        self.shape([(x + r * math.cos(a), y + r * math.sin(a)) for a, r in turns], WARNING, INK)

    def sign(self, left: float, top: float, words: str, size: int = LARGE) -> None:
        """Draw large words on yellow, in a box of `sign_size`."""
        width, height = self.sign_size(words, size)
        self.box(left, top, left + width, top + height, WARNING, INK, 3)
        self.text(left + 0.6 * size, top + 1.05 * size, words, size=size, bold=True)

    def sign_size(self, words: str, size: int = LARGE) -> tuple[float, float]:
        """Return width and height of a sign [px]."""
        return self.length(words, size) + 1.2 * size, 1.4 * size

    def alarm(self, x: float, y: float, size: float = LAMP_SIZE, on: bool = True) -> None:
        """Draw a lamp: black with an exclamation mark where it is on."""
        self.disc(x, y, size, INK if on else WHITE, INK if on else GREY)
        self.text(x, y, "!" if on else "", WARNING, round(size * 4 / 3), "mm", True)

    def bolt(self, x: float, y: float, size: float = 9.0) -> None:
        """Draw a lightning that marks an attacked agent, its tip at (x, y)."""
        points = ((0.0, 0.0), (0.75, -1.1), (0.2, -1.0), (0.6, -2.0), (-0.6, -0.85), (-0.05, -0.95))
        self.shape([(x + a * size, y + b * size) for a, b in points], ATTACK, INK)

    def paste(self, picture: Array, top: int) -> None:
        """Draw a picture (H ZOOM, W ZOOM, 3) uint8, as wide as the canvas, from row `top` [px] down."""
        self.image.paste(Image.fromarray(np.ascontiguousarray(picture)), (0, top * ZOOM))

    def done(self) -> Array:
        """Return the picture (H, W, 3) uint8."""
        return np.array(self.image.reduce(ZOOM), np.uint8)


def header(canvas: Canvas, loop: Loop, state: LoopState, row: int, refused: bool) -> None:
    """Draw the bar above the road: time, attack, budget and alarm."""
    steps, dt, last = int(state.k[row]) - 1, loop.model.dt, state.channel.last
    canvas.box(0, 0, WIDTH, HEADER, PALE)
    canvas.text(MARGIN, FIRST, f"t = {steps * dt:.{1 if dt >= 0.1 else 2}f} s", size=LARGE, bold=True)
    canvas.text(MARGIN, SECOND, f"step {steps} of {loop.horizon}", GREY, SMALL)
    kind = Kind(int(last.kind[row]))
    effect = EFFECTS.get(kind)
    title, does = COMMANDS.get(kind) or (f"ATTACK: {effect.title}", f"{effect.does}: ") if effect else COMMANDS[Kind.NONE]
    on, does = kind != Kind.NONE, does + aimed(loop, last, row)
    canvas.box(BADGE[0], 5, BADGE[1], HEADER - 5, ATTACK if on else WHITE, INK if on else GREY, 2 if on else 1)
    room, ink = (BADGE[0] + MARGIN, BADGE[1] - MARGIN), WHITE if on else GREY
    canvas.text(room[0], FIRST, title + ("  (a command was refused)" if refused else ""), ink, bold=on)
    canvas.text(room[0], SECOND, does, ink, SMALL, room=room)
    if loop.threat.budget is not None:
        canvas.text(BUDGET, FIRST, f"{loop.threat.budget - int(state.channel.used[row])} of {loop.threat.budget}", bold=True)
        canvas.text(BUDGET, SECOND, "attack steps left", GREY, SMALL)
    alarms, second = state.estimate.alarm[row].any(), alarmed(loop, state, row)
    if alarms:
        canvas.box(LAMP - 2 * LAMP_SIZE, 5, WIDTH - 6, HEADER - 5, WARNING, INK, 2)
    canvas.alarm(LAMP, HEADER / 2, LAMP_SIZE, bool(alarms))
    first, words, ink = FIRST if second else FIRST + 9, "ALARM" if alarms else "no alarm", INK if alarms else GREY
    canvas.text(LAMP_TEXT, first, words, ink, LARGE, bold=bool(alarms))
    canvas.text(LAMP_TEXT, SECOND, second, INK, SMALL, room=(LAMP_TEXT, WIDTH - MARGIN))


def alarmed(loop: Loop, state: LoopState, row: int) -> str:
    """Return the agents that alarm and the requested modes, in words; nothing for a single calm agent."""
    alarms, modes = np.flatnonzero(state.estimate.alarm[row]).tolist(), state.estimate.mode[row].tolist()
    asked = {mode: [i for i, held in enumerate(modes) if held == mode] for mode in Mode if mode and mode in modes}
    words = "; ".join(f"{mode.name}{_of(loop, asked[mode])}" for mode in asked)
    lines = ([f"defence's mode: {words}"] if asked else []) + ([_of(loop, alarms).removeprefix(" of ")] if alarms else [])
    return "; ".join(line for line in reversed(lines) if line)


def ended(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> str:
    """Return words about the collision of the episode that an autoreset has just replaced; nothing where there was none."""
    if frame is None or frame.k[row] + 1 == state.k[row] or frame.k[row] > loop.horizon:
        return ""
    if not (frame.collided[row] | frame.rear_collided[row]):
        return ""
    return f"new episode; the last one ended in a {'COLLISION' if frame.collided[row] else 'REAR COLLISION'}"


def ended_line(canvas: Canvas, loop: Loop, state: LoopState, frame: Frame | None, row: int) -> None:
    """Draw a line about the collision of the episode that an autoreset has just replaced, if there was one."""
    if words := ended(loop, state, frame, row):
        canvas.text(WIDTH - MARGIN, HEADER + 17, words, INK, SMALL, "rs", True)


def noun(loop: Loop) -> str:
    """Return the word for an agent."""
    return "car" if loop.model.followers.any() else "agent"


def _of(loop: Loop, agents: list[int]) -> str:
    """Return " of car 2", " of cars 1, 2", or nothing where there is only one agent."""
    if loop.model.agents == 1:
        return ""
    listed = ", ".join(map(str, agents)) if len(agents) < 8 else f"{len(agents)} of {loop.model.agents}"
    return f" of {noun(loop)}{'' if len(agents) == 1 else 's'} {listed}"


def aimed(loop: Loop, last: Command, row: int) -> str:
    """Return the wires that a command hits, each with its value; of many their number and the range of the values."""
    kind, wires = Kind(int(last.kind[row])), loop.model.wires
    if kind == Kind.NONE:
        return ""
    if EFFECTS[kind].over_air:
        sent = {i: f"{last.value[row, i].max():.3g} {EFFECTS[kind].unit}" for i in np.flatnonzero(last.target[row].any(axis=1)).tolist()}
        return "; ".join(value + _of(loop, [i for i in sent if sent[i] == value]) for value in dict.fromkeys(sent.values()))
    valued = ("{:g}" if EFFECTS[kind].recorded else "{:+.4g}") if EFFECTS[kind].valued else ""
    groups: dict[tuple[int, float], list[int]] = {}  # agents by wire and value
    for i, w in np.argwhere(last.target[row]).tolist():
        groups.setdefault((w, float(last.value[row, i, w])), []).append(i)
    if len(groups) > FEW and loop.model.agents > 1:
        values, agents = [value for _, value in groups], sorted({i for held in groups.values() for i in held})
        shown = ", ".join(dict.fromkeys(valued.format(end) for end in (min(values), max(values)))) if valued else ""
        return f"{len({w for w, _ in groups})} readings{_of(loop, agents)}{': ' + shown.replace(', ', ' to ') if shown else ''}"
    out: dict[str, list[str]] = {}  # words by whose wires they are
    for (w, value), agents in groups.items():
        unit = "" if EFFECTS[kind].recorded else UNITS.get(wires[w].split("_")[-1], "")
        shown = f" {valued.format(value)}{unit}" if valued else ""
        out.setdefault(_of(loop, agents), []).append(wires[w].replace("_", " ") + shown)
    return "; ".join(", ".join(held) + whose for whose, held in out.items())
