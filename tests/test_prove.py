"""Proofs: the closed form of a late reaction, tubes of linear loops against ten thousand runs, and the largest attack against found ones."""

import dataclasses
import itertools
import json

import numpy as np
import pytest

from tailgate import cli
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import draws
from tailgate.core.registry import Spec, make
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout
from tailgate.trust.affine import AffineLoop, Step, affine_loop
from tailgate.trust.leaders import accelerations
from tailgate.trust.probing import probed
from tailgate.trust.prove import admissible, closed_form, keeps, message_delay, prove, reacting
from tailgate.trust.signals import SafeDistance
from tailgate.trust.tube import Tube, quantile_of

from .proofs import CAR, LANE, car, lane

RUNS, NETWORK = 10_000, "linear-stealth-v0"


def play(place, attack="none", defence="kf", runs=RUNS):
    return rollout(place.loop(Spec("defence", defence).make()), Spec("attack", attack).make(), draws.keys("tune", range(runs)))


def test_the_known_answer_of_loos_and_platzer():
    safe = SafeDistance(0.1, 2.0, 3.0, 6.0)
    by_hand = 400 / 6 - 400 / 12 + (2 / 3 + 1) * (0.01 + 2.0)
    assert by_hand == pytest.approx(36.683, abs=1e-3) and float(safe.of(np.array(20.0), np.array(20.0))) == pytest.approx(by_hand)
    v, w = np.meshgrid(np.linspace(5.0, 40.0, 30), np.linspace(0.0, 30.0, 30))
    wanted = v * v / 6 - w * w / 12 + (2 / 3 + 1) * (2.0 * 0.01 / 2 + 0.1 * v)
    assert np.allclose(safe.of(v, w), np.maximum(wanted, 0.0))


def test_the_invariant_is_inductive_and_tight():
    """Leaders that brake and speed up at will: a car that obeys it never collides, and one with a hundredth less of it does."""
    safe, rng, worst = SafeDistance(0.5, 2.0, 3.0, 6.0), np.random.default_rng(0), {}
    for short in (0.0, 0.03):
        runs, fine = 4000, 20
        v, lead = rng.uniform(5.0, 35.0, runs), rng.uniform(5.0, 35.0, runs)
        gap = safe.of(v, lead) * (1.0 - short)
        least, dt = gap.copy(), safe.response / fine
        for k in range(60):
            go = keeps(safe, gap / (1.0 - short), v, lead)
            pull = np.where(rng.random(runs) < 0.5, -6.0, rng.uniform(-6.0, 2.0, runs)) if k else np.full(runs, -6.0)
            for _ in range(fine):  # exact for constant accelerations, halts included
                own = np.where(go, 2.0, -3.0)
                moved, v_after = _moved(v, own, dt)
                ahead, lead_after = _moved(lead, pull, dt)
                gap, v, lead = gap + ahead - moved, v_after, lead_after
                least = np.minimum(least, gap)
        worst[short] = least.min()
    assert worst[0.0] >= -1e-9 and worst[0.03] < -0.1


def _moved(v, a, dt):
    stop = np.where(a < 0.0, np.minimum(dt, -v / np.where(a < 0.0, a, -1.0)), dt)
    return v * stop + 0.5 * a * stop * stop, np.maximum(v + a * dt, 0.0)


def test_a_lag_is_no_worse_than_that_much_longer_reaction():
    t, rng = np.linspace(0.0, 12.0, 2401), np.random.default_rng(1)
    for tau, a, b, v in zip(*rng.uniform([[0.1], [0.1], [2.0], [5.0]], [[2.0], [3.0], [8.0], [40.0]], (4, 200)), strict=True):
        lagged = v + a * tau * (1 - np.exp(-t / tau)) - b * (t - tau * (1 - np.exp(-t / tau)))
        delayed = np.where(t < tau, v + a * t, v + a * tau - b * (t - tau))
        assert (delayed - lagged).min() > -1e-9


