"""The standard attack ensemble: many scripts in one program, the search, and the command."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core import draws
from tailgate.core.draws import Keys
from tailgate.core.kinds import EFFECTS, Kind
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_suite
from tailgate.engine.agreement import Untraced
from tailgate.ensemble import members, networks, standard
from tailgate.ensemble import search as searching
from tailgate.ensemble.battery import Played, Scripts, battery_of, played_plainly, remembered
from tailgate.ensemble.gradient import Pace
from tailgate.ensemble.members import Budget
from tailgate.ensemble.networks import Learner, Race, learned, starts_of
from tailgate.ensemble.search import Arena, Effort, search
from tailgate.ensemble.space import FAMILIES, GENES, NEVER
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout

EVERY = {"kinds": tuple(kind.name.lower() for kind in Kind if kind and not EFFECTS[kind].over_air)}
AIR = {"kinds": ("noise_jam", "echo_delay", "fdi", "dos_jam"), "jam_power": 60.0, "delay_bound": 60.0}
PLACES = {
    "car": ("gusty-stop-and-go-v0", "chi2_kf", 30, EVERY), "radar": ("radar-braking-v0", "chi2_kf", 9, AIR),
    "platoon": ("platoon-gusty-v0", "dkf", 40, EVERY | {"agents": (1, 2)}), "network": ("network-restless-v0", "dkf", 20, EVERY),
}  # fmt: skip
EPISODES = 3
SMALL = Effort(64, 3)


def arena(name, **changes):
    scenario, defence, dose, threat = PLACES[name]
    return dataclasses.replace(Arena("test", scenario, dose, defence, dict(threat), 5.0 if name == "network" else None), **changes)


def played(place, scripts, plainly=False):
    """Play scripts on the same episodes."""
    count, loop, attack = len(scripts.length), place.loop, Scripts(len(scripts.phases) > 1)
    keys = draws.keys("tune", range(EPISODES))
    many = Keys(np.tile(keys.key, (count, 1)), np.tile(keys[1], count))
    memory = remembered(scripts.take(np.repeat(np.arange(count), EPISODES)), loop.model.agents)
    if plainly:
        return played_plainly(loop, attack, loop.brief, many, memory)
    made = battery_of(loop, attack, loop.brief, remembered(scripts.take(np.arange(64) % count), loop.model.agents))
    assert not isinstance(made, Untraced), made
    return made.play(many, memory)


def as_evaluated(place, text):
    """Return the outcome of an attack as `evaluate` plays it, and if it attacked."""
    spec = Spec("attack", text)
    attack = spec.make()
    trace = rollout(place.seat(spec.entry.knowledge, attack), attack, draws.keys("tune", range(EPISODES)))
    gap = METRICS["min_gap"](trace) if place.loop.model.followers.any() else np.full(EPISODES, np.inf)
    return Played(METRICS["crashed"](trace) > 0, gap, METRICS["max_error"](trace)), bool((trace.kind != 0).any())


def assert_same(place, found, wanted, text):
    """Collisions, smallest gaps and largest errors are equal to the last bit."""
    assert np.array_equal(found.ended, wanted.ended), text
    if place.loop.model.followers.any():
        first = place.loop.plant.scene(place.loop.plan.plant, place.loop.start(draws.keys("tune", range(EPISODES))).plant)
        before = np.min(first.gap[:, place.loop.model.followers], axis=1)
        assert np.array_equal(np.minimum(found.gap, before), wanted.gap), text
    else:
        assert np.array_equal(found.error, wanted.error), text


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.thin(2) if name in ("platoon", "network") else ()) for name in PLACES]
)
def test_a_row_plays_what_its_text_says(name):
    """For every family of scripts."""
    place, rng = arena(name), np.random.default_rng(7)
    space, count, attacked = place.space, 3 * len(place.space.families), 0
    genomes = rng.random((count, len(GENES)))
    genomes[:, 0] = (np.arange(count) % len(space.families) + 0.5) / len(space.families)
    outcome = played(place, space.scripts(genomes))
    for i, text in enumerate(map(space.text, genomes)):
        wanted, on = as_evaluated(place, text)
        assert_same(place, Played(*(part[i * EPISODES : (i + 1) * EPISODES] for part in outcome)), wanted, text)
        attacked += on
    assert attacked > count / 3
    assert {f.name for f in space.families} == {f.name for f in FAMILIES if {f.kind, f.then or f.kind} <= _granted(place)}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.thin(2) if name in ("platoon", "network") else ()) for name in PLACES]
)
def test_a_row_plays_what_the_file_of_its_program_says(name, tmp_path):
    """Both phases, whatever ends the first."""
    place, rng = arena(name), np.random.default_rng(8)
    space, count, attacked = place.programs, 2 * len(place.programs.families), 0
    genomes = rng.random((count, space.genes))
    genomes[:, 0] = (np.arange(count) % len(space.families) + 0.5) / len(space.families)
    genomes[:, -1] *= 0.5
    outcome = played(place, space.scripts(genomes))
    for i, genome in enumerate(genomes):
        wanted, on = as_evaluated(place, space.text(genome, tmp_path))
        assert_same(place, Played(*(part[i * EPISODES : (i + 1) * EPISODES] for part in outcome)), wanted, space.label(genome))
        attacked += on
    assert attacked > count / 4


def test_programs_around_scripts_hold_them():
    """A script that changes its kind is split into two phases that do the same."""
    place = arena("car")
    genomes = np.random.default_rng(9).random((200, len(GENES)))
    space, programs = place.space, place.programs
    several = [
        g
        for g in genomes
        if space.family(g).then and space.rows(g[None]).burst[0] == NEVER and space.budget - 1 > space.rows(g[None]).switch[0]
    ]
    assert several
    first = programs.around(space, np.array(several), np.random.default_rng(0))
    one, two = played(place, space.scripts(np.array(several))), played(place, programs.scripts(first))
    near = np.abs(one.gap - two.gap) < 0.05
    assert np.mean(near) > 0.8 and np.unique(np.round(one.gap, 2)).size > 10


def _granted(place):
    return {Kind[name.upper()] for name in place.threat["kinds"]}


def test_the_plain_loop_plays_the_same():
    place = arena("radar")
    scripts = place.space.scripts(np.random.default_rng(1).random((40, len(GENES))))
    fast, plain = played(place, scripts), played(place, scripts, plainly=True)
    assert all(np.array_equal(a, b) for a, b in zip(fast, plain, strict=True)) and plain.ended.any()


def test_numbers_lie_within_the_threat_model():
    """The channel refuses nothing that the space proposes for its value."""
    for name in PLACES:
        space = arena(name).space
        rows = space.rows(np.random.default_rng(3).random((500, len(GENES))))
        for number in set(rows.kind.tolist()):
            effect, here = EFFECTS[number], rows.kind == number
            if effect.valued:
                value = np.broadcast_to(rows.base[here, None, None], rows.target[here].shape)
                assert effect.grants(space.brief.limits, effect.clip(space.brief.limits, value)).all()
        assert (rows.burst >= 1).all() and (rows.start >= 1).all() and not (rows.target & ~space.brief.granted).any()
        assert len({space.text(genome) for genome in np.random.default_rng(4).random((50, len(GENES)))}) > 45


def test_a_search_finds_what_no_listed_attack_does():
    """A late echo that waits for a slow car: the board's attacks damage 3 % of the episodes, the search over 35 %."""
    suite = load_suite("radar-v0")
    place = Arena(suite.name, "radar-braking-v0", 4, "chi2_kf", dict(suite.threat), suite.bound)
    told = []
    found = search(place, place.space, Effort(512, 4), tell=lambda *words: told.append(words))
    best = place.best(map(place.space.text, found[:6]))
    assert best[0].damage > 0.35 and best[0].attack.startswith("echo_") and best[0].episodes == searching.FINAL
    assert [one.score for one in best] == sorted((one.score for one in best), reverse=True)
    assert [words[:2] for words in told] == [(n, 4) for n in range(1, 5)]
    assert np.array_equal(search(place, place.space, Effort(512, 4)), found)
    assert not np.array_equal(search(place, place.space, Effort(512, 4), seed=1), found)


