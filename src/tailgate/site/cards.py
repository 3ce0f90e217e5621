"""Cards on the pages: the authors' words, over what is known of components that come with the package.

A published board holds no copy of facts from registry and suite. These are description, reference, uses, file and licence of a class, the
threat model, and the trainings.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping

from tailgate.agents.policy.zoo import zoo_card, zoo_names
from tailgate.base.reading import YAML_ENDS
from tailgate.board.entry import registered
from tailgate.board.schema import Data, Entry
from tailgate.board.words import Name
from tailgate.core.registry import Family
from tailgate.core.scenario import Suite as Played
from tailgate.core.scenario import list_suites, load_scenario, load_suite
from tailgate.core.threat import ThreatModel
from tailgate.training.adaptive import plan_of

from .suite import Suite

LICENCE = "MIT"  # of the package
SHOWN = ("name", "summary", "parameters", "knowledge", "learned", "optimal")  # of a card: shown elsewhere
ORDER = ("reference", "code", "licence", "uses", "authors", "threat_model", "training", "digest", "sentinel", "version")
NAMED = 4  # attacks of one card that are named
BOUNDS = {  # of a threat model, and the kinds of attack that they bound
    "fdi_bound": {"fdi"}, "jam_range": {"dos_jam"}, "jam_power": {"noise_jam"}, "delay_bound": {"echo_delay"},
    "memory": {"delay", "replay"}, "gain_bound": {"insider"},
}  # fmt: skip


def plain(value: object) -> str:
    """Return JSON data in a line."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return "; ".join(f"{k}: {plain(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(plain(v) for v in value)
    return "none" if value is None else str(value)


def _granted(threat: ThreatModel) -> str:
    """Return what an attacker may do, in a line; every figure names its dose and knowledge."""
    blank, words = ThreatModel(), [f"{plain(threat.kinds)} of {plain(threat.targets) or 'every sensor'}"]
    for field in dataclasses.fields(threat):
        value, kinds = getattr(threat, field.name), BOUNDS.get(field.name)
        told = value != getattr(blank, field.name) if kinds is None else kinds & set(threat.kinds)
        if told and field.name not in ("kinds", "targets", "budget", "knowledge"):
            words.append(f"{field.name} {plain(value)}")
    return "; ".join(words)


@functools.cache
def suite_of(name: str, digest: str) -> Played | None:
    """Return the suite of a board, if it is one of the package as it is here."""
    held = load_suite(name) if name in list_suites() else None
    return held if held is not None and held.hash == digest else None


@functools.cache
def threat_of(name: str, digest: str) -> str:
    """Return what a suite of the package, named with its hash, grants an attacker; empty for any other."""
    suite = suite_of(name, digest)
    if suite is None:
        return ""
    where: dict[str, list[str]] = {}
    for scenario in suite.scenarios:
        where.setdefault(_granted(load_scenario(scenario).with_threat(**suite.granted).threat_model), []).append(scenario)
    return next(iter(where)) if len(where) == 1 else ". ".join(f"On {', '.join(names)}: {words}" for words, names in where.items())


def _training(family: Family, name: Name, suite: Played | None) -> str:
    """Return what was trained: nothing, a policy of the zoo, or one after the suite's plan."""
    if family == "defence":
        return "as the file of its policy says" if any(p.startswith("policy=") for p in name.params) else "none"
    if name.base == "zoo" and name.label in zoo_names():
        held = zoo_card(name.label)
        return f"{held['learner']}, {held['decisions']} decisions, seed {held['seed']}, against {held['defence']} on {held['scenario']}"
    if not name.policy:
        return "none"
    if suite is None or not suite.adaptive:
        return "as the file of the policy says"
    plan = plan_of(suite)
    if not plan.learners:
        return f"against one defence, by the standard attack ensemble, budget {plan.ensemble}"
    learners = "; ".join(f"{learner} ({', '.join(changes)})" for learner, changes in plan.learners.items())
    return f"against one defence each, preset {plan.config}, {plan.seeds} seeds: {learners}"


def own_card(suite: Suite, family: Family, name: Name) -> Data:
    """Return the card of what comes with the package, from registry, file of the class and suite; empty for anything else."""
    base = "program" if name.base.endswith(YAML_ENDS) else name.base
    entry = registered(family).get(base)
    if entry is None:
        return {}
    board = suite.board.suite
    return entry.card() | {
        "code": f"src/{entry.cls.__module__.replace('.', '/')}.py, {entry.cls.__name__}", "licence": LICENCE,
        "threat_model": threat_of(board.name, board.hash), "training": _training(family, name, suite_of(board.name, board.hash)),
    }  # fmt: skip


def _drawn(card: Data) -> Data:
    """Return a card's fields in order: those that are known first, then the others as they come."""
    keys = [*(k for k in ORDER if k in card), *(k for k in card if k not in ORDER and k not in SHOWN)]
    fields = [(key.replace("_", " ").capitalize(), plain(card[key])) for key in keys if card[key] not in (None, "", [], {})]
    given = card.get("parameters")
    parameters = []
    for name, item in given.items() if isinstance(given, Mapping) else ():
        known = isinstance(item, Mapping) and "doc" in item
        parameters.append((str(name), plain(item.get("default")) if known else plain(item), str(item["doc"]) if known else ""))
    return {"known": bool(card), "summary": plain(card.get("summary", "")), "fields": fields, "parameters": parameters}


def card_of(suite: Suite, entry: Entry) -> Data:
    """Return the card of an entry: the board's, over what is known of a defence that comes with the package."""
    card = own_card(suite, "defence", suite.defences[entry.defence]) | (entry.card or {})
    drawn = _drawn(card)
    if "uses" not in card and entry.uses:
        drawn["fields"].append(("Uses", ", ".join(entry.uses)))
    return drawn


def attack_cards(suite: Suite) -> list[Data]:
    """Return one card for all attacks of a board that it holds for, with their names; those without a card are left out."""
    found: list[tuple[Data, list[Name]]] = []
    for attack in suite.board.attacks:
        name = suite.attacks[attack.attack]
        card = own_card(suite, "attack", name) | (attack.card or {})
        same = next((names for held, names in found if held == card), None)
        if same is not None:
            same.append(name)
        elif card:
            found.append((card, [name]))
    return [
        _drawn(card) | {"title": plain(card.get("name") or names[0].full), "names": names[:NAMED], "more": len(names[NAMED:])}
        for card, names in found
    ]
