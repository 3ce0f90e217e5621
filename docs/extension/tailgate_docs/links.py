"""Links of a page that is shown elsewhere than it lies: other pages of the site, pictures, files of the repository."""

import re
from dataclasses import dataclass, field
from os.path import relpath
from pathlib import Path

MOST = 500_000  # bytes of a file that the site carries along
_SKIPPED_OR_LINK = re.compile(r"^(?P<fence>```+|~~~+)[^\n]*\n.*?^(?P=fence)`*[ \t]*$|(?P<code>`+)[^`].*?(?P=code)|(?P<link>(!?)\[([^\]\n]*)\]\(([^)\s]+)\))", re.M | re.S)


@dataclass(frozen=True)
class Links:
    """Knows under which name each file of the repository is in the site.

    `shown` maps files outside of the folder `docs` to the page of the site that shows them, both as full paths.
    """

    root: Path
    docs: Path
    shown: dict[Path, Path] = field(default_factory=dict)

    def rebased(self, text: str, source: Path, page: Path) -> str:
        """Return Markdown of the file `source` with links that are right on `page`; both are full paths."""

        def renewed(found: re.Match[str]) -> str:
            if not found["link"]:
                return found[0]
            picture, label, target = found[4], found[5], found[6]
            name, mark, anchor = target.partition("#")
            if "://" in target or not name or name.startswith("mailto:"):
                return found[0]
            path = (source.parent / name).resolve()
            if picture or path.is_relative_to(self.docs):
                place = path
            elif path in self.shown:
                place = self.shown[path]
            elif path.is_file() and path.stat().st_size <= MOST:
                place, mark, anchor = path, "", ""
            elif path.exists():  # a folder, or a large file: its name says where it is in a clone
                at = str(path.relative_to(self.root))
                return f"`{at}`" if label.strip("`") == at else f"{label} (`{at}`)"
            else:
                return found[0]  # the build says that it is missing
            if place.is_dir():
                place = place / "index.md"
            return f"{picture}[{label}]({relpath(place, page.parent)}{mark}{anchor})"

        return _SKIPPED_OR_LINK.sub(renewed, text)


def section(text: str, title: str) -> str:
    """Return the body of a section of Markdown, without its heading."""
    found = re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", text, flags=re.M | re.S)
    if not found:
        raise ValueError(f"no section {title!r}")
    return found[1].strip("\n")
