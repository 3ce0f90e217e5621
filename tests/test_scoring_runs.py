"""Scoring of real runs: sentinels fail their gates, a small board, and the figures of detection."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

from tailgate import make_attack, make_defence
from tailgate.agents.policy.zoo import zoo_names
from tailgate.base.errors import InputError, NotApplicable
from tailgate.board import score
from tailgate.board.detection import Effort, detection, deviation, plants, stealth_impact, threshold
from tailgate.board.files import load, read_board
from tailgate.core.draws import keys
from tailgate.core.registry import Spec, entries
from tailgate.core.scenario import Suite, list_suites, load_scenario, load_suite
from tailgate.evaluation.cells import evaluate
from tailgate.play.metrics import max_error
from tailgate.play.trace import rollout
from tailgate.training.adaptive import asked_of

ROOT = Path(__file__).parents[1]
SENTINELS = {name: e.sentinel for name, e in entries("defence").items() if e.sentinel}


@pytest.fixture(scope="module")
def small():
    """quick-v0 cut to two defences and the sentinels, three attacks and ten seeds, and its rows."""
    base = load_suite("quick-v0")
    part = dataclasses.replace(
        base, scenarios=("gusty-stop-and-go-v0",), defences=("none", "chi2_kf", *SENTINELS), attacks=(*base.attacks[:2], "stealth:trigger=near,threshold=40"),
        seeds=10,
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tailgate.play.trace.MANY", 1)  # attacks are played by compiled code too, which has the bits of plain code
        return part, evaluate(part)


@pytest.mark.thin(2)
@pytest.mark.parametrize("name", SENTINELS)
def test_each_sentinel_fails_the_gate_that_it_names(small, name) -> None:
    """And takes no rank; the two real defences pass every gate."""
    part, rows = small
    made = {e["defence"]: e for e in score(rows, part)["entries"]}
    assert SENTINELS[name] in {gate["gate"] for gate in made[name]["gates"] if not gate["passed"]}
    assert made[name]["status"] == "unranked" and made[name]["rank"] is None
    assert all(gate["passed"] for defence in ("none", "chi2_kf") for gate in made[defence]["gates"])


@pytest.mark.parametrize("path", sorted(ROOT.glob("results/*/board.json*")), ids=lambda path: path.parent.name)
def test_on_every_published_board_each_sentinel_fails_its_gate(path) -> None:
    """Where nobody drives nobody collides: there an error above the suite's bound is what a collision is elsewhere."""
    suite = load_suite(path.parent.name)
    made, road = load(path), suite.bound is None
    found = [entry for entry in made["entries"] if entry["defence"] in SENTINELS]
    assert {entry["defence"] for entry in found} == SENTINELS.keys() & set(suite.defences) and len(found) >= 2
    for entry in found:
        gate = SENTINELS[entry["defence"]] if road else SENTINELS[entry["defence"]].replace("collisions", "bound")
        assert gate in {g["gate"] for g in entry["gates"] if not g["passed"]} and entry["rank"] is None, entry["defence"]


def test_a_small_board_of_real_runs_is_of_the_format_and_says_what_the_rows_say(small) -> None:
    """Shares are counts of the rows, the card is the registry's, and the white box beats the gate that it knows."""
    part, rows = small
    made = score(rows, part)
    read_board(json.loads(json.dumps(made, allow_nan=False)))
    assert json.dumps(score(rows, part)) == json.dumps(made)
    held = {(c["defence"], c["attack"]): c for c in made["cells"]}
    for (defence, attack), cell in held.items():
        mine = [row for row in rows if row["defence"] == defence and row["attack"] == attack]
        if cell["damage"] is not None:
            assert cell["damage"]["value"] == sum(row["crashed"] for row in mine) / len(mine) and cell["n"] == 10
    entry = next(e for e in made["entries"] if e["defence"] == "chi2_kf")
    assert entry["card"]["name"] == "chi2_kf" and entry["status"] == "unattacked" and entry["class"] == "measurements"
    white = next(r for r in entry["rates"] if r["knowledge"] == "white")
    assert white["worst"]["attack"].startswith("stealth") and white["undamaged"]["value"] == 1.0 - held["chi2_kf", white["worst"]["attack"]]["damage"]["value"]
    assert entry["worst_episode"]["crashed"] == 1.0 and "trace_hash" in entry["worst_episode"]


