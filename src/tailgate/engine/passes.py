"""The order of a computation, and the branches that are skipped where no episode of a block needs them.

A number that is needed only on one side of selects with one mask belongs to a branch.
The branch is computed if the mask is true in any lane of the block. These passes find branches; no code declares them.
"""

from __future__ import annotations

import bisect
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from tailgate.engine.graph import Body, Node, Sweep, ordered

_COST = {"const": 0, "uniform": 0, "pick": 0, "loop": 300, "gather": 12, "div": 8, "sqrt": 10, "rem": 20}
LEAST = 12  # least cost of a branch, in additions


@dataclass(eq=False)
class Branch:
    """A part needed only where `mask` is true (`side` 1) or false (`side` 2), and the selects that need it."""

    mask: Node
    side: int
    choices: list[Node]
    inside: set[int]
    cost: int
    body: list[Item] = field(default_factory=list)
    decides: list[Node] = field(default_factory=list)  # selects that are complete after this branch; of the others, one side is known


Item = Node | Branch


def schedule(roots: Iterable[Node], least: int = LEAST) -> list[Item]:
    """Return all that the roots need, except constants and numbers that all episodes share, in the order of computation."""
    wanted = list(roots)
    nodes = [node for node in ordered(wanted) if not node.fixed]
    return _scope(nodes, {node.id for node in wanted}, least)


def rounds(body: Body | Sweep, least: int = LEAST) -> list[Item]:
    """Return a round of a loop or a sweep, in the order of computation."""
    return _scope(body.nodes, {node.id for node in body.after}, least)


def _scope(nodes: Sequence[Node], kept: Collection[int], least: int) -> list[Item]:
    """Return the nodes of one scope with its branches; nodes in `kept` are needed outside the scope."""
    branches = _branches(nodes, kept, least)
    while True:
        try:
            items = _in_order(nodes, branches)
            break
        except _Circle as circle:
            branches.remove(min(circle.branches, key=lambda branch: branch.cost))
    by_id = {node.id: node for node in nodes}
    for branch in branches:
        results = {choice.args[branch.side].id for choice in branch.choices}
        branch.body = _scope([by_id[i] for i in sorted(branch.inside)], results, least)
    return items


# -- finding branches


def _branches(nodes: Sequence[Node], kept: Collection[int], least: int) -> list[Branch]:
    """Return the branches of a scope without their inner branches. Nodes are in the order of their numbers."""
    turns: dict[int, int] = {}  # by select: how many selects with the same mask precede it
    found = _asked(nodes, kept, turns)
    for several in found.values():
        if len(several.choices) > 1 and several.cost >= least:
            turns |= {choice.id: turn for turn, level in enumerate(_levels(nodes, several.choices)) for choice in level if turn}
    if turns:
        found = _asked(nodes, kept, turns)
    return sorted((branch for branch in found.values() if branch.cost >= least), key=lambda branch: -branch.cost)


def _asked(nodes: Sequence[Node], kept: Collection[int], turns: Mapping[int, int]) -> dict[Any, Branch]:
    """Find the outermost branches, by mask, side and turn.

    A path lists the selects (mask, side) around a node, the outermost first. A node gets the path that all its users share.
    """
    nowhere = _Path(None, None, 0)
    by_id = {node.id: node for node in nodes}
    home: dict[int, _Path] = dict.fromkeys(kept, nowhere)
    out: dict[Any, Branch] = {}

    def needed(node: Node, path: _Path) -> None:
        if node.id in by_id:
            held = home.get(node.id)
            home[node.id] = path if held is None else held.meeting(path)

    for node in reversed(nodes):  # users of a node have higher numbers
        path = home.setdefault(node.id, nowhere)
        if path.depth:
            branch = out[path.first]
            branch.inside.add(node.id)
            branch.cost += _cost(node)
        if node.op not in ("select", "blend") or node.args[0].fixed:
            for arg in node.args:
                needed(arg, path)
            continue
        needed(node.args[0], path)
        for side in (1, 2):
            key = (node.args[0].id, side, turns.get(node.id, 0))
            if not path.depth:
                out.setdefault(key, Branch(node.args[0], side, [], set(), 0)).choices.append(node)
            needed(node.args[side], path.to(key))
    for branch in out.values():
        branch.choices = [choice for choice in reversed(branch.choices) if choice.args[branch.side].id in branch.inside]
    return out


