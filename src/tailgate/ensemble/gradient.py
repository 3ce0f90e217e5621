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

from tailgate.base.errors import InputError
from tailgate.core import Array, Kind, draws
from tailgate.core.draws import Keys, Role
from tailgate.core.schema import as_data, digest
from tailgate.ensemble.battery import played_plainly
from tailgate.ensemble.schedule import Schedule, Scheduled, schedule_of
from tailgate.ensemble.search import FINAL, FIRST, MORE, Arena, Found, Meaningless
from tailgate.ensemble.space import GENES

if TYPE_CHECKING:
    from tailgate.engine.torch_form import torch
    from tailgate.ensemble.injection import Course, Injection

SOFT, WIDE = 0.1, 0.5  # of the soft minimum over gaps, and of the step from harmless to harm [m]
SLOPE = 1e-3  # of damage per metre of gap, or unit of error, far from harm
SHARP, SHARE = 0.02, 0.1  # the same for errors, as shares of the largest error and of the bound
PACE, PATIENCE = 0.3, 2  # first step, as a share of a wire's largest value and of the budget; failures before it is halved
LEAST = 0.02  # of a bound: the smallest value from which a wire's steps are reckoned
MOMENTUM = 0.8  # weight of earlier rounds in the direction
ROOM = 1e9  # [bytes] of what the derivatives of episodes side by side keep
COMPARED = 256  # tune episodes on which the start and the end of an ascent are compared

Tell = Callable[[int, int, str, float], None]


@dataclass(frozen=True)
class Pace:
    """The size of a search: scripts among which the starts are found, starts, rounds of each ascent, and episodes of a round."""

    scripts: int
    starts: int
    rounds: int
    episodes: int

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1:
                raise InputError(f"pace.{name}", value, "a whole number, at least 1")


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
        return torch.sigmoid(-least / WIDE) - SLOPE * least
    level = SHARP * float(torch.where(live, path.error.detach(), 0.0).max()) + 1e-300
    most = level * torch.logsumexp(torch.where(live, path.error / level, -torch.inf), dim=0)
    return most if bound is None else torch.sigmoid((most - bound) / (SHARE * bound)) + SLOPE * most


