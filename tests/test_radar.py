"""The FMCW radar: closed forms of beats, link and jammer, and the sensor's readings and energy."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import tailgate
from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base.errors import InputError
from tailgate.core import Air, Kind
from tailgate.core.draws import Role, keys
from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario
from tailgate.envs import FmcwRadar, RadarCruise, RadarFollowing
from tailgate.envs.sensors import fmcw
from tailgate.play.trace import rollout

from .readings import sense

LINK = fmcw.Link()
SAMPLES = 25_600  # of a challenge: 0.1 s at 256 kHz
NORMAL = 3.2905  # 99.9 % two-sided


@given(st.floats(2.0, 200.0), st.floats(-60.0, 60.0))
def test_beats_and_back(d, dv):
    """(3.5), (3.6) and (3.7), (3.8) undo each other, to 1e-12 of the range of the radar."""
    distance, speed = LINK.range_speed(*LINK.beats(np.array(d), np.array(dv)))
    assert abs(distance - d) < 1e-12 and abs(speed - dv) < 1e-12
    up, down = LINK.beats(np.array(d), np.array(dv))
    assert LINK.within_band(up, down) and LINK.within_band(*LINK.beats(np.array(d + 20.0), np.array(dv)))


def test_what_a_metre_and_a_metre_per_second_are():
    """500.346 Hz and 514.139 Hz; a beat is negative when |dv|/d exceeds 0.974 1/s; 6 m more are 3002 Hz on both beats and 40.03 ns."""
    assert LINK.hz_per_metre == pytest.approx(500.346, abs=5e-4) and LINK.hz_per_speed == pytest.approx(514.139, abs=5e-4)
    one = np.array(1.0)
    assert LINK.beats(one, 0.973 * one)[1] > 0.0 > LINK.beats(one, 0.974 * one)[1]
    late, true = (LINK.beats(np.array(d), np.array(-4.0)) for d in (106.0, 100.0))
    assert [a - b for a, b in zip(late, true, strict=True)] == pytest.approx([3002.08] * 2, abs=0.01)
    assert LINK.range_speed(*late)[1] == pytest.approx(-4.0, abs=1e-12)
    nanoseconds = 2.0 * 6.0 / fmcw.LIGHT * 1e9
    assert nanoseconds == pytest.approx(40.03, abs=0.005)


def test_the_echo_falls_with_the_fourth_power_of_the_distance():
    """Pr d^4 is the constant of (3.9), the jammer's power times d^2 that of (3.10)."""
    d = np.geomspace(2.0, 200.0, 9)
    gain, loss = 10**2.8, 10**0.01
    echo = 10e-3 * gain**2 * 3.89e-3**2 * 10.0 / ((4 * np.pi) ** 3 * loss)
    jam = 0.1 * 10.0 * 3.89e-3**2 * gain * 150e6 / ((4 * np.pi) ** 2 * 155e6 * loss)
    np.testing.assert_allclose(LINK.echo_power(d) * d**4, echo, rtol=1e-12)
    np.testing.assert_allclose(LINK.jam_power(d, 0.1) * d**2, jam, rtol=1e-12)


@pytest.mark.parametrize(("section", "d_burn"), [(1.0, 0.72), (10.0, 2.28), (100.0, 7.20)])
def test_echo_and_jammer_are_equal_at_burn_through(section, d_burn):
    """(3.11) is 1 there."""
    link = fmcw.Link(cross_section=section)
    d = link.burn_through(0.1)
    assert d == pytest.approx(d_burn, abs=0.005)
    assert link.echo_power(d) / link.jam_power(d, 0.1) == pytest.approx(1.0, abs=1e-12)


def _to_db(ratio):
    return 10.0 * math.log10(ratio)


def test_the_noise_of_the_receiver():
    """k T0 F B_if is -107.9 dBm at 256 kHz and 12 dB; 512 samples a sweep."""
    assert _to_db(LINK.noise_power / 1e-3) == pytest.approx(-174.0 + 12.0 + 10 * math.log10(256e3), abs=0.05)
    assert fmcw.from_db(_to_db(42.0)) == pytest.approx(42.0, rel=1e-14) and LINK.samples == 512


