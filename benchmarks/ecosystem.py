"""Libraries around this one, each with its snippet of docs/ecosystem.md; writes the record that the page's table is made from.

    python benchmarks/ecosystem.py [--library NAME ...] [--scratch DIR] [--out benchmarks/results/ecosystem.json]

Each library gets a virtual environment: torch first, pinned as constraints.txt says, then library and Tailgate in one resolution, so that
a pin of the library's chooses the versions. An environment that DIR holds already is used again. Libraries that are not asked for keep
their entries. --table prints the page's table and runs nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from tailgate.base.errors import unknown
from tailgate.base.files import write_atomic
from tailgate.base.progress import progress

ROOT = Path(__file__).parents[1]
PAGE, RECORD = ROOT / "docs/ecosystem.md", ROOT / "benchmarks/results/ecosystem.json"
LIMIT = 600  # seconds for a snippet
OWN = str(ROOT)
CLEANRL = "https://raw.githubusercontent.com/vwxyzjn/cleanrl/fe8d8a03c41a7ef5b523e2e354bd01c363e786bb/cleanrl"


class Library(NamedTuple):
    """A section of the page: what to install next to Tailgate, the distributions to name, and if Tailgate's extras hold it."""

    install: tuple[str, ...]
    named: tuple[str, ...]
    extra: bool = False
    torch: bool = True
    file: str = ""  # a file that the snippet needs, by its address; one that DIR holds already is used again
    learns: float = 0.0  # collisions in percent of the episodes that a recipe has to reach; random actions: about 7


LIBRARIES = {
    "Gymnasium": Library((OWN,), (), True, False),
    "Stable-Baselines3": Library((f"{OWN}[train]",), ("stable-baselines3", "torch"), True),
    "rl-zoo3": Library((OWN, "rl_zoo3>=2.9"), ("rl_zoo3", "stable-baselines3", "torch")),
    "CleanRL": Library((OWN, "tyro", "tensorboard"), ("torch", "tyro", "tensorboard"), file=f"{CLEANRL}/ppo.py", learns=60.0),
    "TorchRL": Library((f"{OWN}[torchrl]",), ("torchrl", "tensordict", "torch"), True, learns=60.0),
    "RLlib": Library((OWN, "ray[rllib]>=2.60"), ("ray", "torch")),
    "PettingZoo": Library((f"{OWN}[game]",), ("pettingzoo",), True, False),
    "Minari": Library((OWN, "minari[hdf5,create]>=0.5"), ("minari",), False, False),
    "Tianshou": Library((OWN, "tianshou[eval]>=2"), ("tianshou", "torch")),
    "d3rlpy": Library((OWN, "d3rlpy>=2.8"), ("d3rlpy", "torch")),
    "SBX": Library((OWN, "sbx-rl>=0.28"), ("sbx-rl", "jax", "stable-baselines3", "torch")),
}


def snippet(name: str, page: str) -> str:
    """Return the first Python block under the library's heading."""
    found = re.search(rf"^## {re.escape(name)}\n(?:(?!## )[^\n]*\n)*?```python\n(.*?)^```", page, flags=re.S | re.M)
    if found is None:
        raise unknown("library", name, LIBRARIES)
    return found[1]


def environment(library: Library, folder: Path) -> str:
    """Make the virtual environment, unless it is there; return the last error line of the installer, or nothing."""
    ready = folder / ".ready"
    if ready.exists():
        return ""
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    pinned = ["--constraint", str(ROOT / "constraints.txt")]
    for what in ([[*pinned, "torch"]] if library.torch else []) + [list(library.install)]:
        command = [folder / "bin/python", "-m", "pip", "install", "--quiet", *what]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            return last([line for line in done.stderr.splitlines() if line.startswith("ERROR")] or done.stderr.splitlines())
    ready.touch()
    return ""


def held_file(address: str, folder: Path) -> Path:
    """Return a file of a library in a folder; fetch it if it is not there."""
    path = folder / address.rpartition("/")[2]
    if not path.exists():
        with urllib.request.urlopen(address, timeout=60) as found:
            write_atomic(path, found.read())
    return path


def last(lines: list[str]) -> str:
    """Return the last line with a word in it."""
    return next((line.strip() for line in reversed(lines) if re.search(r"\w", line)), "no message")


