"""Rows played again: a claim becomes verified when every field comes out as the row says.

A row names all that is needed to play it. What it names is read and never run: registered names, the zoo, and files whose digest is
the one in the row. A row that names code to import is refused, unless the caller trusts it. Whatever cannot be looked into here (another
version, a file that is not here) is said to be so: it is neither verified nor wrong.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, cast

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.version import VERSION
from tailgate.core import draws
from tailgate.core.draws import constants
from tailgate.core.registry import SANDBOXES, Spec
from tailgate.core.scenario import list_scenarios, load_scenario
from tailgate.core.schema import build, canonical
from tailgate.core.threat import ThreatModel
from tailgate.evaluation.cells import ENGINE, Cell, run
from tailgate.evaluation.rounds import seeds_of

HASHES = ("trace_hash", "decision_hash")
# What a row says of itself that is not compared: who its companions were, the words of a failure, and what the row alone can say.
FREE = frozenset({"batch", "cell", "reason", "seed", "suite", "purpose"})
BYTES = 10_000_000  # of a file that a row names, at most
ROUND = 4096  # episodes of a round that are looked through for a seed
YAML = (".yaml", ".yml")
Row = dict[str, Any]
Verdict = Literal["verified", "differs", "unchecked"]


@dataclass
class Finding:
    """What became of one row. `differences`: field, what the row says, what came out here."""

    line: int
    verdict: Verdict
    why: str = ""
    differences: list[dict[str, Any]] = field(default_factory=list)


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

    `sample`: so many rows, drawn by `sample_seed`; None: all. `batch`: episodes side by side instead of the row's own number, which
    changes no result. The report has `status` (verified: every row that was asked for agrees; else claimed), `counts`, `entries` (the
    same for each defence), `findings` (rows that differ or could not be checked, lines counted from 1) and `reasons`. `submissions`:
    classes that rows of `leaderboard submit` are about, each in a sandbox, "bwrap/module:Class". `files`: the file that each row is from;
    then the report has the counts of each file too.
    """
    apart = {_target(text): text for text in submissions}
    for name, value in (("sample", sample), ("batch", batch), ("workers", workers)):
        if value is not None:
            sizes.check(name, value)
    asked = _sampled(len(rows), sample, sample_seed)
    found: dict[int, Finding] = {}
    groups: dict[str, tuple[Cell, list[int]]] = {}
    places: dict[str, Cell | str] = {}
    for i in asked:
        key = _key(rows[i])
        if key not in places:
            places[key] = _cell(rows[i], batch, trust_code, apart)
        cell = places[key]
        if not isinstance(cell, str) and rows[i].get("beacon") and rows[i]["seed"] not in _places_of(rows[i]):
            cell = f"the seed is none of the first {ROUND} of the row's round"
        if isinstance(cell, str):
            found[i] = Finding(i + 1, "unchecked", cell)
        else:
            groups.setdefault(key, (cell, []))[1].append(i)
    strange = [(cell, held) for cell, held in groups.values() if rows[held[0]].get("submission")]
    for (_, members), again in zip(strange, _again(strange, rows, apart), strict=True):
        found |= {i: _compared(i + 1, rows[i], row) for i, row in zip(members, again, strict=True)}
    groups = {key: held for key, held in groups.items() if not rows[held[1][0]].get("submission")}
    spans = [(part, members) for cell, held in groups.values() for part, members in _spans(cell, held, rows)]
    here = run([cell for cell, _ in spans], workers=workers, progress=progress) if spans else []
    at = 0
    alone: list[tuple[int, Cell]] = []
    for cell, members in spans:
        played = {row["seed"]: row for row in here[at : at + cell.seeds]}
        at += cell.seeds
        for i in members:
            if played[rows[i]["seed"]]["status"] == "error" and cell.seeds > 1:  # a failure costs its companions: once more by itself
                alone.append((i, replace(cell, first_seed=position(rows[i]), seeds=1)))
            else:
                found[i] = _compared(i + 1, rows[i], played[rows[i]["seed"]])
    for (i, _), row in zip(alone, run([cell for _, cell in alone], workers=workers) if alone else [], strict=True):
        found[i] = _compared(i + 1, rows[i], row)
    return _report(rows, [(i, found[i]) for i in asked], sample, files) | ({} if sample is None else {"sample_seed": sample_seed})


def _target(text: str) -> str:
    """The class that stands behind a sandbox. Raises InputError for any other text."""
    spec = Spec("defence", text)
    if spec.sandboxed is None:
        raise InputError("submission", text, f"a class in a sandbox: {' or '.join(f'{name}/module:Class' for name in SANDBOXES)}")
    return spec.target


