"""Mitigations: each law on verdicts by hand, and what it means for a car: lock-outs that end, receivers that hold, gaps that widen."""

import dataclasses
import functools

import numpy as np
import pytest

import tailgate
from tailgate.core import Mode, Received
from tailgate.core.registry import Spec, entries
from tailgate.core.scenario import load_scenario
from tailgate.estimators import AcceptAll, Brake, GateOut, Hold, Latch, Reacquire, Verdict, Widen

MODEL = load_scenario("stop-and-go-v0").brief().model  # one agent, two sensors, 0.1 s
POLICIES = [AcceptAll(), GateOut(), GateOut(latch=2), Latch(3), Hold(), Reacquire()]


def judge(mitigation, suspect, valid=None, y=None, alarm=None):
    """Decisions of one agent on suspects (K, 2) or (K,), as arrays: accept (K, 2), mode, instead, forget."""
    suspect = np.asarray(suspect, bool)
    suspect = np.repeat(suspect[:, None], 2, axis=1) if suspect.ndim == 1 else suspect
    valid = np.ones_like(suspect) if valid is None else np.asarray(valid, bool)
    y = np.arange(2.0 * len(suspect)).reshape(-1, 2) if y is None else np.asarray(y, float)
    plan = mitigation.prepare(MODEL)
    state = mitigation.start(plan, 1)
    out = {"accept": [], "mode": [], "instead": [], "forget": []}
    for k in range(len(suspect)):
        raised = suspect[k].any() if alarm is None else alarm[k]
        verdict = Verdict(np.zeros((1, 1)), np.array([[raised]]), suspect[k][None, None])
        state, decision = mitigation.step(plan, state, verdict, Received(y[k][None, None], valid[k][None, None], np.zeros((1, 1))))
        assert decision.accept.shape == (1, 1, 2) and decision.accept.dtype == bool and decision.mode.dtype == np.int8
        out["accept"].append(decision.accept[0, 0])
        out["mode"].append(decision.mode[0, 0])
        out["instead"].append(None if decision.instead is None else decision.instead[0, 0])
        out["forget"].append(decision.forget is not None and bool(decision.forget[0, 0]))
    return {name: np.array(values) for name, values in out.items()}


def test_gate_out_by_sensor():
    """Exactly the readings that arrived and are not suspected are used; alarms without a suspect shut nothing."""
    suspect, valid = [[0, 0], [1, 0], [1, 1], [0, 0], [0, 1]], [[1, 1], [1, 1], [1, 1], [1, 0], [0, 1]]
    out = judge(GateOut(), suspect, valid, alarm=[True] * 5)
    assert out["accept"].tolist() == [[True, True], [False, True], [False, False], [True, False], [False, False]]
    assert not out["forget"].any() and set(out["instead"]) == {None} and not out["mode"].any()


def test_accept_all_uses_what_arrived():
    """Suspects are used, missing readings are not."""
    assert judge(AcceptAll(), [1, 1, 0], [[1, 1], [0, 1], [1, 0]])["accept"].tolist() == [[True, True], [False, True], [True, False]]


def test_latch_by_hand():
    """The gate stays shut for the steps after the last suspicion, each sensor by itself."""
    suspect = [[1, 0], [0, 0], [0, 1], [0, 0], [0, 0], [0, 0]]
    accept = judge(Latch(2), suspect)["accept"]
    assert accept[:, 0].tolist() == [False, False, False, True, True, True]
    assert accept[:, 1].tolist() == [True, True, False, False, False, True]
    np.testing.assert_array_equal(judge(Latch(0), suspect)["accept"], judge(GateOut(), suspect)["accept"])
    np.testing.assert_array_equal(judge(GateOut(latch=2), suspect)["accept"], accept)
    assert judge(Latch(2), [1, 0, 1, 0, 0, 0])["accept"][:, 0].tolist() == [False, False, False, False, False, True]


