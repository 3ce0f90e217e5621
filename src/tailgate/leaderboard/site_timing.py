"""What the pages of a board say of the timing of its trained attackers."""

from __future__ import annotations

from .build import names_of, percent
from .site_suite import Data, dose_text
from .timing import Timing

TIMES = (  # as the twins of tailgate.strength.timing
    "its own times", "those of another of its episodes (yoked)", "as many steps at random (shuffled)", "as many, evenly spread (periodic)",
)  # fmt: skip


def timed_of(timing: Timing | None, defence: str) -> Data | None:
    """An entry's figures, or why there are none; None where nobody has looked."""
    if timing is None:
        return None
    if (found := next((entry for entry in timing.entries if entry.defence == defence), None)) is None:
        why = next((entry.why for entry in timing.without if entry.defence == defence), "")
        return {"why": why} if why else None
    shares, gain = (found.own, found.yoked, found.shuffled, found.periodic), found.advantage
    return {
        "why": "", "attack": names_of([found.attack])[found.attack], "knowledge": found.knowledge, "where": found.scenario,
        "dose": dose_text(found.dose), "episodes": timing.episodes,
        "gain": f"{100 * gain.value:+.0f}", "span": f"{100 * gain.low:.0f} to {100 * gain.high:.0f}",
        "rows": [
            {"name": words, "text": percent(share.value), "span": f"{percent(share.low)} to {percent(share.high)}"}
            for words, share in zip(TIMES, shares, strict=True)
        ],
    }  # fmt: skip


def flags_of(timing: Timing | None, defence: str) -> list[str]:
    """What its schedule says against the worth of an entry's attacker."""
    found = [entry for entry in timing.entries if entry.defence == defence and entry.flagged] if timing else []
    told = "does not surely do more at its own times than at those of another of its episodes"
    return [f"yoked equals own: {names_of([entry.attack])[entry.attack].full} on {entry.scenario} {told}" for entry in found]
