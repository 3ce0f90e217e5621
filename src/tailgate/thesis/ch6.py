"""Chapter 6: the lasso distributed estimator on a platoon with cooperative adaptive cruise control."""

from __future__ import annotations

from . import ch6_cases, ch6_figures, ch6_loop, whole_theorems
from .claims import Report, Tick

TITLE = "Chapter 6: resilient state estimation in a vehicle platoon"


def reproduce(seeds: int, tick: Tick, figures: bool) -> Report:
    """Return everything of the chapter on `seeds` report seeds."""
    tick("figures 6.3 to 6.5: five cars, 50 s, three sensors a car")
    runs = ch6_cases.play_all(seeds)
    settings = {
        "seeds": seeds,
        "figures": "dt = 1 s, the linear closed loop, w = (1, 1), Sigma = I, lam = 0.1, u_r known; largest |error| after 20 s",
        "denial of service": "the reading of 20 s at every hit, tau in (6.18); in closed loop the last one before the first hit",
        "closed loop": f"{ch6_loop.SCENARIO}: dt = 0.1 s, 55 s, controllers on the estimates, u_r unknown to the followers, lam = 5",
        "not given in the thesis": "the gains kp = 0.5 and kd = 1, the initial gaps 65 + 5 randn m, the leader's input, the attack's size",
    }
    out = Report("ch6", TITLE, settings, drawn=figures)
    out.add(ch6_cases.parts(runs, seeds, tick))
    out.add(ch6_figures.cases(runs))
    out.add(ch6_loop.parts(seeds, tick))
    tick("theorems without a figure")
    out.add(whole_theorems.chapter_6(seeds))
    return out
