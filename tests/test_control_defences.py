"""Control defences: what they bound, when, from which readings, and what the bounds guarantee."""

import dataclasses
from functools import partial

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import cont2discrete

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Mode, Received
from tailgate.core.draws import keys
from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario
from tailgate.envs.controllers.cacc import Column
from tailgate.estimators import compose
from tailgate.estimators.compose import Score
from tailgate.estimators.distributed.distributed_kalman import DistributedKalmanFilter
from tailgate.estimators.mitigations.control_defences import OWN, AccFallback, InputClip, SlidingMode, peak, reachable, response
from tailgate.estimators.parts import Verdict
from tailgate.play.trace import rollout

DT, MODEL = 0.1, load_scenario("platoon-v2v-v0").brief().model
LIE = "fdi:targets=[predecessor_acceleration],value=10"
RNG = np.random.default_rng(5)


def guarded(mitigation, detector=None, filter=None):
    return compose(filter or DistributedKalmanFilter(), detector or Score(), mitigation)


def play(defence, attack="none", place="platoon-v2v-v0", seeds=range(8), changes=None, **threat):
    here = load_scenario(place).with_threat(**threat)
    here = dataclasses.replace(here, **(changes or {}))
    spec = tailgate.core.registry.Spec("attack", attack)
    return rollout(here.loop(defence), spec.make(), keys("train", list(seeds)))


def fed(mitigation, readings, alarms=None, valid=None):
    """Decisions of one mitigation on readings (K, 5, 3) of one episode, with alarms (K, 5) that suspect every sensor."""
    plan = mitigation.prepare(MODEL)
    state, out = mitigation.start(plan, 1), []
    for k, y in enumerate(readings):
        alarm = np.zeros((1, 5), bool) if alarms is None else alarms[k][None]
        verdict = Verdict(alarm.astype(float), alarm, np.broadcast_to(alarm[..., None], (1, 5, 3)))
        there = np.ones((1, 5, 3), bool) if valid is None else valid[k][None]
        state, decision = mitigation.step(plan, state, verdict, Received(y[None], there, np.zeros((1, 5))))
        out.append(decision)
    return out


def steady(speed=20.0, gap=65.0):
    return np.broadcast_to([gap, speed, 0.0], (5, 3)).copy()


# --- the own loop and the set that a deviation can reach ---


def test_the_own_loop_is_the_hold_of_a_car_under_its_law():
    """A, and the entries of deviation, car ahead and noise, equal scipy's hold of d' = v_p - v, v' = a, tau a' = u - a with the law put in."""
    clip = InputClip(kp=0.6, kd=1.2, headway=2.5, lag=0.8, smoothing=0.4)
    own = clip.loop(DT)
    A = np.array([[0, -1, 0], [0, 0, 1], [0, 0, -1 / 0.8]])
    B = np.array([[0], [0], [1 / 0.8]])
    Ad, Bd = cont2discrete((A, B, np.eye(3), np.zeros((3, 1))), DT, "zoh")[:2]
    smooth = 1.0 - np.exp(-DT / 0.4)
    for _ in range(20):
        d, v, a, g = z = RNG.normal(size=4) * 5.0
        delta, ahead, n = RNG.normal(), RNG.normal(), RNG.normal(size=3)
        y = np.array([d, v, a]) + n
        u = 0.6 * (y[0] - 2.5 * y[1]) + 1.2 * ((y[0] - g) * smooth / DT - 2.5 * y[2]) + delta
        want = Ad @ z[:3] + Bd[:, 0] * u + [ahead, 0.0, 0.0]
        got = own.A @ z + own.forced * delta + own.ahead * ahead + own.noisy @ n
        np.testing.assert_allclose(got, [*want, g + smooth * (y[0] - g)], atol=1e-12)


