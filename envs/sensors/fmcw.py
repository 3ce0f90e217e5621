"""Closed forms of the FMCW radar: beats, link budget, jammer, estimation error, and the energy detector of a silent receiver.

    f_R = 2 d Bs/(c Ts)     f_D = 2 dv/lam     fb+ = f_R + f_D     fb- = f_R - f_D                                      [Hz] (3.5), (3.6)
    d = c Ts (fb+ + fb-)/(4 Bs)                dv = lam (fb+ - fb-)/4              dv = v_leader - v_follower                (3.7), (3.8)
    Pr = Pt G^2 lam^2 s/((4 pi)^3 d^4 L)       PJ,rx = PJ GJ lam^2 G B/((4 pi)^2 d^2 BJ LJ)                             [W]  (3.9), (3.10)
    Pr/PJ,rx = Pt G s BJ LJ/(4 pi PJ GJ d^2 B L)                                                                            (3.11)

Erratum: with dv positive when the gap opens, the printed signs of (3.5), (3.6) and (3.8) give the closing speed; those above agree with a
simulated chirp (fmcw_signal.py).

A ratio (3.11) below 1 does not by itself deny service. The jammer must also beat the IF filter, which passes B_if/B of a noise that fills
the swept band (`in_band`). And it must beat the integration of the M samples of a sweep. The SNR after both decides:

    x = M Pr/(k T0 F B_if + in_band PJ,rx)
"""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError
from tailgate.core import Array, param
from tailgate.core.quantities import Decibel

LIGHT = 299_792_458.0  # speed of light c [m/s]
KT0 = 1.380649e-23 * 290.0  # thermal noise density at the reference temperature of a noise figure [W/Hz]
_LN10 = 2.302585092994046

Share = Annotated[float, Field(gt=0, le=1)]
Radio = Annotated[float, Field(ge=1e-9, le=1e15, allow_inf_nan=False)]  # a value of a radar or a jammer [its unit]


def from_db(value: float) -> float:
    """Return 10^(value/10)."""
    return float(num.exp(value * (_LN10 / 10.0)))


# The closed forms, elementwise.


def beats(d: Array, dv: Array, per_metre: float, per_speed: float) -> tuple[Array, Array]:
    """Return fb+ and fb- [Hz] of a target at d [m] with relative speed dv [m/s]: (3.5), (3.6)."""
    by_range, by_speed = per_metre * d, per_speed * dv
    return by_range + by_speed, by_range - by_speed


def range_speed(up: Array, down: Array, per_metre: float, per_speed: float) -> tuple[Array, Array]:
    """Return d [m] and dv [m/s] of the beats fb+ and fb- [Hz]: (3.7), (3.8)."""
    return 0.5 * (up + down) / per_metre, 0.5 * (up - down) / per_speed


def passes(up: Array, down: Array, low: float, high: float) -> Array:
    """Return bool: the IF filter passes both beats [Hz]."""
    out: Array = (np.minimum(up, down) >= low) & (np.maximum(up, down) < high)
    return out


