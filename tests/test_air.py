"""Attacks over the air: what the channel lets through, what reaches the receiver, and what learners see and do of it."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core import Array, Kind
from tailgate.core.draws import keys
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.observations import ObservationCodec

SILENT = (5, 6, 9)  # steps of the challenges of `Mute`
DISTANCE, SPEED, ACTUATOR = range(3)  # the wires of the radar's plant


class MuteState(NamedTuple):
    held: tuple
    k: Array


class Mute:
    """The plain filter, with a radar that is silent at listed steps."""

    uses = ("measurements", "probe")

    def __init__(self):
        self.filter = tailgate.make_defence("kf")

    def prepare(self, model):
        return self.filter.prepare(model)

    def start(self, plan, prior):
        return MuteState(self.filter.start(plan, prior), np.zeros(len(prior.mean), np.int64))

    def step(self, plan, state, received, known_u, draws):
        held, estimate = self.filter.step(plan, state.held, received, known_u, draws)
        k = state.k + 1  # of this step; the probe is that of the next one
        return MuteState(held, k), estimate._replace(probe=~np.isin(k + 1, SILENT)[:, None])


@pytest.fixture
def loop():
    """The radar's loop, every kind over the air granted from the first step on."""

    def make(defence=None, **threat):
        wide = {"kinds": ("dos_jam", "noise_jam", "echo_delay"), "onset": 1, "end": None, "budget": None, "jam_range": (0.0, 250.0)}
        place = load_scenario("radar-following-v0").with_threat(**(wide | threat))
        return place.loop(defence or Mute(), ("measurements", "probe"))

    return make


def run(loop, command, steps=12, rows=4):
    """Frames of an episode under `command(brief, k, rows)`, None for none."""
    state, out = loop.start(keys("train", range(rows))), []
    for k in range(1, steps + 1):
        sent = command(loop.brief, k, rows) if command else None
        state, frame = loop.advance(state, sent if sent is not None else loop.brief.command(np.zeros(rows, bool), 0, loop.brief.granted, 0.0))
        out.append(frame)
    return out


def radiating(kind, value, wires=(DISTANCE, SPEED), some=slice(None), when=lambda k: True):
    """A command of every step in which `when(k)` holds, in the rows `some`."""

    def command(brief, k, rows):
        on = np.zeros(rows, bool)
        on[some] = when(k)
        target = np.zeros(brief.granted.shape, bool)
        target[:, list(wires)] = True
        return brief.command(on, kind, target, value)

    return command


# -- the channel


@pytest.mark.parametrize("kind, most", [(Kind.NOISE_JAM, 0.05), (Kind.ECHO_DELAY, 7.0)])
def test_values_are_accepted_from_above_zero_to_the_bound(kind, most, loop):
    """Nothing, less than nothing, more than the bound and no number are refused, and change nothing."""
    place = loop(jam_power=0.05, delay_bound=7.0)
    for value, legal in ((most, True), (1e-9, True), (0.0, False), (-1e-3, False), (most * (1 + 1e-9), False), (np.nan, False), (np.inf, False)):
        (frame,) = run(place, radiating(kind, value), steps=1)
        assert (frame.refused == (not legal)).all() and ((frame.command.kind == kind) == legal).all()
        if not legal:
            np.testing.assert_array_equal(frame.wires, frame.clean)


def test_what_is_no_receiver_is_refused(loop):
    """An actuator that is granted is not reached over the air, alone or with a sensor; nor is a plant whose sensors have no echo."""
    place = loop(targets=("distance", "relative_speed", "acceleration"))
    for kind, value in ((Kind.NOISE_JAM, 0.01), (Kind.ECHO_DELAY, 3.0)):
        for wires in ((ACTUATOR,), (DISTANCE, ACTUATOR)):
            (frame,) = run(place, radiating(kind, value, wires), steps=1)
            assert frame.refused.all() and not frame.command.target.any() and (frame.control == frame.applied).all()
    road = load_scenario("stop-and-go-v0").with_threat(kinds=("noise_jam", "echo_delay"), onset=1, targets=("position", "leader_position"))
    deaf = road.loop(tailgate.make_defence("kf"))
    for wire in (0, 2):  # a sensor, and a field of the message
        (frame,) = run(deaf, radiating(Kind.ECHO_DELAY, 1.0, (wire,)), steps=1)
        assert frame.refused.all()


