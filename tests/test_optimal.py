"""Optimal attackers: dynamic programming against brute force and known answers, stealth against its bound and a convex programme, holding against play."""

import dataclasses
import itertools
import math

import numpy as np
import pytest

import tailgate
from tailgate.agents.optimal.optimal_stealth import farthest_inside
from tailgate.agents.optimal.schedules import Filtering, Grid, Holding, Rules, best_holds, best_losses, farthest, reach, stealth_programme
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind
from tailgate.core.draws import keys
from tailgate.core.registry import entries
from tailgate.core.scenario import load_scenario
from tailgate.core.threat import ThreatModel
from tailgate.envs.plants.sensor_network import LinearSensors, NoControl, SensorNetwork
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout
from tailgate.thesis.bounds import stealth_bound, updated

OPTIMAL = ("optimal_dos", "optimal_hold", "optimal_stealth")
BIG = 3.29  # standard errors of a 99.9 % interval


def system(a, states=1, seed=1, sensors=1):
    """The filter's view of a network of one agent with the given spectral radius, process noise 0.1 and sensor noise 1."""
    plant = SensorNetwork(agents=1, states=states, graph="path", system="modal", spectral_radius=a, system_seed=seed, process_var=0.1)
    model = plant.model(LinearSensors(sensors=sensors, sensor_seed=seed), NoControl())
    return Filtering(model.A, model.C[0], model.Q, model.R[0], np.ones(sensors, bool))


def accepted(schedule, rules):
    """Whether a threat model accepts every step of a schedule."""
    held = (0, 0, 0)
    for k, attack in enumerate(schedule, 1):
        held = rules.after(k, held, bool(attack))
        if held is None:
            return False
    return True


def value(filtering, P, schedule, objective):
    traces = np.trace(filtering.covariances(P, np.array(schedule, bool)), axis1=1, axis2=2)
    return float(traces[-1] if objective == "final" else traces.sum())


def test_they_are_ceilings():
    """Their cards and rows say that they are optimal, so that no board counts them as rivals."""
    assert {name for name, entry in entries("attack").items() if entry.optimal} == set(OPTIMAL)
    (row,) = run_cell(Cell("custom", "linear-dos-v0", None, "kf", "optimal_dos", seeds=1))
    assert row["optimal"] and row["status"] == "ok" and row["attack_steps"] == 8.0


# -- losses


@pytest.mark.long
@pytest.mark.parametrize("objective", ["final", "sum"])
@pytest.mark.parametrize(
    "rules",
    [Rules(1, 10, 4, 10, 0), Rules(3, 9, 4, 10, 0), Rules(1, 10, 5, 2, 0), Rules(2, 10, 4, 3, 3), Rules(1, 10, 10, 1, 2), Rules(4, 4, 3, 9, 0)],
)
@pytest.mark.parametrize("states, a, seed", [(1, 1.2, 0), (1, 0.7, 0), (2, 1.0, 0), (2, 1.1, 2), (3, 0.95, 1)])
def test_the_schedule_is_as_good_as_the_best_of_all(states, a, seed, rules, objective):
    """Brute force over all 1024 schedules of ten steps that the threat model accepts."""
    filtering, P = system(a, states, seed), 2.0 * np.eye(states)
    found = best_losses(filtering, P, rules, 10, objective)
    assert accepted(found, rules)
    best = max(value(filtering, P, s, objective) for s in itertools.product((0, 1), repeat=10) if accepted(s, rules))
    assert value(filtering, P, found, objective) == pytest.approx(best, rel=1e-8)


@pytest.mark.parametrize("a", [1.0, 1.05, 1.5, -1.2])
@pytest.mark.parametrize("budget", [1, 5, 12])
def test_the_known_answer(a, budget):
    """One state that does not die out: for the last covariance the whole budget in one block at the end."""
    filtering = dataclasses.replace(system(1.0), A=np.array([[a]]))
    found = best_losses(filtering, np.eye(1), Rules(1, 40, budget, 40, 0), 40)
    np.testing.assert_array_equal(np.flatnonzero(found), np.arange(40 - budget, 40))


def test_the_known_answer_needs_a_state_that_lasts():
    """Without process noise a reading of a dying state weighs the more the earlier it comes: then the block is the first one."""
    filtering = dataclasses.replace(system(0.8), Q=np.zeros((1, 1)))
    found = best_losses(filtering, np.eye(1), Rules(1, 12, 3, 12, 0), 12)
    np.testing.assert_array_equal(np.flatnonzero(found), [0, 1, 2])


