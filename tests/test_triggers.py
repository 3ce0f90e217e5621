"""When an attack is on: each trigger fires exactly where its words say, and random ones keep their rates."""

import math

import numpy as np
import pytest

import tailgate
from tailgate.agents.scripts.triggers import (
    TRIGGERS,
    Bursts,
    Chance,
    Closing,
    Fast,
    LeaderBraking,
    Near,
    Reading,
    Slow,
    Steps,
    Timing,
    Trigger,
    idle,
    part,
    rearm,
)
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Received, Scene, View
from tailgate.core.draws import Role, keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout

ONE = Timing(1, 0.1)


def view(k, **road):
    """What one sees of the road at step k; each quantity (B, N)."""
    shape = next(iter(road.values())).shape if road else (1, 1)
    scene = Scene(**{name: road.get(name, np.zeros(shape)) for name in Scene._fields})
    return View(np.full(shape[0], k), *[None] * 7, last=None)._replace(scene=scene)


def run(trigger, steps, timing=ONE, batch=1, rows=slice(None), road=None):
    """-> on and count (K, B) of a trigger that is armed before step 1."""
    held = keys("train", range(batch))
    held = type(held)(*(leaf[rows] for leaf in held))
    batch = len(held.key)
    state, out = idle(batch, 1), []
    for k in range(1, steps + 1):
        now = view(k, **({"gap": np.zeros((batch, 1))} if road is None else {name: x[k - 1, :, None] for name, x in road.items()}))
        state, on, count = trigger.step(timing, state, now, held.at(Role.ATTACK, np.full(batch, k)))
        assert all(len(leaf) == batch for leaf in state) and on.dtype == bool
        out.append((on, count))
    return tuple(np.array(x) for x in zip(*out, strict=True))


def on_steps(*arguments, **options):
    return (np.flatnonzero(run(*arguments, **options)[0][:, 0]) + 1).tolist()


def test_time_opens_once_and_for_its_window():
    """From `start`, from the onset, or `after` steps from arming, whichever is last; for `window` steps; counted from 0."""
    assert on_steps(Trigger(), 5) == [1, 2, 3, 4, 5]
    assert on_steps(Trigger(start=3, window=2), 9) == [3, 4]
    assert on_steps(Trigger(start=3, window=2), 9, Timing(5, 0.1)) == [5, 6]
    assert on_steps(Trigger(after=6, window=2), 9) == [7, 8]
    assert run(Trigger(start=3), 6)[1][:, 0].tolist() == [0, 0, 0, 1, 2, 3]


def test_steps_and_intervals():
    """On at the listed steps and pairs, and over after the last."""
    trigger = Steps(at=(5, (8, 10), 2))
    assert on_steps(trigger, 20) == [2, 5, 8, 9, 10]
    state = idle(3, 1)
    np.testing.assert_array_equal(trigger.over(state, np.array([9, 10, 11])), [False, True, True])


SERIES = np.array([50.0, 39.0, 41.0, 38.0, 45.0, 30.0])


@pytest.mark.parametrize(
    "cls, threshold, road",
    [
        (Near, 40.0, {"gap": SERIES}), (Slow, 40.0, {"speed": SERIES}), (Fast, 40.0, {"speed": 80.0 - SERIES}),
        (Closing, 40.0, {"speed": 90.0 - SERIES, "lead_speed": np.full(6, 10.0)}),
        (LeaderBraking, 4.0, {"lead_speed": np.array([20.0, 19.5, 19.2, 18.7, 18.5, 18.0])}),
    ],
)  # fmt: skip
def test_conditions_hold_or_latch(cls, threshold, road):
    """Each condition is met at steps 2, 4 and 6 here: on at these, or from the first of them on, or for a window from it."""
    road = {name: x[:, None] for name, x in road.items()}
    assert on_steps(cls(threshold=threshold, latch=False), 6, road=road) == [2, 4, 6]
    assert on_steps(cls(threshold=threshold), 6, road=road) == [2, 3, 4, 5, 6]
    assert on_steps(cls(threshold=threshold, window=3), 6, road=road) == [2, 3, 4]
    assert on_steps(cls(threshold=threshold, latch=False, window=3), 6, road=road) == [2, 4]
    assert on_steps(cls(threshold=threshold, start=3), 6, road=road) == [4, 5, 6]
    assert on_steps(cls(threshold=threshold), 6, Timing(5, 0.1), road=road) == [6]


def test_a_vehicle_of_several_is_enough():
    """With two followers the condition of either opens the window."""
    for gaps, fired in (([50.0, 50.0], False), ([50.0, 30.0], True)):
        _, on, _ = Near(threshold=40.0).step(ONE, idle(1, 2), view(1, gap=np.array([gaps])), None)
        assert on[0] == fired


def test_leader_braking_needs_two_looks():
    """At the first look there is no deceleration to see, whatever the speed; dt scales it."""
    road = {"lead_speed": np.array([[0.0], [-0.05]])}
    assert on_steps(LeaderBraking(threshold=1.0), 2, road=road) == []
    assert on_steps(LeaderBraking(threshold=1.0), 2, Timing(1, 0.01), road=road) == [2]


