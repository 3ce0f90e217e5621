"""The FMCW radar as a sensor: its readings of the car ahead, without an attack and under a jammer or a late echo."""

from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Air, Array, Model, Received, Sized, param
from tailgate.core.draws import Draws
from tailgate.core.quantities import Gap, PositiveSpread, Step, check_order
from tailgate.core.registry import register
from tailgate.envs.controllers.radar_car import STATES
from tailgate.envs.sensors import fmcw_signal
from tailgate.envs.sensors.fmcw import Link, challenge_samples, heard_energy, outlier_probability, tone_sd

Span = Annotated[tuple[Gap, Gap], Field(min_length=2, max_length=2)]
NEAREST = 0.1  # closer than this [m] the radar equation means nothing: powers are those at this distance
UNIFORM, SAMPLED = 1, 2  # tags of the draws


class RadarSensorPlan(NamedTuple):
    C: Array  # (2, n)
    sd: Array  # (2,) of the target's extent
    echo: float  # the echo's power over the receiver's noise, from 1 m
    jam: float  # a jammer's power in the IF samples over the receiver's noise, per W and from 1 m
    challenge: int  # samples of a challenge


@register("sensor", "fmcw_radar", reference="Dutta 2018, section 3.3.1; (3.5)-(3.11)")
@dataclass(frozen=True)
class FmcwRadar(Link):
    """A 77 GHz long-range radar: distance and relative speed of the car ahead, by two beats (3.5)-(3.8).

    An answered echo masks the true one at the true one's power, and is late by the attacker's delay. A muted receiver hears what is
    radiated for min(reaction, window)/window of the challenge.
    """

    range_sd: PositiveSpread = param(0.25, "standard deviation of the distance, from the target's extent [m]")
    speed_sd: PositiveSpread = param(0.1, "standard deviation of the relative speed, from the target's extent [m/s]")
    reach: Span = param((2.0, 200.0), "least and largest distance that it reports [m]")
    window: Step = param(0.1, "duration of a challenge, in which the energy heard is measured [s]")
    path: Literal["closed_form", "signal"] = param(
        "closed_form", "closed_form: beats with the errors of root-MUSIC drawn; signal: IF samples simulated and root-MUSIC run on them"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_order("sensor fmcw_radar.reach", self.reach, strict=True)

    @property
    def challenge(self) -> int:
        return challenge_samples(self.window, self.bandwidth)

    def matrices(self, plant: Sized) -> tuple[tuple[str, ...], Array, Array]:
        if plant.size != (1, STATES):
            raise InputError("sensor fmcw_radar", type(plant).__name__, "the plant radar_following")
        if self.window > getattr(plant, "dt", np.inf):
            raise InputError("sensor fmcw_radar.window", self.window, "a challenge no longer than the plant's step dt")
        C = np.eye(STATES)[None, :2]
        return ("distance", "relative_speed"), C, np.diag([self.range_sd**2, self.speed_sd**2])[None]

    def prepare(self, model: Model) -> RadarSensorPlan:
        noise = self.noise_power
        echo, jam = float(self.echo_power(1.0)) / noise, self.passed * float(self.jam_power(1.0, 1.0)) / noise
        sd = np.array([self.range_sd, self.speed_sd])
        return RadarSensorPlan(model.C[0], sd, echo, jam, self.challenge)

    def measure(self, plan: RadarSensorPlan, truth: Array, probe: Array, draws: Draws) -> Received:
        quiet = num.zeros(probe.shape)
        return self.disturbed(plan, truth, probe, draws, Air(quiet, quiet, np.inf))

    def disturbed(self, plan: RadarSensorPlan, truth: Array, probe: Array, draws: Draws, air: Air) -> Received:
        z = draws.normal((1, 7))
        true = num.matvec(plan.C, truth)
        near = np.maximum(true[..., 0], NEAREST)
        square = near * near
        jam, tone = plan.jam * air.power / square, plan.echo / (square * square)
        target = true + plan.sd * z[..., :2]
        d, dv = target[..., 0], target[..., 1]
        up, down = self.beats(d + air.delay, dv)
        seen = probe & self.within_band(up, down)  # else the IF filter leaves nothing of the echo
        if self.path == "signal":
            noise = draws.normal((1, 2, self.samples, 2), tag=SAMPLED)
            y = num.stack(fmcw_signal.read(self, d, dv, air.delay, tone, 1.0 + jam, noise))
        else:
            x = self.samples * tone / (1.0 + jam)
            y = num.stack(self.range_speed(*self._estimated(up, down, x, z[..., 2:4], draws.uniform((1, 4), tag=UNIFORM))))
        valid = num.full(y.shape, True, bool)
        valid &= (seen & (y[..., 0] >= self.reach[0]) & (y[..., 0] <= self.reach[1]))[..., None]
        return Received(np.where(valid, y, 0.0), valid, self._energy(plan, probe, jam, tone, air, z[..., 4:7]))

    def _estimated(self, up: Array, down: Array, x: Array, z: Array, u: Array) -> tuple[Array, Array]:
        """Return beats [Hz] as root-MUSIC estimates them at the SNR x after integration, from normals z (B, N, 2), uniforms u (B, N, 4)."""
        sd, lost = tone_sd(self, x), outlier_probability(x)
        up = np.where(u[..., 0] < lost, self.lowest + self.bandwidth * u[..., 1], up + sd * z[..., 0])
        down = np.where(u[..., 2] < lost, self.lowest + self.bandwidth * u[..., 3], down + sd * z[..., 1])
        return up, down

    def heard(self, reaction: float) -> tuple[float, float]:
        """Return the samples of a challenge in which an attacker with this reaction time [s] is heard, and its share of power in them."""
        part = min(reaction, self.window) / self.window * self.challenge  # samples, not always a whole number
        whole = max(1.0, float(np.ceil(part)))
        return whole, part / whole

    def _energy(self, plan: RadarSensorPlan, probe: Array, jam: Array, tone: Array, air: Air, z: Array) -> Array:
        """Return the mean power (B, N) over the receiver's noise, of a challenge; 0 where the probe is sent.

        There it would be the echo's, of a target that does not fluctuate: a distance by the radar equation that no late echo changes.
        """
        attacked = (air.power > 0.0) | (air.delay > 0.0)
        whole, share = self.heard(air.reaction)
        heard, scale = np.where(attacked, whole, float(plan.challenge)), np.where(attacked, share, 1.0)
        tone = np.where(air.delay > 0.0, tone, 0.0)
        return np.where(probe, 0.0, heard_energy(plan.challenge, heard, jam * scale, tone * scale, z))
