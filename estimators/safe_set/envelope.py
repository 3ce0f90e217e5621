"""The safety envelope of learned invariants: bounds that clean runs never left (docs/detectors.md#the-learned-envelope).

An invariant bounds a weighted sum g of one agent's signals. These are its readings y and messages m in this step and the step before, and
the known input u. The bounds depend on the sign of u where the clean runs gave tighter ones for it.

    g = a' [y, m, y-, m-, u]        s = max |g - middle| / half width, over the invariants whose signals all arrived

A step with s above the margin is a violation. Its readings are refused, and those of steps with an alarm. One violation may be noise. The
alarm goes on once `count` of the last `window` steps are violations.
The score is the `count`-th largest s of these steps, so that the alarm is: score > margin.

`tailgate learn-envelope` makes the file (tailgate.studies.envelope).
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.core import Array, Innovation, Model, Positive, PositiveCount, Prior, Received, param
from tailgate.core.quantities import Finite, NonNegative, Probability, Step
from tailgate.core.registry import register
from tailgate.core.schema import read_model
from tailgate.estimators.compose import Composed, ComposedPlan, ComposedState, Score, part_from
from tailgate.estimators.parts import Detector, Filter, Mitigation, Verdict

MADE_BY = "tailgate learn-envelope"
FOLDER = Path(str(files("tailgate.configs").joinpath("envelopes")))
LAST = "last "  # before the name of a signal: its value in the step before
ROUNDING = 1e-9  # of the size of an invariant's terms: no violation
MOST = 2000  # invariants of a file
LONGEST = 1000  # steps of the window

Sign = Literal["any", "negative", "positive"]  # of the first known input; positive: not below 0
Kind = Literal["reading", "change", "difference", "regression", "component"]
Pair = Annotated[tuple[Finite, Finite], Field(min_length=2, max_length=2)]


class Invariant(BaseModel):
    """One weighted sum of signals with its bounds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Kind
    weights: Annotated[dict[str, Finite], Field(min_length=1, max_length=1000)]  # by signal, see `names_of`
    size: NonNegative  # the largest |weight x signal| of the clean runs
    bounds: Annotated[dict[Sign, Pair], Field(min_length=1)]
    rates: dict[Sign, Probability]  # limit of the share of other clean episodes, or of steps (see `made`), that leave the bounds


