"""Defences over recordings: the figures are those of the filters themselves, and attacks are laid on top."""

import json

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core.registry import Spec
from tailgate.core.threat import ThreatModel
from tailgate.play.trace import rollout
from tailgate.roads.detect_log import Settings, at_hours, detect, draw, figures, smoothed, synthetic, threat_of, write_parquet
from tailgate.roads.readers import mapping_of, read
from tailgate.roads.recording import Raw, Recording, checked
from tailgate.roads.replayed import Noise, cut, loop_over, rows

from . import logs


def _recording(seed=0, seconds=300.0, missing=(), sd=(0.15, 0.1)):
    """A car behind another with readings of known noise; and the true gap."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, seconds, 0.1)
    lead, own = (20.0 + 2.0 * np.sin(0.3 * (t - late)) for late in (0.0, 1.2))
    x, y = (np.concatenate([[0.0], np.cumsum(0.05 * (v[1:] + v[:-1]))]) for v in (lead, own))
    gap = 27.0 + x - y
    read = gap + sd[0] * rng.standard_normal(len(t))
    read[list(missing)] = np.nan
    return checked(Raw("made", t, read, lead - own + sd[1] * rng.standard_normal(len(t)), own), "file"), gap


def test_a_replay_is_the_filter_over_the_readings():
    """A Kalman filter written here, sample by sample, gives the same estimates."""
    recording, _ = _recording(seconds=40.0, missing=range(100, 110))
    held = cut(recording, Noise(), None)
    loop = loop_over(held, Spec("defence", "kf").make(), ("measurements",), ThreatModel())
    trace = rollout(loop, Spec("attack", "none").make(), rows(held))
    model, part = loop.model, recording.segments[0]
    x = np.array([part.gap[0], part.relative_speed[0], 0.0, part.speed[0]])
    P = np.diag([1.0, 0.25, 0.25, 1e-6])
    for k in range(1, len(part.gap)):
        x, P = model.A @ x + model.B[:, 0] * part.speed[k], model.A @ P @ model.A.T + model.Q
        if part.seen[k]:
            C = model.C[0]
            K = P @ C.T @ np.linalg.inv(C @ P @ C.T + model.R[0])
            x, P = x + K @ (np.array([part.gap[k], part.relative_speed[k]]) - C @ x), (np.eye(4) - K @ C) @ P
        assert np.abs(trace.estimate[k - 1, 0, 0] - x).max() < 1e-8, k
        assert trace.valid[k - 1, 0, 0].all() == part.seen[k]


def test_both_engines_replay_the_same_bits():
    recording, _ = _recording(seconds=60.0, missing=range(100, 110))
    held = cut(recording, Noise(), 20.0)
    guard = Spec("defence", "chi2_kf")
    loop = loop_over(held, guard.make(), guard.entry.uses, threat_of(Settings(), 0.1, 199))
    attack = Spec("attack", "fdi:start_step=90,value=4").make()
    fast, plain = (rollout(loop, attack, rows(held), plain=plain) for plain in (False, True))
    assert [fast.trace_hash(i) for i in range(3)] == [plain.trace_hash(i) for i in range(3)] and (plain.kind != 0).any()


@pytest.mark.long
def test_the_smoother_is_nearer_to_the_truth_than_the_filter():
    recording, gap = _recording()
    out, played = detect([recording], ["kf"])
    smooth = smoothed(cut(recording, Noise(), None))[0, 50:, 0] - gap[50:]
    filtered = played[0].trace.estimate[49:, 0, 0, 0] - gap[50:]
    assert smooth.std() < 0.7 * filtered.std() and filtered.std() < 0.6 * 0.15
    assert out[0]["gap_error"] == pytest.approx(filtered.std(), rel=0.35)


def test_a_constant_gap_is_smoothed_to_itself():
    """Its prior is that of the first reading. A prior one step earlier made 30.003 m of the first gap, and -0.0025 m/s of no speed."""
    t = np.arange(200) / 10.0
    part = checked(Raw("constant", t, np.full(200, 30.0), np.zeros(200), np.full(200, 20.0)), "file")
    np.testing.assert_allclose(smoothed(cut(part, Noise(), None))[0], [[30.0, 0.0]] * 200, atol=1e-9)


@pytest.mark.long
def test_a_piece_is_smoothed_alone_as_next_to_a_longer_one():
    long, short = (_recording(seconds=seconds)[0] for seconds in (60.0, 30.0))
    both = Recording("two", 0.1, (short.segments[0], long.segments[0]))
    smooth, n = smoothed(cut(both, Noise(), None)), len(short.segments[0].gap)
    assert np.array_equal(smooth[0, :n], smoothed(cut(short, Noise(), None))[0]) and np.isnan(smooth[0, n:]).all()
    assert np.array_equal(smooth[1], smoothed(cut(long, Noise(), None))[0])


def test_false_alarms_are_counted():
    """Of a chi-square test at the level that one in 50 readings exceeds, on noise as it is told."""
    recording, _ = _recording(seconds=1200.0)
    out, played = detect([recording], ["chi2_kf:eta=7.824"])
    row, alarm = out[0], played[0].trace.alarm[50:, 0, 0]
    assert row["alarm_share"] == pytest.approx(alarm.mean(), rel=0.02) and 0.005 < row["alarm_share"] < 0.06
    rises = int((alarm[1:] & ~alarm[:-1]).sum())
    assert len(row["alarm_times"]) == row["alarms"] and row["alarm_times"][0] > 5.0 and row["alarm_times"] == sorted(row["alarm_times"])
    assert abs(row["alarms"] - rises) <= 1 and row["alarms_per_hour_low"] < row["alarms_per_hour"] < row["alarms_per_hour_high"]
    assert row["hours"] == pytest.approx((1200.0 - 5.0) / 3600.0, rel=1e-3)


@pytest.mark.long
def test_an_attack_is_seen_or_not_and_the_delay_is_from_its_first_step():
    recording, _ = _recording()
    out, played = detect([recording], ["chi2_kf", "kf"], ["fdi:start_step=150,value=6", "fdi_ramp:start_step=150,rate=0.2"])
    held = {(row["defence"], row["attack"].partition(":")[0]): row for row in out}
    at_once, slow = held["chi2_kf", "fdi"], held["chi2_kf", "fdi_ramp"]
    assert at_once["attacked"] == 5 and at_once["detected"] == 5 and at_once["delay"] == 0.0
    assert slow["detected"] == 5 and 0.1 <= slow["delay"] <= 3.0
    assert held["kf", "fdi"]["detected"] == 0 and held["kf", "fdi"]["delay"] is None
    assert held["kf", "fdi"]["gap_error_attacked"] > 2.0 > held["kf", "none"]["gap_error"]
    attacked = next(p for p in played if p.attack.startswith("fdi:")).trace
    assert ((attacked.kind != 0).sum(axis=0) == 40).all()  # 4 s


def test_settling_and_the_end_of_a_piece_do_not_count():
    recording, _ = _recording(seconds=30.0)
    _, played = detect([recording], ["always_alarm"])
    row = figures(played[0], 0.1)
    assert row["alarm_share"] == 1.0 and row["hours"] == pytest.approx(24.9 / 3600.0) and row["alarms"] == 1  # on when they begin to count


def test_an_alarm_that_was_on_before_the_attack_is_told(capsys):
    assert main(["detect-log", "asta-braking", "--vehicle", "5", "--defence", "always_alarm", "--attack", "fdi:start_step=150,value=6", "--json"]) == 0
    (row,) = (one for one in json.loads(capsys.readouterr().out) if one["attack"] != "none")
    assert row["alarmed_before"] == row["detected"] == row["attacked"] > 0
    assert main(["detect-log", "asta-braking", "--vehicle", "5", "--defence", "always_alarm", "--attack", "fdi:start_step=150,value=6"]) == 0
    assert f"{row['attacked']} on" in " ".join(capsys.readouterr().out.split())


def test_the_threshold_of_a_wanted_rate_on_the_synthetic_road():
    found = at_hours("chi2_kf", 0.1, Noise(), 0.02, onsets=60)
    assert found["wanted_hours"] == 0.02 and 5.0 < found["threshold"] < 40.0
    assert found["fresh"]["low"] < 0.03 and found["fresh"]["high"] > 0.013
    scenario = synthetic(0.1, Noise())
    assert scenario["sensor"]["late"] == 0 and scenario["manoeuvre"]["name"] == "stop_and_go"


def test_the_command(tmp_path, capsys):
    pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    plot, rows_at = tmp_path / "a.png", tmp_path / "a.parquet"
    arguments = ["detect-log", "asta-braking", "--vehicle", "5", "--defence", "chi2_kf", "--defence", "safe_state", "--attack", "fdi:start_step=150,value=6"]
    assert main([*arguments, "--json", "--plot", str(plot), "--parquet", str(rows_at)]) == 0
    held = json.loads(capsys.readouterr().out)
    good = [row for row in held if row["status"] == "ok"]
    assert {row["recording"] for row in held} == {"car 5"} and len(held) == 4 and len(good) >= 2
    assert plot.read_bytes().startswith(b"\x89PNG")
    table = pq.read_table(rows_at)
    mine = table.filter((table["defence"].to_numpy() == "chi2_kf") & (table["attack"].to_numpy() == "none"))
    assert mine.num_rows == 1200 and np.abs(np.diff(mine["t"].to_numpy()) - 0.1).max() < 1e-6
    assert main(arguments[:6]) == 0
    assert "open loop; alarms within 5 s count once" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.parametrize("form, start", [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_the_picture_is_a_vector_where_its_name_ends_so(form, start, tmp_path):
    """And the same bytes each time."""
    run = ["detect-log", "asta-braking", "--vehicle", "5", "--defence", "kf", "--quiet", "--plot"]
    files = [tmp_path / f"{name}.{form.upper()}" for name in "ab"]
    assert [main([*run, str(path)]) for path in files] == [0, 0]
    assert files[0].read_bytes().startswith(start) and files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize("arguments, words", [
    (["nowhere.csv", "--defence", "kf"], "file: got 'nowhere.csv'"), (["asta-braking", "--defence", "kff"], "kff"),
    (["asta-braking", "--defence", "kf", "--vehicle", "9"], "--vehicle: got '9'"), (["asta-braking", "--defence", "kf", "--format", "xls"], "--format: got 'xls'"),
    (["us06", "--defence", "kf"], "a car that follows"), (["asta-braking", "--defence", "kf", "--attack", "dos_hold:start_step=150", "--window", "500"], "--window sets it"),
    (["asta-braking", "--defence", "kf", "--window", "1"], "--window: got 1.0"), (["asta-braking", "--defence", "kf", "--range-sd", "0"], "--range-sd: got 0.0"),
    (["asta-braking", "--defence", "kf", "--hours", "-1"], "--hours: got -1.0"), (["asta-braking", "--defence", "kf", "--threat", "fdi"], "--threat"),
    (["asta-braking", "--defence", "kf", "--threat", "fdi_bound=-1"], "threat_model.fdi_bound"), (["asta-braking", "--defence", "kf", "--map", "x=y"], "--map"),
    (["asta-braking", "--defence", "kf", "--plot", "dl"], "--plot: got 'dl'; expected a file name that ends in .png, .svg, .pdf"),
])  # fmt: skip
def test_bad_input_is_refused(arguments, words, capsys):
    assert main(["detect-log", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_nothing_to_replay_is_refused():
    with pytest.raises(InputError, match="a recording and a defence"):
        detect([], ["kf"])


def test_a_file_and_the_trace_of_the_package_agree(tmp_path):
    from tailgate.core.traces import trace

    held = trace("asta-braking")
    names = {"t": "Time"} | {f"speed{i}": f"Speed{i}" for i in range(1, 6)} | {f"gap{i}": f"IVS{i}" for i in range(1, 5)}
    path = tmp_path / "a.csv"
    path.write_text(logs.table(**{names[key]: value for key, value in held.items()}), encoding="utf-8")
    for mine, theirs in zip(read(str(path)), read("asta-braking"), strict=True):
        assert np.array_equal(mine.segments[0].gap, theirs.segments[0].gap)


def test_a_recording_without_a_name_has_that_of_its_file(tmp_path, capsys):
    t = np.arange(200) * 0.1
    path = tmp_path / "drive.csv"
    path.write_text("t,gap,speed,relative_speed\n" + "".join(f"{x:.1f},{30 + np.sin(x):.4f},20.0,{np.cos(x):.4f}\n" for x in t))
    columns = [word for name in ("t", "gap", "speed", "relative_speed") for word in ("--map", f"{name}={name}")]
    assert main(["detect-log", str(path), "--defence", "kf", *columns]) == 0
    said = capsys.readouterr()
    assert "drive.csv" in said.out and "no unit is named in gap=gap, speed=speed, relative_speed=relative_speed:" in said.err
    units = [f"{text}:{'m' if text == 'gap=gap' else 'm/s'}" if "=" in text and text != "t=t" else text for text in columns]
    assert main(["detect-log", str(path), "--defence", "kf", *units, "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)[0]["recording"] == "drive.csv" and "no unit" not in said.err and "typical" not in said.err
    path.write_text(path.read_text().replace(",20.0,", ",72.0,"))  # km/h, next to a relative speed in m/s
    assert main(["detect-log", str(path), "--defence", "kf", *units]) == 0
    assert "drive.csv: a typical own speed of 72 m/s is 259 km/h" in " ".join(capsys.readouterr().err.split())
    assert mapping_of(["gap=gap:m", "speed=v:raw"]) == (("gap", "gap", "m"), ("speed", "v:raw", ""))  # a column's name may have a colon


@pytest.mark.long
def test_replays_are_written(tmp_path):
    pytest.importorskip("pyarrow")
    recording, _ = _recording(seconds=60.0)
    _, played = detect([recording], ["kf"])
    assert write_parquet(tmp_path / "x.parquet", played) == 599 and draw(played[0]).startswith(b"\x89PNG")
