"""`tailgate bench`: its statistics, what is missing, wrong use, and the C yardstick against the loop."""

import dataclasses
import json
import time
from pathlib import Path

import numpy as np
import pytest

from tailgate import cli
from tailgate.base.errors import InputError
from tailgate.bench import ours, peers, report, run, targets, yardstick
from tailgate.bench.lines import Line, Missing, Sample, repeated
from tailgate.core import draws
from tailgate.core.draws import Role
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.attacker_mdp import Seat


def _compiled() -> bool:
    try:
        yardstick.library()
    except Missing:
        return False
    return True


needs_compiler = pytest.mark.skipif("not _compiled()", reason="no C compiler")  # a text: it is asked when a test begins


def _seat(place):
    seat = Seat.make(scenario=place.name, defence="chi2_kf", reward="min_gap")
    return dataclasses.replace(seat, loop=place.loop(seat.loop.defence, seat.loop.uses))


def _trajectories(form, place, steps):
    """Step by step the loop's state and reward, and the yardstick's rows, of the same 64 episodes."""
    seat, attack, batch = _seat(place), Spec("attack", "fdi:value=-4").make(), 64
    plan = attack.prepare(seat.loop.brief)
    state = seat.loop.start(draws.keys("tune", range(batch)))
    tally, over = seat.begin(state), np.zeros(batch, bool)
    memory = attack.start(plan, batch, state.keys.at(Role.ATTACK, state.k))
    stick = yardstick.Yardstick(form, range(batch), place, yardstick.injection(place, -4.0, 50, min(500, place.horizon)))

    def decide(view):
        nonlocal memory
        memory, command = attack.decide(plan, memory, view, state.keys.at(Role.ATTACK, view.k))
        return command

    for _ in range(steps):
        state, tally, outcome, _ = seat.step(state, tally, decide, over)
        ended = outcome.terminated | outcome.truncated
        if ended.any():
            state = seat.loop.restart(state, ended)
            tally = type(tally)(*(np.where(ended, new, old) for new, old in zip(seat.begin(state), tally, strict=True)))
            assert ended.all() or not outcome.truncated.any()
            fresh = attack.start(plan, batch, state.keys.at(Role.ATTACK, state.k))
            memory = type(memory)(*(np.where(ended.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in zip(fresh, memory, strict=True)))
        stick.run(1)
        yield state, outcome, stick


def _assert_equal(state, outcome, stick, rear):
    ego, filter = state.plant.ego[:, 0], state.defence.filter
    P = filter.P[:, 0]
    wanted = {
        "x": ego[:, 0], "v": ego[:, 1], "a": ego[:, 2], "lead_x": state.plant.lead_x, "lead_v": state.plant.lead_v,
        "clock": state.manoeuvre.clock, "phase": state.manoeuvre.phase, "est_x": filter.x[:, 0, 0], "est_v": filter.x[:, 0, 1],
        "est_a": filter.x[:, 0, 2], "p00": P[:, 0, 0], "p01": P[:, 0, 1], "p02": P[:, 0, 2], "p11": P[:, 1, 1], "p12": P[:, 1, 2],
        "p22": P[:, 2, 2], "u": state.control[:, 0, 0], "y0": state.sent[:, 0, 0], "y1": state.sent[:, 0, 1], "reward": outcome.reward,
    }  # fmt: skip
    if rear:
        wanted |= {"rear_x": state.plant.behind.x, "rear_v": state.plant.behind.v}
    for name, values in wanted.items():
        np.testing.assert_allclose(stick.row(name), values, rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.long
@needs_compiler
def test_the_yardstick_drives_as_the_loop_does():
    """Every state, covariance and reward of 64 episodes over 330 steps, random numbers, gate, injection and phases of the leader included."""
    place, phases, shut = load_scenario("stop-and-go-v0"), set(), False
    for k, (state, outcome, stick) in enumerate(_trajectories("whole", place, 330)):
        _assert_equal(state, outcome, stick, True)
        phases |= set(state.manoeuvre.phase.tolist())
        shut |= k > 50 and bool(state.estimate.alarm.any())
    assert phases == {0, 1, 2, 3} and shut


@needs_compiler
def test_the_yardstick_begins_anew_as_the_loop_does():
    """Episodes of 40 steps: the third ones are those of the loop's restarts."""
    place = dataclasses.replace(load_scenario("stop-and-go-v0").with_threat(end=40, onset=5), horizon=40)
    seat = _seat(place)
    state, stick = seat.loop.start(draws.keys("tune", range(64))), yardstick.Yardstick("whole", range(64), place)
    assert stick.run(100) == 2 * 64
    for _ in range(2):
        state = seat.loop.restart(state, np.ones(64, bool))
    quiet = Spec("attack", "none").make()
    plan = quiet.prepare(seat.loop.brief)
    for _ in range(20):
        state, _, _ = seat.loop.step(state, quiet, plan, None)
    np.testing.assert_allclose(stick.row("x"), state.plant.ego[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(stick.row("est_v"), state.defence.filter.x[:, 0, 1], rtol=1e-9)
    np.testing.assert_allclose(stick.row("rear_x"), state.plant.behind.x, rtol=1e-9)


@needs_compiler
def test_the_bare_yardstick_is_the_loop_without_process_noise_and_driver():
    """The defence is still told of the noise."""
    place = dataclasses.replace(load_scenario("stop-and-go-v0"), truth={"plant": {"process_var": [0.0, 0.0, 0.0], "rear": False}})
    for state, outcome, stick in _trajectories("bare", place, 90):
        _assert_equal(state, outcome, stick, False)


def test_without_a_compiler_the_yardstick_is_missing(monkeypatch):
    """Said in a sentence, and no error."""
    monkeypatch.setattr(yardstick.shutil, "which", lambda name: None)
    yardstick.library.cache_clear()
    record = run.bench(["yardstick-bare"], 1, 0.01)
    yardstick.library.cache_clear()
    assert "no C compiler" in record["missing"]["yardstick-bare"] and record["machine"]["compiler"] is None
    (target,) = record["targets"]
    assert target["met"] is None and "no C compiler" in target["why"] and record["lines"]["batch-4096"]["median"] > 0.0


def _line(name, values, **fields):
    """A line whose rounds give these values."""
    left = list(values)
    return Line(name, name, lambda: lambda seconds: Sample(left.pop(0), 1.0), unit="number", **fields)


def test_a_ratio_is_that_of_the_medians_and_its_interval_that_of_the_rounds():
    """Rounds 1 to 9 against twos: the second smallest to the second largest covers 96 %."""
    measured = run.Measured(0.1)
    measured.measure([_line("a", range(1, 10)), _line("b", [2.0] * 9)], 9, lambda line: None)
    found = run.judged(targets.Target("t", "t", "a", "b", 2.5), measured)
    assert (found["value"], found["low"], found["high"]) == (2.5, 1.0, 4.0) and found["met"]
    assert found["coverage"] == pytest.approx(1.0 - 2.0 * 10 / 512)
    assert run.judged(targets.Target("t", "t", "a", "b", 2.6), measured)["met"] is False
    assert run.judged(targets.Target("t", "t", "b", None, 1.9, True), measured)["met"] is False
    assert run.judged(targets.Target("t", "t", "b"), measured)["met"] is None
    assert run.interval([3.0, 1.0, 2.0])[:2] == (1.0, 3.0) and run.interval([3.0, 1.0, 2.0])[2] == pytest.approx(0.75)


def test_rounds_are_interleaved():
    """A B A B, after each was set up; a line that is measured once is."""
    order = []
    lines = [_line("a", range(3)), _line("b", range(3), most=1), _line("c", range(3))]
    run.Measured(0.1).measure(lines, 2, lambda line: order.append(line.name))
    assert order == ["a", "b", "c", "a", "b", "c", "a", "c"]


def test_a_broken_peer_is_missing_and_a_broken_part_of_ours_is_an_error():
    """Somebody else's fault costs its own line only."""

    def broken():
        raise RuntimeError("no display")

    measured = run.Measured(0.1)
    measured.measure([Line("theirs", "", broken, ours=False), _line("a", [1.0])], 1, lambda line: None)
    assert "RuntimeError: no display" in measured.missing["theirs"] and measured.values == {"a": [1.0]}
    with pytest.raises(RuntimeError, match="no display"):
        measured.measure([Line("own", "", broken)], 1, lambda line: None)


def test_work_is_repeated_until_the_time_is_over():
    """At least once; the count is what was done, and sleeping is no work."""
    done = []
    sample = repeated(lambda: done.append(1) or 5)(0.002)
    assert sample.amount == 5 * len(done) and sample.per > 0.0
    assert repeated(lambda: 7)(0.0).amount == 7
    assert repeated(lambda: time.sleep(0.05) or 1)(0.0).per < 0.03


def test_every_target_names_lines_that_exist():
    """Names are unique, targets and lines apart; what a target compares stands in one group."""
    names = [line.name for line in targets.LINES]
    assert len(set(names)) == len(names) and len({t.name for t in targets.TARGETS}) == len(targets.TARGETS)
    grouped = targets.groups(list(targets.LINES))
    assert sorted(line.name for group in grouped for line in group) == sorted(names)
    for target in targets.TARGETS:
        assert sum({*target.lines} <= {line.name for line in group} for group in grouped) == 1, target.name
    bounds = {t.name: t.bound for t in targets.TARGETS}
    asked = {"make-cartpole": 3.5, "make-highway": 2500, "vector-256": 4, "vector-4096": 1.3, "yardstick": 0.75, "cores": 1.8, "filterpy-1": 15,
             "filterpy-4096": 500, "rkf": 10_000, "norm": 1000, "lasso": 2000, "platoon": 30, "training-share": 0.02, "start-cached": 0.6,
             "start-cold": 3.0, "memory": 1024, "plug-in": 1e6}  # fmt: skip
    assert asked.items() <= bounds.items()


@pytest.mark.parametrize(("make", "how"), [(peers.highway, "tailgate[highway]"), (peers.filterpy_kalman, "filterpy"), (peers.sumo, "libsumo")])
def test_a_peer_that_is_not_installed_is_missing(monkeypatch, make, how):
    """With what to install."""

    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(peers, "import_module", absent)
    with pytest.raises(Missing, match="is missing: pip install") as caught:
        make()
    assert how in str(caught.value)


def test_a_missing_side_leaves_its_target_open(monkeypatch, tmp_path, capsys):
    """Its reason is in the table, in the page and in the record; the exit code is 0."""

    def absent():
        raise Missing("highway-env is missing: pip install 'tailgate[highway]'")

    lines = tuple(dataclasses.replace(line, make=absent) if line.name == "highway" else line for line in targets.LINES)
    monkeypatch.setattr(targets, "LINES", lines)
    arguments = ["bench", "--only", "make-highway", "--rounds", "1", "--seconds", "0.01", "--out", str(tmp_path)]
    assert cli.main(arguments) == 0
    assert "tailgate[highway]" in capsys.readouterr().out
    record = json.loads((tmp_path / "speed.json").read_text(encoding="utf-8"))
    assert record["targets"][0]["met"] is None and record["lines"]["make"]["median"] > 0.0 and "highway" in record["missing"]
    assert "not measured: highway-env is missing" in (tmp_path / "speed.md").read_text(encoding="utf-8")


def test_a_short_run_makes_record_page_and_plot(monkeypatch, tmp_path, capsys):
    """Ratio, machine and a scaling of three points; the same command may write again, a smaller one may not."""
    sizes = targets._curve("whole step", (1, 8, 64), ours.batch)
    plot = targets.Scaling("scaling-episodes", "car following", "episodes", {"whole step": sizes})
    monkeypatch.setattr(targets, "scalings", lambda: (plot,))
    short = ["--rounds", "2", "--seconds", "0.01", "--out", str(tmp_path)]
    assert cli.main(["bench", "--only", "make-cartpole", "--only", "scaling-episodes", "--json", *short]) == 0
    record = json.loads(capsys.readouterr().out)
    (target,) = record["targets"]
    assert target["value"] == pytest.approx(record["lines"]["make"]["median"] / record["lines"]["cartpole"]["median"])
    assert record["machine"]["cores"] >= 1 and record["machine"]["packages"]["numpy"] == np.__version__
    assert [point["at"] for point in record["scalings"][0]["curves"]["whole step"]] == [1, 8, 64]
    text = (tmp_path / "speed.md").read_text(encoding="utf-8")
    assert "gymnasium.make against CartPole-v1" in text and "(speed-episodes.png)" in text
    assert (tmp_path / "speed-episodes.png").read_bytes().startswith(b"\x89PNG")
    assert cli.main(["bench", "--only", "cartpole", *short]) == 2
    assert "record with more" in capsys.readouterr().err and json.loads((tmp_path / "speed.json").read_text())["targets"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--only", "cartpol"], ["only", "cartpol", "cartpole", "yardstick", "scaling-cores"]),
        (["--only", "cartpole", "--rounds", "0"], ["rounds", "0"]), (["--only", "cartpole", "--seconds", "0"], ["seconds", "0"]),
        (["--only", "cartpole", "--seconds", "nan"], ["seconds", "nan"]), (["--only", "cartpole", "--out", "file/here"], ["out", "writable"]),
    ],
)  # fmt: skip
def test_wrong_use_is_one_clear_error(tmp_path, monkeypatch, capsys, arguments, words):
    """Exit code 2 and one line."""
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    assert cli.main(["bench", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "expected" in error and all(word in error for word in words)


def test_the_list_names_everything(capsys):
    """Without measuring."""
    assert cli.main(["bench", "--list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("make-highway", "cartpole-async", "scaling-sensors", "CartPole-v1, native vector environment, 4096"))


def test_parts_of_a_batch_play_to_the_bit():
    """What the cores line asks of two cores."""
    assert ours.unequal()(0.0).value == 0.0


def test_figures_have_three_digits():
    """Of rates, seconds, bytes and shares."""
    assert [report.shown(x, "1/s") for x in (31.04e6, 999.6, 9996.0, 0.5)] == ["31.0 M/s", "1.00 k/s", "10.0 k/s", "0.50 /s"]
    assert (report.shown(2.345, "s"), report.shown(1023.7, "bytes"), report.shown(0.0123, "share")) == ("2.35 s", "1024 bytes", "1.2 %")


def test_scenarios_other_than_its_own_are_refused():
    """The yardstick's ring of the driver behind has ten places."""
    slow = dataclasses.replace(load_scenario("stop-and-go-v0").plant, rear_reaction=0.5)
    with pytest.raises(InputError, match="yardstick"):
        yardstick.Yardstick("whole", range(64), dataclasses.replace(load_scenario("stop-and-go-v0"), plant=slow))
    with pytest.raises(InputError, match="yardstick"):
        yardstick.Yardstick("whole", range(65))
