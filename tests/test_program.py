"""Programs: phases follow each other as the YAML says, every trigger plays with every kind, and mistakes are named."""

import re
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

import tailgate
from tailgate.agents.scripts.program import Phase, Program, Sheet
from tailgate.agents.scripts.triggers import TRIGGERS
from tailgate.agents.scripts.values import LAWS
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Kind
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.schema import as_data, canonical, fields_of
from tailgate.play.trace import rollout

ROOT = Path(__file__).parents[1]
ALL = ("dos_jam", "dos_hold", "dos_hold_fresh", "dropout", "fdi", "delay", "replay")
WIRES = ("position", "velocity", "leader_position", "leader_velocity", "acceleration")
BUILT_IN = sorted(path.stem for path in Path(str(files("tailgate.configs").joinpath("attacks"))).glob("*.yaml"))


@pytest.fixture
def write(tmp_path):
    """A program from YAML text."""

    def make(text, name="mine.yaml"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        return Spec("attack", str(tmp_path / name)).make()

    return make


@pytest.fixture
def sends(short, play, write):
    """The trace of a program against the Kalman filter."""

    def run(text, seeds=3, scenario="stop-and-go-v0", horizon=60, **threat):
        place = short(scenario, horizon=horizon, **({"onset": 1, "kinds": ALL, "targets": WIRES} | threat))
        return play(place, "kf", write(text), range(seeds), terminate=False)

    return run


def steps(trace, kind, row=0):
    return (np.flatnonzero(trace.kind[:, row] == kind) + 1).tolist()


VALUE = {"fdi": "-2", "dos_jam": "{name: uniform, low: -1, high: 1}", "delay": "3", "replay": "4"}
MINIMAL = {"steps": "at: [3, [7, 30]]", "chance": "probability: 0.3", "bursts": "share: 0.5", "near": "threshold: 90", "closing": "threshold: 0.1",
           "speed": "threshold: 20", "slow": "threshold: 30", "leader_braking": "threshold: 0", "time": "start: 9", "reading": "threshold: 20, latest: 30"}  # fmt: skip


@pytest.mark.thin(18)
@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("trigger", TRIGGERS)
def test_every_trigger_plays_with_every_kind(trigger, kind, short, loop_of, write):
    """Each pair plays: the kind takes effect, nothing is refused, and a row does not depend on its companions."""
    value = f", value: {VALUE[kind]}" if kind in VALUE else ""
    program = write(f"phases: [{{kind: {kind}, targets: [velocity], trigger: {{name: {trigger}, {MINIMAL[trigger]}}}{value}}}]")
    loop = loop_of(short("ornstein-uhlenbeck-v0", horizon=60, onset=1, kinds=(kind,), sees_measurement=trigger == "reading"), "kf")
    assert program.sees_measurement == (trigger == "reading")
    whole = rollout(loop, program, keys("train", range(5)), terminate=False)
    assert set(np.unique(whole.kind)) <= {0, Kind[kind.upper()]} and (whole.kind != 0).any() and not whole.refused.any()
    assert not whole.target[..., [0, 2, 3, 4]].any()
    assert rollout(loop, program, keys("train", [3]), terminate=False).trace_hash(0) == whole.trace_hash(3)


def test_phases_follow_each_other(sends):
    """Each phase is armed in the step after the one before has ended: by attacked steps, by its window, by its time."""
    trace = sends("""
phases:
  - {kind: fdi, value: -1, trigger: {name: time, start: 5}, length: 4}
  - {kind: dropout, trigger: {name: time, after: 3, window: 6}}
  - {kind: fdi, value: {name: ramp, rate: 0.5}, duration: 7, targets: [velocity]}
  - {kind: dos_jam, value: 0.5, trigger: {name: steps, at: [2, 40, [42, 43]]}}
""")
    assert steps(trace, Kind.DROPOUT) == list(range(12, 18))
    assert steps(trace, Kind.FDI) == [5, 6, 7, 8, *range(18, 25)]
    np.testing.assert_array_equal(trace.value[17:24, 0, 0, 1], 0.5 * np.arange(1, 8))  # counted from the opening of its phase
    assert steps(trace, Kind.DOS_JAM) == [40, 42, 43]


def test_the_last_phase_needs_no_end_and_a_program_ends(sends):
    """Without an end the last phase lasts; with one, nothing follows."""
    head = "phases:\n  - {kind: dropout, length: 3}\n"
    assert steps(sends(head + "  - {kind: fdi, value: 1}"), Kind.FDI) == list(range(4, 61))
    assert steps(sends(head + "  - {kind: fdi, value: 1, length: 2}"), Kind.FDI) == [4, 5]


def test_repeat(sends):
    """Phases are played again, with windows, counts and chains anew."""
    phases = "phases:\n  - {kind: fdi, value: {name: ramp, rate: 1, limit: 9}, length: 3}\n  - {kind: dropout, trigger: {name: time, after: 2, window: 2}}\n"
    twice, forever = sends(phases + "repeat: 2"), sends(phases + "repeat: forever")
    assert steps(twice, Kind.FDI) == [1, 2, 3, 8, 9, 10] and steps(twice, Kind.DROPOUT) == [6, 7, 13, 14]
    np.testing.assert_array_equal(twice.value[[0, 1, 2, 7, 8, 9], 0, 0, 0], [1, 2, 3, 1, 2, 3])
    assert steps(forever, Kind.FDI) == [k for k in range(1, 61) if (k - 1) % 7 < 3]


def test_rows_are_in_phases_of_their_own(sends):
    """Phases end by what each row sees: rows that meet the condition at other steps go on at other steps."""
    trace = sends("""
phases:
  - {kind: dropout, trigger: {name: chance, probability: 0.1}, length: 2}
  - {kind: fdi, value: 2, length: 4}
""", seeds=12)
    begins = set()
    for row in range(12):
        first = steps(trace, Kind.DROPOUT, row)
        assert len(first) == 2 and steps(trace, Kind.FDI, row) == list(range(first[1] + 1, first[1] + 5))
        begins.add(first[1])
    assert len(begins) > 4


def test_budget_duration_cooldown_and_end_are_respected(sends):
    """A program asks for nothing in vain, and `length` counts the steps in which it attacked."""
    text = "phases:\n  - {kind: fdi, value: 1, length: 6}\n  - {kind: dropout}\n"
    trace = sends(text, budget=15, duration=4, cooldown=3, end=50, onset=5)
    assert not trace.refused.any() and steps(trace, Kind.FDI) == [5, 6, 7, 8, 12, 13]
    assert steps(trace, Kind.DROPOUT) == [14, 15, 19, 20, 21, 22, 26, 27, 28]
    assert (np.flatnonzero(sends(text, end=20).kind[:, 0]) + 1).tolist() == list(range(1, 21))


def test_values_are_cut_at_the_bounds(sends):
    """Injection at fdi_bound and actuator_bound, jamming at jam_range, ages at whole steps within the memory: nothing is refused."""
    cases = {
        "fdi": (0.1, [-3.0, -3.0, -3.0, -3.0, -0.5], {"fdi_bound": 3.0, "actuator_bound": 0.5}),
        "dos_jam": (0.1, [-2.0, -2.0, -2.0, -2.0, -0.5], {"jam_range": (-2.0, 1.0), "actuator_bound": 0.5}),
        "delay": (0.1, [1.0] * 5, {}),
    }
    for kind, (_, lowest, threat) in cases.items():
        trace = sends(f"phases: [{{kind: {kind}, value: {{name: uniform, low: -80, high: 80}}}}]", **threat)
        assert not trace.refused.any() and (trace.kind != 0).all()
        np.testing.assert_array_equal(trace.value.min(axis=(0, 1, 2)), lowest)
        if kind == "delay":
            assert trace.value.max() == 50.0 and (trace.value == np.floor(trace.value)).all()


def test_values_and_probabilities_per_wire(sends):
    """A law for each wire makes these wires the targets; each wire is hit with its own probability, independently of the values."""
    trace = sends("""
phases:
  - kind: fdi
    value: {velocity: {name: gaussian, mean: 1.0, sd: 0.5}, position: -3}
    probability: {velocity: 0.25}
""", seeds=100)
    assert not trace.target[..., 2:].any() and trace.target[..., 0].all()
    hit = trace.target[..., 0, 1]
    assert abs(hit.mean() - 0.25) < 5 * np.sqrt(0.1875 / hit.size)
    assert set(np.unique(trace.value[..., 0])) == {-3.0}
    values = trace.value[..., 0, 1][hit]
    assert abs(values.mean() - 1.0) < 5 * 0.5 / np.sqrt(values.size) and abs(values.std() / 0.5 - 1) < 5 / np.sqrt(2 * values.size)


@pytest.mark.parametrize("text, message", [
    ("about: nothing", r"program mine\.yaml\.phases: got None; expected at least one phase"),
    ("phases: []", "at least one phase"), ("phases: 3", r"program mine\.yaml\.phases"),
    ("- kind: fdi", "a YAML mapping"), ("phases: [", "valid YAML"), ("phases: !!python/object:os.system []", "valid YAML"),
    ("phases: [{kind: fdi}]\nrepat: 2", r"program mine\.yaml: unknown field: got 'repat'.*did you mean 'repeat'"),
    ("phases: [fdi]", r"phase 1: got 'fdi'; expected a mapping"),
    ("phases: [{kind: dropout, length: 2}, {kind: fdi, valu: 3}]", r"mine\.yaml, phase 2: unknown field: got 'valu'; .*did you mean 'value'.*targets"),
    ("phases: [{kind: jam, value: 1}]", r"phase 1\.kind: got 'jam'.*dos_jam"),
    ("phases: [{kind: fdi}]", r"phase 1\.value: got None; expected a law"), ("phases: [{kind: dropout, value: 3}]", r"phase 1\.value: got 3; expected no value"),
    ("phases: [{kind: fdi, value: {name: gausian}}]", r"phase 1\.value\.name: got 'gausian'.*did you mean 'gaussian'.*constant"),
    ("phases: [{kind: fdi, value: {name: gaussian, sd: -1}}]", r"phase 1\.value\.sd: got -1"),
    ("phases: [{kind: fdi, value: {name: gamma, shape: 0.7}}]", r"phase 1\.value\.shape: got 0\.7.*multiple of 0\.5"),
    ("phases: [{kind: fdi, value: {name: uniform, low: 2, high: 1}}]", r"phase 1\.value\.low: got 2\.0; expected at most high"),
    ("phases: [{kind: fdi, value: {low: 2, high: {x: 1}}}]", r"phase 1\.value: got \{'x': 1\}; expected one law per wire"),
    ("phases: [{kind: fdi, value: [1, 2]}]", r"phase 1\.value: got \[1, 2\]"), ("phases: [{kind: fdi, value: true}]", r"phase 1\.value: got True"),
    ("phases: [{kind: fdi, value: .nan}]", r"phase 1\.value\.value: got nan"),
    ("phases: [{kind: fdi, value: 1, trigger: soon}]", r"phase 1\.trigger\.name: got 'soon'; expected one of .*leader_braking"),
    ("phases: [{kind: fdi, value: 1, trigger: {name: near, treshold: 4}}]", r"phase 1\.trigger: unknown field.*'threshold'"),
    ("phases: [{kind: fdi, value: 1, length: 0}]", r"phase 1\.length: got 0"),
    ("phases: [{kind: fdi, value: 1, probability: 1.5}]", r"phase 1\.probability"),
    ("phases: [{kind: fdi, value: 1}, {kind: dropout}]", r"phase 1: got 'a phase without end'"),
    ("phases: [{kind: fdi, value: 1}]\nrepeat: forever", r"phase 1: got 'a phase without end'"),
])  # fmt: skip
def test_mistakes_are_input_errors(text, message, write):
    """File, phase and field are named, with what exists."""
    with pytest.raises(InputError, match=message):
        write(text)


@pytest.mark.parametrize("text, message", [
    ("phases: [{kind: fdi, value: 1, targets: [sonar]}]", r"phase 1\.targets: got 'sonar'; expected one of .*velocity"),
    ("phases: [{kind: fdi, value: {speed: 1}}]", r"phase 1\.targets: got 'speed'"),
    ("phases: [{kind: fdi, value: {position: 1}, targets: [position, velocity]}]", r"phase 1\.value: got \['position'\]; expected .*'velocity' has none"),
    ("phases: [{kind: fdi, value: {position: 1, sonar: 2}, targets: [position]}]", r"phase 1\.value: got 'sonar'"),
    ("phases: [{kind: dropout, probability: {sonar: 0.5}}]", r"phase 1\.probability: got 'sonar'"),
])  # fmt: skip
def test_what_does_not_fit_the_scenario_is_an_input_error(text, message, write, short):
    """Wires that do not exist are named when the scenario is known."""
    with pytest.raises(InputError, match=message) as caught:
        write(text).prepare(short().brief())
    assert not isinstance(caught.value, NotApplicable)


@pytest.mark.parametrize("text, message", [
    ("phases: [{kind: dropout, length: 3}, {kind: replay, value: 4}]", r"phase 2: threat_model\.kinds.*grants replay"),
    ("phases: [{kind: dropout, trigger: {name: bursts, duration: 0.01, share: 0.5}}]", r"phase 1: trigger bursts\.duration: got 0\.01"),
    ("phases: [{kind: fdi, value: 1, targets: [position, acceleration]}]", r"phase 1: threat_model\.targets: got \['position', 'velocity'\].*acceleration"),
])  # fmt: skip
def test_what_is_not_granted_is_not_applicable(text, message, write, short):
    """What a program needs beyond the threat model, or bursts that are shorter than a step: its rows are skipped, with the reason."""
    with pytest.raises(NotApplicable, match=message):
        write(text).prepare(short().brief())


def test_names_and_files():
    """A bare name is a built-in program, anything in .yaml a file; both say what is missing."""
    assert Program(Path("burst_jamming")).sheet.about == Program(Path(str(ROOT / "configs/attacks/burst_jamming.yaml"))).sheet.about
    with pytest.raises(InputError, match=r"program: got 'burst_jaming'; expected one of .*did you mean 'burst_jamming'"):
        tailgate.make_attack("program", path="burst_jaming")
    with pytest.raises(InputError, match=r"program nowhere\.yaml: got 'nowhere\.yaml'; expected a readable YAML file"):
        Spec("attack", "nowhere.yaml").make()


def test_what_the_file_says_is_part_of_the_parameters(write):
    """Two files of one name and other words give other parameters, and other digests of the text that names them."""
    text = "phases: [{kind: fdi, value: %s}]"
    program = write(text % 1)
    one, digest = canonical(program), Spec("attack", str(program.path)).digest
    assert as_data(program)["path"].startswith("mine.yaml#")
    other = write(text % 2)
    assert canonical(other) != one and Spec("attack", str(other.path)).digest != digest


def test_a_file_is_evaluated_like_any_attack(write, tmp_path):
    """Rows name the file and its digest, and say how often it attacked."""
    write("phases: [{kind: dropout, trigger: {name: time, start: 60}, length: 7}]")
    (row,) = tailgate.evaluate(defences=["kf"], attacks=[str(tmp_path / "mine.yaml")], scenarios=["stop-and-go-v0"], doses=[None], seeds=1)
    assert row["attack_steps"] == 7 and row["status"] == "ok" and len(row["attack_digest"]) == 64


@pytest.mark.thin(6)
@pytest.mark.parametrize("name", BUILT_IN)
def test_built_in_programs_play(name, short, play):
    """Every phase of a built-in program comes in some of the episodes, nothing is refused, and it says what it does."""
    program = Program(Path(name))
    assert program.sheet.about.endswith(".")
    of_platoons = any("distance" in phase.targets for phase in program.sheet.phases)
    scenario, defence = ("platoon-gusty-v0", "dkf") if of_platoons else ("stop-and-go-v0", "chi2_kf")
    trace = play(short(scenario, horizon=600, onset=50, kinds=ALL), defence, program, range(12), terminate=False)
    kinds = {int(Kind[phase.kind.upper()]) for phase in program.sheet.phases}
    assert set(np.unique(trace.kind)) == {0} | kinds and not trace.refused.any()


def _blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / "docs/attacks.md").read_text(encoding="utf-8"), flags=re.S)


def test_the_program_of_the_documentation_plays(sends):
    """docs/attacks.md's example, as it stands: each of its kinds takes effect."""
    trace = sends(_blocks("yaml")[0], seeds=20, horizon=600, onset=50, targets=())
    assert {Kind.REPLAY, Kind.FDI, Kind.DROPOUT} <= {Kind(k) for k in np.unique(trace.kind)} and not trace.refused.any()


def test_the_documentation_lists_what_there_is():
    """Every attack, trigger, law, field and built-in program is in docs/attacks.md."""
    text = (ROOT / "docs/attacks.md").read_text(encoding="utf-8")
    parts = [*TRIGGERS.values(), *LAWS.values(), Phase, Sheet]
    names = {*tailgate.list_attacks(), *TRIGGERS, *LAWS, *BUILT_IN} | {field for cls in parts for field in fields_of(cls)}
    assert [name for name in sorted(names) if f"`{name}`" not in text] == []