def test_the_ellipsoid_holds_every_reached_state_and_is_nearly_reached():
    """z' Q^-1 z <= 1 under the worst and under random deviations; the worst gap comes within an eighth of the half-width."""
    own = InputClip().loop(DT)
    Q, width = reachable(own.A, own.forced)
    P, steps = np.linalg.inv(Q), 600
    kernel = response(own.A, own.forced)[:steps]
    worst = np.sign(kernel)[::-1]
    for w in (worst, -worst, *np.sign(RNG.normal(size=(20, steps))), np.ones(steps)):
        z, low = np.zeros(4), 0.0
        for each in w:
            z = own.A @ z + own.forced * each
            assert z @ P @ z <= 1.0 + 1e-9
            low = min(low, z[0])
        assert low >= -width
    assert 0.875 * width < peak(own.A, own.forced) <= width
    z = np.zeros(4)
    for each in -worst:
        z = own.A @ z + own.forced * each
    assert z[0] == pytest.approx(-peak(own.A, own.forced), rel=1e-6)


def test_the_ellipsoid_solves_the_matrix_inequality():
    """V+ <= a V + (1 - a) w^2 for all z and w, at equality of Q = A Q A'/a + b b'/(1-a), for the a of the narrowest one."""
    own = InputClip().loop(DT)
    A, b = own.A, own.forced
    Q, width = reachable(A, b)
    radius = np.abs(np.linalg.eigvals(A)).max()
    shares = np.linspace(radius**2, 1.0, 400)[1:-1]
    widths = [np.sqrt(solve_discrete_lyapunov(A / np.sqrt(a), np.outer(b, b) / (1.0 - a))[0, 0]) for a in shares]
    assert width <= min(widths) * (1.0 + 1e-9)
    a = shares[int(np.argmin(widths))]
    np.testing.assert_allclose(Q, solve_discrete_lyapunov(A / np.sqrt(a), np.outer(b, b) / (1.0 - a)), rtol=0.05)
    P = np.linalg.inv(Q)

    def left(a):
        """The matrix inequality's largest eigenvalue in (z, w), scaled to the ellipsoid."""
        M = np.block([[A.T @ P @ A - a * P, (A.T @ P @ b)[:, None]], [(b @ P @ A)[None], np.array([[b @ P @ b - (1.0 - a)]])]])
        S = np.linalg.cholesky(Q)
        T = np.block([[S, np.zeros((4, 1))], [np.zeros((1, 4)), np.eye(1)]])
        return np.linalg.eigvalsh(T.T @ M @ T).max()

    assert min(left(a) for a in shares) < 1e-4


def test_no_solver_finds_a_narrower_ellipsoid():
    """The linear matrix inequality of Kafash et al., solved by cvxpy on a grid of a, gives the same half-width."""
    cp = pytest.importorskip("cvxpy")
    own = InputClip().loop(DT)
    A, b = own.A, own.forced[:, None]
    found = []
    for a in (0.97, 0.975, 0.98, 0.985, 0.99):
        Q = cp.Variable((4, 4), PSD=True)
        M = cp.bmat([[a * Q, np.zeros((4, 1)), Q @ A.T], [np.zeros((1, 4)), np.array([[1.0 - a]]), b.T], [A @ Q, b, Q]])
        problem = cp.Problem(cp.Minimize(Q[0, 0]), [M >> 0])
        problem.solve(solver="CLARABEL")
        found.append(np.sqrt(problem.value))
    width = reachable(own.A, own.forced).width
    assert width <= min(found) * (1.0 + 1e-5)
    assert min(found) == pytest.approx(width, rel=1e-3)


def test_what_drives_ahead_takes_nothing_of_the_standstill_gap():
    """The gap's response to the speed ahead is nowhere negative and sums up to the headway; that to a command is nowhere positive."""
    own = InputClip().loop(DT)
    kernel = DT * response(own.A, own.ahead)
    assert kernel.min() > -1e-12 and kernel.sum() == pytest.approx(3.0, rel=1e-9)
    assert response(own.A, own.forced).max() <= 0.0
    assert InputClip().slack(own, DT) < 1e-9
    soft = InputClip(kp=0.1, kd=0.5)  # kp < 2 / tau_h^2: overshoots
    assert soft.slack(soft.loop(DT), DT) > 1.0


