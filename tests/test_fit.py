"""The fit to recorded cars: it finds a law that made the data, and reports what it reaches on windows that it did not see."""

import json

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.cli import main
from tailgate.core.registry import make
from tailgate.roads import fit as fits

TRUE = np.array([[1.1, 0.12, 0.3, 0.3], [1.4, 0.2, 0.25, 0.35]])


def _made(windows=3, seconds=30.0, dt=0.1, delay=0.4):
    """Cars that follow the law exactly behind a leader of sines."""
    steps = round(seconds / dt)
    t = dt * np.arange(steps)[:, None]
    lead = 18.0 + 1.5 * np.sin(2 * np.pi * t / (12.0 + 5.0 * np.arange(windows))) + 0.5 * np.sin(t)
    speed = np.repeat(lead[..., None], 3, axis=2)
    gap = np.stack([4.0 + TRUE[i, 0] * lead for i in range(2)], axis=2)
    held = fits.Windows(speed, gap, dt)
    found = fits.play(held, TRUE, np.array([4.0, 4.0]), delay, alone=False)
    return fits.Windows(np.concatenate([lead[..., None], found.speed], axis=2), found.gap, dt)


@pytest.mark.long
def test_the_law_that_made_the_data_is_found():
    held, costs = _made(), []
    for car in range(2):
        x, cost, _ = fits.fitted(held, np.array([4.0, 4.0]), 0.4, car)
        assert (np.abs(x / TRUE[car] - 1.0) < [0.01, 0.06, 0.06, 0.15]).all() and cost < 1.0
        costs.append(cost)
    assert fits.fitted(held, np.array([4.0, 4.0]), 0.0, 0)[1] > 10.0 * costs[0]


def test_a_simulated_string_is_what_the_scenario_drives():
    """The fit's cars and those of the plant obey one law: the same speeds and gaps behind the same leader, without noise."""
    import dataclasses

    from tailgate.core import draws
    from tailgate.core.registry import Spec
    from tailgate.core.scenario import load_scenario
    from tailgate.play.trace import rollout

    scenario = load_scenario("road-string-v0")
    plant = dataclasses.replace(scenario.plant, noise_var=(0.0, 0.0, 0.0), tau=0.3)
    scenario = dataclasses.replace(scenario, plant=plant, sensor=dataclasses.replace(scenario.sensor, late=0), horizon=900)
    guard = Spec("defence", "kf")
    trace = rollout(scenario.loop(guard.make(), guard.entry.uses), Spec("attack", "none").make(), draws.keys("tune", range(4)))
    lead = trace.signals["lead_speed"][:, :, :1]
    measured = fits.Windows(np.concatenate([lead, trace.signals["speed"]], axis=2), trace.signals["gap"], 0.05)
    law = scenario.controller
    rows = np.tile([law.headway, law.gap_gain, law.speed_gain, 0.3], (5, 1))
    found = fits.play(measured, rows, np.full(5, law.standstill), law.delay, alone=False)
    errors = fits.errors_of(measured, found)
    assert max(errors["speed"]) < 0.1 and max(errors["gap"]) < 0.4  # a filter drives there, and the start is on the way


def test_windows_to_fit_and_unseen_ones_share_no_second():
    seen, unseen = fits.windows_of(fits.Settings())
    assert seen.speed.shape[1] == 6 and unseen.speed.shape[1] == 6 and seen.speed.shape[2] == 5
    mine = {tuple(row) for row in seen.speed.reshape(-1, 5)}
    assert not any(tuple(row) in mine for row in unseen.speed.reshape(-1, 5))


def test_string_gain():
    t = np.arange(400)[:, None, None] * 0.1
    speed = np.concatenate([np.sin(t), 1.5 * np.sin(t - 1.0)], axis=2) + 20.0
    assert fits.amplified(speed)[0] == pytest.approx(1.5, rel=0.02)


@pytest.mark.long
def test_the_defaults_of_the_controller_are_the_fit_to_all_cars(tmp_path, capsys):
    """And the errors are those that the documentation reports."""
    assert main(["fit", "--json", "--out", str(tmp_path / "fit.json"), "--plot", str(tmp_path / "fit.png")]) == 0
    held = json.loads((tmp_path / "fit.json").read_text())
    assert held == json.loads(capsys.readouterr().out) and (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    law, found = make("controller", "acc_production"), held["laws"]["one"]["cars"][0]
    assert held["delay"] == law.delay
    for name in ("gap_gain", "speed_gain"):  # one of the laws that fit about as well
        least, greatest = found["near"][name]
        assert least - 0.005 < getattr(law, name) < greatest + 0.005 and least <= found[name] <= greatest
    assert abs(found["standstill"] - law.standstill) < 0.1
    unseen = held["laws"]["each"]["unseen"]
    assert np.mean(unseen["alone"]["gap"]) < 2.2 and np.mean(unseen["alone"]["speed"]) < 0.45
    assert unseen["gain"][-1] > 1.5 and held["measured"]["unseen"]["gain"][-1] > 1.5


@pytest.mark.parametrize("arguments, words", [
    (["--trace", "us06"], "fit.traces: got 'us06'; expected a recording of a string"),
    (["--trace", "asta-braking"], "fit.traces: got 'asta-braking'; expected a recording that begins at rest"),
    (["--trace", "asta-string:nan"], "--trace: got 'asta-string:nan'; expected NAME or NAME:SECONDS, with seconds not below 0"),
    (["--trace", "asta-string:-30"], "--trace: got 'asta-string:-30'; expected NAME or NAME:SECONDS"),
    (["--trace", "asta-string:x"], "--trace: got 'asta-string:x'; expected NAME or NAME:SECONDS"),
    (["--plot", "fit.gif"], "--plot: got 'fit.gif'; expected a file name that ends in .png, .svg, .pdf"),
    (["--window", "1"], "fit.window: got 1.0; expected 5 to 1000 s"),
    (["--window", "700"], "fit.window: got 700.0; expected at most half of the recording"),
    (["--delay", "9"], "fit.delays: got [9.0]; expected delays of 0 to 3 s"),
])  # fmt: skip
def test_bad_input_is_refused(arguments, words, capsys):
    assert main(["fit", *arguments]) == 2
    assert words in capsys.readouterr().err


def test_windows_of_nothing_are_refused():
    with pytest.raises(InputError, match=r"fit\.traces: got \[\]"):
        fits.fit(fits.Settings(traces=()))