@pytest.mark.parametrize("wires", [(DISTANCE,), (SPEED,), (DISTANCE, SPEED)])
def test_one_reading_stands_for_the_whole_receiver(wires, loop, same_bits):
    """Whichever reading is aimed at, both are reached, and what arrives is the same."""
    whole = run(loop(), radiating(Kind.ECHO_DELAY, 6.0))
    part = run(loop(), radiating(Kind.ECHO_DELAY, 6.0, wires))
    for one, other in zip(whole, part, strict=True):
        assert other.command.target[..., :2].all() and (other.command.value[..., :2] == 6.0).all() and not other.command.target[..., ACTUATOR].any()
        assert same_bits(one.wires, other.wires) and same_bits(one.received.energy, other.received.energy)


def test_a_wire_that_is_not_granted_is_refused_though_a_neighbour_is(loop):
    """Only the relative speed is granted: aimed at it reaches the distance too, aimed at the distance it is refused."""
    place = loop(targets=("relative_speed",))
    assert not run(place, radiating(Kind.ECHO_DELAY, 6.0, (SPEED,)), steps=1)[0].refused.any()
    assert run(place, radiating(Kind.ECHO_DELAY, 6.0, (DISTANCE,)), steps=1)[0].refused.all()


def test_a_late_echo_adds_its_metres(loop):
    """The reading of the distance grows by the delay, that of the relative speed stays, within the noise of the sensor."""
    clean, late = run(loop(), None, rows=64), run(loop(), radiating(Kind.ECHO_DELAY, 6.0, when=lambda k: k == 3), rows=64)
    off = late[2].wires[..., :2] - clean[2].wires[..., :2]
    assert abs(off[..., 0] - 6.0).max() < 0.5 and abs(off[..., 1]).max() < 0.5 and late[2].received.valid.all()


# -- what a silent receiver hears


def _energies(loop, command, rows=32):
    return np.array([frame.received.energy[:, 0] for frame in run(loop, command, rows=rows)])


@pytest.mark.parametrize("kind, value", [(Kind.NOISE_JAM, 0.1), (Kind.ECHO_DELAY, 6.0), (Kind.DOS_JAM, 200.0)])
def test_a_silent_receiver_hears_whoever_radiates(kind, value, loop):
    """At a challenge, and only there, power is heard: noise alone has its mean; an attack of any kind over the air is far above it; readings are not valid."""
    silent = np.isin(np.arange(1, 13), SILENT)
    quiet, loud = _energies(loop(), None), _energies(loop(), radiating(kind, value))
    assert abs(quiet[silent] - 1.0).max() < 0.05 and not quiet[~silent].any() and not loud[~silent].any()
    assert loud[silent].min() > 10.0
    for frame in run(loop(), radiating(kind, value)):
        assert frame.received.valid.any() == (frame.k[0] not in SILENT)


def test_who_falls_silent_in_time_is_not_heard(loop):
    """A reaction of 0.1 us leaves nothing in the window of a challenge; one as long as the window leaves everything."""
    attack = radiating(Kind.NOISE_JAM, 0.1)
    silent = np.isin(np.arange(1, 13), SILENT)
    fast, slow, never = (_energies(loop(reaction=reaction), attack)[silent] for reaction in (1e-7, 10.0, None))
    assert abs(fast - 1.0).max() < 0.05
    np.testing.assert_array_equal(slow, never)


# -- rows and doses


@pytest.mark.parametrize("kind, value", [(Kind.NOISE_JAM, 0.1), (Kind.ECHO_DELAY, 6.0)])
def test_clean_rows_keep_every_bit(kind, value, loop, same_bits):
    """Rows beside attacked ones are those of a batch without an attack; attacked ones are those of a batch of one."""
    clean = run(loop(), None, rows=4)
    mixed = run(loop(), radiating(kind, value, some=[1, 3]), rows=4)
    alone = run(loop(), radiating(kind, value), rows=1)  # row 0 attacked
    both = run(loop(), radiating(kind, value, some=[0]), rows=4)
    for k in range(12):
        assert same_bits(mixed[k].wires[::2], clean[k].wires[::2]) and same_bits(mixed[k].received.energy[::2], clean[k].received.energy[::2])
        assert same_bits(mixed[k].estimate.x[::2], clean[k].estimate.x[::2])
        assert same_bits(both[k].wires[:1], alone[k].wires) and same_bits(both[k].received.energy[:1], alone[k].received.energy)


