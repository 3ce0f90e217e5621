"""The JSON data of a replay's page: the whole episode, and the curves of each displayed agent."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import AIRED, Array, Kind, Mode
from tailgate.core.kinds import EFFECTS
from tailgate.core.reach import hops
from tailgate.envs.render.graph import edges, layout

from .replay import Replay, threshold

Data = dict[str, Any]
DIGITS = 6  # of a curve; decisions are exact
SHOWN = 24  # most agents with curves on a page
LANES = 8  # most attacked wires with separate lanes; beyond that, agents have lanes
METRE_S2 = "m/s\N{SUPERSCRIPT TWO}"
WIRE_UNITS = {"position": "m", "distance": "m", "velocity": "m/s", "acceleration": METRE_S2, "command": METRE_S2, "speed": "m/s"}


def curve(values: Array) -> list[float | None]:
    """Round numbers for drawing; null if not finite."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in values.tolist()]


def first_step(event: Array) -> int | None:
    """Return the first step (from 1) in which an event happened, or None."""
    return int(np.argmax(event)) + 1 if event.any() else None


def noun(replay: Replay) -> str:
    """Return the word for an agent."""
    return "car" if replay.loop.model.followers.any() else "agent"


def watched(replay: Replay, agent: int | None = None) -> int:
    """Return the agent to show first: the requested one, else the most attacked one, else the first that follows another."""
    model, count = replay.loop.model, replay.loop.model.agents
    if agent is not None:
        if not 0 <= agent < count:
            raise InputError("--agent", agent, f"an agent's number, from 0 to {count - 1}")
        return agent
    hits = _hit(replay).sum(axis=(0, 2))
    return int(np.argmax(hits) if hits.any() else np.argmax(model.followers))


def shown(replay: Replay, agent: int) -> list[int]:
    """Return the agents with curves: all, or of many those with the fewest hops to `agent`."""
    far = hops(replay.loop.model.graph)[agent]
    return sorted(sorted(range(len(far)), key=lambda i: (far[i], i))[:SHOWN])


def _hit(replay: Replay) -> Array:
    """Return the wires that are attacked in each step, (K, N, w) bool."""
    trace = replay.trace
    return np.asarray(trace.target[:, 0] & (trace.kind[:, 0] != Kind.NONE)[:, None, None])


def _wires(replay: Replay) -> list[Data]:
    """Return the attacked wires with the kinds that hit them; of very many, those of an agent together."""
    hit = _hit(replay)
    if np.isin(replay.trace.kind[:, 0], AIRED).any():
        return _receivers(replay)
    pairs = np.argwhere(hit.any(axis=0)).tolist()
    if len(pairs) <= LANES:
        return [_wire(replay, i, w, hit[:, i, w]) for i, w in pairs]
    agents = sorted({i for i, _ in pairs})
    groups = [[i] for i in agents] if len(agents) <= SHOWN else [agents]
    lanes = []
    for group in groups:
        count = sum(i in group for i, _ in pairs)
        whose = f"{noun(replay)} {group[0]}" if len(group) == 1 else f"{len(group)} {noun(replay)}s"
        lanes.append(_lane(replay, f"{count} readings of {whose}", "", np.asarray(hit[:, group].any(axis=(1, 2)))) | {"value": None})
    return lanes


def _receivers(replay: Replay) -> list[Data]:
    """Return the attacked wires when some attack went over the air: it reaches all readings of a receiver, in one lane."""
    trace, model, hit = replay.trace, replay.loop.model, _hit(replay)
    aired = np.isin(trace.kind[:, 0], AIRED)
    out = []
    for i in range(model.agents):
        reached = hit[:, i].any(axis=1) & aired
        if reached.any():
            value = np.where(reached, trace.value[:, 0, i].max(axis=1), 0.0)
            out.append(_lane(replay, f"receiver{_whose(replay, i)}", "", reached) | {"value": value.tolist()})
        wires = np.flatnonzero((hit[:, i] & ~aired[:, None]).any(axis=0)).tolist()
        out += [_wire(replay, i, w, hit[:, i, w] & ~aired) for w in wires]
    return out


def _whose(replay: Replay, agent: int) -> str:
    return "" if replay.loop.model.agents == 1 else f" of {noun(replay)} {agent}"


def _wire(replay: Replay, agent: int, wire: int, hit: Array) -> Data:
    """Return the lane of one wire of an agent, attacked in the steps `hit` (K,)."""
    name, value = replay.loop.model.wires[wire], replay.trace.value[:, 0, agent, wire]
    lane = _lane(replay, name.replace("_", " ") + _whose(replay, agent), WIRE_UNITS.get(name.split("_")[-1], ""), hit)
    return lane | {"value": value.astype(float).tolist()}


