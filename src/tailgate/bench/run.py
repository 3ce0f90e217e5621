"""Measure in rounds: every line of a group runs once in each, A B A B ..., so that a slow machine slows both sides."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.provenance import commit, cpuinfo, processor
from tailgate.base.version import VERSION
from tailgate.evaluation.stats import at_least

from .lines import RATE, Line, Missing
from .targets import Scaling, Target, chosen, groups
from .yardstick import compiler

PACKAGES = (
    "numpy", "llvmlite", "scipy", "gymnasium", "filterpy", "highway-env", "cvxpy", "clarabel", "stable-baselines3", "torch",
    "libsumo",
)  # fmt: skip
LEVEL = 0.95
Report = Callable[[str, int, int, str], None]  # label, done, total, figures


def machine() -> dict[str, Any]:
    """Return what the figures were made on."""
    found: dict[str, Any] = {
        "processor": processor(), "vectors": _vectors(), "cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(), "packages": {},
    }  # fmt: skip
    for name in PACKAGES:
        try:
            found["packages"][name] = version(name)
        except PackageNotFoundError:
            continue
    try:
        found["compiler"] = compiler()
    except Missing:
        found["compiler"] = None
    return found


def _vectors() -> str:
    """Return the widest vector instructions of this processor, as far as known."""
    flags = cpuinfo("flags").split()
    return next((words for flag, words in (("avx512f", "AVX-512"), ("avx2", "AVX2"), ("asimd", "NEON")) if flag in flags), "unknown")


def interval(values: Sequence[float], level: float = LEVEL) -> tuple[float, float, float]:
    """Return ends of an interval for the median from order statistics, and its coverage.

    It is the narrowest one that covers at least `level`; where none does, from the smallest to the largest.
    No distribution is assumed, only rounds that do not depend on each other.
    """
    ordered, n = sorted(values), len(values)
    cut = max((k for k in range(1, n // 2 + 1) if 1.0 - 2.0 * float(at_least(n - k + 1, n)) >= level), default=1)
    return ordered[cut - 1], ordered[n - cut], max(0.0, 1.0 - 2.0 * float(at_least(n - cut + 1, n)))


def summary(line: Line, values: Sequence[float]) -> dict[str, Any]:
    """Return median and quartiles of a line."""
    low, high = (statistics.quantiles(values, n=4, method="inclusive")[i] for i in (0, 2)) if len(values) > 1 else (values[0], values[0])
    return {
        "what": line.what, "unit": line.unit, "of": line.of, "ours": line.ours, "cores": line.cores, "median": statistics.median(values),
        "q25": low, "q75": high, "rounds": list(values),
    }  # fmt: skip


class Measured:
    """Rounds of lines, and why some could not be had."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.values: dict[str, list[float]] = {}
        self.missing: dict[str, str] = {}

    def measure(self, lines: Sequence[Line], rounds: int, said: Callable[[Line], None]) -> None:
        """Set the lines up, runs each once unmeasured, then round by round."""
        ready = []
        for line in lines:
            said(line)
            try:
                go = line.make()
                if line.unit == RATE:
                    go(0.0)  # compiles, fills caches
                ready.append((line, go))
            except Missing as error:
                self.missing[line.name] = str(error)
            except Exception as error:  # a peer that is broken here is no fault of ours
                if line.ours:
                    raise
                self.missing[line.name] = f"it fails here: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        for i in range(rounds):
            for line, go in ready:
                if line.most is None or i < line.most:
                    said(line)
                    self.values.setdefault(line.name, []).append(go(self.seconds).value)


def judged(target: Target, measured: Measured) -> dict[str, Any]:
    """Return a target's figure with the interval over rounds; `met` is None if it is not known or nothing is asked."""
    out: dict[str, Any] = {
        "name": target.name, "what": target.what, "left": target.left, "right": target.right, "bound": target.bound,
        "at": "most" if target.most else "least", "value": None, "low": None, "high": None, "coverage": None, "met": None,
    }  # fmt: skip
    absent = [name for name in target.lines if name not in measured.values]
    if absent:
        return out | {"why": "; ".join(measured.missing.get(name, "not measured") for name in absent)}
    left = measured.values[target.left]
    if target.right is None:
        value, each = statistics.median(left), left
    else:
        right = measured.values[target.right]
        value = statistics.median(left) / statistics.median(right)
        each = [a / b for a, b in zip(left, right, strict=False)]
    low, high, coverage = interval(each)
    met = None if target.bound is None else value <= target.bound if target.most else value >= target.bound
    return out | {"value": value, "low": low, "high": high, "coverage": coverage, "met": met}


def bench(
    only_these: Iterable[str] | None = None, rounds: int = 7, seconds: float = 0.5, progress: Report | None = None
) -> dict[str, Any]:
    """Measure, and return the record: machine, lines, targets, scalings, what is missing. Raises InputError for an unknown name."""
    sizes.check("rounds", rounds)
    if not 0.0 < seconds <= 60.0:
        raise InputError("seconds", seconds, "seconds above 0, at most 60")
    targets, lines, plots = chosen(only_these)
    plans = [(group, rounds) for group in groups(lines)] + [(_points(plot), max(1, rounds // 2)) for plot in plots]
    total = sum(len(group) + sum(min(count, line.most or count) for line in group) for group, count in plans)
    done = 0

    def said(line: Line) -> None:
        nonlocal done
        if progress is not None:
            progress("measuring", min(done, total), total, line.name)
        done += 1

    started, measured = time.time(), Measured(seconds)
    for group, count in plans:
        measured.measure(group, count, said)
    if progress is not None:
        progress("measuring", total, total, "")
    names, load = {line.name for line in lines}, [round(x, 2) for x in os.getloadavg()] if hasattr(os, "getloadavg") else None
    return {
        "format": "tailgate-speed-1", "version": VERSION, "commit": commit(), "machine": machine(),
        "load": load, "date": time.strftime("%Y-%m-%d", time.gmtime(started)), "rounds": rounds, "seconds": seconds,
        "targets": [judged(target, measured) for target in targets],
        "lines": {line.name: summary(line, measured.values[line.name]) for line in lines if line.name in measured.values},
        "missing": {name: why for name, why in measured.missing.items() if name in names},
        "scalings": [_curves(plot, measured) for plot in plots],
    }  # fmt: skip


def _points(plot: Scaling) -> list[Line]:
    """Return the lines of a plot, point by point: curves that meet at a point are measured side by side."""
    sizes = sorted({n for curve in plot.curves.values() for n in curve})
    return [curve[n] for n in sizes for curve in plot.curves.values() if n in curve]


def _curves(plot: Scaling, measured: Measured) -> dict[str, Any]:
    curves = {}
    for name, curve in plot.curves.items():
        points = [{"at": n, **summary(line, measured.values[line.name])} for n, line in curve.items() if line.name in measured.values]
        if points:
            curves[name] = [{key: point[key] for key in ("at", "median", "q25", "q75")} for point in points]
    return {"name": plot.name, "what": plot.what, "axis": plot.axis, "unit": RATE, "curves": curves}
