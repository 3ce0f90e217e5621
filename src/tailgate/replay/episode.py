"""What the page of a replay draws, as JSON data: the episode for all, and the part of each agent that is looked at."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.core import AIRED, Array, Kind, Mode
from tailgate.core.drawing import edges, hops, layout
from tailgate.core.kinds import EFFECTS

from .replay import Replay, threshold

Data = dict[str, Any]
DIGITS = 6  # of a curve; decisions are exact
SHOWN = 24  # agents with curves of their own in a page, at most
LANES = 8  # attacked wires with a lane each, at most; of more the agents have one
METRE_S2 = "m/s\N{SUPERSCRIPT TWO}"
WIRE_UNITS = {"position": "m", "distance": "m", "velocity": "m/s", "acceleration": METRE_S2, "command": METRE_S2, "speed": "m/s"}


def curve(values: Array) -> list[float | None]:
    """Numbers for drawing: some digits, null where not finite."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in values.tolist()]


def first_step(event: Array) -> int | None:
    """The first step (from 1) in which something happened."""
    return int(np.argmax(event)) + 1 if event.any() else None


def noun(replay: Replay) -> str:
    """What an agent is."""
    return "car" if replay.loop.model.followers.any() else "agent"


def watched(replay: Replay, agent: int | None = None) -> int:
    """The agent to look at first: the one that is asked for, else the one attacked most, else the first that follows another."""
    model, count = replay.loop.model, replay.loop.model.agents
    if agent is not None:
        if not 0 <= agent < count:
            raise InputError("--agent", agent, f"an agent's number, from 0 to {count - 1}")
        return agent
    hits = _hit(replay).sum(axis=(0, 2))
    return int(np.argmax(hits) if hits.any() else np.argmax(model.followers))


def shown(replay: Replay, agent: int) -> list[int]:
    """The agents with curves of their own: all, or of many the one to look at and those with the fewest hops to it."""
    far = hops(replay.loop.model.graph)[agent]
    return sorted(sorted(range(len(far)), key=lambda i: (far[i], i))[:SHOWN])


def _hit(replay: Replay) -> Array:
    """(K, N, w) bool: the wires that are attacked in each step."""
    trace = replay.trace
    return np.asarray(trace.target[:, 0] & (trace.kind[:, 0] != Kind.NONE)[:, None, None])


def _road(replay: Replay, name: str, agent: int) -> Array:
    """(K + 1,): before the first step, then after each."""
    trace = replay.trace
    return np.concatenate([trace.first[name][:, agent], trace.signals[name][:, 0, agent]])


def _believed_gap(replay: Replay, agent: int) -> Array:
    """(K,) the gap as the agent believes it; where its state is a position, the leader's one as it was heard, less the own one."""
    trace, model = replay.trace, replay.loop.model
    assert model.gap is not None
    if model.agents > 1 or model.air:
        return np.asarray(trace.estimate[:, 0, agent] @ model.gap[agent])
    if "leader_position" in model.v2v:
        leader = trace.wires[:, 0, agent, model.wires.index("leader_position")]
    else:
        leader = (_road(replay, "position", agent) + _road(replay, "gap", agent))[:-1]
    return np.asarray(leader - trace.estimate[:, 0, agent, 0])


def _wires(replay: Replay) -> list[Data]:
    """The wires that were ever attacked, each with the kinds that hit it; of very many those of an agent together."""
    trace, model, hit = replay.trace, replay.loop.model, _hit(replay)
    if np.isin(trace.kind[:, 0], AIRED).any():
        return _receivers(replay)
    pairs = np.argwhere(hit.any(axis=0)).tolist()
    if len(pairs) <= LANES:
        out = []
        for i, w in pairs:
            name = model.wires[w].replace("_", " ") + ("" if model.agents == 1 else f" of {noun(replay)} {i}")
            unit = WIRE_UNITS.get(model.wires[w].split("_")[-1], "")
            out.append(_lane(replay, name, unit, hit[:, i, w]) | {"value": [float(v) for v in trace.value[:, 0, i, w]]})
        return out
    agents = sorted({i for i, _ in pairs})
    groups = [[i] for i in agents] if len(agents) <= SHOWN else [agents]
    lanes = []
    for group in groups:
        count = sum(i in group for i, _ in pairs)
        whose = f"{noun(replay)} {group[0]}" if len(group) == 1 else f"{len(group)} {noun(replay)}s"
        lanes.append(_lane(replay, f"{count} readings of {whose}", "", np.asarray(hit[:, group].any(axis=(1, 2)))) | {"value": None})
    return lanes


def _receivers(replay: Replay) -> list[Data]:
    """As `_wires`, where something was sent over the air: that reaches all readings of a receiver, and has one lane for them."""
    trace, model, hit = replay.trace, replay.loop.model, _hit(replay)
    aired = np.isin(trace.kind[:, 0], AIRED)
    out = []
    for i in range(model.agents):
        whose = "" if model.agents == 1 else f" of {noun(replay)} {i}"
        reached = hit[:, i].any(axis=1) & aired
        if reached.any():
            value = np.where(reached, trace.value[:, 0, i].max(axis=1), 0.0)
            out.append(_lane(replay, f"receiver{whose}", "", reached) | {"value": value.tolist()})
        for w in np.flatnonzero((hit[:, i] & ~aired[:, None]).any(axis=0)).tolist():
            name, unit = model.wires[w].replace("_", " ") + whose, WIRE_UNITS.get(model.wires[w].split("_")[-1], "")
            out.append(_lane(replay, name, unit, hit[:, i, w] & ~aired) | {"value": [float(v) for v in trace.value[:, 0, i, w]]})
    return out


