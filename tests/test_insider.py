"""An insider: the altered law of a car in a platoon against the printed one, what grants and refuses it, and both engines."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import draws
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers.cacc import Column
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.play.rollouts import Rollout, rollout_of
from tailgate.play.trace import Trace, rollout

from .engines import loop_of, trace_as_plain

PLACE, CAR, FIRST, LENGTH = "platoon-stop-and-go-v0", 2, 31, 60
LAWS = {"cacc": {}, "ploeg_cacc": {}, "consensus_cacc": {"leader": "estimated"}}
GRANT = {"kinds": ["insider"], "agents": [CAR], "onset": 20}
ATTACK = f"insider:start_step={FIRST},length={LENGTH},kp_scale=0.4,kd_scale=-0.5"


def place_of(law="cacc", **threat):
    """A platoon without limits of the command, so that the law is all that a command is."""
    place = load_scenario(PLACE).with_threat(**GRANT | threat)
    return dataclasses.replace(place, controller=make("controller", law, accel_min=None, accel_max=None, **LAWS[law]), horizon=100)


def play(place, attack=ATTACK, defence="kf", seeds=range(3), **options):
    guard = Spec("defence", defence)
    loop = place.loop(guard.make(), guard.entry.uses)
    return rollout(loop, Spec("attack", attack).make(), draws.keys("train", list(seeds)), **options)


def law_on(name, law, x, f, heard, i, dt, scales):
    """The command and the next f of car i by the formulas of the papers, from its belief x (B, n) and the messages heard (B, 3)."""
    h, dr, keep = law.headway, law.standstill, np.exp(-dt / law.headway)
    d, v, a, ahead = (x[:, place] for place in (Column.gap(i), Column.speed(i), Column.accel(i), Column.speed(i - 1)))
    e, slope = d - dr - h * v, ahead - v - h * a
    if name == "cacc":
        u = scales[0] * law.kp * e + scales[1] * law.kd * slope + f
        return u, keep * f + (1 - keep) * (heard[:, 0] + heard[:, 1]) / 2
    if name == "ploeg_cacc":
        return f, keep * f + (1 - keep) * (scales[0] * law.kp * e + scales[1] * law.kd * slope + heard[:, 2])
    lead = x[:, 1]
    off = [-sum(x[:, Column.gap(m)] for m in range(j + 1, i + 1)) + (i - j) * (dr + h * lead) for j in sorted({0, i - 1})]
    return -scales[1] * law.b * (v - lead) - scales[0] * law.k * sum(off) / len(off), keep * f


def test_a_phase_of_a_program_is_an_insider_too(tmp_path):
    """It aims at what the law weighs, as the script does, and not at the actuator."""
    (tmp_path / "inside.yaml").write_text(
        f"phases:\n  - kind: insider\n    value: 0.0\n    trigger: {{name: time, start: {FIRST}}}\n    length: {LENGTH}\n"
    )
    trace = play(place_of(), f"program:path={tmp_path / 'inside.yaml'}")
    assert not trace.refused.any() and ((trace.kind != 0).sum(axis=0) == LENGTH).all()


@pytest.mark.thin(3)
@pytest.mark.parametrize("name", LAWS)
def test_an_insider_drives_by_the_printed_law_with_other_gains(name):
    """Every command of every car is the law's on the car's own belief; from FIRST on the insider's has scaled gains, and its controller."""
    place = place_of(name)
    trace = play(place, terminate=False)
    wires = trace.wires[..., 3:]  # messages
    for i in range(1, place.plant.size[0]):
        f = trace.truth[0, :, 0, Column.controller(i)].copy()
        for k in range(len(trace.kind)):
            inside = i == CAR and FIRST <= k + 1 < FIRST + LENGTH
            u, f = law_on(name, place.controller, trace.estimate[k, :, i], f, wires[k, :, i], i, trace.dt, (0.4, -0.5) if inside else (1, 1))
            np.testing.assert_allclose(trace.control[k, :, i, 0], u, rtol=1e-9, atol=1e-9, err_msg=f"car {i}, step {k + 1}")


@pytest.mark.long
def test_the_car_follows_the_altered_command():
    """The speed and the place of the insider's car are those of a vehicle with lag under its commands, by scipy's matrix exponential."""
    place, attack = dataclasses.replace(place_of(), horizon=200), ATTACK.replace(f"length={LENGTH}", "length=120")
    trace, tau = play(place, attack, terminate=False), place.plant.tau
    whole = expm(trace.dt * np.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, -1 / tau, 1 / tau], [0, 0, 0, 0]]))
    state = np.stack([trace.signals[name][FIRST - 2, :, CAR] for name in ("position", "speed", "accel")], axis=1)
    for k in range(FIRST - 1, FIRST + 19):  # while nobody stands
        state = state @ whole[:3, :3].T + trace.control[k, :, CAR] * whole[:3, 3]
        np.testing.assert_allclose(trace.position[k, :, CAR], state[:, 0], rtol=1e-10)
    assert (np.abs(trace.gap[..., CAR] - play(place, "none", terminate=False).gap[..., CAR]).max(axis=0) > 5.0).all()


