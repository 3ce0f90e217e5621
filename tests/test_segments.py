"""The attack `segments`: lies one after the other."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from tailgate.agents.scripts.segments import Segments
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario, load_suite
from tailgate.ensemble.members import BUDGETS, Hunt, harvest
from tailgate.ensemble.search import Arena
from tailgate.play.trace import Trace, rollout

ROAD = "gusty-stop-and-go-v0"


def played(place: str, attack: object, defence: str = "kf", episodes: int = 3, **threat: object) -> Trace:
    spec = Spec("defence", defence)
    loop = load_scenario(place).with_threat(**threat).loop(spec.make(), spec.entry.uses)
    return rollout(loop, attack, draws.keys("report", range(episodes)))  # type: ignore[arg-type]


def test_each_segment_rests_then_lies_with_its_own_values() -> None:
    attack = Segments(
        start_step=60, rests=(2, 3, 0), steps=(3, 2, 2), pauses=(0, 4, 1),
        values={"position": (1.0, -2.0, 4.0), "velocity": (0.5, 0.0, -0.25)}, rates={"position": (0.5, 0.0, -1.0)},
    )  # fmt: skip
    trace = played(ROAD, attack)
    wanted = {
        62: (1.0, 0.5), 63: (1.5, 0.5), 64: (2.0, 0.5),  # after two honest steps
        68: (-2.0, 0.0), 73: (-2.0, 0.0),  # every fifth step
        74: (4.0, -0.25), 76: (2.0, -0.25),  # the pause counts in the growth
    }  # fmt: skip
    hit = trace.target[:, 0, 0].any(axis=1)
    assert {int(step) + 1 for step in np.flatnonzero(hit)} == set(wanted)
    for step, values in wanted.items():
        assert trace.value[step - 1, :, 0, :2].tolist() == [list(values)] * 3


def test_a_single_segment_needs_no_rests_and_keeps_the_windows_bursts() -> None:
    trace = played(ROAD, Segments(start_step=60, length=7, burst=2, pause=1, steps=(9,), values={"position": (2.0,)}))
    assert [int(step) + 1 for step in np.flatnonzero(trace.target[:, 0, 0, 0])] == [60, 61, 63, 64, 66]


def test_values_are_cut_at_the_bound_and_sizes_count_over_the_air() -> None:
    far = played(ROAD, Segments(values={"position": (9.0, -9.0)}), fdi_bound=3.0)
    assert np.unique(far.value[..., 0]).tolist() == [-3.0, 0.0, 3.0]
    echo = played("radar-braking-v0", Segments(kind="echo_delay", values={"distance": (-7.0, 5.0)}, start_step=20), delay_bound=60.0)
    assert set(np.unique(echo.value[..., 0][echo.target[..., 0]]).tolist()) <= {7.0, 5.0} and echo.target.any()


@pytest.mark.parametrize(
    ("place", "defence", "text"),
    [
        (ROAD, "chi2_kf", "values.position=[-1,3],rates.position=[0.1,-0.2],trigger=near,threshold=60,rests=[0,20],pauses=[0,2]"),
        (ROAD, "reacquire_kf", "kind=dos_jam,values.velocity=[20,3,9],steps=[5,2,1],rests=[1,2,3],pauses=[0,1,0],start_step=60"),
        ("radar-braking-v0", "kf", "kind=echo_delay,values.distance=[4,6],start_step=20"),
        ("platoon-gusty-v0", "chi2_dkf", "values.distance=[-1,2],values.velocity=[0.4,0],start_step=20"),
    ],
)
def test_the_engine_plays_the_same(place: str, defence: str, text: str) -> None:
    attack = Spec("attack", f"segments:{text}").make()
    fast = played(place, attack, defence)

    class Plain(Segments):
        untraced = "the test wants the plain loop"

    slow = played(place, Plain(**{f.name: getattr(attack, f.name) for f in dataclasses.fields(attack)}), defence)
    assert fast.target.any() and [fast.trace_hash(i) for i in range(3)] == [slow.trace_hash(i) for i in range(3)]


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("segments:values.gap=[1,2]", InputError, r"values: got 'gap'; expected wires \(position, velocity"),
        ("segments:values.position=[1]", InputError, r"values.position: got \[1.0\]; expected as many numbers as steps has \(2\)"),
        ("segments:values.position=[1,2],rests=[1,2,3]", InputError, r"rests: got .*; expected as many numbers as steps has"),
        ("segments:values.position=[1,2],steps=[0,2]", InputError, "steps"),
        ("segments:steps=[]", InputError, "steps: got .*; expected at least one segment"),
        ("segments", NotApplicable, r"values: got None; expected numbers for a wire, such as values.position=\[-3,-3\]"),
        ("segments:targets=[position],values.velocity=[1,2]", InputError, "values: got 'velocity'; expected a wire that is attacked"),
        ("segments:kind=dropout,values.position=[1,2]", InputError, "kind: got 'dropout'"),
    ],
)
def test_wrong_words_are_named(text: str, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        Spec("attack", text).make().prepare(load_scenario(ROAD).brief())


def test_a_kind_that_is_not_granted_has_no_meaning() -> None:
    with pytest.raises(NotApplicable, match="a threat model that grants dos_jam"):
        Spec("attack", "segments:kind=dos_jam,values.position=[1,2]").make().prepare(load_scenario(ROAD).with_threat(kinds=["fdi"]).brief())


def test_the_search_leaves_a_single_step_to_feedback(tmp_path: Path) -> None:
    suite = load_suite("quick-v1")
    place = Arena(suite.name, ROAD, 1, "kf", dict(suite.granted), suite.bound, suite.progress)
    (held,) = harvest(Hunt(place, BUDGETS["quick"], 0, tmp_path, only=("segments",)))
    assert held.found == [] and held.why == "dose: got 1; expected 2 attacked steps or more: feedback searches single ones"
