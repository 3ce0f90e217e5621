"""Figures 3.2 and 3.3 of the thesis, with the velocities, and the limits of the challenge, drawn from what was played."""

from __future__ import annotations

import numpy as np

from tailgate.base.plots import canvas, png
from tailgate.core import Array
from tailgate.envs.controllers.radar_car import GAP, RELATIVE_SPEED

from .ch3_cases import OURS, Runs
from .ch3_limits import Curves
from .ch3_radar import Denial
from .claims import Figure

NUMBERS = {("i", "DoS"): "3.2a", ("i", "delay"): "3.2b", ("ii", "DoS"): "3.3a", ("ii", "delay"): "3.3b"}
WORDS = {"DoS": "denial of service from 182 s", "delay": "an echo 6 m late from 180 s"}


def all_figures(runs: Runs, curves: Curves, denial: Denial, row: int = 0) -> list[Figure]:
    """Every picture; `row` is the run that is shown."""
    return [
        *(_case(runs, number, case, row) for number, case in NUMBERS),
        _latency(curves["latency"]),
        _reaction(curves["reaction"]),
        _denial(denial),
    ]


def _case(runs: Runs, number: str, case: str, row: int) -> Figure:
    figure, axes = canvas(10.0, 8.4, 3, 1)
    clean, ours, bare = (runs[number, *key].trace for key in (("clean", OURS), (case, OURS), (case, "none")))
    for ax, wire, label in ((axes[0, 0], GAP, "distance [m]"), (axes[1, 0], RELATIVE_SPEED, "relative velocity [m/s]")):
        received = np.where(ours.valid[:, row, 0, wire], ours.wires[:, row, 0, wire], 0.0)
        ax.plot(_steps(ours, row), received[: ours.length[row]], color="#D55E00", linewidth=0.7, label="radar data with attack")
        ax.plot(
            _steps(clean, row),
            clean.clean[: clean.length[row], row, 0, wire],
            color="#0072B2",
            linestyle="--",
            label="radar data without attack",
        )
        ax.plot(
            _steps(ours, row), ours.estimate[: ours.length[row], row, 0, wire], color="black", linewidth=1.4, label="estimated radar data"
        )
        ax.set_ylabel(label)
    cars = {"no attack": (clean, "--", "#0072B2"), "with the defence": (ours, "-", "black"), "without": (bare, "-.", "#D55E00")}
    for words, (trace, style, colour) in cars.items():
        t = _steps(trace, row) + 1
        axes[2, 0].plot(t, trace.speed[: trace.length[row], row, 0], linestyle=style, color=colour, label=f"follower, {words}")
        if trace.collided[trace.length[row] - 1, row]:
            axes[2, 0].plot(t[-1], trace.speed[trace.length[row] - 1, row, 0], "x", color=colour, markersize=10, label="collision")
    axes[2, 0].plot(_steps(clean, row) + 1, clean.lead_speed[: clean.length[row], row, 0], color="grey", linestyle=":", label="leader")
    axes[2, 0].set(ylabel="velocity [m/s]", xlabel="time [s]")
    for ax in axes[:, 0]:
        ax.axvspan(180.0 if case == "delay" else 182.0, 300.0, color="#F0C000", alpha=0.2, linewidth=0)
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8, loc="best")
        ax.set_xlim(0, 300)
    caption = (
        f"Figure {NUMBERS[number, case]} of the thesis again: scenario ({number}), {WORDS[case]}, seed {row}; challenges at 15, 50, 175 "
        "and 182 s. Below, what the cars do."
    )
    return Figure(f"figure-{NUMBERS[number, case].replace('.', '-')}", caption, png(figure))


def _steps(trace: object, row: int) -> Array:
    return np.arange(1, int(trace.length[row]) + 1)  # type: ignore[attr-defined]


def _latency(curve: dict[str, Array]) -> Figure:
    figure, axes = canvas(6.0, 4.0, 1, 1)
    ax, p = axes[0, 0], np.geomspace(0.015, 0.6, 100)
    ax.plot(p, (1.0 - p) / p, color="grey", label="(1 - p)/p")
    errors = np.array([curve["mean"] - curve["low"], curve["high"] - curve["mean"]])
    ax.errorbar(curve["p"], curve["mean"], errors, fmt="o", color="black", capsize=3, label="measured, 95 %")
    ax.set(xscale="log", yscale="log", xlabel="probability p of a challenge a step", ylabel="steps from onset to alarm, mean")
    ax.xaxis.set_minor_formatter("")
    ax.set_xticks(curve["p"], [f"{v:g}" for v in curve["p"]])
    ax.yaxis.set_major_formatter("{x:g}")
    ax.grid(alpha=0.3, which="both")
    ax.legend()
    return Figure("figure-latency", "Random challenges: mean latency of the detection.", png(figure))


def _reaction(curve: dict[str, Array]) -> Figure:
    figure, axes = canvas(10.0, 4.2, 1, 2)
    styles = {"heard": ("#0072B2", "-", "o"), "collided, list": ("#D55E00", "--", "x"), "collided, random": ("black", ":", "+")}
    words = {"heard": "heard at 182 s", "collided, list": "collision, thesis's list", "collided, random": "collision, random, p = 0.3"}
    for ax, (case, title) in zip(axes[0], WORDS.items(), strict=True):
        for name, (colour, line, marker) in styles.items():
            ax.plot(curve["reaction"], 100.0 * curve[f"{case}: {name}"], linestyle=line, marker=marker, color=colour, label=words[name])
        ax.set(xscale="log", xlabel="reaction time of the attacker [s]", ylabel="runs [%]", ylim=(-4, 104), title=title)
        ax.grid(alpha=0.3, which="both")
        ax.legend(fontsize=8)
    caption = "Attackers that hear the challenge and fall silent, by their reaction time: when they are heard, and what they do in the end."
    return Figure("figure-reaction", caption, png(figure))


def _denial(curve: Denial) -> Figure:
    figure, axes = canvas(6.0, 3.8, 1, 1)
    ax = axes[0, 0]
    for name, style, marker in (("fills the band", "-", "o"), ("follows the chirp", "--", "s")):
        ax.plot(curve["range"], 100.0 * curve[name], linestyle=style, marker=marker, label=f"noise that {name}")
    ax.set(xlabel="range [m]", ylabel="readings off by more than 5 m [%]", ylim=(-4, 104))
    ax.grid(alpha=0.3)
    ax.legend()
    return Figure(
        "figure-jammer", "A jammer of 100 mW on the car ahead, whose echo is weaker than its noise at every range shown.", png(figure)
    )
