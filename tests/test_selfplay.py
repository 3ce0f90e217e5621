"""Self-play: the defender learns, resumes to the bit, and what it exports plays as it did in training; a run and its report."""

import dataclasses
import json
import re

import numpy as np
import pytest

import tailgate
from tailgate import cli, draws
from tailgate.agents.cem import Config
from tailgate.agents.mixture import Mixture
from tailgate.agents.selfplay import Learner, constant, play
from tailgate.core import Kind
from tailgate.envs.duel import Duel
from tailgate.errors import InputError
from tailgate.estimators import Steered
from tailgate.registry import Spec
from tailgate.scenario import config_path, load_scenario
from tailgate.selfplay import GameConfig, load_config
from tailgate.trace import rollout

ROAD = {"scenario": "gusty-stop-and-go-v0", "interval": 60, "menu": {"thresholds": [6.0, 1e9], "modes": ["normal", "brake"]}, "knowledge": "black"}
FDI = "fdi:trigger=near,threshold=40,value=-4"
SMALL = Config(population=6, episodes=4, hidden=(4,))
ROUND = 6 * 4 * 10  # decisions of a generation without a collision


def attacks(*names):
    return tuple(Spec("attack", name).make() for name in names)


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    """A scenario file with the road of ROAD and a quarter of its time."""
    path = tmp_path_factory.mktemp("scenario") / "brief.yaml"
    text = config_path("scenarios", ROAD["scenario"], "scenario").read_text().replace("horizon: 600", "horizon: 150")
    path.write_text(text.replace("end: 500", "end: 150").replace("onset: 50", "onset: 10"))
    return ROAD | {"scenario": str(path), "interval": 15}


def run(road, steps, seed=0, rivals=("fdi:value=-4", "none"), **options):
    learner = Learner(seed, 0.99, SMALL, Duel.make(**road), attacks(*rivals))
    learner.learn(steps, lambda progress: None, **options)
    return learner


def test_a_mixture_draws_one_attack_per_episode(short):
    """Every row plays one of the members to its end, each about half of them, and the same one alone and in a batch."""
    place = short("gusty-stop-and-go-v0", horizon=40)
    loop, mix = place.loop(tailgate.make_defence("kf")), Mixture(attacks("fdi:value=2", "dos_jam"))
    whole = rollout(loop, mix, draws.keys("train", range(200)))
    kinds = whole.kind[9:]
    assert (kinds == kinds[0]).all() and set(np.unique(kinds)) == {Kind.FDI, Kind.DOS_JAM}
    assert abs(np.count_nonzero(kinds[0] == Kind.FDI) - 100) < 3.29 * np.sqrt(50)
    members = [rollout(loop, attack, draws.keys("train", [7])).trace_hash(0) for attack in mix.attacks]
    alone = rollout(loop, mix, draws.keys("train", [7])).trace_hash(0)
    assert alone == whole.trace_hash(7) == members[[Kind.FDI, Kind.DOS_JAM].index(kinds[0, 7])]


def test_the_defender_learns():
    """Against one injection that the open gate lets through, the payoff after a few generations comes near that of the best fixed setting."""
    duel = Duel.make(**ROAD)
    config = Config(population=16, episodes=8, hidden=(4,), extra_until=4)
    learner = Learner(0, 1.0, config, duel, attacks(FDI))
    learner.learn(3 * 16 * 8 * 9, lambda progress: None)
    keys = draws.keys("tune", range(32))
    fixed = [play(duel, learner.attack, keys, lambda seen, n=n: np.full(32, n)) for n in range(4)]
    weight, bias = learner.network.weights, learner.network.biases
    learned = play(duel, learner.attack, keys, lambda seen: np.argmax(np.tanh(seen @ weight[0] + bias[0]) @ weight[1] + bias[1], axis=1))
    paid = [part.paid.mean() for part in fixed]
    assert fixed[2].crashed.mean() > fixed[1].crashed.mean() + 0.3  # an open gate that nobody brakes behind
    assert learned.paid.mean() > min(paid) + 0.7 * (max(paid) - min(paid))


def test_what_is_exported_plays_as_in_training(brief, tmp_path):
    """The mean's payoff in training is that of the exported defender, which sets its knobs by itself as an ordinary defence."""
    learner = run(brief, 2 * ROUND)
    keys = draws.keys("train", range(learner.generation * 4, learner.generation * 4 + 4))
    reward, crashed = learner._play(learner.mean[None])
    path = learner.export(tmp_path / "defender", {"learner": "cem"})
    guard = Spec("defence", f"steered:policy={path}").make()
    seat = learner.duel.seat
    itself = dataclasses.replace(learner.duel, guard=guard, seat=dataclasses.replace(seat, loop=dataclasses.replace(seat.loop, defence=guard)))
    out = play(itself, learner.attack, keys, gamma=0.99)
    assert out.paid.mean() == pytest.approx(reward[0], rel=1e-9) and out.crashed.mean() == crashed[0] and out.cost.max() > 0.0
    whole = play(itself, learner.attack, keys)
    np.testing.assert_allclose(whole.paid, -whole.cost - whole.crashed)
    trace = rollout(load_scenario(brief["scenario"]).loop(guard, guard.uses), learner.attack, keys)
    np.testing.assert_array_equal((trace.collided | trace.rear_collided).any(axis=0), out.crashed)
    assert json.loads(path.read_text())["training"] == {"learner": "cem"}


