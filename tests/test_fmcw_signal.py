"""The radar's signal: a chirp and its echo, root-MUSIC, and the closed-form path that draws the same errors."""

import dataclasses
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import tailgate
from tailgate.core.draws import keys
from tailgate.core.scenario import load_scenario
from tailgate.envs import FmcwRadar
from tailgate.envs.sensors import fmcw, fmcw_signal
from tailgate.envs.sensors.fmcw_signal import read, root_music, samples
from tailgate.play.trace import rollout

from .readings import sense

LINK = fmcw.Link()
SHARP = FmcwRadar(range_sd=1e-9, speed_sd=1e-9, reach=(1e-3, 1e6))  # the target is a point: what is left is the estimation's error
NORMAL = 3.2905  # 99.9 % two-sided


def noise(shape, seed=0):
    pair = np.random.default_rng(seed).standard_normal((2, *shape))
    return (pair[0] + 1j * pair[1]) * np.sqrt(0.5)


@pytest.mark.parametrize(("d", "dv", "late"), [(100.0, 20.0, 0.0), (100.0, -20.0, 0.0), (3.0, -8.0, 0.0), (60.0, 5.0, 6.0), (200.0, 60.0, 0.0)])
def test_a_simulated_chirp_has_the_beats_of_the_closed_form(d, dv, late):
    """Up: f_R + f_D, down: f_R - f_D, with dv positive when the gap opens; a negative beat is read as one."""
    up, down = LINK.beats(d + late, dv)
    for side, beat in ((1.0, up), (-1.0, down)):
        found = root_music(samples(LINK, d, dv, late, side)) * LINK.bandwidth
        off = (found - beat + 0.5 * LINK.bandwidth) % LINK.bandwidth - 0.5 * LINK.bandwidth  # a frequency of samples is known up to their rate
        assert abs(off) < 0.2


def test_the_sign_of_the_doppler_shift():
    """An opening gap, dv > 0, raises the beat of the rising chirp by 2 dv/lam: the phase of the simulated samples turns faster."""
    still, opening = (np.unwrap(np.angle(samples(LINK, 50.0, dv))) for dv in (0.0, 10.0))
    faster = (opening[-1] - opening[0] - still[-1] + still[0]) / (2 * np.pi) / (511 / LINK.bandwidth)
    assert faster == pytest.approx(2 * 10.0 / LINK.wavelength, rel=1e-4)


def test_six_metres_late_is_3002_hz_on_both_beats_of_the_signal():
    """40.03 ns more time of flight: both beats move alike, so that the relative speed stays."""
    for side in (1.0, -1.0):
        late, true = (root_music(samples(LINK, 60.0, -3.0, extra, side)) * LINK.bandwidth for extra in (6.0, 0.0))
        assert late - true == pytest.approx(3002.08, abs=0.01)


@pytest.mark.parametrize("d, dv", [(2.5, 0.0), (50.0, -30.0), (150.0, 30.0), (199.0, 59.0)])
def test_a_noise_free_sweep_gives_distance_and_speed(d, dv):
    """Also where the beat of a fast target is negative, or above half the sampling rate; the motion between the sweeps is taken out."""
    grid = np.full((1, 1), 1.0)
    distance, speed = read(LINK, d * grid, dv * grid, 0.0 * grid, grid, 0.0 * grid, np.zeros((1, 1, 2, 512, 2)))
    assert distance[0, 0] == pytest.approx(d, abs=1e-3) and speed[0, 0] == pytest.approx(dv, abs=1e-3)


def exhaustive(x, m):
    """Root-MUSIC by the book: every eigenvector, every root of the polynomial, the one nearest to the circle from inside."""
    windows = np.lib.stride_tricks.sliding_window_view(x, m)
    R = windows.T @ windows.conj()
    basis = np.linalg.eigh(R + R[::-1, ::-1].conj())[1][:, :-1]
    projector = basis @ basis.conj().T
    roots = np.roots([np.trace(projector, offset) for offset in range(m - 1, -m, -1)])
    inside = roots[np.abs(roots) <= 1.0]
    return np.angle(inside[np.argmax(np.abs(inside))]) / (2 * np.pi)


@pytest.mark.parametrize("db", [30.0, 3.0, -3.0])
def test_root_music_is_the_books(db):
    """Against numpy's eigenvectors and roots, on 128 samples, the weakest tone at 18 dB after integration."""
    for i in range(20):
        f = -0.45 + 0.045 * i
        x = 10 ** (db / 20) * np.exp(2j * np.pi * f * np.arange(128)) + noise((128,), seed=i)
        assert root_music(x) == pytest.approx(exhaustive(x, 32), abs=1e-9)


@pytest.mark.parametrize("count", [64, 67, 512])
def test_root_music_of_many_is_that_of_each(same_bits, count):
    """A row's frequency does not depend on its companions: strong and weak tones and silence, more rows than are computed at once."""
    size = np.concatenate([np.geomspace(0.05, 30.0, 19), [0.0]])[:, None]
    x = size * np.exp(2j * np.pi * 0.1 * np.arange(count)) + (size > 0.0) * noise((20, count))
    together = root_music(x)
    assert all(same_bits(together[i], root_music(x[i])) for i in range(20))
    assert same_bits(np.concatenate([root_music(x[:3]), root_music(x[3:])]), together)


