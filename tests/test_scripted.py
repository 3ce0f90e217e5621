"""What the built-in attacks send and when, and what a learner is paid for."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate.agents.scripts import scripted
from tailgate.agents.scripts.values import Gamma
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind
from tailgate.core.draws import Role, keys
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout

K = 60


@pytest.fixture(scope="module")
def sends(short, play):
    """The trace of a script against the Kalman filter, without an end at collisions; `seeds` rows."""

    def run(name, seeds=4, threat=None, scenario="stop-and-go-v0", horizon=K, **params):
        place = short(scenario, horizon=horizon, **({"onset": 1} | (threat or {})))
        return play(place, "kf", tailgate.make_attack(name, **params), range(seeds), terminate=False)

    return run


def steps(trace, row=0):
    """Steps (from 1) in which an attack took effect."""
    return (np.flatnonzero(trace.kind[:, row]) + 1).tolist()


def test_none_sends_nothing(sends):
    """No command, none refused, every wire as sent."""
    trace = sends("none")
    assert not trace.kind.any() and not trace.refused.any()
    np.testing.assert_array_equal(trace.wires, trace.clean)


def test_a_window_of_time(sends):
    """A script opens at start_step, or at the onset if that is later, and lasts `length` steps."""
    assert steps(sends("fdi", start_step=20, length=5)) == [20, 21, 22, 23, 24]
    assert steps(sends("fdi", start_step=20, length=5, threat={"onset": 30})) == [30, 31, 32, 33, 34]
    assert steps(sends("fdi", start_step=50)) == list(range(50, K + 1))


def test_bursts_and_pauses(sends):
    """Inside its window a script that pulses attacks `burst` steps, rests `pause` of them, and begins again."""
    assert steps(sends("fdi", start_step=20, burst=2, pause=3, length=12)) == [20, 21, 25, 26, 30, 31]
    assert steps(sends("dos_jam", start_step=50, burst=1, pause=4, threat={"budget": 2})) == [50, 55]
    assert steps(sends("fdi", start_step=55, burst=3, pause=0)) == list(range(55, K + 1))


@pytest.mark.long
def test_signs_are_the_wires_own(sends):
    """With `signs` each wire has its own sign, the same in every step and episode; two seeds differ, without it all are alike."""
    seen = {}
    for seed in (None, *range(8)):
        value = sends("fdi", value=4.0, signs=seed, threat={"fdi_bound": 5.0}).value[:, :, 0, :2]
        assert (np.abs(value) == 4.0).all() and (value == value[0, 0]).all()
        seen[seed] = tuple(np.sign(value[0, 0]).tolist())
    assert seen[None] == (1.0, 1.0) and len(set(seen.values())) == 4


def test_a_script_never_asks_in_vain(sends):
    """Budget, duration, cooldown and end silence a script: nothing is refused."""
    trace = sends("fdi", threat={"budget": 9, "duration": 4, "cooldown": 2, "end": 40})
    assert not trace.refused.any() and len(steps(trace)) == 9
    trace = sends("fdi", start_step=30, threat={"end": 40})
    assert not trace.refused.any() and steps(trace) == list(range(30, 41))


@pytest.mark.parametrize("trigger, threshold", [("near", 60.0), ("closing", 1.0)])
def test_a_window_of_the_road(trigger, threshold, sends):
    """near: opens when the gap passes the threshold; closing: when the closing speed does; then stays open."""
    trace = sends("dropout", trigger=trigger, threshold=threshold, length=30, scenario="braking-v0", horizon=400)
    for row in range(4):
        gap = np.concatenate([[np.nan], trace.gap[:-1, row, 0]])  # the road before the step
        closing = np.concatenate([[np.nan], (trace.speed - trace.lead_speed)[:-1, row, 0]])
        hit = gap < threshold if trigger == "near" else closing > threshold
        first = int(np.argmax(hit)) + 1
        assert hit.any() and first > 1
        assert steps(trace, row) == list(range(first, first + 30))


def test_constant_bias(sends):
    """fdi adds its value to every granted wire, or to those it names."""
    trace = sends("fdi", value=-7.0)
    np.testing.assert_allclose(trace.wires[..., :2] - trace.clean[..., :2], -7.0, atol=1e-11)
    trace = sends("fdi", value=3.0, targets=("velocity",))
    np.testing.assert_array_equal(trace.wires[..., 0], trace.clean[..., 0])
    np.testing.assert_allclose((trace.wires - trace.clean)[..., 1], 3.0, atol=1e-11)


def test_ramp(sends):
    """fdi_ramp adds rate, 2 rate, ... from the opening of its window, up to its limit and the threat model's bound."""
    grown = -0.5 * np.arange(1, K + 1)
    trace = sends("fdi_ramp", rate=-0.5, limit=8.0, targets=("position",))
    np.testing.assert_array_equal(trace.value[:, 0, 0, 0], np.maximum(grown, -8.0))
    trace = sends("fdi_ramp", rate=-0.5, threat={"fdi_bound": 6.0}, targets=("position",))
    np.testing.assert_array_equal(trace.value[:, 0, 0, 0], np.maximum(grown, -6.0))
    assert not trace.refused.any()


