"""The Sphinx extension of this site: pages from code, files and boards, links that hold, names of components that lead to their pages."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

from docutils import nodes
from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.transforms.post_transforms import SphinxPostTransform

from . import api, boards, components, staged, thesis
from .links import Links, section

GENERATED = "generated"
_FROM_README = re.compile(r"<!-- from README: ([^>]+?) -->")
_DECISIONS = "<!-- list of decisions -->"
_THESIS = "<!-- page of the reproduction -->"
_LISTED = re.compile(r"generated/components/\w+/(?!index).*|generated/reports/(?!index$).*|decisions/0.*")
_FAMILIES = ("defence", "attack", "scenario", "suite", "metric", "plant", "sensor", "detector", "filter", "mitigation", "controller", "manoeuvre")


class _Held:
    """Results of a build's earlier steps, for later ones; worker processes inherit them."""

    links: Links
    names: dict[str, str]
    bars: ClassVar[dict[tuple[str, Any], str]] = {}
    drawing: "subprocess.Popen[str] | None" = None


_held = _Held()


def _put(path: Path, text: str) -> None:
    """Write a page if it differs: an unchanged one is not read again."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _generate(app: Sphinx) -> None:
    docs = Path(app.srcdir).resolve()
    root, folder = docs.parent, docs / GENERATED
    texts: dict[Path, str] = {}
    made = components.Pages(root)
    texts |= {folder / "components" / name: text for name, text in made.all().items()}
    classes = {entry.cls: f"components/{family}/{name}.md" for family, group in made.entries.items() for name, entry in group.items()}
    texts |= {folder / "api" / name: text for name, text in api.pages(classes).items()}
    held = boards.published(root)
    texts |= {folder / "boards" / f"{name}.md": boards.page(name, path, root) for name, path in held.items()}
    texts[folder / "boards" / "index.md"] = boards.index(held)
    texts[folder / "replays.md"] = boards.gallery(held)
    shown = staged.shown(root, folder)
    links = Links(root, docs, shown | {root / "README.md": docs / "index.md"})
    for source, page in shown.items():
        if source.suffix == ".md":
            text = staged.titled(source.read_text(encoding="utf-8"), source)
            texts[page] = links.rebased(text, source, page)
    listed = [page.relative_to(folder / "reports").with_suffix("") for page in shown.values() if page.is_relative_to(folder / "reports")]
    lines = [f"- [{name}]({name}.md)" for name in map(str, listed)]
    texts[folder / "reports" / "index.md"] = "\n".join(["# Reports", "", "Reports that commands wrote, with their figures.", "", *lines, ""])
    for path, text in texts.items():
        _put(path, text)
    for path in folder.rglob("*.md"):
        if path not in texts:  # of a component that is gone
            path.unlink()
    _held.links = links


def _read(app: Sphinx, docname: str, content: list[str]) -> None:
    """Put in sections of README, and mend links that leave the folder of pages."""
    if docname.startswith(f"{GENERATED}/"):
        return
    path = Path(app.env.doc2path(docname)).resolve()
    if path.suffix != ".md":
        return
    links = _held.links
    text = links.rebased(content[0], path, path)
    readme = links.root / "README.md"
    whole = readme.read_text(encoding="utf-8")
    if _FROM_README.search(text):
        app.env.note_dependency(str(readme))
    text = _FROM_README.sub(lambda found: links.rebased(section(whole, found[1]), readme, path), text)
    records = sorted(path.parent.glob("0*.md")) if _DECISIONS in text else []
    heads = [(record.name, record.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")) for record in records]
    text = text.replace(_THESIS, thesis.LINK)
    content[0] = text.replace(_DECISIONS, "\n".join(f"- [{head}]({name})" for name, head in heads))


def _aside(app: Sphinx, doctree: nodes.document) -> None:
    """Take pages that a table or list leads to out of the side bar: it would have hundreds of lines, on every page."""
    docname = app.env.docname
    if _LISTED.fullmatch(docname):
        app.env.metadata[docname]["orphan"] = True


class ComponentLinks(SphinxPostTransform):
    """A component's name in code leads to its page, where it is named first on a page."""

    default_priority: ClassVar[int] = 5

    def run(self, **kwargs: Any) -> None:
        docname = self.env.docname
        if docname.startswith(f"{GENERATED}/components/"):
            return
        pages = _held.names
        seen: set[str] = set()
        for node in list(self.document.findall(nodes.literal)):
            name = node.astext()
            at = node.parent
            inside = isinstance(at, (nodes.reference, nodes.title)) or any(isinstance(one, nodes.title) for one in (at, at.parent))
            if name in seen or name not in pages or inside or isinstance(at.parent, nodes.reference):
                continue
            seen.add(name)
            uri = self.app.builder.get_relative_uri(docname, pages[name])
            new = nodes.reference("", "", internal=True, refuri=uri, classes=["component"])
            node.replace_self(new)
            new += node


