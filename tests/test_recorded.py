"""Recorded leaders: the traces of the package, windows that keep purposes apart, and the same bits in every engine."""

import dataclasses
import hashlib
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core import draws, traces
from tailgate.core.draws import PURPOSES, Keys, Role
from tailgate.core.registry import Spec, make, make_from
from tailgate.core.scenario import load_scenario
from tailgate.envs.recorded import Recorded
from tailgate.play.trace import rollout

from .engines import as_plain, loop_of, trace_as_plain

ROOT = Path(__file__).parents[1]
START = np.uint32(0xFFFFFFFF)


def _windows(manoeuvre, dt, purpose, seeds):
    """The places of the samples of each seed's window among the joined speeds, (B, W + 1)."""
    plan = manoeuvre.prepare(dt)
    state = manoeuvre.start(plan, draws.keys(purpose, range(seeds)).at(Role.MANOEUVRE, np.full(seeds, START)))
    return plan, state.at[:, None] + np.arange(plan.length + 1)


@pytest.mark.parametrize("name", list(traces.cards()))
def test_a_trace_is_the_file_of_its_card(name):
    card, columns = traces.as_card(name), traces.trace(name)
    path = ROOT / "configs/traces" / traces.cards()[name].file
    assert card["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert card["licence"] in ("CC0-1.0", "Apache-2.0", "MIT") and card["source"] and card["attribution"]
    assert path.name in (ROOT / "NOTICE").read_text(encoding="utf-8")
    assert np.all(np.diff(columns["t"]) > 0) and all(len(x) == len(columns["t"]) and np.isfinite(x).all() for x in columns.values())
    assert all((x >= 0).all() for key, x in columns.items() if key.startswith(("speed", "gap")))


def test_the_leader_brakes_hard_in_training_only():
    """By 3.0 m/s^2 at 709.5 s. The three whole report blocks have 0.3, 0.7 and 1.0 m/s^2 as a mean over 1 s, the end of the drive 1.4."""
    speed, blocks = Recorded().blocks(0.05)
    braking = {b.first * 0.05: (b.purpose, np.min(speed[b.first + 20 : b.last + 1] - speed[b.first : b.last - 19])) for b in blocks}
    assert [round(-most, 1) for purpose, most in braking.values() if purpose == "report"] == [0.3, 0.7, 1.0, 1.4]
    assert np.argmin(np.diff(speed)) * 0.05 == pytest.approx(709.5) and np.min(np.diff(speed)) / 0.05 == pytest.approx(-3.0)
    assert min(braking.items(), key=lambda held: held[1][1]) == (pytest.approx(600.25), ("train", pytest.approx(-2.36)))


def test_a_string_is_the_leaders_drive():
    """The 600 s of the string begin where the leader's trace begins, the hard braking 1779 s later."""
    leader = traces.trace("asta-leader")["speed1"]
    for name, at in (("asta-string", 0), ("asta-braking", 17790)):
        speed = traces.trace(name)["speed1"]
        assert np.abs(leader[at : at + len(speed)] - speed).max() <= 0.0051


def test_a_changed_or_foreign_trace_is_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"trace: got 'asta-lead'; expected .*asta-leader"):
        traces.trace("asta-lead")
    (tmp_path / "us06.npz").write_bytes((ROOT / "configs/traces/us06.npz").read_bytes()[:-1] + b"x")
    monkeypatch.setattr(traces, "_folder", lambda: tmp_path)
    traces._columns.cache_clear()
    with pytest.raises(InputError, match="trace us06: got 'SHA-256"):
        traces.trace("us06")
    traces._columns.cache_clear()


def test_headers_that_lie_about_their_size_or_break_off_are_refused():
    """Nothing is allocated that is not there; no error but ValueError leaves the reader."""
    whole = io.BytesIO()
    np.save(whole, np.arange(6.0))
    good = whole.getvalue()
    assert traces.npy(good).tolist() == list(range(6))
    huge = good.replace(b"(6,)", b"(10000000000000,)").replace(b" " * 12, b"", 1)
    for bad in (huge, good[:40], good[:100], good[:-8], good + b"1", good.replace(b"<f8", b"|O8"), good.replace(b"(6,)", b"((((")):
        with pytest.raises(ValueError):
            traces.npy(bad)


def test_arrays_of_objects_are_never_unpickled(tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, x=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ValueError, match="object of shape"):
        traces.npz(path.read_bytes())
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", b"\x93NUMPY")
    with pytest.raises(ValueError):
        traces.npz(path.read_bytes())


@pytest.mark.parametrize("chosen", [("asta-leader",), ("us06", "asta-leader")])
@pytest.mark.parametrize("dt", [0.05, 0.1, 1.0])
def test_no_second_of_a_recording_serves_two_purposes(chosen, dt):
    manoeuvre = make("manoeuvre", "recorded", traces=chosen)
    met = {purpose: set(np.unique(_windows(manoeuvre, dt, purpose, 400)[1]).tolist()) for purpose in PURPOSES}
    for one in PURPOSES:
        assert len(met[one]) * dt > 100.0
        for other in PURPOSES:
            assert one == other or not met[one] & met[other], (one, other)


