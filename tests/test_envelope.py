"""The learned safety envelope: what it learns, what it detects and what it cannot, and files that it refuses."""

import dataclasses
import json

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError, NotApplicable
from tailgate.cli import main
from tailgate.core.draws import keys
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.estimators.safe_set.envelope import (
    FOLDER,
    EnvelopeMemory,
    envelope_path,
    load_envelope,
    names_of,
    nth_largest,
    plan_of,
    ratios,
    sealed,
)
from tailgate.evaluation.stats import limits
from tailgate.play.trace import rollout
from tailgate.studies.envelope import Settings, Signals, learn, sampled, upper
from tailgate.studies.envelope_sources import from_log, from_scenarios, played

LOOSE = Settings(margin=0.1, rate=1e-2, unit="step")  # 299 held-out steps show it: one episode
NARROW = Settings(margin=0.0, rate=1e-3, unit="step")
SHIPPED = {"redundant": "redundant-two-v0", "car-following": "gusty-stop-and-go-v0"}


def sheet_of(z, u=None, settings=NARROW, held=None):
    """The envelope of one run z (S, s): also the held-out one, unless another is given."""
    z = np.asarray(z, float)
    u = np.zeros((len(z), 1)) if u is None else u
    signals = Signals(tuple(f"y{i + 1}" for i in range(z.shape[1])), (), 1, 0.1)

    def steps(values):
        return sampled(values, np.ones(values.shape, bool), u[: len(values)], np.arange(len(values)) == 0, np.zeros(len(values), int))

    found = learn(signals, steps(z), steps(z if held is None else held), settings)
    return sealed(sensors=signals.sensors, v2v=(), inputs=1, dt=0.1, made={}, invariants=tuple(found))


def bounds(sheet, weights):
    """The bounds of the template with these weights."""
    (one,) = (one for one in sheet.invariants if one.weights == weights and one.kind in ("reading", "change"))
    return one.bounds["any"]


def scores(sheet, z, u=None, arrived=None):
    """The largest ratio of every step of a run z (S, s)."""
    z = np.asarray(z, float)
    plan, out = plan_of(sheet, 1), []
    here = np.ones(z.shape, bool) if arrived is None else arrived
    memory = EnvelopeMemory(np.zeros((1, 1, z.shape[1])), np.zeros((1, 1, z.shape[1]), bool), np.zeros((1, 1, 0)))
    for k, row in enumerate(z):
        now, some = row[None, None], here[k][None, None]
        known = np.zeros((1, 1, 1)) if u is None else u[k][None, None]
        out.append(float(ratios(plan, memory, now, some, known).max()))
        memory = EnvelopeMemory(now, some, memory.recent)
    return np.array(out)


# -- what is learned


@pytest.mark.parametrize("margin", [0.0, 0.5, "gpd"])
def test_a_constant_signal_learns_itself(margin):
    """A tail fitted to nothing would widen it."""
    sheet = sheet_of(np.full((4000, 1), 7.25), settings=Settings(margin, rate=1e-3, unit="step"))
    assert bounds(sheet, {"y1": 1.0}) == (7.25, 7.25) and bounds(sheet, {"y1": 1.0, "last y1": -1.0}) == (0.0, 0.0)
    assert scores(sheet, [[7.25], [7.25]]).max() == 0.0 and scores(sheet, [[7.2501]])[0] > 1.0


def test_a_linear_relation_is_learned_exactly():
    rng = np.random.default_rng(0)
    y = rng.normal(0.0, 3.0, 5000)
    z = np.stack([y, 2.0 * y], axis=1)
    sheet = sheet_of(z)
    found = [one for one in sheet.invariants if one.kind in ("regression", "component") and set(one.weights) == {"y1", "y2"}]
    assert found
    for one in found:
        assert abs(one.weights["y1"] / one.weights["y2"] + 2.0) < 1e-12
        assert np.abs(one.bounds["any"]).max() < 1e-12
    assert scores(sheet, z).max() <= 1.0
    only = sheet.model_copy(update={"invariants": tuple(found)})
    assert scores(only, z).max() < 1e-3 and scores(only, z[:1] + np.array([1.0, 0.0]))[0] > 1e6


def test_a_ramp_without_noise_has_one_rate():
    sheet = sheet_of(0.25 * np.arange(4000.0)[:, None])
    assert bounds(sheet, {"y1": 1.0, "last y1": -1.0}) == (0.25, 0.25)
    assert scores(sheet, [[10.0], [10.25], [10.75]])[2] > 1.0 >= scores(sheet, [[10.0], [10.25], [10.5]]).max()


