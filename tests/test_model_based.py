"""Attacks that know the model: what a covert or zero-dynamics attacker hides, what it moves, and where it does not apply."""

import dataclasses

import numpy as np
import pytest

import tailgate
from tailgate.agents.white_box.model_based import invariant_zeros
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind
from tailgate.core.draws import keys
from tailgate.core.scenario import load_scenario
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.play.trace import rollout

EVERYTHING = ("position", "velocity", "acceleration")


@pytest.fixture(scope="module")
def pair(play):
    """The attacked and the clean trace of an attack on the linear case study, whose controller and plant have no limits."""

    def run(attack, defence="kf", seeds=4, **threat):
        place = load_scenario("thesis-ch4-v0").with_threat(**{"targets": EVERYTHING, "actuator_bound": 200.0} | threat)
        return tuple(play(place, defence, x, range(seeds), terminate=False) for x in (attack, tailgate.make_attack("none")))

    return run


@pytest.mark.parametrize("defence", ["kf", "chi2_kf"])
def test_covert_is_not_seen_and_moves_the_car(defence, pair):
    """Readings, scores, alarms, estimates and commands are the clean run's to 1e-9, while the car ends 3 m further on, at rest there."""
    attacked, clean = pair(tailgate.make_attack("covert", displacement=3.0, rise=1.0, start_step=10), defence)
    for name in ("wires", "score", "estimate", "control"):
        np.testing.assert_allclose(getattr(attacked, name), getattr(clean, name), atol=1e-9, rtol=0)
    np.testing.assert_array_equal(attacked.alarm, clean.alarm)
    moved = (attacked.truth - clean.truth)[:, :, 0]
    np.testing.assert_array_equal(moved[:9], 0.0)
    np.testing.assert_allclose(moved[-1], [[3.0, 0.0, 0.0]] * 4, atol=1e-9)
    assert (attacked.kind[9:] == Kind.FDI).all() and not attacked.refused.any()
    np.testing.assert_allclose(attacked.applied - attacked.control, attacked.value[..., 4:], atol=1e-12)


def test_without_the_lie_the_same_push_is_seen(pair):
    """The innovations do tell the displacement when the sensors are left alone: the test above can fail."""
    attacked, clean = pair(tailgate.make_attack("actuator_fdi", value=20.0, start_step=10), "kf")
    assert np.max(np.abs(attacked.score - clean.score)) > 0.1


@pytest.mark.parametrize("threat", [{"actuator_bound": 5.0}, {"fdi_bound": 0.5}])
def test_covert_shrinks_its_plan_to_the_bounds_and_stays_covert(threat, pair):
    """With a bound in the way the whole plan is scaled: the largest value is the bound, and still nothing shows."""
    attacked, clean = pair(tailgate.make_attack("covert", displacement=-3.0, rise=1.0), "chi2_kf", **threat)
    wires = slice(4, 5) if "actuator_bound" in threat else slice(0, 2)
    assert np.max(np.abs(attacked.value[..., wires])) == pytest.approx(next(iter(threat.values())), rel=1e-9)
    np.testing.assert_allclose(attacked.estimate, clean.estimate, atol=1e-9, rtol=0)
    moved = (attacked.truth - clean.truth)[-1, :, 0, 0]
    assert (moved < -0.05).all() and (moved > -2.9).all() and not attacked.refused.any()


def test_covert_is_covert_on_the_road_until_the_lie_ends(play):
    """On a road with a clipped controller no estimate differs while it is allowed; the honest samples after `end` give it away."""
    place = load_scenario("ornstein-uhlenbeck-v0").with_threat(targets=EVERYTHING, onset=50, end=250)
    place = dataclasses.replace(place, horizon=300)
    attacked, clean = (play(place, "chi2_kf", name, range(5), terminate=False) for name in ("covert", "none"))
    np.testing.assert_allclose(attacked.estimate[:250], clean.estimate[:250], atol=1e-8, rtol=0)
    np.testing.assert_allclose((attacked.truth - clean.truth)[249, :, 0, 0], 10.0, atol=1e-6)
    assert not attacked.alarm[49:250].any() and attacked.alarm[250:256].any(axis=0).all()


