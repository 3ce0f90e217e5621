"""Metrics: known answers on hand-made traces, undefined where they have no meaning, the same bits in every batch."""

import math
from dataclasses import replace

import numpy as np
import pytest

import tailgate
from tailgate.core.scenario import load_scenario
from tailgate.play.metrics import METRICS, UNITS, measure, metric, unit_in
from tailgate.play.trace import Trace

DT = 0.5
MODEL = replace(load_scenario("stop-and-go-v0").brief().model, dt=DT)


def trace(steps=4, length=None, first=None, **signals):
    """A trace of one episode; each signal is a list over steps (or a constant)."""
    zeros = dict(gap=50.0, speed=10.0, accel=0.0, lead_speed=10.0, rear_gap=20.0, rear_speed=10.0, position=0.0)
    flags = dict(kind=0, alarm=False, refused=False, collided=False, rear_collided=False)
    assert set(signals) <= {*zeros, *flags, "error", "speed_error", "probe"}
    column = {name: np.broadcast_to(np.asarray(signals.get(name, value)), steps).copy() for name, value in (zeros | flags).items()}
    out = {name: column[name].astype(float)[:, None, None] for name in zeros}
    out |= {name: column[name][:, None] for name in ("kind", "refused", "collided", "rear_collided")}
    out["alarm"] = column["alarm"][:, None, None]
    out["probe"] = np.broadcast_to(np.asarray(signals.get("probe", True)), steps).astype(bool).copy()[:, None, None]
    out["truth"] = np.full((steps, 1, 1, 3), 7.0)
    out["estimate"] = out["truth"].copy()
    for i, name in enumerate(("error", "speed_error")):
        out["estimate"][:, 0, 0, i] += np.broadcast_to(signals.get(name, 0.0), steps)
    begin = {name: np.array([[(first or {}).get(name, value)]], float) for name, value in zeros.items()}
    return Trace(MODEL, steps, np.array([steps if length is None else length]), out, begin, lambda v: 5.0 + 3.0 * v)


def value(name, *arguments, **signals):
    got = measure(trace(*arguments, **signals))[name]
    assert got.shape == (1,) and got.dtype == np.float64
    return got[0]


