"""The picture of a car that sees the one ahead by radar (extra: viz): the road, the belief, the probe and what is heard.

The belief belongs to the measurement, a step before the road that is shown. The ghost is off by the error of that time, and the words
give both gaps of that time.
"""

from __future__ import annotations

import math
from itertools import pairwise

from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.controllers.radar_car import GAP
from tailgate.envs.render.canvas import EGO, HEIGHT, INK, MARGIN, SMALL, WARNING, WHITE, WIDTH, Canvas, ended_line, header, metres
from tailgate.envs.render.following import AGENT, CAR_HEIGHT, NOSE, WHEELS, belief, scale_of, truth

BOX, RISE = 300.0, 20.0  # width and height of the radar's sign [px]
WAVES = (10.0, 17.0, 24.0)  # radii of the arcs of a probe [px]


def _probe(canvas: Canvas) -> None:
    """Draw arcs in front of the nose: the radar transmits."""
    turns = [math.radians(angle) for angle in range(-40, 41, 20)]
    for radius in WAVES:
        points = [(NOSE + radius * math.cos(a), WHEELS - CAR_HEIGHT / 2 + radius * math.sin(a)) for a in turns]
        for start, end in pairwise(points):
            canvas.line(*start, *end, EGO)


def _sign(canvas: Canvas, muted: bool, energy: float, alarmed: bool) -> None:
    """Draw the radar's part in the step, and at a challenge the heard power over its own noise."""
    left, top = WIDTH - MARGIN - BOX, HEIGHT - RISE - 2
    words = f"CHALLENGE: radar silent, heard {10.0 * math.log10(max(energy, 1e-9)):+.1f} dB" if muted else "radar transmits"
    canvas.box(left, top, left + BOX, top + RISE, WARNING if muted and alarmed else WHITE, INK, 2 if muted else 1)
    canvas.text(left + BOX / 2, top + 15, words, INK, SMALL, "ms", muted, (left + 4, left + BOX - 4))


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """Return (H, W, 3) uint8: row `row` after `frame`. frame is None right after a reset, also of other rows."""
    at = (row, AGENT)
    road = loop.plant.scene(loop.plan.plant, state.plant).road(row, AGENT)
    road["gap"], road["rear_gap"] = max(road["gap"], 0.0), max(road["rear_gap"], 0.0)  # a long step ends metres beyond a collision
    believed, canvas, scale = float(state.estimate.x[at][GAP]), Canvas(), scale_of(road["gap"], road["rear_gap"])
    fresh = frame is None or frame.k[row] + 1 != state.k[row]  # the prior is exact
    then = believed if frame is None or fresh else float(frame.truth[at][GAP])
    refused = False if frame is None or fresh else bool(frame.refused[row])
    header(canvas, loop, state, row, refused)
    words = f"believed gap {metres(believed)}" + ("" if fresh else f" (true then: {metres(then)})")
    belief(canvas, road["gap"], road["gap"] + believed - then, scale, words)
    truth(canvas, road, scale, bool(state.ended[row]))
    if frame is not None and not fresh:
        _sign(canvas, not state.probed[at], float(frame.received.energy[at]), bool(state.estimate.alarm[at]))
        if state.probed[at] and not state.ended[row]:
            _probe(canvas)
    ended_line(canvas, loop, state, frame, row)
    return canvas.done()
