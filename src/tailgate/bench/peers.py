"""Measurements of the peers that are installed. One that is not installed is missing, and no error."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib import import_module
from itertools import cycle
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np

from tailgate.core.scenario import load_scenario

from .lines import Go, Missing, Sample, repeated

STEPS = 20  # of a single environment before it looks at the clock
ASYNC = 64  # environments of the asynchronous vector environment


def need(module: str, package: str, how: str) -> ModuleType:
    """Return the module. Raises Missing, with what to install, where it is not there."""
    try:
        return import_module(module)
    except ImportError:
        raise Missing(f"{package} is missing: {how}") from None


def stepped(env: gymnasium.Env[Any, Any], actions: Sequence[Any], steps: int = STEPS) -> Go:
    """Return steps per second of a single environment, resets included; it looks at the clock every `steps`."""
    env.reset(seed=0)
    coming = cycle(actions)

    def chunk() -> int:
        for _ in range(steps):
            _, _, terminated, truncated, _ = env.step(next(coming))
            if terminated or truncated:
                env.reset()
        return steps

    return repeated(chunk)


def batched(env: gymnasium.vector.VectorEnv[Any, Any, Any], rows: int = 16) -> Go:
    """Return steps per second of a vector environment, over all its rows, with actions drawn at random beforehand."""
    env.reset(seed=0)
    env.action_space.seed(0)
    coming, size = cycle([env.action_space.sample() for _ in range(rows)]), int(env.num_envs)
    steps = max(1, 64 // size)

    def chunk() -> int:
        for _ in range(steps):
            env.step(next(coming))
        return steps * size

    return repeated(chunk)


def at_random(env: gymnasium.Env[Any, Any], count: int = 1024) -> list[Any]:
    """Return actions drawn at random beforehand."""
    env.action_space.seed(0)
    return [env.action_space.sample() for _ in range(count)]


def cartpole() -> Go:
    """Step CartPole-v1 through gymnasium.make."""
    env = gymnasium.make("CartPole-v1")
    return stepped(env, at_random(env))


def cartpole_vector(size: int) -> Go:
    """Step Gymnasium's native vector environment of CartPole: no noise, no estimator."""
    return batched(gymnasium.make_vec("CartPole-v1", num_envs=size, vectorization_mode="vector_entry_point"))


def highway() -> Go:
    """Step highway-fast-v0 with one lane and one other car."""
    need("highway_env", "highway-env", "pip install 'tailgate[highway]'")
    env = gymnasium.make("highway-fast-v0", config={"lanes_count": 1, "vehicles_count": 1})
    return stepped(env, [1], 5)  # idle: the only action that one lane needs


def filterpy_kalman() -> Go:
    """Run filterpy's Kalman filter, predict and update, on the model of car following."""
    filters = need("filterpy.kalman", "filterpy", "pip install filterpy")
    model = load_scenario("stop-and-go-v0").brief().model
    f = filters.KalmanFilter(dim_x=3, dim_z=2, dim_u=1)
    f.F, f.B, f.H, f.Q, f.R = model.A, model.B, model.C[0], model.Q, model.R[0]
    f.P = np.diag([1.0, 1.0, 0.25])
    readings, u = np.random.default_rng(0).normal(size=(STEPS, 2, 1)), np.zeros((1, 1))

    def chunk() -> int:
        for z in readings:
            f.predict(u)
            f.update(z)
        return STEPS

    return repeated(chunk)


# -- peers with processes: they run in a child, so that no fork copies this process's threads

_CHILD = """
import json, sys, time
import gymnasium
if __name__ == "__main__":
    env = gymnasium.make_vec("CartPole-v1", num_envs=int(sys.argv[1]), vectorization_mode="async")
    env.reset(seed=0)
    action = env.action_space.sample()
    print("ready", flush=True)
    for line in sys.stdin:
        steps, started = 0, time.perf_counter()
        while time.perf_counter() - started < float(line):
            env.step(action)
            steps += env.num_envs
        print(json.dumps([steps, time.perf_counter() - started]), flush=True)
    env.close()
"""


def cartpole_async() -> Go:
    """Step CartPole in Gymnasium's AsyncVectorEnv, one process an environment, on all cores."""
    child = subprocess.Popen([sys.executable, "-c", _CHILD, str(ASYNC)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert child.stdin is not None and child.stdout is not None
    send, answer = child.stdin, child.stdout
    if answer.readline().strip() != "ready":
        raise Missing("AsyncVectorEnv does not start here")

    def go(seconds: float) -> Sample:
        send.write(f"{seconds}\n")
        send.flush()
        steps, spent = json.loads(answer.readline())
        return Sample(steps, spent)

    return go


# -- SUMO, which reads its road from files

_NET = """<net version="1.16"><location netOffset="0,0" convBoundary="0,0,1000000,0" origBoundary="0,0,0,0" projParameter="!"/>
<edge id="road" from="west" to="east" priority="1">
<lane id="road_0" index="0" speed="40" length="1000000" shape="0,-1.6 1000000,-1.6"/></edge>
<junction id="west" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-3.2"/>
<junction id="east" type="dead_end" x="1000000" y="0" incLanes="road_0" intLanes="" shape="1000000,-3.2 1000000,0"/></net>"""
_CARS = 5
_END = 999_000.0  # of the road, but for more than a chunk of steps takes [m]


def _routes() -> str:
    types = '<vType id="leader" maxSpeed="20" speedFactor="1"/><vType id="cacc" carFollowModel="CACC" speedFactor="1"/>'
    places = [(f"car{i}", "cacc" if i else "leader", 400 - 60 * i) for i in range(_CARS)]
    cars = (f'<vehicle id="{name}" type="{kind}" route="along" depart="0" departPos="{x}" departSpeed="20"/>' for name, kind, x in places)
    return f'<routes>{types}<route id="along" edges="road"/>{"".join(cars)}</routes>'


def sumo() -> Go:
    """Step SUMO in this process (libsumo): five cars of its CACC model, whose positions and speeds are read every 0.1 s."""
    with contextlib.redirect_stdout(sys.stderr):  # it has words about versions, which no record shall hold
        held = need("libsumo", "libsumo", "pip install 'tailgate[sumo]'")
    folder = tempfile.TemporaryDirectory(prefix="tailgate-")
    net, routes = Path(folder.name) / "road.net.xml", Path(folder.name) / "cars.rou.xml"
    net.write_text(_NET, encoding="utf-8")
    routes.write_text(_routes(), encoding="utf-8")
    options = ["-n", str(net), "-r", str(routes), "--step-length", "0.1", "--no-step-log", "--no-warnings", "--xml-validation", "never"]
    held.start(["sumo", *options])
    names = [f"car{i}" for i in range(_CARS)]
    for _ in range(20):
        held.simulationStep()

    def chunk() -> int:
        _ = folder  # kept as long as the line
        if held.vehicle.getLanePosition(names[0]) > _END:
            held.load(options)
            for _ in range(20):
                held.simulationStep()
        for _ in range(STEPS):
            held.simulationStep()
            for name in names:
                held.vehicle.getLanePosition(name)
                held.vehicle.getSpeed(name)
        return STEPS

    return repeated(chunk)
