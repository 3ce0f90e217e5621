"""Figure 7.2 of the thesis, and what its queries depend on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tailgate.base.plots import canvas
from tailgate.core import Array
from tailgate.trust.automata import Network
from tailgate.trust.automata_figures import automata_figure
from tailgate.trust.taint import one_hop

from .ch7_trust import THESIS
from .figures import BAND, COLOURS, Picture, panel

LINES = ("-", "--", "-.", ":")
PANELS = (("Intermediate", 100.0, "obs = 1 (the command)"), ("braking", 500.0, "apply_break = 1 (the brake)"))


def automata(network: Network) -> Picture:
    """Draw the automata, with the signals that nobody should trust."""
    return automata_figure(network, one_hop(network))


def queries(deadlines: Array, limits: Mapping[str, Sequence[float]], curves: Mapping[tuple[str, float], Array]) -> Picture:
    """Draw the share of runs by deadline, by the location whose limit is varied."""
    figure, axes = canvas(10.0, 4.2, 1, 2, sharey=True)
    for ax, (where, deadline, words) in zip(axes[0], PANELS, strict=True):
        for limit, style, colour in zip(limits[where], LINES, COLOURS, strict=False):
            ax.plot(deadlines, curves[where, limit], linestyle=style, color=colour, label=f"{where} <= {limit:g}")
        ax.axvline(deadline, color="#5a5a5a", linewidth=1.0)
        ax.axhspan(*THESIS, color=BAND, alpha=0.25, linewidth=0)
        ax.text(deadline, 0.02, f" thesis: {deadline:g}", fontsize=8)
        panel(ax, None, xlabel="deadline [time units]", title=f"{words} before the deadline")
        ax.legend(fontsize=8, loc="lower right")
    axes[0, 0].set(ylabel="share of runs", ylim=(-0.02, 1.04))
    return figure
