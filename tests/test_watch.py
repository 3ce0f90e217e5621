"""A watch on a score: what it sees, and that the defence does not know of it."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import tailgate
from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base.errors import NotApplicable
from tailgate.board.detection import Effort, detection, stealth_impact
from tailgate.core import Model
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_scenario
from tailgate.core.score_threshold import Watched
from tailgate.estimators import AcceptAll, ChiSquare, Composed, GatedKalman, GateOut, KalmanFilter, Score, compose
from tailgate.estimators.watched import watched
from tailgate.evaluation.attack_free import Bench
from tailgate.num import inverse, quadratic
from tailgate.play.trace import Trace, rollout

BIAS = "fdi:value=-3,start_step=40,length=20"
ECHO = "echo_delay:start_step=30,delay=60"
CASES = [
    ("stop-and-go-v0", "kf", BIAS), ("gusty-stop-and-go-v0", "safe_state", BIAS), ("radar-following-v0", "cra", ECHO),
    ("radar-following-v0", "algorithm2", ECHO), ("platoon-braking-v0", "lasso_dkf", BIAS), ("platoon-braking-v0", "centralised_kf", BIAS),
]  # fmt: skip


def _played(scenario: str, guard: object, uses: tuple[str, ...], attack: str, *, plain: bool = False) -> Trace:
    place = load_scenario(scenario).with_threat(budget=20)
    loop = dataclasses.replace(place, horizon=min(place.horizon, 150)).loop(guard, uses)
    return rollout(loop, Spec("attack", attack).make(), keys("tune", range(6)), plain=plain)


@pytest.mark.thin(3)
@pytest.mark.parametrize(("scenario", "name", "attack"), CASES)
def test_a_watch_alarms_by_the_score_and_changes_nothing_else(scenario: str, name: str, attack: str) -> None:
    """In both engines, to the last bit; alarms are those of the score."""
    bench = Bench.of(name, [scenario], 8, None)
    bare = _played(scenario, bench.defence, bench.uses, attack)
    level = float(np.quantile(bare.score[bare.live], 0.9))
    for plain in (False, True):
        seen = _played(scenario, bench.at(level), bench.uses, attack, plain=plain)
        assert np.array_equal(seen.length, bare.length)
        for signal, held in bare.signals.items():
            expected = bare.score > level if signal == "alarm" else held
            assert np.array_equal(seen.signals[signal][seen.live], expected[bare.live]), signal
    assert 0.0 < seen.alarm[seen.live].mean() < 0.5


def test_of_a_filter_the_score_is_the_chi_square_of_its_innovation() -> None:
    """r' S^-1 r, written out here, of what the filter was about to believe."""
    loop = load_scenario("stop-and-go-v0").loop(Bench.of("kf", ["stop-and-go-v0"], 8, None).at(6.0), ("measurements",))
    held, attack = keys("tune", range(4)), NoAttack()
    state, plan = loop.start(held), attack.prepare(loop.brief)
    memory = attack.start(plan, 4, held.at(Role.ATTACK, np.zeros(4, np.int64)))
    for _ in range(30):
        seen = loop.defence.look(loop.plan.defence, state.defence, state.received, state.known_u)  # type: ignore[attr-defined]
        g = quadratic(seen.innovation.r, inverse(seen.innovation.S))
        state, memory, frame = loop.step(state, attack, plan, memory)
        np.testing.assert_array_equal(frame.estimate.score, g)
        np.testing.assert_array_equal(frame.estimate.alarm, g > 6.0)
        assert seen.gate == 6.0


def test_what_acts_on_suspicion_is_not_composed_with_a_test() -> None:
    """A gate would shut; a mode would be asked for."""
    assert isinstance(watched(compose(KalmanFilter(), Score(), GateOut()), 9.0), Watched)
    assert isinstance(watched(compose(KalmanFilter(), Score(), AcceptAll(mode="brake")), 9.0), Watched)
    assert watched(compose(KalmanFilter(), Score(), AcceptAll()), 9.0).parts() == (KalmanFilter(), ChiSquare(9.0), AcceptAll())  # type: ignore[union-attr]


