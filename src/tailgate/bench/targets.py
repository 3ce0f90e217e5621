"""The lines that are measured, and the targets that two of them are held to (spec of speed, 6.1 and 6.5)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from tailgate.base.errors import unknown

from . import ours, peers, problems, yardstick
from .lines import BYTES, NUMBER, SECONDS, SHARE, Go, Line

MANY = 4096

LINES: tuple[Line, ...] = (
    Line("make", "tailgate/CarFollowing-v0 through gymnasium.make", ours.single),
    Line("cartpole", "CartPole-v1 through gymnasium.make", peers.cartpole, ours=False),
    Line("highway", "highway-fast-v0, 1 lane, 1 other car", peers.highway, ours=False),
    Line("vector-256", "tailgate/CarFollowing-v0, make_vec, 256", partial(ours.vector, 256)),
    Line("cartpole-vector-256", "CartPole-v1, native vector environment, 256", partial(peers.cartpole_vector, 256), ours=False),
    Line("vector-4096", "tailgate/CarFollowing-v0, make_vec, 4096", partial(ours.vector, MANY)),
    Line("cartpole-vector-4096", "CartPole-v1, native vector environment, 4096", partial(peers.cartpole_vector, MANY), ours=False),
    Line(
        "cartpole-async", f"CartPole-v1, AsyncVectorEnv, {peers.ASYNC}, all cores, wall time", peers.cartpole_async, ours=False,
        cores=os.cpu_count() or 1,
    ),
    Line("batch-1", "whole step, car following, 1 episode", partial(ours.batch, 1)),
    Line("batch-4096", "whole step, car following, 4096 episodes", partial(ours.batch, MANY)),
    Line("yardstick", "the same step in C, 4096 episodes", partial(yardstick.line, "whole", MANY), ours=False),
    Line("yardstick-bare", "in C without process noise and rear driver, 4096 episodes", partial(yardstick.line, "bare", MANY), ours=False),
    Line("filterpy", "filterpy's Kalman filter, predict and update", peers.filterpy_kalman, of="updates", ours=False),
    Line("cores-1", "whole step, car following, 4096 episodes in 1 thread, wall time", partial(ours.on_cores, MANY, 1)),
    Line("cores-2", "whole step, car following, 4096 episodes in 2 threads, wall time", partial(ours.on_cores, MANY, 2), cores=2),
    Line("cores-2-unequal", "bytes that differ between one thread and two", ours.unequal, NUMBER, "bytes", most=1),
    Line("rkf", "robust KF update, 2 sensors, 4096 at once", partial(problems.robust_updates, MANY), of="updates"),
    Line("cvxpy-rkf", "robust KF update by cvxpy, 2 sensors", problems.robust_by_cvxpy, of="updates", ours=False),
    Line("norm", "(5.8), 14 sensors, 20 states, 4096 at once", partial(problems.ours, "norm", MANY), of="problems"),
    Line("cvxpy-norm", "(5.8) by cvxpy", partial(problems.theirs, "norm"), of="problems", ours=False),
    Line("norm-above", "(5.8): objective above cvxpy's, relatively, at most", partial(problems.above, "norm"), NUMBER, "", most=1),
    Line("lasso", "(6.26), 3 sensors, 19 states, 4096 at once", partial(problems.ours, "lasso", MANY), of="problems"),
    Line("cvxpy-lasso", "(6.26) by cvxpy", partial(problems.theirs, "lasso"), of="problems", ours=False),
    Line("lasso-above", "(6.26): objective above cvxpy's, relatively, at most", partial(problems.above, "lasso"), NUMBER, "", most=1),
    Line("platoon", "whole step, platoon of 5, dkf, 4096 episodes", partial(ours.platoon, MANY)),
    Line("sumo", "SUMO through libsumo, 5 CACC cars, with reads", peers.sumo, ours=False),
    Line("training-share", "share of the environment in PPO, 1024 x 32, batch 8192", ours.environment_share, SHARE, "", most=5),
    Line("start-cached", "import and first step, kernels cached", ours.start_cached, SECONDS, "", most=5),
    Line("start-cold", "import and first step, nothing cached", ours.start_cold, SECONDS, "", most=3),
    Line("memory", "memory of an episode, make_vec, at most", ours.memory, BYTES, "", most=1),
    Line("plug-in", "whole step, a defence in plain numpy, 4096 episodes", partial(ours.plug_in, MANY)),
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A demand: left over right, or left alone, is at least (or at most) the bound. Without a bound it is shown and not judged."""

    name: str
    what: str
    left: str
    right: str | None = None
    bound: float | None = None
    most: bool = False

    @property
    def lines(self) -> tuple[str, ...]:
        return (self.left,) if self.right is None else (self.left, self.right)


