"""Search a published board again with members of the present ensemble, and say how far its figures fall.

    python benchmarks/searched_again.py radar-v1 [--budget quick] [--seed 0] [--workers 2] [--json FILE]

Each ranked figure at black box that leaves more than 10 % undamaged is searched: by `scripts` and `transfer` in every scenario, by
`feedback`, `segments` and `ghosts` in that of its worst attack, or in every one if nothing does harm yet. The best attack of each search
then meets 2000 fresh episodes. The same seed finds the same attacks.
"""

from __future__ import annotations

import argparse
import json
import lzma
import re
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from tailgate.base.pool import each
from tailgate.core.scenario import load_suite
from tailgate.ensemble.members import BUDGETS, Hunt, harvest
from tailgate.ensemble.search import Arena

FRESH, FIRST_FRESH = 2000, 100_000  # episodes, beyond every one that a board or the ensemble has played


class Figure(NamedTuple):
    """A figure that can fall."""

    board: str
    defence: str
    dose: int
    scenario: str  # of its worst attack
    attack: str
    published: float  # share of damaged episodes


def figures(name: str, board: dict[str, Any]) -> list[Figure]:
    """Return the figures of a board that can fall."""
    return [
        Figure(name, entry["defence"], rate["dose"], worst["scenario"], worst["attack"], 1.0 - rate["undamaged"]["value"])
        for entry in board["entries"] if entry["rank"] is not None for rate in entry["rates"] for worst in [rate["worst"]]
        if rate["knowledge"] == "black" and rate["undamaged"] and rate["undamaged"]["value"] > 0.1
    ]  # fmt: skip


def searched(figure: Figure, budget: str, seed: int) -> dict[str, Any]:
    """Search against one defence at one dose; return the worst attack on fresh episodes."""
    suite, found = load_suite(figure.board), []
    with tempfile.TemporaryDirectory() as folder:
        for place in suite.scenarios:
            arena = Arena(suite.name, place, figure.dose, figure.defence, dict(suite.granted), suite.bound, suite.progress)
            here = place == figure.scenario or not figure.published
            only = ("scripts", "feedback", "segments", "ghosts", "transfer") if here else ("scripts", "transfer")
            best = [one.found[0].attack for one in harvest(Hunt(arena, BUDGETS[budget], seed, Path(folder), only=only)) if one.found]
            found += [(arena.confirmed(attack, "report", FIRST_FRESH, FRESH)[0], place, attack) for attack in best]
    damage, place, attack = max(found, key=lambda one: one[0])
    attack = re.sub(r"path=\S*/", "path=", attack)
    return figure._asdict() | {
        "published_attack": figure.attack, "found": damage, "found_in": place, "attack": attack, "budget": budget, "seed": seed,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("board")
    parser.add_argument("--budget", choices=list(BUDGETS), default="quick")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    folder = Path(__file__).parents[1] / "results" / args.board
    packed = folder / "board.json.xz"
    held = lzma.decompress(packed.read_bytes()) if packed.exists() else (folder / "board.json").read_bytes()
    todo = figures(args.board, json.loads(held))
    if not todo:
        parser.error(f"{args.board} has no ranked figure of black box attacks that could fall")
    print("| defence | dose | published | found | points | scenario | attack |\n| --- | --- | --- | --- | --- | --- | --- |")
    out: dict[int, dict[str, Any]] = {}
    for number, row in each(searched, [(figure, args.budget, args.seed) for figure in todo], args.workers):
        out[number] = row
        points = f"{row['published']:.1%} | {row['found']:.1%} | {100 * (row['found'] - row['published']):+.1f}"
        print(f"| `{row['defence']}` | {row['dose']} | {points} | {row['found_in']} | `{row['attack']}` |", flush=True)
        if args.json:
            args.json.write_text(json.dumps([out[i] for i in sorted(out)], indent=1) + "\n")


if __name__ == "__main__":
    main()
