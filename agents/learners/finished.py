"""Finished trainings: the policy of such a seed is kept, and neither trained again nor written over."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tailgate.agents.policy.network_policy import load_policy
from tailgate.base.errors import InputError
from tailgate.core.registry import Spec


def finished(folder: Path, seed: int, defence: str, same: Callable[[Any], bool]) -> Path | None:
    """Return the policy of a seed whose training against a defence is over; None where there is something to train, or to go on with.

    same: tests if a policy's configuration is of the same training. Raises InputError where the policy is of another one and
    has no checkpoint to go on from: it would be written over.
    """
    path, spec = folder / f"policy-{seed}.json", Spec("defence", defence)
    checkpoint, curve = folder / f"checkpoint-{seed}.safetensors", folder / f"curve-{seed}.json"
    if not path.is_file() or not path.with_suffix(".safetensors").is_file():
        return None
    try:
        record = load_policy(path)[0].training
    except InputError:  # stopped between the two files, perhaps
        if checkpoint.exists():
            return None
        raise
    version = record.get("defence_version", spec.entry.version)  # the first policies do not say which
    met = record.get("defence_digest") == spec.digest and version == spec.entry.version
    if met and record.get("seed") == seed and same(record.get("config")):
        return path if curve.exists() or not checkpoint.exists() else None  # stopped between the two
    if checkpoint.exists():
        return None
    expected = f"a policy of this training against {defence}, or a checkpoint to go on from: move it, or train elsewhere"
    raise InputError("resume", str(path), expected)
