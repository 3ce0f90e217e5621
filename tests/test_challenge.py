"""Challenge-response authentication: what a challenge hears, what an alarm undoes, and who is beaten by whom in the thesis's case study."""

import dataclasses

import numpy as np
import pytest
from scipy import stats

import tailgate
from tailgate.base.errors import InputError
from tailgate.base.pytree import leaves
from tailgate.core import Mode, Prior, Received
from tailgate.core.draws import Keys, Role, keys
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.envs.sensors.fmcw import false_alarm_threshold
from tailgate.play.trace import rollout

FIXED = "cra:challenge=fixed"
JAM, LATE = "radar_jam:start_step=182", "echo_delay:start_step=180,delay=6"


class Spy:
    """A defence that keeps what it was given and what it answered."""

    def __init__(self, inner):
        self.inner, self.seen = inner, []

    def prepare(self, model):
        return self.inner.prepare(model)

    def start(self, plan, prior):
        self.prior = prior
        return self.inner.start(plan, prior)

    def step(self, plan, state, received, known_u, draws):
        after, estimate = self.inner.step(plan, state, received, known_u, draws)
        self.seen.append((received, known_u.copy(), state, after, estimate))
        return after, estimate


def place_of(name="thesis-ch3-v0", **changes):
    return dataclasses.replace(load_scenario(name), **changes)


def played(defence, attack, seeds=200, place=None, **options):
    spec = Spec("defence", defence) if isinstance(defence, str) else None
    made, uses = (spec.make(), spec.entry.uses) if spec else (defence, ("measurements", "odometry", "probe"))
    loop = (place or place_of()).loop(made, uses)
    return rollout(loop, Spec("attack", attack).make(), keys("report", range(seeds)), **options)


def crashed(trace):
    return (trace.collided & trace.live).any(axis=0)


def error_of(trace, first):
    """(B,) RMSE of the estimated gap from step `first` on [m]."""
    error = (trace.estimate - trace.truth)[first - 1 :, :, 0, 0]
    return np.sqrt(np.mean(error * error, axis=0))


def onset_of(trace):
    """(B,) step of the first alarm; 0 for none."""
    alarm = trace.alarm[..., 0]
    return np.where(alarm.any(axis=0), alarm.argmax(axis=0) + 1, 0)


# --- the thesis's case study, 200 seeds ---


@pytest.mark.long
@pytest.mark.parametrize("attack", [JAM, LATE])
def test_scenario_one_is_survived_with_the_joint_regression(attack):
    """Both attacks are detected at 182, no run collides, the gap's error over the attack is about 0.14 m, and the last gap 5.03 m."""
    trace = played(FIXED, attack)
    assert not crashed(trace).any() and (onset_of(trace) == 182).all()
    assert np.median(error_of(trace, 182)) == pytest.approx(0.14, abs=0.03)
    assert np.median(trace.gap[-1]) == pytest.approx(5.03, abs=0.01)


@pytest.mark.thin(10)
@pytest.mark.parametrize("defence", ["none", "algorithm2", f"{FIXED},filter=hold_last", "pycra:challenge=fixed", f"{FIXED},watch=none,freeze=false"])
@pytest.mark.parametrize("attack", [JAM, LATE])
def test_scenario_one_collides_in_every_run_without_it(attack, defence):
    """No defence, the printed algorithms, the last reading held, detection alone, and a filter that is not frozen: all collide."""
    trace = played(defence, attack)
    assert crashed(trace).all()
    assert (onset_of(trace) == (0 if defence == "none" else 182)).all()
    if defence == "none":
        assert np.median(trace.length) == pytest.approx(189 if attack == JAM else 269, abs=1)


def test_without_roll_back_the_late_echo_stays_in_the_fit():
    """Two late echoes before detection spoil a regression of 180 readings: every run collides; with roll-back none."""
    assert crashed(played(f"{FIXED},rollback=false", LATE)).all()


