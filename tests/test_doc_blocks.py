"""Python examples of pages that no other test plays: each page's blocks run one after the other, as a reader types them."""

import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

import tailgate
from tests.pages import PAGES as ALL
from tests.pages import ROOT, blocks

PAGES = {  # the packages that a page needs
    "README.md": (), "docs/automata.md": (), "docs/engine.md": (), "docs/guide.md": ("matplotlib", "pandas"), "docs/highway.md": ("highway_env",),
    "docs/lane-keeping.md": (), "docs/rendering.md": ("pygame", "highway_env"), "docs/submissions.md": (), "docs/two-players.md": (),
    "docs/gpu.md": ("torch",), "docs/leaderboard-page.md": (), "docs/replay.md": ("pygame",), "docs/falsification.md": ("optuna",),
    "docs/logs.md": ("pyarrow",), "docs/scoring.md": (), "docs/literature.md": (),
}  # fmt: skip
BEFORE = {  # what the reader of a page has made already, in a small form
    "docs/falsification.md": ["falsify", "kf", "--property", "G[0,60] gap > 20", "--scenario", "braking-v0", "--attack", "none", "--trials", "2", "--out", "found"],
    "docs/logs.md": [
        "log", "--suite", "car-following-v0", "--scenario", "gusty-stop-and-go-v0", "--attack", "none", "--episodes", "1", "--dev-episodes", "1",
        "--out", "out/log",
    ],
    "docs/scoring.md": ["evaluate", "--suite", "quick-v1", "--defence", "kf", "--attack", "none", "--seeds", "2", "--out", "rows.jsonl"],
}  # fmt: skip
ELSEWHERE = {  # the tests that play the blocks of other pages
    "docs/detectors.md": "test_docs.py", "docs/distributed.md": "test_doc_blocks.py", "docs/ecosystem.md": "test_ecosystem.py",
    "docs/environment.md": "test_faces.py", "docs/new-attack.md": "test_docs.py", "docs/new-defence.md": "test_docs.py",
    "docs/new-parts.md": "test_new_parts.py",
}  # fmt: skip
CHANGED = {  # what cannot be had everywhere
    "docs/gpu.md": ('device="cuda"', 'device="cpu"'),
    "docs/replay.md": ('env = gymnasium.wrappers.RecordVideo(env, "films")\n', "" if not find_spec("moviepy") else None),
}


def test_each_page_with_blocks_is_played() -> None:
    assert {page for page in ALL if blocks(page, "python")} == {*PAGES, *ELSEWHERE}
    assert all(page in (ROOT / "tests" / test).read_text(encoding="utf-8") for page, test in ELSEWHERE.items())


@pytest.mark.thin(16)
@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_a_page_run(page: str, tmp_path: Path) -> None:
    for needed in PAGES[page]:
        pytest.importorskip(needed)
    code = "\n".join(blocks(page, "python"))
    if page in CHANGED:
        old, new = CHANGED[page]
        assert old in code
        code = code if new is None else code.replace(old, new)
    (tmp_path / "results").symlink_to(ROOT / "results")
    (tmp_path / "mydefence.py").write_text(blocks("docs/new-defence.md", "python")[0], encoding="utf-8")
    tailgate.evaluate(scenarios="stop-and-go-v0", defences="kf", attacks="none", seeds=1, out=tmp_path / "rows.jsonl")
    (tmp_path / "page.py").write_text(code, encoding="utf-8")
    quiet = os.environ | {"SDL_VIDEODRIVER": "dummy"}  # windows without a screen
    before = [["-m", "tailgate", *BEFORE[page]]] if page in BEFORE else []
    for words in [*before, ["page.py"]]:
        done = subprocess.run([sys.executable, *words], cwd=tmp_path, env=quiet, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_the_script_of_docs_distributed_prints_its_table(tmp_path: Path) -> None:
    (tmp_path / "table.py").write_text(blocks("docs/distributed.md", "python")[0], encoding="utf-8")
    done = subprocess.run([sys.executable, "table.py", "1", "thesis-ch5-v0"], cwd=tmp_path, capture_output=True, text=True, timeout=600, check=True)
    assert len(done.stdout.splitlines()) == 16 and all(line.count("|") == 7 for line in done.stdout.splitlines())