def test_bounds_depend_on_the_sign_of_the_input():
    """Braking lowers a speed, and accelerating raises it: either without the other is no attack, and both at once would hide one."""
    rng = np.random.default_rng(1)
    u = np.where(rng.random(12000) < 0.5, -1.0, 1.0)[:, None]
    z = np.cumsum(u * rng.uniform(0.5, 1.0, u.shape), axis=0)
    sheet = sheet_of(z, u)
    (one,) = (one for one in sheet.invariants if one.kind == "change")
    assert one.bounds["negative"][1] <= -0.5 and one.bounds["positive"][0] >= 0.5 and one.bounds["any"][0] < -0.5
    step, only = np.array([[0.0], [0.8]]), sheet.model_copy(update={"invariants": (one,)})
    assert scores(only, step, np.ones((2, 1)))[1] <= 1.0 < scores(only, step, -np.ones((2, 1)))[1]


def test_what_other_runs_leave_is_not_an_invariant():
    rng = np.random.default_rng(2)
    z = np.stack([rng.uniform(0.0, 1.0, 5000), rng.uniform(0.0, 1.0, 5000)], axis=1)
    other = z + np.array([0.0, 0.5])
    kept = [one for one in sheet_of(z, settings=Settings(0.5, rate=1e-3, unit="step"), held=other).invariants if one.kind == "reading"]
    assert [one.weights for one in kept] == [{"y1": 1.0}]
    with pytest.raises(InputError, match=r"held_out.*2995 held-out steps"):
        sheet_of(z, held=z[:100])
    with pytest.raises(InputError, match=r"none of \d+ invariants.*left"):
        sheet_of(z, held=z * 9.0 + 5.0)


def test_a_tail_reaches_where_a_normal_distribution_does():
    """The quantile at 1e-7 is 5.2 standard deviations; the largest of so few values lies at about 4.3."""
    values = np.random.default_rng(3).normal(size=100_000)
    assert values.max() < 4.8 < upper(values, Settings()) < 6.5
    assert upper(np.random.default_rng(3).uniform(size=100_000), Settings()) < 1.01  # it ends at 1


def test_missing_readings_end_no_invariant_that_does_not_need_them():
    rng = np.random.default_rng(4)
    z = np.stack([rng.uniform(0.0, 1.0, 5000), rng.uniform(5.0, 6.0, 5000)], axis=1)
    sheet, arrived = sheet_of(z), np.array([[True, True], [False, True]])
    assert scores(sheet, [[0.5, 5.5], [0.0, 5.5]], arrived=arrived)[1] <= 1.0  # a lost reading is no reading of 0
    assert scores(sheet, [[0.5, 5.5], [0.0, 9.5]], arrived=arrived)[1] > 1.0


def test_the_score_is_an_order_statistic():
    values = list(np.random.default_rng(5).normal(size=(6, 40)))
    for n in range(1, 7):
        np.testing.assert_array_equal(nth_largest(values, n), np.sort(values, axis=0)[-n])


# -- in the loop


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """An envelope of a few episodes, and the file."""
    path = tmp_path_factory.mktemp("learned") / "mine.json"
    sheet = from_scenarios(["stop-and-go-v0"], 2, 2, LOOSE)
    path.write_text(sheet.model_dump_json())
    assert load_envelope(path) == sheet
    return path


def alarms(text, scenario, attack, seeds, purpose="report", **threat):
    spec = Spec("defence", text)
    place = load_scenario(scenario).with_threat(**threat)
    trace = rollout(place.loop(spec.make(), spec.entry.uses), Spec("attack", attack).make(), keys(purpose, range(seeds)))
    return trace, trace.alarm[..., 0] & trace.live


@pytest.mark.long
def test_no_alarm_in_the_runs_that_it_was_learned_from(learned):
    trace, alarm = alarms(f"envelope:path={learned},count=1", "stop-and-go-v0", "none", 2, "train")
    assert not alarm.any() and trace.score.max() <= 1.0 and trace.score.max() > 0.5


@pytest.mark.long
@pytest.mark.parametrize("name", SHIPPED)
def test_fresh_clean_runs_leave_no_invariant_too_often(name):
    """No invariant is left surely more often than the rate that was asked for, if steps were independent. They are not."""
    sheet, place = load_envelope(envelope_path(tailgate.make_defence("envelope", path=name).path)), load_scenario(SHIPPED[name])
    samples = played(place, "report", range(50))
    signals = len(sheet.sensors) + len(sheet.v2v)
    z, last, u = np.split(samples.columns[:, None], [signals, 2 * signals], axis=-1)
    here, before = (samples.arrived[:, None, part] for part in (slice(signals), slice(signals, 2 * signals)))
    off = ratios(plan_of(sheet, 1), EnvelopeMemory(last, before, np.zeros((len(z), 1, 0))), z, here, u)[:, 0]
    left = np.count_nonzero(off > 1.0, axis=0)
    lowest, _ = limits(left, np.full(left.shape, len(z)), 0.01 / len(left))
    assert len(z) > 25_000 and (lowest < sheet.made["rate"]).all(), left.max()


