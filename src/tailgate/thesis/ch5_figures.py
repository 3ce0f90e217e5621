"""Figures 5.1 to 5.4 of the thesis, and the error against the number of compromised agents, drawn from what was played."""

from __future__ import annotations

import numpy as np

from tailgate.base.plots import canvas, png
from tailgate.core.drawing import graph_figure
from tailgate.core.scenario import load_scenario

from .ch5_cases import COMPROMISED, GUARDS, ONSET, SCENARIO, Runs
from .ch5_theory import Curves
from .claims import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#7F7F7F", "#8C564B", "#BCBD22")
MARKERS = "osD^v<>PX*"


def all_figures(runs: Runs, curves: Curves, row: int = 0) -> list[Figure]:
    """Every picture; `row` is the run that is shown."""
    return [_graph(), _clean(runs, row), _attacked(runs, row), _number(curves)]


def _graph() -> Figure:
    plant = load_scenario(SCENARIO).plant
    figure = graph_figure(plant.hears(), [str(i) for i in range(plant.agents)], attacked=COMPROMISED)
    return Figure(
        "figure-5-1", "Figure 5.1 of the thesis again: who hears whom; agents count from 0, the compromised ones are marked.", png(figure)
    )


def _clean(runs: Runs, row: int) -> Figure:
    figure, axes = canvas(9.0, 3.6, 1, 2)
    steps = np.arange(1, ONSET + 1)
    for ax, log in zip(axes[0], (False, True), strict=True):
        for i in range(runs["norm"].shape[2]):
            ax.plot(
                steps, runs["norm"][:ONSET, row, i], color=COLOURS[i], marker=MARKERS[i], markersize=3, linewidth=1.0, label=f"agent {i}"
            )
        ax.set(xlabel="step", ylabel="|xh_i - x|", yscale="log" if log else "linear")
        ax.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return Figure(
        "figure-5-2",
        f"Figure 5.2 again: attack-free, the resilient estimator, system {row}; right: the same on a logarithmic scale.",
        png(figure),
    )


def _attacked(runs: Runs, row: int) -> Figure:
    figure, axes = canvas(9.0, 3.8, 1, 2)
    for ax, (name, words) in zip(axes[0], reversed(GUARDS.items()), strict=True):
        steps = np.arange(1, len(runs[name]) + 1)
        for i in range(runs[name].shape[2]):
            label = f"agent {i}{' (a)' if i in COMPROMISED else ''}"
            ax.plot(steps, runs[name][:, row, i], color=COLOURS[i], marker=MARKERS[i], markersize=3, linewidth=1.0, label=label)
        ax.axvline(ONSET + 0.5, color="black", linewidth=0.8, linestyle=":")
        ax.set(xlabel="step", ylabel="|xh_i - x|", title=words)
        ax.grid(alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return Figure(
        "figure-5-3-and-5-4", f"Figures 5.3 and 5.4 again: under attack after step {ONSET}, system {row}; (a): attacked.", png(figure)
    )


def _number(curves: Curves) -> Figure:
    figure, axes = canvas(9.0, 3.6, 1, 2)
    left, right = axes[0]
    for (name, words), style in zip(GUARDS.items(), ("--", "-"), strict=True):
        left.plot(curves["count"], np.maximum(curves[name], 1e-12), linestyle=style, marker="o", markersize=4, label=words)
    left.set(xlabel="compromised agents", ylabel="largest error, median", yscale="log", ylim=(1e-3, None))
    right.plot(np.arange(len(curves["near"])), curves["near"], marker="s", color="#D55E00", label="resilient (5.8), honest agent 7")
    right.set(xlabel="compromised neighbours of agent 7", ylabel="its largest error, median", ylim=(0.0, None))
    for ax in (left, right):
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8)
    return Figure(
        "figure-number",
        "Error after step 20 against the number of compromised agents, and of compromised neighbours of one honest agent.",
        png(figure),
    )