def test_built_in_suites_name_doses_that_have_a_reason() -> None:
    """Every new suite shows three doses, each with a sentence, and has the undefended car to compare with."""
    for name in ("car-following-v0", "platoon-v0", "radar-v0", "network-v0", "thesis-v0"):
        suite = load_suite(name)
        assert len(suite.shown) == 3 and all(len(why) > 10 for why in suite.shown.values())
        assert "none" in suite.attacks and ("none" in suite.defences or suite.bound is not None)


def _fits(text, brief):
    """Whether an attack can be prepared at all: what a threat model refuses, it refuses when it is played."""
    try:
        Spec("attack", text).make().prepare(brief)
    except InputError:
        return False
    except NotApplicable:
        return True
    return True


@pytest.mark.thin(6)
@pytest.mark.parametrize(
    "name", ["quick-v0", "car-following-v0", "platoon-v0", "radar-v0", "network-v0", "thesis-v0", pytest.param("highway-v0", marks=pytest.mark.long)]
)
def test_the_entries_of_a_published_board_met_every_built_in_attack_that_its_suite_grants(name) -> None:
    """Scripts, programs and all of the zoo: what they did not meet is refused, does nothing in any scenario, or is a ceiling. Nobody was spared."""
    suite, board = load_suite(name), json.loads((ROOT / f"results/{name}/board.json").read_text())
    if name == "highway-v0":
        pytest.importorskip("highway_env")
    met = {attack["attack"] for attack in board["attacks"]}
    assert met >= {*suite.attacks} - {"none"}
    heads = {text.split(":")[0] for text in met}
    others = [text for text, entry in entries("attack").items() if not (text in heads or entry.optimal or entry.learned)]
    programs = [f"program:path={path.stem}" for path in sorted((ROOT / "configs/attacks").glob("*.yaml"))]
    published = [f"zoo:name={policy}" for policy in zoo_names() if name != "quick-v0" or not policy.startswith("car-following-")]
    others += [text for text in (*programs, *published) if text not in met]  # those of car following play on quick-v0 since decision 54
    briefs = [load_scenario(scenario).with_threat(**suite.granted).brief() for scenario in suite.nominal]
    others = [text for text in others if any(_fits(text, brief) for brief in briefs)]  # a program may aim at wires that are not there
    ranked = [entry["defence"] for entry in board["entries"] if entry["status"] == "ranked"][:1]
    rows = evaluate(suite, defences=ranked, attacks=others, doses=[max(d for d in suite.doses if d)], scenarios=suite.nominal, seeds=1)
    assert len(rows) == len(others) * len(suite.nominal) > 0
    assert not {(row["attack"], row["status"]) for row in rows if row["status"] == "error" or row["attack_steps"]}
    shared = {text for text in met if not text.endswith(".json") or text in suite.attacks}  # files are of those that were trained against one
    for defence in suite.defences:
        assert {cell["attack"] for cell in board["cells"] if cell["defence"] == defence} >= shared, defence


# Why a suite leaves a built-in defence out that fits its plants (docs/scoring.md).
ALIKE = {"composed", "steered", "steered_cra", "filterpy_kf", "filterpy_ekf", "filterpy_ukf", "filterpy_imm"}  # as they stand, another one under a second name
TALKING = {
    "dkf", "norm_resilient", "lasso_dkf", "chi2_dkf", "saturated_dkf", "disagreement_dkf", "trust_dkf", "consensus_kf", "trimmed_consensus", "centralised_kf",
    "centralised_lasso", "dkf_oracle",
}  # fmt: skip
STEERING = {"always_brake", "stand_still", "brake_kf", "widen_kf"}  # in a network nobody drives, in a lane nobody brakes
ALONE = {"imm", "chi2_kf", "chi2_kf_sparse", "windowed_chi2_kf", "cusum_kf", "mewma_kf", "reacquire_kf", "cusum_reacquire_kf", "oracle"}  # lost there, as `kf`
FAILING = {"windowed_chi2_kf", "widen_kf", "brake_kf"}  # in a platoon, a gate: without an attack
SLOW = {"filterpy_hinfinity"}  # episode by episode
LATER = {"bernoulli", "envelope", "minimax", "watermark"}  # built after these suites were fixed; redundant-v0 plays the first and the third