def test_an_overestimated_gap_within_the_admissible_bias_keeps_the_invariant():
    place = load_scenario(CAR)
    safe = reacting(place)
    assert (safe.response, safe.accel, safe.brake, safe.lead_brake) == (pytest.approx(1.108), 2.0, 5.0, 5.0)
    for row in closed_form(place)["speeds"]:
        v = np.array(row["speed"])
        bias = admissible(safe, np.array(row["desired_gap"]), v, v)
        assert bias == row["bias"] and keeps(safe, row["desired_gap"] - bias, v, v) and not keeps(safe, row["desired_gap"] - bias - 1e-6, v, v)
    with pytest.raises(NotApplicable, match=r"controller.*LaneLqr"):
        reacting(load_scenario(LANE))


def scalar(a, many):
    """x+ = a x + w with |w| <= 1, as a loop without anything else."""
    none = (np.zeros((1, 1)), np.zeros(1), np.zeros((1, 1)), np.zeros((1, 0)))
    step = Step(np.array([[a]]), np.zeros(1), np.ones((1, 1)), np.zeros((1, 0)), none, none)
    gaps = ((np.ones(1), 2.0),)
    return AffineLoop(load_scenario(NETWORK).brief().model, None, (step,) * many, np.zeros(1), np.ones((1, 1)), gaps, (), np.zeros(many, bool), 0, chance=1, begun=1)


def test_the_radius_of_a_scalar_system_is_its_geometric_series():
    """A = 0.5, |w| <= 1: it tends to 2."""
    radius = Tube(scalar(0.5, 60)).wide["gap"][:, 0]
    assert np.allclose(radius, 2.0 * (1.0 - 0.5 ** np.arange(1, 62)), rtol=1e-8) and radius[-1] == pytest.approx(2.0)
    assert np.allclose(Tube(scalar(-0.9, 40)).wide["gap"][-1, 0], (1 - 0.9**41) / 0.1, rtol=1e-8)


def inside(tube, trace, size, gaps):
    """Return the share of runs that stay within all ranges, and the largest share of a range's width that was used."""
    many = len(trace.control)
    wide = {name: tube.wide[name] + size * tube.pushed[name] for name in tube.wide}
    off = {
        "gap": np.abs(gaps[..., None] - tube.gap_offset - tube.gap.centre[: len(gaps), None]) / wide["gap"][: len(gaps), None],
        "error": np.abs((trace.estimate - trace.truth)[:, :, 0] - tube.error.centre[:many, None]) / wide["error"][:many, None],
    }  # fmt: skip
    kept = np.ones(gaps.shape[1], bool)
    for used in off.values():
        kept &= (used <= 1.0).all(axis=(0, 2))
    return kept.mean(), max(used.max() for used in off.values())


@pytest.mark.long
@pytest.mark.parametrize("size", [0.0, 0.3])
def test_ten_thousand_runs_in_a_lane_stay_inside_of_the_tube(size):
    """Under random injections of both signs; with six standard deviations all, with a Gaussian range of 1 % at most that many leave."""
    place = lane(targets=("lane_offset",), budget=30)
    attack = "none" if size == 0.0 else f"fdi_uniform:low={-size},high={size},start_step=20"
    trace = play(place, attack)
    offset = np.stack([trace.model.lane - sign * trace.truth[:, :, 0, 0] for sign in (1.0, -1.0)], axis=-1)
    for options, alpha in (({"spread": 6.0}, None), ({}, 0.01)):
        tube = Tube(affine_loop(place, **options), alpha=alpha)
        gaps = np.stack([trace.model.lane + row * trace.truth[:, :, 0, 0] for row in (-1.0, 1.0)], axis=-1)
        assert np.array_equal(np.sort(gaps, axis=-1), np.sort(offset, axis=-1))
        kept, used = inside(tube, trace, size, gaps[..., 0])
        assert kept == 1.0 if alpha is None else kept > 1.0 - alpha
        assert used > (0.2 if alpha is None else 0.7)  # and the tube is no wider than it has to be
        assert np.abs(trace.control).max() < 5.0


