"""Speed as ratios taken in one run; the absolute rates are a benchmark's record."""

import statistics
import time

import numpy as np
import pytest

from tailgate.core import Kind, draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import load_scenario


def _rate(episodes: int, steps: int) -> float:
    """Steps per second of the plain loop with chi2_kf, the best of three."""
    loop = load_scenario("stop-and-go-v0").loop(Spec("defence", "chi2_kf").make())
    state = loop.start(draws.keys("tune", range(episodes)))
    command = loop.brief.command(np.zeros(episodes, bool), Kind.NONE, np.zeros(5, bool), 0.0)
    rates = []
    for _ in range(3):
        current = state
        started = time.perf_counter()
        for _ in range(steps):
            loop.sense(current)
            current, _ = loop.advance(current, command)
        rates.append(episodes * steps / (time.perf_counter() - started))
    return max(rates)


def test_a_batch_is_worth_hundreds_of_single_episodes() -> None:
    """1.2 M steps/s at 4096 against about 1.5 k at one: half of it is asked for."""
    _rate(8, 5)  # compile
    ratios = [_rate(4096, 10) / _rate(1, 100) for _ in range(3)]
    assert statistics.median(ratios) > 300.0


@pytest.mark.long
def test_the_time_of_a_step_grows_with_the_batch_and_not_faster() -> None:
    _rate(8, 5)
    assert statistics.median(_rate(16384, 4) / _rate(4096, 8) for _ in range(3)) > 0.5