@pytest.mark.parametrize("sides", ["above", "both"])
def test_the_guarantee_in_the_worst_case(sides):
    """Whatever the car ahead does with its speed in [0, 40] m/s, with the worst noise and deviation, `clearance` is kept, and nearly reached."""
    clip = InputClip(sides=sides)
    own, bound, steps = clip.loop(DT), clip.bound(MODEL), 700
    sd = clip.sigmas * np.sqrt(np.diag(MODEL.R[1]))
    kernels = [np.resize(np.append(response(own.A, own.noisy[:, s]), np.zeros(steps)), steps) for s in range(3)]
    noise = np.sign(kernels)
    const = own.forced * -clip.kp * clip.standstill
    lows = []
    for ahead in [np.where(np.arange(steps) < stop, 20.0, 0.0) for stop in (1, 300, 600)] + [40.0 * (RNG.uniform(size=steps) < 0.5) for _ in range(5)]:
        z = np.array([65.0, 20.0, 0.0, 65.0])
        for k in range(steps):
            n = -noise[:, steps - 1 - k] * sd
            z = own.A @ z + const + own.forced * bound + own.ahead * DT * ahead[k] + own.noisy @ n
            lows.append(z[0])
    assert clip.clearance - 1e-6 <= min(lows) < clip.clearance + 0.5
    assert bound == pytest.approx(1.067, abs=0.001)


def test_a_bound_that_leaves_nothing_is_refused():
    """Noise too large for the standstill gap, or gains that overshoot, give an InputError that says so."""
    with pytest.raises(InputError, match="clearance"):
        InputClip(standstill=2.0).prepare(MODEL)
    with pytest.raises(InputError, match="sides"):
        InputClip(kp=0.1, kd=0.5, standstill=400.0).prepare(MODEL)
    with pytest.raises(InputError, match="stable"):
        InputClip(kp=3.0, kd=0.0, headway=0.3, standstill=4000.0).prepare(MODEL)
    with pytest.raises(InputError, match="accel_min"):
        SlidingMode(accel_min=4.0).prepare(MODEL)


# --- in the loop ---


def baseline(clip, y):
    """The own law's command (K, B, N) from readings y (K, B, N, 3)."""
    d, v, a = np.moveaxis(y, -1, 0)
    g, out, keep = d[0], [], np.exp(-DT / clip.smoothing)
    for k in range(len(y)):
        rate = (1.0 - keep) * (d[k] - g) / DT
        g = keep * g + (1.0 - keep) * d[k]
        out.append(clip.kp * (d[k] - clip.standstill - clip.headway * v[k]) + clip.kd * (rate - clip.headway * a[k]))
    return np.array(out)


@pytest.mark.long
def test_falsified_accelerations_collide_without_the_clip_and_not_with_it():
    """A bias of 10 m/s^2 on the predecessor's acceleration: everybody collides under dkf and lasso_dkf, nobody with the clip."""
    for filter in ("dkf", "lasso"):
        assert play(guarded(make("mitigation", "accept_all"), filter=make("filter", filter)), LIE).collided.any(axis=0).all()
        safe = play(guarded(InputClip(), filter=make("filter", filter)), LIE)
        assert not safe.collided.any() and safe.gap[:, :, 1:].min() > InputClip().clearance


@pytest.mark.long
@pytest.mark.parametrize("sides", ["above", "both"])
def test_the_command_stays_within_the_bound_of_the_own_law(sides):
    """Recomputed from what was received: at most `bound` above, and with both sides below, within the own law's limits."""
    clip = InputClip(sides=sides)
    bound = clip.bound(MODEL)
    for lie in (LIE, LIE.replace("=10", "=-10")):
        trace = play(guarded(clip), lie, seeds=range(2), changes={"horizon": 150})
        u, own = trace.control[:, :, 1:, 0], baseline(clip, trace.wires[:, :, 1:, :3])
        assert (u <= np.clip(own + bound, -8.0, 3.0) + 1e-9).all()
        assert (u < np.clip(own - bound, -8.0, 3.0) - 1e-9).any() == (sides == "above" and lie != LIE)
        assert (np.abs(u - own) > bound - 1e-6).any()  # a bound is met
        assert (trace.control[:, :, 0] == 0.0).all()  # nobody holds the leader back


