"""The published boards, drawn by the package itself, and pages that lead to them."""

import json
import sys
from pathlib import Path

from tailgate.board.attachments import Attachments
from tailgate.board.files import load
from tailgate.board.head import markdown as head_of
from tailgate.site.build import build_site

REPLAYED = {"quick-v1": True}  # others: the first of each class


def published(root: Path) -> dict[str, Path]:
    """Return the published boards by suite, the newest edition first."""
    found = {path.parent.name: path for path in (root / "results").glob("*/board.json*")}
    return dict(sorted(found.items(), key=lambda item: (not item[0].endswith("-v1"), item[0] != "quick-v0", item[0])))


def page(name: str, path: Path, root: Path) -> str:
    """Return the page that shows the head of a board and leads to the whole of it."""
    board = load(path)
    ranked = sum(entry["rank"] is not None for entry in board["entries"])
    file = path.relative_to(root)
    text = [f"# {name}", "", board["suite"].get("about", "") or f"The board of the suite `{name}`.", ""]
    text += [f'<p><a class="whole" href="../../boards/{name}/index.html"><strong>The whole board of {name}</strong></a>: maps, curves, every entry, replays.</p>', ""]
    text += [f"The suite is [{name}](../components/suite/{name}.md), the file `{file}`.", ""]
    text += ["Those that take a rank:", "", head_of(board, ranked), "", "```console", f"tailgate leaderboard check {file} --workers 2   # play it again", "```", ""]
    return "\n".join(text)


def index(boards: dict[str, Path]) -> str:
    """Return the page that lists all boards."""
    tree = ["```{toctree}", ":hidden:", ":maxdepth: 1", "", *boards, "```", ""]
    rows = []
    for name, path in boards.items():
        board = load(path)
        ranked = sum(entry["rank"] is not None for entry in board["entries"])
        rows.append(f'| [{name}]({name}.md) | {len(board["entries"])} | {ranked} | <a href="../../boards/{name}/index.html">whole board</a> |')
    head = ["# Published boards", "", "Heads are here; a whole board has maps, curves, a page an entry and replays of worst episodes.", ""]
    return "\n".join([*head, *tree, "| board | entries | ranked | |", "|---|---|---|---|", *rows, ""])


def draw(root: Path, out: Path) -> None:
    """Draw every published board into `out`/SUITE, with replays."""
    for name, path in published(root).items():
        board = load(path)
        first = {entry["class"]: entry["defence"] for entry in reversed(board["entries"]) if entry["rank"]}
        replays = REPLAYED.get(name) or set(first.values())
        print(f"board {name}", file=sys.stderr, flush=True)
        build_site([board], out / name, title=name, replays=replays, measured=[Attachments.of(path)])
        listed = json.loads((out / name / "summary.json").read_text(encoding="utf-8"))
        if not listed["entries"]:
            raise ValueError(f"{path}: no entries were drawn")
