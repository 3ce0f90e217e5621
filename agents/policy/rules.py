"""A decision tree as an attack: rules that a person can read, in one JSON file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from tailgate.agents.policy.network_policy import PolicyAttack, PolicyPlan, Seen
from tailgate.base.errors import InputError, unknown
from tailgate.base.files import write_json
from tailgate.base.reading import load_json
from tailgate.core import Array, param
from tailgate.core.registry import register
from tailgate.core.schema import as_data, build
from tailgate.core.threat import Brief

FORMAT = "tailgate-rules-1"
DEEPEST = 32  # levels of a tree, at most


@dataclass(frozen=True)
class Leaf:
    """The end of a branch: one action of the codec, by its number."""

    action: int


@dataclass(frozen=True)
class Split:
    """A branch for observations with a component above the threshold, and one for the others."""

    component: int
    threshold: float
    above: Split | Leaf
    below: Split | Leaf


@dataclass(frozen=True)
class Tree:
    """A decision tree over observations. Its outputs are 1 for the chosen action and 0 for others, as those of a network that is sure."""

    root: Split | Leaf
    outputs: int

    lstm: ClassVar[None] = None
    log_std: ClassVar[None] = None
    squashed: ClassVar[bool] = False

    def __call__(self, observation: Array) -> Array:
        """Return the outputs (B, o) for observations (B, d)."""
        action = _chosen(self.root, np.asarray(observation, np.float64))
        return np.where(action[:, None] == np.arange(self.outputs), 1.0, 0.0)


def _chosen(node: Split | Leaf, seen: Array) -> Array:
    if isinstance(node, Leaf):
        return np.full(len(seen), node.action)
    return np.where(seen[:, node.component] > node.threshold, _chosen(node.above, seen), _chosen(node.below, seen))


@dataclass(frozen=True, kw_only=True)
class RulesHeader(Seen):
    """The JSON file of rules."""

    format: Literal["tailgate-rules-1"]
    actions: tuple[str, ...]
    tree: dict[str, Any]

    masked: ClassVar[bool] = False
    squashed: ClassVar[bool] = False
    greedy: ClassVar[bool] = True


def save_rules(path: Path, root: Split | Leaf, actions: tuple[str, ...], header: dict[str, Any]) -> Path:
    """Write rules as JSON; `header` holds the fields of `Seen`. Return the file."""
    data = {"format": FORMAT} | as_data(header) | {"actions": list(actions), "tree": _as_data(root, header["observation"], actions)}
    path = path.with_suffix(".json")
    write_json(path, data)
    return path


def _as_data(node: Split | Leaf, names: tuple[str, ...], actions: tuple[str, ...]) -> dict[str, Any]:
    if isinstance(node, Leaf):
        return {"do": actions[node.action]}
    above, below = (_as_data(part, names, actions) for part in (node.above, node.below))
    return {"if": names[node.component], "above": node.threshold, "then": above, "else": below}


def load_rules(path: Path) -> tuple[RulesHeader, Tree]:
    """Return rules from their file; raise InputError when it is missing, damaged, or says what does not exist."""
    where = f"rules {path.name}"
    try:
        data = load_json(path)
    except OSError as error:
        raise InputError("rules", str(path), f"a readable file ({error.strerror})") from None
    except ValueError as error:
        raise InputError(where, str(path), f"valid JSON ({error})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise InputError(where, data.get("format") if isinstance(data, dict) else data, f"a JSON object of format {FORMAT!r}")
    header = build(RulesHeader, data, where)
    return header, Tree(_node(header.tree, header, f"{where}.tree", 0), len(header.actions))


def _node(data: object, header: RulesHeader, where: str, depth: int) -> Split | Leaf:
    if depth > DEEPEST:
        raise InputError(where, depth, f"at most {DEEPEST} levels")
    if isinstance(data, dict) and set(data) == {"do"}:
        if data["do"] not in header.actions:
            raise unknown(f"{where}.do", str(data["do"]), header.actions)
        return Leaf(header.actions.index(data["do"]))
    if not isinstance(data, dict) or set(data) != {"if", "above", "then", "else"}:
        raise InputError(where, data, "a mapping of `if`, `above`, `then` and `else`, or of `do` alone")
    if data["if"] not in header.observation:
        raise unknown(f"{where}.if", str(data["if"]), header.observation)
    threshold = data["above"]
    if type(threshold) not in (int, float) or not np.isfinite(threshold):
        raise InputError(f"{where}.above", threshold, "a finite number")
    above, below = (_node(data[name], header, f"{where}.{name}", depth + 1) for name in ("then", "else"))
    return Split(header.observation.index(data["if"]), float(threshold), above, below)


@register("attack", "rules")
@dataclass(frozen=True)
class RulesAttack(PolicyAttack):
    """Rules from a JSON file: a decision tree that was distilled from a learned policy, or written by hand."""

    path: Path = param(Path("rules.json"), "the JSON file of rules")

    @cached_property
    def _loaded(self) -> tuple[RulesHeader, Tree]:  # type: ignore[override]
        return load_rules(self.path)

    def prepare(self, brief: Brief) -> PolicyPlan:
        plan = super().prepare(brief)
        held, names = self._loaded[0].actions, tuple(mode.name for mode in plan.action.modes)
        if names != held:
            raise InputError(f"rules {self.path.name}.actions", list(held), f"those of this threat model: {', '.join(names)}")
        return plan