@pytest.mark.long
def test_one_side_does_not_follow_false_readings():
    """A false gap of +60 m on the own sensor: with a lower bound too the car is driven into the one ahead, whatever the filter knows."""
    options = {"attack": "fdi:value=60,targets=[distance],chance=0.9", "place": "platoon-braking-v0", "onset": 20, "changes": {"horizon": 250}}
    lasso = make("filter", "lasso")
    above, both = (play(guarded(InputClip(sides=sides), filter=lasso), **options, seeds=range(4)) for sides in ("above", "both"))
    assert not above.collided.any() and both.collided.any()


def test_sliding_mode_keeps_to_its_surface_and_out_of_collision():
    """Without noise |sigma| <= phi, but for what the gap's rate lags behind, in hard braking, whatever the messages say; the cars stop apart."""
    still = {"sensor": make("sensor", "platoon_sensors", noise_sd=(0.0, 0.0, 0.0), told_sd=(0.1, 0.1, 0.05))}
    slide = SlidingMode(when="always", smoothing=0.1)
    trace = play(guarded(slide), LIE, seeds=range(2), changes=still | {"manoeuvre": make("manoeuvre", "braking", onset=(10.0, 12.0), decel=7.5), "horizon": 250})
    assert not trace.collided.any() and trace.gap[:, :, 1:].min() > 4.5
    X = trace.truth[:, :, 0]
    for i in (1, 2, 3, 4):
        d, v, a, ahead = (X[..., place] for place in (Column.gap(i), Column.speed(i), Column.accel(i), Column.speed(i - 1)))
        moving = v > 0.5
        sigma = (ahead - v - 3.0 * a) + slide.lam * (d - 5.0 - 3.0 * v)
        assert (0.9 * slide.phi if i == 1 else 0.0) < np.abs(sigma[moving]).max() < slide.phi + 7.5 * slide.smoothing


def test_sliding_mode_acts_while_alarmed_and_lingers():
    """Limits are infinite until an alarm, then both are the law's command, for `linger` seconds after the last alarm."""
    alarms = np.zeros((12, 5), bool)
    alarms[3:5, 2] = True
    out = fed(SlidingMode(linger=0.3), [steady()] * 12, alarms)
    on = np.array([np.isfinite(d.limits[0, :, 0, 0]) for d in out])
    assert on[:, 2].tolist() == [False] * 3 + [True] * 5 + [False] * 4 and not on[:, [0, 1, 3, 4]].any()
    acting = out[4].limits[0, 2, 0]
    assert acting[0] == acting[1] == pytest.approx(0.0, abs=1e-12)  # at the desired gap nothing is wanted
    always = fed(SlidingMode(when="always"), [steady(gap=60.0)])[0].limits[0, :, 0]
    e = -5.0
    want = 1.008 / 3.0 * 8.0 * np.clip(0.5 * e / 4.0, -1.0, 1.0)
    np.testing.assert_allclose(always[1:], want)
    assert np.isneginf(always[0, 0]) and np.isposinf(always[0, 1])  # the leader follows nobody


def test_without_an_alarm_sliding_mode_changes_nothing(same_bits):
    """A detector that never alarms leaves every bit of the plain filter's episode."""
    plain, guard = (play(guarded(m), seeds=range(3), changes={"horizon": 60}) for m in (make("mitigation", "accept_all"), SlidingMode()))
    assert all(same_bits(plain.signals[name], guard.signals[name]) for name in plain.signals)


def test_acc_fallback_asks_for_no_messages_while_alarmed():
    """Mode.ACC while alarmed and for `linger` seconds after, nothing else: all readings are used, none is limited."""
    alarms = np.zeros((10, 5), bool)
    alarms[2:4, 1] = True
    out = fed(AccFallback(linger=0.2), [steady()] * 10, alarms)
    modes = np.array([d.mode[0] for d in out])
    assert modes[:, 1].tolist() == [0, 0] + [Mode.ACC] * 4 + [0] * 4 and not modes[:, [0, 2, 3, 4]].any()
    assert all(d.accept.all() and d.limits is None for d in out)