def versions(python: Path, names: list[str]) -> dict[str, str]:
    """Return the versions of distributions in an interpreter's environment, and its own."""
    code = "import json, platform, sys\nfrom importlib.metadata import version\n"
    code += "print(json.dumps({n: version(n) for n in sys.argv[1:]} | {'python': platform.python_version()}))"
    shown: dict[str, str] = json.loads(subprocess.run([python, "-c", code, *names], capture_output=True, text=True, check=True).stdout)
    return shown


def tried(name: str, scratch: Path) -> dict[str, Any]:
    """Install and run; return the library's entry."""
    library, folder = LIBRARIES[name], scratch / name.lower()
    entry: dict[str, Any] = {"library": name, "extra": library.extra, "install": [part.replace(OWN, ".") for part in library.install]}
    if error := environment(library, folder):
        return entry | {"versions": {}, "python": "", "seconds": 0.0, "passed": False, "printed": "", "error": f"install: {error}"}
    python = folder.absolute() / "bin/python"
    held = versions(python, [*library.named, "gymnasium", "numpy"])
    entry |= {"python": held.pop("python"), "versions": held}
    with tempfile.TemporaryDirectory() as place:
        if library.file:
            shutil.copy(held_file(library.file, folder), place)
        (Path(place) / "snippet.py").write_text(snippet(name, PAGE.read_text(encoding="utf-8")), encoding="utf-8")
        alone = os.environ | {"MINARI_DATASETS_PATH": place, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
        began = time.perf_counter()
        try:
            done = subprocess.run([python, "snippet.py"], cwd=place, env=alone, capture_output=True, text=True, check=False, timeout=LIMIT)
            code, out, err = done.returncode, done.stdout, done.stderr
        except subprocess.TimeoutExpired:
            code, out, err = 1, "", f"not done after {LIMIT} s"
    entry |= {"seconds": round(time.perf_counter() - began, 1), "passed": code == 0}
    if code == 0 and (share := reached(out)) < library.learns:
        return entry | {"passed": False, "printed": "", "error": f"learned {share:g} % collisions, expected {library.learns:g} % or more"}
    return entry | {"printed": last(out.splitlines()) if code == 0 else "", "error": last(err.splitlines()) if code else ""}


def reached(printed: str) -> float:
    """Return the share of collisions that a recipe prints, in percent; 0 where it prints none."""
    shares = re.findall(r"(\d+) % of (?:the last )?\d+ episodes", printed)
    return float(shares[-1]) if shares else 0.0


def table(record: list[dict[str, Any]]) -> str:
    """Return the page's table."""
    heads = ("library", "pip install", "tried with", "Python", "extra", "runs", "seconds", "its last line")
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for entry in record:
        named = ", ".join(f"{name} {version}" for name, version in entry["versions"].items())
        said = (entry["printed"] if entry["passed"] else entry["error"]).replace("|", "\\|")
        install = " ".join(f"'{part}'" if set(part) & set("[>") else part for part in entry["install"])
        facts = ("yes" if entry["extra"] else "no", "yes" if entry["passed"] else "no", f"{entry['seconds']:.0f}")
        lines.append(f"| {entry['library']} | `{install}` | {named or '-'} | {entry['python'] or '-'} | {' | '.join(facts)} | {said} |")
    return "\n".join(lines)


def main() -> None:
    """Try what is asked for and write the record."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--library", action="append", choices=list(LIBRARIES), help="try this one; may be repeated (default: all)")
    parser.add_argument("--scratch", type=Path, help="folder of the virtual environments, which then stay (default: a temporary one)")
    parser.add_argument("--out", type=Path, default=RECORD)
    parser.add_argument("--table", action="store_true", help="print the table of the record and run nothing")
    asked = parser.parse_args()
    known = {entry["library"]: entry for entry in json.loads(asked.out.read_text(encoding="utf-8"))} if asked.out.exists() else {}
    if not asked.table:
        names = asked.library or list(LIBRARIES)
        with tempfile.TemporaryDirectory() as passing, progress(Console(stderr=True)) as update:
            for n, name in enumerate(names):
                known[name] = tried(name, asked.scratch or Path(passing))
                print(json.dumps(known[name]), flush=True)
                update("libraries", n + 1, len(names), name)
                record = [known[library] for library in LIBRARIES if library in known]
                write_atomic(asked.out, (json.dumps(record, indent=1) + "\n").encode())
    print(table([known[library] for library in LIBRARIES if library in known]))
    if failed := [] if asked.table else [name for name in names if not known[name]["passed"]]:
        sys.exit(f"does not run: {', '.join(failed)}")


if __name__ == "__main__":
    main()
