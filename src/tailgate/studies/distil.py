"""Rules that do what a learned policy does: a small decision tree, distilled from it (VIPER: Bastani, Pu and Solar-Lezama 2018).

Trees play in turn, and the policy says what it would have done in their place. So a tree learns from the states that it gets into itself.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tailgate.agents.learners.learning import header_of
from tailgate.agents.policy.network_policy import PolicyPlan, choose
from tailgate.agents.policy.rules import Leaf, Split, Tree, save_rules
from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.extras import optional
from tailgate.base.files import set_aside
from tailgate.core import Array, draws
from tailgate.core.kinds import EFFECTS
from tailgate.core.spec_text import MARKS
from tailgate.envs.gym.actions import Mode
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.batches import framed, side_by_side
from tailgate.envs.gym.observations import SCALES
from tailgate.envs.gym.rewards import Reward
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.evaluation.stats import paired_difference

from .policies import defence_of, loop_for, scenario_of, trained

ROUNDS = 5  # times that a tree plays and is corrected
SHOWN = 256  # episodes of a round
LEAVES = (2, 3, 4, 6, 8, 12, 16)  # sizes that are tried
SELECT = 400  # episodes that choose among trees of one size
UNITS = {"gap": "m", "rear_gap": "m", "speed": "m/s", "lead_speed": "m/s", "closing": "m/s", "rear_closing": "m/s", "accel": "m/s^2"}
Decide = Callable[[Array], Array]
Tell = Callable[[int, int], None]


class Shown(NamedTuple):
    """D decisions: observations (D, d), and the actions (D,) of the policy there."""

    observation: Array
    action: Array


class Fitted(NamedTuple):
    """A tree, and the share of select episodes that it damages."""

    leaves: int
    damage: float
    tree: Split | Leaf


@dataclass(frozen=True)
class Game:
    """The game of a policy: where it plays, and what it sees and does."""

    scenario: str
    defence: str
    threat: dict[str, Any]
    seat: Seat
    plan: PolicyPlan

    def teacher(self, observation: Array) -> Array:
        """Return the actions (D,) of the policy."""
        return choose(self.plan.network, self.plan.action, observation)

    def played(self, decide: Decide, first: int) -> Shown:
        """Let `decide` play training episodes; return what the policy would have done at every decision that could have an effect."""
        seat, seen = self.seat, None
        episodes = side_by_side(seat)
        episodes.begin(draws.keys("train", range(first, first + SHOWN)))
        over, observations, actions = np.zeros(SHOWN, bool), [], []
        for _ in range(seat.decisions):
            if over.all():
                break
            seen = framed(episodes.seen(), seen, seat.observation.frames)
            counts = ~over & episodes.facts().allowed
            observations.append(seen[counts])
            actions.append(self.teacher(seen[counts]))
            over = over | episodes.decide(decide(seen), over, restart=False).terminated
        return Shown(np.concatenate(observations), np.concatenate(actions))

    def damage(self, attack: str, purpose: str, episodes: int) -> Array:
        """Return (episodes,) bool: the episodes that an attack damages."""
        rows = run_cell(Cell("custom", self.scenario, None, self.defence, attack, episodes, purpose, threat=self.threat))
        if why := next((row["reason"] for row in rows if row["status"] != "ok"), ""):
            raise InputError("attack", attack, f"one that can be played here ({why})")
        return np.array([bool(row["crashed"]) for row in rows])


def game_of(text: str, scenario: str | None = None, defence: str | None = None, threat: dict[str, Any] | None = None) -> Game:
    """Return the game that a policy was trained for, with changes.

    Raises
    ------
    InputError
        For an attack that is no policy with discrete decisions and without memory, and for a place where nobody drives.
    """
    who = trained(text)
    scenario, defence = scenario_of(who, scenario), defence_of(who, defence)
    changes = who.threat | dict(threat or {})
    loop = loop_for(who, scenario, defence, changes)
    plan = who.policy.prepare(loop.brief)
    if not loop.model.followers.any():
        raise InputError("--scenario", scenario, "one where somebody drives: rules are compared by collisions")
    if not plan.action.discrete or plan.network.lstm is not None or plan.masked:
        raise InputError("policy", text, "one with discrete decisions, and without a memory or a mask")
    return Game(scenario, defence, changes, Seat(loop, plan.action, plan.observation, Reward(), {}), plan)


def fitted(shown: Shown, leaves: int) -> Split | Leaf:
    """Return the tree of at most this many leaves that is right most often, each action counting alike.

    Raises ImportError without scikit-learn.
    """
    tree = optional("sklearn.tree", "train", "scikit-learn is missing")
    if len(np.unique(shown.action)) < 2:
        return Leaf(int(shown.action[0]) if len(shown.action) else 0)
    made = tree.DecisionTreeClassifier(max_leaf_nodes=leaves, class_weight="balanced", random_state=0)
    made.fit(shown.observation.astype(np.float32), shown.action)
    held, classes = made.tree_, made.classes_

    def node(at: int) -> Split | Leaf:
        if held.children_left[at] < 0:
            return Leaf(int(classes[np.argmax(held.value[at, 0])]))
        below, above = node(held.children_left[at]), node(held.children_right[at])
        if isinstance(below, Leaf) and below == above:
            return below
        return Split(int(held.feature[at]), float(f"{held.threshold[at]:.6g}"), above, below)

    return node(0)


def words(node: Split | Leaf, names: tuple[str, ...], actions: tuple[str, ...], depth: int = 0) -> list[str]:
    """Return rules as lines of text, with physical units where a component has one. actions: in words."""
    pad = "  " * depth
    if isinstance(node, Leaf):
        return [f"{pad}{actions[node.action]}"]
    name = names[node.component]
    plain = name.partition("@")[0]
    unit = UNITS.get(plain)
    value = f"{node.threshold * SCALES[plain]:.4g} {unit}" if unit else f"{node.threshold:.4g}"
    return [
        f"{pad}if {name} > {value}:", *words(node.above, names, actions, depth + 1),
        f"{pad}else:", *words(node.below, names, actions, depth + 1),
    ]  # fmt: skip


def meaning(mode: Mode) -> str:
    """Return an action in words: its name, with the value that it sends."""
    effect = EFFECTS.get(int(mode.kind))
    if effect is None or not effect.valued:
        return mode.name
    sent = mode.value[mode.target.any(axis=0)]
    values = " / ".join(dict.fromkeys(f"{value:.3g}" for value in sent.tolist()))
    return f"{mode.name}, {values}"


def leaves_of(node: Split | Leaf) -> list[Leaf]:
    """Return the leaves below a node."""
    return [node] if isinstance(node, Leaf) else [*leaves_of(node.above), *leaves_of(node.below)]


def distil(
    text: str, out: Path, *, scenario: str | None = None, defence: str | None = None, threat: dict[str, Any] | None = None,
    leaves: int | None = None, loss: float = 0.05, episodes: int = 400, tell: Tell | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Distil a policy into rules, and write them.

    Parameters
    ----------
    text
        The policy, as on the command line.
    out
        The file of the rules.
    scenario, defence, threat
        Where it plays; by default where it was trained.
    leaves
        Leaves of the tree; by default the fewest that lose no more than `loss`.
    loss
        Share of the episodes that the rules may damage less than the policy.
    episodes
        Report episodes that both are compared on.
    tell
        Called with the number of trees that have been fitted, and their count.

    Returns
    -------
    dict
        `trees`: what each size damages on select episodes; `reached`, if the loss is small enough; `rules`, `file`;
        `policy` and `difference` on report episodes.
    """
    sizes.check("episodes", episodes)
    if leaves is not None and not 2 <= leaves <= 256:
        raise InputError("--leaves", leaves, "a whole number from 2 to 256")
    if not 0.0 <= loss < 1.0:
        raise InputError("--loss", loss, "a share from 0, below 1")
    if out.suffix != ".json" or set(str(out)) & set(MARKS) or text.endswith(str(out)):
        raise InputError("--out", str(out), f"another file, which ends in .json, its path without any of {MARKS}")
    game = game_of(text, scenario, defence, threat)
    counts = (leaves,) if leaves is not None else LEAVES
    goal = float(game.damage(text, "select", SELECT).mean()) - loss
    actions, names = tuple(mode.name for mode in game.plan.action.modes), game.plan.observation.names
    config = {"scenario": game.scenario, "defence": game.defence, "threat": game.threat}
    header = header_of(game.seat, {"summary": f"distilled from {text}", "config": config})
    with tempfile.TemporaryDirectory() as folder:
        trees = _trees(game, counts, goal, header, Path(folder) / "tree.json", tell)
    chosen = next((one for one in trees if one.damage >= goal), max(trees, key=lambda one: one.damage))
    if out.exists():
        set_aside(out)
    file = save_rules(out, chosen.tree, actions, header)
    own, theirs = (game.damage(attack, "report", episodes) for attack in (_attack(file), text))
    found = paired_difference(own.astype(float), theirs.astype(float), share=True)
    return {
        "policy": text, "scenario": game.scenario, "defence": game.defence, "threat": game.threat,
        "file": str(file), "leaves": len(leaves_of(chosen.tree)), "reached": chosen.damage >= goal,
        "rules": words(chosen.tree, names, tuple(map(meaning, game.plan.action.modes))), "episodes": episodes,
        "trees": [{"leaves": one.leaves, "damage": one.damage} for one in trees],
        "damage": float(own.mean()), "policy_damage": float(theirs.mean()),
        "difference": {"value": found.value, "low": found.low, "high": found.high},
    }  # fmt: skip


