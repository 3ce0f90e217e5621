"""Check of a board from the board alone, without its rows: its cells are played again and compared.

A cell names a scenario, a dose, a defence and an attack of an installed suite. Its seeds are those of the suite's round. As with rows,
nothing is imported that the board names. Figures of entries that follow from cells are always made again. All others are made again if
all cells of the board were played.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from tailgate.base.errors import InputError
from tailgate.base.version import VERSION
from tailgate.core.registry import Family, Spec
from tailgate.core.scenario import Suite
from tailgate.core.schema import build
from tailgate.evaluation.attack_list import Admitted
from tailgate.evaluation.cells import Cell, run
from tailgate.evaluation.checks import Finding, Unplayable, again, counts, drawn, refused, sampling
from tailgate.evaluation.paired import CLOSE, PAIR
from tailgate.evaluation.rows import CLEAN, Row

from .cells import PRINTS, compared, figures, shared_of
from .consistency import same, sharpened, strays, undue, untold
from .damage import reach_of
from .entry import PROVISIONAL
from .files import amended, known, read_board, suite_of
from .schema import Board, CellLine, Data
from .score import score

VERDICTS = ("equal", "differs", "unchecked")
SCORED = ("class", "uses", "status", "why", "gates", "critical_dose", "rates", "rank", "clean", "flags", "robustness",
          "pointwise", "under_attack", "mean_gap")  # fmt: skip
EPISODES = 20_000  # whose rows are held at a time


def check(
    data: Data, *, sample: int | None = None, sample_seed: int = 0, defences: Sequence[str] = (), workers: int = 1,
    listed: Path | None = None, progress: Callable[[int, int], None] | None = None,
) -> Data:  # fmt: skip
    """Play the cells of a board again, and compare numbers of episodes, damage and fingerprints.

    Parameters
    ----------
    data : dict
        The board, as JSON.
    sample : int, optional
        Number of cells, drawn by `sample_seed`; by default all.
    defences : sequence of str
        Only the cells of these.
    listed : Path, optional
        The list of admitted and withdrawn attacks that belongs to the board; by default the package's.

    Returns
    -------
    dict
        A report:

        - `counts` of cells, and `entries`: the same for each defence;
        - `findings`: cells that differ or could not be checked, with `reasons`;
        - `untrained`: attackers without files, which `leaderboard attack` would train again to the same weights;
        - `strays`: figures that do not follow from the cells, and attacks that the board leaves out against the rules, by `defence`
          and `field`;
        - `untold`: ranked entries whose cells do not say which episodes came to damage, so that their comparisons are limits only;
        - `scored`: true if all cells were played, so that ranks, gates and all other figures were made again;
        - `prints`: hits and fingerprints of each equal cell, by its index in the board.

    Raises
    ------
    InputError
        For a board of another suite or version, and for a defence that is not on it.
    """
    board = read_board(data)
    suite = suite_of(board)
    known(defences, [entry.defence for entry in board.entries])
    mine = [i for i, cell in enumerate(board.cells) if not defences or cell.defence in defences]
    asked = drawn(mine, sample, sample_seed, "check")
    held: list[Row] = []  # of all cells of the board, if all are played
    reach: dict[tuple[str, str], dict[int, float]] = {}  # of clean runs, where lost progress counts

    def play(cells: Mapping[int, Cell]) -> Iterator[tuple[int, Data]]:
        before = len(asked) - len(cells)

        def tell(done: int, _: int) -> None:
            if progress is not None:
                progress(before + done, len(asked))

        for some in _slices(cells):
            rows = run([cells[i] for i in some], workers=workers, progress=tell)
            if suite.progress is not None:
                _add_reach(reach, [cells[i] for i in some], workers)
            before += len(some)
            if len(cells) == len(board.cells):
                held.extend(rows)
            each = iter(rows)
            yield from ((i, figures(list(itertools.islice(each, cells[i].seeds)), suite, reach.get(_where(cells[i])))) for i in some)

    files = {attack.attack: attack.digest for attack in board.attacks}
    seen = again(asked, lambda i: _cell(board.cells[i], board, suite), play, lambda i, here: _compared(board.cells[i], here, files))
    off = strays(data, suite) + undue(data, suite, listed)
    named = {(stray["defence"], stray["field"]) for stray in off}
    off += [stray for stray in _scored(data, held, suite) if (stray["defence"], stray["field"]) not in named]
    more = {"strays": off, "untold": untold(data, suite), "scored": bool(held)}
    return _report(board, seen, sampling(sample, sample_seed)) | more


def _scored(data: Data, rows: list[Row], suite: Suite) -> Iterator[Data]:
    """Yield how the board differs from the one that these rows make; nothing without rows."""
    if not rows:
        return
    said = data["suite"]
    lines = [build(Admitted, a["admitted"], "board: attacks") for a in data["attacks"] if a.get("admitted")]
    try:
        adaptive = said.get("require_adaptive", True)
        here = score(
            rows, suite, attacks=lines, alpha=said.get("alpha", 0.05), require_adaptive=adaptive, shared=shared_of(data),
            searches=data.get("searches", ()),
            provisional=[entry["defence"] for entry in data["entries"] if str(entry.get("why")).startswith(PROVISIONAL)],
        )  # fmt: skip
    except InputError as error:
        yield {"defence": "", "field": "cells", "board": f"{len(data['cells'])} cells", "here": str(error)}
        return
    entries = {entry["defence"]: entry for entry in here["entries"]}
    bounds = {duel.get("class") for duel in data["comparisons"] if duel.get("bound")}
    for entry in data["entries"]:
        mine = entries.get(entry["defence"], {})
        for key in SCORED:
            wide = key == "rank" and entry.get("class") in bounds and _within(mine.get(key), entry.get(key))
            if not wide and not same(entry.get(key), mine.get(key)):
                yield {"defence": entry["defence"], "field": key, "board": entry.get(key), "here": mine.get(key)}
    if not _same_pairs(data["comparisons"], here["comparisons"]):
        yield {"defence": "", "field": "comparisons", "board": f"{len(data['comparisons'])} of them", "here": "others"}


def _within(rank: Data | None, wider: Data | None) -> bool:
    """Return if a rank set lies in one that was made of bounds, fewer of which are significant."""
    return rank is not None and wider is not None and bool(wider["best"] <= rank["best"] and rank["worst"] <= wider["worst"])


def _same_pairs(board: list[Data], here: list[Data]) -> bool:
    """Return if all pairs came out as a board has them, those that it has as bounds within these."""
    if [(duel["a"], duel["b"]) for duel in board] != [(duel["a"], duel["b"]) for duel in here]:
        return False
    for told, made in zip(board, here, strict=True):
        if told.get("bound"):
            fits = told["p"] >= made["p"] * (1.0 - CLOSE) and told["only_a"] - told["only_b"] == made["only_a"] - made["only_b"]
        else:
            fits = all(same(told.get(key), made[key]) for key in PAIR)
        if not fits:
            return False
    return True


def _cell(part: CellLine, board: Board, suite: Suite) -> Cell:
    """Return the cell to play. Raises the reason why it cannot be played here."""
    families: tuple[tuple[Family, str], ...] = (("defence", part.defence), ("attack", part.attack))
    for family, text in families:
        if why := refused(family, text):
            raise Unplayable(why)
    cell = Cell(
        suite.name, part.scenario, part.dose, part.defence, part.attack, board.suite.episodes or 0, board.suite.purpose or "report",
        threat=suite.granted, beacon=board.suite.beacon or "",
    )  # fmt: skip
    spec = Spec("attack", part.attack)
    knowledge = cell.place(spec.make(), spec.entry.knowledge).threat_model.knowledge
    _ = Spec("defence", part.defence).make(), cell.episodes
    if knowledge != part.knowledge:
        raise Unplayable(f"the attack {part.attack!r} is granted the knowledge {knowledge} here")
    return cell


def _where(cell: Cell) -> tuple[str, str]:
    return cell.scenario, cell.defence


def _add_reach(reach: dict[tuple[str, str], dict[int, float]], cells: Sequence[Cell], workers: int) -> None:
    """Add the distances of the clean runs that these cells are judged by; a run that fails has none, as on a board."""
    clean = {_where(cell): dataclasses.replace(cell, attack=CLEAN) for cell in cells if _where(cell) not in reach}
    rows = iter(run(list(clean.values()), workers=workers))
    for where, cell in clean.items():
        runs = list(itertools.islice(rows, cell.seeds))
        if all(row["status"] == "ok" for row in runs):
            reach[where] = reach_of(runs)


def _slices(cells: Mapping[int, Cell]) -> Iterator[list[int]]:
    """Yield places of cells whose rows are held together."""
    some: list[int] = []
    for i in cells:
        some.append(i)
        if sum(cells[k].seeds for k in some) >= EPISODES:
            yield some
            some = []
    if some:
        yield some


def _compared(part: CellLine, here: Data, files: Mapping[str, str | None]) -> Finding:
    """Compare, and say where the attack's file is another one than the board's."""
    found = compared(part, here)
    if found.verdict == "differs" and files.get(part.attack) not in (None, Spec("attack", part.attack).digest):
        found.why = f"the attack's file here is another one than that of the board; {found.why}"
    return found


def _report(board: Board, seen: dict[int, Finding], sample: Data) -> Data:
    total, by_defence = Counter(cell.defence for cell in board.cells), dict[str, list[Finding]]()
    for i, finding in seen.items():
        by_defence.setdefault(board.cells[i].defence, []).append(finding)
    unchecked = [i for i, finding in seen.items() if finding.verdict == "unchecked"]
    reasons = Counter(seen[i].why for i in unchecked)
    return {
        "format": "tailgate-check-1", "suite": board.suite.name, "version": VERSION, "cells": len(board.cells), "asked": len(seen),
        **sample, "counts": counts(seen.values(), VERDICTS),
        "entries": [{"defence": name, "cells": total[name], **counts(held, VERDICTS)} for name, held in by_defence.items()],
        "reasons": [{"why": why, "cells": n} for why, n in reasons.most_common()],
        "untrained": _untrained(board, unchecked),
        "findings": [
            {**board.cells[i].model_dump(include={"scenario", "dose", "defence", "attack", "knowledge"}),
             "verdict": finding.verdict, "why": finding.why}
            for i, finding in seen.items() if finding.verdict != "equal"
        ],
        "prints": {
            str(i): {name: finding.here[name] for name in PRINTS} for i, finding in seen.items() if finding.verdict == "equal"
        },
    }  # fmt: skip


def _untrained(board: Board, places: list[int]) -> list[Data]:
    """Return for each defence the policies that are not here and lie where `leaderboard attack DEFENCE --out FOLDER` puts them."""
    cells: Counter[tuple[str, str]] = Counter()
    files: dict[tuple[str, str], set[Path]] = {}
    for cell in (board.cells[i] for i in places):
        path = Path(cell.attack)
        if path.suffix == ".json" and path.parts[-3:-2] == ("policies",) and not path.is_file():
            held = cell.defence, path.parents[2].as_posix()
            cells[held] += 1
            files.setdefault(held, set()).add(path)
    return [{"defence": name, "folder": folder, "policies": len(files[name, folder]), "cells": n} for (name, folder), n in cells.items()]


def _played(found: Data) -> int:
    """Return how many cells a check has played."""
    return int(found["equal"] + found["differs"])


def _outweighs(old: Data, new: Data) -> bool:
    """Return if an earlier check stays: it played more, or found a difference where this one, of a part of the cells, found none."""
    if bool(old["differs"]) != bool(new["differs"]):
        return bool(old["differs"]) and _played(new) < new["cells"]
    return _played(old) > _played(new)


def with_check(data: Data, report: Data) -> Data:
    """Return the board with a check: `checked` in the entries that were looked into, fingerprints in cells that came out equal.

    An entry keeps the check that played more cells, or found a difference that no whole check has refuted. One of another number of cells
    is of another board. Comparisons that were bounds are made again of cells that now say which episodes came to damage, and ranks with
    them.
    """
    before = {entry["defence"]: entry.get("checked") for entry in data["entries"]}
    checked: dict[str, Data] = {}
    for entry in report["entries"]:
        new, old = {key: entry[key] for key in ("cells", *VERDICTS)}, before.get(entry["defence"])
        if not (old and old["cells"] == new["cells"] and _outweighs(old, new)):
            checked[entry["defence"]] = {"checked": new}
    cells = [cell | report["prints"].get(str(i), {}) for i, cell in enumerate(data["cells"])]
    return sharpened(amended(data, checked, cells=cells), suite_of(read_board(data)))