def test_factors_of_one_change_nothing():
    """An insider that keeps its promise drives as if nobody attacked, to the last bit."""
    kept = play(place_of(), "insider:kp_scale=1,kd_scale=1", "none")
    clean = play(place_of(), "none", "none")
    assert kept.target[19:].any()
    for name in ("truth", "wires", "estimate", "control", "applied", "gap"):
        assert np.array_equal(kept.signals[name], clean.signals[name]), name


def test_the_wires_arrive_as_they_were_sent():
    """An insider lies to nobody: readings, messages and the oracle's mark of attacked sensors are those of the road."""
    trace = play(place_of(), defence="oracle")
    assert np.array_equal(trace.wires, trace.clean) and np.array_equal(trace.control, trace.applied)
    on = trace.kind != 0
    assert on[FIRST - 1 : FIRST + 50].all() and not on[: FIRST - 1].any() and trace.target[on].sum() == 2 * on.sum()
    other = play(place_of())  # the oracle would ignore attacked sensors
    assert all(np.array_equal(trace.signals[name], other.signals[name]) for name in ("estimate", "score"))


def test_an_insider_heeds_no_defence_of_its_own():
    """A defence that fixes the command of every car fixes that of the others."""
    defence = "composed:detector=chi2,mitigation=sliding_mode,mitigation.when=always"
    k, place = FIRST - 1, dataclasses.replace(place_of(), horizon=FIRST)
    trace, clean = play(place, defence=defence), play(place, "none", defence)
    assert np.array_equal(trace.control[:k], clean.control[:k])
    others = [i for i in range(5) if i != CAR]
    assert np.array_equal(trace.control[k][:, others], clean.control[k][:, others])
    assert (trace.control[k][:, CAR] != clean.control[k][:, CAR]).all()
    brake, calm = play(place, defence="always_brake"), play(place, "none", "always_brake")
    assert (brake.control[k, :, CAR] > calm.control[k, :, CAR]).all() and (calm.control[k, :, CAR] <= -2.0).all()


@pytest.mark.long
def test_one_gain_alone():
    """`targets` names the gains: that of the error by `distance`, that of its rate by `velocity`."""
    one = play(place_of(), ATTACK + ",targets=[velocity]")
    assert np.array_equal(one.control, play(place_of(), ATTACK.replace("kp_scale=0.4", "kp_scale=1")).control)
    assert not one.target[..., 0].any() and one.target[..., 1].any()


def test_the_bound_cuts_a_factor_and_the_budget_ends_it():
    trace = play(place_of(gain_bound=0.25, budget=30))
    assert np.unique(np.abs(trace.value[trace.target])).tolist() == [0.25]
    assert (np.count_nonzero(trace.kind, axis=0) == 30).all() and not trace.refused.any()


def test_a_command_beyond_the_threat_model_is_refused():
    """The channel refuses a factor above the bound, a wire without a gain, the leader, and the kind where it is not granted."""
    loop = place_of(gain_bound=2.0, agents=[0, CAR], targets=["distance", "acceleration"]).loop(tailgate.make_defence("kf"))
    other = load_scenario(PLACE).loop(tailgate.make_defence("kf"))
    for place, agent, wire, value, refused in (
        (loop, CAR, 0, 2.0, False), (loop, CAR, 0, -2.0, False), (loop, CAR, 0, 2.1, True), (loop, CAR, 0, np.nan, True), (loop, CAR, 2, 1.0, True),
        (loop, CAR, 1, 1.0, True), (loop, 0, 0, 1.0, True), (loop, 1, 0, 1.0, True), (other, CAR, 0, 1.0, True),
    ):  # fmt: skip
        state = place.start(draws.keys("train", [0]))
        for _ in range(20):
            state, _, _ = place.step(state, tailgate.make_attack("none"), place.brief, None)
        target = np.zeros((1, 5, 7), bool)
        target[0, agent, wire] = True
        _, frame = place.advance(state, place.brief.command(np.array([True]), 10, target, value))
        assert frame.refused[0] == refused, (agent, wire, value)
        assert (frame.command.kind[0] == 10) == (not refused)