@pytest.mark.long
def test_ten_thousand_runs_behind_a_leader_stay_inside_of_the_tube():
    place, size = car(targets=("position",)), 1.0
    trace = play(place, f"fdi_uniform:low={-size},high={size},start_step=20")
    assert not trace.collided.any() and trace.control.min() > -5.0 and trace.control.max() < 2.0
    tube = Tube(affine_loop(place, spread=6.0))
    gap = np.concatenate([trace.first["gap"][None], trace.gap])[:, :, 0]
    kept, used = inside(tube, trace, size, gap)
    assert kept == 1.0 and used > 0.1


@pytest.mark.long
@pytest.mark.parametrize("noise", [None, "uniform"])
def test_ten_thousand_runs_stay_inside_of_the_gaussian_tube_whatever_the_law_of_the_sensor(noise):
    """With a probability of 99 %; the deviation of the error is the one that the tube has."""
    place = car()
    place = dataclasses.replace(place, sensor=dataclasses.replace(place.sensor, noise=noise))
    trace, tube = play(place), Tube(affine_loop(place), alpha=0.01)
    error = (trace.estimate - trace.truth)[:, :, 0]
    kept = np.abs(error - tube.error.centre[:, None]) <= tube.wide["error"][:, None]
    assert kept.all(axis=(0, 2)).mean() > 0.99
    assert np.allclose(error.std(axis=1), np.sqrt(tube.error.variance), rtol=0.06)


def test_the_quantile_of_uniform_noise_covers_sums_of_it():
    rng = np.random.default_rng(3)
    for many in (1, 2, 5):
        weights = rng.uniform(0.2, 1.0, (many, 1))
        total = (weights * 3.0**0.5 * rng.uniform(-1.0, 1.0, (many, 200_000))).sum(axis=0) / np.sqrt((weights**2).sum())
        for tail in (0.3, 0.1, 0.01, 1e-3):
            assert (total > quantile_of(tail, True)).mean() <= tail
    assert quantile_of(0.025, False) == pytest.approx(1.95996, abs=1e-5)


@pytest.mark.long
def test_the_variance_is_that_of_the_loop():
    place = dataclasses.replace(lane(budget=0), manoeuvre=make("manoeuvre", "bend", value=0.0))
    trace, tube = play(place, runs=4000), Tube(affine_loop(lane(budget=0)), alpha=0.01)
    found = trace.truth[:, :, 0, 0].std(axis=1)
    assert np.allclose(found, np.sqrt(tube.gap.variance[:-1, 0]), rtol=0.06)
    assert np.allclose(trace.control[:, :, 0, 0].std(axis=1), np.sqrt(tube.command.variance[:, 0]), rtol=0.06)


def test_the_strongest_attack_of_the_tube_does_in_the_loop_what_the_tube_says(tmp_path):
    """Its signs, played as a program on a loop without noise, take the gap that the tube adds for the attack."""
    place = lane(targets=("lane_offset",), budget=25)
    tube = Tube(affine_loop(place))
    k, signs = tube.strongest()
    size, steps = 0.5, np.flatnonzero(signs[:, 0]) + 1
    values = {int(step): float(size * signs[step - 1, 0]) for step in steps}
    truth = {"plant": {"process_var": (0.0,) * 4, "initial_sd": (0.0,) * 4}, "sensor": {"noise_sd": (1e-9,) * 3}}
    still = dataclasses.replace(place, truth=truth, manoeuvre=make("manoeuvre", "bend", value=0.0))
    loop = still.loop(Spec("defence", "kf").make())
    state, off = loop.start(draws.keys("tune", range(1))), 0.0
    for step in range(1, k):
        on = step in values
        command = loop.brief.command(np.array([on]), 5, np.array([[[True, False, False, False, False]]]), values.get(step, 0.0))
        state, frame = loop.advance(state, command)
        assert not frame.refused.any()
    off = float(loop.plant.truth(loop.plan.plant, state.plant, None)[0, 0, 0])
    assert len(steps) == 25 and abs(off) == pytest.approx(size * tube.pushed["gap"][k - 1].max(), rel=1e-4)