def test_the_largest_sum_is_a_block_too_but_not_the_last():
    """With the covariance at rest the sum is the larger the earlier its growth is forgotten last: it leaves steps for it to die away."""
    filtering = system(1.1, 2)
    P = np.eye(2)
    for _ in range(200):
        P = filtering.step(P[None], False)[0]
    found = np.flatnonzero(best_losses(filtering, P, Rules(1, 40, 5, 40, 0), 40, "sum"))
    assert found[-1] - found[0] == 4 and found[-1] < 39


def test_only_what_is_lost_counts():
    """Losing one of two sensors leaves the covariance below that of losing both, above that of losing none."""
    filtering, P = system(1.1, 2, sensors=2), np.eye(2)
    some = dataclasses.replace(filtering, lost=np.array([True, False]))
    steps = np.ones(6, bool)
    none, one, both = (np.trace(f.covariances(P, s)[-1]) for f, s in ((filtering, ~steps), (some, steps), (filtering, steps)))
    assert none < one < both


@pytest.mark.long
def test_what_grows_too_large_says_so():
    """Many states and a tiny slack: the search gives up with a reason instead of running for hours."""
    with pytest.raises(NotApplicable, match="a smaller system or budget"):
        best_losses(system(1.0, 5, sensors=1), np.eye(5), Rules(1, 40, 20, 40, 0), 40, slack=1e-15)


def test_played_losses_are_those_predicted(play):
    """The scenario: the mean squared final error is the trace of the covariance, in a 99.9 % interval, and above that of other schedules."""
    place = load_scenario("linear-dos-v0")
    trace = play(place, "kf", "optimal_dos", range(1500))
    on = trace.kind[:, 0] == Kind.DROPOUT
    assert on.sum() == 8 and not trace.refused.any()
    model = place.brief().model
    filtering = Filtering(model.A, model.C[0], model.Q, model.R[0], np.ones(1, bool))
    predicted = value(filtering, np.eye(2), on, "final")  # told_prior = 1
    squared = METRICS["final_error"](trace) ** 2
    assert abs(squared.mean() - predicted) < BIG * squared.std() / math.sqrt(1500)
    for script in ("dropout", "none"):
        other = METRICS["final_error"](play(place, "kf", script, range(1500))) ** 2
        assert other.mean() < squared.mean() / 3.0


@pytest.mark.long
@pytest.mark.parametrize("threat", [{"duration": 3}, {"duration": 2, "cooldown": 4}, {"end": 50, "cooldown": 3}, {"budget": None, "end": 20}])
def test_the_channel_accepts_every_loss(threat, play):
    """Whatever the threat model limits, nothing is refused and the schedule is used up as far as it may be."""
    place = dataclasses.replace(load_scenario("linear-dos-v0"), horizon=40).with_threat(**threat)
    trace = play(place, "kf", "optimal_dos", range(2))
    assert not trace.refused.any()
    assert (trace.kind != 0).sum(axis=0).tolist() == [10 if threat.get("budget", 8) is None else 8] * 2


def test_losses_do_not_apply_elsewhere():
    """A driven system, several agents and a threat model without losses are refused with the reason."""
    dos = tailgate.make_attack("optimal_dos")
    for name, threat, message in (
        ("stop-and-go-v0", {}, "a system without input"), ("network-weak-v0", {}, "one agent"), ("linear-dos-v0", {"kinds": ("fdi",)}, "grants dropout"),
    ):
        with pytest.raises(NotApplicable, match=message):
            dos.prepare(load_scenario(name).with_threat(**threat).brief())


# -- stealth


def noiseless(**plant):
    """Two rotating modes seen by two sensors, without any noise in truth; window of 12 steps at the end of 50."""
    place = load_scenario("linear-stealth-v0")
    system = dataclasses.replace(place.plant, states=2, noise_var=0.0, initial_sd=0.0, spectral_radius=1.02, **plant)
    sensor = dataclasses.replace(place.sensor, sensors=2, noise_var=0.0)
    return dataclasses.replace(place, plant=system, sensor=sensor).with_threat(onset=39, knowledge="white", fdi_bound=1e6)


def filters_of(place, steps):
    """S and K of the last `steps` steps of the filter of a scenario of 50 steps, and P- at the first of them."""
    model, P, out = place.brief().model, place.plant.prior_var * np.eye(2), []
    for _ in range(50):
        P = model.A @ P @ model.A.T + model.Q
        out.append(updated(P, model.C[0], model.R[0]))
        P = out[-1].after
    return out[-steps:], out[-steps].before


