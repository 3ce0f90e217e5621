"""The standard attack ensemble: many scripts in one program, the search, and the command."""

import dataclasses
import json

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
from tailgate.ensemble import search as searching
from tailgate.ensemble import standard
from tailgate.ensemble.battery import battery_of, played_plainly
from tailgate.ensemble.search import Arena, Effort, search
from tailgate.ensemble.space import FAMILIES, GENES
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


def repeated(rows, scripts):
    keys = draws.keys("tune", range(EPISODES))
    return Keys(np.tile(keys.key, (scripts, 1)), np.tile(keys[1], scripts)), rows.take(np.repeat(np.arange(scripts), EPISODES))


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.thin(2) if name in ("platoon", "network") else ()) for name in PLACES])
def test_a_row_plays_what_its_text_says(name):
    """Collisions, smallest gaps and largest errors are those of the script, to the last bit, for every family."""
    place, rng = arena(name), np.random.default_rng(7)
    space, count = place.space, 3 * len(place.space.families)
    genomes = rng.random((count, len(GENES)))
    genomes[:, 0] = (np.arange(count) % len(space.families) + 0.5) / len(space.families)
    battery = battery_of(place.loop, space.rows(genomes))
    assert not isinstance(battery, Untraced), battery
    played, follows, attacked = battery.play(*repeated(space.rows(genomes), count)), place.loop.model.followers, 0
    for i, text in enumerate(map(space.text, genomes)):
        attack = Spec("attack", text).make()
        trace = rollout(place._loop(text), attack, draws.keys("tune", range(EPISODES)))
        own = slice(i * EPISODES, (i + 1) * EPISODES)
        assert np.array_equal(played.ended[own], METRICS["crashed"](trace) > 0), text
        if follows.any():
            before = np.min(trace.first["gap"][:, follows], axis=1)
            assert np.array_equal(np.minimum(played.gap[own], before), METRICS["min_gap"](trace)), text
        else:
            assert np.array_equal(played.error[own], METRICS["max_error"](trace)), text
        attacked += bool((trace.kind != 0).any())
    assert attacked > count / 3
    assert {f.name for f in space.families} == {f.name for f in FAMILIES if {f.kind, f.then or f.kind} <= _granted(place)}


def _granted(place):
    return {Kind[name.upper()] for name in place.threat["kinds"]}


def test_the_plain_loop_plays_the_same():
    place = arena("radar")
    rows = place.space.rows(np.random.default_rng(1).random((40, len(GENES))))
    batch = repeated(rows, 40)
    fast, plain = battery_of(place.loop, rows).play(*batch), played_plainly(place.loop, *batch)
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
    best = search(place, Effort(512, 4), tell=lambda *words: told.append(words))
    assert best[0].damage > 0.35 and best[0].script.startswith("echo_") and best[0].episodes == searching.FINAL
    assert [one.score for one in best] == sorted((one.score for one in best), reverse=True)
    assert [words[:2] for words in told] == [(n, 4) for n in range(1, 5)]
    assert search(place, Effort(512, 4)) == best != search(place, Effort(512, 4), seed=1)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setitem(searching.EFFORTS, "quick", SMALL)
    for name, value in (("FINAL", 16), ("MORE", 8), ("KEPT", 8), ("FINALISTS", 1)):
        monkeypatch.setattr(searching, name, value)
    monkeypatch.setattr(standard, "FINAL", 16)


def test_where_nobody_drives_an_error_is_damage(small):
    place = arena("network")
    found = search(place, Effort(64, 1))
    assert found and 0.0 <= found[0].damage <= 1.0
    with pytest.raises(InputError, match="bound: got None; expected an error that counts as damage"):
        search(dataclasses.replace(place, bound=None), SMALL)


WORDS = ["attack", "chi2_kf", "--suite", "radar-v0", "--scenario", "radar-braking-v0", "--dose", "4", "--budget", "quick", "--episodes", "20", "--workers", "1"]


def test_the_command(small, tmp_path, capsys, monkeypatch):
    """It compares with the suite's attacks, writes scripts that `evaluate` plays, and goes on where it was ended."""
    assert main([*WORDS, "--out", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    (cell,) = report["cells"]
    assert report["ensemble"] == "standard-v0" and cell["listed"]["attack"] in load_suite("radar-v0").attacks
    assert cell["found"]["episodes"] == 20 and cell["found"]["low"] <= cell["found"]["damage"] <= cell["found"]["high"]
    assert json.loads((tmp_path / "attack.json").read_text()) == report
    (script,) = (tmp_path / "attacks.txt").read_text().splitlines()
    assert script == cell["found"]["attack"]
    evaluate = ["evaluate", "--suite", "radar-v0", "--scenario", "radar-braking-v0", "--dose", "4", "--defence", "chi2_kf", "--attack", script, "--seeds", "20"]
    assert main([*evaluate, "--out", str(tmp_path / "again.jsonl")]) == 0
    rows = [json.loads(line) for line in (tmp_path / "again.jsonl").read_text().splitlines()]
    assert sum(row["crashed"] for row in rows) / 20 == cell["found"]["damage"]
    monkeypatch.setattr(standard, "searched", lambda *_: pytest.fail("searched again"))
    assert main([*WORDS, "--out", str(tmp_path)]) == 0
    assert "best script found" in (said := capsys.readouterr().out) and script in said.replace("\n", "")


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
