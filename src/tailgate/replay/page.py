"""The page of a replay: one HTML file with the episode in it, which asks for nothing else."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import inspect
import json
import math
import re
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from tailgate.core import Array, Kind, Mode
from tailgate.files import writable_directory, write_atomic
from tailgate.leaderboard.build import names_of
from tailgate.metrics import METRICS, UNITS

from .replay import AGENT, Replay, threshold

Data = dict[str, Any]
DIGITS = 6  # of a curve; decisions are exact
WIRE_UNITS = {"position": "m", "velocity": "m/s", "acceleration": "m/s\N{SUPERSCRIPT TWO}"}
KINDS = {  # what a reader sees of a kind: short name, name, what it does to the wire
    Kind.DOS_JAM: ("JAM", "DoS jam", "the receiver reads the jammer's value"),
    Kind.DOS_HOLD: ("HOLD", "DoS hold", "the receiver is stuck at the last reading before the first attack"),
    Kind.DOS_HOLD_FRESH: ("HOLD*", "DoS hold (fresh)", "the receiver is stuck at the last reading before this burst"),
    Kind.DROPOUT: ("DROP", "dropout", "nothing arrives, and the receiver knows it"),
    Kind.FDI: ("FDI", "false data injection", "the value is added"),
    Kind.DELAY: ("DELAY", "delay", "the receiver reads what was sent so many steps ago"),
    Kind.REPLAY: ("REPLAY", "replay", "the receiver reads the last so many samples over and over"),
}
VALUED = {Kind.DOS_JAM: "", Kind.FDI: "", Kind.DELAY: "steps", Kind.REPLAY: "steps"}  # unit; empty: that of the wire
VERDICTS = {
    "same": ("good", "The same trace, bit for bit", "every signal of every step has the hash that the row records"),
    "decisions": ("warn", "The same decisions, not the same bits", "commands, alarms, modes and collisions agree, other signals differ"),
    "different": ("bad", "NOT the episode of the row", "trace and decisions differ from what the row records"),
    "unknown": ("warn", "Cannot be checked", "the row records no hash"),
}  # fmt: skip
NO_ENTRY = "not recorded"
LABELS = {"version": "version of Tailgate", "config_hash": "configuration (config_hash)", "versions": "versions of the components"}


def _curve(values: Array) -> list[float | None]:
    """Numbers for drawing: some digits, null where not finite."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in values.tolist()]


def _road(replay: Replay, name: str) -> Array:
    """(K + 1,): before the first step, then after each."""
    trace = replay.trace
    return np.concatenate([trace.first[name][:, AGENT], trace.signals[name][:, 0, AGENT]])


def _believed_gap(replay: Replay) -> Array:
    """(K,) the leader's position as the controller heard it, less the estimated own one."""
    trace, model = replay.trace, replay.loop.model
    if "leader_position" in model.v2v:
        leader = trace.wires[:, 0, AGENT, model.wires.index("leader_position")]
    else:
        leader = (_road(replay, "position") + _road(replay, "gap"))[:-1]
    return np.asarray(leader - trace.estimate[:, 0, AGENT, 0])


def _wires(replay: Replay) -> list[Data]:
    """The wires that were ever attacked, each with the kinds that hit it."""
    trace, out = replay.trace, []
    for i, name in enumerate(replay.loop.model.wires):
        hit = trace.target[:, 0, AGENT, i] & (trace.kind[:, 0] != Kind.NONE)
        if hit.any():
            kinds = sorted(set(trace.kind[hit, 0].tolist()))
            out.append({
                "name": name.replace("_", " "), "unit": WIRE_UNITS.get(name.split("_")[-1], ""), "kinds": kinds,
                "hit": hit.astype(int).tolist(), "value": [float(v) for v in trace.value[:, 0, AGENT, i]],
            })  # fmt: skip
    return out