class _Path:
    """The selects around a node, the outermost first."""

    def __init__(self, above: _Path | None, key: Hashable, depth: int) -> None:
        self.above, self.depth = above or self, depth
        self.first: Hashable = key if depth <= 1 else self.above.first
        self._ways: dict[Hashable, _Path] = {}

    def to(self, key: Hashable) -> _Path:
        """Append a select."""
        if key not in self._ways:
            self._ways[key] = _Path(self, key, self.depth + 1)
        return self._ways[key]

    def meeting(self, other: _Path) -> _Path:
        """Return the common part of both paths."""
        one, two = self, other
        while one is not two:
            deep = one.depth - two.depth
            one, two = one.above if deep >= 0 else one, two.above if deep <= 0 else two
        return one


def _cost(node: Node) -> int:
    if node.op == "sweep":
        return node.size // max(1, len(node.attr.after)) * (2 + len(node.attr.nodes))
    if node.op == "matvec":
        return 2 * int(node.attr.nodes.size)
    if node.size:
        return node.size * (node.attr if node.op == "invert" else 1)
    return int(node.attr.cost) if node.op == "call" else _COST.get(node.op, 1)


def _levels(nodes: Sequence[Node], choices: list[Node]) -> list[list[Node]]:
    """Group the selects by how many others they depend on. Nodes are in the order of their numbers."""
    mine = {choice.id for choice in choices}
    if len(mine) == 1:
        return [choices]
    begin = bisect.bisect_left(nodes, min(mine), key=lambda node: node.id)
    end = bisect.bisect_right(nodes, max(mine), key=lambda node: node.id)
    depth: dict[int, int] = {}
    levels: dict[int, list[Node]] = {}
    for node in nodes[begin:end]:
        deep = max((depth.get(arg.id, 0) for arg in node.args), default=0)
        if node.id in mine:
            levels.setdefault(deep, []).append(node)
            deep += 1
        if deep:
            depth[node.id] = deep
    return [levels[deep] for deep in sorted(levels)]


# -- ordering


class _Circle(Exception):
    """Branches that wait for one another."""

    def __init__(self, branches: list[Branch]) -> None:
        super().__init__()
        self.branches = branches


def _in_order(nodes: Sequence[Node], branches: Sequence[Branch]) -> list[Item]:
    """Return the scope's nodes outside its branches, each after its arguments, and each branch where it is first needed."""
    home = {i: branch for branch in branches for i in branch.inside}
    by_id = {node.id: node for node in nodes}
    gives: dict[int, list[Branch]] = {}
    for branch in sorted(branches, key=lambda branch: branch.side):
        branch.decides = []
        for choice in branch.choices:
            gives.setdefault(choice.id, []).append(branch)
    for i, several in gives.items():
        several[-1].decides.append(by_id[i])
    needs: dict[int, list[Node]] = {}  # by branch: what must precede it
    for branch in branches:
        found = [branch.mask]
        found += [arg for i in branch.inside for arg in by_id[i].args if arg.id not in branch.inside]
        found += [choice.args[3 - branch.side] for choice in branch.decides if len(gives[choice.id]) == 1]
        needs[id(branch)] = sorted({arg.id: arg for arg in found}.values(), key=lambda node: node.id)
    partner = {
        id(branch): [b for choice in branch.decides for b in gives[choice.id] if b is not branch] for branch in branches
    }  # fmt: skip
    done: set[int] = set()
    items: list[Item] = []
    busy: list[Branch] = []

    def enter(branch: Branch) -> None:
        if id(branch) in done:
            return
        if branch in busy:
            raise _Circle(busy[busy.index(branch) :])
        busy.append(branch)
        for arg in needs[id(branch)]:
            visit(arg)
        for other in partner[id(branch)]:
            enter(other)
        busy.pop()
        done.add(id(branch))
        items.append(branch)
        done.update(choice.id for choice in branch.decides)

    def visit(node: Node) -> None:
        left: list[tuple[Node, bool]] = [(node, False)]
        while left:
            this, ready = left.pop()
            if this.id in done or this.id not in by_id:
                continue
            if this.id in home:
                raise AssertionError(f"{this} is needed outside its branch")
            if this.id in gives:
                for branch in gives[this.id]:
                    enter(branch)
            elif ready or not this.args:
                done.add(this.id)
                items.append(this)
            else:
                left.append((this, True))
                left.extend((arg, False) for arg in reversed(this.args))

    for node in nodes:
        if node.id not in home and (node.args or node.op != "input"):
            visit(node)
    for node in nodes:
        if node.id not in home:
            visit(node)
    return items


def counted(items: Sequence[Item]) -> dict[str, int]:
    """Count the nodes, the branches, and the nodes in branches."""
    out = {"nodes": 0, "branches": 0, "in branches": 0}
    for item in items:
        if isinstance(item, Branch):
            inner = counted(item.body)
            out["nodes"] += inner["nodes"] + len(item.decides)
            out["branches"] += inner["branches"] + 1
            out["in branches"] += inner["nodes"]
        else:
            out["nodes"] += 1
    return out
