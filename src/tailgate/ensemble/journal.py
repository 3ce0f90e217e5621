"""The journal of a search: what its members have found so far, so that an interrupted search goes on behind the last one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_atomic
from tailgate.base.reading import load_json
from tailgate.core.registry import Spec
from tailgate.ensemble.members import Harvest, Hunt, Member, members_of
from tailgate.ensemble.search import Found


def write(path: Path, hunt: Hunt, found: list[Harvest]) -> None:
    """Write what the members have found, and what later members begin with."""
    data = {
        "members": [one._asdict() | {"found": [attack._asdict() for attack in one.found]} for one in found],
        "genomes": None if hunt.genomes is None else np.asarray(hunt.genomes).tolist(), "starts": hunt.starts,
    }  # fmt: skip
    write_atomic(writable_directory(path.parent) / path.name, json.dumps(data).encode())


def resume(path: Path, hunt: Hunt) -> list[Harvest]:
    """Return what the first members have found, and put into a search what later members begin with; nothing without a whole journal."""
    try:
        data = load_json(path)
        out = [_harvest(one, member) for one, member in zip(data["members"], members_of(hunt), strict=False)]
        genomes, starts = data["genomes"], [str(name) for name in data["starts"]]
        held = None if genomes is None else np.array(genomes, np.float64)
        if len(out) < len(data["members"]) or (held is not None and (held.ndim != 2 or not np.isfinite(held).all())):
            return []
    except (OSError, KeyError, TypeError, ValueError, InputError):
        return []  # it is only time that is lost
    hunt.genomes, hunt.starts = held, starts
    hunt.found |= {one.member: one.found for one in out}
    return out


def _harvest(data: dict[str, Any], member: Member) -> Harvest:
    """Return what a member found. Raises for another member's, for what names code, and for files that are gone."""
    if (data["member"], data["knowledge"]) != (member.name, member.knowledge):
        raise ValueError("another member")
    found = [Found(str(one["attack"]), float(one["damage"]), float(one["score"]), int(one["episodes"])) for one in data["found"]]
    for one in found:
        spec = Spec("attack", one.attack)
        spec.refuse_imports("journal")  # only a command line names code
        spec.make()  # reads its files
        if not 0.0 <= one.damage <= 1.0:
            raise ValueError("no share")
    return Harvest(member.name, member.knowledge, found, str(data["why"]))
