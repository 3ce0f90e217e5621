"""An episode played again from its row: which row, what may be played, and whether the trace is the same.

Rows may come from strangers. A row's scenario and policy are read as data, never executed.
A row whose component is code to import is played only if the user names that component too.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.pytree import duplicate
from tailgate.base.reading import YAML_ENDS
from tailgate.base.version import VERSION
from tailgate.core import Array, Attack, Frame, draws
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import Loop, LoopState
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, list_scenarios, load_scenario
from tailgate.core.schema import build
from tailgate.core.spec_text import split_text
from tailgate.core.threat import ThreatModel
from tailgate.evaluation.cells import ENGINE
from tailgate.play.metrics import measure
from tailgate.play.trace import Recorder, Trace, signals_of

Row = dict[str, Any]
Verdict = Literal["same", "figures", "decisions", "different", "unknown"]


@dataclass(frozen=True)
class Filter:
    """The rows that a user means; None means any. The user also allows imports of the components named here."""

    line: int | None = None
    scenario: str | None = None
    defence: str | None = None
    attack: str | None = None
    dose: int | Literal["none"] | None = None
    seed: int | None = None

    def fits(self, row: Row) -> bool:
        return (
            self._scenario_fits(row) and self.defence in (None, row["defence"]) and self._attack_fits(row)
            and (self.dose is None or row["dose"] == (None if self.dose == "none" else self.dose)) and self.seed in (None, row["seed"])
        )  # fmt: skip

    def _scenario_fits(self, row: Row) -> bool:
        if self.scenario in (None, row["scenario"], row.get("scenario_file")):
            return True
        return str(self.scenario).endswith(YAML_ENDS) and _name_of(str(self.scenario)) == row["scenario"]

    def _attack_fits(self, row: Row) -> bool:
        """Return True for the same text, or for a file elsewhere with the same content and parameters."""
        if self.attack in (None, row["attack"]):
            return True
        (head, params), (held, own) = split_text(str(self.attack)), split_text(row["attack"])
        is_file = Path(head).suffix == Path(held).suffix and Path(head).is_file() and params == own
        return is_file and bool(row["attack_digest"]) and _digest_of(str(self.attack)) == row["attack_digest"]

    def __str__(self) -> str:
        named = {name: value for name, value in dataclasses.asdict(self).items() if value is not None}
        return ", ".join(f"{name} {value}" for name, value in named.items()) or "any"


@cache
def _name_of(scenario: str) -> str:
    return load_scenario(scenario).name


@cache
def _digest_of(attack: str) -> str:
    return Spec("attack", attack).digest


@dataclass(frozen=True)
class Chosen:
    """A row, its line in the file (from 1), how many rows matched, and the reason for this choice."""

    row: Row
    line: int
    matched: int
    why: str


def choose(rows: Sequence[Row], wanted: Filter) -> Chosen:
    """Return the row to play: the requested line, or the matching row with the worst outcome.

    A crash is worst, then the smallest gap, then the largest error.
    """
    if not rows:
        raise InputError("rows", "an empty file", "at least one row")
    if wanted.line is not None:
        if not 1 <= wanted.line <= len(rows):
            raise InputError("--line", wanted.line, f"a line from 1 to {len(rows)}")
        row = rows[wanted.line - 1]
        if not wanted.fits(row):
            shown = f"{row['scenario']}, {row['defence']}, {row['attack']}, dose {row['dose']}, seed {row['seed']}"
            raise InputError(f"line {wanted.line}", shown, f"a row that matches the filters ({wanted})")
        return Chosen(row, wanted.line, 1, "the requested line")
    matching = [(i, row) for i, row in enumerate(rows, start=1) if wanted.fits(row)]
    if not matching:
        keys = ("scenario", "defence", "attack", "dose")
        there = "; ".join(f"{key}: {', '.join(_some({str(row[key]) for row in rows}))}" for key in keys)
        raise InputError("rows", str(wanted), f"filters that a row matches ({there})")
    played = [(i, row) for i, row in matching if row["status"] == "ok"]
    if not played:
        line, row = matching[0]
        raise InputError(f"line {line}", f"{row['status']}: {row['reason']}", "a row that was played; no matching row was")

    def outcome(item: tuple[int, Row]) -> tuple[float, float, float]:
        gap = item[1]["min_gap"]
        return -item[1]["crashed"], np.inf if gap is None else gap, -(item[1]["max_error"] or 0.0)

    line, row = min(played, key=outcome)
    return Chosen(row, line, len(matching), "the only one" if len(matching) == 1 else "the worst outcome")


def _some(names: set[str], most: int = 8) -> list[str]:
    shown = sorted(names)
    return shown if len(shown) <= most else [*shown[:most], f"and {len(shown) - most} more"]


@dataclass(frozen=True)
class Check:
    """A field that the row records, and its value here."""

    name: str
    row: str
    here: str

    @property
    def same(self) -> bool:
        return self.row == self.here


@dataclass(frozen=True, eq=False)
class Replay:
    """An episode that was played again. `gate` (K, N) is the defence's gate at each step, NaN without one."""

    row: Row
    place: Scenario
    loop: Loop
    attack: Attack
    trace: Trace
    gate: Array
    metrics: dict[str, float | None]
    checks: tuple[Check, ...]

    @property
    def verdict(self) -> Verdict:
        """Return whether the trace is the same, its metrics are not, only its decisions are, it differs, or the row records no hash."""
        by_name = {check.name: check for check in self.checks}
        trace, decisions = by_name["trace_hash"], by_name["decision_hash"]
        if trace.same:
            return "figures" if self._figures else "same"
        if not trace.row and not decisions.row:
            return "unknown"
        return "decisions" if decisions.same else "different"

    @property
    def differences(self) -> list[Check]:
        """Return fields and metrics that differ from the row, except the hashes of the trace."""
        return [*(check for check in self.checks[2:] if not check.same), *self._figures]

    @property
    def _figures(self) -> list[Check]:
        """Return the metrics that differ from the row."""
        figures = (Check(name, _figure(self.row[name]), _figure(value)) for name, value in self.metrics.items())
        return [check for check in figures if not check.same]

    @property
    def keys(self) -> Keys:
        return draws.keys(self.row["purpose"], [self.row["seed"]])


