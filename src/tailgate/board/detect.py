"""Detection and stealth impact of a board's entries, played from the board alone, entry by entry; and played again, to be checked."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.locks import alone
from tailgate.base.pool import apart, each
from tailgate.base.version import VERSION
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, name_of
from tailgate.evaluation.checks import Finding, Unplayable, again, differences, drawn, refused, sampling

from .check import VERDICTS
from .consistency import same
from .detection import EFFORT, Effort, Progress, detection, plants, stealth_impact
from .false_alarms import false_alarms
from .files import agree, amended, known, load, read_board, save, suite_of
from .schema import DETECTION, Data

PARTS = 4  # of the longest clean run: what one scenario may take of it when a threshold is checked
YOUNG = ("low", "high")  # fields of stealth that older boards lack
PLACE = ("plant", "scenario", "attack", "hours")  # what a figure is of


def detect(
    path: Path, suite: Suite, *, defences: Sequence[str] = (), effort: Effort = EFFORT, workers: int = 1, progress: Progress | None = None
) -> Data:
    """Play detection and stealth impact of the board in a file, and return it. It is written after each entry, and resumes.

    defences: only these entries; classes of somebody's own are imported where they are named here. By default those that come with the
    package; not `none`, sentinels, or the oracle. Attacks are the black-box scripts of the board's list that can be played here.
    Raises InputError for a board of another suite or version, or with figures of another effort, and for a defence that takes no place
    here.
    """
    with alone(path.parent):
        return _detected(path, suite, defences, effort, workers, progress)


def _detected(path: Path, suite: Suite, defences: Sequence[str], effort: Effort, workers: int, progress: Progress | None) -> Data:
    board = load(path)
    agree(read_board(board), suite)
    own = [e["defence"] for e in board["entries"] if e.get("card") and _takes_part(e)]
    known(defences, [e["defence"] for e in board["entries"] if _takes_part(e)])
    for entry in (e for e in board["entries"] if e["defence"] in defences):
        told, here = (entry.get("worst_episode") or {}).get("defence_digest"), Spec("defence", entry["defence"]).digest
        if told is not None and told != here:
            wanted = f"{told[:12] or 'none'}, of the class that the board's rows are of"
            raise InputError(f"defence {entry['defence']}: digest", here[:12] or "none", wanted)
    listed = [a for a in board["attacks"] if a["attack"] in suite.attacks or a.get("admitted")]
    attacks = [a["attack"] for a in listed if a["knowledge"] == "black" and not (a.get("optimal") or a.get("learned"))]
    attacks = [attack for attack in attacks if not refused("attack", attack)]
    held = board.get("detection") or _nothing(effort, suite)
    for name, value in dataclasses.asdict(_effort(held, effort)).items():
        if value != getattr(effort, name):
            raise InputError(f"detection: {name}", getattr(effort, name), f"{value}, with which the figures of the board were made")
    if (told := held.get("plants")) != _shared(suite):
        wanted = f"{_shared(suite)}, scenarios that share a threshold; without its field `detection` a board is played again"
        raise InputError("detection: plants", told, wanted)
    names = list(defences) or own
    asked = [defence for defence in names if not _whole(held, defence, suite, attacks, effort)]
    part = [defence for defence in names if defence not in asked and not _checked(held, defence)]
    there = {defence: _of(board, held, defence) for defence in part}
    with contextlib.closing(_play(suite, asked, attacks, effort, board["suite"].get("beacon") or "", workers, progress, there)) as played:
        for defence, found in played:
            board = _with(load(path), defence, found, effort, suite)  # read again: it may have been marked in the meantime
            save(board, path)
    return dict(board)


def _takes_part(entry: Data) -> bool:
    """Return if an entry is neither the undefended car, nor the oracle, nor a sentinel."""
    return entry["defence"] != "none" and "truth" not in entry["uses"] and not (entry.get("card") or {}).get("sentinel")


def _nothing(effort: Effort, suite: Suite) -> Data:
    return _said(effort, suite) | {key: [] for key in DETECTION}


def _said(effort: Effort, suite: Suite) -> Data:
    return dataclasses.asdict(effort) | {"hours": list(effort.hours), "plants": _shared(suite)}


def _shared(suite: Suite) -> list[list[str]]:
    """Return scenarios that share a threshold."""
    return [[name_of(name) for name in names] for names in plants(suite.nominal).values()]


def _effort(held: Data, effort: Effort = EFFORT) -> Effort:
    """Return the effort of a board's figures; older boards do not say, and had the usual one. A number that no figure needs is free."""
    given = {f.name: held[f.name] for f in dataclasses.fields(Effort) if f.name in held}
    free = {} if held.get("alarms") else {"checked": effort.checked}
    return dataclasses.replace(EFFORT, **given | free | {"hours": tuple(map(float, held["hours"]))})


