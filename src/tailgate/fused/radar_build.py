"""The constants of a car with a radar, or why it has no lane: what `build` fills in for its plant, model, cruise control and sensor."""

from __future__ import annotations

import numpy as np

from tailgate.core import Array, Mode
from tailgate.envs.fmcw import tone_of
from tailgate.envs.idm import IDM_GAP, IDM_HEADWAY
from tailgate.envs.radar import FmcwRadar
from tailgate.envs.radar_car import STATES, RadarCruise, kinematic
from tailgate.envs.radar_following import RadarFollowing
from tailgate.estimators.algorithm2 import AsPrinted, PrintedRegression
from tailgate.estimators.challenge import CHANCE, Challenger, ChallengeResponse, PyCra
from tailgate.estimators.kinematic import JointRegression
from tailgate.loop import Loop

from . import constants as of
from . import printed, regression
from .constants import put


def vehicle(loop: Loop, c: Array, f: Array) -> str:
    """Both cars at the start, and how the own one moves."""
    plant, plan = loop.plant, loop.plan.plant
    assert isinstance(plant, RadarFollowing)
    put(c, of.DT, plant.dt)
    put(c, of.LOAD, loop.load)
    put(c, of.KEEP, (plan.alpha, (1.0 - plan.alpha) * plant.gain))
    put(c, of.START, (0.0, plant.speed, 0.0))
    put(c, of.LEAD_START, (plant.gap, plant.lead_speed))
    put(c, of.REAR_START, (IDM_GAP + IDM_HEADWAY * plant.speed, plant.speed))
    put(c, of.PRIOR, np.diag(plant.prior_var[:3]))
    c[of.OWN_PRIOR] = plant.prior_var[3]
    f[of.REAR], f[of.REACTION], f[of.ENDS] = plant.rear, plan.behind.reaction if plan.behind else 0, loop.ends_on_collision
    return ""


def told(loop: Loop, c: Array, f: Array) -> str:
    """The model, whose own speed is the known input and has no part in the others' covariance."""
    model = loop.model
    A, B = kinematic(model.dt)
    same = (
        np.array_equal(model.A, A), np.array_equal(model.B, B), np.array_equal(model.C, np.eye(STATES)[None, :2]), not model.c.any(),
        not model.Q[3, :3].any(), not model.Q[:3, 3].any(),
    )  # fmt: skip
    if not all(same):
        return "the model's matrices have another structure"
    for at, value in ((of.A, A[:3, :3]), (of.B, B[:3]), (of.OWN_INTO, A[:2, 3]), (of.Q, model.Q[:3, :3]), (of.RNOISE, model.R)):
        put(c, at, value)
    c[of.OWN_Q] = model.Q[3, 3]
    return ""


def cruise(loop: Loop, c: Array, f: Array) -> str:
    """The cruise control."""
    acc = loop.controller
    assert isinstance(acc, RadarCruise)
    put(c, of.HEADWAY, (acc.headway, acc.standstill, acc.g))
    put(c, of.LOWER_TAU, (acc.tau, acc.gain, acc.sample))
    put(c, of.SET_SPEED, (acc.set_speed, acc.accel_min, acc.accel_max))
    return ""


def challenged(loop: Loop, c: Array, f: Array) -> str:
    """A defence that challenges, with the regression that predicts."""
    defence, plan, R = loop.defence, loop.plan.defence, loop.model.R[0]
    assert isinstance(defence, Challenger)
    part, answer, fixed = plan.filter, plan.response, defence.challenge == "fixed"
    if type(part) not in (JointRegression, PrintedRegression):
        return f"filter {type(part).__name__} has no lane"
    if "probe" not in loop.uses:
        return "a challenge without a probe has no lane"
    if R[0, 1] or R[1, 0] or (fixed and len(plan.times) > of.MOMENTS):
        return f"readings that depend on each other, or more than {of.MOMENTS} times, have no lane"
    usual = 0.0 if fixed else CHANCE if defence.probability is None else defence.probability
    put(c, of.USUAL, (usual, usual if defence.watch is None else defence.watch))
    put(c, of.SUSPICION, (np.inf if defence.suspicion is None else defence.suspicion, defence.quiet))
    if fixed:
        f[of.FIXED] = len(plan.times)
        put(c, of.TIMES, plan.times)
    c[of.THRESHOLD] = plan.threshold
    if isinstance(part, JointRegression):
        f[of.CHALLENGED], f[of.SAMPLED] = 1, part.window
        put(c, of.PRIOR, np.diag(plan.filter_plan.line.broad[:3]))
        put(c, of.Q, np.zeros(9))
        c[of.OWN_PRIOR] = c[of.OWN_Q] = 0.0
        put(c, of.RIDGE, (1.0 / part.delta, part.forgetting, np.inf if part.threshold is None else part.threshold, part.drift))
        put(c, of.SAMPLE_WEIGHT, plan.filter_plan.weight)
    else:
        f[of.PRINTED] = 1
        put(c, of.RIDGE, (part.delta, part.forgetting))
    f[of.PASSES], f[of.STOPS], f[of.FREEZES], f[of.ROLLS_BACK] = answer
    f[of.MODED], c[of.LINGER], c[of.ASKED] = defence.mode != "normal", plan.reaction_plan.linger, Mode[defence.mode.upper()]
    return ""


def sensor(loop: Loop, c: Array, f: Array) -> str:
    """The radar, and how an attacker is heard."""
    radar, plan = loop.sensor, loop.plan.sensor
    assert isinstance(radar, FmcwRadar)
    if radar.path != "closed_form":
        return "a simulated signal has no lane"
    put(c, of.SENSOR_SD, plan.sd)
    put(c, of.ECHO, (plan.echo, plan.jam, radar.samples))
    put(c, of.PER_METRE, (radar.hz_per_metre, radar.hz_per_speed, radar.lowest, radar.highest))
    put(c, of.IF_BAND, (radar.bandwidth, *tone_of(radar), *radar.reach))
    put(c, of.LISTENED, (plan.challenge, *radar.heard(np.inf if loop.threat.reaction is None else loop.threat.reaction)))
    return ""


def remembered(f: Array) -> int:
    """Rows that a challenger keeps, or an algorithm as printed."""
    return printed.ROWS if f[of.PRINTED] else regression.rows(int(f[of.SAMPLED]))


PARTS, CHALLENGERS = (RadarFollowing, FmcwRadar, RadarCruise), (ChallengeResponse, PyCra, AsPrinted)
FILLS = (vehicle, told, cruise, sensor)