@pytest.mark.thin(3)
@pytest.mark.parametrize("onset", [51, 100, 150])
def test_a_list_that_the_attacker_knows_loses(onset):
    """With challenges at 15, 50 and 175 an onset between them collides in every run before anything is heard."""
    trace = played(f"{FIXED},times=[15,50,175]", f"radar_jam:start_step={onset}", 100)
    assert crashed(trace).all() and not trace.alarm[trace.live].any()


@pytest.mark.long
def test_random_challenges_lose_to_the_thesis_jammer_only_where_they_come_late():
    """With p = 0.1 it takes 9 steps on average, and a reading of 180 m and more is fatal after some 6: those who challenge sooner survive."""
    trace = played("cra", JAM)
    latency = np.where(onset_of(trace) > 0, onset_of(trace) - 182, 999)
    assert crashed(trace)[latency >= 7].all() and not crashed(trace)[latency <= 3].any()
    low, high = stats.binom.ppf([0.0005, 0.9995], 200, 0.9**6) / 200  # nothing heard in the first 6
    assert low - 0.1 < crashed(trace).mean() < high + 0.1


@pytest.mark.parametrize("attack", [JAM, LATE])
def test_a_challenge_that_a_doubtful_reading_prompts_comes_in_time(attack):
    """With `suspicion` the defence chooses the step: detection one step after the onset, and no run collides."""
    trace = played("cra:suspicion=30", attack)
    assert not crashed(trace).any() and (onset_of(trace) <= (183 if attack == JAM else 195)).all()


@pytest.mark.thin(2)
@pytest.mark.parametrize("at, error", [(60, 0.33), (100, 0.82)])
def test_scenario_two_needs_the_reset(at, error):
    """A leader that changes from -0.1082 to +0.012 m/s^2 well before the attack is predicted with the reset, and not without."""
    place = place_of("thesis-ch3-switched-v0")
    place = dataclasses.replace(place, manoeuvre=dataclasses.replace(place.manoeuvre, at=at))
    trace = played(FIXED, JAM, place=place)
    assert np.median(error_of(trace, 182)) == pytest.approx(error, rel=0.25) and not crashed(trace).any()
    assert np.median(error_of(played(f"{FIXED},filter.threshold=none", JAM, 50, place), 182)) > 200.0


def test_a_late_change_of_the_leader_is_not_predicted():
    """25 readings since the change, up to the last challenge that passed, leave 8 m over 118 s: what least squares on them would."""
    place = place_of("thesis-ch3-switched-v0")
    place = dataclasses.replace(place, manoeuvre=dataclasses.replace(place.manoeuvre, at=150))
    error = np.median(error_of(played(FIXED, JAM, place=place, terminate=False), 182))
    assert 4.0 < error < 20.0


# --- the mechanism ---


@pytest.mark.long
def test_the_belief_rolls_back_to_the_last_challenge_that_passed():
    """From detection on it is that of a filter that saw nothing since, with the odometry replayed; before, one that saw all readings."""
    spy = Spy(make("defence", "cra", probability=0.2, watch=1.0, quiet=1))
    trace = played(spy, "radar_jam:start_step=60,length=30", 5, place_of(horizon=120), terminate=False)
    model = place_of().brief().model
    filter_ = make("filter", "joint_rls")
    plan, compared = filter_.prepare(model), np.zeros(2, int)
    for b in range(5):
        alone = lambda leaf, b=b: leaf[b : b + 1]  # noqa: E731
        start = filter_.start(plan, Prior(*map(alone, spy.prior)))
        belief, safe, alarmed = start, start, False
        for k, (received, known_u, before, _, estimate) in enumerate(spy.seen):
            belief, safe = (filter_.predict(plan, each, alone(known_u)) for each in (belief, safe))
            muted, heard = not before.probe[b, 0], received.energy[b, 0]
            if muted and heard > 1.1:
                belief, alarmed = safe, True
            elif muted:
                safe, alarmed = belief, False
            elif not alarmed:
                mine = Received(alone(received.y), alone(received.valid), alone(received.energy))
                innovation = filter_.innovation(plan, belief, mine)
                belief = filter_.update(plan, belief, innovation, mine.valid)
            compared += alarmed, muted
            x = estimate.x[b, 0]
            free = muted or alarmed  # else the controller is shown the readings
            np.testing.assert_allclose(x[2:] if not free else x, filter_.estimate(belief)[0, 0][2:] if not free else filter_.estimate(belief)[0, 0], rtol=0, atol=1e-9)
            assert estimate.alarm[b, 0] == alarmed == trace.alarm[k, b, 0]
    assert (compared > 100).all()


