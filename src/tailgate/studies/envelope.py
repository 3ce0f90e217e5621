"""Learning a safety envelope from clean runs (tailgate.estimators.safe_set.envelope; docs/detectors.md#the-learned-envelope).

Templates of invariants, each a weighted sum g of signals:

    reading      y_i                                    component    a principal component with little of the variance
    change       y_i - y_i of the step before           regression   y_i less its least-squares fit by all other signals
    difference   y_i - y_j, where narrower than both

The training steps give the bounds of g: their extremes, widened by a margin. An invariant is kept if other clean steps leave its bounds
rarely enough, by the one-sided Clopper-Pearson limit. Bounds for one sign of the known input are kept where they are tighter.

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
    rate: float = 1e-4  # highest rate of violations that an invariant may have

    def __post_init__(self) -> None:
        if self.margin != "gpd" and not (isinstance(self.margin, (int, float)) and 0.0 <= self.margin <= 100.0):
            raise InputError("margin", self.margin, "gpd, or a share of the half width from 0 to 100")
        for name, value in (("tail", self.tail), ("rate", self.rate)):
            if not (isinstance(value, float) and 1e-12 <= value <= 0.1):
                raise InputError(name, value, "a probability from 1e-12 to 0.1")

    @property
    def fewest(self) -> int:
        """The fewest steps that can show the rate: without a violation among them."""
        return math.ceil(math.log(1.0 - LEVEL) / math.log1p(-self.rate))


class Samples(NamedTuple):
    """Steps of clean runs: columns (S, D) as `names_of` has them, arrived (S, D) bool, negative (S,) bool: u below 0."""

    columns: Array
    arrived: Array
    negative: Array


class Signals(NamedTuple):
    """The names of an envelope's signals, and what a model has to share with it."""

    sensors: tuple[str, ...]
    v2v: tuple[str, ...]
    inputs: int
    dt: float

    @classmethod
    def of(cls, model: Model) -> Signals:
        return cls(tuple(model.sensors), tuple(model.v2v), model.inputs, model.dt)

    @property
    def both(self) -> tuple[str, ...]:
        return self.sensors + self.v2v

    @property
    def names(self) -> tuple[str, ...]:
        return names_of(self.both, self.inputs)