@pytest.mark.thin(3)
@pytest.mark.parametrize("seed", range(3))
def test_what_is_proved_is_below_every_attack_that_does_damage(seed):
    """On a linear system: errors that the best stealth attack reaches with a bound are never below what the tube allows at that bound."""
    rng = np.random.default_rng(seed)
    for size in rng.uniform(10.0, 60.0, 3):
        place = load_scenario(NETWORK).with_threat(fdi_bound=float(size))
        trace = play(place, "optimal_stealth:gate=1000.0", runs=400)
        found = float(np.abs(trace.estimate - trace.truth).max())
        proved = Tube(affine_loop(place, bound=found, spread=4.0), found).largest(100.0)
        assert proved is not None and proved <= size and proved > 0.2 * size
        tube = Tube(affine_loop(place, bound=1e3, spread=6.0), 1e3)
        assert found <= tube.error_norm(float(size)).max()


def test_bisection_finds_the_border_of_a_linear_bound():
    place = lane(targets=("lane_heading",), budget=20)
    tube = Tube(affine_loop(place, at_rest=True), alpha=1e-3)
    a, b = tube.lower_gap(0.0), tube.lower_gap(1.0)
    border = (a[a > b] / (a - b)[a > b]).min()
    assert tube.largest(10.0, limits=False) == pytest.approx(border, rel=1e-9)
    assert tube.under(border * 0.999).gap > 0.0 > tube.under(border * 1.001).gap


@pytest.mark.long
def test_a_smaller_budget_proves_no_less():
    found = [Tube(affine_loop(dataclasses.replace(lane(budget=n), horizon=80), at_rest=True), alpha=1e-3).largest(10.0, limits=False) for n in (0, 1, 5, 40, None)]
    assert found[0] == 10.0 and all(a >= b for a, b in itertools.pairwise(found)) and found[3] > found[4] * 0.99


@pytest.mark.long
def test_limits_of_the_command_count():
    place = load_scenario(LANE).with_threat(budget=20, targets=("lane_offset",))
    tube = Tube(affine_loop(place, at_rest=True), alpha=1e-3)
    strict, loose = tube.largest(10.0), tube.largest(10.0, limits=False)
    assert strict == pytest.approx(0.1537, abs=5e-4) and loose == pytest.approx(1.710, abs=5e-3)
    assert Tube(affine_loop(place), alpha=1e-3).largest(10.0) is None  # the first readings alone may ask for more than the steering has


@pytest.mark.long
def test_a_late_message_is_worse_only_if_it_is_led_on():
    """A stale position keeps the car farther behind; one that is led on by its speed hides a braking leader."""
    place = car()
    gaps = {
        stale: [Tube(affine_loop(place, at_rest=True, lead=(-0.5, 0.5), delay=d, stale=stale)).under(0.0).gap for d in (0, 5, 20)] for stale in (True, False)
    }
    assert gaps[True] == sorted(gaps[True]) and gaps[False] == sorted(gaps[False], reverse=True) and gaps[True][0] == gaps[False][0]


@pytest.mark.long
def test_the_largest_delay_is_the_one_at_which_an_attack_uses_up_the_gap():
    """An injection that leaves a centimetre at 3 steps of delay takes it at 4; one that takes all without a delay leaves no delay."""
    rest = {"at_rest": True, "lead": (-0.5, 0.5)}
    place = dataclasses.replace(car(targets=("position",)), horizon=80)
    place = dataclasses.replace(place, controller=dataclasses.replace(place.controller, standstill=2.0, headway=0.5))
    tubes = [Tube(affine_loop(place, delay=delay, **rest)) for delay in range(5)]
    step = int(np.argmin(tubes[3].lower_gap(0.0)))
    size = (tubes[3].lower_gap(0.0)[step] - 0.01) / tubes[3].pushed["gap"][step, 0]
    gaps = [tube.lower_gap(size).min() for tube in tubes]
    assert gaps == sorted(gaps, reverse=True) and gaps[3] == pytest.approx(0.01, abs=1e-6) and gaps[4] < -0.01
    found = message_delay(place, size, None, **rest)
    assert found["largest"] == 3 and [row["delay"] for row in found["tried"]] == [0, 1, 2, 3, 4]
    assert message_delay(place, 2.0 * size, None, **rest)["largest"] is None