def test_the_share_that_passes_the_if_filter():
    """Of noise over the whole band B_if/B, of a jammer that follows the chirp all; both weigh on the SNR."""
    follows = fmcw.Link(in_band=1.0)
    assert LINK.passed == pytest.approx(256e3 / 150e6) and follows.passed == 1.0
    weak, strong = (link.snr(100.0, 0.1) for link in (follows, LINK))
    assert weak == pytest.approx(LINK.echo_power(100.0) / (LINK.noise_power + LINK.jam_power(100.0, 0.1)))
    assert _to_db(512 * strong) == pytest.approx(21.9, abs=0.1) and _to_db(512 * weak) == pytest.approx(-5.8, abs=0.1)


def test_a_ratio_below_one_is_no_denial():
    """At 30 m a 100 mW jammer is 22 dB above the echo: harmless over the whole band, fatal when it follows the chirp."""
    assert LINK.jam_power(30.0, 0.1) / LINK.echo_power(30.0) > 100.0
    rows = 2000
    for in_band, low, high in ((None, 0.0, 0.0), (1.0, 0.97, 1.0)):
        got = sense(FmcwRadar(in_band=in_band), 30.0, rows, power=0.1)
        lost = 1.0 - np.mean(got.valid[:, 0, 0] & (np.abs(got.y[:, 0, 0] - 30.0) < 4.0) & (np.abs(got.y[:, 0, 1] + 5.0) < 4.0))
        assert low <= lost <= high


def test_without_an_attack_the_reading_is_the_targets_extent():
    """Mean and standard deviation of both readings, 0.25 m and 0.1 m/s, within 99.9 %; the error of the estimation is far below."""
    rows = 20_000
    got = sense(FmcwRadar(), 80.0, rows)
    assert got.valid.all()
    for i, (true, sd) in enumerate(((80.0, 0.25), (-5.0, 0.1))):
        y = got.y[:, 0, i]
        assert abs(y.mean() - true) < NORMAL * sd / np.sqrt(rows) and abs(y.std() / sd - 1.0) < NORMAL / np.sqrt(2 * rows)
    x = LINK.samples * LINK.snr(200.0)
    assert fmcw.tone_sd(LINK, x) / LINK.hz_per_metre < 0.01 and fmcw.outlier_probability(x) < 1e-100


@pytest.mark.parametrize(("path", "within"), [("closed_form", 1e-9), ("signal", 0.01)])
def test_an_answered_echo_is_late_and_as_fast(path, within):
    """+6 m on the distance by the same draws, the speed unchanged; of the signal within the estimation's error."""
    radar = FmcwRadar(path=path)
    late, true = (sense(radar, 60.0, 20, delay=delay) for delay in (6.0, 0.0))
    np.testing.assert_allclose(late.y - true.y, np.broadcast_to([6.0, 0.0], (20, 1, 2)), atol=within)


@pytest.mark.parametrize("path", ["closed_form", "signal"])
def test_measure_is_disturbed_by_nothing(path, same_bits):
    """To the last bit, whatever the attacker's reaction time, seen or muted; and a row alone is its row of a batch."""
    radar = FmcwRadar(path=path)
    model = RadarFollowing().model(radar, RadarCruise())
    plan, rng, rows = radar.prepare(model), np.random.default_rng(1), 64
    truth = np.zeros((rows, 1, 4))
    truth[:, 0, 0], truth[:, 0, 1] = rng.uniform(1.0, 230.0, rows), rng.uniform(-20.0, 20.0, rows)
    probe, nothing = (np.arange(rows) % 3 > 0)[:, None], np.zeros((rows, 1))
    all_keys = keys("train", range(rows))
    draws = all_keys.at(Role.SENSOR, np.arange(rows))
    calm = radar.measure(plan, truth, probe, draws)
    for reaction in (0.0, 0.02, np.inf):
        again = radar.disturbed(plan, truth, probe, draws, Air(nothing, nothing, reaction))
        assert all(same_bits(a, b) for a, b in zip(calm[:3], again[:3], strict=True))
    air = Air(rng.choice([0.0, 0.1], (rows, 1)), rng.choice([0.0, 6.0], (rows, 1)), 0.01)
    batch = radar.disturbed(plan, truth, probe, draws, air)
    for i in (0, 17, 63):
        one = slice(i, i + 1)
        own = keys("train", [i]).at(Role.SENSOR, np.array([i]))
        alone = radar.disturbed(plan, truth[one], probe[one], own, Air(air.power[one], air.delay[one], 0.01))
        assert all(same_bits(a[one], b) for a, b in zip(batch[:3], alone[:3], strict=True))


