"""Chapter 7: trust by statistical model checking of the case study's automata, and of the loop that they represent."""

from __future__ import annotations

from . import ch7_automata, ch7_cost, ch7_loop, ch7_ratings, ch7_signals, ch7_trust, ch7_width
from .claims import Report, Tick

TITLE = "Chapter 7: quantifying trust by statistical model checking"


def reproduce(seeds: int, tick: Tick, figures: bool) -> Report:
    """Return everything of the chapter: half of `seeds` runs of the loop in each cell, a hundred times `seeds` of the automata."""
    tick("runs of the automata")
    runs = ch7_automata.play_all(seeds)
    settings = {
        "runs of the automata": f"{runs.many}, and the first {ch7_trust.RUNS} of them as in the thesis; up to 1000 time units",
        "automata": "figure 7.2 is not in the thesis's text: configs/automata/reactive-braking.yaml is a reading of section 7.4",
        "delays": "uniform up to an invariant, exponential of rate 1 without one, as UPPAAL SMC draws them",
        "loop": ch7_loop.ABOUT,
        "UPPAAL": "the model is exported to its format; verifyta is not part of this comparison",
        "intervals": "Clopper-Pearson, 95 %, fixed number of runs",
        "verdicts on shares": "a share that reaches its level counts for the claim, an interval below it against; `why` says where the "
        "runs are too few to decide",
        "not given in the thesis": "rates of exponential delays, which limits are invariants and which guards, when apply_break is set",
    }
    out = Report("ch7", TITLE, settings, drawn=figures)
    tick("what the queries say")
    out.add(ch7_automata.parts(runs, seeds))
    out.add(ch7_signals.parts())
    tick("intervals")
    out.add(ch7_trust.parts(runs))
    out.add(ch7_ratings.parts(runs, seeds))
    out.add(ch7_loop.parts(seeds, tick))
    tick("widths of the interval")
    out.add(ch7_width.parts(seeds))
    tick("what a run costs")
    out.add(ch7_cost.parts())
    return out
