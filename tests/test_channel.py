"""The channel: what is refused has no effect and costs nothing; what is accepted does exactly what its kind says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tailgate.base.errors import InputError
from tailgate.core import AIRED, Command, Kind, Received
from tailgate.core.channel import Channel
from tailgate.core.kinds import EFFECTS
from tailgate.core.scenario import load_scenario
from tailgate.core.threat import Brief, ThreatModel

ALL = ("dos_jam", "dos_hold", "dos_hold_fresh", "dropout", "fdi", "delay", "replay")
P, V, LP, LV, ACC = range(5)  # wires: position, velocity, leader's position and velocity, the acceleration command
OLD = (Kind.DELAY, Kind.REPLAY)
WIRED = [kind for kind in Kind if kind != Kind.NONE and kind not in AIRED and not EFFECTS[kind].inside]
MODEL = load_scenario("stop-and-go-v0").brief().model
EXPECTED = np.array([-1.0, -2.0, -3.0, -4.0, -5.0])


def sent(k):
    """What is sent at step k: every number tells its step and wire."""
    return 100.0 * k + np.arange(5)


class Wire:
    """A channel of one episode, stepped by hand."""

    def __init__(self, **threat):
        self.plan = Channel().prepare(Brief(MODEL, ThreatModel(**({"kinds": ALL} | threat)), 1000))
        self.state = Channel().start(self.plan, EXPECTED[None, None, :4].copy(), EXPECTED[None, None, 4:].copy())
        self.k = 0

    def step(self, kind=Kind.NONE, targets=(), value=0.0):
        """-> wires, valid, charged, refused."""
        self.k += 1
        target = np.isin(np.arange(5), targets)[None, None]
        command = Command(np.array([kind], np.int8), target, np.broadcast_to(np.asarray(value, float), (1, 1, 5)).copy())
        y, u = sent(self.k)[None, None, :4], sent(self.k)[None, None, 4:]
        received = Received(y[..., :2].copy(), np.ones((1, 1, 2), bool), np.zeros((1, 1)))
        used = self.state.used
        self.state, out, wires, refused = Channel().apply(self.plan, self.state, y.copy(), received, command, np.array([self.k]))
        charged = self.state.used - used == 1
        np.testing.assert_array_equal(np.concatenate([out.y, out.v2v], axis=-1), wires)
        np.testing.assert_array_equal(out.attacked[0, 0], (target & charged)[0, 0, :2])
        self.state, applied = Channel().actuate(self.plan, self.state, u.copy())
        return np.concatenate([wires[0, 0], applied[0, 0]]), out.valid[0, 0], bool(charged[0]), bool(refused[0])

    def idle(self, steps):
        for _ in range(steps):
            self.step()
        return self


def assert_refused(wire, *command, **options):
    """No effect on any wire, counted, not charged, and not the last command."""
    used = wire.state.used.copy()
    wires, valid, charged, refused = wire.step(*command, **options)
    np.testing.assert_array_equal(wires, sent(wire.k))
    assert valid.all() and refused and not charged
    assert wire.state.used == used and wire.state.last.kind == 0
    assert not wire.state.last.target.any() and not wire.state.last.value.any()


def assert_accepted(wire, *command, **options):
    used = int(wire.state.used[0])
    wires, _, charged, refused = wire.step(*command, **options)
    assert charged and not refused and wire.state.used == used + 1
    return wires


@pytest.mark.parametrize("kind", WIRED)
def test_kind_not_granted(kind):
    """A kind outside of the threat model is refused."""
    others = tuple(name for name in ALL if name != kind.name.lower())
    assert_refused(Wire(kinds=others).idle(2), kind, [P], 1.0)
    assert_accepted(Wire().idle(2), kind, [P], 1.0)


@pytest.mark.parametrize("kind", WIRED)
@pytest.mark.parametrize("targets", [[LP], [LV], [P, LP], [ACC], [P, ACC], [P, V, LP, LV, ACC]])
def test_wire_not_granted(kind, targets):
    """One wire too many refuses the whole command; without `targets` no V2V field is granted."""
    assert_refused(Wire(), kind, targets, 1.0)
    assert_refused(Wire(targets=("leader_velocity",)), kind, [P], 1.0)
    assert_accepted(Wire(targets=("leader_velocity", "leader_position", "position", "velocity", "acceleration")), kind, targets, 1.0)


@pytest.mark.parametrize("kind", AIRED)
def test_sensors_that_receive_nothing_over_the_air(kind):
    """Granted or not, there is nothing that noise or a late echo could reach."""
    assert_refused(Wire(kinds=(*ALL, "noise_jam", "echo_delay")), kind, [P], 0.05)


@pytest.mark.parametrize("value", [5.000001, -5.000001, np.inf, -np.inf, np.nan])
def test_injected_value_over_the_bound(value):
    """|value| over fdi_bound on any targeted wire, or NaN, is refused; on other wires it does not matter."""
    assert_refused(Wire(fdi_bound=5.0), Kind.FDI, [P], value)
    assert_refused(Wire(fdi_bound=5.0), Kind.FDI, [P, V], [1.0, value, 0.0, 0.0, 0.0])
    wires = assert_accepted(Wire(fdi_bound=5.0), Kind.FDI, [P], [5.0, value, value, 0.0, 0.0])
    np.testing.assert_array_equal(wires - sent(1), [5.0, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("value", [-1.0001, 2.0001, np.inf, np.nan])
def test_jammer_value_outside_of_its_range(value):
    """A jammer's value must lie in jam_range, ends included."""
    assert_refused(Wire(jam_range=(-1.0, 2.0)), Kind.DOS_JAM, [P], value)
    for end in (-1.0, 2.0):
        assert assert_accepted(Wire(jam_range=(-1.0, 2.0)), Kind.DOS_JAM, [P], end)[P] == end