def test_what_is_out_of_reach_or_muted_is_not_read():
    """Distance outside of `reach`, a beat outside of the IF band, a muted step: no reading, 0 in its place."""
    radar = FmcwRadar(reach=(2.0, 1000.0))
    for got, read in (
        (sense(FmcwRadar(), 1.0, 50), False), (sense(FmcwRadar(), 202.0, 50), False), (sense(FmcwRadar(), 60.0, 50, probe=False), False),
        (sense(radar, 320.0, 50), True), (sense(radar, 400.0, 50), False), (sense(FmcwRadar(), 0.0, 50, power=0.1), False),
    ):  # fmt: skip
        assert (got.valid == read).all() and ((got.y == 0.0) == (not read)).all() and np.isfinite(got.energy).all()


def test_the_energy_of_a_silent_receiver_is_that_of_noise():
    """2 N_c E of a quiet challenge is chi-square with 2 N_c degrees of freedom: Kolmogorov-Smirnov, and the rate of false alarms."""
    rows = 100_000
    energy = sense(FmcwRadar(), 50.0, rows, probe=False).energy[:, 0]
    assert stats.kstest(2 * SAMPLES * energy, "chi2", args=(2 * SAMPLES,)).pvalue > 1e-3
    for p in (0.05, 0.001):
        found = np.mean(energy > fmcw.false_alarm_threshold(p, SAMPLES))
        assert abs(found - p) < NORMAL * np.sqrt(p * (1 - p) / rows)


@pytest.mark.parametrize("kind", ["jam", "tone"])
@pytest.mark.parametrize("strength", [0.02, 0.03])
def test_the_rate_of_misses_is_the_closed_forms(kind, strength):
    """A jammer, and an answer to a muted probe, so weak that the detector misses some: Monte-Carlo within 99.9 %."""
    rows, d = 40_000, 50.0
    threshold = fmcw.false_alarm_threshold(1e-3, SAMPLES)
    if kind == "jam":
        power = strength * LINK.noise_power / float(LINK.passed * LINK.jam_power(d, 1.0))
        radar, attack = FmcwRadar(), {"power": power}
    else:  # a smaller car, whose echo is `strength` times the noise, and whose attacker repeats it
        section = LINK.cross_section * strength * LINK.noise_power / float(LINK.echo_power(d))
        radar, attack = FmcwRadar(cross_section=section), {"delay": 6.0}
    found = np.mean(sense(radar, d, rows, probe=False, **attack).energy <= threshold)
    expected = fmcw.miss_probability(threshold, SAMPLES, **{kind: strength})
    assert 0.01 < expected < 0.9 and abs(found - expected) < NORMAL * np.sqrt(expected * (1 - expected) / rows)


