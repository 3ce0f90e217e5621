"""The consensus law of di Bernardo, Salvi and Santini: each car agrees with its neighbours on positions and with the leader on the speed.

M. di Bernardo, A. Salvi and S. Santini, Distributed Consensus Strategy for Platooning of Vehicles in the Presence of Time-Varying
Heterogeneous Communication Delays, IEEE Transactions on Intelligent Transportation Systems 16 (2015) 102-112. Their terms that make up for
known communication delays are zero here, as nothing is delayed.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import Array, param
from tailgate.core.quantities import Gain
from tailgate.core.registry import register
from tailgate.envs.controllers.cacc import Column, Gains, Law, no_gains


@register(
    "controller", "consensus_cacc",
    reference="M. di Bernardo, A. Salvi, S. Santini, Distributed Consensus Strategy for Platooning of Vehicles, 2015",
)  # fmt: skip
@dataclass(frozen=True)
class Consensus(Law):
    """Second-order consensus over the cars that are heard, with the leader's speed as a reference.

        u_i = -b (v_i - v_0) - (k / D_i) sum_j (r_i - r_j + (i - j) (d_r + tau_h v_0)),        j over the D_i cars that i hears

    The positions' differences are sums of the gaps between. The headway is the leader's, not the own: the string shrinks as the leader
    brakes. Where each car hears cars ahead only, the loop is tau s^3 + s^2 + b s + k, stable for b > k tau. Without messages
    u_i = b (v_{i-1} - v_i) + k (d_i - d_r - tau_h v_i).
    """

    error_gains: ClassVar[tuple[str, ...]] = ("k",)
    rate_gains: ClassVar[tuple[str, ...]] = ("b",)

    b: Gain = param(0.8, "gain of the speed difference to the leader [1/s]")
    k: Gain = param(0.1, "gain of the mean position error among the neighbours [1/s^2]")
    leader: Literal["heard", "estimated"] = param(
        "heard", "the leader's speed is an estimate: heard: only where every car hears the leader's own one; estimated: in any topology"
    )

    def gains(self, graph: Array, headway: float, local: bool = False) -> Gains:
        cars = len(graph)
        if self.leader == "heard" and not graph[:, 0].all():
            wanted = "estimated, in a topology in which not everybody hears the leader"
            raise InputError("controller consensus_cacc.leader", self.leader, wanted)
        out = no_gains(cars, headway)
        for i in range(1, cars):
            row = out.K[i]
            row[Column.speed(i)] -= self.b
            row[Column.speed(i - 1 if local else 0)] += self.b
            near = [i - 1] if local else [j for j in np.flatnonzero(graph[i]).tolist() if j != i]
            share = self.k / len(near)
            for j in near:
                sign = 1.0 if j < i else -1.0
                for m in range(min(i, j) + 1, max(i, j) + 1):
                    row[Column.gap(m)] += sign * share
                row[Column.speed(i if local else 0)] -= share * (i - j) * headway
                out.k0[i] -= share * (i - j) * self.standstill
        return out