def _names(app: Sphinx) -> None:
    """Know the page of every name that belongs to one component alone and cannot be a plain word."""
    folder = Path(app.srcdir) / GENERATED / "components"
    found: dict[str, str] = {}
    for family in reversed(_FAMILIES):
        for path in (folder / family).glob("*.md"):
            if path.stem != "index" and (re.search(r"[_\-\d]", path.stem) or path.stem in ("kf", "rkf", "imm", "cra", "pycra", "dkf")):
                found[path.stem] = f"{GENERATED}/components/{family}/{path.stem}"
    _held.names = found


def _keep_outputs(app: Sphinx, *_: Any) -> None:
    """Keep the notebooks' pictures with the doctrees: by default they would lie next to the folder of the site."""
    app.env.mystnb_config = app.env.mystnb_config.copy(output_folder=str(Path(app.doctreedir) / "notebooks"))  # type: ignore[attr-defined]


def _navigate(app: Sphinx, pagename: str, templatename: str, context: dict[str, Any], doctree: Any) -> None:
    """Make the side bar once for all pages of a folder that are not in it: it takes a tenth of a second a page."""
    known = app.env.metadata.get(pagename, {})
    if "toctree" not in context or (pagename in app.env.found_docs and "orphan" not in known):
        return
    make, folder = context["toctree"], pagename.rpartition("/")[0]

    def toctree(**kwargs: Any) -> str:
        key = (folder, tuple(sorted(kwargs.items())))
        if key not in _held.bars:
            _held.bars[key] = make(**kwargs)
        return _held.bars[key]

    context["toctree"] = toctree


def _begin(app: Sphinx) -> None:
    """Draw the boards in a process of their own, next to the build."""
    if app.builder.name == "html" and app.config.tailgate_boards:
        root = Path(app.srcdir).resolve().parent
        command = [sys.executable, "-m", boards.__name__, str(root), str(Path(app.outdir) / "boards")]
        paths = os.pathsep.join(path for path in (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH")) if path)
        _held.drawing = subprocess.Popen(command, cwd=root, env=os.environ | {"PYTHONPATH": paths}, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def _end(app: Sphinx, error: Exception | None) -> None:
    if error is None and app.builder.name == "html":
        thesis.draw(Path(app.srcdir).resolve().parent, Path(app.outdir))
    drawing = _held.drawing
    if drawing is None:
        return
    if error is not None:
        drawing.kill()
    _, said = drawing.communicate()
    if error is None and drawing.returncode:
        raise ExtensionError(f"the boards were not drawn: {said}")


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the extension."""
    app.add_config_value("tailgate_boards", True, "", bool)
    app.add_lexer("csv", TextLexer)  # Pygments knows none
    app.connect("builder-inited", _generate)
    app.connect("builder-inited", _names, priority=600)
    app.connect("source-read", _read)
    app.connect("doctree-read", _aside)
    app.connect("env-before-read-docs", _keep_outputs)
    app.connect("html-page-context", _navigate, priority=100)
    app.connect("builder-inited", _begin, priority=400)
    app.connect("build-finished", _end)
    app.add_post_transform(ComponentLinks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