def test_gaussian_injection(sends):
    """fdi_gaussian has its mean and deviation, independent between wires, and never exceeds the bound."""
    trace = sends("fdi_gaussian", seeds=200, mean=1.0, sd=3.0)
    value = trace.value[..., 0, :2].reshape(-1, 2)
    n = len(value)
    assert np.max(np.abs(value.mean(axis=0) - 1.0)) < 5 * 3.0 / math.sqrt(n)
    assert np.max(np.abs(value.std(axis=0) / 3.0 - 1)) < 5 / math.sqrt(2 * n)
    assert abs(np.corrcoef(value.T)[0, 1]) < 5 / math.sqrt(n)
    tight = sends("fdi_gaussian", sd=30.0, threat={"fdi_bound": 5.0})
    assert np.max(np.abs(tight.value)) == 5.0 and not tight.refused.any()


def test_bernoulli_injection(sends):
    """fdi_bernoulli hits each wire by itself with its probability, always by the same value."""
    trace = sends("fdi_bernoulli", seeds=200, probability=0.3, value=-2.0)
    hit = trace.target[..., 0, :2].reshape(-1, 2)
    n, share = len(hit), hit.mean(axis=0)
    assert np.max(np.abs(share - 0.3)) < 5 * math.sqrt(0.21 / n)
    assert abs((hit[:, 0] & hit[:, 1]).mean() - 0.09) < 5 * math.sqrt(0.0819 / n)
    assert set(np.unique(trace.value)) == {-2.0, 0.0}


def test_jammer(sends):
    """dos_jam leaves uniform values of its range on every granted wire."""
    trace = sends("dos_jam", seeds=200, low=-10.0, high=30.0)
    heard = trace.wires[..., 0, :2].ravel()
    n = heard.size
    assert heard.min() >= -10.0 and heard.max() <= 30.0
    assert abs(heard.mean() - 10.0) < 5 * 40 / math.sqrt(12 * n)
    assert abs(heard.var() / (1600 / 12) - 1) < 5 * math.sqrt(0.8 / n)


def test_hold(sends):
    """dos_hold repeats the sample before its first step throughout; the drop-out lets the receiver know."""
    trace = sends("dos_hold", start_step=20)
    np.testing.assert_array_equal(trace.wires[19:, :, 0, :2], np.broadcast_to(trace.clean[18, :, 0, :2], (K - 19, 4, 2)))
    fresh = sends("dos_hold", start_step=20, fresh=True, threat={"duration": 5})
    assert set(np.unique(fresh.kind)) == {Kind.NONE, Kind.DOS_HOLD_FRESH}
    second = next(k for k in steps(fresh) if k > 25)
    np.testing.assert_array_equal(fresh.wires[second - 1, :, 0, :2], fresh.clean[second - 2, :, 0, :2])


def test_dropout_with_a_probability(sends):
    """Each wire loses each sample by itself; with probability 1 every one."""
    trace = sends("dropout", seeds=200, probability=0.3)
    lost = trace.target[..., 0, :2].reshape(-1, 2)
    assert np.max(np.abs(lost.mean(axis=0) - 0.3)) < 5 * math.sqrt(0.21 / len(lost))
    assert abs((lost[:, 0] & lost[:, 1]).mean() - 0.09) < 5 * math.sqrt(0.0819 / len(lost))
    assert sends("dropout").target[..., :2].all() and not trace.refused.any()


