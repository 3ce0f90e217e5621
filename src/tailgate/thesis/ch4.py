"""Chapter 4: the chi-square gated Bayesian Kalman filter against the Kalman filter and the robust Kalman filter."""

from __future__ import annotations

from . import ch4_cases, ch4_figures, ch4_safety, ch4_theory
from .ch4_cases import READINGS
from .claims import Report, Tick

TITLE = "Chapter 4: attack-resilient state estimation with a chi-square gate"


def reproduce(seeds: int, tick: Tick, figures: bool) -> Report:
    """Return everything of the chapter on `seeds` report seeds."""
    runs = ch4_cases.play_all(seeds, tick)
    settings = {
        "seeds": seeds, "steps": 150,
        "attack values": "not given in the thesis: FDI U(0, 77), DoS U(-108, 108), on position and velocity, at the thesis's steps",
        "readings": {r.name: r.about for r in READINGS},
        "standstill": "at v = 0 a car of the corrected plant neither rolls back nor slows down, so that other noise moves it than is "
        "drawn; a table says what it comes to, and what Algorithm 3 errs where a car may roll back",
        "robust KF, lam [1/m] tuned on other attacks and seeds": {r.name: round(r.lam, 4) for r in READINGS},
    }  # fmt: skip
    out = Report("ch4", TITLE, settings, drawn=figures)
    out.add(ch4_cases.parts(runs))
    out.add(ch4_figures.cases(runs))
    out.add(ch4_theory.parts(seeds, tick))
    out.add(ch4_safety.parts(seeds, tick))
    return out