@pytest.mark.parametrize("kind", [Kind.DOS_HOLD, Kind.DOS_HOLD_FRESH, Kind.DROPOUT])
def test_a_value_that_is_not_used_never_enters_the_record(kind):
    """Kinds without a value leave no NaN behind, neither on the wires nor in the last command that observations show."""
    wire = Wire().idle(1)
    wires, *_ = wire.step(kind, [P, V], np.nan)
    assert np.isfinite(wires).all()
    assert np.isfinite(wire.state.last.value).all()


@pytest.mark.parametrize("number", [-128, -1, 8, 99, 127])
def test_unknown_kind_number(number):
    """A number that is no kind is refused."""
    assert_refused(Wire(), number, [P], 1.0)


def test_none_and_empty_commands():
    """NONE without a target is not refused; NONE with a target, and a kind without one, are."""
    wires, valid, charged, refused = Wire().step()
    np.testing.assert_array_equal(wires, sent(1))
    assert valid.all() and not charged and not refused
    assert_refused(Wire(), Kind.NONE, [P], 1.0)
    assert_refused(Wire(), Kind.FDI, [], 1.0)


def test_budget():
    """Exactly `budget` commands take effect; refused ones are not charged."""
    wire = Wire(budget=3)
    assert_accepted(wire, Kind.FDI, [P], 1.0)
    assert_refused(wire, Kind.FDI, [LP], 1.0)
    assert_accepted(wire, Kind.FDI, [P], 1.0)
    assert_accepted(wire, Kind.DOS_HOLD, [V])
    for _ in range(3):
        assert_refused(wire, Kind.FDI, [P], 1.0)
    assert_refused(Wire(budget=0), Kind.FDI, [P], 1.0)


def test_duration():
    """A burst lasts at most `duration` steps; a pause starts a new one."""
    wire = Wire(duration=2)
    for _ in range(2):
        assert_accepted(wire, Kind.FDI, [P], 1.0)
    assert_refused(wire, Kind.FDI, [P], 1.0)
    for _ in range(2):
        assert_accepted(wire, Kind.FDI, [P], 1.0)


