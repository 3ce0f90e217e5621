"""Informedness of an alarm: what pairs of an attacked and a clean episode tell."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tailgate.core import Array, Model, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.estimators.compose import AcceptAll, Composed
from tailgate.estimators.filters.kalman import KalmanFilter
from tailgate.estimators.parts import Detector, Filter, Mitigation, Verdict
from tailgate.evaluation.stats import limits
from tailgate.play.trace import Trace, rollout
from tailgate.trust.informs import INFORMS, Informed, difference, informed, informedness
from tailgate.trust.run import check as trust

pytestmark = pytest.mark.usefixtures("compiled")


class Guesses(Detector[None, Array]):
    """Alarms in one step of eight, by a number that the step alone decides."""

    def prepare(self, model: Model) -> None:
        return None

    def start(self, plan: None, batch: int) -> Array:
        return np.zeros(batch, np.int64)

    def step(self, plan: None, state: Array, innovation: Any) -> tuple[Array, Verdict]:
        on = (state * 2654435761 >> 7) % 8 == 0
        alarm = np.broadcast_to(on[:, None], innovation.r.shape[:2])
        return state + 1, Verdict(np.asarray(alarm, float), alarm, np.zeros(innovation.r.shape, bool))

    def gate(self, plan: None, state: Array) -> None:
        return None


@dataclass(frozen=True)
class Guessing(Composed):
    """Kalman filter with an alarm that knows nothing."""

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        return KalmanFilter(), Guesses(), AcceptAll()


def _pairs(defence: Any, attack: str, n: int = 30) -> Informed:
    loop, keys = load_scenario("stop-and-go-v0").loop(defence, ("measurements",)), draws.keys("report", range(n))
    twin = rollout(loop, Spec("attack", "none").make(), keys)
    return informed(rollout(loop, Spec("attack", attack).make(), keys), twin.alarm.any(axis=2) & twin.live, 10, loop.horizon)


def test_an_alarm_that_knows_nothing_informs_of_nothing() -> None:
    """It detects in most runs; in as many it is on without the attack. A detector earns nearly all that it detects."""
    attack = "fdi:trigger=near,threshold=60,value=-40"
    for defence in (Guessing(), Spec("defence", "always_alarm").make()):
        asked, attacked, false = (int(x.sum()) for x in _pairs(defence, attack))
        assert asked > 20 and attacked == false == 0
        assert max(difference(attacked, false, asked, 0.05)["low"], 0.0) == 0.0
    asked, attacked, false = (int(x.sum()) for x in _pairs(Spec("defence", "chi2_kf").make(), attack))
    assert attacked == asked > 20 and false == 0 and difference(attacked, false, asked, 0.05)["low"] > 0.7


def test_independent_alarms_at_random_earn_nothing_at_any_rate() -> None:
    rng, n = np.random.default_rng(3), 400
    for rate_ in (0.02, 0.1, 0.45, 1.0):
        found, false = (rng.random((2, n)) < 1.0 - (1.0 - rate_) ** 11)
        held = difference(int((found & ~false).sum()), int((false & ~found).sum()), n, 0.05)
        assert held["low"] <= 0.0 <= held["high"] and abs(held["value"]) < 0.1, rate_


def test_informedness_of_pairs_that_are_known_by_hand() -> None:
    """Runs 0 to 4: seen; seen in both; only in the twin; begun too late; over before the twin alarms."""
    shape = 12, 5
    kind, alarm, live, twin = np.zeros(shape, np.int8), np.zeros((*shape, 2), bool), np.ones(shape, bool), np.zeros(shape, bool)
    kind[3, :3] = kind[9, 3] = kind[3, 4] = 1
    alarm[5, 0, 1] = alarm[3, 1, 0] = alarm[9, 2, 0] = True  # that of run 2 comes too late
    twin[5, 1] = twin[6, 2] = twin[2, 0] = twin[6, 4] = True  # that of run 0 before the attack
    live[5:, 4] = False
    found = informed(cast(Trace, SimpleNamespace(kind=kind, alarm=alarm, live=live)), twin, 3, 12)
    assert found.asked.tolist() == [True, True, True, False, True]
    assert found.attacked.tolist() == [True, False, False, False, False] and found.clean.tolist() == [False, False, True, False, False]
    short = informed(cast(Trace, SimpleNamespace(kind=kind, alarm=alarm, live=live)), twin[:6], 3, 12)
    assert not short.clean.any(), "a twin that ended has no alarm"
    held = difference(30, 10, 100, 0.05)
    low, high = limits(np.array([30, 10]), np.array([100, 100]), 0.0125)
    assert held == {"value": 0.2, "low": low[0] - high[1], "high": high[0] - low[1]}


@pytest.mark.long
def test_trust_reports_informedness_next_to_detection() -> None:
    """The old property stays as it is; the new one is the least of the attacked cells, at alpha over their number."""
    given = Suite("s", "", ("stop-and-go-v0",), (12,), ("chi2_kf", "always_alarm"), ("none", "fdi:trigger=near,threshold=60,value=-40", "dropout:trigger=near,threshold=60"), 20)
    good, bad = trust(given)["defences"]
    names = ["no_collision", "brakes", "detects", "error", "informs"]
    assert [p["name"] for p in good["properties"]] == [p["name"] for p in bad["properties"]] == names
    sees, seen = good["properties"][2]["share"], good["properties"][4]["share"]
    assert sees["k"] == seen["k"] == 0 and seen["attack"].startswith("dropout") and good["properties"][4]["earned"] == 0.0
    assert bad["properties"][4]["share"]["value"] == 0.0 == bad["properties"][4]["earned"]
    (alone,) = trust(replace(given, attacks=given.attacks[:2], defences=("chi2_kf",)))["defences"]
    assert alone["properties"][4]["share"]["k"] == alone["properties"][4]["share"]["n"] > 15 and alone["properties"][4]["earned"] > 0.55
    assert [p["name"] for p in trust(given, formulas=["F alarm"], runs=3)["defences"][0]["properties"]] == ["F alarm"]


def test_the_cell_of_the_least_limit_counts() -> None:
    """Ten runs that all inform prove less than 400 of which 380 do."""
    cells = [{"scenario": name, "dose": 5, "attack": "fdi", INFORMS: {"asked": n, "attacked": k, "clean": 0}} for name, n, k in (("a", 400, 380), ("b", 10, 10))]
    found = informedness(cells, 0.05)
    assert found is not None and found["share"]["scenario"] == "b"
    assert found["earned"] == difference(10, 0, 10, 0.025)["low"] < difference(380, 0, 400, 0.025)["low"]
