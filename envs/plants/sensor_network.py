"""A network of agents that watch one linear system together (thesis chapter 5; dimensionless).

    x+ = A x + w          y_i = C_i x + v_i + a_i          N(i) = {i} + in-neighbours                  (5.1)-(5.3)

Errata: the thesis's "random" A is drawn without a scale, so that its figures depend on the draw; here A has a stated spectral radius. Its
figure 5.1 shows 12 edges, of which the text gives 11; the twelfth is taken as 4-9. Agents count from 0: the thesis's agent 1 is agent 0.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import (
    Array,
    Controller,
    Count,
    Estimate,
    Model,
    PositiveCount,
    Prior,
    Probability,
    Received,
    Scene,
    Sensor,
    Sized,
    param,
)  # fmt: skip
from tailgate.core.draws import Draws, constants
from tailgate.core.quantities import PositiveVariance, Size, Spread, Step, Variance
from tailgate.core.reach import require_detectable
from tailgate.core.registry import register

Edge = Annotated[tuple[Count, Count], Field(min_length=2, max_length=2)]
GraphName = Literal["thesis", "ring", "path", "star", "complete", "random"]

# Figure 5.1, counted from 0; the last edge is not determined by the text.
THESIS_EDGES = ((0, 2), (0, 3), (0, 7), (1, 8), (2, 7), (4, 5), (4, 6), (5, 7), (6, 7), (7, 9), (8, 9), (3, 8))
Radius = Annotated[float, Field(ge=0, le=1.5)]  # 1000 steps of growth are still a number
MOST = 10**7  # numbers in the covariances of all agents in one episode
ANGLE = 0.9  # the widest angle by which a mode turns in a step, in units of pi


class NetworkPlan(NamedTuple):
    A: Array  # (1, n, n)
    noise_sd: float


class NetworkState(NamedTuple):
    """Every leaf has B first."""

    x: Array  # (B, n)


@lru_cache(maxsize=64)
def modes(states: int, seed: int) -> tuple[Array, Array]:
    """Return T and D, each (n, n): an orthogonal matrix, and rotations by different angles on the diagonal (1 for an odd state)."""
    draws = constants("sensor_network", seed)
    T = draws.normal((states, states), 1)[0]
    for i in range(states):  # Gram and Schmidt, twice against rounding
        for _ in range(2):
            for j in range(i):
                T[:, i] -= num.dot(T[:, i], T[:, j]) * T[:, j]
        T[:, i] /= np.sqrt(num.dot(T[:, i], T[:, i]))
    D = np.eye(states)
    pairs = states // 2
    for p in range(pairs):
        turn = num.expm(np.array([[0.0, -1.0], [1.0, 0.0]]) * (np.pi * ANGLE * (p + 1) / pairs))
        D[2 * p : 2 * p + 2, 2 * p : 2 * p + 2] = turn
    return T, D


def blocks(states: int) -> list[slice]:
    """Return the modes' places on the diagonal of D: pairs, and one alone where the number of states is odd."""
    return [slice(p, min(p + 2, states)) for p in range(0, states, 2)]


