"""Scripts and programs over the air: what they send, where they do not apply, and what they do to a car."""

import numpy as np
import pytest

import tailgate
from tailgate.agents.scripts.program import Program
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import rollout

SCRIPTS = {"noise_jam": "noise_jam", "echo_delay": "echo_delay", "echo_pull_off": "echo_delay", "radar_jam": "dos_jam"}


def place(**threat):
    wide = {"kinds": ("dos_jam", "noise_jam", "echo_delay"), "jam_range": (0.0, 250.0), "budget": None, "onset": 1, "end": None}
    return load_scenario("radar-following-v0").with_threat(**(wide | threat))


def played(attack, seeds=range(4), defence="none", **threat):
    made = Spec("attack", attack).make() if isinstance(attack, str) else attack
    spec = Spec("defence", defence)
    return rollout(place(**threat).loop(spec.make(), spec.entry.uses), made, keys("train", list(seeds)))


@pytest.mark.thin(3)
@pytest.mark.parametrize("attack, kind, value", [
    ("noise_jam:power=0.03,start_step=20,length=5", Kind.NOISE_JAM, 0.03), ("echo_delay:delay=6,start_step=20,length=5", Kind.ECHO_DELAY, 6.0),
    ("noise_jam:power=5,start_step=20,length=5", Kind.NOISE_JAM, 0.1), ("echo_delay:delay=500,start_step=20,length=5", Kind.ECHO_DELAY, 60.0),
])  # fmt: skip
def test_a_script_sends_its_value_in_its_window(attack, kind, value):
    """To both readings, cut at the bound, from step 20 to 24 and never refused."""
    trace = played(attack)
    on = np.flatnonzero(trace.kind[:, 0]) + 1
    assert on.tolist() == [20, 21, 22, 23, 24] and not trace.refused.any()
    assert (trace.kind[19:24] == kind).all() and (trace.value[19:24, :, 0, :2] == value).all() and not trace.target[..., 2].any()


def test_the_pull_off_grows_by_its_rate_up_to_the_bound():
    """base + rate, base + 2 rate, ... from its onset; where it begins below 0 it sends next to nothing until it is above."""
    trace = played("echo_pull_off:base=1,rate=0.5,start_step=10,length=20", delay_bound=8.0, seeds=[0])
    assert trace.value[9:29, 0, 0, 0] == pytest.approx(np.minimum(1.0 + 0.5 * np.arange(1, 21), 8.0))
    late = played("echo_pull_off:base=-1,rate=0.5,start_step=10,length=4", seeds=[0])
    assert late.value[9:13, 0, 0, 0] == pytest.approx([0.0, 0.0, 0.5, 1.0], abs=1e-9) and not late.refused.any()


@pytest.mark.long
@pytest.mark.parametrize("attack", ["noise_jam", "echo_delay", "echo_pull_off", "radar_jam"])
def test_who_hops_radiates_only_after_a_step_with_a_probe(attack):
    """hop=true: silent in every step that follows a muted one, as the plain script is not; nothing is refused."""
    for text, silent in ((f"{attack}:start_step=5,hop=true", True), (f"{attack}:start_step=5", False)):
        trace = played(text, range(20), "pycra:probability=0.4")
        muted = ~trace.valid[..., 0, 0] & (trace.energy[..., 0] > 0.0)  # at step k: its probe was not sent
        after = np.concatenate([np.zeros_like(muted[:1]), muted[:-1]]) & trace.live
        assert ((trace.kind[4:] != 0)[after[4:]].any() == (not silent)) and (trace.kind[4:] != 0)[~after[4:] & trace.live[4:]].all() and not trace.refused.any()


