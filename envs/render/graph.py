"""Drawings of who hears whom: the graph of a network, or the cars of a platoon in a row (thesis figures 5.1 and 6.2; extra: viz)."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.files import write_atomic
from tailgate.base.plots import FORMS, canvas, drawn
from tailgate.core import Array, Model
from tailgate.core.reach import hops

MANY = 60  # agents: more are drawn on a circle
ROUNDS = 300  # rounds of the layout
DPI = 160
INK, EDGE, NODE, ATTACKED = "#1a1a1a", "#6b7076", "#dcebf5", "#b34700"


def layout(graph: Array, row: bool = False) -> Array:
    """Return places (N, 2) of agents whose distances follow the hops (stress majorisation from classical scaling), the same at every call.

    row: side by side, agent 0 on the right, as a platoon drives.
    """
    count = len(graph)
    if row or count < 3:
        return np.stack([-np.arange(count, dtype=float), np.zeros(count)], axis=1)
    if count > MANY:
        turn = 2.0 * np.pi * np.arange(count) / count
        return count / (2.0 * np.pi) * np.stack([np.sin(turn), np.cos(turn)], axis=1)
    wanted = hops(graph)
    wanted = np.where(np.isfinite(wanted), wanted, 1.0 + np.max(wanted[np.isfinite(wanted)]))
    squared = wanted**2
    centred = -0.5 * (squared - squared.mean(axis=0) - squared.mean(axis=1)[:, None] + squared.mean())
    size, axes = np.linalg.eigh(centred)
    places = axes[:, -1:-3:-1] * np.sqrt(np.maximum(size[-1:-3:-1], 1e-3))
    places = places * np.where(places[np.argmax(np.abs(places), axis=0), [0, 1]] < 0.0, -1.0, 1.0)
    places = places + 1e-3 * np.stack([np.sin(np.arange(count)), np.cos(np.arange(count))], axis=1)  # parts two that fell together
    weight = 1.0 / np.maximum(squared, 1.0)
    np.fill_diagonal(weight, 0.0)
    for _ in range(ROUNDS):
        step = places[:, None] - places[None]
        far = np.maximum(np.hypot(step[..., 0], step[..., 1]), 1e-9)
        moved = weight[..., None] * (places[None] + (wanted / far)[..., None] * step)
        places = moved.sum(axis=1) / weight.sum(axis=1)[:, None]
    places = places - places.mean(axis=0)
    _, _, turn = np.linalg.svd(places)  # the long side lies
    places = places @ turn.T
    return np.asarray(places * np.where(places[0] < 0.0, -1.0, 1.0))


def edges(graph: Array) -> list[tuple[int, int, bool]]:
    """Return (from, to, both ways) of each pair of agents where at least one hears the other."""
    heard, out = np.array(graph, bool), []
    for i, j in zip(*np.nonzero(heard), strict=True):
        if i < j or (i > j and not heard[j, i]):
            out.append((int(j), int(i), bool(heard[j, i])))
    return out


def graph_figure(
    graph: Array, labels: Sequence[str] | None = None, attacked: Collection[int] = (), row: bool = False, title: str = ""
) -> Any:
    """Return a matplotlib Figure of a graph (N, N) bool, [i, j] when i hears j.

    Lines join two that hear each other; arrows point to an agent that hears and is not heard.

    labels: of the agents; none: their numbers. attacked: numbers of agents to mark. row: a platoon, the leader on the right.
    Raises InputError for labels or agents that do not fit.
    """
    count = len(graph)
    labels = [str(i) for i in range(count)] if labels is None else list(labels)
    if len(labels) != count:
        raise InputError("labels", len(labels), f"one for each of {count} agents")
    for i in attacked:
        if not 0 <= i < count:
            raise InputError("attacked", i, f"an agent's number, from 0 to {count - 1}")
    from matplotlib.patches import Circle, FancyArrowPatch

    places, links = layout(graph, row), edges(graph)
    span = np.ptp(places, axis=0)
    radius = 0.22 if row or count <= 30 else 0.16
    bend = max((_bend(a, b) for a, b, _ in links), default=0.0) if row else 0.0
    room = np.array([span[0] + 1.0, max(span[1], 0.0) + 1.0 + bend])
    scale = min(1.1, 12.0 / room[0], 9.0 / room[1])
    figure, axes = canvas(max(2.5, room[0] * scale), max(1.4, room[1] * scale) + (0.4 if title else 0.0))
    ax = axes[0, 0]
    for a, b, mutual in links:
        if row and abs(a - b) > 1:
            curve = f"arc3,rad={0.34 * np.sign(b - a):.2f}"
        else:
            curve = "arc3,rad=0"
        ends = [72.0 * scale * _edge(radius, i in attacked) for i in (a, b)]
        style = "-" if mutual else "-|>,head_width=3.2,head_length=6"
        ax.add_patch(FancyArrowPatch(
            places[a], places[b], arrowstyle=style, connectionstyle=curve, color=EDGE, linewidth=1.3, zorder=1,
            shrinkA=ends[0], shrinkB=ends[1] + (0.0 if mutual else 2.0),
        ))  # fmt: skip
    for i, place in enumerate(places):
        hit = i in attacked
        fill, line = ("#ffffff", ATTACKED) if hit else (NODE, INK)
        if hit:  # a second ring: colour is never the only sign
            ax.add_patch(Circle(place, _edge(radius, hit), fill=False, edgecolor=ATTACKED, linewidth=1.8, zorder=2))
        ax.add_patch(Circle(place, radius, facecolor=fill, edgecolor=line, linewidth=1.6, zorder=3))
        size = 72.0 * scale * radius * (1.0 if len(labels[i]) < 3 else 2.2 / len(labels[i]))
        ax.text(*place, labels[i], ha="center", va="center", fontsize=min(12.0, size), color=INK, zorder=4)
    ax.set_xlim(places[:, 0].min() - 0.5, places[:, 0].max() + 0.5)
    ax.set_ylim(places[:, 1].min() - 0.5, places[:, 1].max() + 0.5 + bend)
    ax.set_aspect("equal")
    ax.set_axis_off()
    if title:
        ax.set_title(title, fontsize=10)
    return figure


def _edge(radius: float, hit: bool) -> float:
    """Return the radius at which edges end: at the second ring of an attacked agent."""
    return 1.32 * radius if hit else radius


def _bend(a: int, b: int) -> float:
    """Return the height of the arc between two cars of a row."""
    return 0.0 if abs(a - b) < 2 else 0.5 * 0.34 * abs(a - b)


def draw_graph(source: object, path: Path, attacked: Collection[int] = (), title: str = "") -> Path:
    """Write the graph of a Model, or of a plant whose agents hear each other, to a .png, .svg or .pdf file; return its path."""
    form = path.suffix.lower().removeprefix(".")
    if form not in FORMS:
        raise InputError("out", str(path), f"a file that ends in {', '.join('.' + name for name in FORMS)}")
    if isinstance(source, Model):
        graph, row = source.graph, bool(source.followers.any())
    elif callable(hears := getattr(source, "hears", None)):
        graph, row = hears(), hasattr(source, "topology")
    else:
        raise InputError("graph", type(source).__name__, "a model, or a plant whose agents hear each other")
    write_atomic(path, drawn(graph_figure(graph, None, attacked, row, title), form, dpi=DPI))
    return path