@pytest.mark.parametrize("cooldown", [1, 2, 3])
@pytest.mark.parametrize("duration", [2, None])
def test_cooldown(cooldown, duration):
    """Between two bursts lie `cooldown` steps, no fewer and no more, whether the burst ended by itself or by its duration."""
    wire = Wire(cooldown=cooldown, duration=duration)
    for _ in range(2):
        assert_accepted(wire, Kind.FDI, [P], 1.0)
    if duration is None:
        wire.step()  # the attacker pauses by itself: the first step between the bursts
    for _ in range(cooldown if duration else cooldown - 1):
        assert_refused(wire, Kind.FDI, [P], 1.0)
    assert_accepted(wire, Kind.FDI, [P], 1.0)


def test_onset_and_end():
    """Nothing before `onset` and nothing after `end`; both steps themselves are granted."""
    wire = Wire(onset=4, end=6)
    for k in range(1, 9):
        (assert_accepted if 4 <= k <= 6 else assert_refused)(wire, Kind.FDI, [P], 1.0)


def test_end_is_never_after_the_horizon():
    """Without an end the last step is the horizon."""
    plan = Channel().prepare(Brief(MODEL, ThreatModel(kinds=ALL), 30))
    state = Channel().start(plan, np.zeros((2, 1, 4)), np.zeros((2, 1, 1)))
    np.testing.assert_array_equal(Channel().allowed(plan, state, np.array([30, 31])), [True, False])


@pytest.mark.parametrize("targets", [[P], [V], [P, V], [V, LV], [ACC], [P, V, LP, LV, ACC]])
def test_every_kind_does_what_it_says_on_its_targets_only(targets):
    """Jam replaces, hold repeats, dropout keeps the last value and says so, injection adds; other wires keep every bit."""
    value, on = np.array([7.0, 8.0, 9.0, 10.0, 11.0]), np.isin(np.arange(5), targets)
    effects = {Kind.DOS_JAM: value, Kind.DOS_HOLD: sent(2), Kind.DOS_HOLD_FRESH: sent(2), Kind.DROPOUT: sent(2), Kind.FDI: sent(3) + value}
    for kind, effect in effects.items():
        wire = Wire(targets=MODEL.wires, actuator_bound=20.0).idle(2)
        wires, valid, charged, _ = wire.step(kind, targets, value)
        assert charged
        np.testing.assert_array_equal(wires, np.where(on, effect, sent(3)))
        np.testing.assert_array_equal(valid, ~on[:2] if kind == Kind.DROPOUT else [True, True])
        if kind in (Kind.DOS_JAM, Kind.FDI):
            np.testing.assert_array_equal(wire.state.last.value[0, 0], np.where(on, value, 0.0))
        np.testing.assert_array_equal(wire.step()[0], sent(4))


def test_holds_at_the_first_step_repeat_what_the_prior_expects():
    """Without a good sample yet, a hold reads what the wires were expected to read."""
    for kind in (Kind.DOS_HOLD, Kind.DOS_HOLD_FRESH):
        np.testing.assert_array_equal(Wire().step(kind, [P])[0], [EXPECTED[P], *sent(1)[1:]])


def test_hold_reads_the_sample_before_the_first_attack_and_fresh_the_one_before_this_burst():
    """(6.18) keeps one sample for the whole episode; hold_fresh renews it with each burst."""
    wire = Wire().idle(3)
    for kind in (Kind.DOS_HOLD, Kind.DOS_HOLD_FRESH, Kind.DOS_HOLD):
        assert wire.step(kind, [P])[0][P] == sent(3)[P]  # steps 4 to 6: one burst
    wire.idle(4)  # steps 7 to 10 are good again
    assert wire.step(Kind.DOS_HOLD, [P])[0][P] == sent(3)[P]
    assert wire.step(Kind.DOS_HOLD_FRESH, [P])[0][P] == sent(10)[P]
    assert wire.step(Kind.DOS_HOLD_FRESH, [P, V])[0][V] == sent(12)[V]  # the velocity was good until step 12