@pytest.mark.long
def test_a_large_bias_is_detected_at_once_and_a_slow_ramp_never():
    """The required losing case: 0.01 m a step stays inside of every bound until the position is 4 m off."""
    place = {"scenario": "redundant-two-v0", "seeds": 20, "budget": 50}
    trace, alarm = alarms("envelope:path=redundant", attack="fdi:start_step=100,value=20", fdi_bound=30.0, **place)
    struck = (trace.kind != 0) & trace.live
    assert struck[99].all() and alarm[101].all() and not alarm[:99].any()  # with the third of three violations
    trace, alarm = alarms("envelope", "stop-and-go-v0", "fdi_ramp:start_step=100,rate=0.01,targets=[position]", 20, budget=None)
    error = np.abs(trace.estimate[..., 0, 0] - trace.truth[..., 0, 0])
    assert (trace.kind != 0)[99:499].all() and not alarm.any() and np.median(error.max(axis=0)) > 3.5


def test_one_violation_is_noise_and_three_of_five_are_an_attack():
    """The reading is refused at once; the alarm waits."""
    place = {"scenario": "redundant-two-v0", "seeds": 4, "budget": 50, "fdi_bound": 30.0}
    for length, loud in ((1, False), (3, True)):
        trace, alarm = alarms("envelope:path=redundant", attack=f"fdi:start_step=100,length={length},value=20", **place)
        assert alarm.any(axis=0).tolist() == [loud] * 4
        error = np.abs(trace.estimate[..., 0, 0] - trace.truth[..., 0, 0])[99:104]
        assert error.max() < 1.0  # 20 m off where one of them is believed


def test_a_system_with_other_signals_is_refused_by_name(learned):
    guard = tailgate.make_defence("envelope", path=learned)
    for scenario, field in (("redundant-two-v0", "sensors"), ("stop-and-go-fine-v0", "dt"), ("linear-dos-v0", "sensors")):
        with pytest.raises(NotApplicable, match=rf"defence envelope mine.json: {field}: .*as it was learned"):
            guard.prepare(load_scenario(scenario).brief().model)
    for wrong, said in (({"count": 6}, "at most the window"), ({"window": 2000, "count": 1}, "at most 1000"), ({"filter": "nothing"}, "filter"), ({"path": "nowhere"}, "car-following")):
        with pytest.raises(InputError, match=said):
            tailgate.make_defence("envelope", **wrong)


# -- files


def test_the_digest_of_a_row_is_that_of_the_file(learned, tmp_path):
    import hashlib

    assert Spec("defence", f"envelope:path={learned}").make().sources == [learned]
    assert tailgate.make_defence("envelope").sources == [FOLDER / "car-following.json"]
    assert Spec("defence", "envelope").digest == hashlib.sha256((FOLDER / "car-following.json").read_bytes()).hexdigest()


def changed(**fields):
    return lambda data: data | fields


def of_invariant(**fields):
    def change(data):
        return data | {"invariants": [data["invariants"][0] | fields, *data["invariants"][1:]]}

    return change


def resealed(data):
    return sealed(**{key: value for key, value in data.items() if key not in ("format", "sha256")}).model_dump(mode="json")


HOSTILE = {
    "another value": (changed(dt=0.2), "sha256.*damaged, or was changed by hand"),
    "another format": (changed(format="tailgate-envelope-9"), "format"),
    "another field": (changed(run="os.system"), "run"),
    "no invariants": (changed(invariants=[]), "invariants"),
    "a text for a number": (of_invariant(weights={"position": "1; import os"}), "weights"),
    "a number that is too large": (of_invariant(bounds={"any": [0.0, 1e300]}), "bounds"),
    "three bounds": (of_invariant(bounds={"any": [0.0, 1.0, 2.0]}), "bounds"),
    "another sign": (of_invariant(bounds={"imaginary": [0.0, 1.0]}), "bounds"),
    "an unknown signal": (lambda data: resealed(of_invariant(weights={"lidar": 1.0})(data)), "lidar.*one of position"),
    "crossed bounds": (lambda data: resealed(of_invariant(bounds={"any": [1.0, 0.0]})(data)), "smaller first"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_damaged_or_hostile_file_is_one_clear_error(case, learned, tmp_path):
    change, said = HOSTILE[case]
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(change(json.loads(learned.read_text()))))
    with pytest.raises(InputError, match=said) as caught:
        tailgate.make_defence("envelope", path=path)
    assert "\n" not in str(caught.value) and "bad.json" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b"\x80\x04\x95c__main__", b'{"format": NaN}', b"[" * 100_000, b'{"dt": 1, "dt": 2}'])
