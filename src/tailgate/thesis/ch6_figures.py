"""Figures 6.2 to 6.5 of the thesis, and the choice of lam in closed loop, drawn from what was played."""

from __future__ import annotations

import numpy as np

from tailgate.base.plots import canvas, png
from tailgate.core.drawing import graph_figure
from tailgate.core.scenario import load_scenario

from .ch5_figures import COLOURS, MARKERS
from .ch6_cases import CASES, GUARDS, ONSET, SCENARIO, VICTIM, Runs
from .ch6_loop import Curves
from .claims import Figure

NUMBERS = {"dos": "6.4", "fdi": "6.5"}


def all_figures(runs: Runs, curves: Curves, row: int = 0) -> list[Figure]:
    """Every picture; `row` is the run that is shown."""
    return [_graph(), _clean(runs, row), *(_attacked(runs, case, row) for case in NUMBERS), _choice(curves)]


def _graph() -> Figure:
    plant = load_scenario(SCENARIO).plant
    figure = graph_figure(plant.hears(), [str(i) for i in range(plant.size[0])], attacked=(VICTIM,))
    return Figure("figure-6-2", "Figure 6.2 again: who hears whom in the platoon; 0 is the leader, car 2 is attacked.", png(figure))


def _clean(runs: Runs, row: int) -> Figure:
    figure, axes = canvas(6.5, 3.8, 1, 1)
    ax, own = axes[0, 0], runs["clean", "lasso"].own
    for i in range(1, own.shape[2]):
        ax.plot(
            np.arange(1, len(own) + 1), own[:, row, i], color=COLOURS[i], marker=MARKERS[i], markersize=3, linewidth=1.0, label=f"car {i}"
        )
    ax.set(xlabel="time [s]", ylabel="|distance error| [m]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)
    return Figure(
        "figure-6-3", f"Figure 6.3 again: attack-free, the resilient estimator, each car's own distance, seed {row}.", png(figure)
    )


def _attacked(runs: Runs, case: str, row: int) -> Figure:
    figure, axes = canvas(9.5, 6.0, 2, 2)
    for column, (name, words) in enumerate(reversed(GUARDS.items())):
        played = runs[case, name]
        for line, (signal, what) in enumerate(((played.own, "own distance"), (played.held, "d_2 as held"))):
            ax = axes[line, column]
            for i in range(1 if line == 0 else VICTIM, signal.shape[2]):
                label = f"car {i}{' (a)' if i == VICTIM else ''}"
                ax.plot(
                    np.arange(1, len(signal) + 1),
                    signal[:, row, i],
                    color=COLOURS[i],
                    marker=MARKERS[i],
                    markersize=3,
                    linewidth=1.0,
                    label=label,
                )
            for k in np.flatnonzero(played.trace.kind[:, row]):
                ax.axvspan(k + 0.5, k + 1.5, color="#F0C000", alpha=0.4, linewidth=0)
            ax.set(ylabel=f"|error| [m], {what}", title=words if line == 0 else None)
            ax.grid(alpha=0.3)
            if line:
                ax.set_xlabel("time [s]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    number = NUMBERS[case]
    caption = f"Figure {number} again: {CASES[case][0]}, seed {row}. Bands: attacked steps; {ONSET} s before the first."
    return Figure(f"figure-{number.replace('.', '-')}", caption, png(figure))


def _choice(curves: Curves) -> Figure:
    figure, axes = canvas(6.5, 3.8, 1, 1)
    ax = axes[0, 0]
    for (label, values), (style, marker) in zip(
        ((k, v) for k, v in curves.items() if k != "lam"), (("-", "o"), ("--", "s"), (":", "^")), strict=True
    ):
        ax.plot(curves["lam"], values, linestyle=style, marker=marker, markersize=4, label=label)
    ax.set(xscale="log", yscale="log", xlabel="price lam", ylabel="largest own-distance error of car 2 [m], median")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8)
    return Figure(
        "figure-lam",
        "The price lam in closed loop: a low one distrusts honest news of a braking leader, a high one believes the attacker.",
        png(figure),
    )
