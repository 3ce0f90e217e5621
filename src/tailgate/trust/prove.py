"""Proofs about a scenario: the closed form of a car that reacts late, and the largest attack and delay that leave a tube safe.

`tailgate trust --prove` prints the report; docs/trust.md has a section on what it says and what it does not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, Unpack

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.envs.controllers.adaptive_cruise import LEADER
from tailgate.envs.plants.highway import Highway
from tailgate.trust.affine import LoopOptions, affine_loop, injectable
from tailgate.trust.leaders import accelerations
from tailgate.trust.signals import SafeDistance
from tailgate.trust.tube import Tube

FORMAT = "tailgate-proof-1"
SPEEDS = (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)  # [m/s]
MOST_DELAY = 40  # steps that are tried
Tell = Callable[[int, int], None]


def keeps(safe: SafeDistance, gap: Array, speed: Array, lead_speed: Array) -> Array:
    """Return elementwise if a car may still accelerate for one reaction time: the invariant of Loos, Platzer and Nistor (FM 2011).

        gap >= v^2 / (2 b) - v_l^2 / (2 B) + (a / b + 1) (a r^2 / 2 + r v)

    which is `SafeDistance`, written out. A car that accelerates only where this holds, and brakes with b elsewhere, never collides.
    This takes B >= b: with a softer leader the cars may touch before both stand.
    """
    return np.asarray(gap >= safe.of(speed, lead_speed))


def admissible(safe: SafeDistance, gap: Array, speed: Array, lead_speed: Array) -> Array:
    """Return by how much a gap may be overestimated [m], elementwise, so that the invariant still holds of the true one; 0 at least."""
    return np.asarray(np.maximum(gap - safe.of(speed, lead_speed), 0.0))


def reacting(place: Scenario) -> SafeDistance:
    """Return the numbers of the invariant in a scenario.

    A first-order lag tau counts as that much longer reaction. A car that accelerates with a for tau, then brakes with b, is never slower
    than the lagged one. A leader that brakes softer than the car counts as one that may brake as hard.

    Raises
    ------
    NotApplicable
        Where no car with limits follows another, the real vehicle is not the one that is known, or nothing bounds how the car ahead brakes.
    """
    if place.truth:
        raise NotApplicable("--prove: truth", dict(place.truth), "none: the invariant is about the vehicle that is known")
    if isinstance(place.plant, Highway):
        wanted = "one without traffic: cars cut in here, and the invariant has no such leader"
        raise NotApplicable("--prove: plant", type(place.plant).__name__, wanted)
    model, law = place.brief().model, place.controller
    low, high, tau = getattr(law, "accel_min", None), getattr(law, "accel_max", None), getattr(place.plant, "tau", None)
    if model.lane or not model.followers.any() or low is None or high is None or tau is None:
        wanted = "a car with a lag and limits of its acceleration that follows another"
        raise NotApplicable("--prove: controller", type(law).__name__, wanted)
    hardest = -accelerations(place.manoeuvre)[0]
    return SafeDistance(model.dt + float(tau), max(float(high), 0.0), -float(low), max(hardest, -float(low)))


def closed_form(place: Scenario, speeds: Sequence[float] = SPEEDS) -> dict[str, Any]:
    """Return the admissible bias of the gap at each speed, when both cars drive at it and the gap is the desired one."""
    safe, v = reacting(place), np.array(speeds, float)
    gap = np.asarray(place.controller.desired_gap(v), float)
    room = gap - safe.of(v, v)
    return {
        "numbers": dataclasses.asdict(safe),
        "speeds": [
            {"speed": float(a), "desired_gap": float(b), "least_gap": float(c), "bias": max(float(d), 0.0), "holds": bool(d >= 0.0)}
            for a, b, c, d in zip(v, gap, safe.of(v, v), room, strict=True)
        ],
    }  # fmt: skip


def _not_covered(place: Scenario) -> list[str]:
    """Return what the threat model grants, or the road does, that a proof says nothing about."""
    kinds = [kind for kind in place.threat_model.kinds if kind != "fdi"]
    return kinds + (["a car behind"] if getattr(place.plant, "rear", False) else [])


def attack_size(place: Scenario, bound: float | None, alpha: float | None, **options: Unpack[LoopOptions]) -> dict[str, Any]:
    """Return the largest injected value that is proved safe, with the limits of the command and without them."""
    tube = Tube(affine_loop(place, bound=bound, **options), bound, alpha)
    most, calm = place.threat_model.fdi_bound, tube.under(0.0)
    return {
        "targets": [name for name, hit in zip(tube.loop.model.wires, injectable(place.brief()).tolist(), strict=True) if hit],
        "not_covered": _not_covered(place),
        "budget": place.threat_model.budget, "steps": len(tube.loop.attacked) - tube.loop.burn,
        "noise": {"spread": tube.loop.spread} if alpha is None else {"alpha": alpha},
        "largest": tube.largest(most), "without_limits": tube.largest(most, limits=False), "most": most,
        "calm": {"gap": calm.gap, "room": None if np.isinf(calm.room) else calm.room},
    }  # fmt: skip


def message_delay(
    place: Scenario, size: float, alpha: float | None, tell: Tell | None = None, **options: Unpack[LoopOptions]
) -> dict[str, Any]:  # fmt: skip
    """Return the largest delay of the leader's message [steps] up to which no gap is lost, every shorter one included.

    Raises
    ------
    NotApplicable
        Where no leader sends messages.
    """
    if place.brief().model.v2v[:2] != LEADER:
        raise NotApplicable("--delays: scenario", place.name, "a leader that sends his position and speed")
    rows: list[dict[str, Any]] = []
    for delay in range(MOST_DELAY + 1):
        if tell is not None:
            tell(delay, MOST_DELAY)
        held = Tube(affine_loop(place, delay=delay, **options), None, alpha).under(size)
        rows.append({"delay": delay, "gap": held.gap, "room": held.room})
        if held.gap <= 0.0:
            break
    kept = [row["delay"] for row in rows if row["gap"] > 0.0]
    return {"attack": size, "largest": kept[-1] if kept else None, "tried": rows, "dt": place.brief().model.dt}


def prove(
    scenario: str, bound: float | None = None, alpha: float | None = None, threat: dict[str, Any] | None = None, set_speed: bool = True,
    delays: bool = False, tell: Tell | None = None, **options: Unpack[LoopOptions],
) -> dict[str, Any]:  # fmt: skip
    """Return the report on a scenario under the defence `kf`.

    Parameters
    ----------
    bound
        Size of an error that counts as damage, where nobody drives.
    alpha
        Chance that a range does not hold, under Gaussian noise; none: every noise within the spread.
    set_speed
        False takes the driver's set speed away from the controller, which makes it linear.
    delays
        Ask for the largest message delay as well.
    options
        Arguments of `affine_loop`.
    """
    if bound is not None and not 0.0 < bound < np.inf:
        raise InputError("--bound", bound, "a finite number above 0")
    place = load_scenario(scenario).with_threat(**(threat or {}))
    if not set_speed and getattr(place.controller, "set_speed", None) is not None:
        place = dataclasses.replace(place, controller=dataclasses.replace(place.controller, set_speed=None))
    report: dict[str, Any] = {"format": FORMAT, "scenario": place.name, "config_hash": place.config_hash, "defence": "kf"}
    why: dict[str, str] = {}
    parts: dict[str, Callable[[], Any]] = {
        "closed_form": lambda: closed_form(place), "attack": lambda: attack_size(place, bound, alpha, **options),
    }  # fmt: skip
    if delays:
        parts["delay"] = lambda: message_delay(place, 0.0, alpha, tell, **options)
    for name, part in parts.items():
        try:
            report[name] = part()
        except NotApplicable as error:
            report[name], why[name] = None, str(error)
    return report | {"why": why}