def _lane(replay: Replay, name: str, unit: str, hit: Array) -> Data:
    return {"name": name, "unit": unit, "kinds": sorted(set(replay.trace.kind[hit, 0].tolist())), "hit": hit.astype(int).tolist()}


def _of_agent(replay: Replay, agent: int) -> Data:
    """Return the curves of one agent."""
    trace, model, follows = replay.trace, replay.loop.model, bool(replay.loop.model.followers[agent])
    limit = threshold(replay.loop.defence) or _energy_threshold(replay)
    score, alarm, gate = trace.score[:, 0, agent], trace.alarm[:, 0, agent], replay.gate[:, agent]
    rear = trace.road("rear_gap")[:, agent]
    out: Data = {
        "road": None, "rear": None, "desired": None, "believed": None, "errors": _errors(replay, agent),
        "score": curve(score), "alarm": alarm.astype(int).tolist(), "mode": trace.mode[:, 0, agent].tolist(),
        "threshold": None if limit is None else {"name": limit[0], "value": limit[1], "rules": bool(((score > limit[1]) == alarm).all())},
        "gate": curve(gate) if limit is None and np.isfinite(gate).any() else None, "control": None, "applied": None,
        "radar": _radar(replay, agent) if model.air else None,
    }  # fmt: skip
    if follows:
        assert model.speed is not None
        speed = trace.estimate[:, 0, agent] @ model.speed[agent]
        out |= {
            "road": {name: curve(trace.road(name)[:, agent]) for name in ("gap", "speed", "lead_speed", "position")},
            "rear": {name: curve(trace.road(name)[:, agent]) for name in ("rear_gap", "rear_speed")} if np.isfinite(rear).any() else None,
            "desired": curve(np.asarray(trace.desired_gap(trace.road("speed")[:, agent]))),
            "believed": {"gap": curve(trace.believed_gap()[:, agent]), "speed": curve(np.asarray(speed))},
        }
    if model.actuators and (follows or model.agents == 1):
        commanded, applied = trace.control[:, 0, agent, 0], trace.applied[:, 0, agent, 0]
        out |= {"control": curve(commanded), "applied": None if (commanded == applied).all() else curve(applied)}
    return out


def _in_lane(replay: Replay) -> Data:
    """Return the curves of the picture of a lane: K + 1 places and headings of the car, and K errors of the belief."""
    trace, half = replay.trace, replay.loop.model.lane
    truth, off = trace.truth[:, 0, 0], trace.estimate[:, 0, 0] - trace.truth[:, 0, 0]
    gap = replay.trace.road("gap")[:, 0]
    last = np.copysign(half - gap[-1], truth[-1, 0])  # a trace holds the state up to the last measurement
    speed = replay.trace.road("speed")[:, 0]
    turn = np.concatenate([truth[:, 3], truth[-1:, 3]])
    bend = (replay.trace.road("accel")[:, 0] / speed - turn) / speed  # the lateral acceleration is v (e_psi' + v kappa)
    bend[-1] = bend[-2] if len(bend) > 1 else bend[-1]
    return {
        "half": half, "offset": curve(np.append(truth[:, 0], last)), "heading": curve(np.append(truth[:, 2], truth[-1, 2])),
        "curvature": curve(bend), "believed": curve(off[:, 0]), "turned": curve(off[:, 2]),
    }  # fmt: skip


def _radar(replay: Replay, agent: int) -> Data:
    """Return the radar's curves: muted (K,), energy over its noise [dB], and the defence's threshold [dB] if it has one.

    `then` (K,) is the true gap at the measurement, to which the step's estimate belongs.
    """
    trace = replay.trace
    sent = np.concatenate([[True], trace.probe[:-1, 0, agent]])  # the step before chooses each step's probe
    limit = _energy_threshold(replay)
    return {
        "muted": (~sent).astype(int).tolist(), "energy": curve(_decibels(trace.energy[:, 0, agent])),
        "threshold": None if limit is None else float(_decibels(np.asarray(limit[1]))),
        "then": curve(replay.trace.road("gap")[:, agent][:-1]),
    }  # fmt: skip


def _energy_threshold(replay: Replay) -> tuple[str, float] | None:
    """Return name and value of the energy threshold at a challenge, or None for a defence without challenges."""
    value = getattr(replay.loop.plan.defence, "threshold", None) if "probe" in replay.loop.uses else None
    return ("energy", float(value)) if isinstance(value, float) else None


def _decibels(power: Array) -> Array:
    return np.asarray(10.0 * np.log10(np.maximum(power, 1e-9)))


