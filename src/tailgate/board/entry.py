"""An entry of a board: a defence's figures from its rows, and if it takes a rank."""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence

import numpy as np

from tailgate.core.registry import Entry, Family, Spec, built_in
from tailgate.core.scenario import Suite
from tailgate.core.spec_text import split_text
from tailgate.evaluation.paired import class_of
from tailgate.evaluation.rounds import numbered
from tailgate.evaluation.rows import CLEAN, Row
from tailgate.training.adaptive import Asked, plan_of

from .damage import PLAYED, Key, Table, doses_of, has_road, named
from .flags import flags, of_attacks, standing
from .gates import failure, gates
from .measures import extended as later
from .measures import mean_gap, pointwise, under_attack
from .schema import Data
from .searched import found_for, unsearched
from .worst import Worst

CLEAN_METRICS = (
    "time_gap_inflation", "rms_jerk", "distance_travelled", "max_decel", "min_gap", "rmse_position", "rmse_velocity", "max_error",
    "alarm_rate", "alarm_onsets", "muted_steps",
)  # fmt: skip
CLAIMED = "claimed"  # how the reason begins of an entry whose figures nobody but its author has seen come about
PROVISIONAL = "provisional"  # how it begins of one that its author ranks for a look
Levels = dict[str, dict[str, Worst]]  # by defence and knowledge