def _figure(value: float | None) -> str:
    return "none" if value is None else repr(float(value))


def play(row: Row, allowed: Filter | None = None) -> Replay:
    """Play a row's episode. `allowed` holds the components and the scenario file that the user named.

    Raises InputError for a row that was not played, names code that the user did not, or needs missing files.
    """
    allowed = allowed or Filter()
    if row["status"] != "ok":
        raise InputError("row", f"{row['status']}: {row['reason']}", "a row that was played (status ok)")
    if not allowed.fits(row):
        raise InputError("row", f"{row['scenario']}, {row['defence']}, {row['attack']}", f"a row that matches {allowed}")
    defence_spec, attack_spec = _component("defence", row, allowed.defence), _component("attack", row, allowed.attack)
    place = _place(row, allowed.scenario)
    try:
        loop, attack = place.loop(defence_spec.make(), defence_spec.entry.uses), attack_spec.make()
        states = episode(loop, attack, draws.keys(row["purpose"], [row["seed"]]))
        start, _ = next(states)
    except InputError as error:
        specs = {"defence": defence_spec, "attack": attack_spec}
        changed = " and ".join(name for name, spec in specs.items() if spec.digest != row[f"{name}_digest"])
        if not changed:
            raise
        raise InputError(error.field, error.value, f"{error.expected}; the file of the {changed} is another one than the row's") from None
    recorder, gate = Recorder(loop, start), [_gate(loop, start)]
    for state, frame in states:
        assert frame is not None
        recorder.put(signals_of(frame), np.ones(1, bool))
        gate.append(_gate(loop, state))
    trace = recorder.trace()
    metrics = {name: None if np.isnan(value[0]) else float(value[0]) for name, value in measure(trace).items()}
    versions = {"defence": defence_spec.entry.version, "attack": attack_spec.entry.version}
    here = {
        "trace_hash": trace.trace_hash(0), "decision_hash": trace.decision_hash(0), "version": VERSION,
        "config_hash": place.config_hash, "engine": ENGINE, "versions": ", ".join(f"{k} {v}" for k, v in versions.items()),
        "defence_digest": defence_spec.digest, "attack_digest": attack_spec.digest, "dose": _text(place.threat_model.budget),
        "knowledge": place.threat_model.knowledge, "uses": ", ".join(defence_spec.entry.uses),
    }  # fmt: skip
    held = {**row, "versions": ", ".join(f"{k} {v}" for k, v in _mapping(row.get("versions")).items())}
    held |= {"dose": _text(row["dose"]), "uses": ", ".join(map(str, row["uses"]))}
    checks = tuple(Check(name, str(held.get(name) or ""), value) for name, value in here.items())
    return Replay(row, place, loop, attack, trace, np.array(gate[: len(trace.kind)]), metrics, checks)