def test_an_alarm_ends_at_the_first_quiet_challenge():
    """While alarmed every step is a challenge (watch = 1): the step after the attack is quiet, and readings are used from the next on."""
    trace = played(f"{FIXED},watch=1,quiet=1", "radar_jam:start_step=182,length=20", 20)
    assert trace.alarm[181:201].all() and not trace.alarm[201:].any()
    assert not trace.valid[181:202].any() and trace.valid[202:].all()
    np.testing.assert_array_equal(trace.estimate[202:, :, 0, :2], trace.wires[202:, :, 0, :2])


def test_several_quiet_challenges_may_be_asked_for():
    """With quiet=3 the alarm outlasts the attack by two challenges more; one in between that is heard starts the count again."""
    trace = played(f"{FIXED},watch=1,quiet=3", "radar_jam:start_step=182,length=20", 5)
    assert trace.alarm[181:203].all() and not trace.alarm[203:].any()
    spy = Spy(make("defence", "cra", quiet=2, watch=1.0, filter="hold_last", probability=1.0))
    plan, held = spy.prepare(place_of().brief().model), keys("tune", [0])
    state, alarms = spy.start(plan, Prior(np.ones((1, 1, 4)), np.eye(4)[None, None])), []
    for k, energy in enumerate([9.0, 9.0, 1.0, 9.0, 1.0, 1.0, 1.0, 9.0], start=1):
        received = Received(np.zeros((1, 1, 2)), np.zeros((1, 1, 2), bool), np.array([[energy]]))
        state, estimate = spy.step(plan, state, received, np.ones((1, 1, 1)), held.at(Role.DEFENCE, np.array([k])))
        alarms.append(bool(estimate.alarm[0, 0]))
    assert alarms == [False, True, True, True, True, False, False, True]  # the first step is no challenge


@pytest.mark.long
def test_the_controller_never_gets_the_zero_of_a_challenge():
    """At a challenge the estimate is the prediction, within 2 m of the truth; elsewhere the readings themselves, or with passes=false not."""
    trace = played("cra:probability=0.3", "none", 50)
    muted = ~trace.valid[..., 0, 0]  # (K, B)
    error = np.abs(trace.estimate - trace.truth)[..., 0, 0]
    assert muted.mean() == pytest.approx(0.3, abs=0.02) and (trace.clean[..., 0, 0][muted] == 0.0).all() and error[10:][muted[10:]].max() < 2.0
    np.testing.assert_array_equal(trace.estimate[..., 0, :2][~muted], trace.wires[..., 0, :2][~muted])
    smooth = played("cra:probability=0.3,passes=false", "none", 50)
    assert np.median(error_of(smooth, 50)) < 0.5 * np.median(error_of(trace, 50))


@pytest.mark.long
def test_the_latency_of_random_challenges_is_geometric():
    """Steps from onset to detection: P(n) = p (1-p)^n, mean (1-p)/p, in 2000 episodes each; a challenge takes a share p of all steps."""
    for p in (0.1, 0.4):
        place = place_of(horizon=100, ends_on_collision=False)
        trace = played(f"cra:probability={p}", "echo_delay:start_step=20", 2000, place, terminate=False)
        onset = onset_of(trace)
        latency = onset[onset > 0] - 20
        assert (onset > 0).mean() > 0.999 and latency.min() == 0
        assert abs(latency.mean() - (1 - p) / p) < 3.29 * np.sqrt((1 - p) / p**2 / 2000) + 81 * (1 - p) ** 81
        last = 12
        expected = np.append(p * (1 - p) ** np.arange(last), (1 - p) ** last) * len(latency)
        counted = np.append(np.bincount(latency, minlength=last)[:last], np.count_nonzero(latency >= last))
        assert stats.chisquare(counted, expected * counted.sum() / expected.sum()).pvalue > 0.001
        share = np.count_nonzero(~trace.probe[:18]) / trace.probe[:18].size
        assert abs(share - p) < 3.29 * np.sqrt(p * (1 - p) / trace.probe[:18].size)