@pytest.mark.parametrize(("granted", "kept"), [({}, 6), ({"hold_from_onset": True}, 3)])
def test_what_is_held_is_of_before_the_first_hit_or_of_before_the_onset(granted, kept):
    """(6.18) has one tau, the step before attacks may begin, however late the first of them comes."""
    wire = Wire(onset=4, targets=MODEL.wires, **granted).idle(6)  # three steps in which an attack would have been accepted
    for _ in range(2):
        arrived = wire.step(Kind.DOS_HOLD, [P, ACC])[0]
        np.testing.assert_array_equal(arrived[[P, ACC]], sent(kept)[[P, ACC]])
        assert wire.step(Kind.DOS_HOLD_FRESH, [V])[0][V] == sent(wire.k - 1)[V]
        wire.idle(2)


def test_a_hold_from_the_first_step_on_repeats_what_the_prior_expects():
    np.testing.assert_array_equal(Wire(hold_from_onset=True).idle(1).step(Kind.DOS_HOLD, [P])[0][P], EXPECTED[P])


def test_injected_and_refused_samples_are_not_good_samples_or_attacks():
    """A falsified reading is never held; a refused command does not fix the sample that a hold repeats."""
    wire = Wire().idle(2)
    assert_refused(wire, Kind.FDI, [LP], 1.0)
    assert_accepted(wire, Kind.FDI, [P], 5.0)
    assert wire.step(Kind.DOS_HOLD_FRESH, [P])[0][P] == sent(3)[P]
    assert wire.step(Kind.DOS_HOLD, [P])[0][P] == sent(3)[P]


def test_delay_reads_what_was_sent_some_steps_ago():
    """Age 3 at step k reads step k - 3, attacked steps included; before the first sample, what the prior expects."""
    wire = Wire(targets=MODEL.wires, memory=5)
    assert wire.step(Kind.DELAY, [P, ACC], 3)[0][P] == EXPECTED[P]
    wire.idle(5)
    for k in (7, 8, 9, 10, 11, 12, 13):
        np.testing.assert_array_equal(wire.step(Kind.DELAY, [P, ACC], 3)[0], np.where([1, 0, 0, 0, 1], sent(k - 3), sent(k)))
    arrived = wire.step(Kind.DELAY, [P, V, LV], [5, 1, 9, 2, 9])[0]
    np.testing.assert_array_equal(arrived, [sent(9)[P], sent(13)[V], sent(14)[LP], sent(12)[LV], sent(14)[ACC]])


def test_replay_plays_the_last_window_again_and_again():
    """A window of 3 before step 7 is 4, 5, 6, 4, 5, 6, ...; the recorder runs on, and the next replay plays what was sent meanwhile."""
    wire = Wire(targets=MODEL.wires, memory=4).idle(6)
    assert [wire.step(Kind.REPLAY, [V, ACC], 3)[0][V] for _ in range(7)] == [sent(k)[V] for k in (4, 5, 6, 4, 5, 6, 4)]
    wire.idle(1)  # step 14
    assert [wire.step(Kind.REPLAY, [ACC], 2)[0][ACC] for _ in range(3)] == [sent(k)[ACC] for k in (13, 14, 13)]


def test_a_delay_after_a_replay_is_as_old_as_it_says():
    """Also on wires that were not replayed, and however long the replay was."""
    wire = Wire(targets=MODEL.wires, memory=5).idle(8)
    for _ in range(12):
        wire.step(Kind.REPLAY, [P], 2)  # to step 20
    np.testing.assert_array_equal(wire.step(Kind.DELAY, [P, V, ACC], 5)[0], np.where([1, 1, 0, 0, 1], sent(16), sent(21)))
    assert wire.step(Kind.REPLAY, [P], 3)[0][P] == sent(19)[P]