def test_the_budget_counts_what_is_radiated(loop):
    """A step is charged as any other, at a challenge too; what is asked beyond the budget is refused and radiates nothing."""
    frames = run(loop(budget=5), radiating(Kind.NOISE_JAM, 0.1))
    assert [bool(frame.refused[0]) for frame in frames] == [k > 5 for k in range(1, 13)]
    assert frames[5].received.energy[0, 0] < 1.05 and frames[4].received.energy[0, 0] > 10.0  # both silent


@pytest.mark.parametrize("kind, value", [(Kind.DOS_HOLD, 0.0), (Kind.DOS_HOLD_FRESH, 0.0), (Kind.DELAY, 1.0), (Kind.REPLAY, 3.0)])
def test_what_a_silent_receiver_does_not_read_is_not_remembered(kind, value):
    """Held, delayed and replayed samples are readings that there were, also when a muted step came right before: never its zero."""
    wide = {"kinds": ("dos_hold", "dos_hold_fresh", "delay", "replay"), "onset": 7, "end": None, "budget": None}
    held = load_scenario("radar-following-v0").with_threat(**wide).loop(Mute(), ("measurements", "probe"))  # 5, 6 and 9 are muted
    frames = run(held, radiating(kind, value, when=lambda k: k >= 7))
    for row in range(4):
        read = {float(frame.clean[row, 0, 0]) for frame in frames} - {0.0} | {float(held.model.C[0, 0] @ held.start(keys("train", range(4))).estimate.x[row, 0])}
        got = [float(frame.wires[row, 0, 0]) for frame in frames[6:]]
        assert min(got) > 1.0 and set(got) <= read and len(set(got)) < 6


# -- what an attacker sees


def test_the_probe_is_heard_by_a_black_box(loop):
    """Whether the radar was silent in the step before; a plant without an echo has no such thing to hear."""
    place = loop()
    state = place.start(keys("train", range(3)))
    quiet = place.brief.command(np.zeros(3, bool), 0, place.brief.granted, 0.0)
    for k in range(1, 13):
        view = place.sense(state)
        assert view.defence is None and (view.probed == (k - 1 not in SILENT)).all()
        seen = dict(zip(ObservationCodec(place.brief).names, ObservationCodec(place.brief).observe(view).T, strict=True))
        assert (seen["probed"] == view.probed[:, 0]).all()
        state, _ = place.advance(state, quiet)
    road = load_scenario("stop-and-go-v0").loop(tailgate.make_defence("kf"))
    assert road.sense(road.start(keys("train", [0]))).probed is None


def test_a_restart_forgets_the_probe(loop):
    """A row that begins anew has heard the radar; its neighbours keep what they heard."""
    place = loop()
    state = place.start(keys("train", range(2)))
    for _ in range(5):
        state, _ = place.advance(state, place.brief.command(np.zeros(2, bool), 0, place.brief.granted, 0.0))
    assert not state.probed.any()  # step 5 was a challenge
    assert place.restart(state, np.array([True, False])).probed.tolist() == [[True], [False]]


def test_the_observation_shows_what_was_radiated_by_its_bound(loop):
    """Power and delay of the last command in units of their bounds, 0 for the other kind; the wires only where another kind is granted."""
    place = loop(kinds=("noise_jam", "echo_delay"), delay_bound=8.0)
    codec = ObservationCodec(place.brief)
    assert {"last_power", "last_delay", "probed"} <= set(codec.names) and not {"last_distance", "last_relative_speed"} & set(codec.names)
    for kind, value, wanted in ((Kind.NOISE_JAM, 0.025, (0.25, 0.0)), (Kind.ECHO_DELAY, 2.0, (0.0, 0.25))):
        state, _ = place.advance(place.start(keys("train", [1])), radiating(kind, value)(place.brief, 1, 1))
        seen = dict(zip(codec.names, codec.observe(place.sense(state))[0], strict=True))
        assert (seen["last_power"], seen["last_delay"]) == pytest.approx(wanted)
    wide = ObservationCodec(loop().brief)
    assert {"last_distance", "last_relative_speed", "last_power", "last_delay"} <= set(wide.names)