def episode_of(replay: Replay) -> Data:
    """Everything that the page draws, as JSON data.

    Road signals have K + 1 entries, the first before the first step; all others K, entry s - 1 for step s.
    """
    trace, threat = replay.trace, replay.loop.threat
    commanded, applied = trace.control[:, 0, AGENT, 0], trace.applied[:, 0, AGENT, 0]
    kind, rear = trace.kind[:, 0], _road(replay, "rear_gap")
    used = np.concatenate([[0], np.cumsum(kind != Kind.NONE)])
    limit, score, alarm = threshold(replay.loop.defence), trace.score[:, 0, AGENT], trace.alarm[:, 0, AGENT]
    return {
        "dt": trace.dt, "horizon": trace.horizon, "length": int(trace.length[0]),
        "road": {name: _curve(_road(replay, name)) for name in ("gap", "speed", "lead_speed", "position")},
        "rear": {name: _curve(_road(replay, name)) for name in ("rear_gap", "rear_speed")} if np.isfinite(rear).all() else None,
        "desired": _curve(np.asarray(trace.desired_gap(_road(replay, "speed")))),
        "believed": {"gap": _curve(_believed_gap(replay)), "speed": _curve(trace.estimate[:, 0, AGENT, 1])},
        "error": {
            name: _curve(trace.estimate[:, 0, AGENT, i] - trace.truth[:, 0, AGENT, i]) for i, name in enumerate(("position", "velocity"))
        },
        "score": _curve(score), "alarm": alarm.astype(int).tolist(), "mode": trace.mode[:, 0, AGENT].tolist(),
        "modes": [mode.name for mode in Mode],
        "threshold": None if limit is None else {"name": limit[0], "value": limit[1], "rules": bool(((score > limit[1]) == alarm).all())},
        "gate": _curve(replay.gate) if limit is None and np.isfinite(replay.gate).any() else None,
        "control": _curve(commanded), "applied": None if (commanded == applied).all() else _curve(applied),
        "kind": kind.tolist(), "wires": _wires(replay), "refused": trace.refused[:, 0].astype(int).tolist(),
        "kinds": {int(k): {"code": code, "name": name, "does": does, "valued": k in VALUED, "unit": VALUED.get(k, "")}
                  for k, (code, name, does) in KINDS.items()},
        "left": None if threat.budget is None else (threat.budget - used).tolist(), "budget": threat.budget,
        "hit": _first(trace.collided[:, 0]), "rear_hit": _first(trace.rear_collided[:, 0]),
    }  # fmt: skip


def _first(event: Array) -> int | None:
    """The first step (from 1) in which something happened."""
    return int(np.argmax(event)) + 1 if event.any() else None


def outcome(replay: Replay) -> str:
    """How the episode went, in a sentence."""
    trace, metrics = replay.trace, replay.metrics
    hits = [(trace.collided, "the car hit the one ahead"), (trace.rear_collided, "the car behind hit the car")]
    words = [f"{what} at t = {step * trace.dt:.4g} s (step {step})" for signal, what in hits if (step := _first(signal[:, 0])) is not None]
    if metrics["collided"] and metrics["impact_speed"] is not None:
        words[0] += f", closing at {metrics['impact_speed']:.3g} m/s"
    if words:
        return "Collision: " + "; ".join(words)
    gap = metrics["min_gap"]
    return "No collision" + ("" if gap is None else f"; the smallest gap was {gap:.3g} m")


def _text(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Path):
        return value.name
    if isinstance(value, tuple | list):
        return ", ".join(_text(v) for v in value) or "none named"
    if isinstance(value, dict):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items()) or "none"
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def _card(title: str, part: Any, label: str = "") -> Data:
    """A component and its parameters with their sentences."""
    fields = dataclasses.fields(part) if dataclasses.is_dataclass(part) else ()
    shown = [(f.name, _text(getattr(part, f.name)), f.metadata.get("doc", "")) for f in fields if f.init]
    about = (inspect.getdoc(type(part)) or "").split("\n\n")[0].replace("\n", " ")
    return {"title": title, "label": label or type(part).__name__, "about": about, "fields": shown}


