"""Chapter 3: challenge-response authentication of a radar, and recovery by recursive least squares."""

from __future__ import annotations

from . import ch3_cases, ch3_figures, ch3_limits, ch3_radar
from .claims import Report, Tick

TITLE = "Chapter 3: challenge-response authentication and recovery of a radar"


def reproduce(seeds: int, tick: Tick, figures: bool) -> Report:
    """Return everything of the chapter on `seeds` report seeds."""
    runs = ch3_cases.play_all(seeds, tick)
    settings = {
        "seeds": seeds,
        "steps": "300 of 1 s",
        "noise": "0.25 m and 0.1 m/s, not given in the thesis",
        "DoS": "the radar reads U(180, 250) m and U(0, 60) m/s: 'a very high value'",
        "challenges": "at 15, 50, 175 and 182 s where nothing else is said",
        "scenario (ii)": "the leader changes its acceleration at 100 s, which the thesis does not give",
    }
    out = Report("ch3", TITLE, settings, drawn=figures)
    tick("the radar's signal")
    *radar, jammer = ch3_radar.parts(seeds)
    out.add(radar)
    out.add(ch3_cases.parts(runs, seeds, tick))
    out.add(ch3_figures.cases(runs))
    out.add(ch3_limits.parts(seeds, tick))
    out.add([jammer])
    return out
