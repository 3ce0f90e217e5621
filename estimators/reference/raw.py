"""No defence: the measurement itself is the estimate."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import NotApplicable
from tailgate.core import Array, Estimate, Mode, Model, Prior, Received
from tailgate.core.draws import Draws
from tailgate.core.registry import register


class Reading(NamedTuple):
    """An index table of who learns which state from whose sensor: four arrays of the same length, no state of an agent twice."""

    agent: Array
    state: Array
    teller: Array
    sensor: Array


class RawPlan(NamedTuple):
    rounds: tuple[Reading, ...]
    inputs: Array  # (n, m) B in the rows of the states that the known input alone decides, else 0
    by_input: Array  # (n,) bool: these states


class RawState(NamedTuple):
    x: Array  # (B, N, n) the last values


def readings(model: Model) -> tuple[Reading, ...]:
    """Return what each agent reads and hears, in rounds.

    Where two sensors read the same state, the later round counts, the own sensors last. A late reading, of a state that only keeps what
    another was, is taken for that other one.

    Raises NotApplicable where a sensor does not read one state directly.
    """
    if not (np.isin(model.C, (0.0, 1.0)).all() and (np.count_nonzero(model.C, axis=2) == 1).all()):
        raise NotApplicable("defence none", "this sensor matrix", "sensors that each read one state directly")
    source = [_copied(model, column) for column in range(model.states)]
    state = np.array(source)[np.argmax(model.C, axis=2)]
    rounds: list[list[tuple[int, int, int, int]]] = []
    for i in range(model.agents):
        told: dict[int, int] = {}  # how often each state was read
        tellers = [j for j in np.flatnonzero(model.graph[i]).tolist() if j != i]
        for j in (*tellers, i):
            for s, column in enumerate(state[j].tolist()):
                turn = told[column] = told.get(column, -1) + 1
                if turn == len(rounds):
                    rounds.append([])
                rounds[turn].append((i, column, j, s))
    return tuple(Reading(*np.array(each).T) for each in rounds)


def _copied(model: Model, column: int) -> int:
    """Return the state whose earlier value a state is; itself for most."""
    for _ in range(model.states):
        row = model.A[column]
        if np.count_nonzero(row) != 1 or row.max() != 1.0 or row[column] or model.B[column].any() or model.c[column]:
            return column
        column = int(np.argmax(row))
    return column


@register("defence", "none")
@dataclass(frozen=True)
class Raw:
    """Believes the sensors, its own and those that it hears of: what they read is the state; one that nobody reads keeps its prior.

    A state that the known input alone decides, such as a speed by odometry, follows that input.
    """

    def prepare(self, model: Model) -> RawPlan:
        by_input = np.asarray(~model.A.any(axis=1) & model.B.any(axis=1))
        return RawPlan(readings(model), model.B * by_input[:, None], by_input)

    def start(self, plan: RawPlan, prior: Prior) -> RawState:
        return RawState(prior.mean)

    def step(
        self, plan: RawPlan, state: RawState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[RawState, Estimate]:
        x = state.x.copy(order="K")
        if plan.by_input.any():
            x = np.where(plan.by_input, num.matvec(plan.inputs, known_u), x)
        for agent, column, teller, sensor in plan.rounds:
            there = received.valid[:, teller, sensor]
            x[:, agent, column] = np.where(there, received.y[:, teller, sensor], x[:, agent, column])
        score = np.zeros(x.shape[:2])
        quiet = np.zeros(x.shape[:2], bool)
        return RawState(x), Estimate(x, score, quiet, num.full(score.shape, Mode.NORMAL, np.int8), ~quiet)
