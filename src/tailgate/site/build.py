"""Builds the site of one or several boards: a page of all suites, a page per entry, and replays of worst episodes beside them.

Every page is one file that asks for nothing else. OUT/index.html, OUT/summary.json (what was written, with hashes), and for each suite
OUT/SUITE/board.json, OUT/SUITE/DEFENCE.html and OUT/SUITE/DEFENCE-replay.html.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import DictLoader, Environment, StrictUndefined

from tailgate.base.assets import asset, embedded, inline
from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_atomic
from tailgate.board.attachments import Attachments
from tailgate.board.files import read_board
from tailgate.board.order import GROUPS, ordered
from tailgate.board.words import HERE, TITLE, breakable

from .entry import Replayed, entry_page, replay_of
from .index import section
from .suite import Data, Suite

SUMMARY = "tailgate-site-1"
MOST = 60  # characters of a file's name that come from a defence's


def slug(text: str, kept: str = "a-z0-9_") -> str:
    """A file name for a text: itself where it holds only such characters, else what is left of it and a hash that tells it apart."""
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


def _encoded(data: Data, where: str) -> bytes:
    try:
        return (json.dumps(data, indent=1, allow_nan=False) + "\n").encode()
    except (TypeError, ValueError) as error:
        raise InputError(where, type(data).__name__, f"JSON data ({error})") from None


def _environment() -> Environment:
    names = ("macros.html", "index.html", "entry.html")
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        loader=DictLoader({name: asset(HERE, name) for name in names}),
    )
    environment.filters |= {"breakable": breakable, "embedded": embedded}
    return environment


def build_site(
    boards: Sequence[dict[str, Any]], out: Path, *, title: str | None = None, replays: bool = True, measured: Sequence[Attachments] = (),
) -> Path:  # fmt: skip
    """Writes the site of `boards` (format tailgate-board-1) to the folder `out` and returns the path of its first page.

    replays: play each entry's worst episode again and write its page; without, the entries' pages say that it was not done.
    measured: the attachments of each board.
    Raises InputError, before anything is written, for no board, two of a suite, one that is not of the format (names the field), and for
    what was measured of another suite.
    """
    suites = _suites(boards)
    given = list(measured) or [Attachments()] * len(suites)
    found = [held.belonging(suite.board) for suite, held in zip(suites, given, strict=True)]
    held = [_encoded(data, "board") for data in boards]
    heading = title or TITLE
    environment = _environment()
    common = {"css": [inline(HERE, "page.css"), inline(HERE, "site.css")], "js": inline(HERE, "site.js"), "title": heading}
    folder = writable_directory(Path(out))
    written: dict[str, bytes] = {}
    for suite, content in zip(suites, held, strict=True):
        written[f"{suite.folder}/board.json"] = content
    sections = [section(s, m) | {"hash": hashlib.sha256(c).hexdigest()} for s, m, c in zip(suites, found, held, strict=True)]
    page = environment.get_template("index.html").render(sections=sections, statuses=GROUPS, **common)
    written["index.html"] = _utf8(page)
    template = environment.get_template("entry.html")
    listed: list[Data] = []
    for suite, beside in zip(suites, found, strict=True):
        for entry in ordered(suite.board.entries):
            where = suite.pages[entry.defence]
            also = [(s.board.suite.name, f"../{s.pages[entry.defence]}") for s in suites if s is not suite and entry.defence in s.pages]
            replay = folder / f"{where.removesuffix('.html')}-replay.html"
            source = f"worst episode of suite {suite.board.suite.name}"
            done = replay_of(entry.worst_episode, replay, source) if replays else Replayed(why="Replays were not asked for.")
            if done.page:
                written[str(replay.relative_to(folder))] = replay.read_bytes()
            context = entry_page(suite, entry, done, also, beside)
            written[where] = _utf8(template.render(entry=context, **common))
            listed.append({
                "suite": suite.board.suite.name, "defence": entry.defence, "status": entry.status, "class": entry.class_, "page": where,
                "rank": entry.rank.model_dump() if entry.rank else None, "replay": done.page and str(replay.relative_to(folder)),
                "replay_missing": done.why,
                "critical_dose": {k: v.model_dump() if v else None for k, v in entry.critical_dose.items()},
            })  # fmt: skip
    files = {name: hashlib.sha256(content).hexdigest() for name, content in sorted(written.items())}
    summary = {"format": SUMMARY, "title": heading, "suites": [s.board.suite.name for s in suites], "entries": listed, "sha256": files}
    written["summary.json"] = _encoded(summary, "summary")
    first = written.pop("index.html")
    for name, content in written.items():
        if not name.endswith("-replay.html"):
            write_atomic(folder / name, content)
    write_atomic(folder / "index.html", first)  # last: what it links to is there
    return folder / "index.html"


def _utf8(page: str) -> bytes:
    return page.encode("utf-8", "replace")  # a lone surrogate in a board must not stop the page
