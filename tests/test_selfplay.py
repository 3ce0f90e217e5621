"""Self-play: the defender learns, resumes to the bit, and what it exports plays as it did in training; a run and its report."""

import contextlib
import dataclasses
import hashlib
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import tailgate
from tailgate import cli
from tailgate.agents.learners.cem import Config
from tailgate.agents.learners.selfplay import Learner, Played, constant, play
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base.errors import InputError
from tailgate.cli.selfplay import _print_report
from tailgate.core import Kind, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import config_path, load_scenario
from tailgate.envs.gym.duel import Duel
from tailgate.envs.gym.mixture import Mixture
from tailgate.estimators import Steered
from tailgate.play.trace import rollout
from tailgate.training import selfplay
from tailgate.training.selfplay import Game, GameConfig, load_config

ROAD = {"scenario": "gusty-stop-and-go-v0", "interval": 60, "menu": {"thresholds": [6.0, 1e9], "modes": ["normal", "brake"]}, "knowledge": "black"}
FDI = "fdi:trigger=near,threshold=40,value=-4"
SMALL = Config(population=6, episodes=4, hidden=(4,))
ROUND = 6 * 4 * 5  # decisions of a generation without a collision


def attacks(*names):
    return tuple(Spec("attack", name).make() for name in names)


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    """A scenario file with the road of ROAD and a twelfth of its time."""
    path = tmp_path_factory.mktemp("scenario") / "brief.yaml"
    text = config_path("scenarios", ROAD["scenario"], "scenario").read_text().replace("horizon: 600", "horizon: 50")
    path.write_text(text.replace("end: 500", "end: 50").replace("onset: 50", "onset: 10"))
    return ROAD | {"scenario": str(path), "interval": 10}


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


@pytest.mark.long
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


@pytest.mark.long
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
    "name=tiny", "steps=1", "rounds=1", "episodes=6", "rivals=[dos_jam]", "environment.interval=50", "environment.frames=2", "menu.thresholds=[20, 1.0e+9]",
    "menu.modes=[normal]", "attacker={population: 4, episodes: 2, hidden: [2]}", "defender={population: 4, episodes: 2, hidden: [2]}",
]  # fmt: skip
GUARDS = ("as it is", "best fixed setting", "trained")
NAMES = ("none", "dos_jam", "attacker-1", "fresh-0", "fresh-fixed-0")


@pytest.fixture(scope="module")
def first(brief, tmp_path_factory):
    """The directory in which a run of one round was played, and what the command printed."""
    home, out = tmp_path_factory.mktemp("first"), io.StringIO()
    text = Path(brief["scenario"]).read_text()  # of three times as many steps, so that somebody collides
    (home / "brief.yaml").write_text(text.replace("horizon: 50", "horizon: 150").replace("end: 50", "end: 150"))
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.chdir(home)
        patch.setattr(selfplay, "SELECT_EPISODES", 8)
        assert cli.main(["selfplay", *TINY, f"scenario={home / 'brief.yaml'}", "--json"]) == 0
    return home, json.loads(out.getvalue())