def test_a_policy_is_played_as_its_file_says(tmp_path, monkeypatch):
    """One program plays policies of any weights, to the bit of `evaluate`."""
    place = arena("car")
    monkeypatch.setattr(networks, "JUDGED", 64)
    run, rng = Learner(place, "black", starts_of(place, "black", [], 0)[0], 8, 0), np.random.default_rng(0)
    for _ in range(3):
        theta = run.first + rng.standard_normal(run.first.size)
        run.champion = (0.0, theta)
        wanted, _ = as_evaluated(place, run.write(tmp_path, 0))
        assert_same(place, run.played(theta, run.episodes_of("tune", 0, EPISODES)), wanted, "policy")


def test_starts(monkeypatch):
    """Rest, what a script does, at its size and on its wires, and published policies against the defence before others."""
    monkeypatch.setattr(networks, "SHOWN", 8)
    place, script = (
        arena("car", threat={"kinds": ("dos_jam", "fdi"), "fdi_bound": 4.0}),
        "fdi:trigger=near,threshold=40,value=-2,targets=[velocity]",
    )
    starts = starts_of(place, "black", [script], 0)
    assert [start.name for start in starts[:2]] == ["rest", f"as {script}"] and "-chi2_kf-" in starts[2].name
    assert {"fdi-*0.5:velocity", "fdi+", "dos_jam:position"} <= {mode.name for mode in starts[1].plan.action.modes}


