"""The picture of one car that follows another (extra: viz).

The upper strip is the road as it is, the lower one the same stretch as the car believes it to be. Gaps between bumpers are to scale,
cars are not.
"""

from __future__ import annotations

import math

import numpy as np

from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.render.canvas import (
    BELIEF,
    BELIEF_PALE,
    CAR,
    CAR_SHAPE,
    EGO,
    FAR,
    GREY,
    HEADER,
    HEIGHT,
    HUMAN,
    INK,
    LARGE,
    LEADER,
    MARGIN,
    SMALL,
    WHITE,
    WIDTH,
    Canvas,
    ended_line,
    header,
    metres,
)

AGENT = 0  # whom the picture follows

# Columns [px]. The ego's nose stays in place; there is twice as much room ahead as behind, as ACC keeps twice a human's headway.
NOSE, TAIL = 404.0, 320.0
AHEAD, BEHIND = WIDTH - MARGIN - CAR - NOSE, TAIL - CAR - MARGIN  # room for the two gaps
SPANS = (15.0, 30.0, 60.0, 120.0, 240.0, 480.0)  # metres in AHEAD: few and fixed, so that the scale does not jitter
LANE = AHEAD / 6  # a dash of the lane and its space; also the ruler
# Rows [px] from the top: dimension line and wheels of the true strip, then those of the believed strip
TRUE_LINE, WHEELS, STRIP, BELIEVED_LINE, GHOST_WHEELS = 100.0, 144.0, 200.0, 250.0, 294.0
ROAD, CAR_HEIGHT = 14.0, CAR_SHAPE * CAR


def scale_of(gap: float, rear_gap: float) -> float:
    """Return pixels a metre: the least span that holds the leader, or the next one if that shows the car behind."""
    first = next((i for i, span in enumerate(SPANS) if gap <= span), len(SPANS) - 1)
    scales = [AHEAD / span for span in SPANS[first : first + 2]]
    return next((scale for scale in scales if rear_gap * scale <= BEHIND), scales[0])


def _crash(canvas: Canvas, x: float, left: float, words: str) -> None:
    """Draw a burst where two cars touch, and a sign above it."""
    canvas.burst(x, WHEELS - CAR_HEIGHT / 2)
    canvas.sign(left, HEADER + 20, words)


def _car(canvas: Canvas, nose: float, colour: str, name: str, speed: float, room: tuple[float, float]) -> None:
    """Draw a car with its name and speed, or an arrow at the edge that it is beyond."""
    way = 1 if nose > WIDTH - MARGIN + 1 else -1 if nose < MARGIN + CAR - 1 else 0
    middle = (nose - CAR / 2, WIDTH - MARGIN, MARGIN)[way]
    if way:
        canvas.head(middle, WHEELS - CAR_HEIGHT / 2, way, colour, 16.0)
    else:
        canvas.car(nose, WHEELS, colour)
    canvas.text(middle, WHEELS + 29, name + " (out of view)" * abs(way), colour, SMALL, "ms", room=room)
    canvas.text(middle, WHEELS + 45, f"{speed:.1f} m/s", colour, SMALL, "ms", True, room=room)


def truth(canvas: Canvas, road: dict[str, float], scale: float, ended: bool) -> None:
    """Draw the upper strip: the road as it is, from the leaves of a scene."""
    leader, rear = NOSE + road["gap"] * scale, TAIL - road["rear_gap"] * scale
    canvas.text(MARGIN, HEADER + 17, "THE ROAD AS IT IS", GREY, SMALL)
    canvas.box(0, WHEELS, WIDTH, WHEELS + ROAD, LEADER)
    for x in np.arange(-(road["position"] * scale) % LANE - LANE, WIDTH, LANE):  # the dashes stand on the road: the car passes them
        canvas.box(x, WHEELS + ROAD / 2 - 1, x + LANE / 2, WHEELS + ROAD / 2 + 1, WHITE)
    if math.isfinite(road["rear_gap"]):
        _car(canvas, rear, HUMAN, "behind", road["rear_speed"], (MARGIN, TAIL - 4))
    _car(canvas, leader + CAR, LEADER, "ahead", road["lead_speed"], (NOSE + 2, WIDTH - MARGIN))
    _car(canvas, NOSE, EGO, "ego", road["speed"], (TAIL, NOSE))
    edge = TAIL + CAR / 4  # keeps the texts apart where both gaps are small
    if road["rear_gap"] <= 0.0:
        _crash(canvas, TAIL, TAIL - 2 * CAR, "REAR COLLISION")
    elif math.isfinite(road["rear_gap"]):
        middle = canvas.gap(TAIL, rear, TRUE_LINE, HUMAN)
        canvas.text(middle, TRUE_LINE - 9, "gap behind " + metres(road["rear_gap"]), HUMAN, SMALL, "ms", room=(MARGIN, edge))
    if road["gap"] <= 0.0 or (ended and road["rear_gap"] > 0.0):
        _crash(canvas, NOSE, NOSE - CAR / 4, "COLLISION")
    else:
        middle, words = canvas.gap(NOSE, leader, TRUE_LINE, INK), "true gap " + metres(road["gap"])
        canvas.text(middle, TRUE_LINE - 9, words, INK, LARGE, "ms", True, room=(edge + MARGIN, WIDTH - MARGIN))


