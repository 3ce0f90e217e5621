"""Falsification: the road as a vector, the search, the shrinking, the counterexample's file, splitting and the likeliest failure."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core import draws
from tailgate.core.draws import Keys
from tailgate.core.registry import Spec
from tailgate.falsify import road, run, search
from tailgate.falsify.case import Case
from tailgate.falsify.counterexample import replayed
from tailgate.falsify.run import falsify
from tailgate.falsify.schedule import Schedule, recorded
from tailgate.falsify.search import Search
from tailgate.falsify.shrink import shrunk
from tailgate.play.trace import rollout

PLANTED = Path(__file__).parents[1] / "benchmarks/results/falsification"
BIASED = (("kinds", ["fdi"]), ("targets", ["position"]), ("fdi_bound", 60))
FAULT = Case("", "stop-and-go-v0", 60, "planted:SignError", BIASED, "G[0,60] gap_error < 80")
ROAD = Case("", "braking-v0", None, "kf", (), "G[0,60] gap > 2.5", "none")


@pytest.fixture
def planted(monkeypatch):
    monkeypatch.syspath_prepend(str(PLANTED))


# The road


def test_a_chosen_start_is_a_start_that_the_scenario_draws():
    """The draws of an episode, given back as a choice, play that episode; another choice plays another."""
    loop, attack = ROAD.own, Spec("attack", "none").make()
    keys = draws.keys("tune", range(4))
    at_start = np.full(4, road.START)
    numbers = {(s.role, s.law, s.tag): getattr(keys.at(s.role, at_start), s.law)(s.shape, s.tag) for s in ROAD.slots}
    drawn = rollout(loop, attack, keys)
    chosen = rollout(loop, attack, road.Steered.of(Keys(*keys), numbers))
    assert [drawn.trace_hash(i) for i in range(4)] == [chosen.trace_hash(i) for i in range(4)]
    other = rollout(loop, attack, road.Steered.of(Keys(*keys), {key: held[::-1] for key, held in numbers.items()}))
    assert drawn.trace_hash(0) != other.trace_hash(0)


def test_genes_are_quantiles_of_the_draws():
    genes = np.random.default_rng(0).random((2000, sum(slot.size for slot in ROAD.slots)))
    numbers = road.numbers_of(ROAD.slots, genes)
    laws = {law: np.concatenate([held.ravel() for key, held in numbers.items() if key[1] == law]) for law in ("normal", "uniform")}
    assert abs(laws["normal"].mean()) < 0.05 and abs(laws["normal"].std() - 1.0) < 0.05
    assert laws["uniform"].min() > 0.0 and laws["uniform"].max() < 1.0 and abs(laws["uniform"].mean() - 0.5) < 0.03
    onset = ROAD.own.start(road.Steered.of(draws.keys("tune", [0] * 2000), numbers)).manoeuvre.onset
    low, high = ROAD.own.manoeuvre.onset
    assert low < onset.min() < low + 0.1 and high - 0.1 < onset.max() < high


@pytest.mark.long
def test_the_row_of_a_genome_is_its_text(same_bits):
    """A trial in a batch has the robustness, to the last bit, that its text has in the plain engine."""
    case = Case("quick-v0", "gusty-stop-and-go-v0", 12, "chi2_kf", (), "G[0,60] gap > 2")
    genomes = np.random.default_rng(3).random((4, len(case.genes)))
    found = case.robustness(genomes, np.tile([0, 1], (4, 1)))
    for i, genome in enumerate(genomes[:2]):
        choice = case.choice(genome)
        keys = road.Steered.of(
            draws.keys("tune", [0, 1]),
            {key: np.repeat(held, 2, axis=0) for key, held in road.numbers_of(case.slots, choice.start[None]).items()},
        )
        trace = rollout(case.loop(choice.attack), Spec("attack", choice.attack).make(), keys, plain=True)
        assert same_bits(found[i], case.claim.robustness(trace))
    assert same_bits(case.robustness(genomes[:1], np.array([[0, 1]])), found[:1])  # whatever the batch


# The search


@pytest.mark.long
def test_a_road_alone_is_worse_than_as_many_random_ones():
    every = " + ".join(f"gap@{i}" for i in range(1, 5))
    case = dataclasses.replace(ROAD, scenario="platoon-gusty-v0", defence="dkf", formula=f"G[0,0.1] {every} > 50")
    plain = rollout(case.own, Spec("attack", "none").make(), draws.keys("report", range(1536)))
    found = search.search(Search(case, trials=192))
    assert found.robustness < case.claim.robustness(plain).min()
    assert (found.trials, found.episodes) == (192, 1536)


@pytest.mark.long
@pytest.mark.parametrize("sampler", ["tpe", "cmaes"])
def test_an_interrupted_search_finds_the_same(tmp_path, monkeypatch, sampler):
    job = Search(ROAD, sampler, 3 * search.GENERATION, 5)
    whole = search.search(job)
    with pytest.raises(KeyboardInterrupt):
        search.search(job, tmp_path, lambda done, total, least: _stop(done, 2 * search.GENERATION))
    held = {path.name: path.read_bytes() for path in (tmp_path / "generations").iterdir()}
    assert sorted(held) == ["00000.json", "00001.json"]
    left = []
    monkeypatch.setattr(
        Case, "robustness", lambda self, genomes, seeds, real=Case.robustness: left.append(seeds) or real(self, genomes, seeds)
    )
    again = search.search(job, tmp_path)
    assert len(left) == 1  # what was kept is not played
    assert again.genome.tolist() == whole.genome.tolist() and again[1:] == whole[1:]
    with pytest.raises(InputError, match=r"--out.*generation of this very search"):
        search.search(dataclasses.replace(job, seed=6), tmp_path)


def _stop(done, at):
    if done >= at:
        raise KeyboardInterrupt


# Shrinking


def _needs(steps, least):
    """Return a judge: broken where every one of these steps has a value of at least so much on the second wire."""

    def broken(tried):
        value = np.where(tried.target, tried.value, 0.0)[:, :, 0, 1]
        return np.all(value[list(steps)] >= least, axis=0)

    return broken


def test_what_is_left_is_what_it_takes():
    brief, size = FAULT_BRIEF(), (600, 1, 1, 5)
    kind = np.zeros(size[:2], np.int8)
    kind[100:180] = 5
    target = np.repeat((kind != 0)[:, :, None, None], 5, axis=3) & (np.arange(5) < 2)
    found = Schedule(kind, target, np.where(target, 8.0, 0.0))
    out = shrunk(found, _needs((120, 121, 150), 2.0), brief)
    assert np.flatnonzero(out.kind[:, 0]).tolist() == [120, 121, 150]
    assert not out.target[:, 0, 0, 0].any()  # the other wire is left alone
    values = out.value[[120, 121, 150], 0, 0, 1]
    assert np.all(values >= 2.0) and np.all(values < 2.2)
    nothing = shrunk(found, lambda tried: np.ones(tried.kind.shape[1], bool), brief)
    assert not nothing.kind.any()


def FAULT_BRIEF():
    return dataclasses.replace(FAULT, defence="kf", threat=(("kinds", ["fdi"]),)).own.brief


def test_a_planted_fault_is_found_and_shrunk(planted, tmp_path):
    """The sound filter stands the same search. The attack is shrunk to a tenth of its steps, and no step of it is idle, of those that are tried."""
    report = falsify(Search(FAULT, trials=32, seed=2), tmp_path)
    found = report["counterexample"]
    assert report["violated"] and report["violations"] > 0
    assert found["found"]["steps"] >= 30 and 10 * found["steps"] <= found["found"]["steps"]
    assert found["robustness"] < 0.0 and len(found["commands"]) == found["steps"]
    sound = search.search(Search(dataclasses.replace(FAULT, defence="kf"), trials=32, seed=2))
    assert sound.robustness > 0.0
    again = replayed(tmp_path / run.COUNTEREXAMPLE, "planted:SignError")
    assert again["same"] and again["formulas"] == found["formulas"]
    whole, *parts = found["formulas"]
    assert (whole["formula"], parts[0]["formula"]) == ("G[0, 60] (gap_error < 80)", "gap_error < 80")
    assert whole["along"][0] == found["robustness"] == min(parts[0]["along"])
    data = json.loads((tmp_path / run.COUNTEREXAMPLE).read_text())
    for i in range(0, len(data["commands"]), 4):
        less = data | {"commands": data["commands"][:i] + data["commands"][i + 1 :]}
        (tmp_path / "less.json").write_text(json.dumps(less))
        assert replayed(tmp_path / "less.json", "planted:SignError")["robustness"] >= 0.0
    with pytest.raises(InputError, match="counterexample"):  # the file alone imports nothing
        replayed(tmp_path / run.COUNTEREXAMPLE)


def test_a_schedule_plays_what_was_recorded():
    """Every kind of command, played back at its steps, gives the same road."""
    case = Case("", "gusty-stop-and-go-v0", 20, "chi2_kf", (), "G gap > 2")
    keys = draws.keys("tune", [4])
    for text in (
        "dos_hold:start_step=60",
        "fdi_ramp:trigger=near,threshold=100",
        "dropout:start_step=70,burst=3,pause=2",
        "dos_jam:start_step=80",
    ):
        loop, none = (dataclasses.replace(case.loop(name), horizon=120) for name in (text, "none"))
        trace = rollout(loop, Spec("attack", text).make(), keys)
        again = rollout(none, recorded(trace, loop.horizon), keys, plain=True)
        assert (trace.kind != 0).any() and trace.decision_hash(0) == again.decision_hash(0) and np.array_equal(trace.gap, again.gap)


@pytest.mark.long
@pytest.mark.parametrize(("changes", "expected"), [
    ({"format": "x"}, "tailgate-counterexample-1"), ({"defence": 3}, "a text"), ({"seed": -1}, "not below 0"),
    ({"start": []}, None), ({"start": [{"role": "prior"}]}, "draws of a start"), ({"commands": {}}, "list of commands"),
    ({"commands": [{"k": 9999, "kind": "fdi", "hits": []}]}, "a step from 1"), ({"commands": [{"k": 9, "kind": "delay", "hits": []}]}, "one of"),
    ({"commands": [{"k": 9, "kind": "fdi", "hits": [{"agent": 7, "wire": "position", "value": 1}]}]}, "an agent below"),
    ({"property": "G gap >"}, "a number"), ({"property": "G error < 3 and y"}, "."),
])  # fmt: skip
def test_a_damaged_counterexample_is_refused(tmp_path, changes, expected):
    falsify(Search(dataclasses.replace(ROAD, formula="G[0,60] gap > 20"), trials=2), tmp_path)
    path = tmp_path / run.COUNTEREXAMPLE
    assert replayed(path)["same"]
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    if expected is None:
        assert not replayed(path)["same"]  # another start is another episode
        return
    with pytest.raises(InputError, match=expected):
        replayed(path)


@pytest.mark.long
def test_a_counterexample_of_a_suite_in_a_file_is_played_where_the_suite_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text("about: a\nscenarios: [braking-v0]\ndoses: [5]\nshown: {5: a}\ndefences: [kf]\nattacks: [none]\nseeds: 3\n")
    falsify(Search(dataclasses.replace(ROAD, suite="mine.yaml", formula="G[0,60] gap > 20"), trials=2), tmp_path / "out")
    path = tmp_path / "out" / run.COUNTEREXAMPLE
    with pytest.raises(InputError, match=r"counterexample: suite: got 'mine\.yaml'"):
        replayed(path)
    assert replayed(path, suite="mine.yaml")["same"]


# The commands


@pytest.mark.long
def test_the_commands(tmp_path, capsys):
    out = str(tmp_path / "found")
    place = ["--property", "G[0,60] gap > 2.5", "--scenario", "braking-v0"]
    assert main(["falsify", "kf", *place, "--attack", "none", "--trials", "64", "--out", out, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["violated"] and report["counterexample"]["steps"] == 0 and report["attack"] == "none"
    assert main(["falsify", "kf", "--counterexample", f"{out}/counterexample.json"]) == 0
    assert "to the last bit" in capsys.readouterr().out
    assert main(["falsify", "rkf", "--counterexample", f"{out}/counterexample.json"]) == 1
    capsys.readouterr()
    assert main(["rare", "kf", *place, "--particles", "16", "--runs", "3"]) == 0
    assert "95 % interval" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "expected"), [
    (["falsify", "kf", "--scenario", "braking-v0"], "--property"), (["falsify", "kf", "--property", "G gap > 2"], "--scenario"),
    (["falsify", "kf", "--scenario", "braking-v0", "--property", "G gap > 2", "--sampler", "x"], "--sampler"),
    (["falsify", "kf", "--scenario", "braking-v0", "--property", "G gap > 2", "--trials", "0"], "--trials"),
    (["falsify", "kf", "--scenario", "braking-v0", "--property", "G gap > 2", "--dose", "-1"], "--dose"),
    (["falsify", "kf", "--scenario", "braking-v0", "--property", "G gap > 2", "--seed", "-1"], "--seed"),
    (["falsify", "nobody", "--scenario", "braking-v0", "--property", "G gap > 2"], "nobody"),
    (["falsify", "kf", "--scenario", "braking-v0", "--property", "G nothing > 2"], "nothing"),
    (["falsify", "kf", "--scenario", "braking-v0", "--property", "G[99,100] gap > 2"], "horizon"),
    (["falsify", "kf", "--scenario", "braking-v0", "--property", "true"], "reads a signal"),
    (["falsify", "dkf", "--scenario", "network-v0x", "--property", "G gap > 2"], "network-v0x"),
    (["falsify", "kf", "--scenario", "scalar-hold-v0", "--property", "G gap > 2"], "with a meaning"),
    (["rare", "kf", "--scenario", "braking-v0", "--property", "F gap > 2"], "of comparisons"),
    (["rare", "kf", "--scenario", "braking-v0", "--property", "G gap > 2", "--particles", "4"], "--particles"),
    (["rare", "kf", "--scenario", "braking-v0", "--property", "G gap > 2", "--runs", "2"], "--runs"),
    (["rare", "kf", "--scenario", "braking-v0", "--property", "G gap > 2", "--confidence", "1"], "--confidence"),
])  # fmt: skip
def test_bad_input_is_named_before_anything_is_played(tmp_path, capsys, words, expected):
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert expected in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_result_of_another_job_is_set_aside(tmp_path, capsys):
    """Otherwise an old counterexample would lie next to the new report."""
    words = ["falsify", "kf", "--scenario", "braking-v0", "--attack", "none", "--trials", "8", "--out", str(tmp_path / "found"), "--property"]
    assert main([*words, "G[0,60] gap > 200"]) == 0 and (tmp_path / "found" / "counterexample.json").is_file()
    shutil.rmtree(tmp_path / "found" / "generations")
    assert main([*words, "G[0,60] gap > -1000"]) == 0
    capsys.readouterr()
    assert not (tmp_path / "found" / "counterexample.json").exists()
    assert json.loads((tmp_path / "found" / "falsify.json").read_text())["violated"] is False
    assert json.loads((tmp_path / "found" / "falsify.json.1").read_text())["violated"] is True