def test_false_alarms_come_as_often_as_asked_for():
    """Of noise alone, the mean of N exponentials, a share P_fa of the challenges raises an alarm, and nothing else does."""
    rng, batch, steps = np.random.default_rng(1), 400, 200
    for wanted, samples in ((0.02, 100), (0.1, 3)):
        defence = make("defence", "cra", probability=0.5, false_alarm=wanted, watch=None, quiet=1, filter="hold_last")
        plan, held = defence.prepare(dataclasses.replace(place_of().brief().model, challenge=samples)), keys("tune", range(batch))
        assert plan.threshold == pytest.approx(stats.gamma.isf(wanted, samples) / samples, rel=1e-9)
        state = defence.start(plan, Prior(np.ones((batch, 1, 4)), np.broadcast_to(np.eye(4), (batch, 1, 4, 4))))
        alarms = challenges = 0
        for k in range(1, steps + 1):
            muted = ~state.probe[:, 0]
            energy = rng.gamma(samples, 1.0 / samples, (batch, 1))
            received = Received(np.ones((batch, 1, 2)), np.broadcast_to(~muted[:, None, None], (batch, 1, 2)), energy)
            before = state.heard > plan.threshold
            state, estimate = defence.step(plan, state, received, np.ones((batch, 1, 1)), held.at(Role.DEFENCE, np.full(batch, k)))
            assert (estimate.alarm == np.where(muted[:, None], energy > plan.threshold, before)).all()
            alarms, challenges = alarms + np.count_nonzero(estimate.alarm[muted]), challenges + np.count_nonzero(muted)
        low, high = stats.binom.ppf([0.0005, 0.9995], challenges, wanted)
        assert challenges > 30_000 and low <= alarms <= high


def test_no_false_alarm_in_the_closed_loop_at_one_in_a_million():
    """200 clean episodes with a challenge in every second step: none of 30 000 is taken for an attack, and none collides."""
    trace = played("cra:probability=0.5", "none")
    assert np.count_nonzero(~trace.probe) > 29_000 and not trace.alarm.any() and not crashed(trace).any()


@pytest.mark.long
def test_an_attacker_who_falls_silent_in_time_is_not_heard():
    """With no reaction time an attacker is never detected, and its 6 m end in a collision; with one of 0.1 s, the window, it is."""
    place = place_of().with_threat(reaction=0.0)
    fast = played(FIXED, LATE, 50, place)
    assert not fast.alarm.any() and crashed(fast).all()
    assert (onset_of(played(FIXED, LATE, 50, place_of().with_threat(reaction=0.1))) == 182).all()


@pytest.mark.long
def test_the_watch_and_the_list():
    """Fixed challenges come at their steps alone; watch adds its share of the alarmed steps, none of them with none."""
    quiet = played(f"{FIXED},times=[2,7,300]", "none", 3)
    assert (np.flatnonzero(~quiet.valid[:, 0, 0, 0]) + 1).tolist() == [2, 7, 300]
    for watch, share in (("none", 0.0), ("0.0", 0.0), ("0.3", 0.3), ("1.0", 1.0)):
        trace = played(f"{FIXED},times=[20],watch={watch}", "radar_jam:start_step=20,length=30", 100, place_of(horizon=50), terminate=False)
        held = ~trace.probe[20:48]
        assert abs(held.mean() - share) <= 3.29 * np.sqrt(share * (1 - share) / held.size)
    trace = played("cra:watch=none", "radar_jam:start_step=5", 200, place_of(horizon=90), terminate=False)
    assert (~trace.probe[40:]).mean() == pytest.approx(0.1, abs=0.01) and trace.alarm[40:].mean() > 0.95