@pytest.mark.thin(3)
@pytest.mark.parametrize("dt", [0.1, 0.01])
@pytest.mark.parametrize("wanted", [{"frequency": 0.4}, {"share": 0.2}, {"share": 0.75}])
def test_random_bursts_keep_their_frequency_share_and_length(wanted, dt):
    """Over many episodes: bursts begun a second, share of time and mean length of those not cut off, each within 4 %."""
    batch, steps, mean = 600, round(60.0 / dt) if dt > 0.05 else 2000, 0.5 if dt > 0.05 else 0.1
    trigger = Bursts(duration=mean, **{name: x * (5.0 if name == "frequency" and dt < 0.05 else 1.0) for name, x in wanted.items()})
    on, _ = run(trigger, steps, Timing(1, dt), batch)
    share = trigger.share or trigger.frequency * mean
    assert abs(on.mean() / share - 1) < 0.04
    assert abs(on[:5].mean() - share) < 5 * math.sqrt(share * (1 - share) / batch)  # from the beginning
    begun = on[1:] & ~on[:-1]
    assert abs(begun.sum() / (batch * (steps - 1) * dt) / (share / mean) - 1) < 0.04
    lengths = []
    for row in on.T:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
        lengths += [b - a for a, b in zip(edges[::2], edges[1::2], strict=True) if a > 0 and b < steps]
    assert abs(np.mean(lengths) * dt / mean - 1) < 0.04
    assert abs(np.mean(np.array(lengths) == 1) - dt / mean) < 0.03  # geometric


def test_bursts_of_a_step_and_pauses_of_a_step_alternate():
    """The densest chain: every mean is one step, so bursts and pauses alternate."""
    on, _ = run(Bursts(duration=0.1, frequency=5.0), 40, batch=8)
    assert (on[1:] != on[:-1]).all()


@pytest.mark.parametrize(
    "params, field",
    [
        ({"duration": 0.5}, "frequency"), ({"duration": 0.5, "frequency": 1.0, "share": 0.5}, "frequency"),
        ({"duration": 0.5, "frequency": 2.0}, "frequency"), ({"duration": -1.0, "share": 0.5}, "duration"),
        ({"duration": 0.5, "share": 1.0}, "share"),
    ],
)  # fmt: skip
def test_impossible_bursts_are_refused(params, field):
    """Neither or both of frequency and share, or bursts longer than their period, name the field."""
    with pytest.raises(InputError, match=rf"here\.{field}"):
        part(TRIGGERS, {"name": "bursts", **params}, "here")


@pytest.mark.parametrize("params, field", [({"duration": 0.05, "share": 0.5}, "duration"), ({"duration": 0.5, "share": 0.9}, "share")])
def test_bursts_shorter_than_a_step_are_refused(params, field):
    """What a step of 0.1 s cannot show is refused when the step is known."""
    with pytest.raises(InputError, match=rf"bursts\.{field}.*0\.1 s"):
        Bursts(**params).prepare(load_scenario("stop-and-go-v0").brief())


def test_chance():
    """Fires with its probability a step; latched, it is a geometric onset."""
    on, _ = run(Chance(probability=0.3), 200, batch=200)
    assert abs(on.mean() - 0.3) < 5 * math.sqrt(0.21 / on.size)
    latched, _ = run(Chance(probability=0.3, latch=True), 60, batch=2000)
    assert (latched[1:] >= latched[:-1]).all() and latched[-1].all()
    first = latched.argmax(axis=0) + 1
    assert abs(first.mean() - 1 / 0.3) < 5 * math.sqrt(0.7 / 0.09 / 2000)


@pytest.mark.parametrize("trigger", [Chance(probability=0.4), Bursts(duration=0.5, share=0.4)])
def test_random_triggers_do_not_depend_on_the_batch(trigger):
    """A row fires at the same steps whatever its companions."""
    whole, _ = run(trigger, 80, batch=9)
    np.testing.assert_array_equal(run(trigger, 80, batch=9, rows=[5, 2])[0], whole[:, [5, 2]])
    assert len({row.tobytes() for row in whole.T}) == 9


def test_rearming_forgets_the_window_and_keeps_the_road():
    """A rearmed row begins anew; others keep everything; the last look at the leader stays."""
    state = idle(2, 1)
    for k in (1, 2):
        state, _, _ = Trigger().step(ONE, state, view(k, lead_speed=np.full((2, 1), 7.0)), None)
    again = rearm(state, np.array([True, False]))
    assert again.opened.tolist() == [False, True] and again.elapsed.tolist() == [0, 2] and again.armed.tolist() == [0, 2]
    np.testing.assert_array_equal(again.lead_speed, 7.0)


@pytest.mark.parametrize("data, message", [
    (3, r"here: got 3; expected a name, or a mapping with a name \(time,"), ({"threshold": 1.0}, "with a name"),
    ("nearr", r"here\.name: got 'nearr'.*did you mean 'near'"), ({"name": "near", "treshold": 3}, "unknown field.*did you mean 'threshold'"),
    ({"name": "near", "threshold": -1}, r"here\.threshold: got -1"), ({"name": "steps", "at": []}, r"here\.at"),
    ({"name": "steps", "at": [[9, 3]]}, r"here\.at: got \(9, 3\); expected a pair"), ({"name": ["near"]}, r"here\.name"),
])  # fmt: skip
def test_wrong_triggers_are_input_errors(data, message):
    """A wrong name, field or value names its place and lists what exists."""
    with pytest.raises(InputError, match=message):
        part(TRIGGERS, data, "here")