def _again(groups: Sequence[tuple[Cell, list[int]]], rows: Sequence[Row], apart: dict[str, str]) -> list[list[Row]]:
    """The rows of submissions as they come out here, group by group."""
    out: dict[int, list[Row]] = {}
    for target, text in apart.items():
        mine = [i for i, (cell, _) in enumerate(groups) if cell.defence == target]
        if mine:
            from tailgate.sandbox.verified import replay

            played = replay(text, [(groups[i][0], [rows[k]["seed"] for k in groups[i][1]]) for i in mine])
            out |= dict(zip(mine, played, strict=True))
    return [out[i] for i in range(len(groups))]


def position(row: Row) -> int:
    """Number of a row's episode: its seed, or the seed's place in the round of a beacon."""
    return _places_of(row)[row["seed"]] if row.get("beacon") else int(row["seed"])


def _places_of(row: Row) -> dict[int, int]:
    return _places(str(row["beacon"]), str(row["suite"]), str(row["purpose"]))


@functools.lru_cache(maxsize=16)
def _places(beacon: str, suite: str, purpose: str) -> dict[int, int]:
    return {seed: i for i, seed in enumerate(seeds_of(beacon, suite, purpose, ROUND))}


def _sampled(total: int, sample: int | None, seed: int) -> list[int]:
    """Which rows, in their order."""
    if sample is None or sample >= total:
        return list(range(total))
    order = constants("verify", seed).uniform((total,))[0].argsort()
    return sorted(int(i) for i in order[:sample])


def _key(row: Row) -> str:
    """What rows of one cell share."""
    names = ("suite", "scenario", "scenario_file", "threat_model", "defence", "attack", "purpose", "config_hash", "version", "engine",
             "defence_digest", "attack_digest", "versions", "batch", "beacon", "submission")  # fmt: skip
    return canonical([row.get(name) for name in names])


def _cell(row: Row, batch: int | None, trust_code: bool, apart: dict[str, str]) -> Cell | str:
    """The cell that the row belongs to, without its seeds; or why it cannot be checked here."""
    lacks = [name for name in (*HASHES, "threat_model", "engine", "versions") if name not in row]
    if lacks:
        return f"the row does not record {', '.join(lacks)}"
    if row["version"] != VERSION:
        return f"made with tailgate {row['version']}; this is {VERSION}"
    if row["engine"] != ENGINE:
        return f"made with the engine {row['engine']!r}; this is {ENGINE!r}"
    if row["purpose"] not in draws.PURPOSES:
        return f"seeds of the purpose {row['purpose']!r}, which there is not"
    source = row.get("scenario_file") or row["scenario"]
    if not row.get("scenario_file") and source not in list_scenarios():
        return f"scenario {source!r} is not built in, and the row names no file of it"
    if row.get("scenario_file") and not (source.endswith(YAML) and _readable(Path(source))):
        return f"the file {source!r} of the row's scenario is not here"
    threat = row["threat_model"]
    if not isinstance(threat, dict) or not isinstance(row["versions"], dict):
        return "the row's threat model or its versions are no mapping"
    try:
        changes = {name: value for name, value in threat.items() if name != "class"}
        cell = Cell(
            row["suite"], source, None, row["defence"], row["attack"], 1, row["purpose"], 0,
            batch or _batch(row.get("batch")), changes, str(row.get("beacon", "")),
        )
        _ = cell.episodes  # refuses a beacon that is none  # fmt: skip
        granted = build(ThreatModel, changes, "the row's threat_model")
        for family in ("defence", "attack"):
            if why := _unlike(row, apart) if family == "defence" and row.get("submission") else _refused(family, row, trust_code):
                return why
        place = load_scenario(source)
        if row.get("scenario_file") and replace(place, threat_model=granted).config_hash != row["config_hash"]:
            return f"the file {source!r} holds another scenario than the row's"
        spec = Spec("attack", row["attack"])
        if not row.get("submission"):
            Spec("defence", row["defence"]).make()
        cell.place(spec.make(), spec.entry.knowledge)
    except Exception as error:  # a row can hold anything
        return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    return cell


def _batch(held: Any) -> int:
    return held if isinstance(held, int) and not isinstance(held, bool) and 1 <= held <= 4096 else 256


def _readable(path: Path) -> bool:
    return path.is_file() and path.stat().st_size <= BYTES


def _refused(family: str, row: Row, trust_code: bool) -> str:
    """Why a component of the row is not played; empty where it is."""
    spec = Spec(cast(Any, family), row[family])
    if spec.foreign and not trust_code:
        return f"the {family} {row[family]!r} is code to import, which a row may not make us do; --trust-code allows it"
    recorded = str(row.get(f"{family}_digest") or "")
    if not spec.imports:
        for path in files_of(spec):
            if not _readable(path):
                return f"the {family}'s file {str(path)!r} is not here"
    digest = spec.digest
    if digest != recorded:
        shown = f"digest {recorded[:12] or 'none'}, here {digest[:12] or 'none'}"
        return f"the {family} {row[family]!r} comes from other files than the row's ({shown})"
    version, here = row["versions"].get(family), spec.entry.version
    if version != here:
        return f"the {family} {row[family]!r} has version {here} here and {version} in the row"
    return ""


