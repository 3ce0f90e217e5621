"""Learning a safety envelope from clean runs (tailgate.estimators.safe_set.envelope; docs/detectors.md#the-learned-envelope).

Templates of invariants, each a weighted sum g of signals:

    reading      y_i                                    component    a principal component with little of the variance
    change       y_i - y_i of the step before           regression   y_i less its least-squares fit by all other signals
    difference   y_i - y_j of one unit, where narrower than both

Places on the road have no bounds: they enter by differences alone, so that a drive may be longer than those that were learned from.

The training steps give the bounds of g: their extremes, widened by a margin. An invariant is kept if few enough other clean episodes leave
its bounds, by the one-sided Clopper-Pearson limit. Steps of an episode are not independent, its agents neither; episodes are. The limit is
that of all invariants that are tried together (Bonferroni). Bounds for one sign of the known input are kept where they are tighter.

Messages count as signals. Agents share one envelope: a step of each is a sample.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.files import write_atomic
from tailgate.base.version import VERSION
from tailgate.core import Array, Model
from tailgate.estimators.safe_set.envelope import Invariant, Kind, Sheet, Sign, names_of, sealed
from tailgate.evaluation.stats import limits
from tailgate.studies.log_card import unit_of

LEVEL = 0.95  # of the Clopper-Pearson limit
TAIL_POINTS = 500  # largest values that a tail is fitted to
REST = 0.1  # of the half width: by how much a bound is widened at which clean runs rest, as at standstill; the score would rest at 1
TIES = 20  # steps at a bound that are a rest
NARROW = 0.5  # a difference is kept below this share of the range of both signals
TIGHTER = 0.95  # bounds of one sign are kept below this share of the width without regard to it
SMALL = 1e-2  # variance of a principal component, in those of one standardised signal
NOTHING = 1e-13  # share of the largest term below which a term is left out
Progress = Callable[[str, int, int], None]  # label, done, total


@dataclass(frozen=True)
class Settings:
    """How bounds are widened, and how rare violations have to be."""

    margin: float | Literal["gpd"] = "gpd"  # share of the half width, or by a generalised Pareto tail
    tail: float = 1e-7  # chance of a step beyond a bound that the tail gives, on each side
    rate: float = 0.05  # highest share of clean episodes, or of steps, that may leave an invariant
    unit: Literal["episode", "step"] = "episode"  # of the share; steps count as independent, and for each invariant by itself
    positions: bool = False  # places on the road have bounds as well

    def __post_init__(self) -> None:
        if self.margin != "gpd" and not (isinstance(self.margin, (int, float)) and 0.0 <= self.margin <= 100.0):
            raise InputError("margin", self.margin, "gpd, or a share of the half width from 0 to 100")
        for name, value in (("tail", self.tail), ("rate", self.rate)):
            if not (isinstance(value, float) and 1e-12 <= value <= 0.1):
                raise InputError(name, value, "a probability from 1e-12 to 0.1")
        if self.unit not in ("episode", "step"):
            raise InputError("unit", self.unit, "episode or step")

    def chance(self, judged: int) -> float:
        """Return the chance of missing the limit of one of `judged` invariants."""
        return (1.0 - LEVEL) / (judged if self.unit == "episode" else 1)

    def fewest(self, judged: int = 1) -> int:
        """Return the fewest episodes or steps that can show the rate of one of `judged` invariants: without a violation among them."""
        return math.ceil(math.log(self.chance(judged)) / math.log1p(-self.rate))


class Samples(NamedTuple):
    """Steps of clean runs: columns (S, D) as `names_of` has them, arrived (S, D) bool, negative (S,) bool: u below 0, episode (S,) int."""

    columns: Array
    arrived: Array
    negative: Array
    episode: Array


class Signals(NamedTuple):
    """The names of an envelope's signals, and what a model has to share with it."""

    sensors: tuple[str, ...]
    v2v: tuple[str, ...]
    inputs: int
    dt: float
    units: tuple[str, ...] = ()  # of each signal; empty: all have one
    places: tuple[bool, ...] = ()  # which signals are places on the road; empty: none

    @classmethod
    def of(cls, model: Model) -> Signals:
        """Return the signals of a model. What no name tells of a sensor, the states tell that it reads."""
        names, units = (*model.sensors, *model.v2v), [unit_of(name) for name in (*model.sensors, *model.v2v)]
        places, apart = ["position" in name for name in names], any("position" in name for name in model.v2v)
        assert model.gap is not None and model.speed is not None
        gap, speed = ((rows != 0.0).any(axis=0) for rows in (model.gap, model.speed))
        for i, unit in enumerate(units[: len(model.sensors)]):
            read = (model.C[:, i] != 0.0).any(axis=0)
            for known, name in ((speed, "m/s"), (gap, "m")):
                if unit == "1" and read.any() and not (read & ~known).any():
                    units[i], places[i] = name, apart and name == "m"  # a gap to a place that is sent is no state
        return cls(tuple(model.sensors), tuple(model.v2v), model.inputs, model.dt, tuple(units), tuple(places))

    @property
    def both(self) -> tuple[str, ...]:
        return self.sensors + self.v2v

    @property
    def names(self) -> tuple[str, ...]:
        return names_of(self.both, self.inputs)