def _whole(held: Data, defence: str, suite: Suite, attacks: Sequence[str], effort: Effort) -> bool:
    """Return if an entry has all figures, or the reasons why it has none."""
    lines = [line for part in DETECTION for line in held.get(part, ()) if line["defence"] == defence and not _outdated(line)]
    there = {tuple(line[key] for key in PLACE if key in line) for line in lines}
    return all(
        (plant, h) in there or all((name_of(name), attack, h) in there for name in names for attack in attacks)
        for plant, names in plants(suite.nominal).items() for h in effort.hours
    )  # fmt: skip


def _of(board: Data, held: Data, defence: str) -> Data:
    """Return the lines of one entry in the detection of a board."""
    stealth = next(entry.get("stealth") for entry in board["entries"] if entry["defence"] == defence)
    return {part: [line for line in held.get(part, ()) if line["defence"] == defence] for part in DETECTION} | {"stealth": stealth}


def _checked(held: Data, defence: str) -> bool:
    """Return if false alarms at all thresholds of an entry are there, or nothing is."""
    wanted = {(line["scenario"], line["hours"]) for line in held["entries"] if line["defence"] == defence}
    return wanted <= {(line["scenario"], line["hours"]) for line in held.get("alarms", ()) if line["defence"] == defence}


def _outdated(line: Data) -> bool:
    """Return if a line says that an entry has no threshold, from when only a defence's own one was looked for."""
    return str(line.get("reason", "")).startswith("defence: ")


def _with(board: Data, defence: str, found: Data, effort: Effort, suite: Suite) -> Data:
    """Return the board with the figures of one entry, in the order of its entries."""
    order = [entry["defence"] for entry in board["entries"]]
    held = board.get("detection") or _nothing(effort, suite)
    apart = {defence, *(e["defence"] for e in board["entries"] if not _takes_part(e))}
    lines = {part: [line for line in held.get(part, ()) if line["defence"] not in apart] + found[part] for part in DETECTION}
    lines = {part: sorted(mine, key=lambda line: order.index(line["defence"])) for part, mine in lines.items()}
    return amended(board, {defence: {"stealth": found["stealth"]}}, detection=held | _said(effort, suite) | lines)


