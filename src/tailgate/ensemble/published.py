"""Attacks that the searches of the published boards found: later defences meet them too, where they have a meaning.

The package has a file for each suite (`configs/found`), which `benchmarks/found_attacks.py` makes from the suite's board.
"""

from __future__ import annotations

import base64
import functools
from importlib.resources import files
from pathlib import Path
from typing import Any

from tailgate.base.files import write_atomic
from tailgate.base.reading import load_json
from tailgate.core.scenario import load_suite
from tailgate.core.schema import as_data
from tailgate.ensemble.search import Arena

FOLDER = Path(str(files("tailgate.configs").joinpath("found")))
PATH = "path="  # how a text names a file


def found_against_others(arena: Arena, folder: Path) -> list[str]:
    """Return the attacks without knowledge of the defence that a board's searches found here, but for those against this defence.

    Parameters
    ----------
    arena
        The scenario and the dose; the defence, in any variant of it.
    folder
        The files of policies and programs are written here.

    Returns
    -------
    list of str
        Attacks as on the command line, each once. Empty for a suite without a published board, and for another grant.
    """
    held, own, out = _of(arena.suite), arena.defence.partition(":")[0], []
    if not held or held["threat"] != as_data(dict(arena.threat)):  # a suite of somebody else with this name
        return []
    for line in held["attacks"]:
        if (line["scenario"], line["dose"]) != (arena.name, arena.dose) or line["defence"].partition(":")[0] == own:
            continue
        text, mark, name = line["attack"].partition(PATH)
        out.append(f"{text}{mark}{_written(name, held['files'], folder)}" if mark else text)
    return list(dict.fromkeys(out))


def packed(board: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the JSON data of a suite's file. `folder` is where the board's texts name files from."""
    lines: list[dict[str, Any]] = []
    contents: dict[str, str] = {}
    for line in board["searches"]:
        for cell in line["cells"]:
            for one in cell["members"]:
                if not one["attack"] or one["member"] == "transfer" or (one["knowledge"] != "black" and one["member"] != "gradient"):
                    continue  # what was transferred is there already; a gradient's values are a program, which asks for no knowledge
                text, mark, name = one["attack"].partition(PATH)
                if mark:
                    _put(contents, folder / name)
                lines.append({
                    "scenario": cell["scenario"], "dose": cell["dose"], "defence": line["defence"],
                    "attack": f"{text}{mark}{Path(name).name}" if mark else text,
                })  # fmt: skip
    suite = board["suite"]["name"]
    return {"suite": suite, "threat": as_data(dict(load_suite(suite).granted)), "attacks": lines, "files": contents}


@functools.cache
def _of(suite: str) -> dict[str, Any]:
    """Return the data of a suite's file; empty where there is none."""
    names = {path.name.removesuffix(".json.xz"): path for path in FOLDER.glob("*.json.xz")}
    held: dict[str, Any] = load_json(names[suite]) if suite in names else {}
    return held


def _put(contents: dict[str, str], path: Path) -> None:
    """Put a file, and the tensors next to a policy, into the data."""
    for one in (path, path.with_suffix(".safetensors")) if path.suffix == ".json" else (path,):
        contents[one.name] = base64.b64encode(one.read_bytes()).decode()


def _written(name: str, contents: dict[str, str], folder: Path) -> Path:
    """Write a file, and the tensors next to a policy, where they are not there yet; return its path."""
    path = folder / name
    for one in (path.with_suffix(".safetensors"), path):
        if one.name in contents and not one.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            write_atomic(one, base64.b64decode(contents[one.name]))
    return path
