"""The whole thesis in one report: every chapter, and a list of all that it contains with the claims that answer it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tailgate.base import sources
from tailgate.base.errors import InputError
from tailgate.base.files import sweep, writable_directory, write_atomic, write_html, write_json
from tailgate.base.locks import alone
from tailgate.base.reading import load_json
from tailgate.base.version import VERSION
from tailgate.core import param
from tailgate.core.schema import build, read_yaml

from .claims import Claim, Report
from .run import CHAPTERS, body, check_chapter, check_seeds, data_of, page, read, reproduce, rows, summary, write

TITLE = "Security of Autonomous Systems under Physical Attacks, claim by claim"
Play = Callable[..., Report]


@dataclass(frozen=True)
class Item:
    """One thing that the thesis contains: a figure, table, theorem, algorithm, or a sentence that states a result."""

    item: str
    what: str
    claims: tuple[str, ...] = param((), "ids of the claims that answer it")
    figures: tuple[str, ...] = param((), "figures that show it again, as chapter-name")
    why: str = param("", "why there is no claim")


@dataclass
class Whole:
    """All chapters, in their order, with the seconds that each took, and what they cover."""

    seeds: int
    sources: str
    reports: list[Report]
    seconds: dict[str, float]
    kept: tuple[str, ...]  # chapters that an earlier run had finished
    coverage: list[Item]
    version: str = VERSION

    @property
    def claims(self) -> list[Claim]:
        return [claim for report in self.reports for claim in report.claims]


def load_coverage() -> list[Item]:
    """Return the list of what the thesis contains. Raises InputError for an item with neither a claim nor a reason."""
    data = read_yaml(Path(__file__).with_name("coverage.yaml"), "coverage")
    items = [build(Item, held, f"coverage, item {i}") for i, held in enumerate(data.get("items", []), start=1)]
    for item in items:
        if not item.claims and not item.why:
            raise InputError(f"coverage: {item.item}", "neither claims nor why", "one of both")
    return items


def check_coverage(items: Iterable[Item], claims: Iterable[str]) -> None:
    """Raise InputError if an item names a claim that no chapter makes, or a claim answers nothing that the thesis contains."""
    known, named = set(claims), {name for item in items for name in item.claims}
    if named - known:
        raise InputError("coverage", sorted(named - known), "claims that a chapter makes")
    if known - named:
        raise InputError("coverage: no item for", sorted(known - named), "every claim at something that the thesis contains")


def reproduce_whole(
    seeds: int,
    directory: Path,
    tick: Callable[[str], None] = lambda _: None,
    chapters: Iterable[str] = tuple(CHAPTERS),
    play: Play = reproduce,
) -> Whole:
    """Reproduce every chapter into its own folder of `directory`; keep those that a run of the same version, sources and seeds finished."""
    check_seeds(seeds)
    writable_directory(directory)
    out = Whole(seeds, sources.own(), [], {}, (), load_coverage())
    for name in chapters:
        report, seconds, kept = chapter(name, seeds, directory / name, tick, play)
        out.reports.append(report)
        out.seconds[name] = seconds
        out.kept += (name,) * kept
    return out


def chapter(
    name: str, seeds: int, place: Path, tick: Callable[[str], None] = lambda _: None, play: Play = reproduce
) -> tuple[Report, float, bool]:
    """Reproduce a chapter into its folder; return its report, its seconds, and whether an earlier run had finished it."""
    check_chapter(name)
    check_seeds(seeds)
    with alone(place):
        return _chapter(name, seeds, place, tick, play)


def _chapter(name: str, seeds: int, place: Path, tick: Callable[[str], None], play: Play) -> tuple[Report, float, bool]:
    writable_directory(place)
    stamp = {"seeds": seeds, "sources": sources.own()}
    found = read(place)
    if found and all(found[1].get(key) == value for key, value in {"version": VERSION, **stamp}.items()):
        tick(f"{name}: finished before, in {found[1]['seconds']:.0f} s")
        return found[0], float(found[1]["seconds"]), True
    begin = time.monotonic()
    report = play(name, seeds, lambda text: tick(f"{name}: {text}"))
    seconds = round(time.monotonic() - begin, 1)
    write(report, place, **stamp, seconds=seconds)
    sweep(place)
    tick(f"{name}: {summary(report)}; {seconds:.0f} s")
    return report, seconds, False


def facts(whole: Whole) -> dict[str, str]:
    """Return what the report rests on."""
    total, kept = sum(whole.seconds.values()), ", ".join(whole.kept)
    return {
        "seeds": f"{whole.seeds} where a chapter does not say otherwise",
        "run time": f"{total / 60.0:.1f} minutes of wall-clock time" + (f", of which earlier: {kept}" if kept else ""),
        "measured": "median [quartiles] over seeds, or a share with its exact 95 % interval, where nothing else is said",
        "Tailgate": whole.version,
    }


def covered(items: list[Item]) -> str:
    """Return how many numbered items of the thesis claims answer."""
    with_claims = sum(bool(item.claims) for item in items)
    return f"{len(items)} items: {with_claims} are answered by claims, {len(items) - with_claims} state no result"


def counts(whole: Whole) -> list[tuple[str, ...]]:
    """Return a row per chapter: claims, how many hold, partly, do not, and seconds."""
    out = []
    for report in whole.reports:
        held = [str(sum(c.holds == word for c in report.claims)) for word in ("yes", "partly", "no")]
        out.append((report.title, str(len(report.claims)), *held, f"{whole.seconds[report.chapter]:.0f}"))
    return out


def markdown(whole: Whole) -> str:
    """Return the report as one Markdown text; pictures are in the chapters' folders."""
    verdicts = {claim.id: claim.holds for claim in whole.claims}
    lines = [f"# {TITLE}", "", f"{summary(*whole.reports)}.", "", *(f"- {key}: {value}" for key, value in facts(whole).items()), ""]
    lines += rows(("chapter", "claims", "hold", "partly", "do not", "seconds"), counts(whole))
    for report in whole.reports:
        lines += ["", f"## {report.title}", "", f"{summary(report)}.", "", *body(report, f"{report.chapter}/", "###")]
    lines += ["", "## What the thesis contains, and where it is answered", "", f"{covered(whole.coverage)}.", ""]
    cells = [(i.item, i.what, ", ".join(f"{c} ({verdicts[c]})" for c in i.claims), ", ".join(i.figures), i.why) for i in whole.coverage]
    return "\n".join([*lines, *rows(("item", "what it says", "claims", "figures", "if none, why"), cells)]) + "\n"


