"""Trust on the pages of a site: lower bounds, the closed list of attacks that they are against, and the properties that they are of."""

from __future__ import annotations

from tailgate.board.schema import LEVELS, Bound, Data, Entry, Level, Trust
from tailgate.board.words import at_least
from tailgate.evaluation.rows import CLEAN

from .suite import Suite, dose_text, figure

SPEED, ACCEL = "m/s", "m/s\N{SUPERSCRIPT TWO}"
UNITS = {
    "deadline": "s", "steps": "steps at least", "braking": ACCEL, "stands": SPEED, "detection": "steps", "false_alarms": "h apart",
    "response": "s", "accel": ACCEL, "brake": ACCEL, "lead_brake": ACCEL,
}  # fmt: skip


def trust_of(suite: Suite) -> Data | None:
    """Return the setting of all bounds of a suite; None where nobody has any."""
    head = suite.board.trust
    if head is None:
        return None
    listed = sorted((a for a in head.attacks if a.attack != CLEAN), key=lambda a: LEVELS.index(a.knowledge))
    attacks = [{"name": suite.attacks[a.attack], "knowledge": a.knowledge, "note": a.note} for a in listed]
    counts = [(level, sum(a.knowledge == level for a in listed)) for level in LEVELS]
    purpose = f" ({head.purpose})" if head.purpose else ""
    return {
        "black": _against(suite, "black"), "attacks": attacks, "listed": ", ".join(f"{n} {level} box" for level, n in counts if n),
        "alpha": figure(head.alpha), "runs": head.runs,
        "scenarios": ", ".join(head.scenarios), "doses": ", ".join(dose_text(d) for d in head.doses),
        "seeds": f"seeds of the beacon {head.beacon}{purpose}" if head.beacon else f"public seeds{purpose}",
        "properties": [{"name": _plain(p.name), "about": p.about, "safety": p.safety} for p in head.properties],
        "unsafe": _numbers(head.unsafe), "demands": _numbers(head.demands),
    }  # fmt: skip


def trust_cell(suite: Suite, entry: Entry) -> Data:
    """Return the bound of safety against black boxes in the table, and the one of all properties in its title."""
    bound = entry.trust.safety.get("black") if entry.trust else None
    if entry.trust is None or bound is None:
        return {"text": "\N{EN DASH}", "sort": "", "about": _why(suite, entry)}
    whole = entry.trust.all.get("black")
    about = [f"{bound.k} of {bound.n} runs: {_worst(suite, bound)}"]
    about += [f"all properties: {at_least(whole.lower, 1)}, {whole.k} of {whole.n} runs: {_worst(suite, whole)}"] if whole else []
    return {"text": at_least(bound.lower, 1), "sort": f"{bound.lower:.6g}", "about": "; ".join(about)}


def trust_page(suite: Suite, entry: Entry) -> Data | None:
    """Return the section of an entry: a line per conjunction and knowledge."""
    head, trust = suite.board.trust, entry.trust
    if head is None:
        return None
    groups = []
    for title, held, safety in (("Safety", trust.safety if trust else {}, True), ("All properties", trust.all if trust else {}, False)):
        rows = []
        for level in LEVELS:
            bound = held.get(level)
            row: Data = {"level": level, "text": "\N{EN DASH}", "runs": "", "attacks": "", "alpha": "", "worst": ""}
            if bound is not None:
                row |= {
                    "text": at_least(bound.lower, 1), "runs": f"{bound.k} of {bound.n}", "attacks": len(bound.attacks),
                    "alpha": f"{figure(bound.alpha)} / {bound.cells}", "worst": _worst(suite, bound),
                }  # fmt: skip
            rows.append(row)
        groups.append({"title": title, "of": _members(head, held.get("black"), safety), "rows": rows})
    return {"groups": groups, "why": _why(suite, entry)}


def _against(suite: Suite, level: Level) -> int:
    """Return how many attacks the bounds of a knowledge are against: of a bound, or where nobody has one, of the list."""
    for entry in suite.board.entries:
        for held in (entry.trust.safety, entry.trust.all) if entry.trust else ():
            if bound := held.get(level):
                return len(bound.attacks)
    allowed = LEVELS[: LEVELS.index(level) + 1]
    return sum(a.attack != CLEAN and a.knowledge in allowed for a in (suite.board.trust.attacks if suite.board.trust else ()))


def _members(head: Trust, bound: Bound | None, safety: bool) -> str:
    names = bound.of if bound else [p.name for p in head.properties if p.safety or not safety]
    return ", ".join(_plain(name) for name in names)


def _worst(suite: Suite, bound: Bound) -> str:
    place = suite.where(bound.scenario, bound.attack) if bound.attack != CLEAN else f"no attack, {bound.scenario}"
    return f"{place}, dose {dose_text(bound.dose)}"


def _why(suite: Suite, entry: Entry) -> str:
    """Return why an entry has no bound, or not all; attacks by their names, without the places of files."""
    if entry.trust is None:
        return "not among the defences that were checked"
    text = entry.trust.why
    for attack, name in suite.attacks.items():
        text = text.replace(attack, name.full) if name.policy else text
    return text or ("" if entry.trust.safety.get("black") else "nothing is defined here")


def _numbers(held: dict[str, float]) -> str:
    return ", ".join(" ".join(filter(None, (_plain(name), figure(value), UNITS.get(name, "")))) for name, value in held.items())


def _plain(name: str) -> str:
    return name.replace("_", " ")