def test_policies_are_learned(tmp_path, monkeypatch):
    """From rest alone, a network finds an echo that the gate lets through; the same seed finds the same network."""
    suite = load_suite("radar-v0")
    place = Arena(suite.name, "radar-braking-v0", 9, "kf", dict(suite.threat), suite.bound)
    monkeypatch.setattr(networks, "JUDGED", 128)
    race = Race(16, (networks.Phase(8, 16), networks.Phase(4, 32)))
    texts = learned(place, "black", [], race, 0, tmp_path)
    damage = place.confirmed(texts[0], "select", 0, 128)[0]
    assert damage > place.confirmed("none", "select", 0, 128)[0] + 0.3
    held = [(tmp_path / "policies" / name).read_bytes() for name in sorted(path.name for path in (tmp_path / "policies").iterdir())]
    assert learned(place, "black", [], race, 0, tmp_path) == texts
    assert held == [path.read_bytes() for path in sorted((tmp_path / "policies").iterdir())]
    assert race.episodes(3, 1) == 3 * 128 + 3 * (8 * 16 * 16 + 128) + 2 * (4 * 32 * 16 + 128)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setitem(members.BUDGETS, "quick", Budget(SMALL, SMALL, 6, ((2, 8), (1, 8)), Pace(16, 1, 1, 8)))
    for name, value in (("JUDGED", 64), ("SHOWN", 8), ("COPIED", 64)):
        monkeypatch.setattr(networks, name, value)
    monkeypatch.setattr(members, "FINALISTS", 1)
    for name, value in (("FINAL", 16), ("MORE", 8), ("KEPT", 8)):
        monkeypatch.setattr(searching, name, value)
    monkeypatch.setattr(standard, "FINAL", 16)


def test_where_nobody_drives_an_error_is_damage(small):
    place = arena("network")
    found = place.best([place.space.text(search(place, place.space, Effort(64, 1))[0])])
    assert 0.0 <= found[0].damage <= 1.0
    with pytest.raises(InputError, match="bound: got None; expected an error that counts as damage"):
        search(dataclasses.replace(place, bound=None), place.space, SMALL)


WORDS = [
    "attack",
    "chi2_kf",
    "--suite",
    "radar-v0",
    "--scenario",
    "radar-braking-v0",
    "--dose",
    "4",
    "--budget",
    "quick",
    "--episodes",
    "20",
    "--workers",
    "1",
]