def sampled(z: Array, arrived: Array, u: Array, begins: Array) -> Samples:
    """Return samples of steps in their order: z (S, s), arrived (S, s) bool, u (S, m); begins (S,) bool: no step before."""
    first = begins[:, None]
    z = np.where(arrived, z, 0.0)
    last, before = np.roll(z, 1, axis=0), np.roll(arrived, 1, axis=0) & ~first
    columns = np.concatenate([z, np.where(before, last, 0.0), u], axis=1)
    negative = u[:, 0] < 0.0 if u.shape[1] else np.zeros(len(u), bool)
    return Samples(columns, np.concatenate([arrived, before, np.ones(u.shape, bool)], axis=1), negative)


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several runs."""
    return Samples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


# -- templates


def templates(names: Sequence[str], signals: int, samples: Samples) -> Iterator[tuple[Kind, Array]]:
    """Yield kind and weights (D,) of candidates. Linear relations are fitted to the steps in which every signal arrived."""
    columns, arrived = samples.columns, samples.arrived
    unit = np.eye(len(names))
    spans = [np.ptp(columns[arrived[:, i], i]) if arrived[:, i].any() else 0.0 for i in range(signals)]
    for i in range(signals):
        yield "reading", unit[i]
        yield "change", unit[i] - unit[signals + i]
    for i, j in itertools.combinations(range(signals), 2):
        some = arrived[:, i] & arrived[:, j]
        if some.any() and np.ptp(columns[some, i] - columns[some, j]) < NARROW * min(spans[i], spans[j]):
            yield "difference", unit[i] - unit[j]
    whole = columns[arrived.all(axis=1)]
    if len(whole) <= 10 * len(names):
        return
    mean, spread = whole.mean(axis=0), whole.std(axis=0)
    moving = np.flatnonzero(spread > 1e-12 * (1.0 + np.abs(mean)))
    scaled = (whole[:, moving] - mean[moving]) / spread[moving]
    for place, i in enumerate(moving.tolist()):
        if i < signals and len(moving) > 1:
            fit = np.linalg.lstsq(np.delete(scaled, place, axis=1), scaled[:, place], rcond=None)[0]
            yield "regression", _spread_out(np.insert(-fit, place, 1.0) * spread[i], moving, spread, len(names))
    variances, directions = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    for variance, direction in zip(variances, directions.T, strict=True):
        if variance < SMALL:
            yield "component", _spread_out(direction, moving, spread, len(names))


def _spread_out(terms: Array, moving: Array, spread: Array, width: int) -> Array:
    """Return weights (width,) from those of standardised columns, without terms that are nothing but rounding."""
    terms = np.where(np.abs(terms) > NOTHING * np.abs(terms).max(), terms, 0.0)
    out = np.zeros(width)
    out[moving] = terms / spread[moving]
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
    if len(held_out.columns) < settings.fewest:
        wanted = f"at least {settings.fewest} held-out steps, to show a rate below {settings.rate:g}"
        raise InputError("held_out", f"{len(held_out.columns)} steps", wanted)
    candidates, out = list(templates(signals.names, len(signals.both), train)), []
    for done, (kind, weights) in enumerate(candidates, 1):
        bounds: dict[Sign, tuple[float, float]] = {}
        rates: dict[Sign, float] = {}
        used = np.flatnonzero(weights)
        (g, below, size), (fresh, fresh_below, _) = (_values(samples, weights, used) for samples in (train, held_out))
        choices: list[tuple[Sign, Array, Array]] = [("any", g, fresh)]
        choices += [("negative", g[below], fresh[fresh_below]), ("positive", g[~below], fresh[~fresh_below])]
        for sign, seen, other in choices:
            if len(seen) < 10 * len(weights) or len(other) < settings.fewest:
                continue
            low, high = bounds_of(seen, settings)
            slack = 1e-12 * size
            outside = np.array(np.count_nonzero((other < low - slack) | (other > high + slack)))
            rate = float(limits(outside, np.array(len(other)), 1.0 - LEVEL)[1])
            widest = bounds.get("any")
            if rate < settings.rate and (widest is None or high - low < TIGHTER * (widest[1] - widest[0])):
                bounds[sign], rates[sign] = (low, high), float(f"{rate:.4g}")
        if bounds:
            held = {signals.names[i]: float(weights[i]) for i in used}
            out.append(Invariant(kind=kind, weights=held, size=size, bounds=bounds, rates=rates))
        if progress is not None:
            progress("learning", done, len(candidates))
    if not out:
        raise InputError("held_out", f"none of {len(candidates)} invariants", f"one that is left in fewer than {settings.rate:g} of steps")
    return out


def _values(samples: Samples, weights: Array, used: Array) -> tuple[Array, Array, float]:
    """Return g and the sign of u where all signals arrived, and the size of the largest term."""
    some = samples.arrived[:, used].all(axis=1)
    terms = samples.columns[np.ix_(some, used)] * weights[used]
    g = np.zeros(len(terms))
    for column in terms.T:  # in the order of the defence's sums
        g += column
    return g, samples.negative[some], float(np.abs(terms).max(initial=0.0))


def sheet_of(
    signals: Signals, train: Samples, held_out: Samples, settings: Settings, made: dict[str, Any], progress: Progress | None
) -> Sheet:
    """Return the file's content; `made` says where the steps come from."""
    import scipy

    invariants = learn(signals, train, held_out, settings, progress)
    made |= {
        "margin": settings.margin, "tail": settings.tail, "rate": settings.rate, "level": LEVEL, "tailgate": VERSION,
        "numpy": np.__version__, "scipy": scipy.__version__,
    }  # fmt: skip
    return sealed(sensors=signals.sensors, v2v=signals.v2v, inputs=signals.inputs, dt=signals.dt, made=made, invariants=tuple(invariants))


def write_envelope(sheet: Sheet, out: Path) -> None:
    """Write an envelope in one step."""
    if out.suffix != ".json":
        raise InputError("out", str(out), "a path that ends with .json")
    write_atomic(out, sheet.model_dump_json(indent=1).encode() + b"\n")