@pytest.mark.long
def test_the_mode_outlasts_the_alarm_by_the_linger():
    """While alarmed, and 3 s after, the controller is asked to brake; the car is then slower than without."""
    trace = played(f"{FIXED},watch=1,quiet=1,mode=brake,linger=3", "radar_jam:start_step=182,length=10", 5)
    braked = trace.mode[..., 0] == Mode.BRAKE
    assert (np.flatnonzero(braked[:, 0]) + 1).tolist() == list(range(182, 195)) and (braked == braked[:, :1]).all()
    assert (trace.speed[192] < played(FIXED, "radar_jam:start_step=182,length=10", 5).speed[192] - 1.0).all()


@pytest.mark.long
def test_detection_alone_leaves_the_readings_alone():
    """pycra drives on every reading, attacked ones too, and predicts at challenges; no attack, no difference from cra."""
    attacked, clean, other = played("pycra", LATE, 30), played("pycra", "none", 30), played("cra", "none", 30)
    there = attacked.valid[..., 0, 0] & attacked.live
    np.testing.assert_array_equal(attacked.estimate[..., 0, :2][there], attacked.wires[..., 0, :2][there])
    assert attacked.alarm.any() and [clean.trace_hash(i) for i in range(30)] == [other.trace_hash(i) for i in range(30)]


def test_the_printed_algorithm_is_algorithm_one():
    """w and P of both fits equal a plain loop of Algorithm 1's lines on every reading that arrived, attacked ones too."""
    spy = Spy(make("defence", "algorithm2"))
    played(spy, "echo_delay:start_step=100", 2, place_of(horizon=220), terminate=False)
    for b in range(2):
        for i in range(2):
            w, P = np.zeros(2), np.eye(2)
            for k, (received, _, before, after, estimate) in enumerate(spy.seen, start=1):
                h = np.array([1.0, k / 100.0])
                if before.probe[b, 0]:
                    g = h @ P
                    j = g / (0.95 + g @ h)
                    w, P = w + j * (received.y[b, 0, i] - w @ h), (P - np.outer(j, g)) / 0.95
                np.testing.assert_allclose(after.live.past.w[b, 0, i], w, rtol=1e-6, atol=1e-9)
                if estimate.alarm[b, 0] or not before.probe[b, 0]:
                    assert estimate.x[b, 0, i] == pytest.approx(w @ h, rel=1e-6)
    assert spy.seen[-1][4].alarm.all()


def test_looking_ahead_shows_what_a_step_does():
    """`look` gives the filter's innovation, and for its gain how far a small change of a reading moves what the controller drives on."""
    for text in ("cra:probability=0.3", "cra:probability=0.3,passes=false", "pycra:probability=0.3"):
        spy = Spy(Spec("defence", f"{text},filter.threshold=none").make())  # a reset has no derivative
        trace = played(spy, "echo_delay:start_step=30,length=5", 20, place_of(horizon=60), terminate=False)
        plan = spy.inner.prepare(place_of().brief().model)
        for k in (20, 33, 50):
            received, known_u, before, _, estimate = spy.seen[k]
            draws = keys("report", range(20)).at(Role.DEFENCE, np.full(20, k + 1))
            look = spy.inner.look(plan, before, received, known_u)
            assert look.gate is None
            for i in range(2):
                y = received.y.copy()
                y[..., i] += 1e-3
                moved = (spy.inner.step(plan, before, received._replace(y=y), known_u, draws)[1].x - estimate.x) / 1e-3
                dead = ~before.probe[:, 0] | (estimate.alarm[:, 0] & (text[:3] == "cra"))
                np.testing.assert_allclose(moved[:, 0], look.gain[:, 0, :, i], atol=1e-6)
                assert (moved[dead] == 0.0).all() and dead.any() == (not trace.probe[k - 1].all() or (k == 33 and text[:3] == "cra"))


