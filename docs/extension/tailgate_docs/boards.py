"""The published boards, drawn by the package itself, and pages that lead to them.

As a program, `python -m tailgate_docs.boards ROOT OUT`, it draws all boards while Sphinx builds the rest.
"""

import json
import sys
from pathlib import Path
from typing import Any

from tailgate.board.attachments import Attachments
from tailgate.board.files import load
from tailgate.board.head import markdown as head_of
from tailgate.site.build import build_site, slug

from .docstrings import escaped

WHOLE = ("quick-v1",)  # boards with a replay for each entry; of others for the first of each class


def published(root: Path) -> dict[str, Path]:
    """Return the published boards by suite, the newest edition first."""
    found = {path.parent.name: path for path in (root / "results").glob("*/board.json*")}
    return dict(sorted(found.items(), key=lambda item: (not item[0].endswith("-v1"), item[0] != "quick-v0", item[0])))


def replayed(name: str, board: dict[str, Any]) -> list[str]:
    """Return the defences whose worst episode is played again."""
    if name in WHOLE:
        return [entry["defence"] for entry in board["entries"]]
    first = {entry["class"]: entry["defence"] for entry in reversed(board["entries"]) if entry["rank"]}
    return [entry["defence"] for entry in board["entries"] if entry["defence"] in first.values()]


def _ranked(board: dict[str, Any]) -> int:
    return sum(entry["rank"] is not None for entry in board["entries"])


def _whole(name: str, text: str) -> str:
    """Return a link to the site of a board, which is no page of Sphinx."""
    return f'<a class="whole" href="../../boards/{name}/index.html">{text}</a>'


def page(name: str, path: Path, root: Path) -> str:
    """Return the page that shows the head of a board and leads to the whole of it."""
    board = load(path)
    file = path.relative_to(root)
    made = f"[how it was made](../../results/{name}.md), [scoring](../../scoring.md)"
    return "\n".join([
        f"# {name} (board)", "", escaped(board["suite"]["about"]), "",
        f"{_whole(name, f'Open the whole board of {name}')}: maps, curves, every entry, replays.", "",
        f"The suite is [{name}](../components/suite/{name}.md), the file `{file}`; {made}. Those that take a rank:", "",
        head_of(board, _ranked(board)), "",
        "```console", f"tailgate leaderboard check {file} --workers 2   # plays it again", "```", "",
    ])  # fmt: skip


def index(boards: dict[str, Path]) -> str:
    """Return the page that lists all boards."""
    tree = ["```{toctree}", ":hidden:", ":maxdepth: 1", "", *boards, "```", ""]
    rows = []
    for name, path in boards.items():
        board = load(path)
        rows.append(f"| [{name}]({name}.md) | {len(board['entries'])} | {_ranked(board)} | {_whole(name, 'whole board')} |")
    head = ["# Published boards", "", "Heads are here; a whole board has maps, curves, a page an entry and replays of worst episodes.", ""]
    return "\n".join([*head, *tree, "| board | entries | ranked | all of it |", "|---|---|---|---|", *rows, ""])


def _outcome(row: dict[str, Any]) -> str:
    if row["crashed"]:
        speed = row["impact_speed"]
        return "collision" if speed is None else f"collision at {speed:.1f} m/s"
    return f"least gap {row['min_gap']:.1f} m" if row["min_gap"] is not None else f"largest error {row['max_error']:.2f}"


def gallery(boards: dict[str, Path]) -> str:
    """Return the page of all replays: the worst episodes of entries, step by step."""
    out = [
        "# Gallery of replays", "",
        "The worst episode of an entry, step by step: the road as it is, the road as the car believes it to be, what was sent. "
        "Space plays, arrows move by one step.", "",
        "| a collision | survived |", "|---|---|",
        "| ![A car is led into the one ahead](../images/road-collision.webp) | ![A car keeps its distance](../images/road-survived.webp) |", "",
    ]  # fmt: skip
    for name, path in boards.items():
        board = load(path)
        asked = replayed(name, board)
        out += [f"## {name}", "", "| defence | outcome | scenario | strongest attack |", "|---|---|---|---|"]
        for entry in board["entries"]:
            row = entry["worst_episode"]
            if entry["defence"] in asked and row is not None:
                link = f'<a href="../boards/{name}/{replay(name, entry["defence"])}">{entry["defence"].replace("|", "")}</a>'
                attack = row["attack"].rsplit("/", 1)[-1].replace("|", "")
                out.append(f"| {link} | {_outcome(row)} | {row['scenario']} | `{attack}` |")
        out.append("")
    return "\n".join(out)


def replay(suite: str, defence: str) -> str:
    """Return the path of a replay in the site of its board."""
    return f"{slug(suite, 'a-z0-9_-')}/{slug(defence)}-replay.html"


def draw(root: Path, out: Path) -> None:
    """Draw every published board into `out`/SUITE. Raise ValueError where a replay that the gallery shows was not made."""
    for name, path in published(root).items():
        board = load(path)
        asked = replayed(name, board)
        build_site([board], out / name, title=f"Tailgate: {name}", replays=asked, measured=[Attachments.of(path)])
        listed = json.loads((out / name / "summary.json").read_text(encoding="utf-8"))["entries"]
        held = {entry["defence"]: entry["worst_episode"] for entry in board["entries"]}
        missing = {e["defence"]: e["replay_missing"] for e in listed if e["defence"] in asked and held[e["defence"]] and not e["replay"]}
        if missing:
            raise ValueError(f"{path}: no replay of {missing}")


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(sys.argv[2]))