def gradient_of(injection: Injection, keys: Keys, sent: Array, bound: float | None) -> tuple[Array, Array]:
    """Return the smooth damage (B,), and the derivatives of its sum for what is sent (T, N, w) or (B, T, N, w).

    A derivative that is not finite counts as 0: its direction is unknown.
    """
    each = max(int(ROOM // (8 * injection.numbers * injection.loop.horizon)), 1)
    parts = []
    for first in range(0, len(keys.key), each):
        some = slice(first, first + each)
        parts.append(_gradient(injection, Keys(keys.key[some], keys.episode[some]), sent if sent.ndim == 3 else sent[some], bound))
    damage, slopes = (list(column) for column in zip(*parts, strict=True))
    return np.concatenate(damage), np.sum(slopes, axis=0) if sent.ndim == 3 else np.concatenate(slopes)


def _gradient(injection: Injection, keys: Keys, sent: Array, bound: float | None) -> tuple[Array, Array]:
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
    injection: Injection, start: Schedule, budget: int | None, rounds: int, keys: Keys, bound: float | None,
    tell: Callable[[int, float], None] | None = None,
) -> Schedule:  # fmt: skip
    """Ascend from a schedule by projected gradients with momentum; return the best schedule that was met.

    The derivative is taken as if every step were attacked, with values of 0 in those that are not (straight through).
    A step is worth the derivative times its value; in each round some of the budget moves to worthier steps.
    After some rounds without success the search goes back to the best schedule, and on with half the step.

    Parameters
    ----------
    start
        One schedule for all episodes, or one for each, which then ascends by itself.
    budget
        Attack steps of an episode, or None for all.
    keys
        The episodes, the same in all rounds.
    bound
        The error that counts as damage where nobody drives, see `smooth_damage`.
    tell
        Called after each round with its number from 1, and the best mean of the smooth damage so far.
    """
    brief, shared = injection.loop.brief, start.values.ndim == 3
    bounds = np.where(brief.granted, brief.bounds, 0.0)
    now = Schedule(start.trigger, np.clip(start.values, -bounds, bounds), start.chosen)
    best, slope, direction = now, np.zeros_like(now.values), np.zeros_like(now.values)
    lead = now.values.shape[:-3]
    most, pace, failures = np.full(lead, -np.inf), np.full(lead, PACE), np.zeros(lead, int)
    for number in range(rounds):
        damage, found = gradient_of(injection, keys, now.sent, bound)
        score = np.mean(damage) if shared else damage
        better = score > most
        most, failures = np.maximum(score, most), np.where(better, 0, failures + 1)
        best, slope = _where(better, now, best), np.where(_wide(better, found), found, slope)
        back = failures >= PATIENCE
        now, found = _where(back, best, now), np.where(_wide(back, found), slope, found)
        pace, failures = np.where(back, 0.5 * pace, pace), np.where(back, 0, failures)
        size = np.max(np.abs(found), axis=(-3, -2, -1), keepdims=True)
        direction = np.where(_wide(back, found), 0.0, MOMENTUM * direction) + found / np.where(size > 0.0, size, 1.0)
        scale = np.maximum(np.max(np.abs(now.values), axis=(-3, -2), keepdims=True), LEAST * bounds)
        values = np.clip(now.values + _wide(pace, found) * scale * np.sign(direction), -bounds, bounds)
        now = Schedule(start.trigger, values, moved(now.chosen, np.sum(found * values, axis=(-2, -1)), budget, pace))
        if tell is not None:
            tell(number + 1, float(np.mean(most)))
    return best


def _wide(x: Array, like: Array) -> Array:
    return np.reshape(x, (*np.shape(x), *(1,) * (like.ndim - np.ndim(x))))


def _where(mask: Array, new: Schedule, old: Schedule) -> Schedule:
    values, chosen = (np.where(_wide(mask, x), x, y) for x, y in zip(new[1:], old[1:], strict=True))
    return Schedule(new.trigger, values, chosen)


def moved(chosen: Array, worth: Array, budget: int | None, share: Array) -> Array:
    """Return the steps (..., T) that are attacked next: of the `chosen` all but a share (...) stay, the rest goes to the worthiest."""
    if budget is None or budget >= worth.shape[-1]:
        return np.ones(worth.shape, bool)
    stay = budget - np.maximum(np.round(share * budget), 1).astype(int)
    kept = worthiest(np.where(chosen, worth, -np.inf), stay) & chosen
    return worthiest(np.where(kept, np.inf, worth), budget)


def worthiest(worth: Array, count: int | Array) -> Array:
    """Return a mask of the `count` (...) steps of greatest worth (..., T); of equals the first."""
    rank = np.argsort(np.argsort(-worth, axis=-1, kind="stable"), axis=-1, kind="stable")
    return np.asarray(rank < np.asarray(count)[..., None])


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
        Each `attack` names the file of a program. Empty where the threat model does not grant false data.

    Raises
    ------
    ImportError
        If PyTorch is not installed (extra `train`).
    Meaningless
        For a system of several agents without derivatives by machine code.
    """
    from tailgate.ensemble.injection import Injection

    found, bound = [], None if arena.loop.model.followers.any() else arena.bound
    budget, brief = arena.loop.threat.budget, arena.loop.brief
    after = FIRST + MORE  # the episodes before chose the starts
    keys = draws.keys("tune", range(after, after + pace.episodes))
    for number, start in enumerate(starts(arena, pace, seed, scripts)):
        injection = Injection(arena.loop, start.when())
        if (agents := arena.loop.model.agents) > 1 and not injection.compiled:
            raise Meaningless("agents", agents, "1: PyTorch takes half a minute for a gradient through this loop")
        name = f"{arena.name}-{'own' if arena.dose is None else arena.dose}-gradient-{digest([as_data(arena), seed, number])}.yaml"
        path = out / name

        def say(turn: int, damage: float, number: int = number, path: Path = path) -> None:
            if tell is not None:
                tell(number * pace.rounds + turn, pace.starts * pace.rounds, path.name, damage)

        ends = [start, ascend(injection, start, budget, pace.rounds, keys, bound, say)]
        scores = []
        for end in ends:
            end.write(path, brief, f"Found by gradients against {arena.defence} in {arena.scenario}.")
            scores.append(arena.confirmed(str(path), "tune", after + pace.episodes, COMPARED)[1])
        ends[int(np.argmax(scores))].write(path, brief, f"Found by gradients against {arena.defence} in {arena.scenario}.")
        found.append(Found(f"program:path={path}", *arena.confirmed(str(path), "select", 0, FINAL), FINAL))
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
    rng = np.random.default_rng([seed, zlib.crc32(f"gradient/{arena.name}/{arena.dose}/{arena.defence}".encode())])
    genomes = rng.random((pace.scripts, len(GENES)))
    genomes[:, 0] = (np.array(families)[np.arange(pace.scripts) % len(families)] + 0.5) / len(space.families)
    many = space.scripts(genomes)
    total = arena.scores(many, 0, FIRST)
    best = np.argsort(-total, kind="stable")[: pace.starts * 8]
    again = total[best] + arena.scores(many.take(best), FIRST, MORE)
    out: dict[int, Schedule] = {}
    for i in best[np.argsort(-again, kind="stable")].tolist():
        out.setdefault(int(many.phases[0].trigger[i]), schedule_of(space.text(genomes[i]), brief))
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
    reach = arena.reach(purpose, first, episodes)
    for schedule in (own, ascend(injection, own, arena.loop.threat.budget, rounds, keys, bound)):
        attack = Scheduled(schedule)
        plan = attack.prepare(arena.loop.brief)
        memory = attack.start(plan, episodes, keys.at(Role.ATTACK, np.zeros(episodes, np.int64)))
        hit |= arena.harm(played_plainly(arena.loop, attack, plan, keys, memory), reach)[0]
    return float(np.mean(hit))


def gradient_masking(white: Found | None, black: Found | None) -> bool:
    """Return True if the best black box of any kind damaged more select episodes than the gradients, which send false data alone.

    It is a hint that the defence hides its derivatives, and no test: the kinds of attack may differ too.
    """
    return black is not None and (white is None or white.damage < black.damage)