@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.3, -0.9)])
def test_without_bounds_the_bound_is_reached(direction, play):
    """No noise, no bound: the deviation along e at the last step is bounds.stealth_bound to 1e-6, and nobody alarms."""
    place, e = noiseless(), np.array(direction) / np.linalg.norm(direction)
    trace = play(place, "chi2_kf", tailgate.make_attack("optimal_stealth", direction=direction), range(2))
    moved = (trace.estimate - trace.truth)[-1, :, 0] @ e
    filters, _ = filters_of(place, 12)
    np.testing.assert_allclose(np.abs(moved), stealth_bound(place.brief().model.A, filters, 20.0, e), rtol=1e-6)
    assert not trace.alarm.any() and not trace.refused.any()


def test_it_beats_greedy_stealth(play):
    """Modes that turn: pushing one state in every step, either way, ends nearer, in that very state."""
    place = noiseless()
    far = []
    for attack in (
        tailgate.make_attack("optimal_stealth", direction=(1.0, 0.0)), tailgate.make_attack("stealth", sign=1), tailgate.make_attack("stealth", sign=-1),
    ):
        trace = play(place, "chi2_kf", attack, range(2), terminate=False)
        assert not trace.alarm.any()
        far.append(np.abs(trace.estimate - trace.truth)[-1, :, 0, 0].max())
    assert far[0] > 1.2 * max(far[1:])


def test_the_farthest_direction(play):
    """No direction of a fine circle is reached farther than the one that is found."""
    place = noiseless()
    model, (filters, P) = place.brief().model, filters_of(place, 12)
    circle = [np.array([math.cos(t), math.sin(t)]) for t in np.linspace(0.0, math.pi, 721)]
    most = max(stealth_bound(model.A, filters, 20.0, e) for e in circle)
    e = farthest(model, P, 12)
    assert stealth_bound(model.A, filters, 20.0, e) >= most * (1.0 - 1e-9)
    assert sum(np.linalg.norm(L @ e) for L in reach(model.A, P, model.C[0], model.R[0], model.Q, 12)) * math.sqrt(20.0) == pytest.approx(most, rel=1e-4)


def test_it_never_alarms_and_turns_with_the_error(play):
    """With noise: no alarm in 300 episodes, every step of the window used, and a mean square above that of either fixed sign."""
    place = load_scenario("linear-stealth-v0")
    squared = {}
    for name, attack in (("optimal", "optimal_stealth"), ("plus", tailgate.make_attack("stealth", sign=1)), ("minus", tailgate.make_attack("stealth"))):
        white = place.with_threat(knowledge="white")
        trace = play(white, "chi2_kf", attack, range(300))
        squared[name] = METRICS["final_error"](trace) ** 2
        assert not trace.alarm.any() and ((trace.kind != 0).sum(axis=0) == 20).all()
    assert squared["optimal"].mean() > max(squared["plus"].mean(), squared["minus"].mean())


@pytest.mark.parametrize("q", [1, 2, 3])
def test_a_step_under_bounds_is_that_of_a_convex_programme(q):
    """Random innovations, covariances and bounds that bind: the value of gain' a agrees with cvxpy, and so does whether there is one."""
    cvxpy = pytest.importorskip("cvxpy")
    rng = np.random.default_rng(q)
    bound_by = {True: 0, False: 0}
    for _ in range(25):
        root, r, gain, bound = rng.normal(size=(q, q)) + np.eye(q), 2.0 * rng.normal(size=q), rng.normal(size=q), rng.uniform(0.3, 3.0)
        W = root @ root.T + 0.1 * np.eye(q)
        a, found = farthest_inside(r[None, None], W[None, None], gain[None, None], 4.0, np.arange(q), bound)
        x = cvxpy.Variable(q)
        problem = cvxpy.Problem(cvxpy.Maximize(gain @ x), [cvxpy.quad_form(r + x, cvxpy.psd_wrap(W)) <= 4.0, cvxpy.abs(x) <= bound])
        problem.solve(solver="CLARABEL")
        assert found[0, 0] == (problem.status in ("optimal", "optimal_inaccurate"))
        bound_by[bool(found[0, 0])] += 1
        if found[0, 0]:
            assert gain @ a[0, 0] == pytest.approx(problem.value, rel=1e-5, abs=1e-5)
            assert (r + a[0, 0]) @ W @ (r + a[0, 0]) <= 4.0 * (1 + 1e-9) and np.abs(a).max() <= bound
    assert bound_by[True] > 5


