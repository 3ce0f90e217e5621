"""The CACC law of Ploeg, van de Wouw and Nijmeijer: the predecessor's command fed forward through the spacing policy's own lag.

J. Ploeg, N. van de Wouw and H. Nijmeijer, Lp String Stability of Cascaded Systems: Application to Vehicle Platooning, IEEE Transactions on
Control Systems Technology 22 (2014) 786-793.
"""

from dataclasses import dataclass
from typing import ClassVar

from tailgate.core import Array, param
from tailgate.core.quantities import Gain
from tailgate.core.registry import register
from tailgate.envs.controllers.cacc import Column, Gains, Law, no_gains, spacing


@register("controller", "ploeg_cacc", reference="J. Ploeg, N. van de Wouw, H. Nijmeijer, Lp String Stability of Cascaded Systems, 2014")
@dataclass(frozen=True)
class Ploeg(Law):
    """The command is itself a state: it follows the predecessor's command with the time headway as its lag.

        tau_h u_i' = -u_i + kp e_i + kd e_i' + u_{i-1}          e_i = d_i - d_r - tau_h v_i          f_i = u_i

    With the message a car passes on exactly 1 / (1 + tau_h s) of its predecessor's motion. The loop on e_i, tau s^3 + s^2 + kd s + kp
    whatever the headway, is stable for kd > kp tau. Without the message a car drives on u_i = local_kp e_i + local_kd e_i'. With the gains
    of the loop that has the message, cars that fall back would amplify, and collide behind a leader that brakes.
    """

    error_gains: ClassVar[tuple[str, ...]] = ("kp", "local_kp")
    rate_gains: ClassVar[tuple[str, ...]] = ("kd", "local_kd")

    kp: Gain = param(0.1, "gain of the spacing error [1/s^2]")
    kd: Gain = param(0.5, "gain of its rate [1/s]")
    local_kp: Gain = param(0.5, "gain of the spacing error without messages; string stable from 2 / tau_h^2 on [1/s^2]")
    local_kd: Gain = param(1.0, "gain of its rate without messages [1/s]")

    def gains(self, graph: Array, headway: float, local: bool = False) -> Gains:
        out = no_gains(len(graph), headway)
        for i in range(1, len(graph)):
            spacing(out.G, i, self.kp, self.kd, headway)  # f goes on, so that a car that hears again does not start from nothing
            out.g0[i] = -self.kp * self.standstill
            if local:
                spacing(out.K, i, self.local_kp, self.local_kd, headway)
                out.k0[i] = -self.local_kp * self.standstill
            else:
                out.K[i, Column.controller(i)] = out.V[i, 2] = 1.0
        return out
