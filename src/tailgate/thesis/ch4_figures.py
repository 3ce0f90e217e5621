"""Figures 4.4 to 4.6 of the thesis, the choice of eta, and the cost of a step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from tailgate.base.plots import canvas

from .ch4_cases import CASES, FILTERS, READINGS, Runs
from .claims import Drawing
from .figures import STYLES, Picture, legend_below, mark, panel

NUMBERS = {"clean": "4.4", "fdi": "4.5", "dos": "4.6"}
LINES = {  # distinct without colour as well
    "kf": {"color": "#0072B2", "linestyle": "--"}, "ours": {"color": "#D55E00", "linestyle": "-"},
    "rkf": {"color": "#009E73", "linestyle": "-."}, "rkf_bad": {"color": "#7F7F7F", "linestyle": ":"},
}  # fmt: skip


def cases(runs: Runs, row: int = 0) -> Iterator[Drawing]:
    """Return figures 4.4 to 4.6 of one run."""
    for case, printed in NUMBERS.items():
        caption = f"Figure {printed} of the thesis again: {CASES[case]}, seed {row}, two readings of the noise. Bands: attacked steps."
        yield Drawing(f"figure-{printed.replace('.', '-')}", caption, partial(_case, runs, case, row))


def _case(runs: Runs, case: str, row: int) -> Picture:
    shown = READINGS[::2]  # the corrected plant, printed and fitted noise
    figure, axes = canvas(10.0, 6.2, 2, len(shown))
    for column, reading in enumerate(shown):
        for line, (index, wire, label) in enumerate(((0, 2, "relative distance [m]"), (1, 3, "relative velocity [m/s]"))):
            ax, first = axes[line, column], runs[reading.name, case, "ours"].trace
            t = first.dt * np.arange(1, len(first.kind) + 1)
            for name, words in FILTERS.items():
                trace = runs[reading.name, case, name].trace
                believed = trace.clean[:, row, 0, wire] - trace.estimate[:, row, 0, index]
                ax.plot(t, believed, label=words, linewidth=1.2, **LINES[name])
            true = first.clean[:, row, 0, wire] - first.truth[:, row, 0, index]
            ax.plot(t, true, color="black", linewidth=1.6, label="true (Algorithm 3's run)")
            mark(ax, first.kind[:, row] != 0, first.dt, alpha=0.5)
            panel(ax, None, ylabel=label)
            if line == 0:
                ax.set_title(f"{reading.name}: {reading.about.split(';')[0]}", fontsize=9)
            else:
                ax.set_xlabel("time [s]")
    legend_below(figure, axes, 5)
    return figure


def eta(curves: Mapping[str, Mapping[str, Sequence[float]]], etas: Sequence[float]) -> Picture:
    """Draw error, bound and false alarms over the threshold, by reading."""
    figure, axes = canvas(10.0, 3.6, 1, len(curves) + 1)
    for ax, (name, curve) in zip(axes[0], curves.items(), strict=False):
        for (case, words), (style, marker) in zip(CASES.items(), STYLES, strict=True):
            ax.plot(etas, curve[case], linestyle=style, marker=marker, markersize=4, label=words)
        panel(ax, grid="both", xscale="log", yscale="log", xlabel="threshold eta", ylabel="position RMSE [m], median", title=name)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("{x:g}")
        ax.tick_params(which="minor", labelsize=7)
    last = axes[0, -1]
    for (name, curve), style in zip(curves.items(), ("-", "--"), strict=False):
        last.plot(etas, curve["bound"], linestyle=style, label=f"bound c, {name} [m]")
    rates = next(iter(curves.values()))["alarms"]
    last.plot(etas, [r or np.nan for r in rates], linestyle=":", marker="o", markersize=4, label="false alarms a step [-]")
    panel(last, grid="both", xscale="log", yscale="log", xlabel="threshold eta", title="largest jump, and false alarms")
    return figure


def cost(times: Mapping[str, Mapping[int, float]]) -> Picture:
    """Draw the time of a step [s] by shape and size."""
    figure, axes = canvas(6.0, 4.0)
    ax = axes[0, 0]
    for (name, curve), (style, marker) in zip(times.items(), STYLES, strict=True):
        ax.plot(list(curve), [1e6 * v for v in curve.values()], linestyle=style, marker=marker, label=name)
    last = max(times["n = q"])
    ax.plot([last / 4, last], [1e6 * times["n = q"][last] / 64, 1e6 * times["n = q"][last]], color="grey", linewidth=1, label="slope 3")
    ax.set(xscale="log", yscale="log", xlabel="size", ylabel="time of a step of one episode [us]", title="Algorithm 3: cost of a step")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter("")
    ax.set_xticks(list(times["n = q"]))
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8)
    return figure