def test_without_bounds_the_programme_gives_the_closed_form():
    """One convex programme over the whole window: the bound where nothing binds, less where something does, never less than play."""
    pytest.importorskip("cvxpy")
    place = noiseless()
    model, (filters, P) = place.brief().model, filters_of(place, 12)
    e = np.array([1.0, 0.0])
    free, values = stealth_programme(model, P, e, 20.0, 1e6, 12)
    assert free == pytest.approx(stealth_bound(model.A, filters, 20.0, e), rel=1e-5)
    tight, inside = stealth_programme(model, P, e, 20.0, 0.3 * np.abs(values).max(), 12)
    assert 0.2 * free < tight < 0.9 * free and np.abs(inside).max() <= 0.3 * np.abs(values).max() * (1 + 1e-6)


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_under_bounds_play_stays_below_the_programme(share, play):
    """Each step the best by itself: unnoticed, within the bound, and between 99 % and 100 % of the programme over all steps."""
    pytest.importorskip("cvxpy")
    place, e = noiseless(), np.array([1.0, 0.0])
    model, (_, P) = place.brief().model, filters_of(place, 12)
    bound = share * np.abs(stealth_programme(model, P, e, 20.0, 1e6, 12)[1]).max()
    ceiling, _ = stealth_programme(model, P, e, 20.0, bound, 12)
    held = place.with_threat(fdi_bound=float(bound))
    trace = play(held, "chi2_kf", tailgate.make_attack("optimal_stealth", direction=(1.0, 0.0)), [0])
    moved = abs((trace.estimate - trace.truth)[-1, 0, 0, 0])
    assert not trace.alarm.any() and np.abs(trace.value).max() <= bound
    assert 0.99 * ceiling <= moved <= ceiling * (1.0 + 1e-6)


def test_stealth_says_what_it_needs(play):
    """White box, one agent, a defence with a gate, and a direction of the right length."""
    place = load_scenario("linear-stealth-v0")
    with pytest.raises(InputError, match="white"):
        rollout(place.with_threat(knowledge="black").loop(tailgate.make_defence("chi2_kf")), tailgate.make_attack("optimal_stealth"), keys("train", [0]))
    with pytest.raises(NotApplicable, match="a gate"):
        play(place.with_threat(knowledge="white", onset=1), "kf", "optimal_stealth", [0])
    with pytest.raises(InputError, match="direction"):
        tailgate.make_attack("optimal_stealth", direction=(1.0, 2.0)).prepare(place.brief())
    with pytest.raises(NotApplicable, match="one agent"):
        tailgate.make_attack("optimal_stealth").prepare(load_scenario("network-weak-v0").brief())


# -- holding


def test_the_table_agrees_with_brute_force():
    """Almost no noise: the best of all schedules of nine steps from a state that is known, to the grid's accuracy."""
    loop, steps, budget = Holding(1.0, 0.4, 0.1), 9, 4
    grid = Grid.of(0.1, 30.0, 5)
    small = grid._replace(weights=np.array([1.0]))  # the noise itself left out
    for objective in ("final", "sum"):
        table = best_holds(loop, Rules(1, steps, budget, steps, 0), steps, objective, small)
        for x0, h0 in ((1.0, 1.0), (1.0, -0.4), (0.6, 0.0)):
            best = 0.0
            for schedule in itertools.product((0, 1), repeat=steps):
                if sum(schedule) > budget:
                    continue
                x, h, total, last = x0, h0, 0.0, 0.0
                for on in schedule:
                    h = h if on else x
                    last = (x - h) ** 2
                    total += last
                    x = loop.a * x - loop.g * h
                best = max(best, last if objective == "final" else total)
            i, j = small.nearest(np.array([x0, h0]))
            assert table.value[i, j] == pytest.approx(best, rel=2e-2)