def _errors(replay: Replay, agent: int) -> list[Data]:
    """Return the plots of an agent's errors: name, heading, unit, smallest span of the axis, values."""
    trace, model = replay.trace, replay.loop.model
    if model.agents == 1 and model.followers.any():
        off = trace.estimate[:, 0, 0] - trace.truth[:, 0, 0]
        parts = [("position", "position", "m", 1.0), ("velocity", "velocity", "m/s", 0.5)]
        if model.lane:
            parts, off = [("offset-error", "offset", "m", 0.2), ("heading-error", "heading", "rad", 0.02)], off[:, ::2]
        if model.air:
            parts = [("gap-error", "gap", "m", 1.0), ("relative-speed-error", "relative speed", "m/s", 0.5)]
        return [
            {"name": name, "title": f"Estimation error of the {of}", "unit": unit, "least": least, "values": curve(off[:, i])}
            for i, (name, of, unit, least) in enumerate(parts)
        ]
    if not model.followers.any():
        return []  # one plot shows the errors of all agents
    gap, speed = (error(trace.estimate[:, 0], trace.truth[:, 0])[:, agent] for error in (model.gap_error, model.speed_error))
    own = [("gap", "Error of the believed gap", "m", 1.0, gap)] if model.followers[agent] else []
    return [
        {"name": f"{name}-error", "title": title, "unit": unit, "least": least, "values": curve(values)}
        for name, title, unit, least, values in (*own, ("speed", "Error of the believed speed", "m/s", 0.5, speed))
    ]


def _everybody(replay: Replay, agents: list[int]) -> Data:
    """Return the data of the picture and the plots of all agents."""
    trace, model = replay.trace, replay.loop.model
    size = model.error(trace.estimate[:, 0], trace.truth[:, 0])
    out: Data = {
        "alarm": trace.alarm[:, 0].any(axis=1).astype(int).tolist(), "alarms": trace.alarm[:, 0].astype(int).tolist(),
        "attacked": _hit(replay).any(axis=2).astype(int).tolist(),
        "sizes": {i: curve(size[:, i]) for i in agents}, "noun": noun(replay),
    }  # fmt: skip
    if model.followers.any():
        cars = range(model.agents)
        out["string"] = {
            "gap": [curve(replay.trace.road("gap")[:, i]) for i in cars], "speed": [curve(replay.trace.road("speed")[:, i]) for i in cars],
            "position": curve(replay.trace.road("position")[:, 0]),
            "believed": [curve(replay.trace.believed_gap()[:, i]) if model.followers[i] else [] for i in cars],
        }  # fmt: skip
        if model.followers[0]:  # the leader is no agent
            out["string"]["lead"] = curve(replay.trace.road("lead_speed")[:, 0])
    else:
        places = layout(model.graph)
        low, wide = places.min(axis=0), np.ptp(places, axis=0)
        places = (places - low) / np.where(wide > 0.0, wide, 1.0) + np.where(wide > 0.0, 0.0, 0.5)
        out["graph"] = {"places": np.round(places, 4).tolist(), "edges": edges(model.graph), "error": [curve(e) for e in size.T]}
    return out


def episode_of(replay: Replay, agent: int | None = None) -> Data:
    """Return all data that the page draws; `agent` is the agent to show first.

    Road signals have K + 1 entries, the first before the first step; others have K, entry s - 1 for step s.
    The curves of a single agent are at the top level, those of several below `agents`, by number.
    """
    trace, threat, model = replay.trace, replay.loop.threat, replay.loop.model
    kind = trace.kind[:, 0]
    used = np.concatenate([[0], np.cumsum(kind != Kind.NONE)])
    out: Data = {
        "dt": trace.dt, "horizon": trace.horizon, "length": int(trace.length[0]), "modes": [mode.name for mode in Mode],
        "kind": kind.tolist(), "wires": _wires(replay), "refused": trace.refused[:, 0].astype(int).tolist(),
        "kinds": {k: {"code": effect.code, "name": effect.title, "does": effect.does, "valued": effect.valued, "unit": effect.unit}
                  for k, effect in EFFECTS.items()},
        "left": None if threat.budget is None else (threat.budget - used).tolist(), "budget": threat.budget,
        "hit": first_step(trace.collided[:, 0]), "rear_hit": first_step(trace.rear_collided[:, 0]),
    }  # fmt: skip
    chosen = watched(replay, agent)
    if model.agents == 1:
        return out | _of_agent(replay, 0) | ({"lane": _in_lane(replay)} if model.lane else {})
    agents = shown(replay, chosen)
    return out | _everybody(replay, agents) | {"agent": chosen, "agents": {i: _of_agent(replay, i) for i in agents}}
