"""The site of one or several boards: a page of all suites, a page per entry, and a replay of each entry's worst episode.

OUT/index.html, OUT/summary.json (what was written, with hashes), and for each suite OUT/SUITE/board.json, OUT/SUITE/DEFENCE.html and
OUT/SUITE/DEFENCE-replay.html.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Sequence
from pathlib import Path

from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_atomic, write_html
from tailgate.board.attachments import Attachments
from tailgate.board.files import read_board
from tailgate.board.order import GROUPS, ordered
from tailgate.board.schema import Data

from .entry import Replayed, entry_page, replay_of
from .index import section
from .pages import TITLE, encoded, render
from .suite import Suite

SUMMARY = "tailgate-site-1"
MOST = 60  # characters of a file's name that come from a defence's


def slug(text: str, kept: str = "a-z0-9_") -> str:
    """Return a file name for a text: itself where it holds only such characters, else what is left of it and a hash."""
    plain = re.sub(f"[^{kept}]+", "-", text.lower()).strip("-.")[:MOST].strip("-.")
    if plain and plain == text:
        return plain
    return f"{plain or 'x'}-{hashlib.sha256(text.encode('utf-8', 'backslashreplace')).hexdigest()[:8]}"


def _suites(boards: Sequence[Data]) -> list[Suite]:
    if not boards:
        raise InputError("boards", list(boards), "at least one board")
    suites: list[Suite] = []
    for i, data in enumerate(boards):
        where = "board" if len(boards) == 1 else f"boards[{i}]"
        board = read_board(data, where)
        folder = slug(board.suite.name, "a-z0-9_-")
        if any(folder == other.folder for other in suites):
            raise InputError(f"{where}.suite.name", board.suite.name, "a suite that no other board is of")
        pages = {entry.defence: f"{folder}/{slug(entry.defence)}.html" for entry in board.entries}
        suites.append(Suite(board, folder, pages))
    return suites


def build_site(
    boards: Sequence[Data], out: Path, *, title: str | None = None, replays: bool | Collection[str] = True,
    measured: Sequence[Attachments] = (),
) -> Path:  # fmt: skip
    """Write the site of `boards` (format tailgate-board-1) to the folder `out` and return the path of its first page.

    replays: play each entry's worst episode again and write its page, or those of the named defences. The user has named these, so that
    their classes may be imported. The pages of the others say that it was not done.
    measured: the attachments of each board.
    Raises InputError before anything is written: for no board, two of a suite, a field that breaks the format, and
    attachments of another suite.
    """
    suites = _suites(boards)
    given = list(measured) or [Attachments()] * len(suites)
    attached = [one.belonging(suite.board) for suite, one in zip(suites, given, strict=True)]
    files = {f"{suite.folder}/board.json": encoded(data, "board") for suite, data in zip(suites, boards, strict=True)}
    folder, title = writable_directory(Path(out)), title or TITLE
    sections = [
        section(suite, one) | {"hash": hashlib.sha256(content).hexdigest()}
        for suite, one, content in zip(suites, attached, files.values(), strict=True)
    ]
    first = render("index.html", title=title, sections=sections, statuses=GROUPS)
    hashes = {"index.html": hashlib.sha256(first).hexdigest()}
    listed: list[Data] = []
    for suite, one in zip(suites, attached, strict=True):
        name = suite.board.suite.name
        for entry in ordered(suite.board.entries):
            page = suite.pages[entry.defence]
            also = [(s.board.suite.name, f"../{s.pages[entry.defence]}") for s in suites if s is not suite and entry.defence in s.pages]
            replay = f"{page.removesuffix('.html')}-replay.html"
            done = Replayed(why="Replays were not asked for.")
            if replays is True or (replays and entry.defence in replays):
                named = None if replays is True else entry.defence
                done = replay_of(entry.worst_episode, folder / replay, f"worst episode of suite {name}", named)
            if done.page:
                hashes[replay] = hashlib.sha256((folder / replay).read_bytes()).hexdigest()
            files[page] = render("entry.html", title=title, of=entry, suite=suite, entry=entry_page(suite, entry, done, also, one))
            listed.append({
                "suite": name, "defence": entry.defence, "status": entry.status, "class": entry.class_, "page": page,
                "rank": entry.rank.model_dump() if entry.rank else None, "replay": done.page and replay, "replay_missing": done.why,
                "critical_dose": {k: v.model_dump() if v else None for k, v in entry.critical_dose.items()},
            })  # fmt: skip
    hashes |= {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    summary = {"format": SUMMARY, "title": title, "suites": [s.board.suite.name for s in suites], "entries": listed}
    files["summary.json"] = encoded(summary | {"sha256": dict(sorted(hashes.items()))}, "summary")
    for name, content in files.items():
        (write_html if name.endswith(".html") else write_atomic)(folder / name, content)
    write_html(folder / "index.html", first)  # last: what it links to is there
    return folder / "index.html"