def test_hold_by_hand():
    """A suspected or missing reading is the last accepted one of its sensor; before there is one, the sensor is not used."""
    y = [[1.0, 10.0], [2.0, 20.0], [3.0, 30.0], [4.0, 40.0], [5.0, 50.0]]
    out = judge(Hold(), [[1, 0], [0, 1], [0, 0], [1, 1], [0, 0]], [[1, 1], [1, 1], [1, 0], [1, 1], [0, 1]], y)
    assert out["instead"][1:].tolist() == [[2.0, 10.0], [3.0, 10.0], [3.0, 10.0], [3.0, 50.0]]
    assert out["accept"].tolist() == [[False, True], *[[True, True]] * 4] and out["instead"][0][1] == 10.0
    latched = judge(Hold(latch=1), [0, 1, 0, 0], y=y[:4])["instead"]
    assert latched.tolist() == [y[0], y[0], y[0], y[3]]


def test_a_receiver_that_holds_turns_jamming_into_618(short, play):
    """kf + hold, which finds the jammed samples by their size, estimates to the last bit what kf does under the attack (6.18)."""
    place = short(horizon=80, jam_range=(-1e6, 1e6))
    holds = Spec("defence", "composed:detector.eta=1e6,mitigation=hold").make()
    window = {"start_step": 30, "length": 12}
    jammed = play(place, holds, tailgate.make_attack("dos_jam", low=1e5, high=2e5, **window), range(5), terminate=False)
    held = play(place, "kf", tailgate.make_attack("dos_hold", **window), range(5), terminate=False)
    np.testing.assert_array_equal(jammed.alarm[:, :, 0], held.kind != 0)
    np.testing.assert_array_equal(jammed.estimate, held.estimate)
    np.testing.assert_array_equal(jammed.gap, held.gap)


def test_reacquire_by_hand():
    """After `after` rejections of a sensor in a row the next reading is believed and the filter forgets; then the count starts again."""
    out = judge(Reacquire(after=2), [1, 1, 1, 1, 1, 1, 0, 1, 1, 0, 1])
    assert out["accept"][:, 0].tolist() == [False, False, True, False, False, True, True, False, False, True, False]
    assert np.flatnonzero(out["forget"]).tolist() == [2, 5]
    by_sensor = judge(Reacquire(after=2), [[1, 0], [1, 1], [1, 1], [0, 1], [0, 1]])
    assert by_sensor["accept"].tolist() == [[False, True], [False, False], [True, False], [True, True], [True, False]]
    assert np.flatnonzero(by_sensor["forget"]).tolist() == [2, 3]


def test_reacquire_does_not_count_what_is_missing():
    """A missing reading neither counts as rejected, nor breaks the row, nor is believed."""
    lost = [[1, 1], [0, 0], [1, 1], [0, 0], [1, 1]]
    out = judge(Reacquire(after=2), [1, 1, 1, 1, 1], lost)
    assert out["accept"][:, 0].tolist() == [False, False, False, False, True] and np.flatnonzero(out["forget"]).tolist() == [4]


def test_reacquire_opens_a_latched_gate():
    """Steps that the latch shuts count as rejected, and what is believed again ends the latch."""
    out = judge(Reacquire(latch=3, after=2), [1, 0, 0, 0, 1, 0, 0, 0])
    assert out["accept"][:, 0].tolist() == [False, False, True, True, False, False, True, True]


@pytest.mark.parametrize("policy", POLICIES, ids=repr)
@pytest.mark.parametrize("name", ["widen", "brake", "stop"])
def test_every_policy_takes_a_mode(name, policy):
    """The mode is asked for while alarmed and `linger` seconds after, and changes nothing of what is accepted."""
    suspect = [0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0, 0]
    plain, loud = judge(policy, suspect), judge(dataclasses.replace(policy, mode=name, linger=0.3), suspect)
    assert not plain["mode"].any()
    assert loud["mode"].tolist() == [m * int(Mode[name.upper()]) for m in [0, 1, 1, 1, 1, 0, 1, 1, 1, 1, 1, 0, 0]]
    for what in ("accept", "forget"):
        np.testing.assert_array_equal(loud[what], plain[what])
    quick = judge(dataclasses.replace(policy, mode=name, linger=0.0), suspect)["mode"]
    np.testing.assert_array_equal(quick != 0, suspect)


def test_presets():
    """`widen` and `brake` are `gate_out` with a mode, `latch` with a longer gate."""
    suspect = [0, 1, 0, 0, 1, 1] + [0] * 30
    for preset, plain in ((Widen(), GateOut(mode="widen")), (Brake(linger=1.0), GateOut(mode="brake", linger=1.0)), (Latch(), GateOut(10))):
        one, two = judge(preset, suspect), judge(plain, suspect)
        np.testing.assert_array_equal(one["accept"], two["accept"])
        np.testing.assert_array_equal(one["mode"], two["mode"])
    assert judge(Widen(), suspect)["mode"].any()