@pytest.mark.thin(12)
@pytest.mark.parametrize("text", ["cra", FIXED, "cra:filter=kf,suspicion=20", "cra:filter=polynomial", "cra:filter=autoregressive", "pycra", "algorithm2"])
def test_rows_do_not_depend_on_their_batch(text, same_rows):
    """trace_hash of a seed is the same alone and among others, under attack, alarm and roll-back."""
    loop = place_of("radar-following-v0", horizon=80).loop(Spec("defence", text).make(), ("measurements", "odometry", "probe"))
    attack = Spec("attack", "echo_delay:start_step=20,length=25").make()
    whole = same_rows(lambda seeds: rollout(loop, attack, keys("report", seeds)), 24, [5], [17, 3, 21])
    assert whole.alarm.any() or text in (FIXED, "algorithm2")


@pytest.mark.parametrize("text", ["cra", "cra:filter=polynomial", "pycra", "algorithm2"])
def test_a_restarted_row_is_a_fresh_one(text, same_tree):
    """In the middle of an alarm: its state, prior to roll back to included, is that of the next episode; the others keep every bit."""
    spec = Spec("defence", text)
    loop = place_of(horizon=60).loop(spec.make(), spec.entry.uses)
    rival = Spec("attack", "radar_jam:start_step=5").make()
    state, plan = loop.start(keys("train", range(4))), rival.prepare(loop.brief)
    memory = rival.start(plan, 4, state.keys.at(Role.ATTACK, np.zeros(4, np.int64)))
    for _ in range(30):
        state, memory, _ = loop.step(state, rival, plan, memory)
    after = loop.restart(state, np.array([True, False, True, False]))
    fresh = loop.start(Keys(state.keys.key[[0, 2]], state.keys.episode[[0, 2]] + np.uint32(1)))
    assert same_tree(after, fresh, [0, 2]) == [] and same_tree(state, fresh, [0, 2]) != []
    kept = loop.restart(state, np.ones(4, bool))
    assert same_tree(kept, after) != [] and all(np.array_equal(a[[1, 3]], b[[1, 3]]) for a, b in zip(leaves(after).values(), leaves(state).values(), strict=True))


@pytest.mark.long
def test_any_filter_predicts(tmp_path, monkeypatch):
    """A name, a mapping, or somebody else's class; a wrong one fails where the defence is made."""
    (tmp_path / "held_filter.py").write_text("from tailgate.estimators import HoldLast\n\nclass Mine(HoldLast):\n    '''As it is.'''\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    one, two = (played(f"{FIXED},filter={name}", JAM, 4) for name in ("hold_last", "held_filter:Mine"))
    assert [one.trace_hash(i) for i in range(4)] == [two.trace_hash(i) for i in range(4)]
    made = Spec("defence", "cra:filter=polynomial,filter.degree=1").make()
    assert made.predictor().degree == 1 and Spec("defence", "cra:filter.window=12").make().predictor().window == 12
    for name in ("cra", "pycra"):
        with pytest.raises(InputError, match="nothing_such"):
            make("defence", name, filter="nothing_such")
        with pytest.raises(InputError, match="threshold"):
            make("defence", name, filter={"name": "joint_rls", "threshold": -1.0})


def test_the_threshold_is_that_of_the_radars_own_samples():
    """N_c = 0.1 s x 256 kHz, or what another radar takes; a margin of 3 dB doubles it, less 0.2 %."""
    for sensor, samples in (({}, 25600), ({"window": 0.01}, 2560)):
        model = dataclasses.replace(place_of(), sensor=make("sensor", "fmcw_radar", **sensor)).brief().model
        assert model.challenge == samples
        threshold = make("defence", "cra").prepare(model).threshold
        assert threshold == pytest.approx(stats.gamma.isf(1e-6, samples) / samples, rel=1e-12)
        assert make("defence", "cra", margin=3.0).prepare(model).threshold == pytest.approx(1.99526 * threshold, rel=1e-5)
    assert false_alarm_threshold(1e-6, 25600) == pytest.approx(stats.gamma.isf(1e-6, 25600) / 25600, rel=1e-12)
    assert tailgate.make_defence("cra").false_alarm == 1e-6
