"""Chapter 5: the norm-penalised distributed estimator on a network of agents."""

from __future__ import annotations

from . import ch5_cases, ch5_figures, ch5_theory, whole_theorems
from .claims import Report, Tick

TITLE = "Chapter 5: distributed resilient state estimation"


def reproduce(seeds: int, tick: Tick, figures: bool) -> Report:
    """Return everything of the chapter on `seeds` fresh systems: every run draws its own matrices, initial states and attacks."""
    runs = ch5_cases.play_all(seeds, tick)
    settings = {
        "runs": f"{seeds}, each with its own A, C_i, initial state and attack",
        "system": "10 agents, 20 states, 14 sensors each, no noise, x0 ~ N(0, I), estimates start at 0",
        "estimators": "Sw = Sv = I, lam = 0.4",
        "attack": "after step 20, on agents 1, 2, 3, 5, 8, 10 (here 0, 1, 2, 4, 7, 9), each at p = 0.9 a step: 700 randn on all sensors",
        "not given in the thesis": "the scale of A (here a spectral radius of 1), the size of the attack, the twelfth edge (here 4-9), "
        "how errors are normalised (here not)",
    }
    out = Report("ch5", TITLE, settings, drawn=figures)
    out.add(ch5_cases.parts(runs))
    out.add(ch5_figures.cases(runs))
    out.add(ch5_theory.parts(seeds, tick))
    tick("theorems without a figure")
    out.add(whole_theorems.chapter_5(seeds))
    return out