def middle(suite: Suite) -> int:
    """Return the index of the middle one of the doses that are shown; of all where none is named."""
    chosen = shown(suite)
    return chosen[len(chosen) // 2]

def shown(suite: Suite) -> list[int]:
    """Return indices of the doses that rates are shown at."""
    doses = doses_of(suite)
    return [i for i, dose in enumerate(doses) if dose in suite.shown] or list(range(len(doses)))


def entry_of(
    table: Table, defence: str, levels: dict[str, Worst], dose: int, origins: dict[str, Row], trained: dict[str, str],
    asked: list[Asked] | None, searches: Sequence[Data], provisional: Collection[str] = (),
) -> Data:  # fmt: skip
    """Return the entry of a defence that is made of rows: status, gates, flags, worst episode and figures.

    origins: how each learned attack was trained. trained: the defence that an attack was made against. asked: the suite's trainings; None
    where a rank asks for no attack of this kind. searches: the results of the standard ensemble. provisional: defences that are ranked
    although nobody but their author has played them.
    """
    rows = [row for key in sorted(table.cells) if key.defence == defence for row in table.cells[key]]
    uses = [str(use) for use in rows[0]["uses"]]
    card = _card(defence)
    found = gates(table, defence)
    why = reference(defence, uses, card) or failure(found) or _incomplete(table, levels["black"])
    status = "unranked" if why else "ranked"
    if not why and asked is not None and (short := _draft(table)):
        status, why = "unranked", short
    if not why and card is None and (how := _claimed(rows)) and defence not in provisional:
        status, why = "unranked", how
    if not why and asked is not None and (missing := _unmet(table, defence, origins, asked, searches)):
        status, why = "unattacked", missing
    if not why and defence in provisional:
        why = f"{PROVISIONAL}: tried outside a round"
    whole = {k: worst for k, worst in levels.items() if worst.complete}
    found_by_search = found_for(searches)
    own = {attack: origin for attack, origin in origins.items() if attack not in found_by_search}  # searches are no trainings of one plan
    return {
        "defence": defence, "card": None if card is None else card.card(), "uses": uses, "class": class_of(uses),
        "status": status, "why": why, "gates": found, "rank": None, "clean": _clean(table, defence),
        "flags": flags(table, defence, levels, dose, own, trained), "worst_episode": _episode(table, whole, dose), "stealth": None,
    } | of_worst(table, levels, dose) | (_measures(table, defence, whole) if table.suite.measures else {})  # fmt: skip


def _measures(table: Table, defence: str, whole: dict[str, Worst]) -> Data:
    """Return the measures of an entry that need rows: by dose and knowledge, and its mean gap without an attack."""
    lines = (under_attack(worst, at) for at in shown(table.suite) for worst in whole.values())
    return {"under_attack": [line for line in lines if line is not None], "mean_gap": mean_gap(table, defence)}


def extended(entry: Data, table: Table, levels: dict[str, Worst], dose: int, trained: dict[str, str], added: Collection[str]) -> Data:
    """Return an entry of a board with more attacks, which have rows: shares of damage, status, flags and worst episode.

    Its clean runs, its gates and the suite's trainings that it met stay as they are. So does everything that needs the rows of attacks
    that it had met. trained: the defence that each learned attack was trained on.
    """
    out = entry | of_worst(table, levels, dose)
    if entry["status"] != "unranked" and (why := _incomplete(table, levels["black"])):
        out |= {"status": "unranked", "why": why, "rank": None}
    whole, old = {k: worst for k, worst in levels.items() if worst.complete}, entry["worst_episode"]
    hit = next(((worst, at) for at in (dose, *shown(table.suite)) for worst in whole.values() if worst.at(at)[1] > 0.0), None)
    if hit is None:
        new = _episode(table, whole, dose)
        out["worst_episode"] = min((row for row in (old, new) if row is not None), key=_margin, default=None)
    elif hit[0].named(hit[0].at(hit[1])[0])["attack"] in added:
        out["worst_episode"] = _episode(table, whole, dose)
    if table.suite.measures:
        lines = (later(entry["under_attack"], worst, at, added) for at in shown(table.suite) for worst in whole.values())
        out["under_attack"] = [line for line in lines if line is not None]
    own = any(trained.get(attack) == entry["defence"] for attack in added)
    said = of_attacks(table, entry["defence"], levels, dose, trained)
    return out | {"flags": [*dict.fromkeys([*standing(entry["flags"], levels, dose, added, own), *said])]}


def of_worst(table: Table, levels: dict[str, Worst], dose: int) -> Data:
    """Return the figures of an entry that are shares of damage: critical doses, rates and robustness."""
    whole = {k: worst for k, worst in levels.items() if worst.complete}
    critical: dict[tuple[tuple[str, int], ...], Data | None] = {}
    for worst in whole.values():
        if tuple(worst.pairs) not in critical:  # of classes with the same attacks once
            critical[tuple(worst.pairs)] = worst.critical()
    return {
        "critical_dose": {k: critical[tuple(worst.pairs)] if k in whole else None for k, worst in levels.items()},
        "rates": [worst.rate(s) for s in shown(table.suite) for worst in whole.values()],
        "robustness": _robustness(table, whole.get("black"), dose),
    } | ({"pointwise": [pointwise(worst, s) for s in shown(table.suite) for worst in whole.values()]} if table.suite.measures else {})


def curves(levels: dict[str, Worst]) -> list[Data]:
    """Return dose-response curves of an entry, by knowledge."""
    return [worst.curve() for worst in levels.values() if worst.complete and worst.numbers]


def _card(defence: str) -> Entry | None:
    """Return the card of a built-in defence. What runs somebody else's code has none, as a board must not import what a row names."""
    named = Spec("defence", defence).named()
    return None if any(name not in registered(family) for family, name in named) else registered("defence")[named[0][1]]


@functools.cache
def registered(family: Family) -> dict[str, Entry]:
    """Return the built-in components of a family."""
    return built_in(family)


def reference(defence: str, uses: Collection[str], card: Entry | None) -> str:
    """Return why a defence takes no rank whatever it does; empty where it may."""
    if split_text(defence)[0] == CLEAN:
        return "baseline: no defence"
    if "truth" in uses:
        return "reference: is told what is attacked"
    return f"sentinel: useless by design ({card.sentinel})" if card is not None and card.sentinel else ""


def _incomplete(table: Table, worst: Worst) -> str:
    """Return which figures are missing: else a defence would gain by failing, or by not being attackable, where it is weak."""
    if worst.complete:
        return ""
    if not worst.pairs:
        return "incomplete: no attack was played"
    name, i = worst.lost[0]
    index = table.defences.index(worst.defence)
    dose = int(np.argmax(table.state[name][index, i] != PLAYED))
    key = Key(name, dose, worst.defence, table.attackers[i])
    reason = next((row["reason"] for row in table.cells.get(key, ()) if row["status"] != "ok"), "not played")
    attacks = len({i for _, i in worst.lost})
    return f"incomplete: {attacks} {'attack' if attacks == 1 else 'attacks'} without full figures, first {named(key)}: {reason}"


def _draft(table: Table) -> str:
    """Return why rows are too few, or of seeds that anybody may tune on; empty where they are not."""
    fewest = min(len(seeds) for seeds in table.seeds.values())
    if table.purpose != "report":
        return f"draft: seeds of the purpose {table.purpose}"
    if fewest < table.suite.seeds:
        return f"draft: {fewest} of {table.suite.seeds} episodes"
    for name, seeds in table.seeds.items():
        if set(seeds) != set(numbered(table.beacon, table.suite.name, table.purpose, 0, len(seeds))):
            whose = f"the beacon {table.beacon}" if table.beacon else "the suite, 0, 1, 2, ..."
            return f"draft: the episodes on {name} are not the first ones of {whose}"
    return ""


def _claimed(rows: list[Row]) -> str:
    """Return why rows of somebody else's class count for nothing yet: its author could have tuned on the episodes, or run it free."""
    if not all((row.get("submission") or {}).get("sandbox") for row in rows):
        return f"{CLAIMED}: not played by leaderboard submit in a sandbox"
    return "" if all(row.get("beacon") for row in rows) else f"{CLAIMED}: played on public seeds"


def _unmet(table: Table, defence: str, origins: dict[str, Row], asked: list[Asked], searches: Sequence[Data]) -> str:
    """Return the suite's own searches and trainings against a defence that are missing; empty where none is.

    asked: every scenario that is trained on, learner, knowledge and training seed of a suite with a plan (`adaptive`). Each has to be
    trained as the plan says, against these very files and this version of the defence, and played wherever the policy fits. A suite without
    a plan asks for nothing: any policy will do that was trained against the defence and played everywhere. The policies' files say all
    this.
    """
    index = table.defences.index(defence)
    row = next(rows[0] for key, rows in table.cells.items() if key.defence == defence)
    plan = plan_of(table.suite) if table.suite.adaptive else None
    if plan is not None and plan.ensemble and (missing := unsearched(table, row, searches, plan)):
        return missing
    if plan is not None and not plan.learners:
        return ""
    own = defence, row["defence_digest"], row.get("versions", {}).get("defence", 1)
    met = [
        (origins[attacker.attack], {name for name in table.scenarios if (table.state[name][index, i] == PLAYED).all()})
        for i, attacker in enumerate(table.attackers)
        if attacker.attack in origins and attacker.attack not in table.withdrawn
        and tuple(origins[attacker.attack].get(key, 1) for key in ("defence", "digest", "version")) == own
    ]  # fmt: skip
    if not asked:
        met = [(origin, played) for origin, played in met if played == set(table.scenarios)]
    if not any(played for _, played in met):
        return "no attack that was trained against this defence is among the rows"
    if not asked:
        return ""
    found = {(origin["plan"], origin["seed"]): played for origin, played in met}
    left = [f"{name} seed {seed}" for name, plan, seed, where in asked if not found.get((plan, seed), set()) >= set(where)]
    return f"{len(left)} of {len(asked)} of the suite's own trainings are missing, first {left[0]}" if left else ""


def _clean(table: Table, defence: str) -> dict[str, Data]:
    """Return medians and quartiles of the clean runs, of all nominal scenarios together."""
    rows = [row for name in table.nominal() for row in table.clean.get((name, defence), ())]
    out = {}
    for metric in CLEAN_METRICS:
        values = [row[metric] for row in rows if row[metric] is not None]
        if values:
            low, mid, high = np.quantile(np.sort(values), [0.25, 0.5, 0.75])
            out[metric] = {"median": float(mid), "q25": float(low), "q75": float(high)}
    return out


def _episode(table: Table, whole: dict[str, Worst], dose: int) -> Row | None:
    """Return the worst episode: a damaged one of the worst attack at the middle dose, else at the smallest shown dose with damage.

    The least knowing attacker comes first. Where nothing is damaged, it is the episode of all attacks and shown doses that came nearest.
    """
    for at in (dose, *shown(table.suite)):
        for worst in whole.values():
            pair, share = worst.at(at)
            if share > 0.0:
                hit = zip(worst.rows(pair, at), worst.harm(pair, at)[1], strict=True)
                return min((row for row, harm in hit if harm), key=_margin)
    most = list(whole.values())[-1:]  # who knows most may do all that the others do
    rows = (row for worst in most for pair in range(len(worst.pairs)) for at in shown(table.suite) for row in worst.rows(pair, at))
    return min(rows, key=_margin, default=None)


def _margin(row: Row) -> float:
    """Return how far an episode was from damage: its smallest gap; without a road the largest error counts."""
    return float(row["min_gap"] if has_road(row) else -row["max_error"])


def _robustness(table: Table, worst: Worst | None, dose: int) -> list[Data]:
    """Return the undamaged share where the plant is another one, and its change from the worst of the nominal scenarios."""
    if worst is None:
        return []
    base = worst.undamaged(worst.at(dose, table.nominal())[0], dose)
    out = []
    for name in table.robust():
        if any(scenario == name for scenario, _ in worst.pairs):
            pair, _ = worst.at(dose, [name])
            value, low = worst.undamaged(pair, dose), 1.0 - worst.bounds(dose, [name])[1]
            out.append({
                "scenario": name, "undamaged": {"value": value, "low": low}, "change": value - base, "worst": worst.named(pair),
            })  # fmt: skip
    return out
