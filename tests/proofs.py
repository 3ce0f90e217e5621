"""Scenarios of which something is proved: a lane and a car without limits in reach."""

import dataclasses

from tailgate.core.registry import make
from tailgate.core.scenario import load_scenario

LANE, CAR, STEPS = "lane-keeping-v0", "gusty-stop-and-go-v0", 150


def lane(**threat):
    """The lane with a steering that has no limit in reach: the loop is linear throughout."""
    place = load_scenario(LANE)
    return dataclasses.replace(place, controller=dataclasses.replace(place.controller, limit=5.0), horizon=STEPS).with_threat(
        **{"onset": 1, "end": None, "budget": 40} | threat
    )


def car(**changes):
    """Car following without a set speed, near its equilibrium, so that no limit is in reach of its noise."""
    place = load_scenario(CAR)
    plant = dataclasses.replace(place.plant, rear=False, speed=29.05, gap=92.15, accel=0.0, process_var=(1e-8, 1e-8, 1e-6), prior_var=(1e-4, 1e-4, 1e-4))
    return dataclasses.replace(
        place, plant=plant, sensor=dataclasses.replace(place.sensor, noise_var=(1e-3, 1e-3)), horizon=STEPS,
        controller=dataclasses.replace(place.controller, set_speed=None), manoeuvre=make("manoeuvre", "ornstein_uhlenbeck", limit=0.3, mean_speed=29.05),
    ).with_threat(**{"budget": 20, "onset": 1, "end": None} | changes)  # fmt: skip