@register("plant", "sensor_network", reference="Dutta 2018, (5.1) and section 5.4")
@dataclass(frozen=True)
class SensorNetwork:
    """One linear system without input, watched by agents that talk to their neighbours in a graph."""

    agents: Size = param(10, "number of agents")
    states: Size = param(20, "number of states")
    graph: GraphName = param("thesis", "who hears whom: thesis (figure 5.1), ring, path, star, complete or random")
    edges: tuple[Edge, ...] | None = param(None, "own edges, pairs of agents from 0, in place of `graph`")
    directed: bool = param(False, "an edge (j, i) lets i hear j, and not the other way round")
    edge_probability: Probability = param(0.3, "graph random: probability of each edge beyond a random tree that connects all [-]")
    system: Literal["gaussian", "modal"] = param("gaussian", "A: gaussian entries, scaled; or modal: rotations that all last equally long")
    spectral_radius: Radius = param(1.0, "largest |eigenvalue| of A [-]")
    system_seed: Count = param(0, "seed of A and of a random graph")
    dt: Step = param(1.0, "step [s]; the thesis has none")
    noise_var: Variance = param(0.0, "process noise variance of the system itself; 0, as in the thesis, is none")
    process_var: PositiveVariance = param(1.0, "process noise variance that the defence assumes (Sigma_w)")
    initial_sd: Spread = param(1.0, "spread of the true initial state about 0, which the defence takes it for")
    prior_var: PositiveVariance = param(1.0, "variance of the prior that the defence assumes")

    def __post_init__(self) -> None:
        if self.agents * self.states * self.states > MOST:
            raise InputError("plant sensor_network.states", self.states, f"agents x states^2, a covariance each, at most {MOST}")

    @property
    def size(self) -> tuple[int, int]:
        return self.agents, self.states

    def matrix(self) -> Array:
        """Return A (n, n)."""
        if self.system == "modal":
            T, D = modes(self.states, self.system_seed)
            return self.spectral_radius * num.product(num.product(T, D), T.T)
        raw = constants("sensor_network", self.system_seed).normal((self.states, self.states))[0]
        return np.asarray(raw * (self.spectral_radius / num.spectral_radius(raw)))

    def hears(self) -> Array:
        """Return the graph (N, N) bool, [i, j] when i hears j; everybody hears itself."""
        n, where = self.agents, "plant sensor_network"
        pairs = self._pairs()
        out = np.eye(n, dtype=bool)
        for j, i in pairs:
            if max(i, j) >= n or i == j:
                raise InputError(f"{where}.edges", (j, i), f"two different agents, from 0 to {n - 1}")
            out[i, j] = True
            out[j, i] |= not self.directed
        return out

    def _pairs(self) -> tuple[tuple[int, int], ...]:
        n = self.agents
        if self.edges is not None:
            return self.edges
        if self.graph == "thesis":
            if n != 10:
                raise InputError("plant sensor_network.graph", "thesis", f"another graph: the thesis's has 10 agents, not {n}")
            return THESIS_EDGES
        if self.graph == "path":
            return tuple((i, i + 1) for i in range(n - 1))
        if self.graph == "ring":
            return tuple((i, (i + 1) % n) for i in range(n) if n > 1)
        if self.graph == "star":
            return tuple((0, i) for i in range(1, n))
        if self.graph == "complete":
            return tuple((i, j) for i in range(n) for j in range(n) if i < j or (self.directed and i > j))
        u = constants("sensor_network", self.system_seed).uniform((n, n), 2)[0]
        tree = {(min(int(u[i, i] * i), i - 1), i) for i in range(1, n)}
        more = {(i, j) for i in range(n) for j in range(n) if (i < j or (self.directed and i > j)) and u[i, j] < self.edge_probability}
        return tuple(sorted(tree | more))

    def prepare(self, model: Model) -> NetworkPlan:
        return NetworkPlan(model.A[None], float(np.sqrt(self.noise_var)))

    def model(self, sensor: Sensor, controller: Controller) -> Model:
        """Return the public model. Raise InputError, naming the agents, where it is not detectable."""
        n, (names, C, R) = self.states, sensor.matrices(self)
        model = Model(
            A=self.matrix(), B=np.zeros((n, 0)), c=np.zeros(n), C=C, Q=self.process_var * np.eye(n), R=R, graph=self.hears(), dt=self.dt,
            sensors=names,
        )  # fmt: skip
        require_detectable(model, "plant sensor_network")
        return model

    def start(self, plan: NetworkPlan, draws: Draws) -> NetworkState:
        return NetworkState(self.initial_sd * draws.normal((self.states,)))

    def prior(self, plan: NetworkPlan, state: NetworkState, held: Array, draws: Draws) -> Prior:
        shape = (len(state.x), self.agents, self.states)
        return Prior(num.zeros(shape), num.full((*shape, self.states), self.prior_var * np.eye(self.states)))

    def step(self, plan: NetworkPlan, state: NetworkState, u: Array, exo: Array, draws: Draws) -> NetworkState:
        x = num.apply(plan.A, state.x[:, None])[:, 0]
        return NetworkState(x + plan.noise_sd * draws.normal((self.states,)) if plan.noise_sd else x)

    def known(self, plan: NetworkPlan, u: Array, exo: Array, state: NetworkState) -> Array:
        return u

    def truth(self, plan: NetworkPlan, state: NetworkState, held: Array) -> Array:
        return np.broadcast_to(state.x[:, None], (len(state.x), self.agents, self.states))

    def odometry(self, plan: NetworkPlan, state: NetworkState) -> Array:
        return np.zeros((len(state.x), self.agents, 0))

    def lead_speed_of(self, state: NetworkState) -> Array:
        return np.zeros(len(state.x))

    def scene(self, plan: NetworkPlan, state: NetworkState) -> Scene:
        """Return an empty road: nothing drives."""
        still = num.zeros((len(state.x), self.agents))
        nobody = num.full(still.shape, np.inf)
        return Scene(nobody, still, still, still, nobody, still, still)

    def v2v(self, plan: NetworkPlan, state: NetworkState) -> Array:
        return np.zeros((len(state.x), self.agents, 0))


