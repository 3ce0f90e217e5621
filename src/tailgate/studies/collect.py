"""Putting a trained policy into the zoo, with the record of how it was made and what it did."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load as load_tensors
from safetensors.numpy import save as save_tensors

from tailgate.agents.policy.zoo import FOLDER, zoo_names
from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_atomic
from tailgate.core import Array, Attack, draws
from tailgate.core.registry import Spec
from tailgate.core.schema import as_data
from tailgate.play.metrics import METRICS, unit_in

from .policies import defence_of, loop_for, mean, outcome_for, scenario_of, trained
from .timing import played

POINTS = 50  # of a learning curve, at most
BYTES = 40_000  # of a tensor file, at most
EPISODES = 400  # that a policy is measured on
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


def thinned(curve: list[Any], points: int = POINTS) -> list[Any]:
    """Return at most `points` of a learning curve, evenly spaced, the first and the last among them."""
    if len(curve) <= points:
        return list(curve)
    return [curve[round(i * (len(curve) - 1) / (points - 1))] for i in range(points)]


def single(x: Array) -> Array:
    """Return the array as float32 where no value changes by it, else as it is."""
    small = x.astype(np.float32)
    return small if np.array_equal(small.astype(np.float64), x) else x


def packed(file: Path) -> bytes:
    """Return a tensor file as the zoo keeps it, its arrays as `single` has them: of equal values, of equal bytes."""
    return save_tensors({key: single(x) for key, x in load_tensors(file.read_bytes()).items()})


def add_policy(policy: Path, name: str, summary: str, *, episodes: int = EPISODES, replace: bool = False, folder: Path = FOLDER) -> Path:
    """Copy a trained policy into the zoo as `name`; returns its JSON file. Its outcome is measured again, on report seeds.

    Raises InputError for a policy without a record of its training, and for one that is too large. Without `replace` it raises one too
    for a name that is taken.
    """
    if not _NAME.fullmatch(name) or name.endswith((".json", ".safetensors")):
        raise InputError("zoo.name", name, "letters, digits, '-', '_' and '.', and no separator")
    if not summary.strip():
        raise InputError("zoo.summary", summary, "a sentence")
    known = zoo_names() if folder == FOLDER else [path.stem for path in folder.glob("*.json")]
    if name in known and not replace:
        raise InputError("zoo.name", name, "a name that is not taken, or --replace")
    who = trained(str(policy))
    header = who.header
    scenario, record = scenario_of(who), header.training
    curve = record.get("curve", [])
    if not isinstance(curve, list) or not all(isinstance(point, dict) for point in curve):
        raise InputError(f"policy {who.name}.training.curve", curve, "a list of points, a mapping each")
    loop = loop_for(who, scenario, defence_of(who), who.threat)
    blob = packed(policy.with_name(header.tensors))
    if len(blob) > BYTES:
        raise InputError("zoo", f"a tensor file of {len(blob)} bytes", f"at most {BYTES}")
    keys = draws.keys("report", range(sizes.check("episodes", episodes)))
    outcome = outcome_for(who.outcome, scenario)

    def measured(attack: Attack) -> dict[str, float]:
        return mean(np.stack(played(loop, attack, keys, None, [METRICS[outcome]])), outcome)._asdict()

    training = record | {
        "summary": summary, "curve": thinned(curve), "threat_model": as_data(loop.threat),
        "source_sha256": header.sha256,
        "measured": {
            "outcome": outcome, "unit": unit_in(outcome, loop.model), "purpose": "report", "episodes": episodes, **measured(who.policy),
            "no_attack": measured(Spec("attack", "none").make()),
        },
    }  # fmt: skip
    data = json.loads(policy.read_text(encoding="utf-8")) | {
        "tensors": f"{name}.safetensors", "sha256": hashlib.sha256(blob).hexdigest(), "training": training,
    }  # fmt: skip
    try:
        text = json.dumps(data, indent=1, allow_nan=False)
    except ValueError as error:
        raise InputError(f"policy {who.name}.training", "nan or inf", f"finite numbers ({error})") from None
    file = writable_directory(folder, "zoo") / f"{name}.json"
    write_atomic(file.with_name(f"{name}.safetensors"), blob, "zoo")
    write_atomic(file, text.encode() + b"\n", "zoo")
    return file


def add_run(run: Path, prefix: str, summary: str = "", *, episodes: int = EPISODES, replace: bool = False) -> list[Path]:
    """Copy every policy of a training run into the zoo as PREFIX-SEED."""
    found = sorted(run.glob("policy-*.json"))
    if not found:
        raise InputError("run", str(run), "the directory of a training run, with policy-SEED.json files")
    out = []
    for path in found:
        who = trained(str(path))
        seed = path.stem.removeprefix("policy-")
        text = summary or f"{who.learner} against {who.defence} on {who.scenario}, training seed {seed}"
        out.append(add_policy(path, f"{prefix}-{seed}", text, episodes=episodes, replace=replace))
    return out


def facts(path: Path) -> dict[str, Any]:
    """Return what the command prints of a policy that was added."""
    data = json.loads(path.read_text(encoding="utf-8"))
    size = path.with_suffix(".safetensors").stat().st_size
    return {"name": path.stem, "file": str(path), "bytes": size, "sha256": data["sha256"], "measured": data["training"]["measured"]}