def figures(
    suite: Suite, defence: str, attacks: Sequence[str], effort: Effort, beacon: str, there: Data | None = None,
    progress: Progress | None = None,
) -> Data:  # fmt: skip
    """Return `entries`, `without`, `alarms` and `stealth` of one defence. there: all of these but the alarms, if they are there."""
    found = there or detection(suite, [defence], attacks, effort, beacon=beacon, progress=progress)
    if there is None:
        found = found | {"stealth": stealth_impact(suite, defence, effort, beacon=beacon, progress=progress)}
    most = max(1, effort.most_steps // PARTS)
    return found | {"alarms": false_alarms(suite, found["entries"], effort.checked, most, beacon=beacon)}


def _play(
    suite: Suite, asked: Sequence[str], attacks: Sequence[str], effort: Effort, beacon: str, workers: int, progress: Progress | None,
    there: Mapping[str, Data] | None = None,
) -> Generator[tuple[str, Data]]:  # fmt: skip
    """Yield figures of each defence, as they are done; of those that are there in part, the missing ones."""
    have = there or {}
    every = [*asked, *have]
    sizes.check("workers", workers)
    update, rest = progress or (lambda *_: None), (attacks, effort, beacon)
    if not apart(workers, len(every)):
        ticks = 2 * len(effort.hours)  # of an entry: the stealth attack and the others at each threshold
        for i, defence in enumerate(every):
            steps = itertools.count(i * ticks + 1)
            tick = functools.partial(_tick, update, steps, ticks * len(every), defence)
            yield defence, figures(suite, defence, *rest, have.get(defence), tick)
        return
    jobs = [(suite, defence, *rest, have.get(defence)) for defence in every]
    for done, (i, found) in enumerate(each(figures, jobs, workers), start=1):
        yield every[i], found
        update("detection", done, len(every), every[i])


def _tick(update: Progress, steps: Iterator[int], total: int, defence: str, *_: object) -> None:
    update("detection", next(steps), total, defence)


def check_detection(
    data: Data, *, sample: int | None = None, sample_seed: int = 0, defences: Sequence[str] = (), workers: int = 1,
    progress: Progress | None = None,
) -> Data:  # fmt: skip
    """Play detection and stealth impact of entries of a board again, and compare them figure by figure, numbers to six digits.

    data: a board, as JSON; sample: number of entries, drawn by sample_seed (default: all that have figures); defences: only of these.
    The report has `counts` of figures, and `entries`: the same for each defence. Its `findings` are figures that differ, by `field`, with
    the value on the `board` and the value `here`. Its `reasons` say why entries could not be played. Raises InputError for a board
    without such figures, and as `check.check` does.
    """
    board = read_board(data)
    suite = suite_of(board)
    if not (held := data.get("detection")):
        raise InputError("board: detection", None, "figures of `leaderboard detect`")
    part = {entry["defence"] for entry in data["entries"] if _takes_part(entry)}
    names = list(dict.fromkeys(line["defence"] for key in DETECTION for line in held.get(key, ()) if line["defence"] in part))
    known(defences, names)
    attacks = list(dict.fromkeys(line["attack"] for line in held["entries"]))
    lost = next(filter(None, (refused("attack", attack) for attack in attacks)), "")
    effort, stealth = _effort(held), {entry["defence"]: entry.get("stealth") for entry in data["entries"]}

    def prepare(name: str) -> str:
        if why := lost or refused("defence", name):
            raise Unplayable(why)
        return name

    def compare(name: str, here: Data) -> Finding:
        """Compare an entry; `here` counts its figures."""
        told = {part: lines for part, lines in here.items() if part not in DETECTION or part in held}
        says, made = _by_place(held | {"stealth": stealth.get(name)}, name), _by_place(told, name)
        off = {place: _differences(says.get(place), made.get(place)) for place in dict.fromkeys((*says, *made))}
        lines = [dict(zip((*PLACE, "of"), place, strict=True)) | {"defence": name} | one for place, some in off.items() for one in some]
        wrong = sum(map(bool, off.values()))
        return Finding("differs" if wrong else "equal", "", lines, {"equal": len(off) - wrong, "differs": wrong, "unchecked": 0})

    asked = drawn(list(defences) or names, sample, sample_seed, "check")
    found = again(asked, prepare, lambda jobs: _play(suite, [*jobs], attacks, effort, board.suite.beacon or "", workers, progress), compare)
    counts = {
        name: finding.here or dict.fromkeys(VERDICTS, 0) | {"unchecked": len(_by_place(held | {"stealth": stealth.get(name)}, name))}
        for name, finding in found.items()
    }
    return {
        "format": "tailgate-check-detection-1", "suite": board.suite.name, "version": VERSION, "of": len(names), "asked": len(asked),
        **sampling(sample, sample_seed),
        "counts": {verdict: sum(one[verdict] for one in counts.values()) for verdict in VERDICTS},
        "entries": [{"defence": name, **one} for name, one in counts.items()],
        "findings": [line for finding in found.values() for line in finding.differences],
        "reasons": [{"defence": name, "why": finding.why} for name, finding in found.items() if finding.verdict == "unchecked"],
    }  # fmt: skip


def _by_place(held: Data, defence: str) -> dict[tuple[Any, ...], Data]:
    """Return the figures of an entry by plant, scenario, attack, hours and part."""
    lines = [(part, line) for part in DETECTION for line in held.get(part, ()) if line["defence"] == defence]
    lines += [("stealth", item) for item in held["stealth"] or ()]
    return {(*(line.get(key) for key in PLACE), part): line for part, line in lines}


def _differences(says: Data | None, here: Data | None) -> list[Data]:
    """Return the fields that differ; a board from before stealth had limits says nothing of them."""
    if says is None or here is None:
        return [{"field": "", "board": says, "here": here}]
    return differences([*says, *(key for key in here if key not in says and key not in YOUNG)], says, here, same, "board")
