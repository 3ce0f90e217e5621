"""The command `tailgate attack`: its report, what it keeps, and what it refuses."""

import dataclasses
import json
import shlex
from pathlib import Path

import pytest

from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core.scenario import Suite, load_suite
from tailgate.ensemble import members, standard
from tailgate.ensemble import search as searching

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


def only(monkeypatch, *names):
    """Let these members search and be reported, and no others."""
    for module in (members, standard):
        monkeypatch.setattr(module, "MEMBERS", [one for one in members.MEMBERS if one.name in names])


@pytest.mark.parametrize("left_out", [("feedback", "segments", "transfer", "grey networks", "white box"), pytest.param((), marks=pytest.mark.long)])
def test_the_command(left_out, small_ensemble, tmp_path, capsys, monkeypatch):
    """It compares with the suite's attacks, writes scripts that `evaluate` plays, and goes on where it was ended."""
    kinds = {"scripts": "black", "programs": "black", "feedback": "black", "segments": "black", "transfer": "black", "networks": "black", "grey networks": "grey", "white box": "white", "gradient": "white"}
    kinds = {name: kind for name, kind in kinds.items() if name not in left_out}
    only(monkeypatch, *kinds)
    assert main([*WORDS, "--out", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    (cell,) = report["cells"]
    assert report["ensemble"] == standard.NAME and cell["listed"]["attack"] in load_suite("radar-v0").attacks
    assert cell["found"]["episodes"] == 20 and cell["found"]["low"] <= cell["found"]["damage"] <= cell["found"]["high"]
    assert json.loads((tmp_path / "attack.json").read_text()) == report
    attacks = (tmp_path / "attacks.txt").read_text().splitlines()
    own = {one["member"]: one for one in cell["members"]}
    assert list(own) == list(kinds)
    harm = [next(one["damage"] for one in own.values() if one["attack"] == attack) for attack in attacks]
    assert set(attacks) == {one["attack"] for one in own.values() if one["attack"]} and harm == sorted(harm, reverse=True) and cell["found"]["attack"] in attacks
    assert [one["knowledge"] for one in own.values()] == list(kinds.values())
    assert own["programs"]["attack"].startswith("program:path=") and own["networks"]["attack"].startswith("policy:path=")
    evaluate = ["evaluate", "--suite", "radar-v0", "--scenario", "radar-braking-v0", "--dose", "4", "--defence", "chi2_kf", "--seeds", "20"]
    evaluate += [word for attack in attacks for word in ("--attack", attack)]
    assert main([*evaluate, "--out", str(tmp_path / "again.jsonl")]) == 0
    rows = [json.loads(line) for line in (tmp_path / "again.jsonl").read_text().splitlines()]
    assert own["gradient"]["why"] == "the threat model grants nothing for it"
    for one in own.values():
        assert one["attack"] is None or sum(row["crashed"] for row in rows if row["attack"] == one["attack"]) / 20 == one["damage"]
    monkeypatch.setattr(standard, "search", lambda *_: pytest.fail("searched again"))
    assert main([*WORDS, "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "best of the suite" in said
    again = shlex.split(said.rpartition("play the most harmful one again: tailgate ")[2])
    assert again[again.index("--attack") + 1] == attacks[0] and again[again.index("--scenario") + 1] == "radar-braking-v0"
    assert main([*again[:-1], str(tmp_path / "most.jsonl"), "--seeds", "20"]) == 0
    assert sum(json.loads(line)["crashed"] for line in (tmp_path / "most.jsonl").read_text().splitlines()) == 20 * harm[0]
    held = "*-grey-*" if "grey networks" in kinds else "*"
    next(tmp_path.glob(f"attacks/*/policies/{held}.safetensors")).with_suffix(".json").unlink()
    with pytest.raises(pytest.fail.Exception, match="searched again"):  # a file that is missing is made again
        main([*WORDS, "--out", str(tmp_path)])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--budget", "huge"], "--budget: got 'huge'; expected one of"),
        (["--dose", "5"], "--dose: got 5; expected one of the suite's"), (["--dose", "much"], "--dose: got 'much'"),
        (["--scenario", "nowhere"], "--scenario: got 'nowhere'"), (["--suite", "nothing"], "suite: got 'nothing'"),
        (["--seed", "-1"], "--seed: got -1"), (["--seed", str(2**32)], "--seed: got 4294967296"), (["--workers", "0"], "workers: got 0"), (["--episodes", "0"], "episodes: got 0"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_before_anything_is_played(change, message, capsys, tmp_path):
    import re

    assert main([*WORDS, *change, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error) and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_place_that_is_named_twice_is_one(monkeypatch):
    """Else its report episodes would count twice."""
    suite = load_suite("radar-v0")
    jobs = standard.jobs_of(suite, "chi2_kf", ["radar-braking-v0"] * 2, [4, 9, 4], "quick", 0)
    assert [job.arena.dose for job in jobs] == [4, 9]
    with pytest.raises(InputError, match=r"threat\.knowledge: got 'black'"):
        standard.jobs_of(dataclasses.replace(suite, threat={"knowledge": "black"}), "chi2_kf", (), (), "quick", 0)
    monkeypatch.setattr(standard, "find_spec", lambda _: None)  # members without torch are searched again with it
    assert standard.jobs_of(suite, "chi2_kf", (), (), "quick", 0)[0].name != jobs[0].name


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


@pytest.mark.long
def test_a_class_of_ones_own_is_attacked(small_ensemble, tmp_path, monkeypatch, capsys):
    """The file of a policy does not name it, so that nobody who reads the file imports it."""
    (tmp_path / "attacked_defence.py").write_text("from tailgate.estimators import GatedKalman\n\n\nclass Mine(GatedKalman):\n    pass\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    only(monkeypatch, "scripts", "networks")
    assert main([WORDS[0], "attacked_defence:Mine", *WORDS[2:], "--out", "found", "--json"]) == 0
    (cell,) = json.loads(capsys.readouterr().out)["cells"]
    scripts, networks = cell["members"]
    assert scripts["attack"] and networks["attack"].startswith("policy:path=found")
    assert "attacked_defence" not in Path(networks["attack"].partition("=")[2]).read_text()


@pytest.mark.long
def test_a_scenario_of_ones_own(small_ensemble, tmp_path, monkeypatch):
    """Its rows carry its name; another content under the same path is searched again; files lie in the folder that was named."""
    source = (Path(__file__).parents[1] / "configs" / "scenarios" / "radar-braking-v0.yaml").read_text()
    (tmp_path / "mine.yaml").write_text(source)
    only(monkeypatch, "scripts", "networks")
    suite = dataclasses.replace(load_suite("radar-v0"), name="custom", scenarios=(str(tmp_path / "mine.yaml"),), doses=(4,), robustness=())
    report = standard.attack(suite, "chi2_kf", budget="quick", episodes=8, out=tmp_path / "out")
    (cell,) = report["cells"]
    assert cell["scenario"] == "mine" and cell["listed"]["episodes"] == 8 and all(one["attack"] for one in cell["members"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.yaml", "out"]
    names = [standard.jobs_of(suite, "chi2_kf", (), (), "quick", 0)[0].name]
    (tmp_path / "mine.yaml").write_text(source.replace("horizon: 120", "horizon: 100"))
    assert standard.jobs_of(suite, "chi2_kf", (), (), "quick", 0)[0].name != names[0]


@pytest.mark.long
def test_budgets_share_no_file(small_ensemble, tmp_path, monkeypatch):
    """Two budgets in one folder keep their own policies."""
    monkeypatch.setitem(members.BUDGETS, "standard", members.BUDGETS["quick"])
    only(monkeypatch, "networks")
    suite = load_suite("radar-v0")
    texts = {
        budget: standard.attack(
            suite, "chi2_kf", scenarios=["radar-braking-v0"], doses=[4], budget=budget, episodes=4, out=tmp_path
        )["cells"][0]["found"]["attack"] for budget in ("quick", "standard")
    }  # fmt: skip
    assert len(set(texts.values())) == 2


@pytest.mark.long
def test_a_defence_that_is_not_traced(small_ensemble, tmp_path, monkeypatch, capsys):
    """Scripts and networks are played in the plain loop; who needs derivatives says why it does not search."""
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
    only(monkeypatch, "scripts", "networks", "gradient")
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
    assert scripts["attack"] and policies["attack"].startswith("policy:") and gradients["attack"] is None and gradients["why"]


@pytest.mark.parametrize("content", ["[]", "{}", '{"members": [{"found": [{}]}], "listed": null}'])
def test_the_result_of_a_search_is_checked(content, small_ensemble, tmp_path, capsys):
    (job,) = standard.jobs_of(load_suite("radar-v0"), "chi2_kf", ["radar-braking-v0"], [4], "quick", 0)
    (tmp_path / "searches").mkdir()
    (tmp_path / "searches" / f"{job.name}.json").write_text(content)
    assert main([*WORDS, "--out", str(tmp_path)]) == 2 and "remove the file to search again" in capsys.readouterr().err


def test_the_result_of_a_search_names_no_code(small_ensemble, tmp_path, capsys, monkeypatch):
    (job,) = standard.jobs_of(load_suite("radar-v0"), "chi2_kf", ["radar-braking-v0"], [4], "quick", 0)
    (tmp_path / "evil_attack.py").write_text("raise SystemExit('executed')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "searches").mkdir()
    held = {"members": [{"found": [{"attack": "evil_attack:Evil"}]}], "listed": None}
    (tmp_path / "searches" / f"{job.name}.json").write_text(json.dumps(held))
    assert main([*WORDS, "--out", str(tmp_path)]) == 2 and "evil_attack" in capsys.readouterr().err


def test_a_threat_model_that_grants_nothing(small_ensemble, capsys, tmp_path):
    (tmp_path / "none.yaml").write_text(
        "scenarios: [gusty-stop-and-go-v0]\ndoses: [12]\ndefences: [kf]\nattacks: [none]\nthreat: {kinds: []}\nseeds: 4\n"
    )
    words = ["attack", "kf", "--suite", str(tmp_path / "none.yaml"), "--budget", "quick", "--episodes", "4", "--workers", "1", "--json"]
    assert main(words) == 0
    (cell,) = json.loads(capsys.readouterr().out)["cells"]
    own = {one["member"]: one for one in cell["members"]}
    assert all(own[name]["attack"] is None and own[name]["why"] for name in ("scripts", "programs", "feedback", "segments", "networks", "gradient"))


@pytest.mark.parametrize("name", ["a,b", "c[1]", "d:e"])
def test_a_folder_that_no_text_can_hold(name, tmp_path, capsys):
    assert main([*WORDS, "--out", str(tmp_path / name)]) == 2 and "--out" in capsys.readouterr().err and not (tmp_path / name).exists()


@pytest.mark.parametrize(("white", "flags"), [(0.2, ["gradient masking"]), (0.4, []), (0.6, [])])
def test_gradients_that_do_less_than_a_black_box_are_flagged(white, flags):
    def member(name, knowledge, damage):
        found = {"attack": "fdi", "damage": damage, "score": damage, "episodes": 512}
        return {"member": name, "knowledge": knowledge, "found": [found], "why": ""}

    members_of = [
        member("scripts", "black", 0.3),
        member("networks", "black", 0.4),
        member("white box", "white", 0.9),
        member("gradient", "white", white),
    ]
    result = {"scenario": "somewhere", "dose": 4, "listed": None, "members": members_of}
    assert standard._compared(result, [], Suite())["flags"] == flags
    assert standard._compared(result | {"members": members_of[:3]}, [], Suite())["flags"] == []


def test_without_a_folder_the_most_harmful_attack_is_named_only_if_it_is_no_file():
    from tailgate.cli.ensemble import _again

    def report(*attacks):
        members = [{"damage": damage, "attack": attack} for damage, attack in attacks]
        return {"defence": "kf", "episodes": 400, "cells": [{"scenario": "braking-v0", "dose": 4, "members": members}]}

    script, file = (0.4, "fdi:value=3"), (0.9, "policy:path=x.json")
    assert "--attack policy:path=x.json --seeds 400 --out" in _again(report(script, file), "quick-v0", kept=True)
    assert _again(report(script, file), "quick-v0", kept=False) == "the most harmful one (90.0% in braking-v0, dose 4) is a file, and no file was kept: --out DIR keeps them"
    assert "--attack fdi:value=3" in _again(report((0.9, "policy:path=x.json"), (0.9, "fdi:value=3")), "quick-v0", kept=False)
    assert "--attack fdi:value=3" in _again(report(script), "quick-v0", kept=False) and _again(report((0.0, None)), "quick-v0", kept=False) == ""
