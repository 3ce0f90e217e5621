"""Seven sensors that tell the same thing: car following where some sensors may be attacked and the others still suffice.

Radars, lidar and camera measure the gap d; the leader's message, which nobody attacks, has its position x_l. What a device reports is the
own position x_l - d. The leader sends what its rear radar measures (`v2v`), GNSS has the own position, the wheels have the speed:

    y = [x, x, x, x, x, v, x] + noise

(A, C without any four sensors) is observable, as a position is left; without six it need not be. Two attacked sensors can be corrected.
"""

from dataclasses import dataclass

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, Model, Received, Sized, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import PositiveSpread
from tailgate.core.registry import register
from tailgate.envs.sensors.odometry import OdometryPlan

DEVICES = ("gnss", "camera", "v2v", "radar_short", "radar_long", "wheels", "lidar")  # the raw car believes the last


@register("sensor", "redundant")
@dataclass(frozen=True)
class Redundant:
    """Own position from six devices and speed from the wheels, each with Gaussian noise; all of them can be attacked.

    The defaults are round numbers of the size that is usual for such devices. No device's data sheet was fitted.
    """

    radar_long: PositiveSpread = param(0.25, "long-range radar: the point that reflects wanders over the car ahead [m]")
    radar_short: PositiveSpread = param(0.5, "short-range radar: its wide beam meets several points at once [m]")
    lidar: PositiveSpread = param(0.1, "lidar: time of flight to a plate or a bumper [m]")
    camera: PositiveSpread = param(2.0, "camera: one pixel is 5 % of the width of a car at 40 m [m]")
    wheels: PositiveSpread = param(0.3, "wheel odometry: the tyre's radius is known to 1 %, at 30 m/s [m/s]")
    gnss: PositiveSpread = param(1.5, "satellite navigation: code phase with corrections [m]")
    v2v: PositiveSpread = param(0.7, "the leader's rear radar by message: a reading that may be 0.1 s old [m]")

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if plant.size != (1, 3):
            raise InputError("sensor redundant", type(plant).__name__, "a car-following plant: one follower, [x, v, a]")
        C = np.array([[0.0, 1.0, 0.0] if name == "wheels" else [1.0, 0.0, 0.0] for name in DEVICES])
        sd = self._sd()
        return DEVICES, C[None], np.diag(sd * sd)[None]

    def prepare(self, model: Model) -> OdometryPlan:
        return OdometryPlan(model.C[0], self._sd())

    def _sd(self) -> Array:
        return np.array([getattr(self, name) for name in DEVICES])

    def measure(self, plan: OdometryPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        """Return y = C x + v. `probe` does not apply: what the devices send is not modelled."""
        y = num.matvec(plan.C, truth) + plan.sd * draws.normal((1, len(plan.sd)))
        return Received(y, num.full(y.shape, True, bool), np.zeros(y.shape[:2]))
