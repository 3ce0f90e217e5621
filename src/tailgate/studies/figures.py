"""Pictures of the measures of strength. Every line and mark differs by more than its colour."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tailgate.base.plots import MARKERS, canvas, drawn

from .policies import label
from .timing import TWINS

if TYPE_CHECKING:
    from matplotlib.patches import Rectangle

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito
LINES = ("-", "--", "-.", ":")
WORDS = {"crashed": "episodes with a collision", "collided": "episodes with a collision ahead"}


def axis_label(outcome: str, unit: str, exceeds: float | None = None) -> str:
    """Return what is measured, with its unit."""
    if unit == "0/1":
        what = WORDS.get(outcome, f"episodes with {outcome}") if exceeds is None else f"episodes with {outcome} above {exceeds:g}"
        return f"{what} [%]"
    return f"mean {outcome} [{unit}]"


def _scale(unit: str) -> float:
    return 100.0 if unit == "0/1" else 1.0


def timing_figure(entries: Sequence[dict[str, Any]], form: str = "png") -> bytes:
    """Draw one line per entry and schedule: the outcome with its interval. One panel per outcome."""
    outcomes = list(dict.fromkeys((e["outcome"], e["unit"]) for e in entries))
    heights = [sum((e["outcome"], e["unit"]) == key for e in entries) for key in outcomes]
    figure, axes = canvas(8.5, 1.3 + 0.9 * sum(heights) + 0.5 * len(outcomes), len(outcomes), 1, height_ratios=heights)
    for ax, (outcome, unit) in zip(axes[:, 0], outcomes, strict=True):
        here = [e for e in entries if (e["outcome"], e["unit"]) == (outcome, unit)]
        for i, entry in enumerate(here):
            for j, name in enumerate(TWINS):
                found = {key: _scale(unit) * value for key, value in entry["outcomes"][name].items()}
                ends = [[found["value"] - found["low"]], [found["high"] - found["value"]]]
                ax.errorbar(
                    found["value"], i + 0.18 * (j - 1.5), xerr=ends, marker=MARKERS[j], color=COLOURS[j], capsize=3, linestyle="none",
                    markerfacecolor=COLOURS[j] if name == "own" else "white",
                    label=f"{name}: {TWINS[name]}" if ax is axes[0, 0] and i == 0 else None,
                )  # fmt: skip
        names = [label(f"{e['learner']} against {e['defence']}, {e['scenario']}", 34) for e in here]
        ax.set_yticks(range(len(here)), names, fontsize=8)
        ax.set_ylim(len(here) - 0.5, -0.5)
        ax.set_xlabel(axis_label(outcome, unit))
        if unit == "0/1":
            ax.set_xlim(-2, 102)
        ax.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside upper center", fontsize=8, ncols=2)
    return drawn(figure, form)


def dose_figure(report: dict[str, Any], form: str = "png") -> bytes:
    """Draw one panel per defence, one curve per attack: the measured outcomes with intervals, and the monotone regression."""
    curves = [c for c in report["curves"] if "points" in c]
    defences, attacks = (list(dict.fromkeys(c[key] for c in curves)) for key in ("defence", "attack"))
    columns = min(3, len(defences))
    rows = -(-len(defences) // columns)
    names = [label(attack, 60) for attack in attacks]
    lines = sum(1 + name.count("\n") for name in names)
    figure, axes = canvas(max(6.0, 4.2 * columns), 0.6 + 3.2 * rows + 0.22 * (lines + 1), rows, columns, sharex=True, sharey=True)
    scale = _scale(report["unit"])
    for ax, defence in zip(axes.flat, defences, strict=False):
        for curve in (c for c in curves if c["defence"] == defence):
            i = attacks.index(curve["attack"])
            points = curve["points"]
            x = np.array([p["dose"] for p in points])
            y, low, high, fit = (scale * np.array([p[key] for p in points]) for key in ("value", "low", "high", "fitted"))
            colour, line = COLOURS[i % len(COLOURS)], LINES[i % len(LINES)]
            ax.plot(x, fit, linestyle=line, linewidth=1.4, color=colour)
            ax.errorbar(
                x, y, yerr=[y - low, high - y], capsize=3, linestyle="none", markersize=5, markerfacecolor="white", color=colour,
                marker=MARKERS[i % len(MARKERS)],
            )  # fmt: skip
        if report["limit"] is not None:
            ax.axhline(scale * report["limit"], color="black", linewidth=0.8, linestyle=(0, (1, 3)))
        ax.set_title(defence, fontsize=9)
        ax.grid(alpha=0.3)
    for ax in axes.flat[len(defences) :]:
        ax.set_axis_off()
    for ax in axes[-1]:
        ax.set_xlabel("dose: budget of attack steps")
    for ax in axes[:, 0]:
        ax.set_ylabel(axis_label(report["outcome"], report["unit"], report["exceeds"]), fontsize=8)
    figure.suptitle(report["scenario"], fontsize=10)
    marks = [
        axes[0, 0].plot([], [], color=COLOURS[i % len(COLOURS)], marker=MARKERS[i % len(MARKERS)], markerfacecolor="white",
                        linestyle=LINES[i % len(LINES)])[0] for i in range(len(attacks))
    ]  # fmt: skip
    figure.legend(marks, names, loc="outside lower center", fontsize=8, handlelength=4)
    return drawn(figure, form)


def transfer_figure(report: dict[str, Any], form: str = "png") -> bytes:
    """Draw the mean outcome of what was trained on (rows, below a row without an attack) and played on (columns).

    Frames: both are the same; stars: flagged. Shades are of the logarithm where the outcome is no share.
    """
    rows, columns, share = ["(no attack)", *report["trained_on"]], report["played_on"], report["unit"] == "0/1"
    grid = np.full((len(rows), len(columns)), np.nan)
    grid[0] = [report["no_attack"].get(column, np.nan) for column in columns]
    flagged = np.zeros(grid.shape, bool)
    for entry in report["entries"]:
        at = rows.index(entry["trained_on"], 1), columns.index(entry["played_on"])
        grid[at], flagged[at] = entry["value"], bool(entry.get("flags"))
    shade = grid if share else np.log(np.maximum(grid, 1e-9))
    figure, axes = canvas(2.8 + 0.62 * len(columns), 2.4 + 0.34 * len(rows))
    ax = axes[0, 0]
    ax.set_facecolor("#dddddd")  # what was not played
    low, high = (0.0, 1.0) if share else (float(np.nanmin(shade)), float(np.nanmax(shade)) + 1e-9)
    image = ax.imshow(shade, cmap="Reds", vmin=low, vmax=high, aspect="auto")
    for (i, j), number in np.ndenumerate(grid):
        there = bool(np.isfinite(number))
        dark = there and sum(image.cmap(image.norm(shade[i, j]))[:3]) < 1.5
        text = (f"{100 * number:.0f}" if share else f"{number:.3g}") + (" *" if flagged[i, j] else "") if there else "-"
        ax.text(j, i, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
        if i and rows[i] == columns[j]:
            ax.add_patch(_frame(j, i))
    ax.axhline(0.5, color="black", linewidth=0.8)
    ax.set_xticks(range(len(columns)), [label(name, 20) for name in columns], rotation=40, ha="right", rotation_mode="anchor", fontsize=8)
    ax.set_yticks(range(len(rows)), [label(name, 24) for name in rows], fontsize=8)
    ax.set(xlabel="played on", ylabel="trained on")
    note = "framed: trained on it" + ("; *: better than what was trained on it" if flagged.any() else "")
    ax.set_title(f"{report['scenario']}: {axis_label(report['outcome'], report['unit'])}\n{note}", fontsize=9)
    return drawn(figure, form)


def _frame(column: int, row: int) -> Rectangle:
    from matplotlib import patches

    return patches.Rectangle((column - 0.47, row - 0.45), 0.94, 0.9, fill=False, edgecolor="black", linewidth=1.8)