def _unlike(row: Row, apart: dict[str, str]) -> str:
    """Why a submission is not played; empty where its files are here, in a sandbox."""
    text = apart.get(row["defence"])
    if text is None:
        return f"{row['defence']!r} is a submission: give --submission bwrap/{row['defence']} with its files"
    digest = Spec("defence", text).digest
    if digest != row["defence_digest"]:
        return f"the submission {row['defence']!r} has the digest {digest[:12]} here and {str(row['defence_digest'])[:12]} in the row"
    return ""


def files_of(spec: Spec) -> list[Path]:
    """Files that the text itself names; the digest says whether they are the row's."""
    head, params = spec._parts()
    named = [head] if spec.family == "attack" and Path(head).suffix in (".json", *YAML) else []
    path, policy = params.get("path"), params.get("policy")
    named += [path] if isinstance(path, str) and Path(path).suffix in (".json", *YAML) else []
    named += policy if isinstance(policy, list) else [policy] if policy is not None else []
    return [Path(str(name)) for name in named]


def _spans(cell: Cell, members: list[int], rows: Sequence[Row]) -> list[tuple[Cell, list[int]]]:
    """Cells of neighbouring seeds that cover the rows. Seeds between two of them are played along: side by side they cost little."""
    out: list[tuple[Cell, list[int]]] = []
    for i in sorted(members, key=lambda i: position(rows[i])):
        seed = position(rows[i])
        if out and seed - out[-1][0].first_seed < cell.batch:
            first, held = out[-1]
            out[-1] = replace(first, seeds=seed - first.first_seed + 1), [*held, i]
        else:
            out.append((replace(cell, first_seed=seed, seeds=1), [i]))
    return out


def _compared(line: int, row: Row, here: Row) -> Finding:
    """The row against what came out, field by field."""
    if row["status"] == "error" and here["status"] != "error":
        return Finding(line, "unchecked", f"it failed there ({row['reason'][:80]}) and plays here")
    off = [
        {"field": name, "row": row.get(name), "here": value}
        for name, value in here.items() if name not in FREE and not _same(row.get(name), value)
    ]  # fmt: skip
    if not off:
        return Finding(line, "verified")
    fields = [entry["field"] for entry in off]
    why = ", ".join(fields)
    if fields == ["trace_hash"]:
        why = "trace_hash only: decisions and figures agree, as between two platforms whose last bits differ"
    return Finding(line, "differs", why, off)


def _same(row: Any, here: Any) -> bool:
    if isinstance(here, bool) or isinstance(row, bool):
        return row is here
    return canonical(row) == canonical(here) if isinstance(here, dict | list) else bool(row == here)


def _report(rows: Sequence[Row], found: list[tuple[int, Finding]], sample: int | None, files: Sequence[str]) -> dict[str, Any]:
    def counts(some: list[Finding]) -> dict[str, int]:
        return {verdict: sum(f.verdict == verdict for f in some) for verdict in ("verified", "differs", "unchecked")}

    def status(some: list[Finding]) -> str:
        return "verified" if some and all(f.verdict == "verified" for f in some) else "claimed"

    def entries(of: dict[str, list[Finding]]) -> list[dict[str, Any]]:
        return [{"defence": name, "status": status(some), **counts(some)} for name, some in of.items()]

    by_defence: dict[str, list[Finding]] = {}
    by_file: dict[str, dict[str, list[Finding]]] = {name: {} for name in files}
    reasons: dict[str, int] = {}
    for i, finding in found:
        by_defence.setdefault(rows[i]["defence"], []).append(finding)
        if files:
            by_file[files[i]].setdefault(rows[i]["defence"], []).append(finding)
        if finding.verdict != "verified":
            reasons[f"{finding.verdict}: {finding.why}"] = reasons.get(f"{finding.verdict}: {finding.why}", 0) + 1
    names = ("scenario", "dose", "defence", "attack", "purpose", "seed")
    every = [finding for _, finding in found]
    return {
        "format": "tailgate-verify-1", "status": status(every), "rows": len(rows), "asked": len(found), "sample": sample,
        "version": VERSION, "engine": ENGINE, "counts": counts(every),
        "entries": entries(by_defence), "files": [{"file": name, "entries": entries(of)} for name, of in by_file.items()],
        "reasons": [{"why": why, "rows": n} for why, n in sorted(reasons.items(), key=lambda item: -item[1])],
        "findings": [
            {"line": f.line, "verdict": f.verdict, "why": f.why, **{name: rows[i][name] for name in names}, "differences": f.differences}
            for i, f in found if f.verdict != "verified"
        ],
    }  # fmt: skip
