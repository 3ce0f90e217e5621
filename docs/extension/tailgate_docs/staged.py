"""Files that lie outside of docs and are pages of the site: reports, and the papers of the project's root."""

from pathlib import Path

ROOT_PAGES = {"CONTRIBUTING.md": "contributing", "SECURITY.md": "security", "CHANGELOG.md": "changelog"}


def reports(root: Path) -> list[Path]:
    """Return the reports in Markdown that commands wrote into `results` and `benchmarks/results`."""
    found = [*(root / "results").glob("*/**/*.md"), *(root / "benchmarks/results").rglob("*.md")]
    return sorted(path for path in found if path.name != "README.md")


def shown(root: Path, generated: Path) -> dict[Path, Path]:
    """Return the page in the folder `generated` of each file of the repository that has one."""
    out = {path: generated / "reports" / path.relative_to(root) for path in reports(root)}
    out |= {root / name: generated / "project" / f"{page}.md" for name, page in ROOT_PAGES.items()}
    for path in (root / "results").glob("*/board.json*"):
        out[path] = generated / "boards" / f"{path.parent.name}.md"
    return out


def titled(text: str, path: Path) -> str:
    """Return a report with a first heading, which every page needs."""
    return text if text.startswith("# ") else f"# {path.parent.name}: {path.stem}\n\n{text}"
