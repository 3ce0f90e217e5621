"""A board with the words for it: names as people read them, doses, and figures as the pages of a site show them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from tailgate.board.order import sort_dose
from tailgate.board.schema import LEVELS, Board, CellLine, Data, Dose, Entry, Interval, Level, Limited
from tailgate.board.words import Name, at_least, names_of, percent, shade
from tailgate.core.scenario import list_scenarios, load_scenario

from .charts import Axis

SPREAD = 16  # ratio of the largest dose to the smallest above which doses are drawn on a logarithmic axis at first


def figure(value: float | None, digits: int = 4) -> str:
    """Return a number, short; an en dash for none."""
    if value is None:
        return "\N{EN DASH}"
    text = f"{value:.6f}".rstrip("0") if 1e-5 <= abs(value) < 1e-3 else f"{value:.{digits}g}"
    return text.replace("-", "\N{MINUS SIGN}")


def dose_text(dose: Dose) -> str:
    """Return a dose as text; None is the budget of the scenario."""
    return "the scenario's own" if dose is None else str(dose)


@dataclass
class Suite:
    """A board and the words for it: names as people read them, the doses, and where each entry's page is."""

    board: Board
    folder: str
    pages: dict[str, str] = field(default_factory=dict)  # defence: path of its page from index.html
    defences: dict[str, Name] = field(init=False)
    attacks: dict[str, Name] = field(init=False)

    def __post_init__(self) -> None:
        b = self.board
        taught = [a.trained_on for a in b.attacks if a.trained_on]
        self.defences = names_of(dict.fromkeys([*(e.defence for e in b.entries), *(line.defence for line in b.detected()), *taught]))
        worst = [w.attack for e in b.entries for c in (*e.critical_dose.values(), *e.rates) if c and (w := c.worst)]
        points = [p.attack for c in b.curves for p in c.points]
        robust = [r.worst.attack for e in b.entries for r in e.robustness if r.worst]
        heard = [line.attack for line in b.detected()]
        own = [*(a.attack for a in b.attacks), *(c.attack for c in b.cells)]
        trusted = [a.attack for a in b.trust.attacks] if b.trust else []
        self.attacks = names_of(dict.fromkeys([*own, *worst, *points, *heard, *robust, *trusted]))

    def harmless(self, defence: str, level: Level) -> bool:
        """Return if no attack that knows at most this did damage to a defence, at any dose and in any scenario."""
        known = LEVELS[: LEVELS.index(level) + 1]
        mine = [c.damage.value for c in self.board.cells_of(defence) if c.knowledge in known and not c.optimal and c.damage]
        return bool(mine) and not any(mine)

    @property
    def largest(self) -> int | None:
        return max((d for d in self.board.suite.doses if d is not None), default=None)

    @property
    def shown(self) -> list[Dose]:
        """Return the doses with a column in the headline table: those that the suite gives a reason for, else up to three."""
        doses = self.board.suite.doses
        named = [d for d in doses if str(d) in self.board.suite.shown]
        return named or sorted({doses[0], doses[len(doses) // 2], doses[-1]}, key=doses.index)

    @property
    def middle(self) -> Dose:
        return self.shown[len(self.shown) // 2]

    @property
    def scale(self) -> str:
        numbers = [d for d in self.board.suite.doses if d]
        return "log" if numbers and max(numbers) > SPREAD * min(numbers) else "linear"

    @property
    def damage(self) -> str:
        bound = self.board.suite.bound
        if bound is not None:
            return f"an error above {figure(bound)}"
        share = self.board.suite.progress
        less = "" if share is None else f", or less than {percent(share)} of the distance without an attack"
        names = [scenario.name for scenario in self.board.suite.scenarios]
        in_lane = all(name in list_scenarios() and load_scenario(name).brief().model.lane for name in names)
        return f"{'the lane is left' if in_lane else 'a collision, in front or behind'}{less}"

    @property
    def places(self) -> list[float]:
        """Return doses with a tick on the axis of the curves, which may begin without an attack."""
        doses = [*self.board.suite.doses, *(p.dose for c in self.board.curves for p in c.points)]
        return sorted({float(d) for d in doses if d is not None})

    def axis(self, scale: str) -> Axis:
        places = self.places or [0.0]
        return Axis(0.0 if scale == "linear" else places[0], places[-1], scale)

    @property
    def round(self) -> str:
        """Return whose seeds the episodes are of; empty where the board does not say."""
        beacon = self.board.suite.beacon
        return "" if beacon is None else f"seeds of the beacon {beacon}" if beacon else "public seeds: for development"

    def where(self, scenario: str, attack: str) -> str:
        name = self.attacks[attack].full if attack in self.attacks else attack
        return f"{name}, {scenario}" if scenario else name


def critical_of(suite: Suite, entry: Entry, level: Level) -> Data:
    """Return an entry's critical dose in words, and its interval as places on the dose axis."""
    critical = entry.critical_dose.get(level)
    if critical is None:
        met = any(c.knowledge == level for c in suite.board.cells if c.defence == entry.defence)
        why = "not every attack of this knowledge has full figures" if met else "no attack that knows just this was met"
        return {"text": "\N{EN DASH}", "sort": "", "span": "", "bar": None, "worst": "", "about": why}
    largest = suite.largest
    least = min((d for d in suite.board.suite.doses if d), default=0)
    beyond = "not reached" if largest is None else f"> {largest}"
    axis = Axis(0.0, float(largest or 1), suite.scale)

    def words(x: float | None) -> str:
        return beyond if x is None else f"\N{LESS-THAN OR EQUAL TO} {least:g}" if 0 < x <= least else figure(x, 3)

    def at(x: float | None) -> float:
        return 100.0 if x is None else min(max(axis.at(x), 0.0), 100.0)

    span = "" if critical.low is None else f"{words(critical.low)} to {words(critical.high)}"
    clean = critical.value == 0.0  # then no attack is to blame
    harmless = suite.harmless(entry.defence, level)
    worst = suite.where(critical.worst.scenario, critical.worst.attack) if critical.worst and not clean and not harmless else ""
    bar = {"low": at(critical.low), "x": at(critical.value), "high": at(critical.high), "beyond": critical.value is None}
    about = ["damage without any attack"] * clean + ["no attack that knows at most this did damage"] * harmless
    about += [f"{percent(1 - suite.board.suite.alpha)} interval {span}"] * bool(span) + [f"worst: {worst}"] * bool(worst)
    sort = sort_dose(critical)
    return {
        "text": words(critical.value), "sort": "Infinity" if sort == math.inf else f"{sort:.6g}", "span": span, "bar": bar, "worst": worst,
        "about": "; ".join(about),
    }  # fmt: skip


def interval_of(held: Interval | None) -> Data:
    """Return a share of damaged or detected episodes, and its interval."""
    if held is None:
        return {"text": "n/a", "sort": "", "span": ""}
    return {"text": percent(held.value), "sort": f"{held.value:.6g}", "span": f"{percent(held.low)} to {percent(held.high)}"}


def share_of(share: Limited | float | None) -> Data:
    """Return a share and its lower limit, if it has one."""
    if share is None:
        return {"text": "\N{EN DASH}", "low": "", "sort": ""}
    if isinstance(share, float | int):
        return {"text": percent(share), "low": "", "sort": share}
    return {"text": percent(share.value), "low": at_least(share.low), "sort": f"{share.value:.6g}"}


def gates_of(entry: Entry) -> Data:
    """Return how many gates an entry passes, which ones it fails, and a value to sort by."""
    failed = [g for g in entry.gates if not g.passed]
    names = ", ".join(dict.fromkeys(g.gate.replace("_", " ") for g in failed))
    if not entry.gates:
        return {"text": "\N{EN DASH}", "failed": "", "sort": ""}
    return {"text": f"{len(entry.gates) - len(failed)} of {len(entry.gates)}", "failed": names, "sort": len(failed)}


def cell_of(cell: CellLine | None, limit: float) -> Data:
    """Return a cell of the heat map: its text, its shade, and the words for those who do not see it."""
    if cell is None or cell.damage is None:
        what = "not played" if cell is None or not (cell.reason or cell.failed) else "failed" if cell.failed else "skipped"
        why = ": ".join(filter(None, (what, cell.reason if cell else "")))
        return {"text": "n/a", "shade": "na", "label": why, "over": False, "lost": False}
    damage = cell.damage
    label = f"{percent(round(damage.low, 4))} to {percent(round(damage.high, 4))}, {cell.n} episodes"
    if cell.failed:
        label += f"; {cell.failed} more failed: {cell.reason}"
    over = damage.value > limit
    return {"text": percent(damage.value), "shade": shade(damage.value), "label": label, "over": over, "lost": cell.failed > 0}


def worse(cells: Iterable[CellLine | None]) -> CellLine | None:
    """Return the cell with the most damage; of equal ones the first. One without figures only where no other is."""
    there = [c for c in cells if c is not None]
    known = [c for c in there if c.damage is not None]
    return max(known, key=lambda c: c.damage.value if c.damage else 0.0) if known else next(iter(there), None)


def played(there: int, equal: int, differs: int, unchecked: int, noun: str) -> str:
    """Return the result of playing rows or cells again, in words."""
    again = equal + differs
    said = f"{again} of {there} {noun}" if again < there else f"all {there} {noun}"
    said += f", {differs} of them differ" if differs else ", all equal" if equal else ""
    return said + (f"; {unchecked} could not be played" if unchecked else "")