def test_the_granted_measurement_shows_errors_of_both_readings(loop):
    """By how much each is off in metres and m/s, 0 and a flag of its own at a challenge."""
    place = loop(sees_measurement=True)
    codec = ObservationCodec(place.brief)
    state, off = place.start(keys("train", range(64))), []
    for k in range(1, 13):
        seen = dict(zip(codec.names, codec.observe(place.sense(state)).T, strict=True))
        assert (seen["silent"] == (k in SILENT)).all()
        if k in SILENT:
            assert not seen["noise_distance"].any() and not seen["noise_relative_speed"].any()
        else:
            off.append((seen["noise_distance"], seen["noise_relative_speed"]))
        state, _ = place.advance(state, place.brief.command(np.zeros(64, bool), 0, place.brief.granted, 0.0))
    spread = np.array(off).std(axis=(0, 2))
    assert 0.2 < spread[0] < 0.6 and 0.05 < spread[1] < 0.3 and abs(np.array(off).mean(axis=(0, 2))).max() < 0.1


# -- what a learner can do


@pytest.mark.parametrize("action", ["timing", "mode", "ramp", "continuous", "increment"])
def test_masks_and_refusals_agree(action, loop):
    """Whatever the action, it is refused exactly where the view says that nothing is allowed: budget, cooldown, onset, duration."""
    place = loop(kinds=("noise_jam", "echo_delay"), onset=3, budget=6, duration=3, cooldown=2)
    codec = ActionCodec(ActionSpec(action=action, kind="echo_delay", rate=2.0, delay=3.0), place.brief)
    state, rng, kinds = place.start(keys("train", range(16))), np.random.default_rng(3), set()
    for _ in range(20):
        view = place.sense(state)
        chosen = rng.integers(codec.size, size=16) if codec.discrete else rng.uniform(-1.0, 1.0, (16, codec.size))
        asks = chosen > 0 if codec.discrete else chosen[:, 0] > 0.0
        if codec.discrete:
            assert (codec.mask(view)[np.arange(16), chosen] == (view.allowed | ~asks)).all()
        state, frame = place.advance(state, codec.decode(chosen, view))
        assert (frame.refused == (asks & ~view.allowed)).all()
        kinds |= set(frame.command.kind.tolist())
    assert kinds == ({Kind.NONE, Kind.ECHO_DELAY} if action == "timing" else {Kind.NONE, Kind.NOISE_JAM, Kind.ECHO_DELAY})


def test_modes_carry_power_and_delay(loop):
    """One mode for each kind with its value on the sensors; none for a single reading, which does not exist over the air."""
    brief = loop(kinds=("noise_jam", "echo_delay"), targets=("distance", "relative_speed", "acceleration")).brief
    codec = ActionCodec(ActionSpec(power=0.02, delay=4.0, per_sensor=True), brief)
    assert [mode.name for mode in codec.modes] == ["none", "noise_jam", "echo_delay"]
    assert [mode.value.max() for mode in codec.modes] == [0.0, 0.02, 4.0]
    assert all((mode.target == [[True, True, False]]).all() for mode in codec.modes[1:])
    sizes = ActionCodec(ActionSpec(delay=4.0, shares=(0.5, 1.0)), brief).modes
    assert [(mode.name, mode.value.max()) for mode in sizes[2:]] == [("echo_delay*0.5", 2.0), ("echo_delay", 4.0)]
    ramp = ActionCodec(ActionSpec(action="ramp"), brief)
    assert [mode.name for mode in ramp.modes] == ["none", "noise_jam", "echo_delay+", "echo_delay=", "echo_delay-"]


def test_a_ramp_pulls_the_echo_off_step_by_step(loop):
    """It starts at `delay`, is raised, kept and lowered by `rate`, stays within the bounds, and starts anew after another kind."""
    place = loop(kinds=("noise_jam", "echo_delay"), delay_bound=4.0)
    codec = ActionCodec(ActionSpec(action="ramp", delay=1.0, rate=1.5), place.brief)
    noise, up, keep, down = 1, 2, 3, 4
    state, sent = place.start(keys("train", [0])), []
    for number in (keep, up, up, up, keep, down, down, down, noise, up, down, 0, keep):
        state, frame = place.advance(state, codec.decode(np.array([number]), place.sense(state)))
        assert not frame.refused.any()
        sent.append(float(frame.command.value[0, 0, 0]))
    assert sent == pytest.approx([1.0, 2.5, 4.0, 4.0, 4.0, 2.5, 1.0, 0.0, 0.1, 1.0, 0.0, 0.0, 1.0], abs=1e-9)