def test_what_is_not_linear_is_refused():
    with pytest.raises(NotApplicable, match=r"set_speed.*29.95.*smaller of two laws"):
        affine_loop(load_scenario(CAR))
    with pytest.raises(NotApplicable, match=r"lane-wet-v0.*known"):
        affine_loop(load_scenario("lane-wet-v0"))
    with pytest.raises(NotApplicable, match=r"platoon-braking-v0.*one agent"):
        affine_loop(load_scenario("platoon-braking-v0"))
    with pytest.raises(NotApplicable, match=r"targets.*sensors"):
        affine_loop(lane(targets=("curvature",)))
    with pytest.raises(InputError, match=r"--bound.*error that counts"):
        affine_loop(load_scenario(NETWORK))
    for words, options in {"--spread.*0": {"spread": 0.0}, "delay.*-1": {"delay": -1}, "--lead-accel.*smaller first": {"lead": (1.0, 0.0)}}.items():
        with pytest.raises(InputError, match=words):
            affine_loop(car(), **options)
    with pytest.raises(InputError, match=r"--gaussian.*1.5"):
        Tube(affine_loop(car()), alpha=1.5)


@pytest.mark.parametrize("name", ["radar-following-v0", "radar-braking-v0", "radar-fast-attacker-v0", "thesis-ch3-v0", "thesis-ch3-switched-v0"])
def test_a_controller_that_reads_its_own_sensors_is_refused_before_it_is_probed(name):
    report = prove(name, set_speed=False, delays=True)
    assert report["attack"] is None and "RadarFollowing" in report["why"]["attack"] and "leader that sends" in report["why"]["delay"]


@pytest.mark.parametrize("name", ["car-following-heavy-v0", "car-following-late-v0", "car-following-lossy-v0", "platoon-heavy-v0"])
def test_the_closed_form_is_refused_where_the_real_vehicle_is_another(name):
    with pytest.raises(NotApplicable, match=r"truth.*known"):
        reacting(load_scenario(name))


def test_the_closed_form_needs_a_bound_on_how_the_car_ahead_brakes():
    with pytest.raises(NotApplicable, match=r"plant.*Highway.*cut in"):
        reacting(load_scenario("highway-v0"))
    place = load_scenario(CAR)
    with pytest.raises(NotApplicable, match=r"manoeuvre.*Profile.*bounds its acceleration"):
        reacting(dataclasses.replace(place, manoeuvre=make("manoeuvre", "profile")))
    hard = dataclasses.replace(place, manoeuvre=dataclasses.replace(place.manoeuvre, decel=7.5))
    assert reacting(hard).lead_brake == 7.5


@pytest.mark.thin(3)
@pytest.mark.parametrize(
    ("manoeuvre", "wanted"),
    [("braking", (-4.0, 0.0)), ("stop_and_go", (-3.0, 1.5)), ("ornstein_uhlenbeck", (-3.0, 3.0)), ("sine", (-0.5, 0.5)), ("switched", (-0.1082, 0.012)),
     ("constant", (-0.108, 0.0)), ("pulse", (0.0, 0.3))],
)  # fmt: skip
def test_a_leader_stays_within_his_accelerations(manoeuvre, wanted):
    """As it says, and as it is played."""
    one = make("manoeuvre", manoeuvre)
    assert accelerations(one) == wanted
    place = dataclasses.replace(load_scenario(CAR), manoeuvre=one, horizon=600)
    speed = play(place, runs=20).lead_speed[..., 0]
    pull = np.diff(speed, axis=0) / place.plant.dt
    assert pull.min() >= wanted[0] - 1e-6 and pull.max() <= wanted[1] + 1e-6


def test_a_leader_that_brakes_once_is_in_the_loop():
    for name in ("braking-v0", "braking-fine-v0"):
        report = prove(name, set_speed=False, steps=20)
        assert report["attack"] is not None and not report["why"]


def test_delays_of_nobody_leave_the_rest_of_the_report():
    for name, options in ((LANE, {"alpha": 0.001, "at_rest": True}), (NETWORK, {"bound": 30.0})):
        report = prove(name, delays=True, steps=40, **options)
        assert report["attack"] is not None and report["delay"] is None and "leader that sends" in report["why"]["delay"]