CASES = {
    "collided": [
        ({"collided": [0, 0, 0, 1]}, 1.0), ({}, 0.0), ({"collided": [0, 0, 0, 1], "length": 3}, 0.0), ({"rear_collided": 1}, 0.0),
    ],
    "muted_steps": [({}, 0.0), ({"probe": [1, 0, 0, 1]}, 2.0), ({"probe": [1, 0, 0, 0], "length": 2}, 1.0)],
    "rear_collided": [({"rear_collided": [0, 0, 0, 1]}, 1.0), ({"collided": 1}, 0.0)],
    "crashed": [({"rear_collided": [0, 0, 0, 1]}, 1.0), ({"collided": [0, 0, 0, 1]}, 1.0), ({}, 0.0)],
    "min_gap": [({"gap": [9, 4, 6, 1]}, 1.0), ({"gap": [9, 4, 6, 1], "length": 3}, 4.0), ({"first": {"gap": 2.5}}, 2.5)],
    "impact_speed": [
        ({"collided": [0, 0, 0, 1], "speed": [10, 9, 8, 7], "lead_speed": 2.0}, 5.0), ({}, None), ({"rear_collided": 1}, None),
        ({"collided": [0, 1, 1, 1], "speed": [10, 9, 8, 7], "lead_speed": 2.0}, 7.0), ({"collided": 1, "speed": 1.0}, 0.0),
    ],
    "min_ttc": [
        ({"speed": [10, 12, 14, 11], "gap": [9, 6, 6, 6]}, 1.5), ({}, 100.0), ({"speed": 10.01}, 100.0), ({"speed": 12, "gap": -1}, 0.0),
    ],
    "rmse_position": [({"error": [3, 4, 3, -4]}, math.sqrt(12.5)), ({"error": [3, -3, 90, 90], "length": 2}, 3.0)],
    "rmse_velocity": [({"speed_error": [1, 1, 1, 5]}, math.sqrt(7.0))],
    "max_error": [({"error": [3, -4, 2, 0]}, 4.0), ({"error": [3, -4, 9, 0], "length": 2}, 4.0)],
    "final_error": [({"error": [3, -4, 2, 0]}, 0.0), ({"error": [3, -4, 9, 0], "length": 2}, 4.0)],
    "recovery_time": [
        ({"kind": [0, 5, 0, 0], "gap": [35, 80, 38, 36.9]}, 1.0), ({"kind": [0, 5, 0, 0], "gap": [35, 35, 33, 37]}, 0.5),
        ({"kind": [0, 5, 0, 0]}, None), ({"gap": 35}, None), ({"kind": [0, 0, 0, 5], "gap": 35}, None),
        ({"kind": [0, 5, 0, 0], "gap": [35, 80, 80, 35], "length": 3}, None),
        ({"kind": [5, 0, 0, 0], "gap": [35, 35, 80, 35]}, 1.5), ({"kind": [5, 0, 0, 0], "gap": 35, "collided": [0, 0, 0, 1]}, None),
    ],
    "detection_delay": [
        ({"kind": [0, 5, 0, 5], "alarm": [1, 0, 0, 1]}, 2.0), ({"kind": [0, 5, 0, 0], "alarm": [0, 1, 1, 0]}, 0.0),
        ({"kind": [0, 5, 5, 5]}, None), ({"alarm": 1}, None), ({"kind": [0, 5, 5, 5], "alarm": [1, 0, 0, 0]}, None),
        ({"kind": [0, 5, 5, 5], "alarm": [0, 0, 0, 1], "length": 3}, None),
    ],
    "missed_deadline": [
        ({"kind": [0, 5, 0, 0], "alarm": [0, 0, 1, 0]}, 0.0), ({"kind": [0, 5, 0, 0]}, 1.0), ({}, None), ({"alarm": 1}, None),
        ({"steps": 14, "kind": [5] + 13 * [0], "alarm": 10 * [0] + [1, 0, 0, 0]}, 0.0),
        ({"steps": 14, "kind": [5] + 13 * [0], "alarm": 11 * [0] + [1, 0, 0]}, 1.0),
    ],
    "alarm_onsets": [({"alarm": [1, 0, 1, 1]}, 2.0), ({"alarm": 1}, 1.0), ({}, 0.0), ({"alarm": [1, 0, 1, 1], "length": 2}, 1.0)],
    "alarm_rate": [({"alarm": [1, 0, 1, 1]}, 0.75), ({"alarm": [1, 0, 1, 1], "length": 2}, 0.5)],
    "time_gap_inflation": [({"gap": 38.5}, 0.1), ({"gap": [35, 70, 35, 0], "length": 2}, 0.5), ({"gap": [35, 0, 35, 70]}, 0.0)],
    "distance_travelled": [
        ({"position": [2, 4, 7, 9], "first": {"position": 1.0}}, 8.0), ({"position": [2, 4, 7, 9], "length": 2}, 4.0),
    ],
    "max_decel": [({"accel": [-3, 2, -1, 0]}, 3.0), ({"accel": 2.0}, 0.0), ({"accel": [-3, 2, -9, 0], "length": 2}, 3.0)],
    "rms_jerk": [({"accel": [1, 1, 0, 0], "first": {"accel": 0.0}}, math.sqrt(2.0)), ({"accel": 2.0, "first": {"accel": 2.0}}, 0.0)],
    "string_gain": [
        ({"lead_speed": [11, 12, 13, 14], "accel": 1.0}, 0.5), ({"lead_speed": [11, 12, 13, 14], "accel": [2, -2, 9, 9], "length": 2}, 1.0),
        ({"accel": 3.0}, None), ({"lead_speed": [9, 8, 7, 6], "accel": [0, 0, 0, 4]}, 1.0),
    ],
    "attack_steps": [({"kind": [1, 0, 5, 2]}, 3.0), ({"kind": [1, 0, 5, 2], "length": 2}, 1.0), ({}, 0.0)],
    "refused_commands": [({"refused": [1, 0, 1, 1]}, 3.0), ({"refused": [1, 0, 1, 1], "length": 3}, 2.0)],
}  # fmt: skip