@pytest.mark.parametrize("name", ["quick-v0", "car-following-v0", "platoon-v0", "radar-v0", pytest.param("network-v0", marks=pytest.mark.long), "thesis-v0", "highway-v0", "lane-v0"])
def test_a_suite_plays_every_built_in_defence_that_fits(name) -> None:
    """What it leaves out refuses one of its scenarios, is another one under a second name, has nobody to talk to or hours to go, or is lost without an attack."""
    if name == "highway-v0":
        pytest.importorskip("highway_env")
    suite = load_suite(name)
    sizes = {load_scenario(scenario).brief().model.agents for scenario in suite.scenarios}
    out = ALIKE | SLOW | LATER | (TALKING if sizes == {1} else set()) | (STEERING | ALONE if suite.bound is not None else set())
    out |= FAILING if name == "platoon-v0" else set()
    out |= STEERING if name == "lane-v0" else set()  # a mode changes nothing
    listed = {text.split(":")[0] for text in suite.defences}
    assert not listed & out
    others = [text for text in entries("defence") if text not in listed | out]
    places = [load_scenario(scenario).with_threat(**suite.threat) for scenario in suite.scenarios]
    for text in others:
        with pytest.raises(NotApplicable):
            for place in places:
                place.loop(make_defence(text), entries("defence")[text].uses)


@pytest.mark.long
def test_an_agent_alone_is_lost_in_the_weak_network_whatever_its_filter() -> None:
    """Without an attack, so that no gate can be passed: `kf` on the board says so for all of them."""
    suite = load_suite("network-v0")
    part = dataclasses.replace(suite, scenarios=("network-restless-weak-v0",), defences=("kf", "dkf", *sorted(ALONE)), attacks=("none",), seeds=4)
    errors = {(row["defence"], row["seed"]): row["max_error"] for row in evaluate(part, doses=[1])}
    assert all(error > suite.bound for (defence, _), error in errors.items() if defence != "dkf") and len(errors) == 4 * len(part.defences)
    assert all(error < suite.bound for (defence, _), error in errors.items() if defence == "dkf")


@pytest.mark.long
def test_detectors_that_are_off_where_sensors_are_noisier_than_told_fail_a_gate_of_a_platoon() -> None:
    """Those that are left out of its board, and `chi2_kf`, which is on it, does not."""
    noisy = {"scenarios": ("platoon-noisy-v0",), "robustness": ("platoon-noisy-v0",), "attacks": ("none",), "doses": (60,), "shown": {60: "6 s"}, "adaptive": {}}
    part = dataclasses.replace(load_suite("platoon-v0"), defences=("none", "chi2_kf", *sorted(FAILING)), seeds=6, **noisy)
    board = score(evaluate(part), part, require_adaptive=False)
    failed = {entry["defence"] for entry in board["entries"] if not all(gate["passed"] for gate in entry["gates"])}
    assert failed == FAILING


@pytest.mark.thin(3)
@pytest.mark.parametrize(("frame", "one"), [("composed", "chi2_kf"), ("steered", "chi2_kf"), ("steered_cra", "cra")])
def test_an_empty_frame_is_the_defence_that_it_holds(frame, one) -> None:
    """So a board that has the one needs not the other."""
    scenario, attack = ("radar-following-v0", make_attack("noise_jam", start_step=60)) if one == "cra" else ("stop-and-go-v0", make_attack("fdi", start_step=60, value=-5.0))
    loops = [load_scenario(scenario).loop(make_defence(name), entries("defence")[name].uses) for name in (frame, one)]
    first, second = (rollout(loop, attack, keys("report", range(4))).estimate for loop in loops)
    np.testing.assert_array_equal(first, second)


def test_every_plan_of_training_can_be_asked_for() -> None:
    """Each learner's environment takes the suite's threat model: a board cannot be scored without knowing what it asks for."""
    plans = {name: asked_of(suite) for name in list_suites() if (suite := load_suite(name)).adaptive}
    assert {"car-following-v0", "highway-v0", "network-v0", "platoon-v0", "quick-v0", "radar-v0", "thesis-v0"} <= set(plans)
    assert all(set(one.scenarios) <= set(load_suite(name).scenarios) and one.scenarios for name, asked in plans.items() for one in asked)


WHERE = ("stop-and-go-v0",)
ROAD = Suite("s", "", WHERE)


def few(*hours, episodes=8, most_steps=80_000):
    return Effort(hours, episodes, 20, most_steps)


