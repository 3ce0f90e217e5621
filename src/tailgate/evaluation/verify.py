"""Rows played again: a claim becomes verified when every field comes out as the row says.

A row names all that is needed to play it. It is read and never run: registered names, the zoo, and files whose digest is the one in the
row. A row that names code to import is refused, unless the caller trusts it. Another version, or a file that is not here, is said: such a
row is neither verified nor wrong.
"""

from __future__ import annotations

import functools
import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.reading import YAML_ENDS
from tailgate.base.version import VERSION, plays_as
from tailgate.core import draws
from tailgate.core.registry import SANDBOXES, Family, Spec
from tailgate.core.scenario import list_scenarios, load_scenario
from tailgate.core.schema import build, canonical
from tailgate.core.threat import ThreatModel
from tailgate.evaluation.cells import ENGINE, Cell, run
from tailgate.evaluation.checks import LAST_BITS, Finding, Unplayable, again, counts, differences, drawn, files_of, sampling
from tailgate.evaluation.rounds import seeds_of
from tailgate.evaluation.rows import Row

HASHES = ("trace_hash", "decision_hash")
# What a row says of itself that is not compared: who its companions were, the words of a failure, and what the row alone can say. Its
# version is looked at before.
FREE = frozenset({"batch", "cell", "reason", "seed", "suite", "purpose", "version"})
BYTES = 10_000_000  # of a file that a row names, at most
ROUND = 4096  # episodes of a round that are looked through for a seed
VERDICTS = ("verified", "differs", "unchecked")
Found = dict[int, Finding]  # by the place of a row
Job = tuple[str, Cell]  # what rows of one cell share, and the cell