@dataclass(frozen=True)
class Link:
    """A triangular FMCW radar, its target, and a jammer that the target carries (self-screening)."""

    wavelength: Radio = param(3.89e-3, "wavelength lam of the 77 GHz carrier [m]")
    sweep: Radio = param(150e6, "swept bandwidth Bs of one sweep [Hz]")
    sweep_time: Radio = param(2e-3, "duration Ts of one sweep, up or down [s]")
    power: Radio = param(10e-3, "transmitted power Pt [W]")
    gain_db: Decibel = param(28.0, "gain G of the antenna [dBi]")
    loss_db: Decibel = param(0.10, "losses L of the radar [dB]")
    cross_section: Radio = param(10.0, "radar cross-section s of the car ahead, which does not fluctuate [m^2]")
    bandwidth: Radio = param(256e3, "IF bandwidth B_if, which is the rate of the complex samples [Hz]")
    noise_figure_db: Decibel = param(12.0, "noise figure F of the receiver [dB]")
    operating_band: Radio = param(150e6, "operating bandwidth B of the radar, as a jammer sees it [Hz]")
    jam_gain_db: Decibel = param(10.0, "gain GJ of the jammer's antenna [dBi]")
    jam_band: Radio = param(155e6, "bandwidth BJ of the jammer [Hz]")
    jam_loss_db: Decibel = param(0.10, "losses LJ of the jammer [dB]")
    in_band: Share | None = param(
        None, "share of the jammer's received power that the IF filter passes; none: B_if/B, of noise over all B; 1: it follows the chirp"
    )

    def __post_init__(self) -> None:
        if self.samples < 64:
            raise InputError("sensor fmcw_radar.bandwidth", self.bandwidth, f"at least 64 samples a sweep, {64.0 / self.sweep_time:g} Hz")

    @property
    def slope(self) -> float:
        """Chirp rate Bs/Ts [Hz/s]."""
        return self.sweep / self.sweep_time

    @property
    def hz_per_metre(self) -> float:
        return 2.0 * self.slope / LIGHT

    @property
    def hz_per_speed(self) -> float:
        """Shift of either beat per m/s of relative speed [Hz/(m/s)]."""
        return 2.0 / self.wavelength

    @property
    def samples(self) -> int:
        """Complex IF samples M of one sweep."""
        return round(self.bandwidth * self.sweep_time)

    @property
    def lowest(self) -> float:
        """Least beat that the receiver's band holds [Hz]; the band reaches from here over B_if, for beats are mostly positive."""
        return -0.25 * self.bandwidth

    @property
    def noise_power(self) -> float:
        """Power of the receiver's noise, k T0 F B_if [W]."""
        return KT0 * from_db(self.noise_figure_db) * self.bandwidth

    @property
    def passed(self) -> float:
        """Share of the received jammer's power that reaches the IF samples."""
        return min(1.0, self.bandwidth / self.operating_band) if self.in_band is None else self.in_band

    @property
    def highest(self) -> float:
        return self.lowest + self.bandwidth

    def beats(self, d: Array, dv: Array) -> tuple[Array, Array]:
        """Return fb+ and fb- [Hz] of a target at d [m] with relative speed dv [m/s]: (3.5), (3.6)."""
        return beats(d, dv, self.hz_per_metre, self.hz_per_speed)

    def range_speed(self, up: Array, down: Array) -> tuple[Array, Array]:
        """Return d [m] and dv [m/s] of the beats fb+ and fb- [Hz]: (3.7), (3.8)."""
        return range_speed(up, down, self.hz_per_metre, self.hz_per_speed)

    def within_band(self, up: Array, down: Array) -> Array:
        """Return bool: the IF filter passes both beats [Hz]."""
        return np.asarray(passes(up, down, self.lowest, self.highest))

    def echo_power(self, d: Array | float) -> Array:
        """Return Pr [W] of the echo from d [m]: (3.9)."""
        gain, four_pi = from_db(self.gain_db), 4.0 * math.pi
        at_1m = self.power * gain * gain * self.wavelength * self.wavelength * self.cross_section
        at_1m /= four_pi * four_pi * four_pi * from_db(self.loss_db)
        square = np.square(d)
        return np.asarray(at_1m / (square * square))

    def jam_power(self, d: Array | float, radiated: Array | float) -> Array:
        """Return PJ,rx [W] in the operating band B, of a jammer at d [m] that radiates PJ [W]: (3.10).

        `passed` of it reaches the IF samples.
        """
        four_pi = 4.0 * math.pi
        at_1m = from_db(self.jam_gain_db) * self.wavelength * self.wavelength * from_db(self.gain_db) * self.operating_band
        at_1m /= four_pi * four_pi * self.jam_band * from_db(self.jam_loss_db)
        return np.asarray(at_1m * radiated / np.square(d))

    def burn_through(self, radiated: float) -> float:
        """Return the distance d_burn [m] at which echo and jammer, of PJ [W], are received equally strong: (3.11) = 1."""
        square = self.power * from_db(self.gain_db) * self.cross_section * self.jam_band * from_db(self.jam_loss_db)
        square /= 4.0 * math.pi * radiated * from_db(self.jam_gain_db) * self.operating_band * from_db(self.loss_db)
        return math.sqrt(square)

    def snr(self, d: Array | float, radiated: Array | float = 0.0) -> Array:
        """Return the echo over all noise in one IF sample, for a target at d [m] whose jammer radiates PJ [W]."""
        return np.asarray(self.echo_power(d) / (self.noise_power + self.passed * self.jam_power(d, radiated)))


# Root-MUSIC's error against the SNR x after integration, fitted to the signal path at 512 samples a sweep (benchmarks/results/radar_path).
_EFFICIENCY = (1.42, 21.6, 222.0)  # variance over the Cramer-Rao bound: e0 (1 + e1/x + e2/x^2)
_OUTLIER = (3.96, 1.08, 0.207)  # odds of an outlier: exp(o0 - o1 ln x - o2 x)
_CELL = 4.0  # an outlier misses by more than _CELL/M cycles per sample, the resolution of a window of M/4 samples


class Tone(NamedTuple):
    """The constants from which the error of a beat follows."""

    bound: float  # the Cramer-Rao bound at x = 1, of a beat in units of B_if
    widest: float  # variance of a beat that lies anywhere within a cell, in these units


