"""Chapter 3: challenge-response authentication of a radar, and recovery by recursive least squares."""

from __future__ import annotations

from . import ch3_cases, ch3_figures, ch3_limits, ch3_radar
from .ch4_cases import Tick
from .claims import Report

TITLE = "Chapter 3: challenge-response authentication and recovery of a radar"


def reproduce(seeds: int, tick: Tick, figures: bool) -> Report:
    """Everything of the chapter on `seeds` report seeds."""
    runs = ch3_cases.play_all(seeds, tick)
    settings = {
        "seeds": seeds,
        "steps": "300 of 1 s",
        "noise": "0.25 m and 0.1 m/s, not given in the thesis",
        "DoS": "the radar reads U(180, 250) m and U(0, 60) m/s: 'a very high value'",
        "challenges": "at 15, 50, 175 and 182 s where nothing else is said",
        "scenario (ii)": "the leader changes its acceleration at 100 s, which the thesis does not give",
    }
    out = Report("ch3", TITLE, settings)
    radar, denial = ch3_radar.report(seeds, tick)
    out.add(radar)
    out.add(ch3_cases.report(runs, seeds, tick))
    limits, curves = ch3_limits.report(seeds, tick)
    out.add(limits)
    if figures:
        tick("pictures")
        out.figures += ch3_figures.all_figures(runs, curves, denial)
    return out
