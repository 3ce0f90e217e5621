"""The page of a replay: one HTML file that contains the episode and needs no other file."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.assets import embedded, inline, templates
from tailgate.base.files import write_html
from tailgate.board.words import names_of
from tailgate.play.metrics import METRICS, unit_in

from .episode import Data, episode_of, first_step, noun
from .replay import Replay

VERDICTS = {
    "same": ("good", "The same trace, bit for bit", "every signal of every step has the hash that the row records"),
    "figures": ("bad", "The trace of the row, but other figures", "every signal agrees, and metrics differ from what the row records"),
    "decisions": ("warn", "The same decisions, not the same bits", "commands, alarms, modes and collisions agree, other signals differ"),
    "different": ("bad", "NOT the episode of the row", "trace and decisions differ from what the row records"),
    "unknown": ("warn", "Cannot be checked", "the row records no hash"),
}  # fmt: skip
NO_ENTRY = "not recorded"
LABELS = {"version": "version of Tailgate", "config_hash": "configuration (config_hash)", "versions": "versions of the components"}


def outcome(replay: Replay) -> str:
    """Return the outcome of the episode in a sentence."""
    trace, metrics, model = replay.trace, replay.metrics, replay.loop.model
    if not model.followers.any():
        size = model.error(trace.estimate[:, 0], trace.truth[:, 0])
        last, agent = divmod(int(np.argmax(size)), model.agents)
        when = f"at t = {(last + 1) * trace.dt:.4g} s (step {last + 1})"
        return f"The largest error of an estimate was {size.max():.4g}, of agent {agent} {when}"
    if model.lane:
        left = first_step(trace.collided[:, 0])
        if left is not None:
            return f"The car left its lane at t = {left * trace.dt:.4g} s (step {left}), at {metrics['impact_speed']:.3g} m/s across"
        gap = metrics["min_gap"]
        return "The car kept its lane" + ("" if gap is None else f"; it came as near as {gap:.3g} m to a line")
    ahead, behind = "the car hit the one ahead", "the car behind hit the car"
    if model.agents > 1 and (step := first_step(trace.collided[:, 0])) is not None:
        car = int(np.argmin(trace.gap[step - 1, 0]))
        ahead = f"car {car} hit {'the leader' if car == (0 if model.followers[0] else 1) else f'car {car - 1}'}"
    hits = [(trace.collided, ahead), (trace.rear_collided, behind)]
    found = [(what, at) for signal, what in hits if (at := first_step(signal[:, 0])) is not None]
    words = [f"{what} at t = {at * trace.dt:.4g} s (step {at})" for what, at in found]
    if metrics["collided"] and metrics["impact_speed"] is not None:
        words[0] += f", closing at {metrics['impact_speed']:.3g} m/s"
    if words:
        return "Collision: " + "; ".join(words)
    gap = metrics["min_gap"]
    return "No collision" + ("" if gap is None else f"; the smallest gap was {gap:.3g} m")


def _text(value: object) -> str:
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


def _card(title: str, part: object, label: str = "") -> Data:
    """Return a component and its parameters with their descriptions."""
    fields = dataclasses.fields(part) if dataclasses.is_dataclass(part) else ()
    shown = [(f.name, _text(getattr(part, f.name)), f.metadata.get("doc", "")) for f in fields if f.init]
    about = (inspect.getdoc(type(part)) or "").split("\n\n")[0].replace("\n", " ")
    return {"title": title, "label": label or type(part).__name__, "about": about, "fields": shown}


def _named(text: str) -> str:
    """Return a component's text for readers; of a file, the folder and the name instead of the full path."""
    return names_of([text])[text].full


def _identity(replay: Replay) -> list[tuple[str, str]]:
    """Return the row's fields that identify the episode, without metrics and threat model."""
    skipped = {*METRICS, "threat_model", "status", "reason", "failed"}
    shown: dict[str, Callable[[Any], str]] = {"defence": _named, "attack": _named, "scenario_file": _file_name}
    row = replay.row.items()
    return [(key.replace("_", " "), shown.get(key, _text)(value)) for key, value in row if key not in skipped and value not in ("", None)]


def _file_name(path: str) -> str:
    return re.split(r"[\\/]", path)[-1]


PICTURES = {  # captions of the canvas
    "road": "The road as it is, and where the car believes that it is",
    "lane": "The lane from above: the car, and as an outline where it believes that it is",
    "string": "The road as it is, and where each car believes that it is",
    "graph": "The graph of the agents, shaded by their errors",
}  # fmt: skip


def context_of(replay: Replay, source: str) -> Data:
    """Return the words and tables of the template. `source` says where the row comes from."""
    model = replay.loop.model
    picture = "graph" if not model.followers.any() else "lane" if model.lane else "string" if model.agents > 1 else "road"
    row, place = replay.row, replay.place
    tone, title, why = VERDICTS[replay.verdict]
    tone_of = "plain" if picture == "graph" else "bad" if replay.metrics["crashed"] else "good"
    metrics = [
        (name.replace("_", " "), _measured(value), unit_in(name, replay.loop.model), " ".join((METRICS[name].__doc__ or "").split()),
         _measured(row[name]) if row[name] != value else "")
        for name, value in replay.metrics.items()
    ]  # fmt: skip
    cards = [_card(part, getattr(place, part)) for part in ("plant", "sensor", "controller", "manoeuvre")]
    return {
        "source": source, "picture": PICTURES[picture], "many": model.agents > 1, "noun": noun(replay),
        "defence": _named(row["defence"]), "attack": _named(row["attack"]), "seed": row["seed"], "purpose": row["purpose"],
        "check": {"tone": tone, "title": title, "why": why}, "tone": tone_of, "outcome": outcome(replay), "metrics": metrics,
        "failed": failed(row),
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


def failed(row: Data) -> Data | None:
    """Return the property that the run of a row fails, as `tailgate trust` recorded it."""
    held = row.get("failed")
    return {key: str(held.get(key) or "") for key in ("property", "about", "formula")} if isinstance(held, dict) else None


def _measured(value: float | None) -> str:
    return "\N{EN DASH}" if value is None else f"{value:.6g}".replace("-", "\N{MINUS SIGN}")


def render(replay: Replay, source: str = "", agent: int | None = None) -> str:
    """Return the page as text; `agent` is the agent to show first."""
    here = "tailgate.replay"
    css, js = inline(here, "page.css"), inline(here, "pen.js", "road.js", "lane.js", "string.js", "graph.js", "plots.js", "page.js")
    data = embedded(episode_of(replay, agent))
    return templates(here).get_template("page.html").render(css=css, js=js, data=data, **context_of(replay, source))


def page_at(out: Path) -> Path:
    """Return the file of a page: `out` if it is an .html file, else index.html in that directory."""
    return out if out.suffix.lower() in (".html", ".htm") else out / "index.html"


def write_page(replay: Replay, out: Path, source: str = "", agent: int | None = None) -> Path:
    """Write the page to `page_at(out)`, and return its path."""
    path = page_at(out)
    write_html(path, render(replay, source, agent).encode("utf-8", "replace"))  # a lone surrogate in a row must not stop the page
    return path