def test_the_trigger_is_shared_among_the_kinds(loop):
    """fdi, echo_delay and noise_jam split (0, 1] evenly, each with its values: those of fdi per wire, of the others one more per agent."""
    place = loop(kinds=("noise_jam", "fdi", "echo_delay"), fdi_bound=10.0, delay_bound=8.0)
    codec, view = ActionCodec(ActionSpec(action="continuous"), place.brief), place.sense(place.start(keys("train", range(7))))
    trigger = np.array([-0.5, 0.0, 0.01, 0.33, 0.34, 0.66, 0.67])
    action = np.stack([trigger, np.full(7, 0.5), np.full(7, -0.25), np.full(7, 0.0)], axis=1)
    command = codec.decode(action, view)
    assert codec.size == 4 and command.kind.tolist() == [0, 0, Kind.FDI, Kind.FDI, Kind.ECHO_DELAY, Kind.ECHO_DELAY, Kind.NOISE_JAM]
    assert command.value[:, 0, :2].tolist() == [[0, 0]] * 2 + [[5.0, -2.5]] * 2 + [[4.0, 4.0]] * 2 + [[0.05, 0.05]]
    alone = ActionCodec(ActionSpec(action="continuous"), loop(kinds=("noise_jam",)).brief)
    assert alone.size == 2 and alone.decode(np.array([[0.1, 1.0], [1.0, -1.0]]), place.sense(place.start(keys("train", range(2))))).value.max(axis=(1, 2)) == pytest.approx([0.1, 0.0])


def test_fdi_alone_decodes_as_it_did(same_bits):
    """Continuous and increment on a road without a radar, to the last bit of the plain formulas."""
    place = load_scenario("stop-and-go-v0").with_threat(kinds=("fdi",), onset=1).loop(tailgate.make_defence("kf"))
    bound, rng = place.brief.bounds[:2], np.random.default_rng(5)
    for name in ("continuous", "increment"):
        codec, state = ActionCodec(ActionSpec(action=name, rate=0.7), place.brief), place.start(keys("train", range(5)))
        for _ in range(6):
            action = rng.uniform(-1.0, 1.0, (5, 3))
            view = place.sense(state)
            values = bound * action[:, 1:] if name == "continuous" else np.clip(view.last.value[:, 0, :2] + 0.7 * action[:, 1:], -bound, bound)
            command = codec.decode(action, view)
            assert same_bits(command.value[:, 0, :2], np.where(action[:, :1] > 0, values, 0.0))
            state, _ = place.advance(state, command)


@pytest.mark.parametrize("options, threat, message", [
    ({"power": 0.2}, {}, r"power: got 0.2; expected at most the threat model's jam_power \(0.1\)"),
    ({"delay": 61.0}, {}, r"delay: got 61.0; expected at most the threat model's delay_bound \(60.0\)"),
    ({"action": "timing", "kind": "echo_delay", "delay": 70.0}, {}, "delay_bound"),
    ({"action": "continuous"}, {"kinds": ("dos_jam",)}, "continuous with fdi"),
    ({}, {"kinds": ("echo_delay",), "targets": ("acceleration",)}, "a granted sensor that listens to its own echo"),
])  # fmt: skip
def test_what_is_not_granted_is_an_error_of_the_learner(options, threat, message, loop):
    """Values beyond the bounds, vectors without a kind that they can carry, and kinds that reach nobody."""
    wide = {"kinds": ("noise_jam", "echo_delay")} | threat
    with pytest.raises(InputError, match=message):
        ActionCodec(ActionSpec(**options), loop(**wide).brief)


def test_a_value_that_is_not_used_is_not_checked(loop):
    """A timing policy with echo_delay does not care about the power, nor one of noise_jam about the delay."""
    brief = loop(kinds=("noise_jam", "echo_delay"), jam_power=0.01, delay_bound=2.0).brief
    assert ActionCodec(ActionSpec(action="timing", kind="echo_delay", delay=2.0), brief).modes[1].value.max() == 2.0
    assert ActionCodec(ActionSpec(action="timing", kind="noise_jam", power=0.01), brief).modes[1].value.max() == 0.01
    road = load_scenario("stop-and-go-v0").brief()
    assert dataclasses.asdict(ActionCodec(ActionSpec(), road).spec)["power"] == 0.1