class Sheet(BaseModel):
    """The file of an envelope."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["tailgate-envelope-1"]
    sha256: str  # of everything else
    sensors: tuple[str, ...]
    v2v: tuple[str, ...]
    inputs: Annotated[int, Field(ge=0, le=1000)]
    dt: Step
    made: dict[str, Any]  # scenarios, seeds, samples, settings, versions
    invariants: Annotated[tuple[Invariant, ...], Field(min_length=1, max_length=MOST)]

    @property
    def digest(self) -> str:
        """The SHA-256 that the file should have."""
        data = self.model_dump(mode="json", exclude={"sha256"})
        return hashlib.sha256(json.dumps(data, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def sealed(**fields: Any) -> Sheet:
    """Return a sheet of these fields with its digest."""
    sheet = Sheet(format="tailgate-envelope-1", sha256="", **fields)
    return sheet.model_copy(update={"sha256": sheet.digest})


def names_of(signals: tuple[str, ...], inputs: int) -> tuple[str, ...]:
    """Return the names of the columns [z, z-, u]: signals z, the same in the step before, known inputs."""
    return (*signals, *(LAST + name for name in signals), *(f"input {i}" for i in range(inputs)))


def envelope_path(text: Path) -> Path:
    """Return the file of an envelope: a path to a JSON file, or the name of one that comes with the package."""
    if text.suffix == ".json":
        return text
    known = sorted(path.stem for path in FOLDER.glob("*.json"))
    if str(text) not in known:
        raise unknown("envelope.path", str(text), [*known, "a path that ends with .json"])
    return FOLDER / f"{text}.json"


def load_envelope(path: Path) -> Sheet:
    """Return an envelope from its file. Raise InputError where the file is missing, damaged or inconsistent. It executes nothing."""
    sheet = read_model(Sheet, path, "envelope", MADE_BY)
    where, known = f"envelope {path.name}", names_of((*sheet.sensors, *sheet.v2v), sheet.inputs)
    if sheet.sha256 != sheet.digest:
        raise InputError(f"{where}: sha256", sheet.sha256, "the digest of its content: the file is damaged, or was changed by hand")
    for i, one in enumerate(sheet.invariants):
        if strange := sorted(set(one.weights) - set(known)):
            raise InputError(f"{where}: invariants.{i}.weights", strange[0], f"one of {', '.join(known)}")
        if crossed := [sign for sign, (low, high) in one.bounds.items() if low > high]:
            raise InputError(f"{where}: invariants.{i}.bounds.{crossed[0]}", one.bounds[crossed[0]], "two numbers, the smaller first")
    return sheet


@lru_cache(maxsize=32)
def _loaded(path: Path, changed: int, size: int) -> Sheet:
    """Return an envelope, read once for each state of its file; outside of the defence, whose attributes are a key of compiled code."""
    return load_envelope(path)


class EnvelopePlan(NamedTuple):
    """Constants of J invariants over D columns; the first row of the bounds holds for u < 0, the second for the rest."""

    weights: Array  # (1, J, D)
    needed: Array  # (1, J, D) 1.0 where a column has a weight
    middle: Array  # (2, J)
    half: Array  # (2, J) inf where nothing is known
    agents: int
    signals: int


class EnvelopeMemory(NamedTuple):
    """Every leaf has B first."""

    last: Array  # (B, N, S) signals of the step before
    arrived: Array  # (B, N, S) bool
    recent: Array  # (B, N, window - 1) s of the steps before, the newest first


def plan_of(sheet: Sheet, agents: int) -> EnvelopePlan:
    """Return the constants of a sheet."""
    names = names_of((*sheet.sensors, *sheet.v2v), sheet.inputs)
    weights, ends = np.zeros((len(sheet.invariants), len(names))), np.full((2, 2, len(sheet.invariants)), np.inf)
    ends[:, 0] = -np.inf
    for j, one in enumerate(sheet.invariants):
        for name, weight in one.weights.items():
            weights[j, names.index(name)] = weight
        for row, sign in enumerate(("negative", "positive")):
            ends[row, :, j] = one.bounds.get(sign, one.bounds.get("any", (-np.inf, np.inf)))  # type: ignore[call-overload]
    some = np.isfinite(ends[:, 0])
    low, high = np.where(some, ends[:, 0], 0.0), np.where(some, ends[:, 1], 0.0)
    slack = ROUNDING * (1.0 + np.array([one.size for one in sheet.invariants]))
    half = np.where(some, 0.5 * (high - low) + slack, np.inf)
    needed = (weights != 0.0).astype(np.float64)
    return EnvelopePlan(weights[None], needed[None], 0.5 * (low + high), half, agents, len(sheet.sensors) + len(sheet.v2v))


def nth_largest(values: list[Array], n: int) -> Array:
    """Return the n-th largest of some arrays, elementwise."""
    left = list(values)
    for _ in range(n - 1):
        top, rest = left[0], []
        for value in left[1:]:
            rest.append(np.minimum(top, value))
            top = np.maximum(top, value)
        left = rest
    top = left[0]
    for value in left[1:]:
        top = np.maximum(top, value)
    return top


@register(
    "defence", "envelope", uses=("measurements", "v2v"),
    reference="Tiwari, Dutertre, Jovanovic, de Candia, Lincoln, Rushby, Sadigh, Seshia, Safety envelope for security, 2014",
)  # fmt: skip
@dataclass(frozen=True)
class Envelope(Composed):
    """Filter whose readings are refused while they leave bounds that were learned from clean runs; alarms where that lasts."""

    threshold_field: ClassVar[str] = "margin"
    path: Path = param(Path("car-following"), "JSON file of `tailgate learn-envelope`, or the name of one in the package")
    window: PositiveCount = param(5, "steps n that the alarm looks back on [steps]")
    count: PositiveCount = param(3, "violations m of these n that make an alarm: fewer are noise [steps]")
    margin: Positive = param(1.0, "distance of a violation from the middle of the learned bounds, in half widths [-]")
    filter: object = param("kf", "filter: a name, or a mapping with name and parameters")
    mitigation: object = param("gate_out", "mitigation: a name, or a mapping with name and parameters")

    def __post_init__(self) -> None:
        if self.window > LONGEST:
            raise InputError("defence envelope.window", self.window, f"at most {LONGEST} steps")
        if self.count > self.window:
            raise InputError("defence envelope.count", self.count, f"at most the window, {self.window}")
        _ = self.parts(), self.sheet  # a wrong name or a damaged file shall fail here

    @property
    def sheet(self) -> Sheet:
        """The learned invariants."""
        path = envelope_path(self.path)
        try:
            held = path.stat()
        except OSError:
            return load_envelope(path)  # which says what is wrong
        return _loaded(path, held.st_mtime_ns, held.st_size)

    @property
    def sources(self) -> list[Path]:
        """The files whose digest a row records."""
        return [envelope_path(self.path)]

    def parts(self) -> tuple[Filter, Detector, Mitigation]:
        f = part_from("filter", self.filter, "kf", "defence envelope.filter")
        m = part_from("mitigation", self.mitigation, "gate_out", "defence envelope.mitigation")
        return f, Score(), m

    def prepare(self, model: Model) -> ComposedPlan:
        sheet, where = self.sheet, f"defence envelope {self.path.name}"
        for field, learned, here in (
            ("sensors", sheet.sensors, model.sensors), ("messages", sheet.v2v, model.v2v), ("inputs", sheet.inputs, model.inputs),
            ("dt", sheet.dt, model.dt),
        ):  # fmt: skip
            if learned != here:
                shown = list(learned) if isinstance(learned, tuple) else learned
                raise NotApplicable(f"{where}: {field}", list(here) if isinstance(here, tuple) else here, f"{shown}, as it was learned")
        return super().prepare(model)._replace(detector_plan=plan_of(sheet, model.agents))

    def start(self, plan: ComposedPlan, prior: Prior) -> ComposedState:
        limits: EnvelopePlan = plan.detector_plan
        shape = (len(prior.mean), limits.agents)
        last = num.zeros((*shape, limits.signals))
        memory = EnvelopeMemory(last, num.full(last.shape, False, bool), num.zeros((*shape, self.window - 1)))
        begun = plan._replace(detector_plan=None)
        return super().start(begun, prior)._replace(detector=memory)

    def judge(
        self, plan: ComposedPlan, state: ComposedState, innovation: Innovation, received: Received, known_u: Array
    ) -> tuple[EnvelopeMemory, Verdict]:
        memory: EnvelopeMemory = state.detector
        now, arrived = signals_of(received, memory.last.shape[-1])
        worst = np.max(ratios(plan.detector_plan, memory, now, arrived, known_u), axis=-1)
        score = nth_largest([worst, *(memory.recent[..., i] for i in range(self.window - 1))], self.count)
        recent = memory.recent
        if self.window > 1:
            recent = num.full(memory.recent.shape, worst[..., None])
            recent[..., 1:] = memory.recent[..., :-1]
        alarm = score > self.margin
        suspect = np.broadcast_to((alarm | (worst > self.margin))[..., None], received.y.shape)
        return EnvelopeMemory(now, arrived, recent), Verdict(score, alarm, suspect)


def signals_of(received: Received, signals: int) -> tuple[Array, Array]:
    """Return the signals (B, N, S), 0 where nothing arrived, and (B, N, S) bool: what arrived. Messages do, where they are heard."""
    y, valid, v2v = received.y, received.valid, received.v2v
    heard = v2v is not None
    if v2v is None:
        v2v = num.zeros((*y.shape[:2], signals - y.shape[-1]))
    arrived = np.concatenate([valid, np.full_like(v2v, heard, bool)], axis=-1)
    return np.where(arrived, np.concatenate([y, v2v], axis=-1), 0.0), arrived


def ratios(plan: EnvelopePlan, memory: EnvelopeMemory, now: Array, arrived: Array, known_u: Array) -> Array:
    """Return how far each invariant is from the middle of its bounds, in half widths (B, N, J); 0 where a signal is missing."""
    g = num.apply(plan.weights, np.concatenate([now, memory.last, known_u], axis=-1))
    (least, middle), (tight, half) = plan.middle, plan.half
    if known_u.shape[-1]:
        below = known_u[..., :1] < 0.0
        middle, half = np.where(below, least, middle), np.where(below, tight, half)
    off = np.abs(g - middle) / half
    gone = np.concatenate([~arrived, ~memory.arrived, np.full_like(known_u, False, bool)], axis=-1)
    if num.some(gone):
        off = np.where(num.apply(plan.needed, gone.astype(np.float64)) > 0.0, 0.0, off)
    return np.asarray(off)