def test_the_thesis_jammer_writes_high_values():
    """Uniform on 180 to 250 m and on 0 to 60 m/s, by each wire's own law; what the threat model does not allow is cut."""
    trace = played("radar_jam:start_step=10", seeds=range(100))
    hit = (trace.kind == Kind.DOS_JAM) & trace.live
    d, dv = trace.wires[hit][:, 0, 0], trace.wires[hit][:, 0, 1]
    assert len(d) > 300 and 180.0 <= d.min() < 185.0 and 245.0 < d.max() <= 250.0 and 0.0 <= dv.min() < 4.0 and 56.0 < dv.max() <= 60.0
    band = 3.29 / np.sqrt(12.0 * len(d))  # 99.9 % of the mean of a uniform law on [0, 1]
    assert abs(d.mean() - 215.0) < 70.0 * band and abs(dv.mean() - 30.0) < 60.0 * band
    cut = played("radar_jam:start_step=10", jam_range=(0.0, 200.0))
    assert cut.wires[cut.kind == Kind.DOS_JAM][:, 0, 0].max() == 200.0 and not cut.refused.any()


def test_the_thesis_jammer_is_heard_at_a_challenge():
    """The receiver that falls silent hears far more than noise, though the values arrive by decree."""
    trace = played("radar_jam:start_step=10,length=40", defence="cra", seeds=range(8))
    muted = ~np.concatenate([np.ones((1, 8), bool), trace.probe[:-1, :, 0]])
    hit, quiet = muted & (trace.kind != 0) & trace.live, muted & (trace.kind == 0) & trace.live
    assert hit.sum() > 8 and trace.energy[hit].min() > 10.0 and trace.energy[quiet].max() < 1.1


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_needs_a_radar_and_its_kind(name):
    """Not applicable where the sensors have no echo, or the kind or every sensor is not granted; an actuator is an error of the user."""
    attack = tailgate.make_attack(name)
    road = load_scenario("stop-and-go-v0").with_threat(kinds=("dos_jam", "noise_jam", "echo_delay"))
    for other in (road, load_scenario("platoon-braking-v0").with_threat(kinds=("dos_jam", "noise_jam", "echo_delay"))):
        with pytest.raises(NotApplicable):
            attack.prepare(other.brief())
    with pytest.raises(NotApplicable, match=f"grants {SCRIPTS[name]}"):
        attack.prepare(place(kinds=("fdi",)).brief())
    with pytest.raises(NotApplicable):
        attack.prepare(place(targets=("acceleration",)).brief())
    with pytest.raises(InputError, match=r"targets.*'acceleration'.*distance, relative_speed"):
        tailgate.make_attack(name, targets=("acceleration",)).prepare(place(targets=("distance", "relative_speed", "acceleration")).brief())


@pytest.mark.parametrize("attack", ["noise_jam:power=0", "echo_delay:delay=-1", "echo_pull_off:rate=0", "radar_jam:distance=[250,180]", "radar_jam:relative_speed=[1,nan]"])
def test_parameters_out_of_range_are_refused(attack):
    """No power, a negative delay, a span that is turned round, no number."""
    with pytest.raises(InputError):
        Spec("attack", attack).make()


@pytest.mark.long
def test_conditions_and_chance_work_as_for_every_script():
    """A late echo only while the gap is small; with chance 0.3 in 30 % of the open steps."""
    trace = played("echo_delay:delay=1,trigger=near,threshold=60", seeds=range(10))
    gap = np.concatenate([trace.first["gap"][None, :, 0], trace.gap[:-1, :, 0]])
    first = np.argmax(trace.kind > 0, axis=0)
    rows = np.arange(10)
    assert (gap[first, rows] <= 60.0).all() and (gap[first - 1, rows] > 60.0).all()
    some = played("echo_delay:delay=0.1,chance=0.3", seeds=range(10))
    share, count = (some.kind[some.live] > 0).mean(), int(some.live.sum())
    assert abs(share - 0.3) < 3.29 * np.sqrt(0.21 / count)


PROGRAM = """
phases:
  - {kind: noise_jam, value: 0.05, trigger: {name: time, start: 10}, length: 4}
  - {kind: echo_delay, value: {name: ramp, base: 0.0, rate: 2.0, limit: 50.0}, length: 5}
  - {kind: dos_jam, value: {distance: 200.0, relative_speed: 10.0}, length: 2}
"""


