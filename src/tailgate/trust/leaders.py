"""The accelerations of which a leader is capable, by his manoeuvre."""

from __future__ import annotations

from tailgate.base.errors import NotApplicable
from tailgate.envs.manoeuvres import Braking, Constant, OrnsteinUhlenbeck, Pulse, Sine, StopAndGo, Switched


def accelerations(manoeuvre: object) -> tuple[float, float]:
    """Return the smallest and the largest acceleration of a leader [m/s^2]; 0 lies between them, as a leader may halt.

    Raises
    ------
    NotApplicable
        For a manoeuvre that states no bound, such as a recording.
    """
    match manoeuvre:
        case StopAndGo():
            found = (-manoeuvre.decel, manoeuvre.accel_rate)
        case Braking():
            found = (-manoeuvre.decel, 0.0)
        case OrnsteinUhlenbeck():
            found = (-manoeuvre.limit, manoeuvre.limit)
        case Sine():
            found = (-abs(manoeuvre.amplitude), abs(manoeuvre.amplitude))
        case Switched():
            found = (min(manoeuvre.value, manoeuvre.then), max(manoeuvre.value, manoeuvre.then))
        case Constant() | Pulse():
            found = (manoeuvre.value, manoeuvre.value)
        case _:
            wanted = "one that bounds its acceleration; --lead-accel says other bounds"
            raise NotApplicable("--prove: manoeuvre", type(manoeuvre).__name__, wanted)
    return min(float(found[0]), 0.0), max(float(found[1]), 0.0)