@pytest.mark.long
def test_acc_fallback_ignores_the_lie_once_alarmed():
    """With an alarm in every step the falsified messages do nothing; with none they collide."""

    class Shouting(Score):
        def step(self, plan, state, innovation):
            state, verdict = super().step(plan, state, innovation)
            return state, verdict._replace(alarm=np.ones_like(verdict.alarm))

    assert play(guarded(AccFallback()), LIE).collided.any(axis=0).all()
    quiet, lied = (play(guarded(AccFallback(), Shouting()), attack) for attack in ("none", LIE))
    assert not lied.collided.any()
    np.testing.assert_array_equal(quiet.gap, lied.gap)


@pytest.mark.parametrize("mitigation", [AccFallback, InputClip, SlidingMode])
def test_gate_leaves_out_what_is_suspected(mitigation):
    """With `gate` suspected readings are not used, without it all that arrived are."""
    alarms = np.zeros((2, 5), bool)
    alarms[1, 3] = True
    for gate in (False, True):
        out = fed(mitigation(gate=gate), [steady()] * 2, alarms)
        assert out[0].accept.all()
        assert out[1].accept[0, 3].all() == (not gate) and out[1].accept[0, [0, 1, 2, 4]].all()


@pytest.mark.parametrize("mitigation", [InputClip(), InputClip(sides="both"), SlidingMode(when="always")])
def test_missing_readings(mitigation):
    """No limit before the own sensors have all been heard once; then the last reading stands for a missing one."""
    lost = np.ones((3, 5, 3), bool)
    lost[0, 1, 0] = lost[2, 2] = False
    changed = steady()
    changed[2] = [1.0, 40.0, -3.0]
    out = fed(mitigation, [steady(), steady(), changed], valid=lost)
    assert np.isinf(out[0].limits[0, 1]).all() and not np.isinf(out[0].limits[0, 2, 0, 1])
    assert np.isfinite(out[1].limits[0, 1, 0, 1])
    np.testing.assert_allclose(out[2].limits[0, 2], out[1].limits[0, 2], atol=1e-12)


def test_limits_reach_the_estimate_and_the_mode_lives_on():
    """Composed.step hands limits and mode on; a mitigation without limits gives none."""
    defence = guarded(InputClip(mode="widen"), make("detector", "chi2", eta=1e-9))
    loop = load_scenario("platoon-v2v-v0").loop(defence)
    state = loop.start(keys("train", range(2)))
    received = state.received._replace(v2v=None)
    _, estimate = defence.step(loop.plan.defence, state.defence, received, state.known_u, None)
    assert estimate.limits.shape == (2, 5, 1, 2) and (estimate.limits[..., 0] <= estimate.limits[..., 1]).all()
    assert (estimate.mode == Mode.WIDEN).all()
    plain = guarded(make("mitigation", "accept_all"))
    assert plain.step(plain.prepare(loop.model), state.defence._replace(mitigation=plain.prepare(loop.model).mitigation.start(
        plain.prepare(loop.model).mitigation_plan, 2)), received, state.known_u, None)[1].limits is None  # fmt: skip


@pytest.mark.thin(4)
@pytest.mark.parametrize("mitigation", [InputClip(), SlidingMode(when="always"), SlidingMode(linger=1.0), AccFallback()])
def test_rows_do_not_depend_on_their_batch(mitigation, same_rows):
    """trace_hash of each seed is the same alone and among others, with lost and falsified readings."""
    place = {"kinds": ("fdi", "dropout"), "targets": (*OWN, "predecessor_acceleration"), "onset": 5}
    detector = make("detector", "chi2", eta=9.0)
    for attack in ("fdi_gaussian:sd=5", "dropout:probability=0.4"):
        run = partial(play, guarded(mitigation, detector), attack, "platoon-v2v-v0", changes={"horizon": 30}, **place)
        same_rows(run, 7, [5, 2], [3])


@pytest.mark.parametrize("name", ["acc_fallback", "input_clip", "sliding_mode"])
def test_they_do_not_apply_without_a_string(name):
    """One car behind a leader, and a network without a road, have nothing for them: NotApplicable, so that rows are skipped."""
    for place in ("stop-and-go-v0", "thesis-ch5-v0"):
        with pytest.raises(NotApplicable, match="string of cars"):
            make("mitigation", name).prepare(load_scenario(place).brief().model)
