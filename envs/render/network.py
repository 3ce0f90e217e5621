"""The picture of a network: the graph, its agents shaded by how wrong their estimates are, and the errors as bars (extra: viz)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from tailgate.core import Array, Frame
from tailgate.core.loop import Loop, LoopState
from tailgate.envs.render.canvas import (
    ATTACK,
    GREY,
    HEADER,
    HEIGHT,
    INK,
    MARGIN,
    NORMAL,
    SMALL,
    TINY,
    WHITE,
    WIDTH,
    Canvas,
    ended_line,
    header,
)
from tailgate.envs.render.graph import edges, layout

SPLIT = 560.0  # column [px] between the graph and the bars
DECADES = (-3, 4)  # range of the shade and the bars
PALE, DEEP = (0xEE, 0xF4, 0xFA), (0x08, 0x30, 0x6B)  # no error, the largest: from light to dark
MOST_BARS = 20  # agents: of more the worst


@lru_cache(maxsize=8)
def _places(graph: bytes, count: int) -> Array:
    """Return places (N, 2) in [0, 1], the wider side filled."""
    places = layout(np.frombuffer(graph, bool).reshape(count, count))
    low, high = np.min(places, axis=0), np.max(places, axis=0)
    return np.asarray((places - low) / np.where(high > low, high - low, 1.0) + np.where(high > low, 0.0, 0.5))


def share(error: float) -> float:
    """Return the place of an error on the logarithmic scale, 0 to 1."""
    low, high = DECADES
    if math.isnan(error):
        return 0.0
    return max(0.0, min((math.log10(max(error, 1e-300)) - low) / (high - low), 1.0))


def shade(error: float) -> str:
    """Return the colour of an error: the larger, the darker."""
    part = share(error)
    return "#" + "".join(f"{round(a + (b - a) * part):02x}" for a, b in zip(PALE, DEEP, strict=True))


def errors(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """Return the error (N,) of each agent's last estimate; NaN right after a reset."""
    if frame is not None and frame.k[row] + 1 == state.k[row]:
        return np.asarray(loop.model.error(frame.estimate.x[row], frame.truth[row]))
    return np.full(loop.model.agents, np.nan)


def _graph(canvas: Canvas, loop: Loop, sizes: Array, attacked: Array, alarm: Array) -> None:
    model = loop.model
    radius = 21.0 if model.agents <= 12 else max(6.0, 21.0 * math.sqrt(12 / model.agents))
    inset = radius + 22.0
    places = _places(np.array(model.graph, bool).tobytes(), model.agents)
    x = inset + places[:, 0] * (SPLIT - 2 * inset)
    y = HEADER + inset + (1.0 - places[:, 1]) * (HEIGHT - HEADER - 2 * inset)
    for a, b, mutual in edges(model.graph):
        far = max(1.0, math.hypot(x[b] - x[a], y[b] - y[a]))
        ux, uy = (x[b] - x[a]) / far, (y[b] - y[a]) / far
        canvas.line(x[a], y[a], x[b], y[b], GREY, 1)
        if not mutual:  # an arrow's head at the one who hears
            tip = (x[b] - ux * radius, y[b] - uy * radius)
            canvas.shape([tip, *((tip[0] - 9 * ux + s * 4 * uy, tip[1] - 9 * uy - s * 4 * ux) for s in (1, -1))], GREY)
    for i in range(model.agents):
        if attacked[i]:
            canvas.disc(x[i], y[i], radius + 5, WHITE, ATTACK)
        canvas.disc(x[i], y[i], radius, shade(sizes[i]), ATTACK if attacked[i] else INK)
        dark = share(sizes[i]) > 0.45
        if radius >= 10:
            canvas.text(x[i], y[i] + 1, str(i), WHITE if dark else INK, NORMAL if radius > 15 else TINY, "mm", True)
        if attacked[i]:
            canvas.bolt(x[i] - radius * 0.85, y[i] - radius * 0.75, 9.0)
        if alarm[i]:
            canvas.alarm(x[i] + radius * 0.85, y[i] - radius * 0.85, 9.0)


def _bars(canvas: Canvas, sizes: Array, attacked: Array, alarm: Array) -> None:
    """Draw the errors on a logarithmic axis, one bar an agent; of many agents the worst."""
    left, right, top, low = SPLIT + 44.0, WIDTH - 74.0, HEADER + 38.0, HEIGHT - 24.0
    some = sorted(range(len(sizes)), key=lambda i: (-sizes[i], i))[:MOST_BARS]
    some = sorted(some) if len(sizes) <= MOST_BARS else some
    title = "ERROR OF EACH AGENT'S ESTIMATE, 2-NORM" if len(sizes) <= MOST_BARS else f"THE {MOST_BARS} LARGEST ERRORS, 2-NORM"
    canvas.line(SPLIT, HEADER, SPLIT, HEIGHT, GREY, 1)
    canvas.text(SPLIT + MARGIN, HEADER + 20, title, GREY, SMALL)
    for decade in range(DECADES[0], DECADES[1] + 1):
        x = left + (right - left) * share(10.0**decade)
        canvas.line(x, top - 6, x, low, "#d5d8dc", 1)
        canvas.text(x, low + 14, f"{10.0**decade:g}", GREY, TINY + 1, "ms")
    pitch = (low - top) / len(some)
    if math.isnan(sizes[0]):
        canvas.text((left + right) / 2, (top + low) / 2, "no estimate yet", GREY, NORMAL, "mm")
        return
    for place, i in enumerate(some):
        y, size = top + pitch * place, max(1.0, (right - left) * share(sizes[i]))
        canvas.box(left, y + pitch * 0.15, left + size, y + pitch * 0.85, shade(max(sizes[i], 0.05)), ATTACK if attacked[i] else INK, 1)
        letters = SMALL if pitch > 15 else TINY if pitch >= 9 else 0
        if letters:
            middle = y + pitch / 2
            canvas.text(left - 8, middle, str(i), INK, letters, "rm", bool(attacked[i]))
            canvas.text(left + size + 6, middle, _short(sizes[i]), INK, letters, "lm")
            if attacked[i]:
                canvas.bolt(left - 32, middle + 6, 6.0)
            if alarm[i]:
                canvas.alarm(WIDTH - 14, middle, min(7.0, pitch / 2))


def _short(error: float) -> str:
    return f"{error:.0f}" if 1000.0 <= error < 1e6 else f"{error:.3g}"


def draw(loop: Loop, state: LoopState, frame: Frame | None, row: int) -> Array:
    """Return (H, W, 3) uint8: row `row` after `frame`, or right after a reset."""
    here = frame is not None and bool(frame.k[row] + 1 == state.k[row])
    attacked = np.any(state.channel.last.target[row], axis=1)
    sizes, canvas = errors(loop, state, frame, row), Canvas()
    header(canvas, loop, state, row, here and frame is not None and bool(frame.refused[row]))
    _graph(canvas, loop, sizes, attacked, state.estimate.alarm[row])
    _bars(canvas, sizes, attacked, state.estimate.alarm[row])
    ended_line(canvas, loop, state, frame, row)
    return canvas.done()
