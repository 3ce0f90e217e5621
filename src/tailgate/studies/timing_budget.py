"""The time that authentication costs, and what it buys: schedulability, end-to-end delay, control cost, and the choice of messages.

Tasks run by fixed priorities on their control unit, messages in slots of a cycle. A tag makes a message longer and its sender and receiver
slower, and with a key that is released later its value comes later still. The control cost of a delay is measured: the package's own
closed loop, with that step and that latency.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from tailgate.base.errors import InputError, unknown
from tailgate.base.sizes import Episodes
from tailgate.core import NonNegative, Positive, PositiveCount, draws, param
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, config_path, load_scenario
from tailgate.core.schema import build, read_yaml
from tailgate.play.metrics import measure
from tailgate.play.trace import rollout

FORMAT = "tailgate-security-cost-1"
MOST = 14  # messages of which every set is tried
PERIODS = 16  # control periods that are tried at most
LATEST = 40  # steps of delay that are measured; the closed loop is as slow as they are many
SHORTEST, LONGEST = 10, 20_000  # steps of an episode at a period that is tried
APART = 1e4  # how often the shortest period of a task may fit into the longest
EDGE = 1e-9  # share by which a time may pass its limit: sums of decimal numbers
Tell = Callable[[int, int], None]
Bits = Annotated[int, Field(ge=0, le=10**6)]


@dataclass(frozen=True)
class Task:
    """A periodic task with its deadline at the end of its period."""

    name: str
    period: Positive = param(0.1, "period T [s]")
    wcet: Positive = param(0.01, "worst-case execution time C [s]")
    ecu: str = param("control", "control unit; on each a shorter period is more urgent")


@dataclass(frozen=True)
class Message:
    """A message over the slotted channel; its name is a wire of the scenario."""

    name: str
    bits: PositiveCount = param(256, "length without a tag [bit]")
    sender: str = param("", "task that sends it")
    receiver: str = param("", "task that receives it")
    weight: Positive = param(1.0, "part of the security level that its authentication is worth")


@dataclass(frozen=True)
class Slot:
    """The slotted channel: each message has a slot in every cycle."""

    cycle: Positive = param(0.05, "length of a cycle [s]")
    bits: PositiveCount = param(512, "bits of a slot")


@dataclass(frozen=True)
class Authentication:
    """The cost of a tag."""

    fixed: NonNegative = param(0.002, "time at either end for each message, e0 [s]")
    each_bit: NonNegative = param(4e-6, "time at either end for each bit, e1 [s]")
    tag: Bits = param(128, "length of a tag [bit]")
    key_interval: NonNegative = param(0.0, "time until the key is released [s]; 0: the receiver has it")


@dataclass(frozen=True)
class Budget:
    """A system, the scenario that its control cost is measured in, and the security level that is asked for."""

    name: str
    scenario: str
    tasks: tuple[Task, ...]
    messages: tuple[Message, ...]
    path: tuple[str, ...] = param((), "tasks from the arrival of a message to the command, in order")
    about: str = ""
    defence: str = param("kf", "defence of the closed loop")
    metric: Literal["min_gap", "rmse_position"] = param("min_gap", "control cost: less of the median gap, or more of the error")
    seeds: Episodes = param(40, "episodes of each figure")
    slot: Slot = param(Slot(), "the channel")
    authentication: Authentication = param(Authentication(), "what a tag costs")
    periods: tuple[Positive, ...] = param((), "control periods that are tried [s]; empty: the scenario's step")
    level: NonNegative = param(0.0, "security level that is asked for: sum of the weights of authenticated messages")


def load_budget(name: str) -> Budget:
    """Return a budget by its built-in name, or from a YAML file, checked as a whole."""
    path = config_path("timing", name, "--security")
    data = {"name": path.stem} | read_yaml(path, "--security")
    where = f"timing {data['name']}"
    for key, cls in (("tasks", Task), ("messages", Message)):
        held = data.get(key)
        if not isinstance(held, list) or not held:
            raise InputError(f"{where}.{key}", held, "a list of mappings, at least one")
        data[key] = tuple(build(cls, one, f"{where}: {key[:-1]} {i}") for i, one in enumerate(held, start=1))
    for key, part in (("slot", Slot), ("authentication", Authentication)):
        if key in data:
            data[key] = build(part, data[key], f"{where}.{key}")
    budget = build(Budget, data, where)
    _check(budget, where)
    return budget


def _check(budget: Budget, where: str) -> None:
    names = [task.name for task in budget.tasks]
    for key, held in (("tasks", names), ("messages", [message.name for message in budget.messages])):
        if len(set(held)) < len(held):
            raise InputError(f"{where}.{key}", held, "names of which no two are equal")
    for message in budget.messages:
        for field in ("sender", "receiver"):
            if getattr(message, field) not in names:
                raise unknown(f"{where}: message {message.name}.{field}", getattr(message, field), names)
    for name in budget.path:
        if name not in names:
            raise unknown(f"{where}.path", name, names)
    if len(set(budget.path)) < len(budget.path):
        raise InputError(f"{where}.path", list(budget.path), "each task once")
    if not budget.path:
        raise InputError(f"{where}.path", [], "the tasks from the arrival of a message to the command")
    if len(budget.messages) > MOST:
        raise InputError(f"{where}.messages", len(budget.messages), f"at most {MOST}: every set of them is tried")
    place = load_scenario(budget.scenario)
    _check_periods(budget, place, where)
    model = place.brief().model
    for message in budget.messages:
        if message.name not in model.wires:
            raise unknown(f"{where}: message", message.name, model.wires)
    if budget.level > sum(message.weight for message in budget.messages):
        raise InputError(f"{where}.level", budget.level, f"at most the sum of all weights ({sum(m.weight for m in budget.messages):g})")


def _check_periods(budget: Budget, place: Scenario, where: str) -> None:
    """Raise InputError for periods in which an episode has too few or too many steps, or that are too far apart."""
    seconds = place.horizon * place.plant.dt
    if len(budget.periods) > PERIODS:
        raise InputError(f"{where}.periods", len(budget.periods), f"at most {PERIODS} periods")
    for period in budget.periods:
        low, high = seconds / LONGEST, seconds / SHORTEST
        if not low <= period <= high:
            wanted = f"{low:g} to {high:g} s: an episode of {place.name} lasts {seconds:g} s, and has {SHORTEST} to {LONGEST} steps"
            raise InputError(f"{where}.periods", period, wanted)
    every = [*(task.period for task in budget.tasks), *budget.periods]
    if max(every) > APART * min(every):
        raise InputError(f"{where}.tasks: period", max(every), f"at most {APART:g} times the shortest, {min(every):g}")


def responses(tasks: Sequence[tuple[float, float]]) -> list[float | None]:
    """Return the worst-case response times [s] of tasks (C, T), the most urgent first, preemptive and independent.

    R = C_i + sum over more urgent j of ceil(R / T_j) C_j, from R = C_i on (Joseph and Pandya, The Computer Journal 1986). None where R
    passes the period.
    """
    out: list[float | None] = []
    for i, (cost, period) in enumerate(tasks):
        R: float | None = cost
        while R is not None:
            wanted = cost + sum(math.ceil(R / T - EDGE) * C for C, T in tasks[:i])
            if wanted > period * (1.0 + EDGE):
                R = None
            elif wanted <= R * (1.0 + EDGE):
                break
            else:
                R = wanted
        out.append(R)
    return out


def utilisation(tasks: Iterable[tuple[float, float]]) -> float:
    """Return the share of a processor that tasks (C, T) take."""
    return sum(C / T for C, T in tasks)


@dataclass(frozen=True)
class Timing:
    """The times of a system with some messages authenticated: response times by task, delay of the longest path, load by control unit."""

    responses: Mapping[str, float | None]
    load: Mapping[str, float]
    delay: float | None  # [s], from sending to the command; None where a task misses its deadline

    @property
    def schedulable(self) -> bool:
        """True if every task meets its deadline."""
        return self.delay is not None


def timing(budget: Budget, sealed: frozenset[str], period: float | None = None) -> Timing:
    """Return the times of a system. `period` is the control period: that of the tasks of the path behind the first one."""
    cost = {task.name: task.wcet for task in budget.tasks}
    every = {task.name: task.period for task in budget.tasks}
    if period is not None:
        every |= dict.fromkeys(budget.path[1:], period)
    tag = budget.authentication
    for message in budget.messages:
        if message.name in sealed:
            for end in (message.sender, message.receiver):
                cost[end] += tag.fixed + tag.each_bit * message.bits
    found: dict[str, float | None] = {}
    load: dict[str, float] = {}
    for ecu in dict.fromkeys(task.ecu for task in budget.tasks):
        names = sorted((task.name for task in budget.tasks if task.ecu == ecu), key=lambda name: every[name])
        pairs = [(cost[name], every[name]) for name in names]
        load[ecu] = utilisation(pairs)
        missed: list[float | None] = [None] * len(pairs)
        found |= dict(zip(names, responses(pairs) if load[ecu] <= 1.0 + EDGE else missed, strict=True))
    if any(R is None for R in found.values()):
        return Timing(found, load, None)
    delays = [
        (found[message.sender] or 0.0)
        + budget.slot.cycle * math.ceil((message.bits + (tag.tag if message.name in sealed else 0)) / budget.slot.bits)
        + (tag.key_interval if message.name in sealed else 0.0)
        for message in budget.messages
    ]
    inside = sum(every[name] + (found[name] or 0.0) for name in budget.path)
    return Timing(found, load, max(delays) + inside)


def at_period(place: Scenario, period: float, latency: int) -> Scenario:
    """Return a scenario with a step of `period` [s] and readings and messages `latency` steps late, of the same length in seconds.

    The variance of process noise a step grows with the step: it is that of a random walk.
    """
    plant, ratio = place.plant, period / place.plant.dt
    changes: dict[str, Any] = {"dt": period}
    for name, power in (("process_var", 1.0), ("noise_var", 1.0), ("accel_sd", 0.5)):
        if hasattr(plant, name) and ratio != 1.0:
            held = getattr(plant, name)
            changes[name] = tuple(ratio**power * one for one in held) if isinstance(held, tuple) else ratio**power * held
    threat = dataclasses.replace(place.threat_model, onset=1, end=None)
    return dataclasses.replace(
        place, plant=dataclasses.replace(plant, **changes), horizon=max(1, round(place.horizon / ratio)), threat_model=threat,
        truth={**place.truth, "latency": latency} if latency else place.truth,
    )  # fmt: skip


@dataclass(frozen=True)
class Cost:
    """The closed loop at a period and a delay: medians over episodes."""

    period: float  # [s]
    latency: int  # [steps]
    min_gap: float  # [m]
    rmse_position: float  # [m]
    crashed: float  # share of episodes


def control_cost(budget: Budget, period: float, latency: int) -> Cost:
    """Return what a delay costs the closed loop, without an attack."""
    guard = Spec("defence", budget.defence)
    loop = at_period(load_scenario(budget.scenario), period, latency).loop(guard.make(), guard.entry.uses)
    found = measure(rollout(loop, Spec("attack", "none").make(), draws.keys("tune", range(budget.seeds))))
    gap, error = (float(np.median(found[name])) for name in ("min_gap", "rmse_position"))
    return Cost(period, latency, gap, error, float(np.mean(found["crashed"])))


def value_of(budget: Budget, cost: Cost) -> float:
    """Return the control cost J that is made small: the median smallest gap with its sign changed, or the median error [m]."""
    return -cost.min_gap if budget.metric == "min_gap" else cost.rmse_position


def choices(budget: Budget, tell: Tell | None = None) -> dict[str, Any]:
    """Return the report: every set of authenticated messages at every period, its times, its control cost, and the best one."""
    names = [message.name for message in budget.messages]
    weight = {message.name: message.weight for message in budget.messages}
    place = load_scenario(budget.scenario)
    periods = budget.periods or (place.plant.dt,)
    sets = [frozenset(some) for size in range(len(names) + 1) for some in combinations(names, size)]
    rows: list[tuple[float, frozenset[str], Timing, int | None]] = []
    wanted: set[tuple[float, int]] = set()
    for period in periods:
        for sealed in sets:
            held = timing(budget, sealed, period)
            latest = min(LATEST, round(place.horizon * place.plant.dt / period) - 1)
            steps = None if held.delay is None or held.delay > period * latest * (1.0 + EDGE) else math.ceil(held.delay / period - EDGE)
            rows.append((period, sealed, held, steps))
            if steps is not None:
                wanted.add((period, steps))
    measured: dict[tuple[float, int], Cost] = {}
    for i, (period, steps) in enumerate(sorted(wanted)):
        if tell is not None:
            tell(i, len(wanted))
        measured[period, steps] = control_cost(budget, period, steps)
    out: list[dict[str, Any]] = []
    for period, sealed, held, steps in rows:
        cost = None if steps is None else measured[period, steps]
        out.append({
            "period": period, "authenticated": sorted(sealed), "level": sum(weight[name] for name in sealed), "delay": held.delay,
            "latency": steps, "load": dict(held.load), "responses": dict(held.responses), "schedulable": held.schedulable,
            "cost": None if cost is None else dataclasses.asdict(cost), "J": None if cost is None else value_of(budget, cost),
            "why": _why_not(held, cost),
        })  # fmt: skip
    enough = [row for row in out if row["why"] is None and row["level"] >= budget.level - EDGE]
    best = min(enough, key=lambda row: (row["J"], row["period"], -row["level"]), default=None)
    return {
        "format": FORMAT, "name": budget.name, "scenario": budget.scenario, "defence": budget.defence, "metric": budget.metric,
        "seeds": budget.seeds, "asked": budget.level, "sets": out, "best": best,
        "threat": None if best is None else threat_of(budget, best["authenticated"], best["period"]),
    }  # fmt: skip


def _why_not(held: Timing, cost: Cost | None) -> str | None:
    """Return why a set is no candidate; None where it is one."""
    if not held.schedulable:
        return "misses a deadline"
    if cost is None:
        return "too late to be measured"
    return "collides" if cost.crashed > 0.0 else None


def threat_of(budget: Budget, sealed: Sequence[str], period: float) -> dict[str, Any]:
    """Return the changes of a threat model that a set of authenticated messages makes: values of them are no longer forged."""
    interval = budget.authentication.key_interval
    return {"authenticated": sorted(sealed), "key_interval": math.floor(interval / period + EDGE)}


