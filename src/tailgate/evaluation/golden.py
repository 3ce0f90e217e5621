"""Golden traces: fingerprints of a few episodes of every scenario of every suite, as the suite plays it.

A published suite never changes under its name.
`check` plays 16 episodes per cell again, fewer of a slow plant or a small suite, and reports what changed.
It covers two defences and three attacks of each scenario.
`write` records fingerprints of a new version; never use it for a published one.
A decision's hash is the same on every platform.
A trace's hash is exact for one machine type with one numpy and one llvmlite, which compiles random numbers and traced loops.
It is compared only where these match the record.

    python -m tailgate.evaluation.golden --check [--scenario NAME ...] [--device cuda]
    python -m tailgate.evaluation.golden --write [--suite NAME ...]
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tailgate.base.errors import InputError, NotApplicable, said, unknown
from tailgate.base.files import write_json
from tailgate.base.progress import progress
from tailgate.base.reading import load_json
from tailgate.core import draws
from tailgate.core.draws import Draws, Keys
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, Suite, list_suites, load_scenario, load_suite
from tailgate.engine.cards import device, playing_on
from tailgate.envs.gym.mixture import Mixture, MixtureState
from tailgate.evaluation.devices import untraced
from tailgate.play.trace import Trace, rollout

FORMAT = "tailgate-golden-2"
FILE = Path(str(files("tailgate.configs").joinpath("golden"))) / "golden.json"
EPISODES = 16
FEW = {"Highway": 2}  # for a plant that steps its episodes one by one
FOREIGN = {"Highway"}  # plants of other libraries, whose last bits also depend on the instructions that numpy finds
DEFENCES, ATTACKS = 2, 3
PURPOSE = "report"  # the first episodes of a board


@dataclass(frozen=True, eq=False)
class _Blocks(Mixture):
    """A mixture in which each attack plays an equal block of rows of one batch."""

    def start(self, plan: tuple[Any, ...], batch: int, draws: Draws) -> MixtureState:
        state = super().start(plan, batch, draws)
        return state._replace(member=np.arange(batch) // max(1, batch // len(plan)))


def this_platform() -> str:
    """Return what a trace's last bits may depend on."""
    return f"{platform.machine()}, numpy {np.__version__}, llvmlite {version('llvmlite')}"


def instructions() -> str:
    """Return the instruction sets beyond the baseline that numpy found on this processor."""
    return " ".join(np.show_config(mode="dicts")["SIMD Extensions"]["found"])


def uses() -> dict[str, tuple[str, Suite]]:
    """Return all scenarios of all built-in suites by `suite/scenario`, because each suite has its threat model, doses and attacks."""
    return {f"{suite.name}/{name}": (name, suite) for suite in map(load_suite, list_suites()) for name in suite.scenarios}


