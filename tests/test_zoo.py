"""The zoo: packaged policies that play as files do, and files that cannot do harm."""

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tailgate import cli
from tailgate.agents.policy import zoo
from tailgate.agents.policy.network_policy import PolicyAttack, load_policy
from tailgate.agents.policy.zoo import ZooAttack, zoo_card, zoo_names, zoo_path
from tailgate.base.errors import InputError
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.evaluation.cells import evaluate
from tailgate.play.trace import rollout
from tailgate.studies.collect import BYTES, POINTS, add_policy, add_run, single, thinned
from tailgate.studies.policies import loop_for, trained
from tailgate.training.train import environment_of, recorded

ROOT = Path(__file__).parents[1]
RUN = ROOT / "results" / "quickstart-v0"
FIRST = ZooAttack().name


@pytest.fixture
def copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The first policy in a zoo of its own, that a test may damage."""
    for suffix in (".json", ".safetensors"):
        shutil.copy(zoo_path(FIRST).with_suffix(suffix), tmp_path)
    monkeypatch.setattr(zoo, "FOLDER", tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", zoo_names())
def test_every_policy_has_its_record_and_is_small(name: str) -> None:
    """Who trained it, for how long, against what, and what it did; its files agree with their hash and fit the cell of their training."""
    card, who = zoo_card(name), trained(f"zoo:name={name}")
    assert card["summary"] and card["learner"] and card["decisions"] > 0 and isinstance(card["seed"], int)
    assert 2 <= len(card["curve"]) <= POINTS and len(card["environment"]) == 16
    measured = card["measured"]
    assert measured["purpose"] == "report" and measured["episodes"] >= 100
    assert measured["low"] <= measured["value"] <= measured["high"]
    assert zoo_path(name).with_suffix(".safetensors").stat().st_size <= BYTES
    assert who.scenario is not None and who.defence is not None
    loop_for(who, who.scenario, who.defence, who.threat)
    assert {path.stem for path in zoo.FOLDER.glob("*.safetensors")} == set(zoo_names())


@pytest.mark.thin(3)  # policies of one search have one environment
@pytest.mark.parametrize("name", zoo_names())
def test_the_recorded_environment_is_that_of_its_record(name: str) -> None:
    """The hash is that of the environment which the training's configuration makes today: it can be trained again as it was."""
    record = load_policy(zoo_path(name))[0].training
    config = recorded(record["config"])
    assert Seat.make(gamma=config.gamma, **environment_of(config)).card()["hash"] == record["environment"]


GROUPS = {name.rpartition("-")[0]: name for name in reversed(zoo_names())}  # the first policy of each search
LONG = ("highway", "platoon")  # ten seconds to a minute each


@pytest.mark.thin(60)
@pytest.mark.parametrize("group", [pytest.param(name, marks=[pytest.mark.long] if name.startswith(LONG) else []) for name in sorted(GROUPS)])
def test_the_recorded_outcome_is_what_the_policy_does(group: str) -> None:
    """Of every search the first policy, played again on the report seeds, has its recorded mean, and no attack has its own."""
    if group.startswith("highway"):
        pytest.importorskip("highway_env")
    text = f"zoo:name={GROUPS[group]}"
    who, measured = trained(text), zoo_card(GROUPS[group])["measured"]
    assert who.scenario is not None and who.defence is not None
    rows = evaluate(
        scenarios=[who.scenario], defences=[who.defence], attacks=[text, "none"], doses=[None], seeds=measured["episodes"], threat=who.threat,
    )  # fmt: skip
    for attack, told in ((text, measured), ("none", measured["no_attack"])):
        mine = [row[measured["outcome"]] for row in rows if row["attack"] == attack]
        assert sum(mine) / len(mine) == pytest.approx(told["value"], rel=1e-12, abs=1e-12), attack