def test_two_runs_of_a_seed_and_a_resumed_one_agree(brief, tmp_path):
    """Same seed, same file; interrupted and resumed, the same as well; another seed, another file; another pool, no resuming."""
    whole = run(brief, 3 * ROUND).export(tmp_path / "whole", {}).with_suffix(".safetensors").read_bytes()
    run(brief, 1, checkpoint=tmp_path / "check")
    second = Learner(0, 0.99, SMALL, Duel.make(**brief), attacks("fdi:value=-4", "none"))
    second.load(tmp_path / "check")
    assert second.generation == 1
    second.learn(3 * ROUND, lambda progress: None)
    assert second.export(tmp_path / "resumed", {}).with_suffix(".safetensors").read_bytes() == whole
    assert run(brief, 1, seed=1).export(tmp_path / "other", {}).with_suffix(".safetensors").read_bytes() != whole
    with pytest.raises(InputError, match="checkpoint"):
        Learner(0, 0.99, SMALL, Duel.make(**brief), attacks("none")).load(tmp_path / "check")


def test_it_begins_at_the_defence_as_it_is():
    """Before training the mean chooses the menu's setting nearest to the defence's own, whatever it sees."""
    learner = Learner(0, 0.99, SMALL, Duel.make(**(ROAD | {"menu": {}})), attacks("none"))
    seen = np.random.default_rng(0).normal(size=(20, 15)).astype(np.float32)
    assert (np.argmax(learner.network(seen), axis=1) == 9).all()
    assert (np.argmax(constant(learner.duel, 4)(seen), axis=1) == 4).all()


TINY = [
    "name=tiny", "steps=1", "rounds=1", "episodes=6", "rivals=[]", "environment.interval=50", "menu.thresholds=[8, 20]", "menu.modes=[normal]",
    "attacker={population: 4, episodes: 2, hidden: [2]}", "defender={population: 4, episodes: 2, hidden: [2]}",
]  # fmt: skip


def test_a_run_from_the_command_line(brief, tmp_path, monkeypatch, capsys):
    """Table and JSON agree; resumed with one round more it trains only that round; without --resume the run is set aside."""
    import tailgate.selfplay as module

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "SELECT_EPISODES", 8)
    assert cli.main(["selfplay", *TINY, f"scenario={brief['scenario']}", "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    home = tmp_path / "runs/tiny"
    assert out == json.loads((home / "report.json").read_text())
    pairs = {(row["defender"], row["attack"]) for row in out["table"]}
    assert pairs == {(g, a) for g in ("as it is", "best fixed setting", "trained") for a in ("none", "attacker-1", "fresh-0", "fresh-fixed-0")}
    share = {(row["defender"], row["attack"]): row["collisions"]["value"] for row in out["table"]}
    assert out["exploitability"]["trained"]["value"] == share["trained", "fresh-0"] - share["trained", "attacker-1"]
    assert out["fixed_minus_trained"]["value"] == share["best fixed setting", "fresh-fixed-0"] - share["trained", "fresh-0"]
    assert not list(home.glob("checkpoint*"))
    stamp = {name: (home / name).stat().st_mtime_ns for name in ("attacker-1.json", "defender-1.json", "fresh-fixed-0.json")}
    assert cli.main(["selfplay", "--resume", "name=tiny", "rounds=2"]) == 0
    text = capsys.readouterr().out
    assert "exploitability, trained" in text and re.search(r"attacker-2 .*%", text)
    assert {name: (home / name).stat().st_mtime_ns for name in stamp} == stamp
    assert json.loads((home / "report.json").read_text())["defender"].endswith("defender-2.json")
    assert cli.main(["selfplay", "--resume", "name=tiny", "gamma=0.5"]) == cli.EXIT_INPUT
    assert "gamma" in capsys.readouterr().err


@pytest.mark.parametrize("wrong, words", [
    (["defence=kf"], ["steered defence"]), (["learner=xyz"], ["learner", "cem"]), (["attacker.populations=3"], ["populations"]),
    (["menu.interval=3"], ["environment.interval"]), (["scenario=thesis-ch5-v0", "defence=chi2_dkf:eta=22.8"], ["reward"]), (["name=a/b"], ["name"]),
    (["rivals=[stealth]"], ["rivals"]), (["environment.scenario=x"], ["environment", "scenario"]), (["menu=3"], ["menu", "mapping"]),
    (["defence=os:path"], ["command line only"]), (["roundss=3"], ["rounds"]), (["--resume", "name=nobody"], ["nobody"]),
])  # fmt: skip
def test_bad_configurations(wrong, words, tmp_path, monkeypatch, capsys):
    """One clear line, and nothing is written."""
    monkeypatch.chdir(tmp_path)
    assert cli.main(["selfplay", *wrong]) == cli.EXIT_INPUT
    err = capsys.readouterr().err
    assert all(word in err for word in words), err
    assert not (tmp_path / "runs").exists()


def test_the_preset():
    """The preset is what the documentation says: gate and mode of chi2_kf."""
    config = load_config(None, ["steps=7"])
    assert isinstance(config, GameConfig) and config.steps == 7 and config.defence == "chi2_kf"
    assert Duel.make(config.scenario, config.defence, config.menu).settings.shape == (15, 2)
    assert isinstance(Duel.make(config.scenario, config.defence, config.menu).guard, Steered)
