"""The attack `feedback`: values that follow the road."""

import dataclasses

import numpy as np
import pytest

from tailgate.agents.scripts.feedback import Feedback
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import Trace, rollout

WEIGHTS = {"position": (-1.0, 0.3, 0.5, -0.4, 0.2), "velocity": (0.4, -0.1, 0.2, 0.6, -0.7)}


def played(place: str, attack: object, defence: str = "kf", episodes: int = 3, **threat: object) -> Trace:
    spec = Spec("defence", defence)
    loop = load_scenario(place).with_threat(**threat).loop(spec.make(), spec.entry.uses)
    return rollout(loop, attack, draws.keys("report", range(episodes)))  # type: ignore[arg-type]


def test_values_are_those_of_the_formula() -> None:
    attack = Feedback(weights=WEIGHTS, start_step=60, length=30)
    trace = played("gusty-stop-and-go-v0", attack)
    hit = trace.target[:, :, 0]  # (T, B, w)
    assert set(np.flatnonzero(hit.any(axis=(1, 2))).tolist()) == set(range(59, 89))
    gap, speed, ahead = (trace.signals[name][:, :, 0] for name in ("gap", "speed", "lead_speed"))
    for step in (59, 60, 75, 88):
        since = (step - 59) * trace.dt
        for row in range(3):
            seen = np.array([1.0, since, gap[step - 1, row] / 20.0, (speed[step - 1, row] - ahead[step - 1, row]) / 5.0, speed[step - 1, row] / 20.0])
            wanted = [0.1 * np.sinh(np.clip(np.array(w) @ seen, -8.0, 8.0)) for w in WEIGHTS.values()]
            assert np.allclose(trace.value[step, row, 0, :2], wanted, rtol=1e-12)


def test_values_are_cut_at_the_bound() -> None:
    far = played("gusty-stop-and-go-v0", Feedback(weights={"position": (8.0, 0.0, 0.0, 0.0, 0.0)}), fdi_bound=3.0)
    assert np.unique(far.value[..., 0]).tolist() == [0.0, 3.0] or np.unique(far.value[..., 0]).tolist() == [3.0]
    with pytest.raises(NotApplicable, match=r"weights: got None; expected five weights for a wire, such as weights.position="):
        played("gusty-stop-and-go-v0", Feedback())


def test_the_later_kind_comes_after_steps_of_the_window() -> None:
    trace = played("gusty-stop-and-go-v0", Feedback(kind="dropout", later="dos_jam", switch=4, start_step=60, length=9, weights=WEIGHTS))
    kinds = trace.kind[59:68, 0].tolist()
    assert kinds == [Kind.DROPOUT] * 4 + [Kind.DOS_JAM] * 5
    assert (trace.value[59:63] == 0.0).all() and (trace.value[63:68, 0, 0, 0] != 0.0).all()


def test_over_the_air_a_magnitude_counts() -> None:
    weights = {"distance": (-4.0, 0.0, 0.0, 0.0, 0.0)}
    trace = played("radar-braking-v0", Feedback(kind="echo_delay", weights=weights, start_step=20), delay_bound=60.0)
    there = trace.target[..., 0]
    assert there.any() and np.allclose(trace.value[..., 0][there], 0.1 * np.sinh(4.0))


@pytest.mark.parametrize(
    ("place", "defence", "text"),
    [
        ("gusty-stop-and-go-v0", "chi2_kf", "weights.position=[-1,0.3,0.5,-0.4,0.2],trigger=near,threshold=60,burst=2,pause=3"),
        ("gusty-stop-and-go-v0", "chi2_kf", "kind=dropout,later=dos_jam,switch=4,weights.velocity=[1,0.1,0.2,0.6,-0.7],start_step=60"),
        ("radar-braking-v0", "kf", "kind=noise_jam,later=echo_delay,switch=3,weights.distance=[-4,0.2,0.4,0.1,-0.4],start_step=20"),
        ("platoon-gusty-v0", "chi2_dkf", "weights.distance=[-1,0.3,0.5,-0.4,0.2],weights.velocity=[0.4,0,0,0.6,0],start_step=20"),
    ],
)
def test_the_engine_plays_the_same(place: str, defence: str, text: str) -> None:
    """As the plain loop does, with each agent's own road."""
    attack = Spec("attack", f"feedback:{text}").make()
    fast = played(place, attack, defence)

    class Plain(Feedback):
        untraced = "the test wants the plain loop"

    slow = played(place, Plain(**{f.name: getattr(attack, f.name) for f in dataclasses.fields(attack)}), defence)
    assert fast.target.any() and [fast.trace_hash(i) for i in range(3)] == [slow.trace_hash(i) for i in range(3)]


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("feedback:weights.gap=[1,0,0,0,0]", InputError, r"weights: got 'gap'; expected wires \(position, velocity"),
        ("feedback:weights.position=[1,0,0,0]", InputError, "weights.position: got .* at least 5 items"),
        ("feedback:kind=insider", InputError, "kind: got 'insider'"),
        ("feedback:kind=noise_jam,weights.position=[1,0,0,0,0]", NotApplicable, "sensors without an echo"),
        ("feedback:later=delay,switch=2", InputError, "later: got 'delay'"),
        ("feedback:later=dos_jam", InputError, "later, switch: got .*; expected both, or neither"),
        ("feedback:switch=3", InputError, "later, switch: got .*; expected both, or neither"),
        ("feedback:targets=[position],weights.velocity=[1,0,0,0,0]", InputError, "weights: got 'velocity'; expected a wire that is attacked"),
    ],
)
def test_wrong_words_are_named(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Spec("attack", text).make().prepare(load_scenario("gusty-stop-and-go-v0").brief())


def test_a_kind_that_is_not_granted_has_no_meaning() -> None:
    with pytest.raises(NotApplicable, match="a threat model that grants dos_jam"):
        Spec("attack", "feedback:later=dos_jam,switch=2,weights.position=[1,0,0,0,0]").make().prepare(load_scenario("gusty-stop-and-go-v0").with_threat(kinds=["fdi"]).brief())