def test_a_copy_with_single_precision_plays_bit_for_bit(tmp_path: Path) -> None:
    """The weights come from a float32 optimiser: halving their file changes no trace."""
    path = add_policy(RUN / "policy-1.json", "copy", "a copy", episodes=8, folder=tmp_path)
    who = trained(str(RUN / "policy-1.json"))
    assert who.scenario is not None and who.defence is not None
    loop, keys = loop_for(who, who.scenario, who.defence, who.threat), draws.keys("train", range(12))
    old, new = (rollout(loop, PolicyAttack(p), keys) for p in (RUN / "policy-1.json", path))
    assert (old.kind != 0).any()
    assert [old.trace_hash(i) for i in range(12)] == [new.trace_hash(i) for i in range(12)]
    assert path.with_suffix(".safetensors").stat().st_size < 0.6 * (RUN / "policy-1.safetensors").stat().st_size
    record, source = load_policy(path)[0].training, load_policy(RUN / "policy-1.json")[0]
    assert record["source_sha256"] == source.sha256 and record["config"] == source.training["config"]


def test_weights_that_single_precision_would_change_are_kept() -> None:
    """1/3 has no float32 of equal value, 0.25 has."""
    assert single(np.array([0.25])).dtype == np.float32
    assert single(np.array([0.25, 1 / 3])).dtype == np.float64


def test_a_thinned_curve_keeps_its_ends() -> None:
    """At most 50 points, the first and the last among them; a short curve stays."""
    curve = list(range(1234))
    short = thinned(curve)
    assert len(short) == 50 and short[0] == 0 and short[-1] == 1233 and short == sorted(set(short))
    assert thinned(curve[:7]) == curve[:7]


def test_the_zoo_plays_as_the_file_does() -> None:
    """`zoo:name=NAME` and its JSON file give the same trace and see the same."""
    who = trained(f"zoo:name={FIRST}")
    assert who.scenario is not None and who.defence is not None
    loop, keys = loop_for(who, who.scenario, who.defence, who.threat), draws.keys("train", range(6))
    attack = Spec("attack", f"zoo:name={FIRST}").make()
    one, other = rollout(loop, attack, keys), rollout(loop, PolicyAttack(zoo_path(FIRST)), keys)
    assert [one.trace_hash(i) for i in range(6)] == [other.trace_hash(i) for i in range(6)]
    assert attack.knowledge == who.header.knowledge and attack.sees_measurement == who.header.sees_measurement
    assert attack.learned and attack.sources == [zoo_path(FIRST)]


@pytest.mark.long
def test_a_policy_keeps_its_kinds_where_more_are_granted() -> None:
    """A threat model that grants more kinds of attack changes nothing of what a policy does."""
    own = {"kinds": ["dos_jam", "fdi"], "budget": 20, "fdi_bound": 3.0}
    rows = [
        evaluate(scenarios=["gusty-stop-and-go-v0"], defences=["chi2_kf"], attacks=[f"zoo:name={FIRST}"], seeds=4, threat=own | {"kinds": kinds})
        for kinds in (own["kinds"], ["dos_hold", "fdi", "dropout", "dos_jam"])
    ]  # fmt: skip
    assert all(row["status"] == "ok" and row["attack_steps"] > 0 for row in rows[0])
    assert [row["trace_hash"] for row in rows[0]] == [row["trace_hash"] for row in rows[1]]


def test_where_a_policy_does_not_fit_its_rows_are_skipped() -> None:
    """Another scenario has another observation: a pairing without meaning, with the reason."""
    rows = evaluate(scenarios=["thesis-ch5-v0"], defences=["norm_resilient"], attacks=[f"zoo:name={FIRST}"], doses=[None], seeds=2)
    assert [row["status"] for row in rows] == ["skipped"] * 2 and FIRST in rows[0]["reason"]


@pytest.mark.parametrize("name", ["../policies/" + FIRST, f"{FIRST}.json", "", "/etc/passwd", "car-following-chi2_kf"])
def test_a_name_that_is_not_in_the_zoo_is_refused(name: str) -> None:
    """Paths are no names; the error lists what there is."""
    with pytest.raises(InputError, match=FIRST):
        ZooAttack(name)


def test_an_unknown_name_is_one_clear_error_with_a_suggestion() -> None:
    with pytest.raises(InputError, match=f"did you mean '{FIRST[:-1]}"):
        Spec("attack", f"zoo:name={FIRST[:-1]}").make()