def sampled(z: Array, arrived: Array, u: Array, begins: Array, episode: Array) -> Samples:
    """Return samples of steps in their order: z (S, s), arrived (S, s) bool, u (S, m); begins (S,) bool: no step before; episode (S,)."""
    first = begins[:, None]
    z = np.where(arrived, z, 0.0)
    last, before = np.roll(z, 1, axis=0), np.roll(arrived, 1, axis=0) & ~first
    columns = np.concatenate([z, np.where(before, last, 0.0), u], axis=1)
    negative = u[:, 0] < 0.0 if u.shape[1] else np.zeros(len(u), bool)
    return Samples(columns, np.concatenate([arrived, before, np.ones(u.shape, bool)], axis=1), negative, episode)


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several runs, whose episodes are others."""
    ends = np.cumsum([0] + [1 + int(part.episode.max(initial=-1)) for part in parts])
    apart = [part._replace(episode=part.episode + end) for part, end in zip(parts, ends, strict=False)]
    return Samples(*(np.concatenate(columns) for columns in zip(*apart, strict=True)))


# -- templates


def templates(has: Signals, samples: Samples, positions: bool = False) -> Iterator[tuple[Kind, Array]]:
    """Yield kind and weights (D,) of candidates. Linear relations are fitted to the steps in which every signal arrived.

    Without `positions` the weights of places on the road add up to 0.
    """
    names, signals, columns, arrived = has.names, len(has.both), samples.columns, samples.arrived
    free = [i for i in range(signals) if has.places and has.places[i] and not positions]
    unit = np.eye(len(names))
    spans = [np.ptp(columns[arrived[:, i], i]) if arrived[:, i].any() else 0.0 for i in range(signals)]
    for i in range(signals):
        if i not in free:
            yield "reading", unit[i]
        yield "change", unit[i] - unit[signals + i]
    for i, j in itertools.combinations(range(signals), 2):
        some = arrived[:, i] & arrived[:, j]
        if has.units and (has.units[i] != has.units[j] or has.units[i] == "1"):
            continue
        if some.any() and np.ptp(columns[some, i] - columns[some, j]) < NARROW * min(spans[i], spans[j]):
            yield "difference", unit[i] - unit[j]
    whole = columns[arrived.all(axis=1)]
    moved = free + [signals + i for i in free]
    if free:  # from the first of them; it rests then, and has no weight until the others' is taken from it
        whole = whole.copy()
        whole[:, moved] -= whole[:, free[:1]]
    if len(whole) <= 10 * len(names):
        return
    mean, spread = whole.mean(axis=0), whole.std(axis=0)
    moving = np.flatnonzero(spread > 1e-12 * (1.0 + np.abs(mean)))
    scaled = (whole[:, moving] - mean[moving]) / spread[moving]
    for place, i in enumerate(moving.tolist()):
        if i < signals and len(moving) > 1:
            fit = np.linalg.lstsq(np.delete(scaled, place, axis=1), scaled[:, place], rcond=None)[0]
            yield "regression", _spread_out(np.insert(-fit, place, 1.0) * spread[i], moving, spread, len(names), moved)
    variances, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    for variance, direction in zip(variances, directions.T, strict=True):
        if variance < SMALL:
            yield "component", _spread_out(direction, moving, spread, len(names), moved)


def _spread_out(terms: Array, moving: Array, spread: Array, width: int, moved: Sequence[int]) -> Array:
    """Return weights (width,) from those of standardised columns, without terms that are nothing but rounding.

    moved: columns less the first of them.
    """
    terms = np.where(np.abs(terms) > NOTHING * np.abs(terms).max(), terms, 0.0)
    out = np.zeros(width)
    out[moving] = terms / spread[moving]
    if len(moved):
        out[moved[0]] = -sum(float(out[i]) for i in moved[1:])
    return out


# -- bounds


def upper(values: Array, settings: Settings) -> float:
    """Return a bound that values (S,) stay below: their largest, widened by the tail of a generalised Pareto distribution."""
    top = float(values.max())
    count = min(TAIL_POINTS, len(values) // 10)
    if count < 20:
        return top
    highest = np.partition(values, len(values) - count - 1)[len(values) - count - 1 :]
    start = float(highest.min())
    excess = np.sort(highest)[1:] - start
    if excess[-1] <= 1e-12 * max(abs(top), abs(start)):  # constant
        return top
    from scipy import stats  # its import takes half a second

    shape, _, scale = stats.genpareto.fit(excess / excess[-1], floc=0.0)
    beyond = float(stats.genpareto.isf(min(1.0, settings.tail * len(values) / count), shape, scale=scale)) * float(excess[-1])
    return max(top, start + beyond) if math.isfinite(beyond) else top


def bounds_of(values: Array, settings: Settings) -> tuple[float, float]:
    """Return the bounds of values (S,), with their margin."""
    low, high = float(values.min()), float(values.max())
    if settings.margin != "gpd":
        wider = settings.margin * 0.5 * (high - low)
        return low - wider, high + wider
    ends = [-upper(-values, settings), upper(values, settings)]
    wider = REST * 0.5 * (ends[1] - ends[0])
    for i, (extreme, sign) in enumerate(((low, -1.0), (high, 1.0))):
        if ends[i] == extreme and np.count_nonzero(values == extreme) > TIES:
            ends[i] += sign * wider
    return ends[0], ends[1]


def learn(signals: Signals, train: Samples, held_out: Samples, settings: Settings, progress: Progress | None = None) -> list[Invariant]:
    """Return the invariants that training steps have and other steps keep. Raise InputError where there is none.

    Every value of the training steps lies within the bounds.
    """
    candidates: list[tuple[Kind, Array]] = list(templates(signals, train, settings.positions))
    out: list[Invariant] = []
    judged = len(candidates) * (3 if signals.inputs else 1)  # with bounds for each sign of the input
    fewest, unit = settings.fewest(judged), settings.unit
    if (count := len(np.unique(held_out.episode)) if unit == "episode" else len(held_out.columns)) < fewest:
        wanted = f"at least {fewest} held-out {unit}s, to show a rate below {settings.rate:g}"
        raise InputError("held_out", f"{count} {unit}s", wanted)
    for done, (kind, weights) in enumerate(candidates, 1):
        bounds: dict[Sign, tuple[float, float]] = {}
        rates: dict[Sign, float] = {}
        used = np.flatnonzero(weights)
        (g, below, _, size), (fresh, fresh_below, episode, _) = (_values(samples, weights, used) for samples in (train, held_out))
        choices: list[tuple[Sign, Array, Array]] = [("any", np.full(len(g), True), np.full(len(fresh), True))]
        choices += [("negative", below, fresh_below), ("positive", ~below, ~fresh_below)] if signals.inputs else []
        for sign, here, there in choices:
            seen, other = g[here], fresh[there]
            count = len(np.unique(episode[there])) if unit == "episode" else len(other)
            if len(seen) < 10 * len(weights) or count < fewest:
                continue
            low, high = bounds_of(seen, settings)
            slack = 1e-12 * size
            outside = (other < low - slack) | (other > high + slack)
            left = len(np.unique(episode[there][outside])) if unit == "episode" else np.count_nonzero(outside)
            rate = float(limits(np.array(left), np.array(count), settings.chance(judged))[1])
            widest = bounds.get("any")
            if rate < settings.rate and (widest is None or high - low < TIGHTER * (widest[1] - widest[0])):
                bounds[sign], rates[sign] = (low, high), float(f"{rate:.4g}")
        if bounds:
            held = {signals.names[i]: float(weights[i]) for i in used}
            out.append(Invariant(kind=kind, weights=held, size=size, bounds=bounds, rates=rates))
        if progress is not None:
            progress("learning", done, len(candidates))
    if not out:
        raise InputError("held_out", f"none of {len(candidates)} invariants", f"one left in fewer than {settings.rate:g} of {unit}s")
    return out


def _values(samples: Samples, weights: Array, used: Array) -> tuple[Array, Array, Array, float]:
    """Return g, the sign of u and the episode where all signals arrived, and the size of the largest term."""
    some = samples.arrived[:, used].all(axis=1)
    terms = samples.columns[np.ix_(some, used)] * weights[used]
    g = np.zeros(len(terms))
    for column in terms.T:  # in the order of the defence's sums
        g += column
    return g, samples.negative[some], samples.episode[some], float(np.abs(terms).max(initial=0.0))


def sheet_of(
    signals: Signals, train: Samples, held_out: Samples, settings: Settings, made: dict[str, Any], progress: Progress | None
) -> Sheet:
    """Return the file's content; `made` says where the steps come from."""
    import scipy

    invariants = learn(signals, train, held_out, settings, progress)
    made |= {
        "margin": settings.margin, "tail": settings.tail, "rate": settings.rate, "level": LEVEL, "unit": settings.unit,
        "positions": settings.positions, "tailgate": VERSION,
        "numpy": np.__version__, "scipy": scipy.__version__,
    }  # fmt: skip
    return sealed(sensors=signals.sensors, v2v=signals.v2v, inputs=signals.inputs, dt=signals.dt, made=made, invariants=tuple(invariants))


def write_envelope(sheet: Sheet, out: Path) -> None:
    """Write an envelope in one step."""
    if out.suffix != ".json":
        raise InputError("out", str(out), "a path that ends with .json")
    write_atomic(out, sheet.model_dump_json(indent=1).encode() + b"\n")
