"""The gradient attack, a white box: values to inject, found by ascending the derivatives of a whole closed loop.

The search knows the defence. It maximises a smooth damage over many tune episodes at once, so it knows no noise of the episodes on which
it is scored. The result is one open-loop schedule for all episodes, a program that needs no knowledge while it is played.
A bound with hindsight has a schedule for each episode, found on that very episode.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tailgate.core import Array, Kind, draws
from tailgate.core.draws import Keys
from tailgate.ensemble.schedule import Schedule, Scheduled, schedule_of
from tailgate.ensemble.search import FINAL, FIRST, MORE, Arena, Found
from tailgate.ensemble.space import GENES
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout

if TYPE_CHECKING:
    from tailgate.engine.torch_form import torch
    from tailgate.ensemble.injection import Injection
    from tailgate.ensemble.injection import Path as Course

SOFT, WIDE = 0.5, 2.0  # of the soft minimum over gaps, and of the step from harmless to harm [m]
SHARP, SHARE = 0.02, 0.1  # the same for errors, as shares of the largest error and of the bound
FASTEST, SLOWEST = 0.3, 0.02  # steps of the first and of the last round, as shares of the largest value of a wire
LEAST = 0.02  # of a bound: the smallest value from which a wire's steps are reckoned
MOMENTUM, MEMORY = 0.8, 0.7  # weights of earlier rounds in the direction, and in what an attacked step is worth
COMPARED = 256  # tune episodes on which the start and the end of an ascent are compared

Tell = Callable[[int, int, str, float], None]


@dataclass(frozen=True)
class Pace:
    """The size of a search: scripts among which the starts are found, starts, rounds of each ascent, and episodes of a round."""

    scripts: int
    starts: int
    rounds: int
    episodes: int


PACES = {"quick": Pace(256, 2, 16, 64), "standard": Pace(2048, 4, 40, 128)}


def smooth_damage(path: Course, follows: bool, bound: float | None) -> torch.Tensor:
    """Return a smooth measure of damage (B,): high where a gap became small, or, where nobody drives, an error large.

    Parameters
    ----------
    path
        The course of the episodes.
    follows
        If somebody drives behind another.
    bound
        The error that counts as damage where nobody drives; without one the measure is the error itself.
    """
    from tailgate.engine.torch_form import tensor, torch

    live = tensor(path.live)
    if follows:
        least = -SOFT * torch.logsumexp(torch.where(live, -path.gap / SOFT, -torch.inf), dim=0)
        return -torch.nn.functional.softplus(least / WIDE)
    level = SHARP * float(torch.where(live, path.error.detach(), 0.0).max()) + 1e-300
    most = level * torch.logsumexp(torch.where(live, path.error / level, -torch.inf), dim=0)
    return most if bound is None else -torch.nn.functional.softplus((bound - most) / (SHARE * bound))


def gradient_of(injection: Injection, keys: Keys, sent: Array, bound: float | None) -> tuple[Array, Array]:
    """Return the smooth damage (B,), and the derivatives of its sum for what is sent (T, N, w) or (B, T, N, w).

    A derivative that is not finite counts as 0: its direction is unknown.
    """
    from tailgate.engine.torch_form import torch
    from tailgate.ensemble.injection import single_thread

    schedule = torch.tensor(sent, requires_grad=True)
    damage = smooth_damage(injection.play(keys, schedule), bool(injection.loop.model.followers.any()), bound)
    if not damage.requires_grad:  # the trigger never opened
        return damage.numpy(), np.zeros_like(sent)
    with single_thread():
        (slope,) = torch.autograd.grad(damage.sum(), schedule)
    found = slope.numpy()
    return damage.detach().numpy(), np.where(np.isfinite(found), found, 0.0)


def ascend(
    injection: Injection, start: Schedule, budget: int | None, rounds: int, episodes: Callable[[int], Keys], bound: float | None,
    tell: Callable[[int, float], None] | None = None,
) -> Schedule:  # fmt: skip
    """Ascend from a schedule by projected gradients with momentum; return the schedule of the last round.

    The derivative is taken as if every step were attacked, with values of 0 in those that are not (straight through).
    A step is worth the derivative times its value; the budget goes to the worthiest steps.

    Parameters
    ----------
    budget
        Attack steps of an episode, or None for all.
    episodes
        The episodes of a round, by its number from 0.
    tell
        Called after each round with its number from 1, and the mean smooth damage before it.
    """
    brief = injection.loop.brief
    bounds = np.where(brief.granted, brief.bounds, 0.0)
    values, chosen = np.clip(start.values, -bounds, bounds), start.chosen
    direction, worth = np.zeros_like(values), chosen.astype(float)
    for number in range(rounds):
        sent = Schedule(start.trigger, values, chosen).sent
        damage, slope = gradient_of(injection, episodes(number), sent, bound)
        size = np.max(np.abs(slope), axis=(-3, -2, -1), keepdims=True)
        direction = MOMENTUM * direction + slope / np.where(size > 0.0, size, 1.0)
        scale = np.maximum(np.max(np.abs(values), axis=(-3, -2), keepdims=True), LEAST * bounds)
        pace = SLOWEST + (FASTEST - SLOWEST) * (1.0 - number / rounds)
        values = np.clip(values + pace * scale * np.sign(direction), -bounds, bounds)
        gain = np.sum(slope * values, axis=(-2, -1))
        most = np.max(np.abs(gain), axis=-1, keepdims=True)
        worth = MEMORY * worth + (1.0 - MEMORY) * gain / np.where(most > 0.0, most, 1.0)
        chosen = worthiest(worth, budget)
        if tell is not None:
            tell(number + 1, float(np.mean(damage)))
    return Schedule(start.trigger, values, chosen)


def worthiest(worth: Array, budget: int | None) -> Array:
    """Return a mask of the `budget` steps of greatest worth (..., T); of equals the first."""
    if budget is None or budget >= worth.shape[-1]:
        return np.ones(worth.shape, bool)
    rank = np.argsort(np.argsort(-worth, axis=-1, kind="stable"), axis=-1, kind="stable")
    return rank < budget


def gradient(arena: Arena, pace: Pace, out: Path, seed: int = 0, tell: Tell | None = None, scripts: Sequence[str] = ()) -> list[Found]:
    """Search schedules of false data that do most harm; return them, the most harmful first.

    Parameters
    ----------
    arena
        The defence, and where it is attacked.
    out
        Folder of the programs that are found; the figures are those of the files, as `evaluate` plays them.
    seed
        The same seed finds the same schedules.
    tell
        Called after each round with its number, their count, the file, and the mean smooth damage.
    scripts
        Scripts of false data, `fdi` or `fdi_ramp`, from which the first ascents begin, such as the best of `search`.

    Returns
    -------
    list of Found
        Each `script` is the path of a program. Empty where the threat model does not grant false data.

    Raises
    ------
    ImportError
        If PyTorch is not installed (extra `train`).
    """
    from tailgate.ensemble.injection import Injection

    found, bound = [], None if arena.loop.model.followers.any() else arena.bound
    budget, brief = arena.loop.threat.budget, arena.loop.brief
    after = FIRST + MORE
    for number, start in enumerate(starts(arena, pace, seed, scripts)):
        injection = Injection(arena.loop, start.when())
        begin = after + number * pace.rounds * pace.episodes
        path = out / f"gradient-{arena.scenario}-{'own' if arena.dose is None else arena.dose}-{arena.defence}-{number}.yaml"

        def keys(turn: int, begin: int = begin) -> Keys:
            first = begin + turn * pace.episodes
            return draws.keys("tune", range(first, first + pace.episodes))

        def say(turn: int, damage: float, number: int = number, path: Path = path) -> None:
            if tell is not None:
                tell(number * pace.rounds + turn, pace.starts * pace.rounds, path.name, damage)

        ends = [start, ascend(injection, start, budget, pace.rounds, keys, bound, say)]
        scores = []
        for end in ends:
            end.write(path, brief, f"Found by gradients against {arena.defence} in {arena.scenario}.")
            scores.append(arena.confirmed(str(path), "tune", after + pace.starts * pace.rounds * pace.episodes, COMPARED)[1])
        ends[int(np.argmax(scores))].write(path, brief, f"Found by gradients against {arena.defence} in {arena.scenario}.")
        found.append(Found(str(path), *arena.confirmed(str(path), "select", 0, FINAL), FINAL))
    return sorted(found, key=lambda one: -one.score)


def starts(arena: Arena, pace: Pace, seed: int, scripts: Sequence[str] = ()) -> list[Schedule]:
    """Return the schedules from which ascents begin: those of the given scripts, then of the most harmful among random ones.

    The random ones differ in their triggers.
    """
    space, brief = arena.space, arena.loop.brief
    families = [i for i, family in enumerate(space.families) if family.kind == Kind.FDI and family.then is None]
    if not families:
        return []
    given = [schedule_of(text, brief) for text in scripts[: pace.starts]]
    if len(given) == pace.starts:
        return given
    rng = np.random.default_rng([seed, zlib.crc32(f"gradient/{arena.scenario}/{arena.dose}/{arena.defence}".encode())])
    genomes = rng.random((pace.scripts, len(GENES)))
    genomes[:, 0] = (np.array(families)[np.arange(pace.scripts) % len(families)] + 0.5) / len(space.families)
    rows = space.rows(genomes)
    total = arena.scores(rows, 0, FIRST)
    best = np.argsort(-total, kind="stable")[: pace.starts * 8]
    again = total[best] + arena.scores(rows.take(best), FIRST, MORE)
    out: dict[int, Schedule] = {}
    for i in best[np.argsort(-again, kind="stable")].tolist():
        out.setdefault(int(rows.trigger[i]), schedule_of(space.text(genomes[i]), brief))
    return [*given, *out.values()][: pace.starts]


def hindsight(arena: Arena, start: Schedule, episodes: int, rounds: int, purpose: str = "report", first: int = 0) -> float:
    """Return the share of episodes that schedules damage which were found on these very episodes, one on each.

    No attacker knows the noise to come. This is a bound on what an open-loop schedule can do, as far as the ascent finds it.
    """
    from tailgate.ensemble.injection import Injection

    keys = draws.keys(purpose, range(first, first + episodes))
    injection, bound = Injection(arena.loop, start.when()), None if arena.loop.model.followers.any() else arena.bound
    own = Schedule(start.trigger, *(np.repeat(part[None], episodes, axis=0) for part in (start.values, start.chosen)))
    hit = np.zeros(episodes, bool)
    for schedule in (own, ascend(injection, own, arena.loop.threat.budget, rounds, lambda _: keys, bound)):
        trace = rollout(arena.loop, Scheduled(schedule), keys, plain=True)
        hit |= (METRICS["crashed"](trace) > 0) | (METRICS["max_error"](trace) > (np.inf if bound is None else bound))
    return float(np.mean(hit))


def gradient_masking(white: Found | None, black: Found | None) -> bool:
    """Return True if the best script, a black box, did more damage than the gradients: the defence hides its derivatives."""
    return black is not None and (white is None or white.damage < black.damage)