@pytest.mark.parametrize("name, case", [(name, case) for name, cases in CASES.items() for case in cases])
def test_known_answers(name, case):
    """A hand-made episode gives the number worked out by hand; None where the metric is undefined."""
    signals, want = case
    got = value(name, **signals)
    assert math.isnan(got) if want is None else got == pytest.approx(want, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("name, case", [(name, case) for name, cases in CASES.items() for case in cases])
def test_what_follows_the_end_of_an_episode_does_not_count(name, case, same_bits):
    """A companion that lives longer pads the episode with steps that are not its own: no metric moves by a bit."""
    alone = trace(**case[0])
    padded = {}
    for key, signal in alone.signals.items():
        rest = np.full((3, *signal.shape[1:]), 1, signal.dtype) if signal.dtype != float else np.full((3, *signal.shape[1:]), -1e9)
        padded[key] = np.concatenate([signal, rest])
    longer = Trace(MODEL, alone.horizon + 3, alone.length, padded, alone.first, alone.desired_gap)
    assert same_bits(measure(longer)[name], measure(alone)[name])


def test_every_metric_has_a_known_answer_and_a_unit():
    """No metric without a case above, a unit and a sentence."""
    assert set(METRICS) == set(CASES) == set(UNITS)
    assert all(METRICS[name].__doc__ and UNITS[name] for name in METRICS)


def test_an_error_has_no_unit_where_nothing_drives():
    """A car errs in metres; a network's error is a norm over states of any unit. Other metrics keep theirs."""
    network = load_scenario("thesis-ch5-v0").brief().model
    assert [unit_in(name, MODEL) for name in ("max_error", "crashed")] == ["m", "0/1"]
    assert [unit_in(name, network) for name in ("max_error", "rmse_position", "crashed")] == ["-", "-", "0/1"]


@pytest.mark.thin(2)
@pytest.mark.parametrize("attack", ["fdi_ramp", "dos_jam"])
def test_a_row_has_the_same_bits_whatever_its_companions(attack, short, play, same_bits):
    """Metrics of a seed alone, among 7 in another order, and among 64: equal bit for bit, undefined ones too."""
    place = short(horizon=150)
    everyone = play(place, "kf", attack, range(64))
    whole = measure(everyone)
    assert len(set(everyone.length)) > 1  # some companions outlive others
    for seeds in ([11], [63, 2, 40, 11, 5, 900, 901], list(range(30, 60))):
        part = measure(play(place, "kf", attack, seeds))
        for name, column in part.items():
            for i, seed in enumerate(seeds):
                if seed < 64:
                    assert same_bits(column[i], whole[name][seed]), (name, seed)


def test_a_registered_metric_is_a_column_and_never_nan_or_infinite():
    """A new metric appears in the rows of an evaluation; NaN and infinities become null."""
    kept = list(METRICS)
    try:

        @metric("1")
        def odd(trace):
            """1 for even rows, NaN and infinity else."""
            return np.where(np.arange(trace.batch) % 2 == 0, 1.0, np.where(np.arange(trace.batch) % 4 == 1, np.nan, np.inf))

        rows = tailgate.evaluate(scenarios=["thesis-ch4-v0"], defences=["kf"], attacks=["none"], seeds=4)
    finally:
        METRICS.pop("odd", None)
        UNITS.pop("odd", None)
    assert [row["odd"] for row in rows] == [1.0, None, 1.0, None]
    for row in rows:
        assert row["status"] == "ok" and row["detection_delay"] is None and row["alarm_rate"] == 0.0
        assert all(row[name] is None or math.isfinite(row[name]) for name in kept)


STRING = replace(load_scenario("platoon-braking-v0").brief().model, dt=DT)


def string(steps=4, **signals):
    """A trace of the leader 0 and four followers in one episode; each signal is (steps, 5), (5,) or a number."""
    road = dict(gap=[np.inf, 50, 50, 50, 50], speed=10.0, accel=0.0, lead_speed=10.0, rear_gap=np.inf, rear_speed=0.0, position=0.0)
    column = {name: np.broadcast_to(np.asarray(signals.get(name, value), float), (steps, 5))[:, None] for name, value in road.items()}
    out = {name: value.copy() for name, value in column.items()}
    for name, value in (("alarm", False), ("probe", True)):
        out[name] = np.broadcast_to(np.asarray(signals.get(name, value), bool), (steps, 5))[:, None].copy()
    flags = ("kind", "refused", "collided", "rear_collided")
    out |= {name: np.broadcast_to(signals.get(name, 0), steps)[:, None].copy() for name in flags}
    truth = np.full((steps, 1, 5, 19), 7.0)
    estimate, error = truth.copy(), np.broadcast_to(np.asarray(signals.get("error", 0.0), float), (steps, 5))
    for i in range(1, 5):
        estimate[:, 0, i, 3 + 4 * (i - 1)] += error[:, i]  # its own gap: what it believes of the others' does not count
        estimate[:, 0, i, 3 + 4 * (i % 4)] += 99.0
    out["truth"], out["estimate"] = truth, estimate
    first = {name: np.broadcast_to(np.asarray(value, float), (1, 5)).copy() for name, value in road.items()}
    return Trace(STRING, steps, np.array([steps]), out, first, lambda v: 5.0 + 3.0 * v)


A, B = [0, 0, 0, 1, 0], [0, 0, 1, 0, 0]  # an alarm of car 3, of car 2


@pytest.mark.parametrize(
    "name, signals, want",
    [
        ("min_gap", {"gap": [np.inf, 9, 4, 6, 8]}, 4.0), ("min_gap", {}, 50.0), ("collided", {"collided": [0, 0, 1, 0]}, 1.0),
        ("impact_speed", {"collided": 1, "gap": [np.inf, 9, -0.1, -0.2, 9], "speed": [10, 11, 12, 15, 16], "lead_speed": 10.0}, 5.0),
        ("min_ttc", {"gap": [np.inf, 9, 4, 6, 8], "speed": [10, 10, 11, 12, 10]}, 3.0), ("min_ttc", {"speed": [50, 10, 10, 10, 10]}, 100.0),
        ("rmse_position", {"error": [0, 3, 0, 4, 0]}, 2.5), ("max_error", {"error": [0, 3, 0, -4, 0]}, 4.0),
        ("max_decel", {"accel": [-9, -1, -3, 0, 2]}, 3.0), ("distance_travelled", {"position": [90, 80, 60, 70, 75]}, 60.0),
        ("time_gap_inflation", {"gap": [np.inf, 35, 35, 35, 70]}, 0.25), ("rms_jerk", {"accel": [[7, 0, 0, 0, 0]] * 2 + [[9, 0, 0, 0, 2]] * 2}, 1.0),
        ("string_gain", {"lead_speed": np.array([[11], [12], [13], [14]]) * np.ones(5), "accel": [0, 9, 9, 9, 1]}, 0.5),
        ("recovery_time", {"kind": [5, 0, 0, 0], "gap": [[np.inf, 35, 35, 35, 35], [np.inf, 35, 80, 35, 35]] + [[np.inf, 35, 35, 35, 35]] * 2}, 1.0),
        ("recovery_time", {"kind": [5, 0, 0, 0], "gap": [np.inf, 35, 35, 80, 35]}, None),
        ("alarm_onsets", {"alarm": [A, B, [0] * 5, A]}, 2.0), ("alarm_rate", {"alarm": [A, B, [0] * 5, A]}, 0.75),
        ("detection_delay", {"kind": [0, 5, 5, 5], "alarm": [A, [0] * 5, B, A]}, 1.0), ("rear_collided", {}, 0.0),
    ],
)  # fmt: skip
def test_known_answers_of_a_string(name, signals, want):
    """Over all cars that follow another: the leader's own driving, and what a car believes of others, do not count; any alarm does."""
    got = measure(string(**signals))[name][0]
    assert math.isnan(got) if want is None else got == pytest.approx(want, rel=1e-12, abs=1e-12)