def test_the_command(small, tmp_path, capsys, monkeypatch):
    """It compares with the suite's attacks, writes scripts that `evaluate` plays, and goes on where it was ended."""
    assert main([*WORDS, "--out", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    (cell,) = report["cells"]
    assert report["ensemble"] == "standard-v0" and cell["listed"]["attack"] in load_suite("radar-v0").attacks
    assert cell["found"]["episodes"] == 20 and cell["found"]["low"] <= cell["found"]["damage"] <= cell["found"]["high"]
    assert json.loads((tmp_path / "attack.json").read_text()) == report
    attacks = (tmp_path / "attacks.txt").read_text().splitlines()
    own = {one["member"]: one for one in cell["members"]}
    assert list(own) == ["scripts", "programs", "transfer", "networks", "grey networks", "white box", "gradient"]
    assert attacks == [one["attack"] for one in own.values() if one["attack"]] and cell["found"]["attack"] in attacks
    assert [one["knowledge"] for one in own.values()] == ["black"] * 4 + ["grey", "white", "white"]
    assert own["programs"]["attack"].startswith("program:path=") and own["networks"]["attack"].startswith("policy:path=")
    evaluate = ["evaluate", "--suite", "radar-v0", "--scenario", "radar-braking-v0", "--dose", "4", "--defence", "chi2_kf", "--seeds", "20"]
    evaluate += [word for attack in attacks for word in ("--attack", attack)]
    assert main([*evaluate, "--out", str(tmp_path / "again.jsonl")]) == 0
    rows = [json.loads(line) for line in (tmp_path / "again.jsonl").read_text().splitlines()]
    assert own["gradient"]["why"] == "the threat model grants nothing for it"
    for one in own.values():
        assert one["attack"] is None or sum(row["crashed"] for row in rows if row["attack"] == one["attack"]) / 20 == one["damage"]
    monkeypatch.setattr(standard, "searched", lambda *_: pytest.fail("searched again"))
    assert main([*WORDS, "--out", str(tmp_path)]) == 0
    assert "best of the suite" in capsys.readouterr().out
    next(tmp_path.glob("attacks/*/policies/*-grey-*.safetensors")).with_suffix(".json").unlink()
    with pytest.raises(pytest.fail.Exception, match="searched again"):  # a file that is missing is made again
        main([*WORDS, "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--budget", "huge"], "--budget: got 'huge'; expected one of"),
        (["--dose", "5"], "--dose: got 5; expected one of the suite's"), (["--dose", "much"], "--dose: got 'much'"),
        (["--scenario", "nowhere"], "--scenario: got 'nowhere'"), (["--suite", "nothing"], "suite: got 'nothing'"),
        (["--seed", "-1"], "--seed: got -1"), (["--workers", "0"], "workers: got 0"), (["--episodes", "0"], "episodes: got 0"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_before_anything_is_played(change, message, capsys, tmp_path):
    import re

    assert main([*WORDS, *change, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_defence_without_a_meaning(capsys):
    assert main(["attack", "nobody", "--suite", "radar-v0"]) == 2 and "'nobody'" in capsys.readouterr().err
    assert main(["attack", "cra", "--suite", "quick-v0"]) == 2 and "one with a meaning in suite quick-v0" in capsys.readouterr().err


def test_another_defence_of_the_same_name_is_searched_again(tmp_path, monkeypatch):
    """The file of a finished search is that of the code that was attacked."""
    text = "from tailgate.estimators import GatedKalman\n\n\nclass Mine(GatedKalman):\n    pass\n"
    monkeypatch.syspath_prepend(str(tmp_path))
    names = []
    for extra in ("", "# changed\n"):
        (tmp_path / "edited_defence.py").write_text(text + extra)
        (job,) = standard.jobs_of(load_suite("radar-v0"), "edited_defence:Mine", ["radar-braking-v0"], [4], "quick", 0)
        names.append(job.name)
    assert names[0] != names[1]


def test_a_class_of_ones_own_is_attacked(small, tmp_path, monkeypatch, capsys):
    """The file of a policy does not name it, so that nobody who reads the file imports it."""
    (tmp_path / "attacked_defence.py").write_text("from tailgate.estimators import GatedKalman\n\n\nclass Mine(GatedKalman):\n    pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(members, "MEMBERS", [one for one in members.MEMBERS if one.name in ("scripts", "networks")])
    assert main([WORDS[0], "attacked_defence:Mine", *WORDS[2:], "--out", "found", "--json"]) == 0
    (cell,) = json.loads(capsys.readouterr().out)["cells"]
    scripts, networks = cell["members"]
    assert scripts["attack"] and networks["attack"].startswith("policy:path=found")
    assert "attacked_defence" not in Path(networks["attack"].partition("=")[2]).read_text()


def test_a_scenario_of_ones_own(small, tmp_path, monkeypatch):
    """Its rows carry its name; another content under the same path is searched again; files lie in the folder that was named."""
    source = (Path(__file__).parents[1] / "configs" / "scenarios" / "radar-braking-v0.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(source)
    monkeypatch.setattr(members, "MEMBERS", [one for one in members.MEMBERS if one.name in ("scripts", "networks")])
    suite = dataclasses.replace(load_suite("radar-v0"), name="custom", scenarios=(str(tmp_path / "mine.yaml"),), doses=(4,), robustness=())
    report = standard.attack(suite, "chi2_kf", budget="quick", episodes=8, out=tmp_path / "out")
    (cell,) = report["cells"]
    assert cell["scenario"] == "mine" and cell["listed"]["episodes"] == 8 and all(one["attack"] for one in cell["members"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.yaml", "out"]
    names = [standard.jobs_of(suite, "chi2_kf", (), (), "quick", 0)[0].name]
    (tmp_path / "mine.yaml").write_text(source.replace("horizon: 120", "horizon: 100"))
    assert standard.jobs_of(suite, "chi2_kf", (), (), "quick", 0)[0].name != names[0]


def test_budgets_share_no_file(small, tmp_path, monkeypatch):
    """Two budgets in one folder keep their own policies."""
    monkeypatch.setitem(members.BUDGETS, "standard", members.BUDGETS["quick"])
    monkeypatch.setattr(members, "MEMBERS", [one for one in members.MEMBERS if one.name == "networks"])
    suite = load_suite("radar-v0")
    texts = {
        budget: standard.attack(
            suite, "chi2_kf", scenarios=["radar-braking-v0"], doses=[4], budget=budget, episodes=4, out=tmp_path
        )["cells"][0]["found"]["attack"] for budget in ("quick", "standard")
    }  # fmt: skip
    assert len(set(texts.values())) == 2


def test_a_defence_that_is_not_traced(small, tmp_path, monkeypatch, capsys):
    """Scripts and programs are played in the plain loop; who needs derivatives or a program says why it does not search."""
    (tmp_path / "branching_defence.py").write_text(
        "from tailgate.estimators import GatedKalman\n\n\nclass Mine(GatedKalman):\n"
        "    def step(self, plan, state, received, known_u, draws=None):\n"
        "        if float(received.y.sum()) > 1e30:\n            raise ValueError\n"
        "        return super().step(plan, state, received, known_u, draws)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(searching, "FIRST", 2)
    monkeypatch.setattr(searching, "MORE", 2)
    monkeypatch.setattr(members, "MEMBERS", [one for one in members.MEMBERS if one.name in ("scripts", "networks", "gradient")])
    words = [
        "attack",
        "branching_defence:Mine",
        "--scenario",
        "gusty-stop-and-go-v0",
        "--budget",
        "quick",
        "--episodes",
        "2",
        "--workers",
        "1",
    ]
    assert main([*words, "--json"]) == 0
    scripts, policies, gradients = json.loads(capsys.readouterr().out)["cells"][0]["members"]
    assert (
        scripts["attack"]
        and policies["attack"] is None
        and "traces" in policies["why"]
        and gradients["attack"] is None
        and gradients["why"]
    )


@pytest.mark.parametrize("content", ["[]", "{}", '{"members": [{"found": [{}]}], "listed": null}'])
def test_the_result_of_a_search_is_checked(content, small, tmp_path, capsys):
    (job,) = standard.jobs_of(load_suite("radar-v0"), "chi2_kf", ["radar-braking-v0"], [4], "quick", 0)
    (tmp_path / "searches").mkdir()
    (tmp_path / "searches" / f"{job.name}.json").write_text(content)
    assert main([*WORDS, "--out", str(tmp_path)]) == 2 and "remove the file to search again" in capsys.readouterr().err


def test_the_result_of_a_search_names_no_code(small, tmp_path, capsys, monkeypatch):
    (job,) = standard.jobs_of(load_suite("radar-v0"), "chi2_kf", ["radar-braking-v0"], [4], "quick", 0)
    (tmp_path / "evil_attack.py").write_text("raise SystemExit('executed')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "searches").mkdir()
    held = {"members": [{"found": [{"attack": "evil_attack:Evil"}]}], "listed": None}
    (tmp_path / "searches" / f"{job.name}.json").write_text(json.dumps(held))
    assert main([*WORDS, "--out", str(tmp_path)]) == 2 and "evil_attack" in capsys.readouterr().err


def test_a_threat_model_that_grants_nothing(small, capsys, tmp_path):
    (tmp_path / "none.yaml").write_text(
        "scenarios: [gusty-stop-and-go-v0]\ndoses: [12]\ndefences: [kf]\nattacks: [none]\nthreat: {kinds: []}\nseeds: 4\n"
    )
    words = ["attack", "kf", "--suite", str(tmp_path / "none.yaml"), "--budget", "quick", "--episodes", "4", "--workers", "1", "--json"]
    assert main(words) == 0
    (cell,) = json.loads(capsys.readouterr().out)["cells"]
    own = {one["member"]: one for one in cell["members"]}
    assert all(own[name]["attack"] is None and own[name]["why"] for name in ("scripts", "programs", "networks", "gradient"))


@pytest.mark.parametrize("name", ["a,b", "c[1]", "d:e"])
def test_a_folder_that_no_text_can_hold(name, tmp_path, capsys):
    assert main([*WORDS, "--out", str(tmp_path / name)]) == 2 and "--out" in capsys.readouterr().err and not (tmp_path / name).exists()
