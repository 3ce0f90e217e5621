"""Rare events of a loop: the probability that an episode breaks an invariant, and the likeliest noise that does so."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base import sources
from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_json
from tailgate.base.locks import alone
from tailgate.base.reading import load_json
from tailgate.core.draws import Role
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario
from tailgate.core.schema import as_data as plain_data
from tailgate.core.schema import digest
from tailgate.falsify.branches import Branches, as_data
from tailgate.falsify.case import AT_ONCE, Case
from tailgate.falsify.claim import invariant_of
from tailgate.falsify.likeliest import Likeliest, likeliest
from tailgate.falsify.noise import NoisyLoop
from tailgate.falsify.splitting import Run, chance_of, check, plain_episodes, split
from tailgate.play.trace import episodes_at_once

REPORT = "rare.json"
SAMPLES, BLOCKS = 256, 60  # of the search for the likeliest failure
SHOWN = 50  # levels that a bar counts; a run ends where it arrives
Progress = Callable[[str, int, int, str], None]  # label, done, total, figures


@dataclass(frozen=True)
class Rare:
    """An estimate: the case, particles of a run, runs, and the seed of the keys."""

    case: Case
    particles: int = 256
    runs: int = 8
    seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        check(self.particles, self.runs, self.confidence, self.seed)

    def digest(self, what: str) -> str:
        """Return a digest of all that decides a part of the result."""
        one = self.case
        parts = [Spec("defence", one.defence).digest, Spec("attack", one.attack).digest, load_scenario(one.scenario).config_hash]
        counts = self.particles if what == "run" else self.runs if what == "likeliest" else None
        return digest([sources.own(), *parts, plain_data(one), counts, self.seed, what])


def estimate(job: Rare, out: Path | None = None, progress: Progress | None = None, noise: bool = False) -> dict[str, Any]:
    """Estimate how rarely an episode breaks an invariant.

    Parameters
    ----------
    job
        The case, whose attack may be `none` or one with random draws, and the size of the estimate.
    out
        Folder of finished runs and the report. The same call goes on after an interrupt.
    noise
        Search the likeliest failure too.

    Returns
    -------
    dict
        `probability` with `low` and `high`; `runs`, the estimate of each; `episodes` that were played, and `plain_episodes` that would
        give an interval as narrow.
        `failure`: an episode that broke the invariant, as keys that `tailgate.falsify.branches` plays.
        `likeliest`: the noise in standard deviations and its log-likelihood over that of no noise.

    Raises
    ------
    InputError
        Before anything is played, for an argument that makes no sense, and for a property that is no invariant.
    """
    update, started = progress or (lambda *_: None), time.perf_counter()
    if not job.case.attack:
        raise InputError("--attack", job.case.attack, "none or an attack by name")
    job.case.check()
    loop, invariant = job.case.own, invariant_of(job.case.claim)
    attack, at_once = Spec("attack", job.case.attack).make(), episodes_at_once(job.case.own.model, job.case.own.horizon, AT_ONCE)
    play = Branches(loop, attack, invariant, at_once)
    with contextlib.nullcontext() if out is None else alone(writable_directory(out)):
        runs, failures = [], []
        for number in range(job.runs):
            path = None if out is None else out / "runs" / f"{number:03d}.json"
            held = _kept(path, job.digest("run"))
            if held is None:
                rng = np.random.default_rng([job.seed, number])
                run = split(
                    play, loop.horizon, job.particles, rng,
                    lambda level, p, left, at=number: update(f"run {at + 1}", min(level, SHOWN), SHOWN, f"P {p:.2g}, {left:.3g} to go"),  # type: ignore[misc]
                )  # fmt: skip
                held = {
                    "probability": run.probability,
                    "levels": run.levels,
                    "episodes": run.episodes,
                    "first": run.first,
                    "failure": _failure(run),
                }
                _keep(path, held | {"digest": job.digest("run")})
            runs.append(Run(held["probability"], held["levels"], held["episodes"], np.zeros(0), np.zeros(0), held["first"]))
            failures += [held["failure"]] if held["failure"] else []
            update("splitting", number + 1, job.runs, f"P {runs[-1].probability:.3g}")
        chance = chance_of(runs, job.particles, job.confidence)
        found = _noise(job, NoisyLoop(loop, attack, invariant, at_once), out, update) if noise else None
        report = {
            "property": job.case.formula, "defence": job.case.defence, "suite": job.case.suite, "scenario": job.case.scenario,
            "dose": job.case.dose, "attack": job.case.attack, "seed": job.seed, "particles": job.particles,
            "confidence": job.confidence, "probability": chance.probability, "low": chance.low, "high": chance.high,
            "runs": list(chance.runs), "levels": [run.levels for run in runs], "episodes": chance.episodes,
            "plain_episodes": _finite(plain_episodes(chance, job.confidence)), "likeliest": found,
            "failure": min(failures, key=lambda one: one["margin"], default=None),
            "seconds": round(time.perf_counter() - started, 2),
        }  # fmt: skip
        _keep(None if out is None else out / REPORT, report)
    return report


def _failure(run: Run) -> dict[str, Any] | None:
    """Return the path of a run that arrived with the least margin, as JSON data."""
    if not len(run.margins):
        return None
    at = int(np.argmin(run.margins))
    return {"margin": float(run.margins[at]), "keys": as_data(run.keys[:, at])}


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _noise(job: Rare, play: NoisyLoop, out: Path | None, update: Progress) -> dict[str, Any]:
    """Return the likeliest failure as JSON data."""
    path, name = None if out is None else out / "likeliest.json", job.digest("likeliest")
    if (held := _kept(path, name)) is not None:
        return held["found"]  # type: ignore[no-any-return]
    found: Likeliest = likeliest(
        play, play.steps, play.width, SAMPLES, BLOCKS, np.random.default_rng([job.seed, job.runs, 1]),
        lambda done, of, left: update("likeliest failure", done, of, f"{left:.3g} to go"),
    )  # fmt: skip
    update("likeliest failure", 1, 1, f"{found.distance:.3g} standard deviations")
    channels = [
        {"role": Role(slot.role).name.lower(), "tag": slot.tag, "at": int(at), "noise": found.mean[:, place].tolist()}
        for slot, start in zip(play.slots, np.cumsum([0, *(slot.size for slot in play.slots)]), strict=False)
        for at, place in enumerate(range(int(start), int(start) + slot.size))
    ]  # fmt: skip
    data = {
        "failed": found.failed, "distance": found.distance, "log_likelihood": found.log_likelihood, "first_order": found.first_order,
        "episodes": found.episodes, "channels": channels,
    }  # fmt: skip
    _keep(path, {"digest": name, "found": data})
    return data


def _keep(path: Path | None, data: dict[str, Any]) -> None:
    if path is not None:
        write_json(path, data)


def _kept(path: Path | None, name: str) -> dict[str, Any] | None:
    """Return what an earlier run kept under this digest."""
    if path is None or not path.is_file():
        return None
    try:
        held = load_json(path)
    except (OSError, ValueError):
        held = None
    if not isinstance(held, dict) or held.get("digest") != name:
        raise InputError("--out", str(path), "a part of this very estimate; remove it, or give another folder")
    return held