def test_windows_differ_from_seed_to_seed_and_from_episode_to_episode():
    manoeuvre, start = make("manoeuvre", "recorded"), np.full(50, START)
    plan = manoeuvre.prepare(0.05)
    keys = draws.keys("report", range(50))
    first = manoeuvre.start(plan, keys.at(Role.MANOEUVRE, start)).at
    again = manoeuvre.start(plan, Keys(keys.key, keys.episode + np.uint32(1)).at(Role.MANOEUVRE, start)).at
    assert len(set(first.tolist())) > 40 and (first != again).all()
    blocks = [b for b in manoeuvre.blocks(0.05)[1] if b.purpose == "report"]
    assert all(any(b.first <= at and at + plan.length <= b.last for b in blocks) for at in (*first, *again))


def test_draws_do_not_depend_on_the_purpose_in_the_counter_and_defences_do_not_see_it():
    keys = draws.keys("report", range(8))
    bare = Keys(keys.key, np.zeros(8, np.uint32))
    for role in (Role.SENSOR, Role.DEFENCE, Role.ATTACK):
        step = np.arange(8)
        assert np.array_equal(keys.at(role, step).normal((3,)), bare.at(role, step).normal((3,)))
    assert (keys.at(Role.DEFENCE, np.arange(8)).episode == 0).all() and (keys.at(Role.ATTACK, np.arange(8)).episode == 0).all()
    assert (draws.purpose_of(keys.at(Role.MANOEUVRE, np.arange(8))) == PURPOSES.index("report")).all()


def test_the_leader_drives_the_window_exactly():
    scenario = dataclasses.replace(load_scenario("road-following-v0"), horizon=1200)
    manoeuvre = scenario.manoeuvre
    plan, places = _windows(manoeuvre, 0.05, "tune", 12)
    trace = rollout(scenario.loop(Spec("defence", "kf").make()), Spec("attack", "none").make(), draws.keys("tune", range(12)))
    played = np.concatenate([trace.first["lead_speed"][None, :, 0], trace.signals["lead_speed"][:, :, 0]])
    wanted = plan.speed[places].T[1:]  # the first step is played before the first measurement
    assert np.abs(played[: len(wanted)] - wanted[: len(played)]).max() < 1e-9
    assert np.abs(np.diff(wanted, axis=0)).max() < 0.25  # 5 m/s^2: nothing jumps


def test_a_window_of_ones_own_file(tmp_path):
    path = tmp_path / "mine.csv"
    path.write_text("t,v\n" + "\n".join(f"{t},{10 + t % 7}" for t in range(0, 650)), encoding="utf-8")
    manoeuvre = make_from("manoeuvre", {"name": "recorded", "traces": [], "path": str(path)}, "x")
    assert {b.recording for b in manoeuvre.blocks(0.1)[1]} == {"mine.csv"} and len(manoeuvre.blocks(0.1)[1]) == 5


@pytest.mark.parametrize("fields, words", [
    ({"traces": ("asta",)}, r"recorded\.traces: got 'asta'"),
    ({"traces": ()}, r"recorded\.traces: got \(\); expected a recording"),
    ({"traces": ("asta-leader", "asta-leader")}, r"expected recordings of different drives"),
    ({"traces": ("asta-leader", "asta-string")}, r"expected recordings of different drives"),
    ({"traces": ("comma2k19-radar",)}, r"expected a recording with the leader's speed"),
    ({"window": 130.0}, r"recorded\.window: got 130\.0; expected at most the block"),
    ({"window": 0.0}, r"recorded\.window: got 0\.0"),
    ({"traces": ("us06",), "block": 200.0}, r"recorded\.block: got 200\.0; expected recordings of at least 5 blocks"),
])  # fmt: skip
def test_bad_fields_are_refused(fields, words):
    with pytest.raises(InputError, match=words):
        make("manoeuvre", "recorded", **fields).prepare(0.05)


def test_a_plant_that_begins_at_one_speed_is_refused():
    scenario = dataclasses.replace(load_scenario("stop-and-go-v0"), manoeuvre=make("manoeuvre", "recorded"))
    with pytest.raises(InputError, match="plant: got 'CarFollowing'; expected one whose cars may begin at any speed"):
        scenario.loop(Spec("defence", "kf").make())


@pytest.mark.long
@pytest.mark.parametrize("name", ["road-following-v0", "road-string-v0", "road-us06-v0", "road-aeb-own-v0", "road-aeb-shared-v0"])
def test_the_engine_plays_the_same_bits(name):
    for defence, attack in (("chi2_kf", "fdi:start_step=105,value=10"), ("none", "dropout:start_step=110")):
        plain = trace_as_plain(*loop_of(name, defence, attack, horizon=260))
        assert (plain.kind != 0).any()


@pytest.mark.long
@pytest.mark.parametrize("name", ["road-following-v0", "road-string-v0"])
def test_environments_begin_again_in_another_window_to_the_same_bits(name, tmp_path):
    as_plain({"scenario": name, "defence": "chi2_kf"}, 19, tmp_path)