def test_what_is_no_envelope_is_refused(content, tmp_path):
    path = tmp_path / "bad.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match="envelope"):
        tailgate.make_defence("envelope", path=path)
    with pytest.raises(InputError, match="envelope"):
        tailgate.make_defence("envelope", path=tmp_path / "missing.json")


# -- the command


@pytest.mark.long
def test_a_log_and_its_scenario_teach_the_same(tmp_path):
    """Files and play have the same steps, at however many doses: the same invariants to the last bit, and damage is found."""
    pytest.importorskip("pyarrow")
    from tailgate.studies.log import write_log

    folder = tmp_path / "log"
    write_log("car-following-v0", folder, episodes=3, dev_episodes=3, scenarios=["thesis-ch4-v0"], doses=[10, 20], attacks=["fdi:start_step=60,value=3"])
    assert from_log(folder, None, LOOSE).invariants == from_scenarios(["thesis-ch4-v0"], 3, 3, LOOSE).invariants
    with pytest.raises(InputError, match="one of the log: thesis-ch4-v0"):
        from_log(folder, ["braking-v0"], LOOSE)
    held = json.loads((folder / "schema.json").read_text())
    file = folder / held["files"][0]["path"]
    file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(InputError, match="SHA-256"):
        from_log(folder, None, LOOSE)
    held["files"][0]["path"] = "../../elsewhere.parquet"
    (folder / "schema.json").write_text(json.dumps(held))
    with pytest.raises(InputError, match=r"log .*files.0.path.*elsewhere"):
        from_log(folder, None, LOOSE)
    (folder / "schema.json").write_text(json.dumps(held | {"defences": [], "files": []}))
    with pytest.raises(InputError, match="defences"):
        from_log(folder, None, LOOSE)
    (folder / "schema.json").write_text("{}")
    with pytest.raises(InputError, match=r"log .*: format"):
        from_log(folder, None, LOOSE)


def test_the_command_writes_what_it_prints(capsys, tmp_path):
    out = tmp_path / "mine.json"
    assert main(["learn-envelope", "--scenario", "thesis-ch4-v0", "--episodes", "30", "--held-out", "30", "--unit", "step", "--rate", "1e-3", "--margin", "0.2", "--out", str(out), "--json"]) == 0
    text = capsys.readouterr()
    assert json.loads(text.out) == json.loads(out.read_text()) and "learning: 100 %" in text.err
    sheet = load_envelope(out)
    assert sheet.made["from"] == {"thesis-ch4-v0": load_scenario("thesis-ch4-v0").config_hash} and sheet.made["margin"] == 0.2
    assert sheet.made["train"] == {"purpose": "train", "seeds": [0, 29], "steps": [4500]} and sheet.made["dev"]["purpose"] == "tune"
    assert names_of(sheet.sensors, 1)[-1] == "input 0"


@pytest.mark.parametrize("arguments, said", [
    (["--scenario", "stop-and-go-v0", "--held-out", "3"], "held_out: got 3; expected at least 59 episodes"),
    (["--scenario", "stop-and-go-v0", "--scenario", "redundant-two-v0"], "scenario redundant-two-v0: sensors"),
    (["--scenario", "stop-and-go-v0", "--scenario", "stop-and-go-v0"], "each once"),
    (["--scenario", "stop-and-go-v0", "--margin", "wide"], "--margin"),
    (["--scenario", "stop-and-go-v0", "--margin", "-1"], "margin: got -1.0"),
    (["--scenario", "stop-and-go-v0", "--tail", "2"], "tail"),
    (["--scenario", "stop-and-go-v0", "--rate", "nan"], "rate"),
    (["--scenario", "nowhere-v0"], "nowhere-v0"),
    (["--log", "/nowhere"], "a readable report of tailgate log"),
    ([], "at least one"),
])  # fmt: skip
def test_bad_input_is_refused_in_one_line(arguments, said, capsys, tmp_path):
    assert main(["learn-envelope", *arguments, "--out", str(tmp_path / "mine.json")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and not list(tmp_path.iterdir())
    assert dataclasses.asdict(Settings())["margin"] == "gpd"