@pytest.mark.parametrize("shape", [(385, 128), (16, 2), (2, 129, 128)])
def test_sums_run_in_ascending_order(same_bits, shape):
    """numpy's sum over an axis that is not the last: no term is added to another one first."""
    x, out = np.random.default_rng(1).standard_normal(shape), np.zeros((*shape[:-2], shape[-1]))
    for k in range(shape[-2]):
        out += x[..., k, :]
    assert same_bits(fmcw_signal._in_order(x), out)


@pytest.mark.long
def test_a_large_batch_takes_no_more_memory_than_a_small_one():
    """Root-MUSIC of 128 sweeps allocates as much at its peak as that of 16, for which machine code is made before."""
    peaks = []
    for rows in (16, 16, 128):
        x = noise((rows, 512))
        tracemalloc.start()
        root_music(x)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.1 * peaks[1]


def test_the_constants_are_those_of_the_record():
    """What the closed form draws was fitted to the signal path by benchmarks/results/radar_path/radar_path.py."""
    record = json.loads((Path(__file__).parents[1] / "benchmarks/results/radar_path/radar_path.json").read_text(encoding="utf-8"))
    np.testing.assert_allclose(fmcw._OUTLIER, record["fitted"]["outlier"], rtol=0.01)
    np.testing.assert_allclose(fmcw._EFFICIENCY, record["fitted"]["efficiency"], rtol=0.01)
    for row in record["samples"]["512"]:
        x = np.array(10.0 ** (row["snr_db"] / 10.0))
        bound = 6.0 * LINK.bandwidth**2 / (4 * np.pi**2 * x * (512**2 - 1))
        assert fmcw.outlier_probability(x) == pytest.approx(row["outliers"], abs=0.02)
        if row["snr_db"] >= 14.0:
            assert fmcw.tone_sd(LINK, x) ** 2 == pytest.approx(row["over_bound"] * bound, rel=0.2)


# in_band, distance [m], power of the jammer [W]; x after integration is 49.7, 37.7, 32.4, 21.9, 15.9, 14.2, 11.3, 7.8 and 4.7 dB
PLACES = [
    (None, 100.0, 0.0), (None, 200.0, 0.0), (None, 30.0, 0.1), (None, 100.0, 0.1), (None, 200.0, 0.1),
    (1.0, 10.0, 0.1), (1.0, 14.0, 0.1), (1.0, 21.0, 0.1), (1.0, 30.0, 0.1),
]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("in_band", "d", "power"), PLACES)
def test_the_fast_path_has_the_signals_mean_and_variance(in_band, d, power):
    """Of both readings, and the share of outliers, within 99.9 %: far above, in and below the threshold region."""
    radar = dataclasses.replace(SHARP, in_band=in_band)
    rows, many = 400, 40_000
    slow = sense(dataclasses.replace(radar, path="signal"), d, rows, power=power, seed=100_000)
    fast = sense(radar, d, many, power=power)
    for i, (true, cell) in enumerate(((d, 4.0), (-5.0, 4.0))):
        a, b = slow.y[:, 0, i][slow.valid[:, 0, i]], fast.y[:, 0, i][fast.valid[:, 0, i]]
        assert abs(a.mean() - b.mean()) <= NORMAL * np.sqrt(a.var() / len(a) + b.var() / len(b))
        spread = np.sqrt(np.mean(((b - b.mean()) ** 2 - b.var()) ** 2) / len(a))  # of the sample's variance
        assert abs(a.var() - b.var()) <= NORMAL * spread
        p, q = np.mean(np.abs(a - true) > cell), np.mean(np.abs(b - true) > cell)
        assert abs(p - q) <= NORMAL * np.sqrt(q * (1.0 - q) / len(a))
    p, q = slow.valid[:, 0, 0].mean(), fast.valid[:, 0, 0].mean()
    assert abs(p - q) <= NORMAL * np.sqrt(q * (1.0 - q) / rows)
    assert fast.valid.any() and slow.valid.any()


@pytest.mark.long
def test_service_is_denied_below_the_threshold():
    """Outliers are absent at 21 dB, some at 11 dB and most at 5 dB after integration, on the signal path."""
    for d, low, high in ((4.5, 0.0, 0.01), (14.0, 0.15, 0.40), (30.0, 0.90, 1.0)):
        radar = dataclasses.replace(SHARP, path="signal", in_band=1.0)
        got = sense(radar, d, 300, power=0.1, dv=0.0)
        share = 1.0 - np.mean(np.abs(got.y[:, 0, 0] - d) < 4.0)
        assert low <= share <= high


@pytest.mark.long
def test_both_paths_drive_the_car(same_bits):
    """The case study's first 40 s: the same truth behind both, readings 0.25 m and 0.1 m/s around it; a row alone equals its row of a batch."""
    place = load_scenario("thesis-ch3-v0")
    for path in ("closed_form", "signal"):
        there = dataclasses.replace(place, horizon=40, sensor=dataclasses.replace(place.sensor, path=path))
        loop, none = there.loop(tailgate.make_defence("kf")), tailgate.make_attack("none")
        trace = rollout(loop, none, keys("train", range(4)))
        off = trace.clean[:, :, 0] - trace.truth[:, :, 0, :2]
        sd = np.sqrt(np.mean(off**2, axis=(0, 1)))
        np.testing.assert_allclose(sd, [0.25, 0.1], rtol=0.25)
        alone = rollout(loop, none, keys("train", [2]))
        assert same_bits(alone.clean[:, 0], trace.clean[:, 2])
