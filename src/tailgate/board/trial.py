"""A class of one's own on the published board of a suite: played, attacked, and ranked for a look."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory
from tailgate.base.progress import cells, lasting
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite
from tailgate.core.schema import digest
from tailgate.evaluation.rows import CLEAN, read_rows

from . import files as boards
from .attacked import Progress, attack
from .files import agree, board_in, load, read_board, save
from .run import board_of, files_of_rows, play
from .schema import Data


class Trial(NamedTuple):
    """The board with the class on it, its file, and its line."""

    board: Data
    file: Path
    entry: Data


def published(suite: Suite) -> Data | None:
    """Return the board of a suite that comes with the package, None where there is none of this version of the suite."""
    if suite.name not in (known := boards.published()):
        return None
    data: Data = load(known[suite.name])
    return data if data["suite"]["hash"] == suite.hash else None


def try_out(
    suite: Suite, defence: str, out: Path, *, workers: int = 1, progress: Progress, board: Path | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Trial:  # fmt: skip
    """Play a defence on a suite, attack it as the suite's plan says, and rank it among the entries of a board.

    The rank is a provisional one: the author has played the class, on seeds that everybody knows. An interrupted trial goes on.

    Parameters
    ----------
    suite, defence
        A suite, and a defence on a command line, such as module:Class.
    out
        Folder of what is made; rows, attackers and board lie in out/DIGEST/SUITE. Another class, another version of it, other parameters or
        another board have another digest.
    board
        The board that it joins; by default the published one of the package. Without any it is alone with the undefended car.

    Raises
    ------
    InputError
        For a class in a sandbox, a defence that the suite plays already, and a board of another suite.
    """
    spec = Spec("defence", defence)
    if spec.sandboxed:
        raise InputError("defence", defence, "a class without a sandbox, module:Class; `leaderboard submit` plays it in one")
    if defence in suite.defences:
        raise InputError("defence", defence, f"a class of yours: {suite.name} plays this one")
    held = published(suite) if board is None else load(board)
    if held is not None:
        agree(read_board(held), suite)
    joined = None if held is None else digest(held)
    folder = writable_directory(out / digest([spec.digest, defence, joined])[:8] / suite.name)  # of this class as it is, and this board
    path, keep = board_in(folder), held is not None
    if held is not None and not path.is_file():
        save(held, path)
    play(
        suite, folder, defences=[defence], workers=workers, board=load(path) if keep else None,
        progress=lambda name, done, total: progress(name, done, total, cells(done, total)),
    )  # fmt: skip
    _played(folder, defence)
    made = board_of(suite, folder, keep=keep, provisional=[defence])
    entry = _entry(made, defence)
    if entry["status"] == "unattacked":
        say(f"now the attacks on {defence}, as {entry['why']}")
        attack(
            suite, defence, folder / "attacked", workers=workers, progress=progress,
            announce=lambda seconds: say(f"the searches take about {lasting(seconds)} where nothing else runs"),
        )  # fmt: skip
        made = board_of(suite, folder, keep=keep, provisional=[defence])
        entry = _entry(made, defence)
    return Trial(made, path, entry)


def _played(folder: Path, defence: str) -> None:
    """Raise InputError for a class that failed in every clean episode: it has no figure, and its page would have none."""
    rows = [row for path in files_of_rows(folder) for row in read_rows(path) if row["defence"] == defence and row["attack"] == CLEAN]
    if rows and all(row["status"] != "ok" for row in rows):
        raise InputError("defence", defence, f"a class that plays an episode to its end ({rows[0]['reason']})")


def _entry(board: Data, defence: str) -> Data:
    return next(entry for entry in board["entries"] if entry["defence"] == defence)
