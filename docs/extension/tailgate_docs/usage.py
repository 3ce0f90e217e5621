"""Examples on the pages of components.

An example is a command or a few lines of Python. It uses the first scenario in which the component has a meaning.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, get_args

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Model, draws
from tailgate.core.draws import Role
from tailgate.core.kinds import KindName
from tailgate.core.registry import Entry, Spec
from tailgate.core.scenario import Scenario, list_scenarios, load_scenario
from tailgate.core.threat import Brief
from tailgate.evaluation.cells import Cell

DOSE, USUAL = 12, "gusty-stop-and-go-v0"
PACKAGED = {"program": "program:path=burst_jamming", "feedback": "feedback:weights.velocity=[-3,0,0,0,0]", "segments": "segments:values.velocity=[-3,3]", "zoo": "zoo:name=car-following-chi2_kf-0"}
MADE = {
    "policy": ("`make demo` trains it:", "runs/quickstart/policy-0.json", "--threat kinds=[fdi]"),
    "rules": ("Rules come from `tailgate distil zoo:name=car-following-chi2_kf-0 --out rules.json`:", "rules:path=rules.json",
              '--dose 20 --threat "kinds=[dos_jam,fdi]" --threat fdi_bound=3'),
}  # fmt: skip
Threat = dict[str, Any]


def usage(entry: Entry, listed: Sequence[str]) -> list[str]:
    """Return lines of Markdown. listed: scenarios of suites that list the component, or that contain it."""
    name, places = entry.name, list(dict.fromkeys([*listed, USUAL, *_small_first()]))
    if entry.family == "attack":
        if name in MADE:
            said, text, more = MADE[name]
            return [said, "", *_evaluate(USUAL, "chi2_kf", text, more)]
        return _attack(PACKAGED.get(name, name), places)
    if entry.family == "defence":
        python = ["```python", "import tailgate", "", f'defence = tailgate.make_defence("{name}")', "```", ""]
        return [*(_evaluate(listed[0], name, "none") if listed else _defence(name, places)), *python]
    if entry.family in ("filter", "detector", "mitigation"):
        text = f"composed:{entry.family}={name}"
        if fits("stop-and-go-v0", text, "none"):
            return ["```console", f"tailgate evaluate --suite quick-v0 --defence {text} --seeds 5 --out rows.jsonl", "```", ""]
        return _defence(text, places)
    if entry.family == "learner":
        return ["```console", f"python train.py learner={name} name=by-{name}", "```", ""]
    if entry.family == "reward":
        return ["```python", "import gymnasium", "", f'env = gymnasium.make("tailgate:tailgate/CarFollowing-v1", reward="{name}")', "```", ""]
    if listed:
        return ["```python", "from tailgate.core.scenario import load_scenario", "", f'scenario = load_scenario("{listed[0]}")', "```", ""]
    return ["A scenario's file names it:", "", "```yaml", f"{entry.family}: {{name: {name}}}", "```", ""]


def clean_run(scenario: str) -> list[str]:
    """Return the command that plays a scenario without an attack."""
    return _evaluate(scenario, "kf", "none")


def _evaluate(scenario: str, defence: str, attack: str, more: str = "") -> list[str]:
    words = f"tailgate evaluate --scenario {scenario} --defence {defence} --attack {attack} {more} --seeds 5 --out rows.jsonl"
    return ["```console", " ".join(words.split()), "```", ""]


def _defence(text: str, places: Sequence[str]) -> list[str]:
    place = next((place for place in places if fits(place, text, "none")), None)
    return ["No scenario of the package suits it as it is."] if place is None else _evaluate(place, text, "none")


def _attack(text: str, places: Sequence[str]) -> list[str]:
    for place in places:
        for changes in _threats(text, _place(place)):
            for defence in ("kf", "chi2_kf", "cra"):
                if fits(place, defence, text, changes):
                    return _evaluate(place, defence, text, f"--dose {DOSE} " + " ".join(_option(*item) for item in changes.items()))
    return ["No scenario of the package suits it as it is."]


def _threats(text: str, place: Scenario) -> Iterator[Threat]:
    """Yield changes of the threat model that may grant an attack what it needs, the fewest first."""
    model = _model(place.name)
    kinds: list[Threat] = [{}, *([{"kinds": [text]}] if text in get_args(KindName) else [])]
    ends = list(model.actuators)
    for wires in ([], ends, [*model.sensors, *ends], *([name, *ends] for name in model.sensors), list(model.v2v)):
        for kind in kinds:
            yield kind | ({"targets": wires} if wires else {})


def _option(name: str, value: list[str]) -> str:
    return f'--threat "{name}=[{",".join(value)}]"' if len(value) > 1 else f"--threat {name}=[{value[0]}]"


def fits(scenario: str, defence: str, attack: str, changes: Mapping[str, Any] | None = None) -> bool:
    """If a defence and an attack have a meaning in a scenario: an attack's first step is played."""
    return _fits(scenario, defence, attack, tuple((key, tuple(value)) for key, value in (changes or {}).items()))


_place = cache(load_scenario)


@cache
def _small_first() -> list[str]:
    """Return all scenarios; those of few agents first, as they are soon played."""
    return sorted(list_scenarios(), key=lambda name: _model(name).agents)


@cache
def _model(scenario: str) -> Model:
    return _place(scenario).brief().model


@cache
def _fits(scenario: str, defence: str, attack: str, changes: tuple[tuple[str, Any], ...]) -> bool:
    held, sent = Spec("defence", defence), Spec("attack", attack)
    dose = None if attack == "none" else DOSE
    try:
        made = sent.make()
        place = Cell("custom", scenario, dose, defence, attack, 1, threat=dict(changes), given=_place(scenario)).place(made, sent.entry.knowledge)
        made.prepare(Brief(_model(scenario), place.threat_model, place.horizon))  # fails sooner than the loop is made
        loop, keys = place.loop(held.make(), held.entry.uses), draws.keys("report", range(1))
        if attack == "none":
            return True
        plan = made.prepare(loop.brief)
        state = loop.start(keys)
        loop.step(state, made, plan, made.start(plan, 1, keys.at(Role.ATTACK, np.zeros(1, np.int64))))
    except InputError:
        return False
    return True