@pytest.mark.parametrize(
    "attack, threat, error, words",
    [
        ("insider", {"kinds": ["fdi"]}, NotApplicable, "a threat model that grants insider"),
        ("insider:agents=[1]", {}, NotApplicable, "grants distance, velocity of agents 1"),
        ("insider:agents=[0]", {"agents": [0]}, NotApplicable, "the manoeuvre drives the leader"),
        ("insider:agents=[9]", {}, NotApplicable, "an agent's number, from 0 to 4"),
        ("insider:targets=[acceleration]", {}, InputError, "distance, velocity"),
        ("insider:targets=[nothing]", {}, InputError, "nothing"),
        ("insider", {"targets": ["acceleration"]}, NotApplicable, "a threat model that grants distance or velocity"),
    ],
)
def test_it_says_in_one_line_what_is_missing(attack, threat, error, words):
    with pytest.raises(error, match=words) as raised:
        Spec("attack", attack).make().prepare(place_of(**threat).brief())
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["stop-and-go-v0", "thesis-ch6-v0", "network-noisy-v0", "radar-following-v0", "lane-keeping-v0", "road-string-v0"])
def test_a_plant_without_gains_to_scale(name):
    with pytest.raises(NotApplicable, match="no gains that could be scaled"):
        tailgate.make_attack("insider").prepare(load_scenario(name).with_threat(kinds=["insider"]).brief())


def test_learners_do_not_choose_it():
    """An action that could be nothing but an insider is refused; among other kinds it is left out."""
    with pytest.raises(InputError, match="not insider"):
        ActionCodec(ActionSpec("mode"), place_of().brief())
    with pytest.raises(InputError, match="not insider"):
        ActionCodec(ActionSpec("timing", kind="insider"), place_of().brief())
    both = ActionCodec(ActionSpec("mode", value=5.0), place_of(kinds=["fdi", "insider"]).brief())
    assert {mode.kind for mode in both.modes} == {0, 5}


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_the_traced_engine_plays_it_to_the_bit(law, tmp_path, monkeypatch):
    """With the attack in plain code, and traced as well."""
    loop, rival = loop_of(PLACE, "chi2_kf", ATTACK.replace(f"={FIRST},length={LENGTH}", "=21,length=20"), 50, **GRANT)
    object.__setattr__(loop, "controller", make("controller", law, **LAWS[law]))
    plain = trace_as_plain(loop, rival)
    assert (plain.kind == 10).any()
    whole = rollout_of(loop, rival)
    assert isinstance(whole, Rollout), whole
    keys = draws.keys("report", range(67))
    fast = Trace(loop.model, loop.horizon, *whole.play(keys, True), loop.controller.desired_gap)
    assert [fast.trace_hash(b) for b in range(67)] == [plain.trace_hash(b) for b in range(67)]


def growth(kp, kd, headway, tau, dt):
    """The largest |eigenvalue| of a car behind a steady one, under the printed law of `cacc` on its exact state, held for a step."""
    whole = expm(dt * np.array([[0, -1, 0, 0], [0, 0, 1, 0], [0, 0, -1 / tau, 1 / tau], [0, 0, 0, 0]]))
    law = np.array([kp, -kp * headway - kd, -kd * headway])
    return float(np.abs(np.linalg.eigvals(whole[:3, :3] + np.outer(whole[:3, 3], law))).max())


@pytest.mark.long
@pytest.mark.parametrize("scale", [-0.1, -0.15, -0.25, -0.3])
def test_the_gain_at_which_a_car_swings_is_the_closed_form(scale):
    """The first follower. Routh: tau s^3 + (1 + kd h) s^2 + (kd + kp h) s + kp is stable
    above kd = -0.204 here. Swings grow or die out at the rate of the poles."""
    place = place_of(end=None, agents=[1])
    law, plant = place.controller, dataclasses.replace(place.plant, initial_sd=1e-6)
    rate = growth(law.kp, scale * law.kd, law.headway, plant.tau, plant.dt)
    assert (rate > 1.0) == ((1 + 3 * scale) * (scale + 1.5) < 1.008 * 0.5)
    sensor = dataclasses.replace(place.sensor, noise_sd=(1e-5,) * 3)
    quiet = dataclasses.replace(place, plant=plant, manoeuvre=make("manoeuvre", "constant", value=0.0), sensor=sensor, horizon=700)
    trace = play(quiet, f"insider:kp_scale=1,kd_scale={scale},start_step=50", "dkf", terminate=False)
    off = trace.speed[..., 1] - trace.lead_speed[..., 1]
    first, last = (110, 250) if rate > 1.0 else (250, 600)  # the slow pair of poles is all that is left, and nobody stands
    for x in off[first:last].T:
        (_, c), *_ = np.linalg.lstsq(np.stack([x[10:-10], x[:-20]], axis=1), x[20:], rcond=None)
        np.testing.assert_allclose(np.log(-c) / 20, np.log(rate), rtol=0.05)