@pytest.fixture
def tiny(first, tmp_path, monkeypatch, capsys):
    """A copy of that run, its report, and how the command is called there."""
    shutil.copytree(first[0] / "runs", tmp_path / "runs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(selfplay, "SELECT_EPISODES", 8)

    def command(*words):
        code = cli.main(["selfplay", *words])
        return code, capsys.readouterr()

    return tmp_path / "runs/tiny", first[1], command


@pytest.mark.long
def test_a_run_from_the_command_line(tiny):
    """Table and JSON agree, and every figure is that of the table; another configuration is not resumed."""
    home, out, command = tiny
    assert out == json.loads((home / "report.json").read_text())
    share = {(row["defender"], row["attack"]): row["collisions"]["value"] for row in out["table"]}
    assert set(share) == {(guard, name) for guard in GUARDS for name in NAMES}
    worst = {guard: out["worst"][guard]["attack"] for guard in GUARDS[1:]}
    for guard, fresh in zip(GUARDS[1:], ("fresh-fixed-0", "fresh-0"), strict=True):
        found, name = out["exploitability"][guard], worst[guard]
        assert out["worst"][guard]["collisions"]["value"] == share[guard, name]
        assert found["attack"] == name and found["value"] == pytest.approx(share[guard, name] - share[guard, "attacker-1"], abs=1e-12)
        assert found["fresh"] == {"attack": fresh, "collisions": found["fresh"]["collisions"]} and found["fresh"]["collisions"]["value"] == share[guard, fresh]
    assert out["worst_fixed_minus_trained"]["value"] == pytest.approx(share[GUARDS[1], worst[GUARDS[1]]] - share["trained", worst["trained"]], abs=1e-12)
    assert not list(home.glob("checkpoint*"))
    code, said = command("--resume", "name=tiny", "gamma=0.5")
    assert code == cli.EXIT_INPUT and "gamma" in said.err


@pytest.mark.long
def test_the_worst_attack_is_chosen_on_select_seeds(tiny):
    """Replayed one by one, no attack does more there than the one that is named, against the trained defender and the fixed setting."""
    home, out, _ = tiny
    place, most = load_scenario(out["config"]["scenario"]).with_threat(**out["config"]["threat"]), []
    for guard, hand in {"trained": {"policy": home / "defender-1.json"}, "best fixed setting": {"setting": out["fixed"]["setting"]}}.items():
        defence = dataclasses.replace(Duel.make(out["config"]["scenario"], "chi2_kf", out["config"]["menu"], interval=50).guard, **hand)
        loop, shares = place.loop(defence, defence.uses), {}
        for name in NAMES:
            attack = PolicyAttack(home / f"{name}.json") if (home / f"{name}.json").is_file() else Spec("attack", name).make()
            trace = rollout(loop, attack, draws.keys("select", range(8)))
            shares[name] = float((trace.collided | trace.rear_collided).any(axis=0).mean())
        assert out["worst"][guard]["select"]["value"] == shares[out["worst"][guard]["attack"]] == max(shares.values())
        most.append(max(shares.values()))
    assert max(most) > 0


@pytest.mark.thin(2)
@pytest.mark.parametrize(
    "select, report, worst, weak",
    [  # collisions in 8 episodes of: none, the script, self-play's last attacker, fresh against trained, fresh against fixed
        ([0, 3, 2, 5, 6], [0, 3, 2, 4, 4], ("fresh-fixed-0", "fresh-fixed-0"), False), ([0, 6, 2, 5, 5], [0, 3, 2, 4, 4], ("dos_jam", "dos_jam"), False),
        ([0, 3, 2, 6, 5], [0, 3, 6, 4, 4], ("fresh-0", "fresh-0"), False), ([0, 0, 0, 0, 0], [0, 0, 0, 0, 0], ("none", "none"), False),
        ([0, 8, 0, 0, 0], [0, 8, 0, 0, 0], ("dos_jam", "dos_jam"), True), ([0, 1, 6, 0, 0], [0, 1, 6, 0, 0], ("attacker-1", "attacker-1"), True),
    ],
)  # fmt: skip
def test_a_weak_search_is_said_to_be_one(select, report, worst, weak, brief, tmp_path, monkeypatch, capsys):
    """Exploitability is that under the worst known attack, chosen on one purpose's seeds and reported on the other's; weak is a search that surely found less."""
    monkeypatch.chdir(tmp_path)
    game = Game(load_config(None, [*TINY, "episodes=8", f"scenario={brief['scenario']}"]), lambda *_: None)
    other = {"select": select, "report": report}

    def played(guard, attack, purpose, episodes):
        name = attack.path.stem if isinstance(attack, PolicyAttack) else next(n for n, made in game.scripts.items() if made is attack)
        crashed = np.arange(8) < other[purpose][NAMES.index(name)] - (guard == "trained" and purpose == "report" and name == worst[0])
        return Played(np.zeros(8), crashed, np.zeros(8), 8)

    monkeypatch.setattr(game, "_play", played)
    files = [tmp_path / f"{name}.json" for name in NAMES[2:]]
    out = game._report({name: name for name in GUARDS}, files[:1], files[1:2], files[2:], 0)
    assert (out["worst"]["trained"]["attack"], out["worst"]["best fixed setting"]["attack"]) == worst
    assert out["worst"]["best fixed setting"]["collisions"]["value"] == report[NAMES.index(worst[1])] / 8
    assert out["worst"]["trained"]["select"]["value"] == select[NAMES.index(worst[0])] / 8
    assert out["worst_fixed_minus_trained"]["value"] == (report[NAMES.index(worst[0])] > 0) / 8
    found = out["exploitability"]["best fixed setting"]
    assert found["weak_search"] is weak and found["attack"] == worst[1] and found["fresh"]["collisions"]["value"] == report[4] / 8
    assert found["value"] == (report[NAMES.index(worst[1])] - report[2]) / 8
    _print_report(out)
    said = " ".join(capsys.readouterr().out.split())
    assert f"exploitability, best fixed setting: at least {100 * found['value']:+.1f} points" in said
    assert said.count("the search was too weak: its fresh attacker does") == 2 * weak
    several = game._report({name: name for name in GUARDS}, files[:1], files[1:], files[1:], 0)["exploitability"]["trained"]
    assert several["fresh"]["attack"] == max(("fresh-0", "fresh-fixed-0"), key=lambda name: select[NAMES.index(name)])  # of several the best


@pytest.mark.long
def test_a_run_that_goes_on_trains_for_the_opponents_of_now(tiny):
    """With a round more the pools are kept, and the fresh attackers are trained for the new defender; one trained for others is trained anew."""
    home, _, command = tiny
    stamp = {name: (home / name).stat().st_mtime_ns for name in ("attacker-1.json", "defender-1.json")}
    (home / "checkpoint-fresh-0-00ff.safetensors").write_bytes(b"of another defender")
    code, said = command("--resume", "name=tiny", "rounds=2")
    assert code == 0 and re.search(r"attacker-2 .*%", said.out)
    assert {name: (home / name).stat().st_mtime_ns for name in stamp} == stamp
    report = json.loads((home / "report.json").read_text())
    assert report["defender"].endswith("defender-2.json") and not list(home.glob("checkpoint*"))

    def digest(name):
        return f"{name}#{hashlib.sha256((home / name).read_bytes()).hexdigest()[:16]}"

    def against(name):
        return json.loads((home / f"{name}.json").read_text())["training"]["against"]

    assert against("fresh-0")["policy"] == digest("defender-2.json")
    assert against("fresh-fixed-0")["setting"] == report["fixed"]["setting"]
    assert against("attacker-2")["policy"] == [digest("defender-0.json"), digest("defender-1.json")]
    assert [one["path"] for one in against("defender-2")] == [digest("attacker-1.json"), digest("attacker-2.json")]

    made = {path.name: path.stat().st_mtime_ns for path in home.glob("*-*.json")}
    assert command("--resume", "name=tiny")[0] == 0
    assert made == {path.name: path.stat().st_mtime_ns for path in home.glob("*-*.json")}  # what is finished is not written again
    first = (home / "attacker-1.json").read_text()
    data = json.loads(first)
    data["training"]["against"]["policy"] = ["defender-0.json#0123456789abcdef"]
    (home / "attacker-1.json").write_text(json.dumps(data))
    assert command("--resume", "name=tiny")[0] == 0
    assert (home / "attacker-1.json").read_text() == first
    (home / "attacker-1.json").write_text("[]")
    code, said = command("--resume", "name=tiny")
    assert code == cli.EXIT_INPUT and "attacker-1.json" in said.err


@pytest.mark.parametrize("text", ["[]", "{", "3", '{"name": "tiny"}', "[" * 100_000], ids=["list", "cut off", "number", "no class", "deep"])
def test_a_damaged_configuration_is_one_error(text, tmp_path, monkeypatch):
    """Of the command and of the game."""
    monkeypatch.chdir(tmp_path)
    config = load_config(None, ["name=tiny"])
    config.directory.mkdir(parents=True)
    (config.directory / "config.json").write_text(text)
    with pytest.raises(InputError, match=r"resume.*config\.json"):
        load_config(None, ["name=tiny"], resume=True)
    with pytest.raises(InputError, match=r"resume.*config\.json"):
        Game(config, lambda *_: None, resume=True)


@pytest.mark.parametrize("wrong, words", [
    (["learner=sac", "attacker={}"], ["learner", "action mode"]), (["learner=ppo"], ["config.attacker", "population", "attacker={}"]),
    (["defence=kf"], ["steered defence"]), (["learner=xyz"], ["learner", "cem"]), (["attacker.populations=3"], ["populations"]),
    (["menu.interval=3"], ["environment.interval"]), (["scenario=thesis-ch5-v0", "defence=chi2_dkf:eta=22.8"], ["reward"]), (["name=a/b"], ["name"]),
    (["rivals=[stealth]"], ["rivals"]), (["environment.scenario=x"], ["environment", "scenario"]), (["menu=3"], ["menu", "mapping"]),
    (["defence=os:path"], ["imports nothing"]), (["roundss=3"], ["rounds"]), (["payoff.scenario=x"], ["config.payoff", "scenario"]), (["--resume", "name=nobody"], ["nobody"]),
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


@pytest.mark.long
@pytest.mark.parametrize("name", ["ppo", "maskable_ppo"])
def test_the_attacker_learns_by_other_learners_too(name, brief, tmp_path, monkeypatch, capsys):
    """A round and its report; what is exported chooses as it was trained to, and the run goes on."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(selfplay, "SELECT_EPISODES", 4)
    small = [line for line in TINY if not line.startswith(("attacker", "steps"))]
    words = [*small, "steps=16", f"learner={name}", "attacker={envs: 2, rollout: 8, batch_size: 8, epochs: 1, hidden: [4]}", f"scenario={brief['scenario']}"]
    assert cli.main(["selfplay", *words, "--json"]) == 0
    out, home = json.loads(capsys.readouterr().out), tmp_path / "runs/tiny"
    assert {row["attack"] for row in out["table"]} == set(NAMES)
    header = json.loads((home / "attacker-1.json").read_text())
    assert header["training"]["learner"] == name and header.get("masked", False) == (name == "maskable_ppo") and header["training"]["steps"] >= 16
    kept = {path.name: path.read_bytes() for path in home.glob("*.safetensors")}
    assert cli.main(["selfplay", "--resume", "name=tiny", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == out and kept == {path.name: path.read_bytes() for path in home.glob("*.safetensors")}
