"""Search attacks against a published board by another method than the ensemble that made it, and say how far its figures fall.

    python benchmarks/outside.py radar-v1 --minutes 30 [--seed 0] [--json FILE]

The attacks are those of `feedback`: a trigger, bursts and pauses, a kind, a later kind, and for each wire a feedback of the road.
So each wire has another value, unlike in the scripts of the ensemble, and there is no hidden layer, unlike in its networks.
Random attacks of all kinds come first. The best combinations of kinds, wires and triggers are then searched by CMA-ES.
Each ranked figure at black box that leaves more than 10 % undamaged gets the same time, in the scenario of its worst attack.
The best attack of a search then meets 2000 fresh episodes. A faster machine tries more, so the seed alone does not repeat a search.
"""

from __future__ import annotations

import argparse
import json
import lzma
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from cmaes import CMA

from tailgate.agents.scripts.feedback import FEATURES, fed_back, road
from tailgate.base.errors import InputError
from tailgate.base.pytree import map_leaves
from tailgate.core import Array, Command, View, draws
from tailgate.core.draws import Draws, Keys
from tailgate.core.kinds import AIRED, EFFECTS, Kind
from tailgate.core.scenario import load_suite
from tailgate.core.threat import Brief, receivers
from tailgate.engine.agreement import ROWS, Untraced
from tailgate.ensemble.battery import battery_of
from tailgate.ensemble.search import Arena
from tailgate.ensemble.space import TRIGGERS

KINDS = Kind.FDI, Kind.DOS_JAM, Kind.DOS_HOLD, Kind.DROPOUT, Kind.NOISE_JAM, Kind.ECHO_DELAY
RANDOM, EPISODES, PLACES, GROUP, FRESH = 512, 32, 8, 16, 2000
FIRST_FRESH = 100_000  # beyond every episode that a board or the ensemble has played
NEVER = 1 << 30


class Numbers(NamedTuple):
    """The numbers of B attacks."""

    weights: Array  # (B, N, w, FEATURES)
    target: Array  # (B, N, w) bool
    kind: Array  # (B,)
    later: Array  # (B,)
    switch: Array  # (B,) steps of the window before the later kind
    trigger: Array  # (B,) place in TRIGGERS
    threshold: Array  # (B,)
    start: Array  # (B,)
    burst: Array  # (B,)
    pause: Array  # (B,)


class Memory(NamedTuple):
    """The attacks of B episodes and their state; every leaf has B first."""

    numbers: Numbers
    opened: Array  # (B,) bool
    elapsed: Array  # (B,) steps since the trigger fired
    lead_speed: Array  # (B, N)


@dataclass(frozen=True)
class Many:
    """Another `feedback` in each row."""

    def decide(self, plan: Brief, memory: Memory, view: View, draws: Draws) -> tuple[Memory, Command]:
        """Return the next memory and the commands."""
        one, scene = memory.numbers, view.scene
        level, trigger = one.threshold[:, None], one.trigger[:, None]
        brakes = (memory.lead_speed - scene.lead_speed) / plan.model.dt
        holds = trigger == 0
        for place, seen in enumerate((-scene.gap, scene.speed, -scene.speed, scene.speed - scene.lead_speed, brakes), 1):
            limit = -level if place in (1, 3) else level
            holds = np.where(trigger == place, seen > limit, holds)
        ready = (view.k >= one.start) & (view.k >= plan.threat.onset)
        opened = memory.opened | (ready & holds.any(axis=1))
        on = opened & view.allowed & (memory.elapsed % (one.burst + one.pause) < one.burst)
        raw = fed_back(one.weights, road(view, memory.elapsed, plan.model.dt))
        kind = np.where(memory.elapsed < one.switch, one.kind, one.later)
        value = np.zeros(raw.shape)
        for number in (Kind.FDI, Kind.DOS_JAM, Kind.NOISE_JAM, Kind.ECHO_DELAY):
            if number.name.lower() in plan.threat.kinds:
                sent = EFFECTS[number].clip(plan.limits, raw if number in (Kind.FDI, Kind.DOS_JAM) else np.abs(raw))
                value = np.where((kind == number)[:, None, None], sent, value)
        target = on[:, None, None] & one.target
        hit = target.any(axis=(1, 2))
        command = Command(np.where(hit, kind, 0).astype(np.int8), target, np.where(target, value, 0.0))
        return Memory(one, opened, memory.elapsed + opened, np.array(scene.lead_speed)), command