def test_the_gamma_and_the_noncentral_share_are_exact_enough_for_few_samples():
    """Down to 16 samples, partly heard: mean and variance of the energy within 99.9 % of 1 + r (J + T) and its variance."""
    rows, count = 200_000, 16
    z, one = np.random.default_rng(2).standard_normal((rows, 1, 3)), np.ones((rows, 1))
    for heard, jam, tone in ((16, 0.0, 0.0), (16, 2.0, 3.0), (4, 1.0, 5.0), (1, 0.0, 8.0)):
        e, r = fmcw.heard_energy(count, heard * one, jam * one, tone * one, z), heard / count
        mean, var = 1.0 + r * (jam + tone), (r * ((1 + jam) ** 2 + 2 * tone * (1 + jam)) + 1.0 - r) / count
        kurtosis = np.mean((e - mean) ** 4) / var**2
        assert abs(e.mean() - mean) < NORMAL * np.sqrt(var / rows) + 1e-3 * var
        assert abs(e.var() / var - 1.0) < NORMAL * np.sqrt((kurtosis - 1.0) / rows) + 1e-3


@pytest.mark.parametrize("attack", [{"power": 0.1}, {"delay": 6.0}])
def test_a_fast_attacker_is_heard_for_its_reaction_time_alone(attack):
    """The mean energy above the noise is min(reaction, W)/W of the whole: also below one sample, and none with no reaction time."""
    radar, d, rows = FmcwRadar(), 50.0, 2000
    noise = LINK.noise_power
    whole = float(LINK.passed * LINK.jam_power(d, 0.1) if "power" in attack else LINK.echo_power(d)) / noise
    for reaction in (np.inf, 0.5, 0.05, 1e-3, 1e-6, 0.0):
        energy = sense(radar, d, rows, probe=False, reaction=reaction, **attack).energy[:, 0]
        share = min(reaction, 0.1) / 0.1
        assert abs(energy.mean() - 1.0 - share * whole) < NORMAL * energy.std() / np.sqrt(rows)
    calm = sense(radar, d, rows, probe=False)
    assert np.allclose(energy, calm.energy[:, 0], atol=0.05)  # silent at once, it cannot be told from nobody


def test_a_reaction_time_matters_not_while_the_radar_transmits(same_bits):
    """Only a muted probe makes an attacker fall silent."""
    slow, fast = (sense(FmcwRadar(), 50.0, 30, power=0.1, reaction=reaction) for reaction in (np.inf, 0.0))
    assert all(same_bits(a, b) for a, b in zip(slow[:3], fast[:3], strict=True))


def test_the_channel_hands_the_power_to_the_radar():
    """In the loop of the case study, 100 mW at the leader: a muted step hears noise and jammer at the true gap, any other says nothing."""
    place = load_scenario("thesis-ch3-v0")
    place = dataclasses.replace(place, horizon=30)

    class Jam(NoAttack):
        def decide(self, plan, state, view, draws):
            return None, plan.command(view.k > 15, Kind.NOISE_JAM, plan.granted, 0.1)

    defence = tailgate.make_defence("pycra", probability=0.5)
    trace = rollout(place.loop(defence, ("measurements", "probe")), Jam(), keys("train", range(3)))
    assert rollout(place.loop(defence), Jam(), keys("train", range(3))).probe.all(), "who does not say that it mutes the probe cannot"
    muted = np.concatenate([np.zeros((1, 3), bool), ~trace.probe[:-1, :, 0]])
    d = trace.truth[:, :, 0, 0]
    jam = np.where(np.arange(1, 31)[:, None] > 15, LINK.passed * LINK.jam_power(d, 0.1), 0.0)
    expected = np.where(muted, 1.0 + jam / LINK.noise_power, 0.0)
    np.testing.assert_allclose(trace.energy[:, :, 0], expected, rtol=0.05)
    assert muted[16:].any() and (trace.valid[..., 0, 0] == ~muted).all() and not trace.refused.any()


def test_bad_parameters_are_named():
    """Too few samples a sweep, a reach without extent, an unknown path, another plant."""
    for field, value in (("bandwidth", 1e3), ("reach", (200.0, 2.0)), ("path", "spectrum"), ("in_band", 0.0)):
        with pytest.raises(InputError, match=field):
            make("sensor", "fmcw_radar", **{field: value})
    with pytest.raises(InputError, match="radar_following"):
        FmcwRadar().matrices(tailgate.envs.CarFollowing())