@pytest.mark.parametrize("kind", OLD)
@pytest.mark.parametrize("value", [0, -1, 5, 1.5, np.nan, np.inf])
def test_an_age_is_a_whole_number_within_the_memory(kind, value):
    """Steps from 1 to memory."""
    assert_refused(Wire(memory=4).idle(6), kind, [P], value)
    assert assert_accepted(Wire(memory=4).idle(6), kind, [P], 4)[P] == sent(3)[P]


@pytest.mark.parametrize("kind", [Kind.FDI, Kind.DOS_JAM])
def test_an_actuator_has_its_own_bound(kind):
    """actuator_bound limits what is added to, or jammed onto, the acceleration command; fdi_bound and jam_range do not."""
    wide = {"targets": ("acceleration",), "fdi_bound": 100.0, "jam_range": (-100.0, 100.0), "actuator_bound": 1.5}
    assert_refused(Wire(**wide), kind, [ACC], -1.6)
    assert assert_accepted(Wire(**wide), kind, [ACC], -1.5)[ACC] == (sent(1)[ACC] if kind == Kind.FDI else 0.0) - 1.5


VALUES = st.sampled_from([0.0, 1.0, 3.0, -5.0, 5.0, 5.1, -200.0, np.nan, np.inf])
COMMANDS = st.lists(st.tuples(st.integers(-1, 8), st.sets(st.integers(0, 4)), VALUES), min_size=5, max_size=25)


@settings(max_examples=150, deadline=None)
@given(
    COMMANDS, st.sets(st.sampled_from(MODEL.wires), min_size=1), st.one_of(st.none(), st.integers(0, 6)),
    st.one_of(st.none(), st.integers(1, 4)), st.integers(0, 3), st.integers(1, 8), st.sets(st.sampled_from(ALL), min_size=1),
)  # fmt: skip
def test_no_sequence_of_commands_leaves_the_threat_model(commands, targets, budget, duration, cooldown, onset, kinds):
    """Random commands: ungranted wires keep every bit, budget, duration, cooldown and onset hold, effects are charged."""
    wire = Wire(
        targets=tuple(targets), budget=budget, duration=duration, cooldown=cooldown, onset=onset, end=20, fdi_bound=5.0, kinds=tuple(kinds)
    )
    granted = np.array([w in targets for w in MODEL.wires])
    on = []
    for kind, target, value in commands:
        wires, valid, charged, refused = wire.step(kind, list(target), value)
        np.testing.assert_array_equal(wires[~granted], sent(wire.k)[~granted])
        assert valid[~granted[:2]].all() and np.isfinite(wires).all()
        assert not (charged and refused) and refused == ((kind != 0 or bool(target)) and not charged)
        if charged:
            assert onset <= wire.k <= 20 and Kind(kind).name.lower() in kinds
        else:
            np.testing.assert_array_equal(wires, sent(wire.k))
            assert valid.all()
        on.append(charged)
    assert wire.state.used[0] == sum(on) and (budget is None or sum(on) <= budget)
    runs = "".join("x" if c else "." for c in on).strip(".")
    assert duration is None or all(len(r) <= duration for r in runs.split("."))
    assert all(len(r) >= cooldown for r in runs.split("x") if r)


@pytest.mark.parametrize(
    "field, value", [("budget", -1), ("onset", 0), ("duration", 0), ("fdi_bound", 0.0), ("jam_range", (2.0, 1.0)), ("end", 3),
                     ("kinds", ("magic",)), ("knowledge", "blue"), ("cooldown", -1), ("fdi_bound", float("nan"))],
)  # fmt: skip
def test_threat_models_are_validated(field, value):
    """Impossible limits are refused with the field's name."""
    with pytest.raises(InputError, match=rf"threat_model\.{field}"):
        load_scenario("stop-and-go-v0").with_threat(**({"onset": 5} | {field: value}))


def test_unknown_target_names_the_wires(short, loop_of):
    """A wire that does not exist is refused before the first step, with the nearest name."""
    with pytest.raises(InputError, match=r"positon.*did you mean 'position'"):
        loop_of(short(targets=("positon",)), "kf")