class LinearPlan(NamedTuple):
    C: Array  # (N, q, n)
    sd: float


@register("sensor", "linear_sensors", reference="Dutta 2018, (5.2) and section 5.4")
@dataclass(frozen=True)
class LinearSensors:
    """Every agent's readings y_i = C_i x, with random C_i."""

    sensors: Size = param(14, "readings of each agent")
    pattern: Literal["gaussian", "modes"] = param(
        "gaussian", "C_i: gaussian: everybody sees something of every state; modes: each agent sees some modes of a modal system only"
    )
    modes_seen: PositiveCount = param(1, "pattern modes: how many of the system's modes each agent sees")
    sensor_seed: Count = param(0, "seed of the C_i")
    noise_var: Variance = param(0.0, "variance of the sensors' noise; 0, as in the thesis, is none")
    told_var: PositiveVariance = param(1.0, "noise variance that the defence assumes (Sigma_v)")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        where = "sensor linear_sensors"
        if not isinstance(plant, SensorNetwork):
            raise InputError(where, type(plant).__name__, "the plant sensor_network")
        agents, states = plant.size
        C = constants("linear_sensors", self.sensor_seed).normal((agents, self.sensors, states))[0]
        if self.pattern == "modes":
            C = self._of_modes(plant, C)
        names = tuple(f"y{s + 1}" for s in range(self.sensors))
        return names, C, np.repeat(self.told_var * np.eye(self.sensors)[None], agents, axis=0)

    def _of_modes(self, plant: SensorNetwork, raw: Array) -> Array:
        """Return C_i that see modes i, i + N, ... and those after them, as many as `modes_seen`."""
        places, where = blocks(plant.states), "sensor linear_sensors"
        if plant.system != "modal":
            raise InputError(f"{where}.pattern", self.pattern, "the plant's system to be modal")
        if self.modes_seen > len(places):
            raise InputError(f"{where}.modes_seen", self.modes_seen, f"at most the {len(places)} modes of {plant.states} states")
        T, _ = modes(plant.states, plant.system_seed)
        out = np.zeros_like(raw)
        for i in range(plant.agents):
            for step in range(self.modes_seen):
                place = places[(i + step) % len(places)]
                out[i] += num.product(raw[i][:, place], T.T[place])
        return out

    def prepare(self, model: Model) -> LinearPlan:
        return LinearPlan(model.C, float(np.sqrt(self.noise_var)))

    def measure(self, plan: LinearPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        y = num.apply(plan.C, truth)
        if plan.sd:
            y = y + plan.sd * draws.normal(y.shape[1:])
        return Received(y, num.full(y.shape, True, bool), num.zeros(y.shape[:2]))


@register("controller", "none")
@dataclass(frozen=True)
class NoControl:
    """Controls nothing: for systems that are watched and not driven."""

    def prepare(self, model: Model) -> int:
        if model.actuators:
            raise InputError("controller none", list(model.actuators), "a plant without actuators")
        return model.agents

    def start(self, plan: int, batch: int) -> None:
        return None

    def step(self, plan: int, state: None, estimate: Estimate, v2v: Array, odometry: Array) -> tuple[None, Array]:
        return None, np.zeros((len(v2v), plan, 0))

    def held(self, plan: int, state: None, batch: int) -> Array:
        return np.zeros((batch, plan, 0))

    def desired_gap(self, speed: Array) -> Array:
        return np.zeros_like(speed)