@pytest.mark.parametrize("name", [n for n in entries("mitigation") if n not in ("acc_fallback", "input_clip", "sliding_mode")])
def test_no_mitigation_uses_what_did_not_arrive(name):
    """Without a reading nothing of that step is accepted: a sensor that never arrived is not used."""
    rng = np.random.default_rng(3)
    suspect, valid = rng.uniform(size=(60, 2)) < 0.1, rng.uniform(size=(60, 2)) < 0.5
    valid[:, 1] = False
    y = np.where(valid, 1.0, np.nan)
    out = judge(tailgate.core.registry.make("mitigation", name), suspect, valid, y)
    assert out["accept"][:, 0].any() and not out["accept"][:, 1].any()
    used = y if out["instead"][0] is None else out["instead"]
    assert np.isfinite(used[out["accept"]]).all()


def right_again(trace, last):
    """(B,) time [s] from step `last` until the position estimate stays within 1.5 m; inf where it does not."""
    wrong = np.abs(trace.estimate[:, :, 0, 0] - trace.truth[:, :, 0, 0]) > 1.5
    steps = np.max(np.where(wrong, np.arange(1, len(wrong) + 1)[:, None], last), axis=0)
    return np.where(steps == len(wrong), np.inf, (steps - last) * trace.dt)


@pytest.fixture(scope="module")
def biased(play):
    """stop-and-go-v0 with a bias of -3 for 15 steps from step 200 on, then a jammer for some steps."""

    @functools.cache
    def run(defence, jammed):
        name = "fdi_then_jam" if jammed else "fdi"
        extra = {"inject": 15} if jammed else {}
        attack = tailgate.make_attack(name, value=-3.0, start_step=200, length=15 + jammed, **extra)
        trace = play(load_scenario("stop-and-go-v0"), Spec("defence", defence).make(), attack, range(100), terminate=False)
        return trace, right_again(trace, 214 + jammed)

    return run


@pytest.mark.long
def test_reacquire_ends_the_lock_out(biased):
    """After a bias of 3 m for 15 steps, and 15 steps of jamming: with gate_out one run in ten or more never recovers, with reacquire all do."""
    _, gate_out = biased("chi2_kf:eta=20", 15)
    _, reacquire = biased("reacquire_kf:eta=20", 15)
    assert np.quantile(gate_out, 0.9) > 20.0
    assert np.quantile(reacquire, 0.9) < 2.0 and reacquire.max() < 4.0
    assert biased("reacquire_kf:eta=20", 0)[1].max() < 4.0


def test_reacquire_believes_an_attacker_who_lies_for_long_enough(biased):
    """A jammer that outlasts `after` rejections is believed: the estimate is hundreds of metres off, which gate_out never is."""
    trace, _ = biased("reacquire_kf:eta=20,after=10", 15)
    error = np.abs(trace.estimate - trace.truth)[199:235, :, 0, 0].max(axis=0)
    assert np.median(error) > 100.0
    trace, _ = biased("chi2_kf:eta=20", 15)
    assert np.abs(trace.estimate - trace.truth)[199:235, :, 0, 0].max() < 20.0


def test_modes_reach_the_controller(short, play):
    """Alarms that never end: `widen` drives at a gap half as long again, `brake` and `stop` slow the car down, `stop` the faster."""
    place = short("braking-v0", horizon=240)
    speed, gap = {}, {}
    for mode in ("normal", "widen", "brake", "stop"):
        loud = Spec("defence", f"composed:detector.eta=0.01,mitigation=accept_all,mitigation.mode={mode},mitigation.linger=60").make()
        trace = play(place, loud, "none", range(8), terminate=False)
        speed[mode], gap[mode] = trace.speed[..., 0], trace.gap[..., 0]
    assert (gap["widen"][-1] > 1.3 * gap["normal"][-1]).all()
    assert (speed["brake"][50] < speed["normal"][50] - 5.0).all() and (speed["stop"][50] < speed["brake"][50] - 5.0).all()
    assert (speed["stop"][-1] < 1.0).all()