def episode(loop: Loop, attack: Attack, keys: Keys) -> Iterator[tuple[LoopState, Frame | None]]:
    """Yield the states of one episode: the start, then each step with its frame, until it ends."""
    state = loop.start(keys)
    plan = attack.prepare(loop.brief)
    memory = attack.start(plan, 1, keys.at(Role.ATTACK, np.zeros(1, np.int64)))
    yield state, None
    for _ in range(loop.horizon):
        if state.ended.all():
            return
        state, memory, frame = loop.step(state, attack, plan, memory)
        yield state, frame


def threshold(defence: object) -> tuple[str, float] | None:
    """Return name and value of the alarm threshold of the defence or its detector; None without one."""
    parts = getattr(defence, "parts", None)
    for part in (defence, *(parts() if callable(parts) else ())):
        name = getattr(part, "threshold_field", None)
        value = getattr(part, name, None) if isinstance(name, str) else None
        if isinstance(name, str) and isinstance(value, int | float):
            return name, float(value)
    return None


def _gate(loop: Loop, state: LoopState) -> Array:
    """Return the gate of each agent (N,); NaN without one."""
    nobody = np.full(loop.model.agents, np.nan)
    if not hasattr(loop.defence, "look"):
        return nobody
    look = loop.defence.look(loop.plan.defence, duplicate(state.defence), state.received, state.known_u)
    return nobody if look.gate is None else np.broadcast_to(look.gate, (1, loop.model.agents))[0]


def _text(dose: int | None) -> str:
    return "unlimited" if dose is None else str(dose)


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _component(family: Literal["defence", "attack"], row: Row, named: str | None) -> Spec:
    """Return the row's component, or the one that the user named for it; `Filter.fits` has checked that they agree."""
    held = Spec(family, row[family])
    if named is None and held.imports:
        raise InputError(
            f"the row's {family}", row[family],
            f"a registered name: a row must not import code. If you trust this class, name it yourself: --{family} '{row[family]}'",
        )  # fmt: skip
    spec = held if named is None else Spec(family, named)
    head, _ = split_text(spec.text)
    if family == "attack" and Path(head).suffix in (".json", *YAML_ENDS) and not spec.imports and not Path(head).is_file():
        raise InputError("the row's attack", spec.text, "an existing file; give its present path: --attack FILE")
    return spec


def _place(row: Row, named: str | None) -> Scenario:
    """Return the row's scenario with the row's threat model."""
    source = row.get("scenario_file") or row["scenario"]
    if named is not None and named.endswith(YAML_ENDS):
        source = named
    elif source == row["scenario"] and not source.endswith(YAML_ENDS) and source not in list_scenarios():
        raise InputError("the row's scenario", source, "a built-in one, or its file: --scenario FILE.yaml")
    elif source.endswith(YAML_ENDS) and not Path(source).is_file():
        raise InputError("the row's scenario", source, "an existing file; give its present path: --scenario FILE.yaml")
    threat = row.get("threat_model")
    if not isinstance(threat, dict):
        raise InputError("the row's threat_model", threat, "a mapping of fields")
    fields = {key: value for key, value in threat.items() if key != "class"}
    return dataclasses.replace(load_scenario(source), threat_model=build(ThreatModel, fields, "the row's threat_model"))
