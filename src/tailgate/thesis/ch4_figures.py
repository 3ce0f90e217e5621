"""Figures 4.4 to 4.6 of the thesis, the choice of eta, and the cost of a step, drawn from what was played."""

from __future__ import annotations

import numpy as np

from tailgate.base.plots import canvas, png

from .ch4_cases import CASES, FILTERS, READINGS, Runs
from .ch4_theory import ETAS, SIZES, Curves, Times
from .claims import Figure

NUMBERS = {"clean": "4.4", "fdi": "4.5", "dos": "4.6"}
STYLES = {  # told apart without colour as well
    "kf": {"color": "#0072B2", "linestyle": "--"}, "ours": {"color": "#D55E00", "linestyle": "-"},
    "rkf": {"color": "#009E73", "linestyle": "-."}, "rkf_bad": {"color": "#7F7F7F", "linestyle": ":"},
}  # fmt: skip


def all_figures(runs: Runs, curves: Curves, times: Times, row: int = 0) -> list[Figure]:
    """Every picture; `row` is the run that is shown."""
    return [*(_case(runs, case, row) for case in CASES), _eta(curves), _cost(times)]


def _case(runs: Runs, case: str, row: int) -> Figure:
    shown = READINGS[::2]  # the corrected plant, printed and fitted noise
    figure, axes = canvas(10.0, 6.2, 2, len(shown))
    for column, reading in enumerate(shown):
        for line, (index, wire, label) in enumerate(((0, 2, "relative distance [m]"), (1, 3, "relative velocity [m/s]"))):
            ax, first = axes[line, column], runs[reading.name, case, "ours"].trace
            t = first.dt * np.arange(1, len(first.kind) + 1)
            for name, words in FILTERS.items():
                trace = runs[reading.name, case, name].trace
                believed = trace.clean[:, row, 0, wire] - trace.estimate[:, row, 0, index]
                ax.plot(t, believed, label=words, linewidth=1.2, **STYLES[name])
            true = first.clean[:, row, 0, wire] - first.truth[:, row, 0, index]
            ax.plot(t, true, color="black", linewidth=1.6, label="true (Algorithm 3's run)")
            for k in np.flatnonzero(first.kind[:, row]):
                ax.axvspan(t[k] - first.dt / 2, t[k] + first.dt / 2, color="#F0C000", alpha=0.5, linewidth=0)
            ax.set_ylabel(label)
            ax.grid(alpha=0.3)
            if line == 0:
                ax.set_title(f"{reading.name}: {reading.about.split(';')[0]}", fontsize=9)
            else:
                ax.set_xlabel("time [s]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    caption = f"Figure {NUMBERS[case]} of the thesis again: {CASES[case]}, seed {row}, two readings of the noise. Bands: attacked steps."
    return Figure(f"figure-{NUMBERS[case].replace('.', '-')}", caption, png(figure))


def _eta(curves: Curves) -> Figure:
    figure, axes = canvas(10.0, 3.6, 1, len(curves) + 1)
    lines = {"clean": ("attack-free", "-", "o"), "fdi": ("false data injection", "--", "s"), "dos": ("denial of service", ":", "^")}
    for ax, (name, curve) in zip(axes[0], curves.items(), strict=False):
        for case, (words, style, marker) in lines.items():
            ax.plot(ETAS, curve[case], linestyle=style, marker=marker, markersize=4, label=words)
        ax.set(xscale="log", yscale="log", xlabel="threshold eta", ylabel="position RMSE [m], median", title=name)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter("{x:g}")
        ax.tick_params(which="minor", labelsize=7)
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=8)
    last = axes[0, -1]
    for (name, curve), style in zip(curves.items(), ("-", "--"), strict=False):
        last.plot(ETAS, curve["bound"], linestyle=style, label=f"bound c, {name} [m]")
    rates = next(iter(curves.values()))["alarms"]
    last.plot(ETAS, [r or np.nan for r in rates], linestyle=":", marker="o", markersize=4, label="false alarms a step [-]")
    last.set(xscale="log", yscale="log", xlabel="threshold eta", title="largest jump, and false alarms")
    last.grid(alpha=0.3, which="both")
    last.legend(fontsize=8)
    caption = "Section 4.7, the choice of eta: error with and without attack, the bound of one step's jump, false alarms."
    return Figure("figure-eta", caption, png(figure))


def _cost(times: Times) -> Figure:
    figure, axes = canvas(6.0, 4.0, 1, 1)
    ax = axes[0, 0]
    for (name, curve), (style, marker) in zip(times.items(), (("-", "o"), ("--", "s"), (":", "^")), strict=True):
        ax.plot(list(curve), [1e6 * v for v in curve.values()], linestyle=style, marker=marker, label=name)
    last = max(times["n = q"])
    ax.plot([last / 4, last], [1e6 * times["n = q"][last] / 64, 1e6 * times["n = q"][last]], color="grey", linewidth=1, label="slope 3")
    ax.set(xscale="log", yscale="log", xlabel="size", ylabel="time of a step of one episode [us]", title="Algorithm 3: cost of a step")
    ax.xaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_minor_formatter("")
    ax.set_xticks(list(SIZES))
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=8)
    caption = "Time of a step against the number of states n and of sensors q; the claim is at most slope 3. Wall-clock: other load shows."
    return Figure("figure-cost", caption, png(figure))
