"""Console commands of the documentation run: page by page, in the order in which a reader types them, in what looks like a clone."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.logs import openacc
from tests.pages import PAGES, ROOT, blocks, commands

LIGHT = ("docs/engine.md", "docs/scenarios.md")  # these run each time, the others by make test-long
LIMIT = 1800  # seconds for a command
PROGRAMS = {"tailgate": ["-m", "tailgate"], "python": [], "pytest": ["-m", "pytest"], "pip": ["-m", "pip"]}

# Both tables have the beginning of a command, or of PAGE: command; the longest that fits counts.
EXCEPTED = {
    "git clone": "takes a network",
    "cd tailgate-benchmark": "goes with git clone",
    "make ": "installs, or takes hours; the Makefile is its own test",
    "python3 -m venv": "an installation; .ci/run makes one",
    ". .venv/bin/activate": "the tests run in an environment",
    "pip install '": "an installation; .ci/run makes one",
    "pip install --constraint": "an installation; .ci/run makes one",
    "tailgate evaluate --suite quick-v0 --engine ray --address": "takes a cluster that runs; tests/test_cluster.py has one on this machine",
    "tailgate evaluate --suite quick-v0 --device cuda": "takes a card; tests/test_cuda.py plays on one or its double",
    "tailgate bench --device cuda": "takes a card",
    "python benchmarks/ecosystem.py": "installs from the network, an hour",
    "python benchmarks/literature.py": "a study of hours",
    "python results/adversaries-v0/adversaries.py": "a study of hours, with a word that stands for a cell",
    "README.md: tailgate leaderboard try mydefence:Class": "a name that stands for a class; docs/new-defence.md has one",
    "docs/scoring.md: tailgate leaderboard run": "published boards, an hour each; tests/test_scoring_runs.py and test_scoring_attacks.py have small ones",
    "docs/submissions.md: tailgate leaderboard admit": "words that stand for names; tests/test_scoring_attacks.py admits attacks",
    "docs/submissions.md: tailgate leaderboard run NAME": "words that stand for names",
    "tailgate zoo add": "writes into the package; tests/test_zoo.py adds to another folder",
    "for d in": "attackers of a published board, hours",
    "tailgate leaderboard run car-following-v1": "a published board, hours",
    "tailgate leaderboard run lane-v0": "a published board, hours",
    "tailgate leaderboard run quick-v1": "a published board, an hour",
    "tailgate leaderboard run radar-v": "a published board, hours",
    "docs/results/quick-v0.md: tailgate leaderboard": "a published board, with the attackers that the loops make",
    "chromium": "a browser; tests/test_replay_page.py opens such pages in one",
}

SMALL = {  # options that make a command small
    "tailgate evaluate": "--seeds 2",
    "tailgate evaluate --scenario film.yaml": "",
    "tailgate evaluate --suite road-v0": "--seeds 1",
    "docs/replay.md: tailgate evaluate": "",
    "tailgate evaluate --suite ch5-v0": "--seeds 1 --defence dkf",
    "tailgate evaluate --suite car-following-v1 --defence envelope": "--seeds 2 --scenario gusty-stop-and-go-v0",
    "tailgate attack": "--episodes 20",
    "tailgate attack chi2_kf --suite radar-v0 --dose 4": "--episodes 20 --scenario radar-braking-v0",
    "tailgate trust --suite": "--runs 20 --defence kf --defence none",
    "tailgate trust --scenario": "--runs 20",
    "tailgate rare": "--particles 64 --runs 3",
    "tailgate timing": "--episodes 10",
    "tailgate dose-response": "--episodes 10",
    "tailgate transfer": "--episodes 2",
    "tailgate distil": "--episodes 20",
    "tailgate calibrate": "--onsets 5",
    "tailgate detect-log": "",
    "tailgate learn-envelope": "--episodes 200 --held-out 160",
    "tailgate learn-envelope --log": "",
    "tailgate log": "--attack none --defence kf --episodes 60 --dev-episodes 20",
    "tailgate tune": "steps=20000 --trials 2 --episodes 20",
    "tailgate train": "steps=200000 episodes=20",
    "tailgate selfplay": "steps=5000 episodes=10 fresh=1",
    "tailgate selfplay name": "rounds=1 steps=5000 episodes=10 fresh=1",
    "tailgate selfplay --resume": "rounds=2 steps=5000 episodes=10 fresh=1",
    "tailgate bench": "--only yardstick --rounds 1 --seconds 0.05",
    "tailgate reproduce": "ch7 --seeds 10",
    "tailgate reproduce ch": "--seeds 10",
    "README.md: tailgate leaderboard run": "--defence kf",
    "docs/guide.md: tailgate leaderboard run quick-v0 --out boards --train": "--defence chi2_kf",
    "tailgate leaderboard check": "--sample 5",
    "docs/scoring.md: tailgate leaderboard check": "--sample 1",
    "tailgate leaderboard verify": "--sample 20",
    "pip install --no-deps .": "--no-build-isolation --target .",
    "python train.py": "steps=400000 episodes=20",
    "python train.py --config": "steps=20000 episodes=10 seeds=2",
    "python results/ch4-v0/ch4.py": "--seeds 2",
}

MINE = {  # what a page tells its reader to save: page and language of the blocks, and their numbers
    "docs/attacks.md": {"mine.yaml": ("docs/attacks.md", "yaml", 0)},
    "docs/automata.md": {"mine.yaml": ("docs/automata.md", "yaml", 1)},
    "docs/detectors.md": {"mydetector.py": ("docs/detectors.md", "python", 0)},
    "docs/engine.md": {"mydefence.py": ("docs/new-defence.md", "python", 0)},
    "docs/environment.md": {"mine.py": ("docs/environment.md", "python", 2, 3)},
    "docs/new-attack.md": {"myattack.py": ("docs/new-attack.md", "python", 0)},
    "docs/new-defence.md": {"mydefence.py": ("docs/new-defence.md", "python", 0)},
    "docs/new-parts.md": {"pyproject.toml": ("docs/new-parts.md", "toml", 0), "drone.py": ("docs/new-parts.md", "python", 0), "drone.yaml": ("docs/new-parts.md", "yaml", 0)},
    "docs/rendering.md": {"film.yaml": ("docs/rendering.md", "yaml", 0)},
    "docs/scenarios.md": {"closer.yaml": ("docs/scenarios.md", "yaml", 1)},
    "docs/submissions.md": {"mydefence.py": ("docs/new-defence.md", "python", 0)},
}  # fmt: skip

BEFORE = {"docs/environment.md": ["python mine.py"]}  # what the reader of a page has run already

FAILS = "python benchmarks/fuzz.py --reader rows --show"  # shows how a reader refuses an input


def entry(table: dict[str, str], page: str, command: str) -> str | None:
    """Return the longest key of a table that fits a command."""
    fits = [key for key in table if command.startswith(key) or f"{page}: {command}".startswith(key)]
    return max(fits, key=len, default=None)


def played(page: str) -> list[str]:
    return [command for command in commands(page) if entry(EXCEPTED, page, command) is None]


def clone(page: str, folder: Path) -> None:
    """Make a folder look like the root of a clone, with copies of what commands may write to, and what the reader has saved."""
    for name in ("benchmarks", "configs", "docs", "tests", "train.py", "constraints.txt"):
        (folder / name).symlink_to(ROOT / name)
    if any("results" in command for command in played(page)):
        shutil.copytree(ROOT / "results", folder / "results")
    for name, (source, language, *numbers) in MINE.get(page, {}).items():
        text = "".join(blocks(source, language)[number] for number in numbers)
        (folder / name).write_text(text.replace("model.learn(150_000)", "model.learn(10_000)"), encoding="utf-8")
    if page == "docs/security-cost.md":
        shutil.copy(ROOT / "configs/timing/platoon-v2v.yaml", folder / "mine.yaml")
    if page == "docs/real-roads.md":
        (folder / "my-drive.csv").write_text(openacc(), encoding="utf-8")


def started(command: str) -> list[str]:
    """Return the words that start a command: with this interpreter, and in a shell where it has a pattern or a substitution."""
    if re.search(r"\$\(|\*", command):
        shell = "".join(f'{name}() {{ {shlex.join([sys.executable, *words])} "$@"; }}\n' for name, words in PROGRAMS.items())
        return ["bash", "-c", shell + command]
    first, *rest = shlex.split(command)
    return [sys.executable, *PROGRAMS[first], *rest]


@pytest.mark.parametrize("page", [pytest.param(page, marks=[] if page in LIGHT else pytest.mark.long) for page in PAGES if played(page)])
def test_the_commands_of_a_page_run(page: str, tmp_path: Path) -> None:
    clone(page, tmp_path)
    quiet = os.environ | {"SDL_VIDEODRIVER": "dummy", "COLUMNS": "200"}
    for command in [*BEFORE.get(page, ()), *played(page)]:
        small = f"{command} {SMALL.get(entry(SMALL, page, command) or '', '')}".strip()
        done = subprocess.run(started(small), cwd=tmp_path, env=quiet, capture_output=True, text=True, timeout=LIMIT, check=False)
        failed = done.returncode or ("Traceback" in done.stderr and not small.startswith(FAILS))
        assert not failed, f"{page}: {small}\nexit status {done.returncode}\n{done.stderr[-2000:]}"
    shutil.rmtree(tmp_path / "results", ignore_errors=True)


def test_each_command_runs_or_is_excepted() -> None:
    typed = [(page, command) for page in PAGES for command in commands(page)]
    run = [(page, command) for page in PAGES for command in played(page)]
    assert len(run) > 150
    assert {command.split()[0] for _, command in run} <= set(PROGRAMS)
    assert {entry(EXCEPTED, *words) for words in typed} - {None} == set(EXCEPTED), "an exception that no page needs"
    assert {entry(SMALL, *words) for words in run} - {None} == set(SMALL), "options for commands that no page has"
    assert set(MINE) | set(LIGHT) <= {page for page, _ in run}