def _named(text: str) -> str:
    """A component's text as people read it: of a file, the folder and the name, not the place on somebody's machine."""
    return names_of([text])[text].full


def _identity(replay: Replay) -> list[tuple[str, str]]:
    """The row's own words about what it is: all but the figures and the threat model."""
    skipped = {*METRICS, "threat_model", "status", "reason"}
    shown: dict[str, Callable[[Any], str]] = {"defence": _named, "attack": _named, "scenario_file": _file_name}
    row = replay.row.items()
    return [(key.replace("_", " "), shown.get(key, _text)(value)) for key, value in row if key not in skipped and value not in ("", None)]


def _file_name(path: str) -> str:
    return re.split(r"[\\/]", path)[-1]


def context_of(replay: Replay, source: str) -> Data:
    """What the template shows in words and tables. `source` says where the row comes from."""
    row, place = replay.row, replay.place
    tone, title, why = VERDICTS[replay.verdict]
    crash = bool(replay.metrics["crashed"])
    metrics = [
        (name.replace("_", " "), _measured(value), UNITS[name], " ".join((METRICS[name].__doc__ or "").split()),
         _measured(row[name]) if row[name] != value else "")
        for name, value in replay.metrics.items()
    ]  # fmt: skip
    cards = [_card(part, getattr(place, part)) for part in ("plant", "sensor", "controller", "manoeuvre")]
    return {
        "source": source,
        "defence": _named(row["defence"]), "attack": _named(row["attack"]), "seed": row["seed"], "purpose": row["purpose"],
        "check": {"tone": tone, "title": title, "why": why}, "crash": crash, "outcome": outcome(replay), "metrics": metrics,
        "differences": [(LABELS.get(c.name, c.name.replace("_", " ")), c.row or NO_ENTRY, c.here or "none") for c in replay.differences],
        "hashes": [(c.name, c.row or NO_ENTRY, c.here, c.same) for c in replay.checks[:2]],
        "identity": _identity(replay),
        "scenario": {
            "name": place.name, "about": place.about, "horizon": place.horizon, "dt": f"{replay.trace.dt:.6g}",
            "seconds": f"{place.horizon * replay.trace.dt:.6g}", "ends": place.ends_on_collision, "cards": cards,
        },
        "threat": _card("threat model", place.threat_model),
        "players": [_card("defence", replay.loop.defence, _named(row["defence"])), _card("attack", replay.attack, _named(row["attack"]))],
    }  # fmt: skip


def _measured(value: float | None) -> str:
    return "\N{EN DASH}" if value is None else f"{value:.6g}".replace("-", "\N{MINUS SIGN}")


def _asset(*names: str) -> str:
    return "".join(files("tailgate.replay").joinpath(name).read_text(encoding="utf-8") for name in names)


def _inline(text: str) -> Data:
    """A style sheet or script as it stands in the page, and its hash: the page's policy lets nothing else run."""
    return {"text": Markup(text), "hash": base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}


def embedded(data: Any) -> Markup:
    """JSON for a script element: nothing in it can end the element or open another."""
    text = json.dumps(data, allow_nan=False, separators=(",", ":"))
    for char in "<>&\u2028\u2029":
        text = text.replace(char, f"\\u{ord(char):04x}")
    return Markup(text)


def render(replay: Replay, source: str = "") -> str:
    """The page as text."""
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    css, js = _inline(_asset("page.css")), _inline(_asset("road.js", "plots.js", "page.js"))
    data = embedded(episode_of(replay))
    return environment.from_string(_asset("page.html")).render(css=css, js=js, data=data, **context_of(replay, source))


def write_page(replay: Replay, out: Path, source: str = "") -> Path:
    """Writes the page to `out` (a file that ends in .html, or a directory for index.html) and returns its path."""
    path = out if out.suffix.lower() in (".html", ".htm") else writable_directory(out) / "index.html"
    write_atomic(path, render(replay, source).encode("utf-8", "replace"))  # a lone surrogate in a row must not stop the page
    return path