@pytest.mark.parametrize(
    "threat, params, message",
    [
        ({"targets": ()}, {}, "every sensor"), ({"targets": ("position", "acceleration")}, {}, "velocity"),
        ({}, {"targets": ("position", "velocity")}, "an actuator"), ({"kinds": ("dos_jam",)}, {}, "grants fdi"),
        ({}, {"state_index": 1}, "rests where it is put"),
    ],
)  # fmt: skip
def test_covert_needs_every_sensor_and_an_actuator(threat, params, message):
    """What is not granted, or a state that does not stay, makes it not applicable; the reason says what is missing."""
    place = load_scenario("thesis-ch4-v0").with_threat(**{"targets": EVERYTHING} | threat)
    with pytest.raises(NotApplicable, match=message):
        tailgate.make_attack("covert", **params).prepare(place.brief())


def test_covert_needs_a_way_to_the_state():
    """An actuator without influence on the state is not applicable; a state that does not exist is an input error."""
    brief = load_scenario("thesis-ch4-v0").with_threat(targets=EVERYTHING).brief()
    cut = dataclasses.replace(brief, model=dataclasses.replace(brief.model, B=np.zeros((3, 1))))
    with pytest.raises(NotApplicable, match="can reach"):
        tailgate.make_attack("covert").prepare(cut)
    with pytest.raises(InputError, match=r"covert\.state_index: got 3; expected at most 2"):
        tailgate.make_attack("covert", state_index=3).prepare(brief)


@pytest.mark.parametrize("dt", [0.1, 0.01])
def test_sampling_zeros_of_a_car(dt):
    """From the command to the position: zeros near those of a sampled triple integrator, -0.268 and -3.732; to the speed: near -1."""
    model = load_scenario("stop-and-go-v0" if dt == 0.1 else "stop-and-go-fine-v0").brief().model
    position, speed, both = (invariant_zeros(model.A, model.B, model.C[0][rows]) for rows in ([0], [1], [0, 1]))
    np.testing.assert_allclose([zero.z for zero in position], [-0.268, -3.732], atol=dt)
    assert len(speed) == 1 and abs(speed[0].z + 1.0) < dt and abs(speed[0].z) < 1.0
    assert both == []


def test_invariant_zeros_are_those_of_the_transfer_function():
    """x1+ = x2, x2+ = -x1/4 + u seen through y = x2 - z0 x1 has the zero z0; more outputs keep only a common zero."""
    A, B = np.array([[0.0, 1.0], [-0.25, 0.0]]), np.array([[0.0], [1.0]])
    for z0 in (0.5, -1.7, 3.0):
        (zero,) = invariant_zeros(A, B, np.array([[-z0, 1.0]]))
        assert zero.z == pytest.approx(z0, abs=1e-9)
        np.testing.assert_allclose(A @ zero.x + B @ zero.g - zero.z * zero.x, 0.0, atol=1e-9)
        assert len(invariant_zeros(A, B, np.array([[-z0, 1.0], [-2.0 * z0, 2.0]]))) == 1
        assert invariant_zeros(A, B, np.array([[-z0, 1.0], [1.0, 0.0]])) == []