def as_data(whole: Whole) -> dict[str, Any]:
    """Return the report as JSON data."""
    return {
        "title": TITLE, "version": whole.version, "seeds": whole.seeds, "sources": whole.sources, "seconds": whole.seconds,
        "chapters": {
            r.chapter: data_of(r) | {"figures": [f"{r.chapter}/{f.name}.png" for f in r.figures]} for r in whole.reports
        },
        "coverage": [dataclasses.asdict(item) for item in whole.coverage],
    }  # fmt: skip


def write_whole(whole: Whole, directory: Path) -> Path:
    """Write report.json, report.md and index.html of the whole; return the page.

    Raises InputError if the coverage does not fit the claims.
    """
    check_coverage(whole.coverage, [claim.id for claim in whole.claims])
    drawn = {f"{r.chapter}-{f.name}" for r in whole.reports for f in r.figures}
    if missing := {name for item in whole.coverage for name in item.figures} - drawn:
        raise InputError("coverage: figures", sorted(missing), "figures that a chapter draws")
    write_json(directory / "report.json", as_data(whole))
    write_atomic(directory / "report.md", markdown(whole).encode())
    write_html(directory / "index.html", html(whole).encode())
    sweep(directory)
    return directory / "index.html"


def html(whole: Whole) -> str:
    """Return the report as one self-contained page."""
    return page(
        "whole.html", title=TITLE, summary=summary(*whole.reports), reports=whole.reports, facts=facts(whole), counts=counts(whole),
        coverage=whole.coverage, covered=covered(whole.coverage), verdicts={claim.id: claim.holds for claim in whole.claims},
    )  # fmt: skip


def read_whole(directory: Path) -> Whole:
    """Return the report that `write_whole` wrote into a directory, with the version that wrote it.

    Which chapters were kept from an earlier run is not in it. Raises InputError for what is no such report.
    """
    try:
        data = load_json(directory / "report.json")
        items = [build(Item, held, f"coverage, item {i}") for i, held in enumerate(data["coverage"], start=1)]
        found = [(name, read(directory / name)) for name in data["chapters"]]
        reports = [held[0] for _, held in found if held]
        if missing := [name for name, held in found if held is None]:
            raise InputError(str(directory), missing, "a report.json and the figures of each chapter")
        return Whole(data["seeds"], data["sources"], reports, data["seconds"], (), items, data["version"])
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(str(directory / "report.json"), str(error), "a report of all chapters") from None
