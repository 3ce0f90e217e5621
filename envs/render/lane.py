"""The picture of a car that keeps its lane, from above (extra: viz): the car, and a dashed outline where it believes it is.

The road bends ahead by its curvature now. Across the lane and along it are to scale, each to its own.
The belief belongs to the measurement, a step before the road that is shown: the outline is off by the error of that time.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.render.canvas import (
    BELIEF,
    EGO,
    FAR,
    GREY,
    HEADER,
    HEIGHT,
    INK,
    LEADER,
    MARGIN,
    NORMAL,
    PALE,
    SMALL,
    WHITE,
    WIDTH,
    Canvas,
    ended_line,
    header,
)  # fmt: skip

ALONG, ACROSS = 24.0, 40.0  # px a metre
HERE, MIDDLE = 260.0, (HEADER + HEIGHT) / 2 + 8.0  # the car's centre of gravity, and the middle of the lane there [px]
BODY = (4.5, 1.8)  # length and width of the car [m]
DASH, STEP = 6.0, 1.0  # half the period of the dashes, and the pieces of a line [m]


def _road(canvas: Canvas, half: float, bend: float, position: float) -> None:
    """Draw the lane's lines, the left one whole, the right one whole, and dashes in its middle."""
    xs = np.arange(-HERE / ALONG, (WIDTH - HERE) / ALONG + STEP, STEP)

    def at(x: float, y: float) -> tuple[float, float]:
        return HERE + x * ALONG, max(HEADER, min(MIDDLE - (y + 0.5 * bend * x * x) * ACROSS, FAR))

    ground = [at(x, half) for x in xs] + [at(x, -half) for x in xs[::-1]]
    canvas.shape(ground, PALE)
    for side in (half, -half):
        for a, b in pairwise(xs):
            canvas.line(*at(a, side), *at(b, side), LEADER, 4)
    for a in np.arange(-(position % (2 * DASH)) - 2 * DASH, xs[-1], 2 * DASH):
        canvas.line(*at(a, 0.0), *at(a + DASH, 0.0), WHITE, 2)


def _body(offset: float, heading: float) -> list[tuple[float, float]]:
    """Return the corners of the car [px]."""
    length, width = BODY
    turn, shift = math.sin(max(-1.0, min(heading, 1.0))), max(-FAR, min(offset, FAR))
    corners = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
    return [(HERE + a * length * ALONG, MIDDLE - (shift + b * width + a * length * turn) * ACROSS) for a, b in corners]


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """Return (H, W, 3) uint8: row `row` after `frame`. frame is None right after a reset, also of other rows."""
    scene, half, at = loop.plant.scene(loop.plan.plant, state.plant), loop.model.lane, (row, 0)
    assert scene.lane is not None
    x = loop.plant.truth(loop.plan.plant, state.plant, np.zeros((len(state.k), 1, 0)))[at]
    offset, bend = float(scene.lane.offset[at]), float(scene.lane.curvature[at])
    fresh = frame is None or frame.k[row] + 1 != state.k[row]
    canvas = Canvas()
    _road(canvas, half, bend, float(scene.position[at]))
    out = abs(offset) >= half
    canvas.shape(_body(offset, float(x[2])), EGO, INK)
    if frame is not None and not fresh:
        off = state.estimate.x[at] - frame.truth[at]
        ghost = _body(offset + float(off[0]), float(x[2] + off[2]))
        for start, end in zip(ghost, [*ghost[1:], ghost[0]], strict=True):
            canvas.line(*start, *end, BELIEF, dash=4.0)
        canvas.text(WIDTH - MARGIN, HEIGHT - 26, f"believed {offset + float(off[0]):+.2f} m", BELIEF, NORMAL, "rs", True, ground=WHITE)
    canvas.text(WIDTH - MARGIN, HEIGHT - 8, f"offset {offset:+.2f} m of {half:g} m", EGO, NORMAL, "rs", True, ground=WHITE)
    radius = "straight" if abs(bend) < 1e-6 else f"bend of {1.0 / abs(bend):,.0f} m to the {'left' if bend > 0 else 'right'}"
    canvas.text(MARGIN, HEIGHT - 8, f"{float(scene.speed[at]):.1f} m/s, {radius}", GREY, SMALL, ground=WHITE)
    if out or state.ended[row]:
        canvas.sign(HERE + 80.0, HEADER + 12.0, "OFF THE LANE")
    header(canvas, loop, state, row, False if frame is None or fresh else bool(frame.refused[row]))
    ended_line(canvas, loop, state, frame, row)
    return canvas.done()
