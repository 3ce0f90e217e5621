"""The space of scripts: every family of scripted attacks, on every set of wires, with every trigger, bursts and pauses.

A point of the space is the text of a script, as on the command line. Its numbers lie within the threat model; thresholds of triggers lie
within what the road shows in episodes without an attack.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from tailgate.core import Kind
from tailgate.core.threat import Brief
from tailgate.play.trace import Trace

MOST_SETS = 12  # sets of wires, at most; of many wires only single ones and all
SMALL = 1e-3  # of a bound: the smallest magnitude that is tried


class Trial(Protocol):
    """The source of numbers: a sampler that learns which of them do harm. An `optuna.Trial` is one."""

    def suggest_float(self, name: str, low: float, high: float, *, log: bool = False) -> float: ...

    def suggest_int(self, name: str, low: int, high: int, *, log: bool = False) -> int: ...

    def suggest_categorical(self, name: str, choices: tuple[str, ...]) -> str: ...


@dataclass(frozen=True)
class Road:
    """The range of each signal that a trigger waits for, in episodes without an attack; empty where nobody drives."""

    ranges: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, trace: Trace) -> Road:
        """Return the ranges of a trace without an attack, from its 1st to its 99th percentile."""
        follows = trace.model.followers
        if not follows.any():
            return cls({})
        live = trace.live
        gap, speed, ahead = (trace.signals[name][:, :, follows][live] for name in ("gap", "speed", "lead_speed"))
        fall = -np.diff(trace.signals["lead_speed"][:, :, follows], axis=0)[live[1:]] / trace.dt
        seen = {"near": gap, "speed": speed, "slow": speed, "closing": speed - ahead, "leader_braking": fall}
        found = {}
        for name, values in seen.items():
            low, high = (float(x) for x in np.percentile(values[np.isfinite(values)], (1.0, 99.0)))
            low = max(low, 0.0)  # a threshold is not negative
            if high > low:
                found[name] = (low, high)
        return cls(found)


def _signed(trial: Trial, name: str, most: float) -> float:
    """Return a number of either sign whose magnitude is log-uniform up to `most`."""
    size = trial.suggest_float(f"{name}.size", SMALL * most, most, log=True)
    return -size if trial.suggest_categorical(f"{name}.sign", ("-", "+")) == "-" else size


def _number(value: float) -> str:
    return f"{value:.4g}"


def _fdi(trial: Trial, brief: Brief) -> dict[str, str]:
    return {"value": _number(_signed(trial, "value", brief.threat.fdi_bound))}


def _ramp(trial: Trial, brief: Brief) -> dict[str, str]:
    most, steps = brief.threat.fdi_bound, max(_budget(brief), 2)
    return {"base": _number(_signed(trial, "base", most)), "rate": _number(_signed(trial, "rate", max(2.0 * most / steps, SMALL)))}


def _gaussian(trial: Trial, brief: Brief) -> dict[str, str]:
    most = brief.threat.fdi_bound
    return {"mean": _number(_signed(trial, "mean", most)), "sd": _number(trial.suggest_float("sd", SMALL * most, most, log=True))}


def _bernoulli(trial: Trial, brief: Brief) -> dict[str, str]:
    return _fdi(trial, brief) | {"probability": _number(trial.suggest_float("probability", 0.1, 0.9))}


def _then_jam(trial: Trial, brief: Brief) -> dict[str, str]:
    return _fdi(trial, brief) | {"inject": str(trial.suggest_int("inject", 1, max(_budget(brief), 2)))}


def _jam(trial: Trial, brief: Brief) -> dict[str, str]:
    low, high = brief.threat.jam_range
    first = trial.suggest_float("low", low, high)
    return {"low": _number(first), "high": _number(first + (high - first) * trial.suggest_float("width", 0.0, 1.0))}


def _hold(trial: Trial, brief: Brief) -> dict[str, str]:
    kinds = brief.threat.kinds
    fresh = tuple(text for text, kind in (("false", "dos_hold"), ("true", "dos_hold_fresh")) if kind in kinds)
    return {"fresh": trial.suggest_categorical("fresh", fresh)}


def _dropout(trial: Trial, brief: Brief) -> dict[str, str]:
    return {"probability": "1" if trial.suggest_categorical("lossy", ("all", "some")) == "all" else _number(trial.suggest_float("loss", 0.2, 0.95))}


def _old(name: str) -> Callable[[Trial, Brief], dict[str, str]]:
    return lambda trial, brief: {name: str(trial.suggest_int(name, 1, brief.threat.memory, log=True))}


def _hop(trial: Trial) -> dict[str, str]:
    return {"hop": trial.suggest_categorical("hop", ("false", "true"))}


def _echo(trial: Trial, brief: Brief) -> dict[str, str]:
    most = brief.threat.delay_bound
    return {"delay": _number(trial.suggest_float("delay", SMALL * most, most, log=True))} | _hop(trial)


def _pull_off(trial: Trial, brief: Brief) -> dict[str, str]:
    most = brief.threat.delay_bound
    base, rate = trial.suggest_float("base", SMALL * most, most, log=True), trial.suggest_float("rate", SMALL * most, most, log=True)
    return {"base": _number(base), "rate": _number(rate)} | _hop(trial)


def _noise(trial: Trial, brief: Brief) -> dict[str, str]:
    most = brief.threat.jam_power
    return {"power": _number(trial.suggest_float("power", SMALL * most, most, log=True))} | _hop(trial)


@dataclass(frozen=True)
class Family:
    """A scripted attack: its name, the kinds that it needs (one of each set), and the numbers of its own."""

    name: str
    kinds: tuple[tuple[Kind, ...], ...]
    numbers: Callable[[Trial, Brief], dict[str, str]]


FAMILIES = (
    Family("dos_hold", ((Kind.DOS_HOLD, Kind.DOS_HOLD_FRESH),), _hold),
    Family("dos_jam", ((Kind.DOS_JAM,),), _jam),
    Family("dropout", ((Kind.DROPOUT,),), _dropout),
    Family("fdi", ((Kind.FDI,),), _fdi),
    Family("fdi_ramp", ((Kind.FDI,),), _ramp),
    Family("fdi_gaussian", ((Kind.FDI,),), _gaussian),
    Family("fdi_bernoulli", ((Kind.FDI,),), _bernoulli),
    Family("fdi_then_jam", ((Kind.FDI,), (Kind.DOS_JAM,)), _then_jam),
    Family("delay", ((Kind.DELAY,),), _old("age")),
    Family("replay", ((Kind.REPLAY,),), _old("window")),
    Family("noise_jam", ((Kind.NOISE_JAM,),), _noise),
    Family("echo_delay", ((Kind.ECHO_DELAY,),), _echo),
    Family("echo_pull_off", ((Kind.ECHO_DELAY,),), _pull_off),
)


def _budget(brief: Brief) -> int:
    """Return the attack steps that an episode may have."""
    return brief.horizon if brief.threat.budget is None else brief.threat.budget


@dataclass(frozen=True)
class Space:
    """All scripts that a threat model grants in a scenario."""

    brief: Brief
    road: Road

    @property
    def families(self) -> tuple[Family, ...]:
        """The families whose kinds are granted."""
        granted = {Kind[name.upper()] for name in self.brief.threat.kinds}
        return tuple(family for family in FAMILIES if all(granted & set(kinds) for kinds in family.kinds))

    @property
    def targets(self) -> tuple[tuple[str, ...], ...]:
        """The sets of wires that are tried; the empty one stands for all that are granted."""
        granted = [name for name, hit in zip(self.brief.model.wires, self.brief.granted.any(axis=0).tolist(), strict=True) if hit]
        sets = [subset for size in range(1, len(granted)) for subset in itertools.combinations(granted, size)]
        return ((), *(sets if len(sets) < MOST_SETS else [(name,) for name in granted]))

    def script(self, trial: Trial, family: Family) -> str:
        """Return the text of one script of a family."""
        words = family.numbers(trial, self.brief)
        targets = tuple("+".join(subset) for subset in self.targets)
        if len(targets) > 1 and (aimed := trial.suggest_categorical("targets", targets)):
            words["targets"] = f"[{aimed.replace('+', ',')}]"
        agents = np.flatnonzero(self.brief.granted.any(axis=1)).tolist()
        if len(agents) > 1 and (one := trial.suggest_categorical("agents", ("", *map(str, agents)))):
            words["agents"] = f"[{one}]"
        return f"{family.name}:" + ",".join(f"{key}={value}" for key, value in (words | self._timing(trial)).items())

    def _timing(self, trial: Trial) -> dict[str, str]:
        """Return when it attacks: a trigger with its threshold or a step, and bursts with pauses or one window."""
        threat, budget = self.brief.threat, _budget(self.brief)
        trigger = trial.suggest_categorical("trigger", ("time", *self.road.ranges))
        if trigger == "time":
            last = self.brief.horizon if threat.end is None else min(threat.end, self.brief.horizon)
            words = {"start_step": str(trial.suggest_int("start_step", threat.onset, max(last, threat.onset)))}
        else:
            low, high = self.road.ranges[trigger]
            words = {"trigger": trigger, "threshold": _number(trial.suggest_float(f"threshold.{trigger}", low, high))}
        if budget > 1 and trial.suggest_categorical("bursts", ("one", "many")) == "many":
            most = max(budget // 2, 1)
            words |= {"burst": str(trial.suggest_int("burst", 1, most, log=True)), "pause": str(trial.suggest_int("pause", 1, 20, log=True))}
        return words
