"""Figures 5.1 to 5.4 of the thesis, and the error against the number of compromised agents."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from tailgate.base.plots import canvas
from tailgate.core import Array

from .ch5_cases import COMPROMISED, DEFENCES, ONSET, SCENARIO, Runs
from .claims import Drawing
from .figures import Picture, hearing, legend_below, panel, per_agent


def cases(runs: Runs, row: int = 0) -> Iterator[Drawing]:
    """Return figures 5.1 to 5.4 of one run."""
    caption = "Figure 5.1 of the thesis again: who hears whom; agents count from 0, the compromised ones are marked."
    yield Drawing("figure-5-1", caption, partial(hearing, SCENARIO, COMPROMISED))
    caption = f"Figure 5.2 again: attack-free, the resilient estimator, system {row}; right: the same on a logarithmic scale."
    yield Drawing("figure-5-2", caption, partial(_clean, runs["norm"][:ONSET, row]))
    caption = f"Figures 5.3 and 5.4 again: under attack after step {ONSET}, system {row}; (a): attacked."
    yield Drawing("figure-5-3-and-5-4", caption, partial(_attacked, {name: runs[name][:, row] for name in DEFENCES}))


def _clean(error: Array) -> Picture:
    figure, axes = canvas(9.0, 3.6, 1, 2)
    agents = range(error.shape[1])
    for ax, scale in zip(axes[0], ("linear", "log"), strict=True):
        per_agent(ax, error, [f"agent {i}" for i in agents], agents)
        panel(ax, None, xlabel="step", ylabel="|xh_i - x|", yscale=scale)
    legend_below(figure, axes, 5)
    return figure


def _attacked(error: Mapping[str, Array]) -> Picture:
    figure, axes = canvas(9.0, 3.8, 1, 2)
    for ax, (name, words) in zip(axes[0], reversed(DEFENCES.items()), strict=True):
        agents = range(error[name].shape[1])
        per_agent(ax, error[name], [f"agent {i}{' (a)' if i in COMPROMISED else ''}" for i in agents], agents)
        ax.axvline(ONSET + 0.5, color="black", linewidth=0.8, linestyle=":")
        panel(ax, None, xlabel="step", ylabel="|xh_i - x|", title=words)
    legend_below(figure, axes, 5)
    return figure


def number(curves: Mapping[str, Array]) -> Picture:
    """Draw the largest error against the number of compromised agents, and of compromised neighbours."""
    figure, axes = canvas(9.0, 3.6, 1, 2)
    left, right = axes[0]
    for (name, words), style in zip(DEFENCES.items(), ("--", "-"), strict=True):
        left.plot(curves["count"], np.maximum(curves[name], 1e-12), linestyle=style, marker="o", markersize=4, label=words)
    panel(left, xlabel="compromised agents", ylabel="largest error, median", yscale="log", ylim=(1e-3, None))
    right.plot(np.arange(len(curves["near"])), curves["near"], marker="s", color="#D55E00", label="resilient (5.8), honest agent 7")
    panel(right, xlabel="compromised neighbours of agent 7", ylabel="its largest error, median", ylim=(0.0, None))
    return figure