@pytest.mark.parametrize("objective", ["final", "sum"])
def test_the_value_is_the_mean_of_play(objective, play):
    """What the table predicts from the start is the Monte-Carlo mean, in a 99.9 % interval; more than one block and than waiting does."""
    place = load_scenario("scalar-hold-v0")
    attack = tailgate.make_attack("optimal_hold", objective=objective)
    trace = play(place, "none", attack, range(3000))
    error = (trace.estimate - trace.truth)[:, :, 0, 0] ** 2
    got = error[-1] if objective == "final" else error.sum(axis=0)
    table = attack.prepare(place.brief()).table
    x, grid = trace.truth[0, :, 0, 0], table.grid
    predicted = table.value[grid.nearest(x), grid.nearest(np.zeros(1))[0]].mean()  # before the first reading 0 is held
    assert abs(got.mean() - predicted) < BIG * got.std() / math.sqrt(3000) + 0.01 * predicted
    assert not trace.refused.any() and ((trace.kind != 0).sum(axis=0) <= 12).all()
    block = play(place, "none", tailgate.make_attack("dos_hold", fresh=True, start_step=49), range(3000))
    other = (block.estimate - block.truth)[:, :, 0, 0] ** 2
    assert got.mean() > 1.3 * (other[-1] if objective == "final" else other.sum(axis=0)).mean()


def test_a_larger_budget_is_never_worse_and_none_is_worth_nothing():
    """The values by budget: 0 without one, then growing."""
    loop, grid = Holding(1.0, 0.25, 1.0), Grid.of(1.0, 8.0, 2)
    values = [best_holds(loop, Rules(1, 20, b, 20, 0), 20, "final", grid).value for b in (0, 1, 3, 8)]
    assert not values[0].any()
    assert all((more >= less - 1e-9).all() and more.max() > less.max() for less, more in itertools.pairwise(values))


def test_the_reading_is_what_is_held(play):
    """While it holds, what arrives is the last reading before the burst; the table's own idea of it is the channel's."""
    trace = play(load_scenario("scalar-hold-v0"), "none", "optimal_hold", range(50))
    y, on = trace.wires[:, :, 0, 0], trace.kind != 0
    x = trace.truth[:, :, 0, 0]
    held = np.zeros(50)
    for k in range(60):
        held = np.where(on[k], held, x[k])
        np.testing.assert_array_equal(y[k], held)
    assert on[-1].mean() > 0.9


def test_holding_says_what_it_needs():
    """Another plant, limited bursts, and a reading that is not shown are refused."""
    hold, place = tailgate.make_attack("optimal_hold"), load_scenario("scalar-hold-v0")
    for brief, message in (
        (load_scenario("stop-and-go-v0").brief(), "scalar_loop"), (place.with_threat(duration=3).brief(), "no duration"),
        (place.with_threat(kinds=("fdi",)).brief(), "dos_hold_fresh"),
    ):
        with pytest.raises(NotApplicable, match=message):
            hold.prepare(brief)
    with pytest.raises(InputError, match="sees_measurement"):
        rollout(place.with_threat(sees_measurement=False).loop(tailgate.make_defence("none")), hold, keys("train", [0]))


def test_the_scalar_loop(play):
    """Undisturbed it is x+ = (1 - g) x + w: in the stationary state the variance is 1 / (1 - 0.75^2), in a 99.9 % interval."""
    trace = play(load_scenario("scalar-hold-v0"), "none", "none", range(3000))
    last = trace.truth[-1, :, 0, 0]
    wanted = 1.0 / (1.0 - 0.75**2)
    assert abs((last**2).mean() - wanted) < BIG * wanted * math.sqrt(2.0 / 3000)
    np.testing.assert_array_equal(trace.estimate, trace.truth)
    np.testing.assert_allclose(trace.applied[:, :, 0, 0], -0.25 * trace.truth[:, :, 0, 0], rtol=1e-12)


@pytest.mark.parametrize("scenario, defence, attack", [
    ("linear-dos-v0", "kf", "optimal_dos"), ("linear-stealth-v0", "chi2_kf", "optimal_stealth"), ("scalar-hold-v0", "none", "optimal_hold"),
])
@pytest.mark.thin(4)
def test_rows_do_not_depend_on_their_batch(scenario, defence, attack, play, same_rows):
    """Alone, among 3 or among 32: the same trace to the last bit."""
    place = load_scenario(scenario)
    place = dataclasses.replace(place, horizon=35 if attack == "optimal_dos" else 50).with_threat(end=None)
    same_rows(lambda seeds: play(place, defence, attack, seeds), 32, [7], [9, 0, 31])


def test_rules_are_those_of_the_channel():
    """What is not limited is limited by the horizon, and the end never lies behind it."""
    assert Rules.of(ThreatModel(), 30) == Rules(1, 30, 30, 30, 0)
    assert Rules.of(ThreatModel(budget=4, duration=2, cooldown=3, onset=5, end=99), 30) == Rules(5, 30, 4, 2, 3)