def _lane(replay: Replay, name: str, unit: str, hit: Array) -> Data:
    return {"name": name, "unit": unit, "kinds": sorted(set(replay.trace.kind[hit, 0].tolist())), "hit": hit.astype(int).tolist()}


def _of_agent(replay: Replay, agent: int) -> Data:
    """The curves of one agent."""
    trace, model, follows = replay.trace, replay.loop.model, bool(replay.loop.model.followers[agent])
    limit = threshold(replay.loop.defence) or _energy_threshold(replay)
    score, alarm, gate = trace.score[:, 0, agent], trace.alarm[:, 0, agent], replay.gate[:, agent]
    rear = _road(replay, "rear_gap", agent)
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
            "road": {name: curve(_road(replay, name, agent)) for name in ("gap", "speed", "lead_speed", "position")},
            "rear": {name: curve(_road(replay, name, agent)) for name in ("rear_gap", "rear_speed")} if np.isfinite(rear).any() else None,
            "desired": curve(np.asarray(trace.desired_gap(_road(replay, "speed", agent)))),
            "believed": {"gap": curve(_believed_gap(replay, agent)), "speed": curve(np.asarray(speed))},
        }
    if model.actuators and (follows or model.agents == 1):
        commanded, applied = trace.control[:, 0, agent, 0], trace.applied[:, 0, agent, 0]
        out |= {"control": curve(commanded), "applied": None if (commanded == applied).all() else curve(applied)}
    return out


def _radar(replay: Replay, agent: int) -> Data:
    """What the radar did and heard: muted (K,), energy over its noise [dB], and where the defence declares it the threshold [dB].

    `then` (K,) is the true gap at the measurement, to which the belief of the step belongs.
    """
    trace = replay.trace
    sent = np.concatenate([[True], trace.probe[:-1, 0, agent]])  # each step's probe is chosen in the step before
    limit = _energy_threshold(replay)
    return {
        "muted": (~sent).astype(int).tolist(), "energy": curve(_decibels(trace.energy[:, 0, agent])),
        "threshold": None if limit is None else float(_decibels(np.asarray(limit[1]))),
        "then": curve(_road(replay, "gap", agent)[:-1]),
    }  # fmt: skip


def _energy_threshold(replay: Replay) -> tuple[str, float] | None:
    """Name and value of the threshold on the energy at a challenge; None of defences that make none."""
    value = getattr(replay.loop.plan.defence, "threshold", None) if "probe" in replay.loop.uses else None
    return ("energy", float(value)) if isinstance(value, float) else None


def _decibels(power: Array) -> Array:
    return np.asarray(10.0 * np.log10(np.maximum(power, 1e-9)))


def _errors(replay: Replay, agent: int) -> list[Data]:
    """The plots of an agent's errors: name, heading, unit, smallest span of the axis, values."""
    trace, model = replay.trace, replay.loop.model
    if model.agents == 1 and model.followers.any():
        off = trace.estimate[:, 0, 0] - trace.truth[:, 0, 0]
        parts = [("position", "position", "m", 1.0), ("velocity", "velocity", "m/s", 0.5)]
        if model.air:
            parts = [("gap-error", "gap", "m", 1.0), ("relative-speed-error", "relative speed", "m/s", 0.5)]
        return [
            {"name": name, "title": f"Estimation error of the {of}", "unit": unit, "least": least, "values": curve(off[:, i])}
            for i, (name, of, unit, least) in enumerate(parts)
        ]
    if not model.followers.any():
        return []  # the errors of all agents stand in one plot
    gap, speed = (error(trace.estimate[:, 0], trace.truth[:, 0])[:, agent] for error in (model.gap_error, model.speed_error))
    own = [("gap", "Error of the believed gap", "m", 1.0, gap)] if model.followers[agent] else []
    return [
        {"name": f"{name}-error", "title": title, "unit": unit, "least": least, "values": curve(values)}
        for name, title, unit, least, values in (*own, ("speed", "Error of the believed speed", "m/s", 0.5, speed))
    ]


def _everybody(replay: Replay, agents: list[int]) -> Data:
    """What the picture and the plots of all agents show."""
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
            "gap": [curve(_road(replay, "gap", i)) for i in cars], "speed": [curve(_road(replay, "speed", i)) for i in cars],
            "position": curve(_road(replay, "position", 0)),
            "believed": [curve(_believed_gap(replay, i)) if model.followers[i] else [] for i in cars],
        }  # fmt: skip
    else:
        places = layout(model.graph)
        low, wide = places.min(axis=0), np.ptp(places, axis=0)
        places = (places - low) / np.where(wide > 0.0, wide, 1.0) + np.where(wide > 0.0, 0.0, 0.5)
        out["graph"] = {"places": np.round(places, 4).tolist(), "edges": edges(model.graph), "error": [curve(e) for e in size.T]}
    return out


def episode_of(replay: Replay, agent: int | None = None) -> Data:
    """Everything that the page draws, as JSON data. agent: the one to look at first.

    Road signals have K + 1 entries, the first before the first step; all others K, entry s - 1 for step s. The curves of one agent stand
    at the top where there is only one, else below `agents`, by number.
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
        return out | _of_agent(replay, 0)
    agents = shown(replay, chosen)
    return out | _everybody(replay, agents) | {"agent": chosen, "agents": {i: _of_agent(replay, i) for i in agents}}
