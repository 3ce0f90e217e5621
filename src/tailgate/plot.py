"""Figures of rows and traces, for notebooks and papers; they need matplotlib (extra `viz`).

Each function returns a matplotlib figure, without pyplot's global state: `figure.savefig("name.pdf")`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.plots import MARKERS, canvas, matrix_figure, scatter_figure
from tailgate.base.pytree import Array
from tailgate.core.kinds import Kind
from tailgate.evaluation.rows import Row
from tailgate.evaluation.summary import summarise
from tailgate.play.trace import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["dose_response", "episode", "error_against_gap", "matrices"]


def matrices(rows: Sequence[Row], title: str = "") -> Figure:
    """Return matrices of defences by attacks: position error, smallest gap, collisions; without a road, state errors.

    Parameters
    ----------
    rows
        Of one scenario at one dose.

    Raises
    ------
    InputError
        For rows of several scenarios or doses, and where nothing was played.
    """
    table = [entry for entry in summarise(rows) if entry["crash"] is not None]
    places = {(entry["scenario"], entry["dose"]) for entry in table}
    if not places:
        raise InputError("rows", "none that were played", "rows of one scenario at one dose")
    if len(places) != 1:
        raise InputError("rows", f"{len(places)} scenarios and doses", "rows of one scenario at one dose")
    _single(table)
    return matrix_figure(table, title)


def _single(table: Sequence[Row]) -> None:
    """Raise InputError for two entries of one place, dose, defence and attack: of two versions, purposes or knowledges."""
    seen = set()
    for entry in table:
        key = entry["scenario"], entry["dose"], entry["defence"], entry["attack"]
        if key in seen:
            raise InputError("rows", f"{entry['defence']} against {entry['attack']} twice", "rows of one version, purpose and knowledge")
        seen.add(key)


def error_against_gap(rows: Sequence[Row]) -> Figure:
    """Return position error against smallest gap, a mark for each cell; filled marks are cells where most episodes collide.

    Raises
    ------
    InputError
        For rows without a road.
    """
    table = [entry for entry in summarise(rows) if entry["crash"] is not None and entry["min_gap"]]
    if not table:
        raise InputError("rows", f"{len(rows)} rows", "at least one episode on a road")
    return scatter_figure(table)


def dose_response(rows: Sequence[Row]) -> Figure:
    """Return the share of episodes with a collision [%] over the dose [steps], with 95 % intervals, a line for each defence and attack.

    Raises
    ------
    InputError
        For rows without a dose.
    """
    table = [entry for entry in summarise(rows) if entry["crash"] is not None and entry["dose"] is not None]
    if not table:
        raise InputError("rows", f"{len(rows)} rows", "rows with doses in steps")
    _single(table)
    names = list(dict.fromkeys((entry["scenario"], entry["defence"], entry["attack"]) for entry in table))
    figure, axes = canvas(7.0, 4.2)
    for i, name in enumerate(names):
        mine = sorted((e for e in table if (e["scenario"], e["defence"], e["attack"]) == name), key=lambda entry: int(entry["dose"]))
        doses = [entry["dose"] for entry in mine]
        value, low, high = (100.0 * np.array([entry["crash"][key] for entry in mine]) for key in ("value", "low", "high"))
        label = ", ".join(part for k, part in enumerate(name) if len({other[k] for other in names}) > 1) or name[1]
        axes[0, 0].errorbar(doses, value, [value - low, high - value], marker=MARKERS[i % len(MARKERS)], capsize=3, label=label)
    axes[0, 0].set(xlabel="dose [attacked steps]", ylabel="episodes with a collision [%]", ylim=(-2.0, 102.0))
    axes[0, 0].legend(fontsize=8)
    return figure


def _runs(mask: Array) -> list[tuple[int, int]]:
    """Return the first and the last place of each run of true values of a mask (K,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]])))
    return [(int(first), int(last) - 1) for first, last in edges.reshape(-1, 2)]


def episode(trace: Trace, row: int = 0, agent: int = 0) -> Figure:
    """Return the true and the believed gap [m], or the norm of the estimate's error, over time; attacked and alarmed steps are marked.

    Parameters
    ----------
    trace
        Of `tailgate.play.trace.rollout`.
    row, agent
        The episode of the trace, and the agent.

    Raises
    ------
    InputError
        For a row or an agent that the trace has not.
    """
    for name, value, count in (("row", row, trace.batch), ("agent", agent, trace.model.agents)):
        if not 0 <= value < count:
            raise InputError(name, value, f"a whole number from 0 to {count - 1}")
    steps = slice(0, int(trace.length[row]))
    time = trace.dt * np.arange(1, steps.stop + 1)
    figure, axes = canvas(8.0, 3.4)
    ax = axes[0, 0]
    error = trace.model.gap_error(trace.estimate[steps, row], trace.truth[steps, row])
    if trace.model.followers[agent]:
        before = np.concatenate([trace.first["gap"][None, row], trace.gap[steps, row]])[: steps.stop, agent]
        ax.plot(time - trace.dt, before, "-", color="black", label="gap")
        ax.plot(time - trace.dt, before + error[:, agent], "--", color="C0", label="believed gap")
        ax.set_ylabel("[m]")
    else:
        off = trace.model.error(trace.estimate[steps, row], trace.truth[steps, row])[:, agent]
        ax.plot(time, off, "-", color="black", label="error of the estimate (2-norm)")
    hit, alarm = trace.kind[steps, row] != Kind.NONE, trace.alarm[steps, row, agent]
    for i, (first, last) in enumerate(_runs(hit)):
        ax.axvspan(trace.dt * first, trace.dt * (last + 1), color="0.85", label="" if i else "attack")
    if alarm.any():
        ax.plot(time[alarm], np.zeros(int(alarm.sum())), "|", color="C3", label="alarm", transform=ax.get_xaxis_transform())
    ax.set(xlabel="time [s]")
    ax.legend(fontsize=8)
    return figure