class Choice(NamedTuple):
    """The choices that CMA-ES leaves as they are."""

    kind: int
    later: int
    wires: int  # place among the sets
    agent: int  # -1: all
    trigger: int
    bursts: bool


class Search:
    """A search against one defence in one scenario at one dose."""

    def __init__(self, arena: Arena, seed: int) -> None:
        self.arena, self.rng, self.next = arena, np.random.default_rng([seed, 77]), 0
        brief, space = arena.loop.brief, arena.space
        self.brief, self.road = brief, arena.space.road
        self.kinds = [kind for kind in KINDS if kind.name.lower() in brief.threat.kinds]
        self.sets, self.agents, self.triggers = space.wires, [-1, *(i for i in space.agents if i is not None)], space.triggers
        granted = brief.granted
        self.size = granted.shape[1] * FEATURES + 4
        self.heard = receivers(brief)

    def choose(self) -> Choice:
        pick = self.rng.integers
        kind = int(self.kinds[pick(len(self.kinds))])
        later = int(self.kinds[pick(len(self.kinds))]) if self.rng.random() < 0.4 else kind
        return Choice(kind, later, int(pick(len(self.sets))), self.agents[int(pick(len(self.agents)))],
                      TRIGGERS.index(self.triggers[int(pick(len(self.triggers)))]), bool(self.rng.random() < 0.5))  # fmt: skip

    def start(self) -> Array:
        scale = np.array([2.0, 0.5, 0.5, 0.5, 0.5])
        wires = self.brief.granted.shape[1]
        return np.concatenate([(self.rng.standard_normal((wires, FEATURES)) * scale).ravel(), self.rng.uniform(-1.0, 1.0, 4)])

    def numbers(self, attacks: list[tuple[Choice, Array]]) -> Numbers:
        """Return the numbers of attacks; each is a choice and its vector (size,)."""
        brief, count = self.brief, len(attacks)
        agents, wires = brief.granted.shape
        budget = max(brief.horizon if brief.threat.budget is None else brief.threat.budget, 1)
        end = brief.horizon if brief.threat.end is None else min(brief.threat.end, brief.horizon)
        weights, target = np.zeros((count, agents, wires, FEATURES)), np.zeros((count, agents, wires), bool)
        whole, level = np.zeros((count, 7), np.int64), np.zeros(count)
        for i, (choice, vector) in enumerate(attacks):
            unit = 1.0 / (1.0 + np.exp(-3.0 * vector[-4:]))  # in (0, 1)
            weights[i] = np.round(vector[:-4].reshape(wires, FEATURES), 3)
            names = self.sets[choice.wires]
            target[i] = brief.granted & np.array([not names or name in names for name in brief.model.wires])
            if {choice.kind, choice.later} & set(map(int, AIRED)):
                target[i] &= self.heard
            if choice.agent >= 0:
                target[i] &= (np.arange(agents) == choice.agent)[:, None]
            first = 1
            if choice.trigger:
                low, high = self.road[TRIGGERS[choice.trigger]]
                level[i] = round(low + (high - low) * unit[0], 2)
            else:
                first = brief.threat.onset + int((end - brief.threat.onset) * unit[0])
            burst = max(1, round((budget / 2.0) ** unit[1])) if choice.bursts else NEVER
            whole[i] = (choice.kind, choice.later, max(1, int(budget * unit[3])) if choice.later != choice.kind else NEVER,
                        choice.trigger, first, burst, max(1, round(30.0 ** unit[2])) if choice.bursts else 0)  # fmt: skip
        kind, later, switch, trigger, first_step, burst_of, pause = whole.T
        return Numbers(weights, target, kind, later, switch, trigger, level, first_step, burst_of, pause)

    def scores(self, attacks: list[tuple[Choice, Array]], episodes: int) -> Array:
        """Return the mean score (A,) of attacks, each over the same tune episodes, which this search plays for the first time."""
        first, self.next = self.next, self.next + episodes
        arena, numbers, total = self.arena, self.numbers(attacks), len(attacks)
        keys, reach = draws.keys("tune", range(first, first + episodes)), arena.reach("tune", first, episodes)
        few = self.memory(map_leaves(lambda leaf: leaf[np.arange(ROWS) % total], numbers))
        battery: Any = battery_of(arena.loop, Many(), arena.loop.brief, few)
        if isinstance(battery, Untraced):
            raise InputError("attack", battery, "a traced one")
        each, scores = max(4096 // (episodes * self.brief.granted.shape[0]), 1), []
        for begin in range(0, total, each):
            some = np.arange(begin, min(begin + each, total))
            many = Keys(np.tile(keys.key, (len(some), 1)), np.tile(keys[1], len(some)))
            rows = np.repeat(some, episodes)
            played = battery.play(many, self.memory(map_leaves(lambda leaf, rows=rows: leaf[rows], numbers)))
            clean = None if reach is None else np.tile(reach, len(some))
            scores.append(arena.score(played, clean).reshape(len(some), episodes).mean(axis=1))
        return np.concatenate(scores)

    def memory(self, numbers: Numbers) -> Memory:
        count = np.zeros(len(numbers.kind), np.int64)
        return Memory(numbers, count > 0, count, np.full((len(count), self.brief.granted.shape[0]), -np.inf))

    def text(self, choice: Choice, vector: Array) -> str:
        """Return an attack as on a command line."""
        one, wires = map_leaves(lambda leaf: leaf[0], self.numbers([(choice, vector)])), self.brief.model.wires
        kind, later = Kind(choice.kind), Kind(choice.later)
        parts = [f"kind={kind.name.lower()}"]
        if later != kind:
            parts += [f"later={later.name.lower()}", f"switch={one.switch}"]
        hit = np.any(one.target, axis=0)
        if choice.wires:
            parts.append(f"targets=[{','.join(name for name, on in zip(wires, hit, strict=True) if on)}]")
        if choice.agent >= 0:
            parts.append(f"agents=[{choice.agent}]")
        parts.append(f"trigger={TRIGGERS[choice.trigger]},threshold={one.threshold!s}" if choice.trigger else f"start_step={one.start}")
        if choice.bursts:
            parts.append(f"burst={one.burst},pause={one.pause}")
        if EFFECTS[kind].valued or EFFECTS[later].valued:
            weights = one.weights[0].tolist()
            parts += [f"weights.{name}=[{','.join(map(str, held))}]" for name, held, on in zip(wires, weights, hit, strict=True) if on]
        return f"feedback:{','.join(parts)}"

    def run(self, seconds: float) -> tuple[tuple[Choice, Array], int]:
        """Search for so long; return the best attack and how many were tried."""
        until, tried = time.monotonic() + seconds, 0
        best: list[tuple[float, Choice, Array]] = []
        attacks: list[tuple[Choice, Array]] = []
        while not tried or time.monotonic() < until - 0.65 * seconds:
            attacks = [(self.choose(), self.start()) for _ in range(RANDOM)]
            score = self.scores(attacks, EPISODES)
            tried += len(attacks)
            best += [(float(value), *attack) for value, attack in zip(score, attacks, strict=True)]
            best = sorted(best, key=lambda one: -one[0])[:64]
        starts: list[tuple[float, Choice, Array]] = []
        for one in best:  # the best of each choice
            if all(one[1] != other[1] for other in starts):
                starts.append(one)
        runs = [(choice, CMA(mean=vector, sigma=0.4, population_size=GROUP, seed=int(self.rng.integers(1 << 30))))
                for _, choice, vector in starts[:PLACES]]  # fmt: skip
        finals: list[tuple[float, Choice, Array]] = list(best[:4])
        rounds = 0
        while time.monotonic() < until:
            rounds += 1
            asked = [(choice, [cma.ask() for _ in range(GROUP)], cma) for choice, cma in runs]
            attacks = [(choice, vector) for choice, vectors, _ in asked for vector in vectors]
            score = self.scores(attacks, EPISODES)
            tried += len(attacks)
            for i, (choice, vectors, cma) in enumerate(asked):
                mine = score[i * GROUP : (i + 1) * GROUP]
                cma.tell([(vector, -float(value)) for vector, value in zip(vectors, mine, strict=True)])
                top = int(np.argmax(mine))
                finals.append((float(mine[top]), choice, vectors[top]))
                finals.append((float(mine[top]), choice, np.array(cma.mean)))
            finals = sorted(finals, key=lambda one: -one[0])[:48]
            if rounds % 12 == 0 and len(runs) > 2:  # half of the runs go on
                reached = {choice: max((value for value, other, _ in finals if other == choice), default=0.0) for choice, _ in runs}
                runs = sorted(runs, key=lambda one: -reached[one[0]])[: len(runs) // 2]
        again = self.scores([(choice, vector) for _, choice, vector in finals], 256)
        top = finals[int(np.argmax(again))]
        return (top[1], top[2]), tried


def figures(board: dict[str, Any]) -> list[tuple[str, int, str, str, float]]:
    """Return the figures that can fall: defence, dose, scenario, the worst attack there, and its damage."""
    found = []
    for entry in board["entries"]:
        if entry["rank"] is None:
            continue
        for rate in entry["rates"]:
            if rate["knowledge"] == "black" and rate["undamaged"] and rate["undamaged"]["value"] > 0.1:
                worst = rate["worst"]
                found.append((entry["defence"], rate["dose"], worst["scenario"], worst["attack"], 1.0 - rate["undamaged"]["value"]))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("board")
    parser.add_argument("--minutes", type=float, default=30.0, help="of the whole search")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    suite, folder = load_suite(args.board), Path(__file__).parents[1] / "results" / args.board
    packed = folder / "board.json.xz"
    held = lzma.decompress(packed.read_bytes()) if packed.exists() else (folder / "board.json").read_bytes()
    todo = figures(json.loads(held))
    if not todo:
        parser.error(f"{args.board} has no ranked figure of black box attacks that could fall")
    print(f"{len(todo)} searches of {60 * args.minutes / len(todo):.0f} s")
    print("| defence | dose | scenario | published | found | points | tried | attack |\n| --- | --- | --- | --- | --- | --- | --- | --- |")
    out = []
    for defence, dose, place, attack, published in todo:
        arena = Arena(suite.name, place, dose, defence, dict(suite.granted), suite.bound, suite.progress)
        try:
            search = Search(arena, args.seed)
            (choice, vector), tried = search.run(60 * args.minutes / len(todo))
            text = search.text(choice, vector)
            damage, _ = arena.confirmed(text, "report", FIRST_FRESH, FRESH)
        except InputError as error:
            print(f"| `{defence}` | {dose} | {place} | {error} |", flush=True)
            continue
        row = {
            "defence": defence, "dose": dose, "scenario": place, "published": published, "found": damage, "tried": tried, "attack": text,
            "published_attack": attack,
        }  # fmt: skip
        out.append(row)
        points = f"{published:.1%} | {damage:.1%} | {100 * (damage - published):+.1f}"
        print(f"| `{defence}` | {dose} | {place} | {points} | {tried} | `{text}` |", flush=True)
        if args.json:
            args.json.write_text(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