def belief(canvas: Canvas, gap: float, believed: float, scale: float, words: str) -> None:
    """Draw the lower strip: the car at its believed place behind the leader, and `words` on the line between."""
    leader, off = NOSE + gap * scale, gap - believed
    ghost = max(-FAR, min(NOSE + off * scale, FAR))
    canvas.box(0, STRIP, WIDTH, HEIGHT, BELIEF_PALE)
    canvas.line(0, STRIP, WIDTH, STRIP, BELIEF, 1)
    canvas.line(0, GHOST_WHEELS, WIDTH, GHOST_WHEELS, BELIEF, 1, dash=3.0)
    canvas.line(leader, TRUE_LINE, leader, GHOST_WHEELS, LEADER, 1, dash=3.0)  # the same bumper in both strips
    canvas.text(MARGIN, STRIP + 17, "WHERE THE EGO BELIEVES IT IS", BELIEF, SMALL)
    middle = canvas.gap(ghost, leader, BELIEVED_LINE, BELIEF, dash=5.0)
    canvas.text(middle, BELIEVED_LINE - 11, words, BELIEF, LARGE, "ms", True, (MARGIN, WIDTH - MARGIN), BELIEF_PALE)
    if ghost > 0.0 and ghost - CAR < WIDTH:
        canvas.car(ghost, GHOST_WHEELS, BELIEF, ghost=True)
    else:
        way, x, y = 1 if ghost > 0.0 else -1, WIDTH - MARGIN if ghost > 0.0 else MARGIN, GHOST_WHEELS - CAR_HEIGHT / 2
        canvas.head(x, y, way, BELIEF, 20.0)
        words = f"out of view: {metres(abs(off))} {'ahead of' if way > 0 else 'behind'} where it really is"
        canvas.text(x - way * 26, y + 5, words, BELIEF, anchor="rs" if way > 0 else "ls", ground=BELIEF_PALE)
    canvas.gap(MARGIN, MARGIN + LANE, HEIGHT - 10, GREY)
    canvas.text(MARGIN + LANE + 8, HEIGHT - 5, f"{LANE / scale:g} m", GREY, SMALL)


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """Return (H, W, 3) uint8: row `row` after `frame`. frame is None right after a reset, also of other rows."""
    at, model = (row, AGENT), loop.model
    road = loop.plant.scene(loop.plan.plant, state.plant).road(row, AGENT)
    # The belief that the controller acted on is one step older than the road, and so is the leader's position that goes with it.
    leader, refused = road["position"] + road["gap"] - road["lead_speed"] * model.dt, False
    if frame is not None and frame.k[row] + 1 == state.k[row]:
        refused = bool(frame.refused[row])
        if "leader_position" in model.v2v:  # as the controller heard it
            leader = float(frame.wires[at][model.wires.index("leader_position")])
    canvas, scale = Canvas(), scale_of(road["gap"], road["rear_gap"])
    header(canvas, loop, state, row, refused)
    believed = leader - float(state.estimate.x[at][0])
    belief(canvas, road["gap"], believed, scale, f"believed gap {metres(believed)}")
    truth(canvas, road, scale, bool(state.ended[row]))
    ended_line(canvas, loop, state, frame, row)
    return canvas.done()
