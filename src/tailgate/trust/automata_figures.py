"""Automata drawn (thesis figure 7.2; extra: viz): locations on a ring in the order of the declaration, labels next to their edges."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import TYPE_CHECKING

from tailgate.base.plots import canvas

from .automata import Component, Edge, Location, Network

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, EDGE, NODE, MARKED = "#1a1a1a", "#6b7076", "#dcebf5", "#b34700"
RADIUS = {1: 0.0, 2: 1.0, 3: 1.2, 4: 1.35, 5: 1.6}
WIDTH, HEIGHT = 0.66, 0.22  # half of a location's box


def automata_figure(network: Network, untrusted: Collection[str] = ()) -> Figure:
    """Draw a matplotlib Figure with one panel per component. Edges whose signal is in `untrusted` are dashed, and say so."""
    count = len(network.components)
    figure, axes = canvas(5.2 * count, 4.6, 1, count)
    for ax, component in zip(axes[0], network.components, strict=True):
        _panel(ax, component, untrusted)
    return figure


def location_words(location: Location, leaves: bool = True) -> str:
    """Return what a location says of itself: invariant, clock rates, committed, and the rate where it decides itself when it is left."""
    lines = [location.name, *map(str, location.invariant)]
    for clock, speed in location.rates.items():
        lines.append(f"{clock}' in [{speed[0]:g}, {speed[1]:g}]" if isinstance(speed, tuple) else f"{clock}' = {speed:g}")
    if location.committed:
        lines.append("committed")
    elif leaves and not location.invariant:
        lines.append(f"rate {location.rate:g}")
    return "\n".join(lines)


def edge_words(edge: Edge) -> str:
    """Return guard, signal and what is set, a line each."""
    sets = [f"{name} := {value:g}" for name, value in edge.assign.items()]
    return "\n".join([*map(str, edge.guard), *([edge.sync] if edge.sync else []), *sets])


def _panel(ax: Axes, component: Component, untrusted: Collection[str]) -> None:
    from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

    count = len(component.locations)
    radius = RADIUS.get(count, 0.38 * count)
    locations, boxes = {}, {}
    for j, location in enumerate(component.locations):
        turn = 2.0 * math.pi * j / count
        at = (1.25 * radius * math.sin(turn), radius * math.cos(turn))
        words = location_words(location, any(edge.source == location.name and not edge.hears for edge in component.edges))
        lines = words.count("\n")
        size = (WIDTH + (0.12 if location.rates else 0.0), HEIGHT + 0.1 * lines)
        first = location.name == component.initial
        box = FancyBboxPatch(
            (at[0] - size[0], at[1] - size[1]), 2 * size[0], 2 * size[1], boxstyle="round,pad=0.02,rounding_size=0.14", facecolor=NODE,
            edgecolor=INK, linewidth=2.6 if first else 1.2, zorder=3,
        )  # fmt: skip
        ax.add_patch(box)
        ax.text(*at, words, ha="center", va="center", fontsize=9, color=INK, zorder=4)
        locations[location.name], boxes[location.name] = at, box
    pairs = [(edge.source, edge.target) for edge in component.edges]
    for number, edge in enumerate(component.edges):
        start, end = locations[edge.source], locations[edge.target]
        dx, dy = end[0] - start[0], end[1] - start[1]
        back = (edge.target, edge.source) in pairs or pairs.index((edge.source, edge.target)) != number
        bend = -0.5 if back else -0.2
        marked = edge.sync in untrusted
        ax.add_patch(FancyArrowPatch(
            start, end, patchA=boxes[edge.source], patchB=boxes[edge.target], connectionstyle=f"arc3,rad={bend}", mutation_scale=15,
            arrowstyle="-|>", color=MARKED if marked else EDGE, linestyle="--" if marked else "-", linewidth=1.6, zorder=2,
        ))  # fmt: skip
        middle = (0.5 * (start[0] + end[0]) + 0.5 * bend * dy, 0.5 * (start[1] + end[1]) - 0.5 * bend * dx)
        words = edge_words(edge) + ("\n(untrusted)" if marked else "")
        far = math.hypot(dy, dx) or 1.0
        side = (-dy / far, dx / far)  # where the arc bulges to
        align = "left" if side[0] > 0.35 else "right" if side[0] < -0.35 else "center"
        level = "bottom" if side[1] > 0.7 else "top" if side[1] < -0.7 else "center"
        ax.text(middle[0] + 0.09 * side[0], middle[1] + 0.09 * side[1], words, ha=align, va=level, fontsize=9,
                color=MARKED if marked else INK, zorder=5, linespacing=1.15)  # fmt: skip
    wide, high = max(1.25 * radius + WIDTH + 0.45, 2.3), radius + 0.5
    ax.set_xlim(-wide, wide)
    ax.set_ylim(-high, high)
    ax.set_aspect("equal")
    ax.set_axis_off()
    ax.set_title(f"{component.name}: {component.about}" if component.about else component.name, fontsize=10)
