"""A counterexample: an episode that breaks a property, as a JSON file that anybody plays again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, unknown
from tailgate.base.reading import load_json
from tailgate.core import Array, Attack, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import list_scenarios, list_suites
from tailgate.falsify.case import PURPOSE, Case
from tailgate.falsify.claim import Claim
from tailgate.falsify.road import Numbers, Steered, as_data, from_data, numbers_of
from tailgate.falsify.schedule import Schedule, recorded
from tailgate.falsify.schedule import from_data as schedule_of
from tailgate.falsify.search import Worst
from tailgate.falsify.shrink import shrunk
from tailgate.play.trace import Trace, rollout

FORMAT = "tailgate-counterexample-1"
CANDIDATE_STEPS = 900_000  # of schedules that are played side by side
FIELDS = ("suite", "scenario", "dose", "defence")


def _rows(numbers: Numbers, batch: int) -> Numbers:
    """Return the draws of one row for a batch."""
    return {key: np.repeat(held, batch, axis=0) for key, held in numbers.items()}


def _played(case: Case, attack: Attack, text: str, seed: int, numbers: Numbers, batch: int = 1, plain: bool = True) -> Trace:
    keys = Steered.of(draws.keys(PURPOSE, [seed] * batch), _rows(numbers, batch))
    return rollout(case.loop(text), attack, keys, plain=plain)


def counterexample(case: Case, worst: Worst) -> dict[str, Any]:
    """Return the worst episode of a search as JSON data, with its attack shrunk if it breaks the property.

    All figures are those of the plain engine. `commands` are the shrunk schedule; `found` says what the search found.
    """
    choice = case.choice(worst.genome)
    numbers = numbers_of(case.slots, choice.start[None])
    trace = _played(case, Spec("attack", choice.attack).make(), choice.attack, worst.seed, numbers)
    schedule = recorded(trace, case.own.horizon)
    found: dict[str, Any] = {"attack": choice.attack, "robustness": _least(case.claim, trace), "steps": int(schedule.steps[0])}

    def broken(tried: Schedule) -> Array:
        count, out = tried.kind.shape[1], []
        size = max(CANDIDATE_STEPS // case.own.horizon, 1)
        for first in range(0, count, size):
            some = tried.take(np.arange(first, min(first + size, count)))
            played = _played(case, some, "none", worst.seed, numbers, some.kind.shape[1], plain=False)
            out.append(case.claim.robustness(played) < 0.0)
        return np.concatenate(out)

    if found["robustness"] < 0.0:
        schedule = shrunk(schedule, broken, case.own.brief)
    data = {
        "format": FORMAT, **{name: getattr(case, name) for name in FIELDS}, "threat": dict(case.threat), "property": case.formula,
        "purpose": PURPOSE, "seed": worst.seed, "start": as_data(numbers, 0), "found": found,
        "commands": schedule.as_data(case.own.model.wires),
    }  # fmt: skip
    return data | _figures(case, _played(case, schedule, "none", worst.seed, numbers))


def _least(claim: Claim, trace: Trace) -> float:
    return float(np.clip(claim.robustness(trace)[0], -1e300, 1e300))


def _figures(case: Case, trace: Trace) -> dict[str, Any]:
    """Return what an episode shows: its robustness, its hash, the road at its start, and the robustness of each formula over time."""
    steps = int(trace.length[0])
    first = {
        name: float(value) for name in ("gap", "speed", "lead_speed")
        for value in [np.min(trace.first[name][0][case.own.model.followers], initial=np.inf)] if math.isfinite(value)
    }  # fmt: skip
    return {
        "robustness": _least(case.claim, trace), "steps": int(np.count_nonzero(trace.kind[:steps, 0])), "trace_hash": trace.trace_hash(0),
        "collided": bool((trace.collided | trace.rear_collided)[:steps, 0].any()), "length": steps, "dt": trace.dt, "road": first,
        "formulas": [
            {"formula": text, "along": [value if math.isfinite(value) else None for value in held[:steps, 0].tolist()]}
            for text, held in case.claim.along(trace).items()
        ],
    }  # fmt: skip


def replayed(path: Path, defence: str | None = None, scenario: str | None = None, suite: str = "") -> dict[str, Any]:
    """Play a counterexample again in the plain engine; return its figures, and `same`: if they are the file's.

    Parameters
    ----------
    path
        The file.
    defence
        Plays this defence instead of the file's; a class to import is played only if it is named here.
    scenario
        Plays in this scenario instead of the file's; a scenario file is read only if it is named here.
    suite
        Takes the threat model of this suite instead of the file's; a suite file is read only if it is named here.

    Raises
    ------
    InputError
        For a file that is no counterexample, or that names code which the user did not.
    """
    try:
        data = load_json(path)
    except (OSError, ValueError) as error:
        raise InputError("counterexample", str(path), f"a file of `tailgate falsify` ({error})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError("counterexample: format", data.get("format") if isinstance(data, dict) else data, FORMAT)
    for name in ("suite", "scenario", "defence", "property"):
        if not isinstance(data.get(name), str):
            raise InputError(f"counterexample: {name}", data.get(name), "a text")
    if not isinstance(data.get("threat"), dict) or type(data.get("seed")) is not int or data["seed"] < 0:
        raise InputError("counterexample: threat, seed", [data.get("threat"), data.get("seed")], "a mapping, and a number not below 0")
    for name, named, known in (("suite", suite, ["", *list_suites()]), ("scenario", scenario, list_scenarios())):
        if not named and data[name] not in known:
            raise unknown(f"counterexample: {name}", data[name], known)  # a file does not choose a file
    chosen, place = defence or data["defence"], scenario or data["scenario"]
    if defence is None:
        Spec("defence", chosen).refuse_imports("counterexample")
    case = Case(suite or data["suite"], place, data.get("dose"), chosen, tuple(data["threat"].items()), data["property"], "none")
    numbers = from_data(case.slots, data.get("start"), "counterexample: start")
    schedule = schedule_of(data.get("commands"), case.own.brief, "counterexample: commands")
    figures = _figures(case, _played(case, schedule, "none", data["seed"], numbers))
    return figures | {"same": all(figures[name] == data.get(name) for name in ("robustness", "trace_hash"))}
