"""Helpers of the chapters' pictures: panels, curves of agents, and bands at attacked steps."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from tailgate.core import Array
from tailgate.core.scenario import load_scenario
from tailgate.envs.render.graph import graph_figure

if TYPE_CHECKING:
    from matplotlib import axes as axes_
    from matplotlib import figure as figure_

Axes: TypeAlias = "axes_.Axes"  # matplotlib is an extra
Picture: TypeAlias = "figure_.Figure"

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#7F7F7F", "#8C564B", "#BCBD22")
MARKERS = "osD^v<>PX*"
STYLES = (("-", "o"), ("--", "s"), (":", "^"))  # distinct without colour as well
BAND = "#F0C000"


def panel(ax: Axes, legend: int | None = 8, grid: Literal["major", "both"] = "major", **labels: object) -> None:
    """Label an axis of matplotlib, and give it a grid and a legend of this font size (None: no legend)."""
    ax.set(**labels)
    ax.grid(alpha=0.3, which=grid)
    if legend is not None:
        ax.legend(fontsize=legend)


def hearing(scenario: str, attacked: Collection[int]) -> Picture:
    """Return the drawing of who hears whom in a scenario, the attacked agents marked."""
    heard = load_scenario(scenario).plant.hears()
    drawn: Picture = graph_figure(heard, [str(i) for i in range(len(heard))], attacked=attacked)
    return drawn


def per_agent(ax: Axes, values: Array, names: Sequence[str], agents: Iterable[int]) -> None:
    """Draw a curve over the steps from 1 for each of these agents, of values (K, N)."""
    steps = np.arange(1, len(values) + 1)
    for i in agents:
        ax.plot(steps, values[:, i], color=COLOURS[i], marker=MARKERS[i], markersize=3, linewidth=1.0, label=names[i])


def mark(ax: Axes, attacked: Array, dt: float = 1.0, alpha: float = 0.4) -> None:
    """Draw a band behind each attacked step of (K,) bool, where step k ends at (k + 1) dt."""
    for k in np.flatnonzero(attacked) + 1:
        ax.axvspan(dt * k - dt / 2, dt * k + dt / 2, color=BAND, alpha=alpha, linewidth=0)


def legend_below(figure: Picture, axes: Array, columns: int) -> None:
    """Put the legend of the first axis below the figure."""
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=columns, fontsize=8)