def test_an_authenticated_wire_takes_no_injection():
    threat = {"targets": ["lane_offset", "lane_heading"], "budget": 20}
    sealed, one = (prove(LANE, alpha=0.001, at_rest=True, steps=60, threat=threat | more)["attack"] for more in ({"authenticated": ["lane_offset"]}, {"targets": ["lane_heading"]}))
    assert sealed == one and sealed["targets"] == ["lane_heading"]
    none = prove(LANE, alpha=0.001, at_rest=True, steps=60, threat={"targets": ["lane_offset"], "authenticated": ["lane_offset"]})["attack"]
    assert none["targets"] == [] and none["largest"] == none["most"]


@pytest.mark.parametrize("bound", [float("nan"), float("inf"), -3.0, 0.0])
def test_a_bound_is_a_finite_number_above_zero(bound):
    with pytest.raises(InputError, match=r"--bound.*finite number above 0"):
        prove(NETWORK, bound=bound)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--prove", "--defence", "chi2_kf"], "--defence"), (["--prove", "--attack", "none"], "--attack"), (["--prove", "--suite", "lane-v0"], "--suite"),
        (["--prove", "--runs", "5"], "--runs"), (["--prove", "--out", "x"], "--out"), (["--prove", "--alpha", "0.01"], "--alpha"), (["--prove", "--dose", "5", "--dose", "20"], "--dose"),
        (["--prove", "--automata", "telematics"], "--automata"), (["--prism", "x.prism"], "--prism"), (["--bound", "3"], "--bound"), (["--delays"], "--delays"),
        (["--automata", "telematics", "--at-rest"], "--at-rest"), (["--automata", "telematics", "--out", "x"], "--out"),
        (["--prove", "--property", "gap > 2"], "--property"), (["--prove", "--gaussian", "1.5"], "--gaussian"), (["--prove", "--bound", "nan", "--json"], "--bound"),
    ],
)  # fmt: skip
def test_an_option_that_is_not_read_is_refused(words, named, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scenario = [] if "telematics" in words and "--prove" not in words else ["--scenario", LANE]
    assert cli.main(["trust", *scenario, *words]) == 2
    assert f"{named}:" in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["--gaussian", "0.001", "--at-rest", "--delays", "--steps", "40"], ["--spread", "3", "--steps", "40"]])
def test_the_printed_table(words, capsys):
    assert cli.main(["trust", "--prove", "--scenario", LANE, *words]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert ("all ranges together with 0.999" if "--gaussian" in words else "noise within 3 sd") in text and "no closed form: " in text


def test_a_controller_is_read_off_exactly():
    place = car()
    law, h, gamma = probed(place.controller, place.brief().model), place.controller.headway, place.controller.gamma
    assert np.allclose(law.F, [[-gamma / h, -(1.0 + gamma * h) / h, 0.0]], atol=1e-8) and np.allclose(law.H, [[gamma / h, 1.0 / h]], atol=1e-8)
    assert law.u0 == pytest.approx(-gamma * place.controller.standstill / h) and (law.low, law.high) == (-5.0, 2.0)


def test_the_command(capsys):
    assert cli.main(["trust", "--prove", "--scenario", LANE, "--at-rest", "--gaussian", "0.001", "--dose", "20", "--threat", "targets=[lane_offset]", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)[0]
    assert report["format"] == "tailgate-proof-1" and report["attack"]["largest"] == pytest.approx(0.1537, abs=5e-4) and report["closed_form"] is None
    assert report == json.loads(json.dumps(prove(LANE, alpha=0.001, threat={"budget": 20, "targets": ["lane_offset"]}, at_rest=True)))
    assert cli.main(["trust", "--prove", "--scenario", CAR]) == 0
    assert "admissible bias" in " ".join(capsys.readouterr().out.split())
    assert cli.main(["trust", "--prove"]) == 2 and "--scenario" in capsys.readouterr().err
    assert cli.main(["trust", "--prove", "--scenario", "thesis-ch5-v0"]) == 1