def test_a_white_box_sees_the_defence_and_not_the_watch() -> None:
    """A script needs to look at nothing, and plays; who looks finds no innovation of a safe set."""
    bench = Bench.of("safe_state", ["stop-and-go-v0"], 8, None)
    loop = load_scenario("stop-and-go-v0").with_threat(knowledge="white", budget=20).loop(bench.at(0.9), bench.uses)
    assert rollout(loop, Spec("attack", BIAS).make(), keys("tune", range(2))).alarm.any()
    with pytest.raises(NotApplicable, match="innovation"):
        rollout(loop, Spec("attack", "stealth").make(), keys("tune", range(2)))


@dataclass(frozen=True)
class Deaf(Composed):
    """Is told that its sensors are ten times worse."""

    def parts(self) -> Any:
        return KalmanFilter(), Score(), AcceptAll()

    def prepare(self, model: Model) -> Any:
        return super().prepare(dataclasses.replace(model, R=100.0 * model.R))


class Named:
    """A threshold of its own, and no dataclass."""

    threshold_field = "eta"

    def __getattr__(self, name: str) -> Any:
        return getattr(KF, name)


class OwnTurn(Named):
    """Sets its threshold itself."""

    threshold_field = None

    def with_threshold(self, value: float) -> Any:
        return GatedKalman(eta=value)


KF = tailgate.make_defence("kf")


def test_a_composed_defence_with_a_plan_of_its_own_is_left_as_it_is() -> None:
    bare, held = (_played("stop-and-go-v0", Deaf(), ("measurements",), BIAS, plain=plain) for plain in (True, False))
    seen = _played("stop-and-go-v0", watched(Deaf(), 0.01), ("measurements",), BIAS)
    assert np.array_equal(bare.score, held.score) and np.array_equal(bare.score, seen.score) and np.median(bare.score) < 0.1


def test_what_is_turned_is_what_is_named() -> None:
    for defence, kind, field in ((Named(), Watched, ""), (OwnTurn(), GatedKalman, "threshold"), (GatedKalman(), GatedKalman, "eta")):
        bench = Bench.of(defence, ["stop-and-go-v0"], 8, None)
        assert isinstance(bench.at(9.0), kind) and bench.field == field


def test_a_loop_has_one_bare_loop() -> None:
    """Its plan is made once, which for a submission means a process."""
    loop = load_scenario("stop-and-go-v0").loop(watched(OwnTurn(), 9.0), ("measurements",))
    assert loop.bare is loop.bare and loop.bare.bare is loop.bare and not isinstance(loop.bare.defence, Watched)


@pytest.mark.long
def test_filters_and_challenges_have_figures_of_detection() -> None:
    """A challenge is answered by a jump of the energy; a filter sees a late echo at once, and a stealthy attacker stays below its chi-square."""
    effort = Effort((0.02,), 8, 20, 40_000)
    over_air = Suite("s", "", ("radar-following-v0",))
    (heard,) = detection(over_air, ["cra:probability=0.5"], [ECHO], effort, dose=20)["entries"]
    assert heard["watched"] and "rarer" not in heard and heard["detected"]["value"] == 1.0 and heard["threshold"] > 0.0
    road = Suite("s", "", ("stop-and-go-v0",))
    (seen,) = detection(road, ["kf"], ["fdi:start_step=100,value=-10"], effort, dose=20)["entries"]
    (gated,) = detection(road, ["composed:mitigation=accept_all"], ["fdi:start_step=100,value=-10"], effort, dose=20)["entries"]
    assert seen == {**gated, "defence": "kf", "watched": True}
    (curve,) = stealth_impact(road, "kf", effort, dose=100) or [{}]
    assert curve["deviation"] > 0.0
    seldom = Effort((0.1,), 8, 20, 80_000)  # a reading on the edge once in each minute
    (none,) = stealth_impact(road, "safe_state", seldom, dose=100) or [{}]
    assert none["deviation"] is None and "the scorer's" in none["reason"] and none["rarer"]
    (rare,) = detection(road, ["safe_state"], [BIAS], seldom, dose=20)["entries"]
    assert rare["watched"] and rare["rarer"] and 0.9999 < rare["threshold"] <= 1.0
