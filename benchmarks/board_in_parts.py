"""Make a board whose searches take longer than one sitting. Searches stay in results/under-way, and the next sitting goes on.

    python benchmarks/board_in_parts.py road-v0 [--hours 2] [--workers 2] [--defence NAME]

Searches belong to the code that made them. The first sitting notes the commit, and each sitting plays in a work tree of that commit, below
.under-way. A sitting ends after some hours, or when the board is there: .under-way/SUITE/results/SUITE then goes to results by hand.
The board's rows come before its searches; a sitting with --defence has the searches alone.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILES = "policy:path=", "program:path="  # attacks that lie in files
BEGUN = ".begun.tar.xz"  # how the archives of unfinished searches end
PAUSE, PATIENCE = 20, 300  # seconds between two looks for finished searches, and for the end of a sitting


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suite", help="a built-in suite")
    parser.add_argument("--hours", type=float, default=2.0, help="length of this sitting (default 2)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--defence", action="append", default=[], help="search against this one alone, and play no other rows; repeatable")
    options = parser.parse_args()
    kept, tree = ROOT / "results" / "under-way" / options.suite, ROOT / ".under-way" / options.suite
    commit = commit_of(kept)
    if not tree.is_dir():
        git("worktree", "prune")
        git("worktree", "add", "--quiet", "--detach", str(tree), commit)
    elif git("-C", str(tree), "rev-parse", "HEAD") != commit:
        print(f"{tree}: got another commit; expected {commit}. Remove it with `git worktree remove`.", file=sys.stderr)
        return 2
    for part in sorted(kept.glob("*.tar.xz")):
        with tarfile.open(part) as held:
            held.extractall(tree, filter="data")
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it, and would pass that on
    whole = ["run", options.suite, "--out", "results", "--train"]
    parts = [["attack", name, "--suite", options.suite, "--out", f"results/{options.suite}/attacked"] for name in options.defence]
    until = time.monotonic() + 3600 * options.hours
    for part in parts or [whole]:
        sit([sys.executable, "-m", "tailgate", "leaderboard", *part, "--workers", str(options.workers)], tree, options.suite, kept, until)
    begun = len(list(kept.glob(f"*{BEGUN}")))
    print(f"{len(list(kept.glob('*.tar.xz'))) - begun} searches in {kept.relative_to(ROOT)}, and {begun} that were begun")
    return 0


def sit(command: list[str], tree: Path, suite: str, kept: Path, until: float) -> None:
    """Run a command in the work tree until it ends or the time is up, and keep the searches that it finishes."""
    if time.monotonic() >= until:
        return
    run = subprocess.Popen(command, cwd=tree, env=os.environ | {"PYTHONPATH": str(tree / "src")})
    try:
        while run.poll() is None and time.monotonic() < until:
            time.sleep(PAUSE)
            keep(tree, suite, kept)
    finally:
        if run.poll() is None:
            run.send_signal(signal.SIGINT)
        try:
            run.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            run.kill()
        keep(tree, suite, kept)
        keep_begun(tree, suite, kept)


def commit_of(kept: Path) -> str:
    """Return the commit whose code makes the board: the noted one, or now the last one."""
    note = kept / "commit"
    if not note.is_file():
        if git("status", "--porcelain", "--untracked-files=no"):
            raise SystemExit("the working tree has changes: commit them, because searches belong to the code that made them")
        kept.mkdir(parents=True, exist_ok=True)
        note.write_text(git("rev-parse", "HEAD") + "\n")
    return note.read_text().strip()


def keep(tree: Path, suite: str, kept: Path) -> None:
    """Pack each finished search with the files of its attacks."""
    for result in sorted(tree.glob(f"results/{suite}/attacked/searches/*/searches/*.json")):
        packed = kept / f"{result.parents[1].name}-{result.stem}.tar.xz"
        if not packed.exists():
            pack(packed, tree, [result.relative_to(tree), *files_of(json.loads(result.read_text()), tree)])
            packed.with_name(f"{packed.name.removesuffix('.tar.xz')}{BEGUN}").unlink(missing_ok=True)


def keep_begun(tree: Path, suite: str, kept: Path) -> None:
    """Pack what a sitting that ends has of its searches: the journal of each, and the files of the attacks that it has found."""
    for journal in sorted(tree.glob(f"results/{suite}/attacked/searches/*/searches/*.journal")):
        if journal.with_suffix(".json").exists():
            continue
        found = sorted(path for path in (journal.parents[1] / "attacks" / journal.stem).rglob("*") if path.is_file())
        pack(kept / f"{journal.parents[1].name}-{journal.stem}{BEGUN}", tree, [path.relative_to(tree) for path in (journal, *found)])


def pack(packed: Path, tree: Path, paths: Iterable[Path]) -> None:
    """Write an archive of files of the work tree in one step."""
    partial = packed.with_suffix(".part")
    with tarfile.open(partial, "w:xz") as out:
        for path in paths:
            out.add(tree / path, str(path), filter=plain)
    partial.replace(packed)


def files_of(found: dict[str, list[dict[str, list[dict[str, str]]]]], tree: Path) -> Iterator[Path]:
    """Yield the files of the attacks of a search, relative to the work tree."""
    for attack in (one["attack"] for member in found["members"] for one in member["found"]):
        if attack.startswith(FILES):
            path = Path(attack.partition("=")[2])
            yield from (part for part in (path, path.with_suffix(".safetensors")) if (tree / part).is_file())


def plain(info: tarfile.TarInfo) -> tarfile.TarInfo:
    """Leave out who made a file, and when."""
    info.uid = info.gid = info.mtime = 0
    info.uname = info.gname = ""
    return info


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:  # what there is has been kept
        sys.exit(130)