def test_a_program_uses_both_kinds(tmp_path):
    """Power, then a delay that grows, then a jammer's values: one phase after the other."""
    path = tmp_path / "radio.yaml"
    path.write_text(PROGRAM)
    trace = played(Program(path), delay_bound=7.0)
    assert trace.kind[9:20, 0].tolist() == [8] * 4 + [9] * 5 + [1] * 2 and not trace.refused.any()
    assert trace.value[9:13, 0, 0, 0].tolist() == [0.05] * 4 and trace.value[13:18, 0, 0, 0].tolist() == [2.0, 4.0, 6.0, 7.0, 7.0]
    assert trace.wires[18:20, 0, 0].tolist() == [[200.0, 10.0]] * 2


def test_a_programs_probability_is_that_of_the_receiver(tmp_path):
    """Half of the steps, not the three quarters in which one of two readings would be drawn."""
    path = tmp_path / "half.yaml"
    path.write_text("phases: [{kind: echo_delay, value: 0.1, probability: 0.5}]")
    trace = played(Program(path), seeds=range(20))
    share, count = (trace.kind[trace.live] > 0).mean(), int(trace.live.sum())
    assert abs(share - 0.5) < 3.29 * 0.5 / np.sqrt(count)


def test_a_program_over_the_air_needs_a_radar(tmp_path):
    """Not applicable on a plant without an echo; a named actuator is an error of the file."""
    path = tmp_path / "deaf.yaml"
    path.write_text("phases: [{kind: echo_delay, value: 6}]")
    with pytest.raises(NotApplicable, match="echo"):
        Program(path).prepare(load_scenario("stop-and-go-v0").with_threat(kinds=("echo_delay",)).brief())
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text("phases: [{kind: echo_delay, value: 6, targets: [acceleration]}]")
    with pytest.raises(InputError, match=r"phase 1.targets.*'acceleration'"):
        Program(wrong).prepare(place(targets=("distance", "acceleration")).brief())


# -- the published scenarios


@pytest.mark.long
@pytest.mark.parametrize("name", ["radar-following-v0", "radar-braking-v0", "radar-fast-attacker-v0"])
@pytest.mark.parametrize("defence", ["none", "kf", "chi2_kf", "cra"])
def test_without_an_attack_everybody_arrives(name, defence):
    """200 episodes without a collision in front or behind and without a false alarm; standing, the car keeps its 5 m, the noise aside."""
    spec = Spec("defence", defence)
    trace = rollout(load_scenario(name).loop(spec.make(), spec.entry.uses), tailgate.make_attack("none"), keys("tune", range(200)))
    assert trace.gap.min() > (4.0 if name == "radar-braking-v0" else 30.0) and trace.rear_gap.min() > 4.0
    assert not trace.alarm.any() and (trace.length == trace.horizon).all()


@pytest.mark.long
def test_the_fast_attacker_is_the_limit_of_the_challenge():
    """The same late echo: heard by cra from beyond 30 m in many episodes, and in none where the attacker falls silent in 10 ns."""
    heard, crashed = {}, {}
    for name in ("radar-following-v0", "radar-fast-attacker-v0"):
        spec = Spec("defence", "cra")
        attack = Spec("attack", "echo_delay:delay=60,trigger=near,threshold=50").make()
        trace = rollout(load_scenario(name).loop(spec.make(), spec.entry.uses), attack, keys("tune", range(60)))
        begins = trace.alarm & ~np.concatenate([np.zeros_like(trace.alarm[:1]), trace.alarm[:-1]])
        heard[name] = (begins & (trace.gap > 30.0)).any(axis=(0, 2)).mean()
        crashed[name] = trace.collided.any(axis=0).mean()
    assert heard["radar-following-v0"] > 0.2 and heard["radar-fast-attacker-v0"] == 0.0
    assert crashed["radar-following-v0"] < 0.85 < 0.95 < crashed["radar-fast-attacker-v0"]