class _Bomb:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


@pytest.mark.parametrize("how", ["pickle", "flipped bit", "truncated", "path outside", "pickle as JSON"])
def test_a_damaged_file_is_refused_and_nothing_runs(copied: Path, how: str) -> None:
    """Whatever stands in the files, loading reads numbers or raises InputError."""
    data, tensors, mark = copied / f"{FIRST}.json", copied / f"{FIRST}.safetensors", copied / "ran"
    facts, blob = json.loads(data.read_text()), tensors.read_bytes()
    bomb = pickle.dumps(_Bomb(mark))
    if how == "pickle":  # with a hash that agrees
        import hashlib

        tensors.write_bytes(bomb)
        data.write_text(json.dumps(facts | {"sha256": hashlib.sha256(bomb).hexdigest()}))
    elif how == "flipped bit":
        tensors.write_bytes(blob[:-1] + bytes([blob[-1] ^ 1]))
    elif how == "truncated":
        tensors.write_bytes(blob[:1000])
    elif how == "path outside":
        data.write_text(json.dumps(facts | {"tensors": f"../{FIRST}.safetensors"}))
    else:
        data.write_bytes(bomb)
    with pytest.raises(InputError):
        _ = ZooAttack(FIRST).knowledge
    assert not mark.exists()
    pickle.loads(bomb)
    assert mark.exists()  # the bomb would have worked


def test_a_damaged_file_is_an_error_and_not_a_skipped_pairing(copied: Path) -> None:
    (copied / f"{FIRST}.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match="sha256"):
        evaluate(scenarios=["gusty-stop-and-go-v0"], defences=["kf"], attacks=[f"zoo:name={FIRST}"], doses=[None], seeds=1)


@pytest.mark.parametrize("name", ["../escape", "a/b", "", ".hidden", "x.json"])
def test_a_bad_name_is_not_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=r"zoo\.name"):
        add_policy(RUN / "policy-0.json", name, "a sentence", episodes=2, folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_nothing_is_replaced_unasked(tmp_path: Path) -> None:
    add_policy(RUN / "policy-0.json", "one", "first", episodes=2, folder=tmp_path)
    with pytest.raises(InputError, match="not taken"):
        add_policy(RUN / "policy-1.json", "one", "second", episodes=2, folder=tmp_path)
    add_policy(RUN / "policy-1.json", "one", "second", episodes=2, folder=tmp_path, replace=True)
    assert load_policy(tmp_path / "one.json")[0].training["summary"] == "second"


def test_a_directory_without_policies_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="training run"):
        add_run(tmp_path, "name")


@pytest.mark.parametrize(("curve", "words"), [(5, "got 5"), ([1, 2], "points"), ({"a": 1}, "points"), ([{"reward": float("nan")}], "finite")])
def test_a_curve_that_is_none_is_one_clear_error(tmp_path: Path, curve: Any, words: str) -> None:
    """And nothing is written."""
    for suffix in (".json", ".safetensors"):
        shutil.copy(RUN / f"policy-0{suffix}", tmp_path)
    path = tmp_path / "policy-0.json"
    data = json.loads(path.read_text())
    path.write_text(json.dumps(data | {"training": data["training"] | {"curve": curve}}))
    with pytest.raises(InputError, match=rf"policy-0\.training.*{words}"):
        add_policy(path, "one", "a sentence", episodes=2, folder=tmp_path / "zoo")
    assert not (tmp_path / "zoo").exists()


def test_list_shows_the_zoo(capsys: pytest.CaptureFixture[str]) -> None:
    """As a table of its own behind the attacks, and as JSON."""
    assert cli.main(["list", "attacks", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [card["name"] for card in found["zoo"]] == zoo_names() and "zoo" in {card["name"] for card in found["attacks"]}
    assert cli.main(["list", "zoo"]) == 0
    table = capsys.readouterr().out
    assert all(name in table for name in zoo_names()) and zoo_card(FIRST)["sha256"][:12] in table