@pytest.mark.parametrize("trigger, threshold", [("speed", 27.5), ("slow", 15.0), ("leader_braking", 3.0)])
def test_flat_scripts_know_the_new_triggers(trigger, threshold, short, play):
    """speed, slow: the own speed; leader_braking: its deceleration: the window opens at the first step at which it is so, and stays."""
    place = short("braking-v0", horizon=450, onset=1)
    trace = play(place, "kf", tailgate.make_attack("dropout", trigger=trigger, threshold=threshold, length=30), range(4), terminate=False)
    for row in range(4):
        speed, lead = (
            np.concatenate([trace.first[name][row], getattr(trace, name)[:-1, row, 0]]) for name in ("speed", "lead_speed")
        )  # before the step
        decel = np.concatenate([[-np.inf], (lead[:-1] - lead[1:]) / 0.1])
        hit = {"speed": speed > threshold, "slow": speed < threshold, "leader_braking": decel > threshold}[trigger]
        first = int(np.argmax(hit)) + 1
        assert hit.any() and first > 1
        assert (np.flatnonzero(trace.kind[:, row]) + 1).tolist() == list(range(first, first + 30))


def read(trigger, values, reach):
    """On (K,) where `values` (K, N, q) are read, step by step, of which `reach` (N, q) may be attacked."""
    state, out = idle(1, values.shape[1]), []
    for k, y in enumerate(values, start=1):
        now = view(k, gap=np.zeros((1, values.shape[1])))._replace(received=Received(y[None], np.ones((1, *y.shape), bool), None))
        state, on, _ = trigger.step(ONE._replace(reach=reach), state, now, None)
        out.append(bool(on[0]))
    return out


def test_a_large_reading_of_a_wire_that_may_be_attacked():
    """Of either sign, and on no other wire; at the latest step in any case; what was lost is not large."""
    values, reach = np.zeros((6, 2, 2)), np.array([[True, False], [False, False]])
    values[1, 0, 1] = values[1, 1, 0] = 90.0
    values[2, 0, 0], values[3, 0, 0], values[4, 0, 0] = np.nan, -31.0, 3.0
    assert read(Reading(threshold=30.0, latch=False), values, reach) == [False, False, False, True, False, False]
    assert read(Reading(threshold=30.0), values, reach) == [False] * 3 + [True] * 3
    assert read(Reading(threshold=30.0, window=2), values, reach) == [False] * 3 + [True] * 2 + [False]
    assert read(Reading(threshold=40.0, latest=5), values, reach) == [False] * 4 + [True] * 2


@pytest.mark.long
def test_readings_are_waited_for_only_where_they_are_seen():
    """A script asks for the sight of readings, as a policy does; a threat model without it is refused, not played blindly."""
    place = load_scenario("network-restless-v0").with_threat(kinds=["dos_hold"], agents=[1, 7], budget=5)
    script = Spec("attack", "dos_hold:trigger=reading,threshold=36,latest=192").make()
    loop = place.loop(tailgate.make_defence("dkf"))
    assert script.sees_measurement and not Spec("attack", "dos_hold:start_step=21").make().sees_measurement
    with pytest.raises(NotApplicable, match="sees_measurement"):
        rollout(loop, script, keys("tune", range(2)))
    rows = tailgate.evaluate(
        scenarios=[place.name], defences=["dkf"], attacks=["dos_hold:start_step=21", "dos_hold:trigger=reading,threshold=36,latest=192"],
        seeds=40, purpose="tune", threat={"kinds": ["dos_hold"], "agents": [1, 7], "budget": 5},
    )  # fmt: skip
    early, late = (np.mean([row["max_error"] for row in rows if row["attack"] == name]) for name in dict.fromkeys(row["attack"] for row in rows))
    assert all(row["status"] == "ok" and row["attack_steps"] == 5 for row in rows) and late > 1.2 * early


def test_a_script_that_waits_for_a_reading_plays_in_the_traced_loop_as_in_the_plain_one():
    loop = load_scenario("gusty-stop-and-go-v0").with_threat(sees_measurement=True).loop(tailgate.make_defence("kf"))
    script = Spec("attack", "fdi:trigger=reading,threshold=300,value=-5").make()
    one, two = (rollout(loop, script, keys("tune", range(40)), plain=plain) for plain in (False, True))
    assert [one.trace_hash(i) for i in range(40)] == [two.trace_hash(i) for i in range(40)]
    first = (one.kind != 0).argmax(axis=0)
    assert len(set(first.tolist())) > 1 and first.min() > loop.brief.threat.onset
    assert (one.wires[first - 1, range(40), 0, 0] <= 300.0).all() and (one.clean[first, range(40), 0, 0] > 300.0).all()
