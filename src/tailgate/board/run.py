"""From suites to boards and the page of them: every row that lies in a suite's folder counts."""

from __future__ import annotations

import hashlib
import lzma
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from tailgate.base.errors import InputError
from tailgate.base.reading import lines_of, parse_json
from tailgate.base.version import VERSION, plays_as
from tailgate.core.scenario import Suite
from tailgate.evaluation.attack_list import attacks_of, list_of
from tailgate.evaluation.cells import evaluate
from tailgate.evaluation.checks import refused
from tailgate.evaluation.rows import CLEAN, read_rows
from tailgate.trust.run import REPORT, with_trust

from .card import with_cards
from .cells import shared_of
from .entry import PROVISIONAL
from .files import agree, board_in, load, read_board, read_json, save
from .schema import Data
from .score import score
from .searched import searches_in
from .update import with_kept
from .verified import digest, with_verified

OWN = "rows.jsonl.xz"  # rows of `run`; other files of rows come from `attack` and `submit`
LIST = "attacks.jsonl"
CARDS = "cards"  # folder of what authors say of their entries
TRUST = "trust"  # folder that `tailgate trust` wrote
VERIFIED = "verified"  # folder of reports of `leaderboard verify`
Progress = Callable[[str, int, int], None]  # suite, done, total


def play(
    suite: Suite, folder: Path, *, defences: Sequence[str] | None = None, attacks: Sequence[str] | None = None, workers: int = 1,
    board: Data | None = None, beacon: str = "", progress: Progress | None = None,
) -> Path:  # fmt: skip
    """Play the rows of a suite and of the attacks admitted since, or of some, against its defences; return their file. It resumes.

    board: JSON of the one that they join: attacks that all of its entries have met are played too. Raises InputError where that cannot be.
    """
    if attacks is None and defences is not None:
        defences = list(dict.fromkeys([CLEAN, *defences]))  # the undefended car is what gates measure against
    _one_round(folder, beacon)
    if attacks is not None and suite.progress is not None:
        attacks = list(dict.fromkeys([CLEAN, *attacks]))  # lost progress is measured against clean runs
    some = repr(defences if attacks is None else (defences, list(attacks)))
    name = hashlib.blake2b(some.encode(), digest_size=4).hexdigest()
    file = folder / (OWN if defences is None and attacks is None else f"rows-{name}.jsonl.xz")
    if attacks is None:
        listed = attacks_of(suite, folder / LIST)
        attacks = (*listed, *_met_by_all(board, listed)) if board is not None else listed
    update = None if progress is None else lambda done, total: progress(suite.name, done, total)
    evaluate(suite, defences=defences, attacks=attacks, workers=workers, out=file, beacon=beacon, progress=update)
    return file


def _met_by_all(board: Data, listed: Sequence[str]) -> list[str]:
    """Return attacks on no list that all entries of a board have met. Raises InputError for one to import, or one that is not here."""
    found = [text for text in shared_of(board) if text not in listed]
    for text in found:
        if why := refused("attack", text):
            raise InputError("board: attacks", text, f"an attack that can be played here ({why})")
    return found


def files_of_rows(folder: Path) -> list[Path]:
    """Return files of rows in a suite's folder, without those of policies, of trust and hidden ones."""
    found = sorted(path for path in folder.glob("**/*") if path.name.endswith((".jsonl", ".jsonl.xz")) and path.name != LIST)
    within = [(path, path.relative_to(folder).parts) for path in found]
    others = {"policies", "searches", TRUST}
    return [path for path, parts in within if not others & set(parts) and not any(part.startswith(".") for part in parts)]


def _one_round(folder: Path, beacon: str) -> None:
    """Raise InputError where a file holds rows of another round: before anything is played that could not be scored with them."""
    for path in files_of_rows(folder):
        try:
            held = parse_json(next(lines_of(path), b"{}")).get("beacon", beacon)
        except (OSError, ValueError, AttributeError, EOFError, lzma.LZMAError):
            continue  # what is wrong with it is said where it is read
        if held != beacon:
            raise InputError(f"beacon of {path}", held, f"{beacon!r}, as asked for now: use another folder for another round")


def board_of(
    suite: Suite, folder: Path, beacon: str | None = None, keep: bool = False, *, require_adaptive: bool = True,
    provisional: Collection[str] = (),
) -> Data:  # fmt: skip
    """Score all rows in a folder, with verified/*.json and the bounds of trust/trust.json, and write board.json. Returns the board.

    Fields of an earlier board.json that do not come from rows are kept (`with_kept`). With `keep` entries are kept too that have no rows,
    or not those of all their cells. Raises InputError if there are no rows, if they are of another round than `beacon`, and if they do
    not fit the board. The same goes for a report that cannot be read or has another subject.
    """
    files = files_of_rows(folder)
    if not files:
        raise InputError("rows", str(folder), "a folder with rows of `leaderboard run`")
    path = board_in(folder)
    before = kept_board(path, suite, beacon or "", provisional) if keep else load(path) if path.is_file() else None
    parts = {path: read_rows(path) for path in files}
    if keep and (other := {plays_as(row["version"]) for rows in parts.values() for row in rows} - {VERSION}):
        raise InputError("rows: version", min(other), f"{VERSION}, as the board's")
    board = score(
        (row for rows in parts.values() for row in rows), suite, attacks=list_of(suite, folder / LIST),
        board=before if keep else None, require_adaptive=require_adaptive, searches=searches_in(folder),
        provisional=provisional,
    )  # fmt: skip
    if beacon is not None and board["suite"]["beacon"] != beacon:
        raise InputError("beacon", beacon, f"that of the rows, {board['suite']['beacon'] or 'which are of public seeds'}")
    held = {digest(path): Counter(row["defence"] for row in rows) for path, rows in parts.items()}
    board = with_verified(with_cards(board, folder / CARDS), folder / VERIFIED, held)
    if (report := folder / TRUST / REPORT).is_file():
        board = with_trust(board, read_json(report, "trust"), f"trust {report}", suite)
    if before is not None:
        board = with_kept(board, before)
    save(board, path)
    return board


def kept_board(path: Path, suite: Suite, beacon: str, provisional: Collection[str] = ()) -> Data:
    """Return the JSON of a board whose entries stay; none of these may be provisional but those that are tried again.

    Raises InputError for no board, and for one of another suite, version or round.
    """
    if not path.is_file():
        raise InputError("--keep-entries", str(path), "a board whose entries can stay")
    data: Data = load(path)
    board = read_board(data, str(path))
    agree(board, suite)
    if tried := [entry.defence for entry in board.entries if entry.why.startswith(PROVISIONAL) and entry.defence not in provisional]:
        raise InputError("--keep-entries", tried[0], "a board without entries that were only tried")
    if (board.suite.beacon or "") != beacon:
        raise InputError("beacon", beacon, f"that of the board, {board.suite.beacon or 'whose seeds are public ones'}")
    return data
