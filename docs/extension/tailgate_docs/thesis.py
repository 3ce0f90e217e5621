"""The published reproduction of the thesis as the one page that `tailgate reproduce` writes: it is no page of Sphinx."""

from pathlib import Path

from tailgate.base.files import writable_directory, write_atomic
from tailgate.thesis.whole import html, read_whole

LINK = '<a class="whole" href="thesis/index.html">The published report as one page</a>: claims by verdict, pictures in their places.'


def draw(root: Path, out: Path) -> None:
    """Write `out`/thesis/index.html from the JSON and the pictures in results/reproduction; nothing is computed."""
    text = html(read_whole(root / "results/reproduction"))
    write_atomic(writable_directory(out / "thesis") / "index.html", text.encode())
