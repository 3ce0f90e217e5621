"""Rules: a decision tree as an attack, and its distillation from a learned policy."""

import json

import numpy as np
import pytest

from tailgate.agents.policy.rules import Leaf, RulesAttack, Split, Tree, load_rules, save_rules
from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core import Kind, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.play.trace import rollout
from tailgate.studies import distil as distilling
from tailgate.studies.distil import Shown, distil, fitted, game_of, words

THREAT = {"kinds": ("dos_jam", "fdi"), "budget": 20, "fdi_bound": 3.0, "knowledge": "black"}
POLICY = "zoo:name=car-following-chi2_kf-0"


def place():
    loop = load_scenario("gusty-stop-and-go-v0").with_threat(**THREAT).loop(Spec("defence", "chi2_kf").make())
    return loop, ActionCodec(ActionSpec(action="mode", value=-3.0), loop.brief), ObservationCodec(loop.brief)


def written(path, root):
    _, codec, seen = place()
    header = {"action": codec.spec, "observation": seen.names, "knowledge": "black", "agents": 1}
    return save_rules(path, root, tuple(mode.name for mode in codec.modes), header), codec, seen


@pytest.fixture
def near(tmp_path):
    """Rules that inject while the gap is below 40 m."""
    _, codec, seen = place()
    fdi = [mode.name for mode in codec.modes].index("fdi-")
    return written(tmp_path / "near.json", Split(seen.names.index("gap"), 0.8, Leaf(0), Leaf(fdi)))[0]


def test_a_file_is_read_as_it_was_written(near):
    header, tree = load_rules(near)
    assert tree == Tree(Split(header.observation.index("gap"), 0.8, Leaf(0), Leaf(header.actions.index("fdi-"))), len(header.actions))
    seen = np.zeros((3, len(header.observation)), np.float32)
    seen[:, header.observation.index("gap")] = (0.7, 0.75, 0.9)
    assert np.argmax(tree(seen), axis=1).tolist() == [header.actions.index("fdi-")] * 2 + [0] and (tree(seen).sum(axis=1) == 1.0).all()


def test_rules_do_what_they_say(near):
    """They inject in every step with a small gap, as long as the budget lasts; the engine plays the plain loop's bits."""
    loop, _, _ = place()
    attack = RulesAttack(near)
    trace = rollout(loop, attack, draws.keys("tune", range(8)))
    before = np.concatenate([trace.first["gap"][None], trace.signals["gap"]])[:-1, :, 0]
    small = (before < 40.0) & (np.cumsum(before < 40.0, axis=0) <= 20)
    clear = np.abs(before - 40.0) > 1e-3
    assert np.array_equal((trace.kind == Kind.FDI) & trace.live & clear, small & trace.live & clear) and (trace.kind != 0).any()
    keys = draws.keys("tune", range(8))
    plan, state = attack.prepare(loop.brief), loop.start(keys)
    memory = attack.start(plan, 8, keys)
    for k in range(200):
        state, memory, frame = loop.step(state, attack, plan, memory)
        assert np.array_equal(frame.scene.gap[trace.live[k]], trace.signals["gap"][k][trace.live[k]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "rules near.json: got 'other'; expected a JSON object of format"),
        ({"tree": {"do": "fly"}}, r"tree.do: got 'fly'; expected one of"),
        ({"tree": {"if": "gap", "above": 1.0, "then": {"do": "none"}}}, "expected a mapping of `if`, `above`, `then` and `else`"),
        ({"tree": {"if": "mood", "above": 1.0, "then": {"do": "none"}, "else": {"do": "none"}}}, "tree.if: got 'mood'"),
        ({"tree": {"if": "gap", "above": "far", "then": {"do": "none"}, "else": {"do": "none"}}}, "tree.above: got 'far'"),
        ({"actions": ["none"]}, "tree.else.do: got 'fdi-'"), ({"knowledge": "all"}, "knowledge"), ({"extra": 1}, "extra"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused(near, change, message):
    near.write_text(json.dumps(json.loads(near.read_text()) | change))
    with pytest.raises(InputError, match=message):
        load_rules(near)


def test_a_tree_of_any_depth_and_a_missing_file_are_refused(near, tmp_path):
    node = {"do": "none"}
    for _ in range(40):
        node = {"if": "gap", "above": 1.0, "then": node, "else": {"do": "none"}}
    near.write_text(json.dumps(json.loads(near.read_text()) | {"tree": node}))
    with pytest.raises(InputError, match="at most 32 levels"):
        load_rules(near)
    with pytest.raises(InputError, match="a readable file"):
        load_rules(tmp_path / "nothing.json")
    near.write_text("{")
    with pytest.raises(InputError, match="valid JSON"):
        load_rules(near)


def test_rules_of_another_threat_model_are_refused(near):
    brief = load_scenario("gusty-stop-and-go-v0").with_threat(**THREAT | {"kinds": ("fdi",)}).brief()
    with pytest.raises(InputError, match=r"expected .* as environment.action=mode has under this threat model"):
        RulesAttack(near).prepare(brief)


def test_a_tree_is_fitted():
    """Rare actions count as much as frequent ones, and equal leaves are one."""
    rng = np.random.default_rng(0)
    seen = rng.random((5000, 3)).astype(np.float32)
    tree = fitted(Shown(seen, np.where(seen[:, 1] > 0.98, 2, 0)), 4)
    assert (
        isinstance(tree, Split)
        and tree.component == 1
        and abs(tree.threshold - 0.98) < 2e-3
        and tree.above == Leaf(2)
        and tree.below == Leaf(0)
    )
    assert fitted(Shown(seen, np.full(5000, 3)), 4) == Leaf(3)
    assert words(tree, ("a", "gap", "b"), ("none", "x", "y")) == [f"if gap > {tree.threshold * 50:.4g} m:", "  y", "else:", "  none"]


@pytest.fixture
def small(monkeypatch):
    for name, value in (("ROUNDS", 2), ("SHOWN", 32), ("SELECT", 64), ("LEAVES", (2, 4))):
        monkeypatch.setattr(distilling, name, value)


@pytest.mark.long
def test_a_policy_is_distilled(small, tmp_path, capsys):
    """The rules are played by `evaluate`, and lose what the report says."""
    out = tmp_path / "rules.json"
    assert main(["distil", POLICY, "--out", str(out), "--episodes", "60", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["rules"][0].startswith("if ") and report["leaves"] in (2, 4) and report["policy_damage"] > 0.4
    assert (
        report["damage"] > 0.2 and report["difference"]["low"] <= report["damage"] - report["policy_damage"] <= report["difference"]["high"]
    )
    game = game_of(POLICY)
    assert game.damage(f"rules:path={out}", "report", 60).mean() == report["damage"]
    assert distil(POLICY, out, episodes=60)["rules"] == report["rules"]
    assert main(["distil", POLICY, "--out", str(out), "--episodes", "60"]) == 0 and "the rules damage" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words_of", "message"),
    [
        (["fdi"], "policy: got 'fdi'"), ([POLICY, "--leaves", "1"], "--leaves: got 1"), ([POLICY, "--loss", "2"], "--loss: got 2"),
        ([POLICY, "--episodes", "0"], "episodes: got 0"), ([POLICY, "--defence", "nobody"], "'nobody'"),
        (["zoo:name=network-dkf-0"], "--scenario: got 'thesis-ch5-v0'"),
    ],
)  # fmt: skip
def test_bad_input(words_of, message, capsys, tmp_path):
    assert main(["distil", *words_of, "--out", str(tmp_path / "r.json")]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "r.json").exists()
