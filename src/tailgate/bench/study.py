"""Scaffold of the one-off studies. Each is a script in the folder of its record, and the record says what made it."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from tailgate.base.files import write_atomic
from tailgate.base.provenance import commit
from tailgate.base.version import VERSION


def arguments(script: str, doc: str | None) -> argparse.ArgumentParser:
    """Return the parser of a study (its `__file__` and `__doc__`), with `--out`, the record in the same folder."""
    made = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    record = Path(script).with_suffix(".json")
    made.add_argument("--out", type=Path, default=record, help="where the record goes (default: the study's folder)")
    return made


def made_by(*packages: str) -> dict[str, Any]:
    """Return what a record rests on: command, version, commit, machine, its load, and these packages."""
    return {
        "command": " ".join(["python", *sys.argv]), "version": VERSION, "commit": commit(), "machine": platform.machine(),
        "cores": os.cpu_count(), "load": [round(x, 2) for x in os.getloadavg()], "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }  # fmt: skip


def write_record(path: Path, record: Mapping[str, Any], by_lines: bool = False) -> None:
    """Write a record as JSON, indented; `by_lines` gives each field, and each entry of a list, a line."""
    text = _by_lines(record) if by_lines else json.dumps(record, indent=1, allow_nan=False)
    write_atomic(path, text.encode() + b"\n")


def _by_lines(record: Mapping[str, Any]) -> str:
    fields = []
    for key, value in record.items():
        held = json.dumps(value, allow_nan=False)
        if isinstance(value, list) and value:
            held = "[\n" + ",\n".join(json.dumps(entry, allow_nan=False) for entry in value) + "\n]"
        fields.append(f"{json.dumps(key)}: {held}")
    return "{\n" + ",\n".join(fields) + "\n}"
