"""Timing of trained attackers on the pages of a board."""

from __future__ import annotations

from tailgate.board.attachments import Timing
from tailgate.board.schema import Data
from tailgate.board.words import names_of, percent

from .suite import dose_text

TIMES = (  # as the twins of tailgate.studies.timing
    "its own times", "those of another of its episodes (yoked)", "as many steps at random (shuffled)", "as many, evenly spread (periodic)",
)  # fmt: skip
VERDICTS = {
    "more": "At its own times it surely does more", "equal": "At its own times it does less than 10 points more (95 %, this entry alone)",
    "unknown": "It is undecided if it does more at its own times",
}  # fmt: skip


def timed_of(timing: Timing | None, defence: str) -> Data | None:
    """Return an entry's figures, or why there are none; None where nobody has looked."""
    if timing is None:
        return None
    if (found := next((entry for entry in timing.entries if entry.defence == defence), None)) is None:
        why = next((entry.why for entry in timing.without if entry.defence == defence), "")
        return {"why": why} if why else None
    shares, gain = (found.own, found.yoked, found.shuffled, found.periodic), found.advantage
    return {
        "why": "", "attack": names_of([found.attack])[found.attack], "knowledge": found.knowledge, "where": found.scenario,
        "dose": dose_text(found.dose), "episodes": found.episodes, "verdict": VERDICTS[found.verdict], "alike": found.schedules == 1,
        "gain": points(gain.value), "span": f"{points(gain.low)} to {points(gain.high)}", "p": f"{gain.adjusted:.2g}",
        "most": percent(found.most) if found.most > found.board else "", "board": percent(found.board),
        "rows": [
            {"name": words, "text": percent(share.value), "span": f"{percent(share.low)} to {percent(share.high)}"}
            for words, share in zip(TIMES, shares, strict=True)
        ],
    }  # fmt: skip


def points(change: float) -> str:
    """Return a change of a share in points, with its sign."""
    text = f"{100 * change:+.0f}"
    return "0" if text in ("+0", "-0") else text.replace("-", "\N{MINUS SIGN}")


def flags_of(timing: Timing | None, defence: str) -> list[str]:
    """Return flags of an entry whose attacker gains nothing by its schedule."""
    out = []
    for entry in (entry for entry in timing.entries if entry.defence == defence) if timing else ():
        who = f"{names_of([entry.attack])[entry.attack].full} on {entry.scenario}"
        if entry.verdict == "equal":
            out.append(f"yoked equals own: {who} does less than 10 points more at its own times than at another episode's (95 %)")
        if entry.outdone:
            out.append(f"outdone by its twins: {who} surely does less at its own times than at random or evenly spread ones")
    return out