TARGETS: tuple[Target, ...] = (
    Target("make-cartpole", "gymnasium.make against CartPole-v1", "make", "cartpole", 3.5),
    Target("make-highway", "gymnasium.make against highway-fast-v0, 1 lane, 1 car", "make", "highway", 2500.0),
    Target("vector-256", "native vector environment against CartPole's, 256", "vector-256", "cartpole-vector-256", 4.0),
    Target("vector-4096", "native vector environment against CartPole's, 4096", "vector-4096", "cartpole-vector-4096", 1.3),
    Target("async", "native vector environment, 256, against CartPole's AsyncVectorEnv", "vector-256", "cartpole-async"),
    Target("yardstick", "4096 episodes against the C yardstick", "batch-4096", "yardstick", 0.75),
    Target("yardstick-bare", "4096 episodes against C without process noise and driver behind", "batch-4096", "yardstick-bare"),
    Target("cores", "2 cores against one, 4096 episodes", "cores-2", "cores-1", 1.8),
    Target("cores-equal", "episodes that two cores play differently in any bit", "cores-2-unequal", None, 0.0, True),
    Target("filterpy-1", "whole step against one filterpy update, 1 episode", "batch-1", "filterpy", 15.0),
    Target("filterpy-4096", "whole step against one filterpy update, 4096 episodes", "batch-4096", "filterpy", 500.0),
    Target("rkf", "robust KF update against cvxpy, 2 sensors", "rkf", "cvxpy-rkf", 10_000.0),
    Target("norm", "(5.8) batched against cvxpy", "norm", "cvxpy-norm", 1000.0),
    Target("norm-objective", "(5.8): objective above cvxpy's (1e-12: rounding)", "norm-above", None, 1e-12, True),
    Target("lasso", "(6.26) batched against cvxpy", "lasso", "cvxpy-lasso", 2000.0),
    Target("lasso-objective", "(6.26): objective above cvxpy's (1e-12: rounding)", "lasso-above", None, 1e-12, True),
    Target("platoon", "platoon of 5, batch, against libsumo with reads", "platoon", "sumo", 30.0),
    Target("training-share", "environment's share of tuned SB3 training", "training-share", None, 0.02, True),
    Target("start-cached", "import and first step, cached", "start-cached", None, 0.6, True),
    Target("start-cold", "import and first step, cold", "start-cold", None, 3.0, True),
    Target("memory", "memory of an episode of car following", "memory", None, 1024.0, True),
    Target("plug-in", "a plug-in defence in plain Python (numpy), 4096 episodes", "plug-in", None, 1e6),
)


@dataclass(frozen=True)
class Scaling:
    """A curve family: rate against one quantity. `points` are the lines of each curve by that quantity."""

    name: str
    what: str
    axis: str
    curves: dict[str, dict[int, Line]]


def _curve(name: str, sizes: Iterable[int], make: Callable[[int], Go], ours: bool = True, cores: bool = False) -> dict[int, Line]:
    return {n: Line(f"{name} {n}", f"{name}, {n}", partial(make, n), ours=ours, cores=n if cores else 1) for n in sizes}


def scalings() -> tuple[Scaling, ...]:
    """Return what the plots show."""
    sizes, lanes, cores = (1, 4, 16, 64, 256, 1024, 4096, 16384), (64, 256, 1024, 4096, 16384), range(1, (os.cpu_count() or 1) + 1)
    return (
        Scaling("scaling-episodes", "car following, episodes side by side", "episodes", {
            "whole step": _curve("whole step", sizes, ours.batch),
            "make_vec": _curve("make_vec", sizes, ours.vector),
            "CartPole's native vector environment": _curve("CartPole", sizes, peers.cartpole_vector, False),
            "the same step in C": _curve("C", lanes, partial(yardstick.line, "whole"), False),
        }),
        Scaling("scaling-cars", "platoons, 256 episodes", "cars", {
            "dkf": _curve("dkf", (2, 3, 5, 10, 20), lambda n: ours.platoon(256, n - 1)),
            "lasso_dkf": _curve("lasso_dkf", (2, 3, 5, 10, 20), lambda n: ours.platoon(256, n - 1, "lasso_dkf")),
        }),
        Scaling("scaling-sensors", "network of 10 agents, 256 episodes, sensors of each agent", "sensors", {
            "norm_resilient": _curve("sensors", (2, 4, 8, 14, 20), lambda n: ours.network(256, n)),
        }),
        Scaling("scaling-cores", "car following, 4096 episodes, wall time", "cores", {
            "whole step": _curve("cores", cores, partial(ours.on_cores, MANY), cores=True),
        }),
    )  # fmt: skip


def chosen(names: Iterable[str] | None) -> tuple[list[Target], list[Line], list[Scaling]]:
    """Return the targets, lines and scalings of these names; all without any. Raises InputError for a name that does not exist."""
    lines, plots = {line.name: line for line in LINES}, {scaling.name: scaling for scaling in scalings()}
    targets = {target.name: target for target in TARGETS}
    if not names:
        return list(TARGETS), list(LINES), list(plots.values())
    picked = list(dict.fromkeys(names))
    for name in picked:
        if name not in targets | lines | plots:
            raise unknown("only", name, targets | lines | plots)
    held = [targets[name] for name in picked if name in targets]
    wanted = {name for target in held for name in target.lines} | {name for name in picked if name in lines and name not in targets}
    return held, [line for line in LINES if line.name in wanted], [plots[name] for name in picked if name in plots]


def groups(lines: list[Line]) -> list[list[Line]]:
    """Return the lines in groups that targets join: what is compared is measured side by side, and nothing else between."""
    of = {line.name: {line.name} for line in lines}
    for target in TARGETS:
        if all(name in of for name in target.lines):
            joined = set().union(*(of[name] for name in target.lines))
            for name in joined:
                of[name] = joined
    out, seen = [], set()
    for line in lines:
        if line.name not in seen:
            seen |= of[line.name]
            out.append([other for other in lines if other.name in of[line.name]])
    return out
