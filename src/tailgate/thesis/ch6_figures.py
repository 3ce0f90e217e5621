"""Figures 6.2 to 6.5 of the thesis, and the choice of lam in closed loop."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from tailgate.base.plots import canvas
from tailgate.core import Array

from .ch6_cases import CASES, DEFENCES, ONSET, SCENARIO, VICTIM, Runs
from .claims import Drawing
from .figures import STYLES, Picture, hearing, legend_below, mark, panel, per_agent

NUMBERS = {"dos": "6.4", "fdi": "6.5"}


def cases(runs: Runs, row: int = 0) -> Iterator[Drawing]:
    """Return figures 6.2 to 6.5 of one run."""
    caption = "Figure 6.2 again: who hears whom in the platoon; 0 is the leader, car 2 is attacked."
    yield Drawing("figure-6-2", caption, partial(hearing, SCENARIO, (VICTIM,)))
    caption = f"Figure 6.3 again: attack-free, the resilient estimator, each car's own distance, seed {row}."
    yield Drawing("figure-6-3", caption, partial(_clean, runs["clean", "lasso"].own[:, row]))
    for case, printed in NUMBERS.items():
        caption = f"Figure {printed} again: {CASES[case][0]}, seed {row}. Bands: attacked steps; {ONSET} s before the first."
        yield Drawing(f"figure-{printed.replace('.', '-')}", caption, partial(_attacked, runs, case, row))


def _clean(own: Array) -> Picture:
    figure, axes = canvas(6.5, 3.8)
    per_agent(axes[0, 0], own, [f"car {i}" for i in range(own.shape[1])], range(1, own.shape[1]))
    panel(axes[0, 0], xlabel="time [s]", ylabel="|distance error| [m]")
    return figure


def _attacked(runs: Runs, case: str, row: int) -> Picture:
    figure, axes = canvas(9.5, 6.0, 2, 2)
    for column, (name, words) in zip(axes.T, reversed(DEFENCES.items()), strict=True):
        played = runs[case, name]
        for ax, signal, first, what in zip(column, (played.own, played.held), (1, VICTIM), ("own distance", "d_2 as held"), strict=True):
            cars = range(signal.shape[2])
            per_agent(ax, signal[:, row], [f"car {i}{' (a)' if i == VICTIM else ''}" for i in cars], cars[first:])
            mark(ax, played.trace.kind[:, row] != 0)
            panel(ax, None, ylabel=f"|error| [m], {what}")
        column[0].set_title(words)
        column[1].set_xlabel("time [s]")
    legend_below(figure, axes, 4)
    return figure


def choice(curves: Mapping[str, Array]) -> Picture:
    """Draw the largest error over the price `lam`."""
    figure, axes = canvas(6.5, 3.8)
    ax = axes[0, 0]
    labels = [label for label in curves if label != "lam"]
    for label, (style, marker) in zip(labels, STYLES, strict=True):
        ax.plot(curves["lam"], curves[label], linestyle=style, marker=marker, markersize=4, label=label)
    ax.set(xscale="log", yscale="log", xlabel="price lam", ylabel="largest own-distance error of car 2 [m], median")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_major_formatter("{x:g}")
    panel(ax, grid="both")
    return figure
