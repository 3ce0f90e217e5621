"""The journal of a search: what its members have found so far, so that an interrupted search goes on behind the last one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tailgate.base.errors import InputError
from tailgate.base.files import writable_directory, write_atomic
from tailgate.base.reading import load_json
from tailgate.core.registry import Spec
from tailgate.ensemble.members import Harvest, Hunt
from tailgate.ensemble.search import Found


def write(path: Path, hunt: Hunt, found: list[Harvest]) -> None:
    """Write what the members have found, and what later members begin with."""
    data = {
        "members": [one._asdict() | {"found": [attack._asdict() for attack in one.found]} for one in found],
        "genomes": None if hunt.genomes is None else np.asarray(hunt.genomes).tolist(), "starts": hunt.starts,
    }  # fmt: skip
    write_atomic(writable_directory(path.parent) / path.name, json.dumps(data).encode())


def resume(path: Path, hunt: Hunt) -> list[Harvest]:
    """Return what members have found, and put into a search what later members begin with; nothing without a whole journal."""
    try:
        data = load_json(path)
        out = [Harvest(**one | {"found": [Found(**attack) for attack in one["found"]]}) for one in data["members"]]
        attacks = [found.attack for one in out for found in one.found]
        for text in attacks:
            Spec("attack", text).refuse_imports("journal")  # only a command line names code
        files = [Path(text.partition("path=")[2]) for text in attacks if text.startswith(("program:path=", "policy:path="))]
        genomes, starts = data["genomes"], [str(name) for name in data["starts"]]
        if not all(file.is_file() for file in files):
            return []
        hunt.genomes = None if genomes is None else np.array(genomes, np.float64)
    except (OSError, KeyError, TypeError, ValueError, InputError):
        return []  # it is only time that is lost
    hunt.starts = starts
    hunt.found |= {one.member: one.found for one in out}
    return out
