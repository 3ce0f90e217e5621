"""Every defence in every scenario of every suite is traced, to the bits of the plain loop; the exceptions have a reason each."""

from pathlib import Path
from typing import Any

import pytest

from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.loop import Loop
from tailgate.core.registry import Spec, entries
from tailgate.core.scenario import Suite, load_scenario, load_suite
from tailgate.engine.agreement import Untraced
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.programs import SeatPrograms, programs_of
from tailgate.play.rollouts import Rollout, rollout_of
from tailgate.play.trace import Trace, rollout

ROOT = Path(__file__).parent.parent
NAMES = sorted(path.stem for path in (ROOT / "configs/suites").glob("*.yaml") if "." not in path.stem)
SUITES = [load_suite(name) for name in NAMES]
SCENARIOS = sorted({name for suite in SUITES for name in suite.scenarios})
REASONS = {  # of what is played plain
    "filterpy": "it plays one episode after the other",
    "highway": "highway.py",  # somebody else's simulator, episode by episode
}
KEYS = draws.keys("report", range(6))


def reason(scenario: str, defence: str) -> str:
    if defence == "centralised_lasso" and scenario in ("network-restless-v0", "thesis-ch5-v0"):
        return "operations"  # pivoting of 30 and 140 sensors
    return next((why for name, why in REASONS.items() if scenario.startswith(name) or defence.startswith(name)), "")


def seated(scenario: str, defence: str, threat: dict[str, Any]) -> Seat:
    model = load_scenario(scenario).with_threat(**threat).threat_model
    value = max(-min(4.0, model.fdi_bound), model.jam_range[0])
    try:
        return Seat.make(scenario, defence, threat, value=value)
    except InputError as error:
        if "nobody drives" not in str(error):
            raise
        return Seat.make(scenario, defence, threat, value=value, reward="error")


@pytest.mark.long
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_scenario_with_every_defence_of_its_suites(scenario: str) -> None:
    """As an environment with resets, and whole episodes of it: of the first defence under every attack, of the others under some."""
    known: set[str] = set()
    for suite in (suite for suite in SUITES if scenario in suite.scenarios):
        threat = {**suite.threat, "budget": suite.middle_dose}
        for defence in {str(defence): None for defence in suite.defences if str(defence) not in known}:
            spec = Spec("defence", defence)
            try:
                loops = {known: looped(scenario, spec, threat | {"knowledge": known}) for known in ("black", "grey", "white")}
                seat = seated(scenario, defence, threat)
            except InputError:
                continue  # a defence that does not fit
            wanted, found = reason(scenario, defence), programs_of(seat)
            if wanted:
                assert isinstance(found, Untraced) and wanted in found.why, (defence, found)
                continue
            assert isinstance(found, SeatPrograms), (defence, found)
            whole_episodes(loops, suite, defence, 3 if known else len(suite.attacks))
            known.add(defence)
    assert known or "highway" in scenario


def looped(scenario: str, defence: Spec, threat: dict[str, Any]) -> Loop:
    return load_scenario(scenario).with_threat(**threat).loop(defence.make(), defence.entry.uses)


def whole_episodes(loops: dict[str, Loop], suite: Suite, defence: str, most: int) -> None:
    played = 0
    for attack in map(str, suite.attacks):
        spec = Spec("attack", attack)
        made, loop = spec.make(), loops[spec.entry.knowledge]
        try:
            made.prepare(loop.brief)
        except InputError:
            continue
        found = rollout_of(loop, made)
        if isinstance(found, Untraced) and "NotApplicable" in found.why:
            with pytest.raises(InputError):  # nor does the plain loop play it
                rollout(loop, made, KEYS, plain=True)
            continue
        assert isinstance(found, Rollout), (defence, attack, found)
        got = Trace(loop.model, loop.horizon, *found.play(KEYS, True), loop.controller.desired_gap)
        plain = rollout(loop, made, KEYS, plain=True)
        assert [got.trace_hash(i) for i in range(6)] == [plain.trace_hash(i) for i in range(6)], (defence, attack)
        played += 1
        if played == most:
            break


def test_the_exceptions_are_few() -> None:
    built_in = [name for name, entry in entries("defence").items() if entry.built_in]
    assert len(built_in) >= 37 and sum(bool(reason("", name)) for name in built_in) <= 6
