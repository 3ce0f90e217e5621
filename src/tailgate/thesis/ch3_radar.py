"""The radar's equations against a simulated chirp: signs, the late echo, and what a jammer stronger than the echo does (section 3.3)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from tailgate.core import Array
from tailgate.core.draws import constants
from tailgate.envs.sensors import fmcw_signal
from tailgate.envs.sensors.fmcw import Link

from . import ch3_figures
from .claims import Claim, Drawing, Part, Table, verdict
from .runs import median

RANGES = (10.0, 30.0, 60.0, 100.0, 150.0, 200.0)
POWER = 0.1  # the thesis's jammer P_J [W]
FAR = 5.0  # a reading that is off by more than this counts as denied [m]
SMALL = 1.0  # [m^2] of a cross-section: the thesis gives none
LINKS = {"fills the band": Link(), "follows the chirp": Link(in_band=1.0)}  # what the jammer's noise does


def parts(seeds: int) -> Iterator[Part]:
    """Return the claims and the table on the signal, and last the drawing."""
    yield from (_signs(), _late())
    yield from _denial(seeds)


def _read(link: Link, d: float, dv: float, count: int, late: float = 0.0, jam: float = 0.0, seed: int = 0) -> tuple[Array, Array]:
    """Return (count,) distances [m] and relative speeds [m/s] by the signal path, the jammer radiating `jam` [W]."""
    one = np.ones((count, 1))
    noise = 1.0 + link.passed * link.jam_power(d, jam) / link.noise_power
    snr = link.echo_power(d) / link.noise_power
    normals = constants("reproduce ch3", seed).normal((count, 2, link.samples, 2))[0][:, None]
    x, v = fmcw_signal.read(link, d * one, dv * one, late * one, snr * one, noise * one, normals)
    return x[:, 0], v[:, 0]


def _signs() -> Claim:
    found, right = {}, []
    for dv in (-20.0, 20.0):
        speed = median(_read(Link(), 60.0, dv, 50)[1])
        up, down = (float(v) for v in Link().beats(np.array(60.0), np.array(dv)))
        found[f"dv = v_leader - v_follower = {dv:+g} m/s"] = {
            "by (3.8) with the corrected sign [m/s]": round(speed, 2), "by (3.8) as printed [m/s]": round(-speed, 2),
            "fb+ [Hz]": round(up), "fb- [Hz]": round(down),
        }  # fmt: skip
        right.append(abs(speed - dv) < 0.2)
    return Claim(
        "3.3-signs", "fb+ = f_R - f_D, fb- = f_R + f_D, dv = lam (fb- - fb+)/4 for dv = v_L - v_F (3.5, 3.6, 3.8)", "as printed", found,
        verdict(not any(right), all(right)), "from the samples of a simulated chirp: the printed signs give the closing speed",
    )  # fmt: skip


def _late() -> Claim:
    clean, late = _read(Link(), 60.0, -3.0, 200), _read(Link(), 60.0, -3.0, 200, late=6.0)
    shift, speed = (median(b - a) for a, b in zip(clean, late, strict=True))
    return Claim(
        "3.3-late", "A late echo makes the car ahead appear farther away", "6 m",
        {"shift of the distance [m]": round(shift, 3), "shift of the relative speed [m/s]": round(speed, 3), "delay [ns]": 40.03},
        verdict(abs(shift - 6.0) < 0.05 and abs(speed) < 0.05, abs(shift) < 1.0),
        "time of flight in the simulated signal; both beats rise by 3002 Hz",
    )  # fmt: skip


def _denial(seeds: int) -> tuple[Claim, Table, Drawing]:
    rows, share = [], {name: np.zeros(len(RANGES)) for name in LINKS}
    for i, d in enumerate(RANGES):
        cells = [f"{d:g}", f"{float(Link().echo_power(d) / Link().jam_power(d, POWER)):.4f}"]
        for name, link in LINKS.items():
            x, _ = _read(link, d, 0.0, seeds, jam=POWER, seed=round(d))
            share[name][i] = (np.abs(x - d) > FAR).mean()
            gain = float(10.0 * np.log10(link.samples * link.snr(d, POWER)))
            cells += [f"{gain:.1f}", f"{100 * share[name][i]:.0f} %"]
        rows.append(tuple(cells))
    weak = Link(cross_section=SMALL)
    small = [float((np.abs(_read(weak, d, 0.0, seeds, jam=POWER, seed=round(d))[0] - d) > FAR).mean()) for d in RANGES]
    filled = [*share["fills the band"].tolist(), *small]
    claim = Claim(
        "3.3-ratio", "When Pr/PJ < 1 the radar starts receiving corrupted measurements (3.11)", "below 1",
        {
            "burn-through range [m]": round(Link().burn_through(POWER), 2),
            "readings that are off by more than 5 m": {
                name: {f"{d:g} m": v for d, v in zip(RANGES, values, strict=True)}
                for name, values in [*((k, v.tolist()) for k, v in share.items()), (f"fills the band, s = {SMALL:g} m^2", small)]
            },
        }, verdict(min(filled) > 0.5, max(filled) < 0.05),
        "signal path with root-MUSIC, s = 10 m^2 where none is given (the thesis has none): the ratio is below 1 at all these ranges, but "
        "IF filter and integration take most of a noise that fills 155 MHz; one that follows the chirp does deny service",
    )  # fmt: skip
    heads = ("range [m]", "Pr/PJ", "noise that fills the band: SNR [dB]", "denied", "noise that follows the chirp: SNR [dB]", "denied")
    title = "A jammer of 100 mW: ratio (3.11), SNR after integration, and readings off by more than 5 m"
    caption = "A jammer of 100 mW on the car ahead, whose echo is weaker than its noise at every range shown."
    drawing = Drawing("figure-jammer", caption, partial(ch3_figures.denial, np.array(RANGES), share))
    return claim, Table(title, heads, tuple(rows)), drawing
