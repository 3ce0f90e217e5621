"""The meaning of a log's columns, and its data card."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from tailgate.core import draws
from tailgate.core.draws import Draws
from tailgate.core.loop import Loop
from tailgate.core.traces import cards

LICENCE = "CC0-1.0"
Role = Literal["key", "input", "defence", "label", "truth"]
ROLES = {
    "key": "which episode, step and agent",
    "input": "what a defence receives: a detector may read it",
    "defence": "what the defence that drove made of it: a detector may read it",
    "label": "what is to be found: a detector is trained on it and must not read it",
    "truth": "what nobody on the road knows: a detector must not read it",
}


class Column(NamedTuple):
    """One column: `type` is a constructor of pyarrow."""

    name: str
    type: str
    unit: str
    role: Role
    doc: str


def unit_of(wire: str) -> str:
    """Return the unit of a wire by the quantity in its name; 1 for the dimensionless sensors of a network."""
    for words, unit in (
        (("acceleration", "command"), "m/s^2"), (("speed", "velocity"), "m/s"), (("position", "distance", "gap"), "m"),
    ):  # fmt: skip
        if any(word in wire for word in words):
            return unit
    return "1"


def columns_of(loop: Loop) -> list[Column]:
    """Return the columns of a scenario's log, in their order."""
    model = loop.model
    out = [
        Column("suite", "string", "", "key", "suite"), Column("scenario", "string", "", "key", "scenario"),
        Column("split", "string", "", "key", "train or dev"), Column("defence", "string", "", "key", "defence that drove"),
        Column("attack", "string", "", "label", "attack of the episode; none: an episode without one"),
        Column("dose", "int64", "steps", "label", "attack budget of the episode; null: the scenario's own"),
        Column("episode", "int64", "", "key", "seed of the episode, whose noise and manoeuvre are the same in every cell of a split"),
        Column("k", "int64", "steps", "key", "step, from 1"), Column("t", "float64", "s", "key", "time of the step, k dt"),
        Column("agent", "int64", "", "key", "agent or car, from 0"),
    ]  # fmt: skip
    out += [Column(f"reading_{name}", "float64", unit_of(name), "input", f"reading of {name}, as it arrived") for name in model.sensors]
    out += [Column(f"valid_{name}", "bool_", "", "input", f"a reading of {name} arrived") for name in model.sensors]
    out += [Column(f"message_{name}", "float64", unit_of(name), "input", f"{name} in the message, as it arrived") for name in model.v2v]
    state = loop.plant.start(loop.plan.plant, _one_row())
    if loop.plant.odometry(loop.plan.plant, state).shape[-1]:
        out += [
            Column("odometry_position", "float64", "m", "input", "own position by trusted odometry"),
            Column("odometry_speed", "float64", "m/s", "input", "own speed by trusted odometry"),
        ]  # fmt: skip
    if model.air:
        out += [
            Column("energy", "float64", "1", "input", "power heard while the probe was muted, over the receiver's noise; else 0"),
            Column("probed", "bool_", "", "input", "the probe was sent in the step before"),
        ]  # fmt: skip
    out += [
        Column(f"known_input_{i}", "float64", "unit of the input", "input", f"input {i} of the model since the last step, 0 if unknown")
        for i in range(model.inputs)
    ]  # fmt: skip
    out += [Column(f"estimate_{i}", "float64", "unit of the state", "defence", f"estimate of state {i}") for i in range(model.states)]
    out += [
        Column(f"innovation_{name}", "float64", unit_of(name), "defence", f"reading of {name} less its prediction; null: none")
        for name in model.sensors
    ]  # fmt: skip
    out += [
        Column("score", "float64", "of the defence", "defence", "how suspect the step is, more is more"),
        Column("alarm", "bool_", "", "defence", "the defence alarms"),
        Column("mode", "string", "", "defence", "what the defence asks of the controller"),
        Column("attacked", "bool_", "", "label", "a wire of this agent was attacked in this step"),
        Column("attack_kind", "string", "", "label", "kind of that attack, or none"),
    ]  # fmt: skip
    out += [Column(f"truth_attacked_{name}", "bool_", "", "truth", f"the wire {name} was attacked") for name in model.wires]
    sent = model.sensors + model.v2v
    out += [Column(f"truth_sent_{name}", "float64", unit_of(name), "truth", f"{name} before the attack") for name in sent]
    out += [Column(f"truth_state_{i}", "float64", "unit of the state", "truth", f"state {i}") for i in range(model.states)]
    return [*out, Column("truth_collided", "bool_", "", "truth", "somebody collided in this step, the episode's last where that ends it")]


