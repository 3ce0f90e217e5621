"""Figure 7.2 of the thesis, and what its queries depend on."""

from __future__ import annotations

from tailgate.base.plots import canvas, png
from tailgate.trust.automata import load_network
from tailgate.trust.automata_figures import automata_figure
from tailgate.trust.taint import one_hop

from .ch7_automata import DEADLINES, LIMITS, NETWORK, Curves
from .ch7_trust import THESIS
from .claims import Figure

STYLES = (("-", "#0072B2"), ("--", "#D55E00"), ("-.", "#009E73"), (":", "#CC79A7"))
PANELS = (("Intermediate", 100.0, "obs = 1 (the command)"), ("braking", 500.0, "apply_break = 1 (the brake)"))


def all_figures(curves: Curves) -> list[Figure]:
    network = load_network(NETWORK)
    picture = png(automata_figure(network, one_hop(network)))
    caption = "Figure 7.2 again, as read from section 7.4. Thick: where it begins; dashed: signals that table 7.1 does not trust."
    return [Figure("figure-7-2", caption, picture), _queries(curves)]


def _queries(curves: Curves) -> Figure:
    figure, axes = canvas(10.0, 4.2, 1, 2, sharey=True)
    for ax, (where, deadline, words) in zip(axes[0], PANELS, strict=True):
        for limit, (style, colour) in zip(LIMITS[where], STYLES, strict=True):
            ax.plot(DEADLINES, curves[where, limit], linestyle=style, color=colour, label=f"{where} <= {limit:g}")
        ax.axvline(deadline, color="#5a5a5a", linewidth=1.0)
        ax.axhspan(*THESIS, color="#F0C000", alpha=0.25, linewidth=0)
        ax.text(deadline, 0.02, f" thesis: {deadline:g}", fontsize=8)
        ax.set(xlabel="deadline [time units]", title=f"{words} before the deadline")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8, loc="lower right")
    axes[0, 0].set(ylabel="share of runs", ylim=(-0.02, 1.04))
    caption = (
        "The answer to a query is what its deadline and the location's limit make it. Band: the thesis's interval; line: its deadline; "
        "the thesis's limits are 100 and 500."
    )
    return Figure("figure-queries", caption, png(figure))