def test_zero_dynamics_moves_the_state_and_not_the_trusted_position(pair):
    """Speed and acceleration are moved by far more than the trusted position shows; nobody alarms; it ends before the bound."""
    attack = tailgate.make_attack("zero_dynamics", start_step=20)
    attacked, clean = pair(attack, "chi2_kf", targets=("velocity", "acceleration"))
    during = attacked.kind[:, 0] == Kind.FDI
    last = int(np.flatnonzero(during)[-1])
    assert 5 < during.sum() < 20 and during[19 : last + 1].all()
    seen = np.abs(attacked.wires - clean.wires)[: last + 2, ..., 0]
    moved = np.abs(attacked.truth - clean.truth)[last + 1, :, 0]
    assert seen.max() < 1e-6 and moved[:, 1].min() > 1e-3 and moved[:, 2].min() > 0.3
    np.testing.assert_allclose(attacked.wires[: last + 1, ..., 1], clean.wires[: last + 1, ..., 1], atol=1e-6)  # the lie
    np.testing.assert_array_equal(attacked.alarm[: last + 1], clean.alarm[: last + 1])
    peak = np.max(np.abs(attacked.value))
    assert 200.0 / 4.0 < peak <= 200.0 and not attacked.refused.any()


def test_zero_dynamics_follows_complex_zeros(short):
    """A growing complex pair: the input turns as it grows, and the trusted output of the bare model stays silent."""
    brief = short(targets=("velocity", "acceleration")).brief()
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    B, C = np.array([[0.0], [0.0], [1.0]]), np.array([[[1.25, -1.0, 1.0], [0.0, 1.0, 0.0]]])  # zeros 0.5 +- i
    brief = dataclasses.replace(brief, model=dataclasses.replace(brief.model, A=A, B=B, C=C))
    plan = tailgate.make_attack("zero_dynamics", first=1e-2).prepare(brief)
    inputs, x, seen = plan.extra.value[:, 0, 4], np.zeros(3), []
    for a in inputs:
        seen.append(C[0, 0] @ x)
        x = A @ x + B[:, 0] * a
    assert np.max(np.abs(inputs)) > 1.0 and (inputs > 0).any() and (inputs < 0).any()
    assert np.max(np.abs(seen)) < 0.02 * np.max(np.abs(inputs))


@pytest.mark.parametrize(
    "targets, message",
    [
        (("position", "acceleration"), "invariant zero that grows; the zeros are: -0.967"), (("acceleration",), "the zeros are: none"),
        (EVERYTHING, "with none: covert"), (("position", "velocity"), "grants an actuator"),
    ],
)  # fmt: skip
def test_zero_dynamics_says_why_it_does_not_apply(targets, message):
    """A trusted speed leaves no growing zero, both sensors leave none, no trusted sensor is a case for covert."""
    with pytest.raises(NotApplicable, match=message):
        tailgate.make_attack("zero_dynamics").prepare(load_scenario("stop-and-go-v0").with_threat(targets=targets).brief())


def test_zero_dynamics_needs_room_to_grow():
    """A first input at the bound leaves no step."""
    place = load_scenario("stop-and-go-v0").with_threat(targets=("velocity", "acceleration"))
    with pytest.raises(NotApplicable, match=r"zero_dynamics\.first"):
        tailgate.make_attack("zero_dynamics", first=1.9).prepare(place.brief())


@pytest.mark.parametrize("name, targets", [("covert", EVERYTHING), ("zero_dynamics", ("velocity", "acceleration"))])
def test_rows_do_not_depend_on_their_batch(name, targets, short, loop_of, same_rows):
    """Alone, among 3 or among 16; and before the onset the episode is the clean one."""
    loop = loop_of(short(targets=targets, onset=25), "chi2_kf")
    attack = tailgate.make_attack(name)
    whole = same_rows(lambda seeds: rollout(loop, attack, keys("train", seeds), terminate=False), 16, [7], [9, 0, 15])
    clean = rollout(loop, tailgate.make_attack("none"), keys("train", range(16)), terminate=False)
    for signal in clean.signals:
        np.testing.assert_array_equal(whole.signals[signal][:24], clean.signals[signal][:24], err_msg=signal)
    assert (whole.kind[24:34] == Kind.FDI).all()


def test_a_cell_that_does_not_apply_is_skipped_with_its_reason():
    """Rows say that they were skipped, and what would have to be granted."""
    (row,) = run_cell(Cell("custom", "stop-and-go-v0", None, "kf", "covert", seeds=1))
    assert row["status"] == "skipped" and "an actuator" in row["reason"]