def verify(
    rows: Sequence[Row],
    *,
    sample: int | None = None,
    sample_seed: int = 0,
    workers: int = 1,
    batch: int | None = None,
    trust_code: bool = False,
    submissions: Sequence[str] = (),
    files: Sequence[str] = (),
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Play rows again and compare hashes, metrics and everything else that they record.

    `sample`: number of rows, drawn by `sample_seed`; None: all. `batch`: episodes side by side instead of the row's own number, which
    changes no result. `submissions`: classes that rows of `leaderboard submit` are about, each in a sandbox, "bwrap/module:Class".

    The report has `status`, `counts`, `entries` (the same for each defence), `findings` and `reasons`. The status is "verified" where every
    row that was asked for agrees, else "claimed". Findings are rows that differ or could not be checked, by line, counted from 1.
    `left_out` names columns of somebody's own metrics, which are not made again.
    `files`: the file that each row is from; then the report has the counts of each file too.
    """
    apart = {_target(text): text for text in submissions}
    for name, value in (("sample", sample), ("batch", batch), ("workers", workers)):
        if value is not None:
            sizes.check(name, value)
    cell_of = _Cells(batch, trust_code, apart)
    found = again(
        drawn(range(len(rows)), sample, sample_seed, "verify"), lambda i: cell_of(rows[i]),
        lambda jobs: _play(jobs, rows, apart, workers, progress), lambda i, here: _compared(rows[i], here),
    )  # fmt: skip
    return _report(rows, found, sampling(sample, sample_seed), files)


def _target(text: str) -> str:
    """Return the class in a sandbox. Raises InputError for any other text."""
    spec = Spec("defence", text)
    if spec.sandboxed is None:
        raise InputError("submission", text, f"a class in a sandbox: {' or '.join(f'{name}/module:Class' for name in SANDBOXES)}")
    return spec.target


def _play(
    jobs: Mapping[int, Job], rows: Sequence[Row], apart: dict[str, str], workers: int, progress: Callable[[int, int], None] | None
) -> Iterator[tuple[int, Row]]:
    """Yield each row as it comes out here. A row that fails costs its companions, and so is played once more by itself."""
    groups: dict[str, tuple[Cell, list[int]]] = {}
    for i, (key, cell) in jobs.items():
        groups.setdefault(key, (cell, []))[1].append(i)
    for target, text in apart.items():
        mine = [(cell, members) for cell, members in groups.values() if rows[members[0]].get("submission") and cell.defence == target]
        if mine:
            from tailgate.sandbox.verified import replay

            played = replay(text, [(cell, [rows[i]["seed"] for i in members]) for cell, members in mine])
            yield from ((i, row) for (_, members), some in zip(mine, played, strict=True) for i, row in zip(members, some, strict=True))
    built_in = [(cell, members) for cell, members in groups.values() if not rows[members[0]].get("submission")]
    spans = [span for cell, members in built_in for span in _spans(cell, members, rows)]
    here = iter(run([cell for cell, _ in spans], workers=workers, progress=progress) if spans else [])
    alone: dict[int, Cell] = {}
    for cell, members in spans:
        by_seed = {row["seed"]: row for row in itertools.islice(here, cell.seeds)}
        for i in members:
            if by_seed[rows[i]["seed"]]["status"] == "error" and cell.seeds > 1:
                alone[i] = replace(cell, first_seed=position(rows[i]), seeds=1)
            else:
                yield i, by_seed[rows[i]["seed"]]
    if alone:
        yield from zip(alone, run(list(alone.values()), workers=workers), strict=True)


def position(row: Row) -> int:
    """Return the number of a row's episode: its seed, or the seed's place in the round of a beacon."""
    return _places_of(row)[row["seed"]] if row.get("beacon") else int(row["seed"])


def _places_of(row: Row) -> dict[int, int]:
    return _places(str(row["beacon"]), str(row["suite"]), str(row["purpose"]))


@functools.lru_cache(maxsize=16)
def _places(beacon: str, suite: str, purpose: str) -> dict[int, int]:
    return {seed: i for i, seed in enumerate(seeds_of(beacon, suite, purpose, ROUND))}


def _key(row: Row) -> str:
    """Return what rows of one cell share."""
    names = ("suite", "scenario", "scenario_file", "threat_model", "defence", "attack", "purpose", "config_hash", "version", "engine",
             "defence_digest", "attack_digest", "versions", "batch", "beacon", "submission")  # fmt: skip
    return canonical([row.get(name) for name in names])


class _Cells:
    """The cells that rows belong to. Rows of one cell are looked into once."""

    def __init__(self, batch: int | None, trust_code: bool, apart: dict[str, str]) -> None:
        self.batch, self.trust_code, self.apart = batch, trust_code, apart
        self.known: dict[str, Cell | Exception] = {}

    def __call__(self, row: Row) -> Job:
        """Return the cell of a row, without its seeds. Raises the reason why the row cannot be checked here."""
        key = _key(row)
        if key not in self.known:
            try:
                self.known[key] = self._cell(row)
            except Exception as error:
                self.known[key] = error
        cell = self.known[key]
        if isinstance(cell, Exception):
            raise cell
        if row.get("beacon") and row["seed"] not in _places_of(row):
            raise Unplayable(f"the seed is none of the first {ROUND} of the row's round")
        return key, cell

    def _cell(self, row: Row) -> Cell:
        lacks = [name for name in (*HASHES, "threat_model", "engine", "versions") if name not in row]
        if lacks:
            raise Unplayable(f"the row does not record {', '.join(lacks)}")
        if plays_as(row["version"]) != VERSION:
            raise Unplayable(f"made with tailgate {row['version']}; this is {VERSION}")
        if row["engine"] != ENGINE:
            raise Unplayable(f"made with the engine {row['engine']!r}; this is {ENGINE!r}")
        if row["purpose"] not in draws.PURPOSES:
            raise Unplayable(f"seeds of the purpose {row['purpose']!r}, which there is not")
        file = row.get("scenario_file")
        source = file or row["scenario"]
        if not file and source not in list_scenarios():
            raise Unplayable(f"scenario {source!r} is not built in, and the row names no file of it")
        if file and not (source.endswith(YAML_ENDS) and _readable(Path(source))):
            raise Unplayable(f"the file {source!r} of the row's scenario is not here")
        threat = row["threat_model"]
        if not isinstance(threat, dict) or not isinstance(row["versions"], dict):
            raise Unplayable("the row's threat model or its versions are no mapping")
        changes = {name: value for name, value in threat.items() if name != "class"}
        cell = Cell(
            row["suite"], source, None, row["defence"], row["attack"], 1, row["purpose"], 0, self.batch or _batch(row.get("batch")),
            changes, str(row.get("beacon", "")),
        )  # fmt: skip
        _ = cell.episodes  # refuses a beacon that is none
        granted = build(ThreatModel, changes, "the row's threat_model")
        submitted = bool(row.get("submission"))
        why = (_unlike(row, self.apart) if submitted else self._refused("defence", row)) or self._refused("attack", row)
        if why:
            raise Unplayable(why)
        place = load_scenario(source)
        if file and replace(place, threat_model=granted).config_hash != row["config_hash"]:
            raise Unplayable(f"the file {source!r} holds another scenario than the row's")
        spec = Spec("attack", row["attack"])
        if not submitted:
            Spec("defence", row["defence"]).make()
        cell.place(spec.make(), spec.entry.knowledge)
        return cell

    def _refused(self, family: Family, row: Row) -> str:
        """Return why a component of the row is not played; empty where it is."""
        spec = Spec(family, row[family])
        if spec.foreign and not self.trust_code:
            return f"the {family} {row[family]!r} is code to import, which a row may not make us do; --trust-code allows it"
        missing = [] if spec.imports else [path for path in files_of(spec) if not _readable(path)]
        if missing:
            return f"the {family}'s file {str(missing[0])!r} is not here"
        recorded, digest = str(row.get(f"{family}_digest") or ""), spec.digest
        if digest != recorded:
            shown = f"digest {recorded[:12] or 'none'}, here {digest[:12] or 'none'}"
            return f"the {family} {row[family]!r} comes from other files than the row's ({shown})"
        version, here = row["versions"].get(family), spec.entry.version
        return f"the {family} {row[family]!r} has version {here} here and {version} in the row" if version != here else ""


def _batch(held: object) -> int:
    return held if isinstance(held, int) and not isinstance(held, bool) and 1 <= held <= 4096 else 256


def _readable(path: Path) -> bool:
    return path.is_file() and path.stat().st_size <= BYTES


def _unlike(row: Row, apart: dict[str, str]) -> str:
    """Return why a submission is not played; empty where its files are here, in a sandbox."""
    text = apart.get(row["defence"])
    if text is None:
        return f"{row['defence']!r} is a submission: give --submission bwrap/{row['defence']} with its files"
    digest = Spec("defence", text).digest
    if digest != row["defence_digest"]:
        return f"the submission {row['defence']!r} has the digest {digest[:12]} here and {str(row['defence_digest'])[:12]} in the row"
    return ""


def _spans(cell: Cell, members: list[int], rows: Sequence[Row]) -> list[tuple[Cell, list[int]]]:
    """Return cells of neighbouring seeds that cover the rows. Seeds between two of them are played along: they cost little."""
    out: list[tuple[Cell, list[int]]] = []
    for i in sorted(members, key=lambda i: position(rows[i])):
        seed = position(rows[i])
        if out and seed - out[-1][0].first_seed < cell.batch:
            first, held = out[-1]
            out[-1] = replace(first, seeds=seed - first.first_seed + 1), [*held, i]
        else:
            out.append((replace(cell, first_seed=seed, seeds=1), [i]))
    return out


def _compared(row: Row, here: Row) -> Finding:
    """Compare a row with what came out, field by field."""
    if row["status"] == "error" and here["status"] != "error":
        return Finding("unchecked", f"it failed there ({row['reason'][:80]}) and plays here")
    off = differences((name for name in here if name not in FREE), row, here, _same, "row")
    if not off:
        return Finding("verified")
    fields = [entry["field"] for entry in off]
    return Finding("differs", f"trace_hash {LAST_BITS}" if fields == ["trace_hash"] else ", ".join(fields), off)


def _same(row: object, here: object) -> bool:
    if isinstance(here, bool) or isinstance(row, bool):
        return row is here
    return canonical(row) == canonical(here) if isinstance(here, dict | list) else bool(row == here)


def _status(some: Found) -> str:
    return "verified" if some and all(finding.verdict == "verified" for finding in some.values()) else "claimed"


def _report(rows: Sequence[Row], found: Found, sample: Row, files: Sequence[str]) -> Row:
    def entries(some: Found) -> list[Row]:
        by_defence: dict[str, Found] = {}
        for i, finding in some.items():
            by_defence.setdefault(rows[i]["defence"], {})[i] = finding
        return [{"defence": name, "status": _status(held), **counts(held.values(), VERDICTS)} for name, held in by_defence.items()]

    by_file: dict[str, Found] = {name: {} for name in files}
    for i, finding in found.items() if files else ():
        by_file[files[i]][i] = finding
    off = {i: finding for i, finding in found.items() if finding.verdict != "verified"}
    reasons = Counter(f"{finding.verdict}: {finding.why}" for finding in off.values())
    names = ("scenario", "dose", "defence", "attack", "purpose", "seed")
    return {
        "format": "tailgate-verify-1", "status": _status(found), "rows": len(rows), "asked": len(found), "sample": sample["sample"],
        "version": VERSION, "engine": ENGINE, "counts": counts(found.values(), VERDICTS),
        "entries": entries(found), "files": [{"file": name, "entries": entries(held)} for name, held in by_file.items()],
        "reasons": [{"why": why, "rows": n} for why, n in reasons.most_common()],
        "left_out": sorted({name for i in found for name in rows[i].get("metrics", ())}),
        "findings": [
            {"line": i + 1, "verdict": f.verdict, "why": f.why, **{name: rows[i][name] for name in names}, "differences": f.differences}
            for i, f in off.items()
        ],
    } | sample  # fmt: skip