def test_uniform_injection(sends):
    """fdi_uniform is uniform on its range and is cut at the bound."""
    trace = sends("fdi_uniform", seeds=100, low=-6.0, high=2.0)
    assert stats.kstest(trace.value[..., 0, :2].ravel(), stats.uniform(-6.0, 8.0).cdf).pvalue > 1e-3
    tight = sends("fdi_uniform", low=-6.0, high=2.0, threat={"fdi_bound": 5.0})
    assert tight.value.min() == -5.0 and not tight.refused.any()


@pytest.mark.parametrize("shape", [0.5, 1.0, 2.0, 3.5])
def test_gamma_magnitudes(shape, short):
    """The law is the gamma distribution, with one sign or both; other wires and steps are independent."""
    brief = short().brief()
    draws = keys("train", range(1500)).at(Role.ATTACK, np.full(1500, 3))
    values = Gamma(shape=shape, scale=2.0, sign=-1).sample(brief, np.zeros(1500), draws)
    assert values.shape == (1500, 1, 5)
    assert stats.kstest(-values.ravel(), stats.gamma(shape, scale=2.0).cdf).pvalue > 1e-3
    assert abs(np.corrcoef(values[:, 0, 0], values[:, 0, 1])[0, 1]) < 5 / math.sqrt(1500)
    both = Gamma(shape=shape, scale=2.0, sign=0).sample(brief, np.zeros(1500), draws)
    np.testing.assert_array_equal(np.abs(both), -values)
    assert abs((both > 0).mean() - 0.5) < 5 * 0.5 / math.sqrt(both.size)
    assert abs(np.corrcoef((both > 0).ravel(), np.abs(both).ravel())[0, 1]) < 5 / math.sqrt(both.size)


def test_sparse_injection(sends):
    """Thesis 4.7: from k_f on, each sensor is hit by itself with its own probability; the values do not depend on the hits."""
    trace = sends("fdi_sparse", seeds=200, probability=[0.1, 0.6], targets=["velocity", "position"], start_step=11, value={"name": "gaussian", "mean": 3.0, "sd": 1.0})
    assert not trace.kind[:10].any() and not trace.refused.any()
    hit = trace.target[10:, :, 0, :2].reshape(-1, 2)
    assert np.max(np.abs(hit.mean(axis=0) - [0.6, 0.1])) < 5 * math.sqrt(0.24 / len(hit))
    assert abs((hit[:, 0] & hit[:, 1]).mean() - 0.06) < 5 * math.sqrt(0.06 / len(hit))
    values = trace.value[10:, :, 0, :2].reshape(-1, 2)[hit]
    assert abs(values.mean() - 3.0) < 5 / math.sqrt(values.size) and abs(values.std() - 1.0) < 5 / math.sqrt(2 * values.size)
    assert stats.kstest(values, stats.norm(3.0, 1.0).cdf).pvalue > 1e-3


def test_sparse_injection_as_text(sends):
    """The law and its parameters, per sensor too, can be written as a command line writes them."""
    spec = tailgate.core.registry.Spec("attack", "fdi_sparse:probability=1,value=gamma,value.shape=1.5,value.sign=1")
    assert spec.make().law == Gamma(shape=1.5, sign=1)
    per = sends("fdi_sparse", probability=1.0, value={"position": 2.0, "velocity": {"name": "ramp", "rate": 0.5}})
    np.testing.assert_array_equal(per.value[:, 0, 0, 0], 2.0)
    np.testing.assert_array_equal(per.value[:, 0, 0, 1], 0.5 * np.arange(1, K + 1))


@pytest.mark.parametrize(
    "params, message",
    [
        ({"value": "gamm"}, r"fdi_sparse\.value\.name: got 'gamm'.*did you mean 'gamma'"), ({"value": {"name": "gamma", "shape": 0.3}}, r"value\.shape"),
        ({"probability": [0.1, 0.2, 0.3]}, r"probability: got .*expected one number, or one for each of position, velocity"),
        ({"probability": 1.2}, "probability"), ({"value": {"position": 1.0}}, "'velocity' has none"),
    ],
)  # fmt: skip
def test_wrong_sparse_injections_are_refused(params, message, short):
    """A wrong law, or more probabilities than targets, is an input error."""
    with pytest.raises(InputError, match=message):
        tailgate.make_attack("fdi_sparse", **params).prepare(short().brief())