def place_of(name: str, suite: Suite) -> Scenario:
    """Return the scenario with the suite's threat model and middle dose, for a black-box attacker unless the suite grants more."""
    dose = suite.doses[len(suite.doses) // 2]
    changes = suite.threat | {"knowledge": suite.knowledge or "black"} | ({} if dose is None else {"budget": dose})
    return load_scenario(name).with_threat(**changes)


def loops(place: Scenario, names: Sequence[str]) -> Iterator[tuple[str, Loop]]:
    """Yield the defences that apply to a scenario, with their loops."""
    for name in dict.fromkeys(names):
        spec = Spec("defence", name)
        try:
            yield name, place.loop(spec.make(), spec.entry.uses)
        except NotApplicable:
            continue


def episodes_of(place: Scenario, suite: Suite) -> int:
    """Return how many episodes of a cell are recorded; never more than a board of the suite has."""
    return min(FEW.get(type(place.plant).__name__, EPISODES), suite.seeds)


def play(loop: Loop, attacks: Sequence[str], episodes: int = EPISODES) -> Trace:
    """Play `episodes` rows of each attack in one batch, one attack after the other."""
    keys = draws.keys(PURPOSE, range(episodes))
    some = Keys(np.tile(keys.key, (len(attacks), 1)), np.tile(keys.episode, len(attacks)))
    return rollout(loop, _Blocks(tuple(Spec("attack", text).make() for text in attacks)), some)


def cells(loop: Loop, defence: str, attacks: Sequence[str], episodes: int = EPISODES) -> list[dict[str, str]]:
    """Return the fingerprints of one defence, one entry per attack."""
    trace, out = play(loop, attacks, episodes), []
    for i, attack in enumerate(attacks):
        rows = range(i * episodes, (i + 1) * episodes)
        hashes = {"decision": _all(map(trace.decision_hash, rows)), "trace": _all(map(trace.trace_hash, rows))}
        out.append({"defence": defence, "attack": attack, **hashes})
    return out


def _all(hashes: Iterator[str]) -> str:
    return hashlib.blake2b("".join(hashes).encode(), digest_size=16).hexdigest()


def record(name: str, suite: Suite) -> dict[str, Any]:
    """Return the record of a scenario: no attack, and the first two attacks of the suite that are granted and take effect."""
    place = place_of(name, suite)
    episodes = episodes_of(place, suite)
    chosen = list(islice(loops(place, ("kf", "none", *suite.defences)), DEFENCES))
    if not chosen:
        raise InputError("golden", name, "a scenario that one of its suite's defences can serve")
    brief, able = place.brief(), ["none"]
    for text in suite.attacks:
        attack, entry = Spec("attack", text).make(), Spec("attack", text).entry
        if text == "none" or getattr(attack, "knowledge", entry.knowledge) != "black" or entry.learned:
            continue
        try:
            attack.prepare(brief)
        except NotApplicable:
            continue
        able.append(text)
    trace = play(chosen[0][1], able, episodes)
    steps = ((trace.kind != 0) & trace.live).sum(axis=0).reshape(len(able), episodes).sum(axis=1)
    acting = [text for text, n in zip(able, steps, strict=True) if n]
    kinds = {Spec("attack", text).entry.name: text for text in reversed(acting)}  # the first of each sort
    acting.sort(key=lambda text: text not in kinds.values())
    attacks = ["none", *acting[: ATTACKS - 1]]
    return {
        "hash": place.config_hash, **({} if episodes == EPISODES else {"episodes": episodes}),
        **({"instructions": instructions()} if type(place.plant).__name__ in FOREIGN else {}),
        "cells": [cell for defence, loop in chosen for cell in cells(loop, defence, attacks, episodes)],
    }  # fmt: skip


def read() -> dict[str, Any]:
    """Read the recorded fingerprints."""
    try:
        held: dict[str, Any] = load_json(FILE)
    except (OSError, ValueError) as error:
        raise InputError("golden", str(FILE), f"a readable JSON file ({said(error)})") from None
    if held.get("format") != FORMAT:
        raise InputError("golden.format", held.get("format"), FORMAT)
    return held


def moved_suites(held: dict[str, Any]) -> list[str]:
    """Return which suites or scenarios differ from the recorded ones, without playing."""
    here, there = {name: load_suite(name).hash for name in list_suites()}, held["suites"]
    out = [f"suite {name} is not recorded: python -m tailgate.evaluation.golden --write" for name in here if name not in there]
    out += [f"suite {name} is recorded and gone" for name in there if name not in here]
    changed = [name for name in here if there.get(name, here[name]) != here[name]]
    out += [f"suite {name} has changed under its name: it needs a new version" for name in changed]
    used = uses()
    out += [f"{key} is not recorded" for key in used if key not in held["scenarios"]]
    out += [f"{key} is recorded, but no suite has such a scenario" for key in held["scenarios"] if key not in used]
    return out


def comparable(held: dict[str, Any], entry: dict[str, Any]) -> bool:
    """Return True if traces of a recorded scenario must match here to the last bit."""
    return held["platform"] == this_platform() and entry.get("instructions", "") in ("", instructions())


def check(name: str, held: dict[str, Any]) -> list[str]:
    """Play a scenario (`suite/scenario`) again and return one sentence per change; traces count only on the recorded platform.

    Raises ImportError if the scenario needs a package that is not installed.
    """
    entry = held["scenarios"].get(name)
    if entry is None:
        raise unknown("golden.scenario", name, held["scenarios"])
    of, _, scenario = name.partition("/")
    if of not in list_suites() or scenario not in (suite := load_suite(of)).scenarios:
        return [f"{name}: no suite has such a scenario any more"]
    place = place_of(scenario, suite)
    out = []
    if place.config_hash != entry["hash"]:
        out.append(f"{name} has changed under its name: it needs a new version")
    exact = comparable(held, entry)
    for defence in dict.fromkeys(cell["defence"] for cell in entry["cells"]):
        mine = [cell for cell in entry["cells"] if cell["defence"] == defence]
        found = list(loops(place, (defence,)))
        if not found:
            out.append(f"{name}: {defence} can no longer serve it")
            continue
        if device() != "cpu" and untraced(found[0][1]):
            continue  # the plain loop plays it, on the processor
        attacks, episodes = [cell["attack"] for cell in mine], entry.get("episodes", EPISODES)
        for was, now in zip(mine, cells(found[0][1], defence, attacks, episodes), strict=True):
            where = f"{name}, {defence} against {was['attack']}"
            if was["decision"] != now["decision"]:
                out.append(f"{where}: decisions (commands, alarms, modes, collisions) moved")
            elif exact and was["trace"] != now["trace"]:
                out.append(f"{where}: the trace moved, its decisions did not")
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0 if nothing changed, 1 if something did, 2 for bad input."""
    parser = argparse.ArgumentParser(prog="python -m tailgate.evaluation.golden", description="Golden traces of the published suites.")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--check", action="store_true", help="play them again and report what changed")
    what.add_argument("--write", action="store_true", help="record them again, for a new version")
    parser.add_argument("--scenario", action="append", metavar="NAME", help="only this one, under all suites (repeatable; with --check)")
    parser.add_argument("--suite", action="append", metavar="NAME", help="only this one, a new one (repeatable; with --write)")
    parser.add_argument("--device", default="cpu", metavar="NAME", help="where they are played: cpu (default) or cuda; with --check")
    options = parser.parse_args(arguments)
    try:
        if options.device != "cpu" and options.write:
            raise InputError("--device", options.device, "--check")
        if options.scenario and options.write:
            raise InputError("--scenario", options.scenario, "--check; --write takes --suite")
        if options.suite and options.check:
            raise InputError("--suite", options.suite, "--write; --check takes --scenario")
        with playing_on(options.device):
            return _write(options.suite) if options.write else _check(options.scenario)
    except (InputError, ImportError) as error:
        print(f"tailgate.evaluation.golden: error: {error}", file=sys.stderr)
        return 2


def _check(only: list[str] | None) -> int:
    held = read()
    there = {key: key.partition("/")[2] for key in sorted(held["scenarios"])}
    for name in only or ():
        if name not in there.values():
            raise unknown("--scenario", name, sorted(set(there.values())))
    names = [key for key, name in there.items() if not only or name in only]
    moved, left = [] if only else moved_suites(held), []
    with progress(Console(stderr=True)) as update:
        for done, name in enumerate(names, 1):
            try:
                moved += check(name, held)
            except ImportError as error:
                left.append(f"{name} is not played: {error}")
            update("playing", done, len(names), f"{done} of {len(names)} scenarios")
    for line in [*left, *moved]:
        print(line)
    compared = "decisions and traces" if held["platform"] == this_platform() else f"decisions only: traces are of {held['platform']}"
    print(f"{len(names) - len(left)} scenarios, {compared}: {f'{len(moved)} differences' if moved else 'nothing moved'}")
    return 1 if moved else 0


def _write(only: list[str] | None) -> int:
    """Record all suites, or only those given, and keep the record of the others."""
    for name in only or ():
        if name not in list_suites():
            raise unknown("--suite", name, list_suites())
    used = {key: (name, suite) for key, (name, suite) in uses().items() if only is None or suite.name in only}
    if only is not None and (platform_of := read()["platform"]) != this_platform():
        raise InputError("--suite", this_platform(), f"the platform of the other suites' traces ({platform_of}), or a record of all suites")
    scenarios = {}
    with progress(Console(stderr=True)) as update:
        for done, key in enumerate(sorted(used), 1):
            scenarios[key] = record(*used[key])
            update("playing", done, len(used), f"{done} of {len(used)} scenarios")
    suites = {name: load_suite(name).hash for name in only or list_suites()}
    if only is not None:
        others = read()
        suites, scenarios = (dict(sorted((others[key] | new).items())) for key, new in (("suites", suites), ("scenarios", scenarios)))
    held = {
        "format": FORMAT, "platform": this_platform(), "episodes": EPISODES, "purpose": PURPOSE, "suites": suites, "scenarios": scenarios,
    }  # fmt: skip
    write_json(FILE, held, "golden")
    print(FILE)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