@pytest.mark.long
def test_detection_holds_all_to_one_mean_time_between_false_alarms(monkeypatch) -> None:
    """A bias of ten standard deviations is seen at once at either threshold; the looser one is the higher; who has no score has none."""
    found = detection(ROAD, ["chi2_kf", "none"], ["fdi:start_step=100,value=-10"], few(0.02, 0.1), dose=20)
    tight, loose = found["entries"]
    assert tight["threshold"] < loose["threshold"] and [e["detected"]["value"] for e in (tight, loose)] == [1.0, 1.0]
    assert tight["delay"] <= loose["delay"] <= 1.0 and 0.6 < tight["detected"]["low"] < 1.0
    assert {(w["defence"], w["hours"]) for w in found["without"]} == {("none", 0.02), ("none", 0.1)} and "score" in found["without"][0]["reason"]


def test_a_mean_time_that_is_out_of_reach_is_listed_and_not_an_error() -> None:
    """10 h need more steps than were allowed."""
    found = detection(ROAD, ["chi2_kf"], ["none"], few(10.0, episodes=2, most_steps=1000))
    assert not found["entries"] and "hours" in found["without"][0]["reason"]


@pytest.mark.long
def test_the_looser_threshold_lets_a_stealthy_attacker_further() -> None:
    """The curve of deviation against false-alarm time rises; who has no score has none."""
    curve = stealth_impact(ROAD, "chi2_kf", few(0.02, 0.1), dose=100)
    assert [p["hours"] for p in curve] == [0.02, 0.1] and 0.0 < curve[0]["deviation"] < curve[1]["deviation"]
    assert all(p["low"] < p["deviation"] < p["high"] and "reason" not in p for p in curve)
    assert stealth_impact(ROAD, "none", few(0.02)) is None


@pytest.mark.long
def test_of_a_deviation_that_is_missing_the_reason_is_given() -> None:
    """`imm` shows no gate to stay below; a mean time that is out of reach has no threshold; five episodes have a median without limits."""
    [shut] = stealth_impact(ROAD, "imm", few(0.02, episodes=2))
    assert shut["threshold"] is not None and shut["deviation"] is shut["low"] is shut["high"] is None and "innovation" in shut["reason"]
    near, far = stealth_impact(ROAD, "chi2_kf", few(0.02, 10.0, episodes=5), dose=20)
    assert far["threshold"] is None and "hours" in far["reason"] and near["deviation"] > 0.0 and near["low"] is near["high"] is None


def test_what_comes_after_an_attack_is_no_deviation() -> None:
    """A gate stays shut on honest readings after a jump, and the error grows; what counts is the largest while the attack lasts."""
    loop = load_scenario("stop-and-go-v0").with_threat(kinds=("fdi",), fdi_bound=500.0, budget=10).loop(make_defence("chi2_kf"), ("measurements",))
    trace = rollout(loop, make_attack("fdi_ramp", start_step=100, rate=-1.0, limit=100), keys("report", range(6)))
    attacked = (trace.kind != 0) & trace.live
    error = trace.model.error(trace.estimate, trace.truth)[..., 0]
    for b, value in enumerate(deviation(trace)):
        during = error[attacked[:, b], b]
        assert len(during) == 10 and value == pytest.approx(during.max() / 1.0)
    assert (max_error(trace) > 1.2 * deviation(trace)).any()
    assert np.isnan(deviation(rollout(loop, make_attack("none"), keys("report", [0])))).all()


def test_scenarios_of_one_plant_share_a_threshold() -> None:
    """Groups by what is driven and how much of it is read: fourteen readings have another chi-square than two."""
    assert plants(["stop-and-go-v0", "braking-v0", "thesis-ch5-v0"]) == {
        "CarFollowing": ("stop-and-go-v0", "braking-v0"), "SensorNetwork": ("thesis-ch5-v0",),
    }  # fmt: skip
    both = plants(["network-restless-v0", "stop-and-go-v0", "network-restless-weak-v0"])
    assert list(both.values()) == [("network-restless-v0",), ("stop-and-go-v0",), ("network-restless-weak-v0",)]
    assert list(both)[2] == "SensorNetwork of 10 agents with 10 states and 2 readings each"
    assert math.isfinite(threshold("chi2_kf", WHERE, 0.02, 20, 80_000).threshold)