OLD = {"kinds": ("fdi", "delay", "replay")}


def test_delay(sends):
    """The receiver reads what was sent `age` steps ago, on its targets."""
    trace = sends("delay", age=7, start_step=20, targets=["position"], threat=OLD)
    np.testing.assert_array_equal(trace.wires[19:, :, 0, 0], trace.clean[12:-7, :, 0, 0])
    np.testing.assert_array_equal(trace.wires[..., 1], trace.clean[..., 1])


def test_replay(sends):
    """The receiver reads the `window` samples before the attack, over and over."""
    trace = sends("replay", window=8, start_step=20, length=20, threat=OLD)
    recorded = trace.clean[11:19, :, 0, :2]
    np.testing.assert_array_equal(trace.wires[19:39, :, 0, :2], np.concatenate([recorded, recorded, recorded[:4]]))
    np.testing.assert_array_equal(trace.wires[39:], trace.clean[39:])


def test_a_replayed_speed_passes_the_gate_in_a_steady_cruise_and_a_replayed_position_does_not(short, play):
    """Thesis 4.7: a replay without a change of level escapes the chi-square detector."""
    place = dataclasses.replace(short("stop-and-go-v0", horizon=300, onset=1, **OLD), manoeuvre=tailgate.core.registry.make("manoeuvre", "constant", value=0.0))
    rate = {}
    for name in ("velocity", "position"):
        trace = play(place, "chi2_kf", tailgate.make_attack("replay", start_step=200, targets=(name,)), range(40), terminate=False)
        rate[name] = trace.alarm[trace.kind != 0].mean()
    assert rate["velocity"] < 0.005 and rate["position"] > 0.99


def test_actuator_injection(sends):
    """The actuator gets the command and the bias, cut at its bound; sensors and the defence's knowledge stay as they are."""
    grant = {"targets": ("position", "acceleration"), "actuator_bound": 1.5}
    for value, arrives in ((-1.0, -1.0), (9.0, 1.5)):
        trace = sends("actuator_fdi", value=value, start_step=10, threat=grant)
        np.testing.assert_allclose((trace.applied - trace.control)[9:], arrives, atol=1e-12)
        np.testing.assert_array_equal(trace.applied[:9], trace.control[:9])
        np.testing.assert_array_equal(trace.wires, trace.clean)
        assert not trace.refused.any()


@pytest.mark.parametrize(
    "name, params, message",
    [
        ("delay", {}, "grants delay"), ("replay", {}, "grants replay"), ("delay", {"age": 51, "threat": OLD}, "at most threat_model.memory"),
        ("replay", {"targets": ["leader_velocity"], "threat": OLD}, "grants leader_velocity"), ("actuator_fdi", {}, "grants acceleration"),
        ("fdi_uniform", {"threat": {"kinds": ("dropout",)}}, "grants fdi"), ("fdi_sparse", {"threat": {"kinds": ("dropout",)}}, "grants fdi"),
    ],
)  # fmt: skip
def test_what_is_not_granted_is_not_applicable(name, params, message, sends):
    """Attacks that need more than the threat model grants say what, before the first step."""
    with pytest.raises(NotApplicable, match=message):
        sends(name, **params)


def test_actuator_injection_has_no_other_targets(short):
    """A sensor as its target is an input error that lists the actuators."""
    with pytest.raises(InputError, match=r"actuator_fdi\.targets: got 'position'; expected actuators \(acceleration\)"):
        tailgate.make_attack("actuator_fdi", targets=("position",)).prepare(short().brief())