def tone_of(link: Link) -> Tone:
    """Return 6/((2 pi)^2 (M^2 - 1)), of one tone in M samples (Rife and Boorstyn 1974)."""
    cell = _CELL / link.samples
    return Tone(6.0 / (4.0 * math.pi * math.pi * (link.samples * link.samples - 1)), cell * cell / 3.0)


@np.errstate(over="ignore", divide="ignore")  # at no SNR it is the widest
def tone_variance(x: Array, bound: float, widest: float) -> Array:
    """Return the variance over B_if^2 of a beat that is no outlier, at the SNR x after integration, a multiple of the bound."""
    inverse, (e0, e1, e2) = 1.0 / x, _EFFICIENCY
    variance = bound * inverse * e0 * (1.0 + inverse * (e1 + inverse * e2))
    out: Array = np.minimum(variance, widest)
    return out


def outlier_odds(x: Array, log_x: Array) -> Array:
    """Return the logarithm of the odds that a beat is no outlier, cut where nothing would change, elementwise."""
    o0, o1, o2 = _OUTLIER
    out: Array = np.minimum(o1 * log_x + o2 * x - o0, 700.0)
    return out


def tone_sd(link: Link, x: Array) -> Array:
    """Return the standard deviation [Hz] of a beat that is no outlier, at the SNR x after integration."""
    return np.asarray(link.bandwidth * np.sqrt(tone_variance(x, *tone_of(link))))


def outlier_probability(x: Array) -> Array:
    """Return the probability that the largest root is the noise's, at the SNR x after integration; the beat is then uniform in the band."""
    return np.asarray(1.0 / (1.0 + num.exp(outlier_odds(x, num.log(x)))))


def challenge_samples(window: float, bandwidth: float) -> int:
    """Return the complex IF samples N_c of a challenge of `window` [s]."""
    return max(1, round(window * bandwidth))


def false_alarm_threshold(p_fa: float, samples: int) -> float:
    """Return the mean power E over the receiver's noise that noise alone exceeds with probability p_fa.

    2 N_c E is chi-square with 2 N_c degrees of freedom.
    """
    from scipy import special  # not loaded where no radar is

    return float(special.chdtri(2 * samples, p_fa) / (2 * samples))


def miss_probability(threshold: float, samples: int, jam: float = 0.0, tone: float = 0.0) -> float:
    """Return the probability that a challenge stays at or below the threshold, under noise of power `jam` and an answer of power `tone`.

    Both are over the receiver's noise, and last for the whole challenge: 2 N_c E/(1 + jam) is chi-square with 2 N_c degrees of freedom and
    noncentrality 2 N_c tone/(1 + jam). For an answer that stops after a share r of it, tone = r times its power is exact.
    """
    from scipy import special

    scale = 2.0 * samples / (1.0 + jam)
    if tone == 0.0:
        return float(special.chdtr(2 * samples, scale * threshold))
    return float(special.chndtr(scale * threshold, 2 * samples, scale * tone))


def heard_energy(samples: int, heard: Array, jam: Array, tone: Array, z: Array) -> Array:
    """Return the mean power E (B, N) over the receiver's noise of N_c complex samples.

    `heard` (B, N), at least 1, of them carry what is radiated. jam and tone (B, N): powers over the noise in those samples. z (B, N, 3):
    standard normals.
    """
    return np.asarray(mean_power(samples, heard, jam, tone, z[..., 0], z[..., 1], z[..., 2]))


def mean_power(samples: int, heard: Array, jam: Array, tone: Array, z0: Array, z1: Array, z2: Array) -> Array:
    """Return what `heard_energy` returns, elementwise.

    The tone adds to the part of the noise that is in phase with it, one normal. The other 2 N_c - 1 are two gamma variables by Wilson and
    Hilferty's cube (1931).
    """
    noise, rest = 1.0 + jam, samples - heard
    in_phase = np.sqrt(0.5) * z0 + np.sqrt(heard * tone / noise)
    loud = noise * (gamma(heard - 0.5, z1) + in_phase * in_phase)
    quiet = np.where(rest > 0.0, gamma(np.maximum(rest, 1.0), z2), 0.0)
    out: Array = (loud + quiet) / samples
    return out


def gamma(shape: Array, z: Array) -> Array:
    """Return a gamma variable of scale 1 from a standard normal, elementwise: Wilson and Hilferty's cube."""
    root = np.maximum(1.0 - 1.0 / (9.0 * shape) + z / (3.0 * np.sqrt(shape)), 0.0)
    out: Array = shape * (root * root * root)
    return out
