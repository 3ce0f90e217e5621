"""Falsification as one call: search, shrink, replay, report."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tailgate.base.files import set_aside, writable_directory, write_json
from tailgate.base.locks import alone
from tailgate.base.reading import load_json
from tailgate.falsify.counterexample import counterexample
from tailgate.falsify.search import Search, search

COUNTEREXAMPLE, REPORT = "counterexample.json", "falsify.json"
Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


def falsify(job: Search, out: Path | None = None, progress: Progress | None = None) -> dict[str, Any]:
    """Search an episode that breaks a property, and shrink its attack.

    Parameters
    ----------
    job
        The case, the sampler, how many trials, and the seed.
    out
        Folder of finished generations, the report and the counterexample. The same call goes on after an interrupt.

    Returns
    -------
    dict
        `violated`, `least` (robustness that the search found), `trials`, `episodes`, `violations`, `seconds`, and `counterexample`:
        the worst episode with its shrunk attack, as `tailgate.falsify.counterexample` writes it. A robustness has the unit of the atom
        that decides.

    Raises
    ------
    InputError
        Before anything is played, for an argument that makes no sense.
    ImportError
        Before anything is played, for a sampler that is not installed.
    """
    update, started = progress or (lambda *_: None), time.perf_counter()
    job.check()
    with contextlib.nullcontext() if out is None else alone(writable_directory(out)):
        if out is not None and (out / REPORT).is_file() and not _is_of(job, out / REPORT):
            for name in (REPORT, COUNTEREXAMPLE):
                if (out / name).is_file():
                    set_aside(out / name)
        worst = search(job, out, lambda done, total, least: update("falsify", done, total, f"least robustness {least:.4g}"))
        update("shrink", 0, 1, "")
        found = counterexample(job.case, worst)
        update("shrink", 1, 1, f"{found['found']['steps']} attacked steps to {found['steps']}")
        report = _asked(job) | {
            "trials": worst.trials, "episodes": worst.episodes, "violations": worst.violations, "least": worst.robustness,
            "violated": found["robustness"] < 0.0, "seconds": round(time.perf_counter() - started, 2), "counterexample": found,
        }  # fmt: skip
        if out is not None:
            if report["violated"]:
                write_json(out / COUNTEREXAMPLE, found)
            write_json(out / REPORT, report)
    return report


def _asked(job: Search) -> dict[str, Any]:
    """Return what a report says of its job."""
    case = job.case
    return {
        "property": case.formula, "defence": case.defence, "suite": case.suite, "scenario": case.scenario, "dose": case.dose,
        "attack": case.attack or "searched", "sampler": job.sampler, "seed": job.seed,
    }  # fmt: skip


def _is_of(job: Search, report: Path) -> bool:
    """Return True for a report of this job."""
    try:
        held = load_json(report, strict=False)
        return isinstance(held, dict) and all(held.get(key) == value for key, value in _asked(job).items())
    except (OSError, ValueError):
        return False