@pytest.mark.thin(2)
@pytest.mark.parametrize("name, targets", [("delay", ()), ("replay", ()), ("actuator_fdi", ("acceleration",)), ("fdi_sparse", ()), ("fdi_uniform", ())])
def test_rows_do_not_depend_on_their_batch(name, targets, short, loop_of, same_rows):
    """With what they need granted: alone, among 3 or among 16; budget and cooldown hold; before the onset nothing differs."""
    loop = loop_of(short(targets=targets, onset=25, budget=15, duration=4, cooldown=2, **OLD), "chi2_kf")
    attack = tailgate.make_attack(name)
    whole = same_rows(lambda seeds: rollout(loop, attack, keys("train", seeds), terminate=False), 16, [7], [9, 0, 15])
    clean = rollout(loop, tailgate.make_attack("none"), keys("train", range(16)), terminate=False)
    for signal in clean.signals:
        np.testing.assert_array_equal(whole.signals[signal][:24], clean.signals[signal][:24], err_msg=signal)
    assert ((whole.kind != 0).sum(axis=0) <= 15).all() and not whole.refused.any() and not np.array_equal(whole.estimate, clean.estimate)


@pytest.mark.parametrize("kind, times", [("fdi", scripted.THESIS_FDI_STEPS), ("dos", scripted.THESIS_DOS_STEPS)])
def test_thesis_times(kind, times, short, play):
    """The attack steps of figures 4.5 and 4.6, on the case study they belong to."""
    place = load_scenario("thesis-ch4-v0")
    trace = play(place, "kf", tailgate.make_attack("thesis_times", kind=kind), range(50), terminate=False)
    assert steps(trace) == list(times) and not trace.refused.any()
    value = trace.value[np.array(times) - 1][..., :2]
    low, high = (0.0, 77.0) if kind == "fdi" else (-108.0, 108.0)
    assert low <= value.min() < low + 3 and high - 3 < value.max() <= high


def test_stealth_needs_a_white_box(short, play):
    """Without the knowledge it says so; against a defence without an innovation the pairing has no meaning."""
    with pytest.raises(InputError, match=r"threat_model\.knowledge: got 'black'; expected white"):
        play(short(), "kf", tailgate.make_attack("stealth"), [0])
    with pytest.raises(NotApplicable, match="look"):
        play(short(), "none", "stealth", [0])


@pytest.mark.parametrize("state, sign", [(0, -1), (0, 1), (1, 1), (2, -1)])
def test_stealth_pushes_the_state_it_names(state, sign, short, play):
    """Each direction is pushed in its sense, without an alarm."""
    place = short(horizon=40, fdi_bound=1e4, knowledge="white")
    trace = play(place, "chi2_kf", tailgate.make_attack("stealth", state_index=state, sign=sign), range(8), terminate=False)
    error = (trace.estimate - trace.truth)[-1, :, 0, state] * sign
    assert error.min() > 0.1 and not trace.alarm[9:].any()


@pytest.mark.parametrize("bad", [{"targets": ("speed",)}, {"targets": ("position", "sonar")}])
def test_unknown_targets_are_refused(bad, short):
    """A script names wires that exist."""
    with pytest.raises(InputError, match=r"attack targets.*position, velocity"):
        tailgate.make_attack("fdi", **bad).prepare(short().brief())


def test_an_inverted_jammer_is_refused():
    """low above high is an input error that names the field."""
    with pytest.raises(InputError, match=r"dos_jam\.low: got 2\.0; expected at most high \(1\.0\)"):
        tailgate.make_attack("dos_jam", low=2.0, high=1.0)


def test_rollout_stops_when_all_have_crashed(short, loop_of):
    """With termination the trace ends with the last collision; without, at the horizon."""
    attack = tailgate.make_attack("fdi", value=-50.0)
    loop = loop_of(short("braking-v0", horizon=600), "none")
    held = tailgate.core.draws.keys("train", range(4))
    ended, full = rollout(loop, attack, held), rollout(loop, attack, held, terminate=False)
    assert len(ended.kind) == ended.length.max() < 600 == len(full.kind)
    last = ended.length - 1
    assert (ended.collided | ended.rear_collided)[last, range(4)].all()


def test_nobody_can_rewrite_the_model(short):
    """The public model is handed to attacks and defences: its arrays are copies, and read-only."""
    loop = short().loop(tailgate.make_defence("kf"))
    for name in ("A", "B", "c", "C", "Q", "R", "graph"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(loop.brief.model, name)[...] = 0
