"""Python examples of pages that no other test plays: each page's blocks run one after the other, as a reader types them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import tailgate

ROOT = Path(__file__).parents[1]
PAGES = (
    "README.md", "docs/automata.md", "docs/engine.md", "docs/guide.md", "docs/highway.md", "docs/lane-keeping.md", "docs/rendering.md",
    "docs/submissions.md", "docs/two-players.md",
)  # fmt: skip


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.thin(9)
@pytest.mark.parametrize("page", PAGES)
def test_the_blocks_of_a_page_run(page: str, tmp_path: Path) -> None:
    for needed in ("matplotlib", "pandas", "pygame", "highway_env"):
        pytest.importorskip(needed)
    (tmp_path / "mydefence.py").write_text(blocks("docs/new-defence.md")[0], encoding="utf-8")
    tailgate.evaluate(scenarios="stop-and-go-v0", defences="kf", attacks="none", seeds=1, out=tmp_path / "rows.jsonl")
    (tmp_path / "page.py").write_text("\n".join(blocks(page)), encoding="utf-8")
    quiet = os.environ | {"SDL_VIDEODRIVER": "dummy"}  # windows without a screen
    done = subprocess.run([sys.executable, "page.py"], cwd=tmp_path, env=quiet, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