def _trees(
    game: Game, counts: Sequence[int], goal: float, header: dict[str, Any], file: Path, tell: Tell | None
) -> list[Fitted]:  # fmt: skip
    """Return the best tree of each size, up to the first that reaches the goal. Trees are played from a file."""
    actions = tuple(mode.name for mode in game.plan.action.modes)
    begun, trees = game.played(game.teacher, 0), list[Fitted]()
    for i, count in enumerate(counts):
        shown, best = begun, Fitted(count, -1.0, Leaf(0))
        for number in range(1, ROUNDS + 1):
            tree = fitted(shown, count)
            save_rules(file, tree, actions, header)
            best = max(best, Fitted(count, float(game.damage(_attack(file), "select", SELECT).mean()), tree), key=lambda one: one.damage)
            if tell is not None:
                tell(i * ROUNDS + number, len(counts) * ROUNDS)
            if number < ROUNDS:
                rules = Tree(tree, len(actions))
                more = game.played(lambda seen, rules=rules: np.argmax(rules(seen), axis=1), number * SHOWN)  # type: ignore[misc]
                shown = Shown(*(np.concatenate(parts) for parts in zip(shown, more, strict=True)))
        trees.append(best)
        if best.damage >= goal:
            break
    return trees


def _attack(file: Path) -> str:
    return f"rules:path={file.with_suffix('.json')}"
