"""Pages of the documentation, for the tests that play them: blocks of a language, and commands in the order in which a reader types them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [
    page.relative_to(ROOT).as_posix()
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if not {"generated", "extension"} & set(page.relative_to(ROOT).parts)
]


def blocks(page: str, language: str) -> list[str]:
    """Return the blocks of a page that are marked with a language."""
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)


def commands(page: str) -> list[str]:
    """Return the console commands of a page without comments: continued lines joined, a loop as one, `a && b` as two."""
    out: list[str] = []
    for block in blocks(page, "console"):
        for line in re.sub(r"\\\n\s*", "", block).splitlines():
            text = re.sub(r"\s+# .*", "", line).strip().removeprefix(".venv/bin/")
            if out and out[-1].startswith("for ") and not out[-1].endswith("; done"):
                out[-1] += f"; {text}"
            else:
                out += text.split(" && ")
    return out