def recordings_of(manoeuvre: object) -> list[dict[str, str]]:
    """Return name, source, licence and attribution of the recorded drives that a manoeuvre plays."""
    named = [cards()[name] for name in getattr(manoeuvre, "traces", ()) if name in cards()]
    out = [{key: getattr(card, key) for key in ("name", "source", "licence", "attribution")} for card in named]
    if path := getattr(manoeuvre, "path", None):
        out.append({"name": path.name, "source": "a file given with the scenario", "licence": "that of the file", "attribution": ""})
    return out


def _one_row() -> Draws:
    return draws.keys("train", [0]).at(draws.Role.PRIOR, np.zeros(1, np.int64))


def readme(held: dict[str, Any]) -> str:
    """Return the data card (README.md) of a log, from what schema.json holds."""
    out = [f"# Episodes of {held['suite']}", "", held["about"] or "Simulated episodes.", ""]
    recorded = {one["name"]: one for scenario in held["scenarios"].values() for one in scenario["recordings"]}
    out += [
        f"Made by tailgate {held['version']}, format {held['format']}, identity {held['identity']}. "
        + ("The speed of the leader is recorded:" if recorded else "Everything is simulated: nobody's data is in it."),
        "",
    ]
    for one in recorded.values():
        out.append(f"- **{one['name']}**: {one['source']}. Licence: {one['licence']}. {one['attribution']}".rstrip())
    out += [
        *(["", "All else is simulated.", ""] if recorded else []),
        f"One row per step and agent, in the order of cell, episode, step and agent; one row group or more per cell. "
        f"Licence{' of what is simulated' if recorded else ''}: {LICENCE}.",
        "",
        "## What it is for",
        "",
        "To learn detectors of attacks on sensors. The columns say what a detector may read. A row's neighbours in an episode are not "
        "independent of it: split by episode, never by row, and use `dev` for every choice. The boards are scored on other seeds.",
        "",
        f"**Held out:** {', '.join(held['held_out']) or 'nothing'}. Attacks of these families are in no file here, and the board has them"
        f"{': ' if held['left_out'] else ''}{', '.join(f'`{text}`' for text in held['left_out'])}. "
        f"Within a family that is here, the board's other doses and scenarios are new to a detector too.",
        "",
        "| split | seeds of the purpose | file | rows | row groups | SHA-256 |",
        "|---|---|---|---|---|---|",
    ]
    for f in held["files"]:
        out.append(f"| {f['split']} | {held['splits'][f['split']]} | {f['path']} | {f['rows']} | {f['row_groups']} | {f['sha256']} |")
    doses = ", ".join("the scenario's own" if dose is None else f"{dose} steps" for dose in held["doses"])
    out += [
        "",
        "Defences that drove: " + ", ".join(f"`{name}`" for name in held["defences"]) + f". Attack budget: {doses}. Attacks:",
        "",
        *(f"- `{name}`" for name in held["attacks"]),
    ]
    if held["skipped"]:
        out += ["", "Pairings without meaning, which are not here:", ""]
        out += [f"- {s['split']}: {s['scenario']}, `{s['defence']}` against `{s['attack']}`: {s['reason']}" for s in held["skipped"]]
    out += ["", "## Columns", "", "`schema.json` has the same for programs.", ""]
    out += [f"- **{role}**: {words}" for role, words in ROLES.items()]
    for name, scenario in held["scenarios"].items():
        out += [
            "", f"### {name}", "",
            f"{scenario['about']} dt {scenario['dt']} s, {scenario['horizon']} steps, agents: {scenario['agents']}, configuration "
            f"{scenario['config_hash']}.",
            "", "| column | type | unit | role | meaning |", "|---|---|---|---|---|",
        ]  # fmt: skip
        out += [f"| {c['name']} | {c['type'].strip('_')} | {c['unit']} | {c['role']} | {c['doc']} |" for c in scenario["columns"]]
    return "\n".join(out) + "\n"
