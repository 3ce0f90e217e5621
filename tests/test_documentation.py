"""The documentation as a site: every page can be reached, every link resolves, tutorials run, the site builds without a warning."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, get_args
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.ipynb"))
OWN = [p for p in sorted(DOCS.rglob("*")) if p.suffix in (".md", ".ipynb") and not {"generated", "extension"} & set(p.relative_to(DOCS).parts)]
READ = [*OWN, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md", "results/README.md"))]
FENCE = re.compile(r"^(```+|~~~+).*?^\1[ \t]*$", re.M | re.S)


def _text(path: Path) -> str:
    """Return the prose of a page: Markdown without blocks of code, or the Markdown cells of a notebook."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        text = "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")
    return FENCE.sub("", text)


def _trees(path: Path) -> list[str]:
    """Return the entries of all tables of contents of a page."""
    blocks = re.findall(r"^```\{toctree\}\n(.*?)^```", path.read_text(encoding="utf-8"), flags=re.M | re.S)
    return [line for block in blocks for line in block.splitlines() if line and not line.startswith(":")]


def _anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and the site make them."""
    found: set[str] = set()
    for title in re.findall(r"^#{1,6} (.+)$", _text(path), flags=re.M):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", title).replace("`", "")
        slug = re.sub(r"[^\w\- ]", "", plain.strip().lower()).replace(" ", "-")
        found.add(slug if slug not in found else next(f"{slug}-{n}" for n in range(1, 99) if f"{slug}-{n}" not in found))
    return found


def test_every_page_is_in_the_navigation() -> None:
    reached, todo = {"index"}, ["index"]
    while todo:
        page = todo.pop()
        path = DOCS / f"{page}.md"
        for entry in _trees(path) if path.is_file() else []:
            name = (path.parent / entry).relative_to(DOCS).as_posix()
            assert name not in reached, f"{name} is listed twice"
            reached.add(name)
            todo.append(name)
    pages = {path.relative_to(DOCS).with_suffix("").as_posix() for path in OWN}
    records = {page for page in pages if page.startswith("decisions/0")}
    assert "<!-- list of decisions -->" in (DOCS / "decisions/index.md").read_text(encoding="utf-8")
    assert pages - records - reached == set()
    assert {page for page in reached - pages if not page.startswith("generated/")} == set()


def test_every_internal_link_resolves() -> None:
    broken = []
    for path in READ:
        for target in re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`\n]*`", "", _text(path))):
            name, _, anchor = target.partition("#")
            if "://" in target or target.startswith("mailto:"):
                continue
            at = (path.parent / name) if name else path
            if not at.exists() or (anchor and at.suffix in (".md", ".ipynb") and anchor not in _anchors(at)):
                broken.append((path, target))
    assert broken == []


def test_sections_that_the_home_page_takes_from_readme_are_there() -> None:
    taken = re.findall(r"<!-- from README: ([^>]+?) -->", (DOCS / "index.md").read_text(encoding="utf-8"))
    titles = re.findall(r"^## (.+)$", (ROOT / "README.md").read_text(encoding="utf-8"), flags=re.M)
    assert len(taken) >= 2 and set(taken) <= set(titles)


@pytest.fixture
def extension(monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("numpydoc", reason="the extra docs is not installed")
    monkeypatch.syspath_prepend(DOCS / "extension")
    return DOCS / "extension"


@pytest.mark.parametrize("learners", [False, pytest.param(True, marks=pytest.mark.long)])  # they import torch
def test_every_component_has_a_page_with_its_parameters(extension: Path, learners: bool) -> None:
    from tailgate_docs.components import Pages  # type: ignore[import-not-found]

    from tailgate.core.registry import Family, find
    from tailgate.core.schema import fields_of
    from tailgate.play.metrics import METRICS

    made = Pages(ROOT, [family for family in get_args(Family) if (family == "learner") <= learners])
    pages = made.all()
    for family, group in made.entries.items():
        for name in group:
            text = pages[f"{family}/{name}.md"]
            cls = find(family, name).cls
            assert f"[{name}]({name}.md)" in pages[f"{family}/index.md"]
            assert "## Use" in text and cls.__qualname__ in text and ".py`, line " in text
            wanted = fields_of(getattr(sys.modules[cls.__module__], "Config", cls) if family == "learner" else cls)
            assert re.findall(r"^\| `(\w+)` \|", text, flags=re.M) == list(wanted)
    gate = pages["defence/chi2_kf.md"]
    assert "| `eta` | gate on r' S^-1 r | - | number above 0 | `20.0` |" in gate and "estimators/detectors/chi_square.py" in gate
    assert "| `gain` |" in gate and "`varying`, `steady`" in gate
    assert {f"metric/{name}.md" for name in METRICS} | {f"scenario/{name}.md" for name in made.scenarios} | {f"suite/{name}.md" for name in made.suites} <= set(pages)


@pytest.mark.parametrize("package", ["tailgate", "tailgate.core", "tailgate.board", "tailgate.num"])
def test_every_public_name_is_in_the_reference(extension: Path, package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from tailgate_docs import api  # type: ignore[import-not-found]

    monkeypatch.setattr(api, "PACKAGES", (package,) if package not in api.MODULES else ())
    monkeypatch.setattr(api, "MODULES", (package,) if package in api.MODULES else ())
    pages = api.pages({})
    assert set(pages) == {"index.md", f"{package}.md"}
    told = set(re.findall(r"^`{7}\{py:\w+\} (\w+)", pages[f"{package}.md"], flags=re.M))
    assert told == set(api.public(package)) and len(told) > 4


def test_docstrings_are_markdown(extension: Path) -> None:
    from tailgate_docs.docstrings import markdown, summary  # type: ignore[import-not-found]

    def sample(x: float) -> float:
        """Return x_k * 2 <= y, as `a*b`.

        The law is

            y = 2 * x_k

        Parameters
        ----------
        x : float
            Speed [m/s], of *one* car.

        Raises
        ------
        InputError
            If it is negative.
        """
        return 2 * x

    assert summary(sample) == r"Return x\_k \* 2 \<= y, as `a*b`."
    said = markdown(sample)
    assert "\n    y = 2 * x_k" in said
    assert r"- `x` : float: Speed \[m/s\], of \*one\* car." in said and "**Raises**" in said and "- InputError: If it is negative." in said


@pytest.mark.long
def test_the_gallery_leads_to_replays_that_are_drawn(extension: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tailgate_docs import boards  # type: ignore[import-not-found]

    one = {"quick-v1": ROOT / "results/quick-v1/board.json.xz"}
    monkeypatch.setattr(boards, "published", lambda root: one)
    monkeypatch.setattr(boards, "WHOLE", ())
    monkeypatch.chdir(ROOT)
    boards.draw(ROOT, tmp_path / "boards")
    links = re.findall(r'href="\.\./boards/([^"]+)"', boards.gallery(one))
    assert len(links) == 2 and all((tmp_path / "boards" / link).is_file() for link in links)
    page = boards.page("quick-v1", one["quick-v1"], ROOT)
    assert "| rkf | measurements | 1 |" in page and (tmp_path / "boards/quick-v1/index.html").is_file()
    assert "boards/quick-v1/index.html" in page and "[quick-v1](quick-v1.md)" in boards.index(one)


def test_links_of_a_page_that_is_shown_elsewhere(extension: Path, tmp_path: Path) -> None:
    from tailgate_docs.links import Links, section  # type: ignore[import-not-found]

    root = tmp_path.resolve()
    docs, shown = root / "docs", root / "docs/generated/report.md"
    for name in ("docs/a.md", "docs/images/p.png", "results/one/report.md", "results/one/rows.json", "README.md"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("x")
    links = Links(root, docs, {root / "results/one/report.md": shown})
    text = "[a](docs/a.md#b) ![p](docs/images/p.png) [r](results/one/report.md) [f](results/one) [w](https://x.org) `[c](docs/a.md)`\n"
    new = links.rebased(text, root / "README.md", docs / "deep/page.md")
    assert new == "[a](../a.md#b) ![p](../images/p.png) [r](../generated/report.md) f (`results/one`) [w](https://x.org) `[c](docs/a.md)`\n"
    assert section("# t\n\n## A\n\none\n\n## B\n\ntwo\n", "A") == "one"
    with pytest.raises(ValueError, match="no section 'C'"):
        section("## A\n", "C")


def _shown(cell: dict[str, Any]) -> list[str]:
    """Return the texts of a cell's outputs; of pictures that there is one. A kernel cuts what is printed where it likes."""
    printed, out = "", []
    for output in cell["outputs"]:
        assert output["output_type"] != "error"
        data = output.get("data", {})
        if output["output_type"] == "stream":
            assert output["name"] == "stdout", output["text"]
            printed += "".join(output["text"])
        else:
            out.append("picture" if "image/png" in data else "".join(data.get("text/html", data.get("text/plain"))))
    return [printed, *out]


@pytest.mark.long
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_a_tutorial_runs_to_the_outputs_that_it_shows(path: Path) -> None:
    nbclient = pytest.importorskip("nbclient", reason="the extra docs is not installed")
    nbformat = pytest.importorskip("nbformat")
    text = path.read_text(encoding="utf-8")
    for name in ("ipykernel", "pandas", "matplotlib", *(["torch"] if "import torch" in text else [])):
        pytest.importorskip(name)
    held = nbformat.read(path, as_version=4)
    assert path.stat().st_size < 150_000
    assert any(cell["outputs"] for cell in held.cells if cell.cell_type == "code")
    fresh = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(fresh, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}).execute()
    for old, new in zip(held.cells, fresh.cells, strict=True):
        if old.cell_type == "code" and "measured" in old.metadata.get("tags", ()):
            assert _shown(new)  # it differs from machine to machine
        elif old.cell_type == "code":
            assert _shown(new) == _shown(old), old.source


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built strictly, with its boards."""
    for name in ("sphinx", "furo", "myst_nb", "numpydoc"):
        pytest.importorskip(name, reason="the extra docs is not installed")
    folder = tmp_path_factory.mktemp("docs")
    command = [sys.executable, "-m", "sphinx", "--builder", "html", "--fail-on-warning", "--keep-going", "--quiet", "--jobs", "2"]
    command += ["--doctree-dir", str(folder / "doctrees"), str(DOCS), str(folder / "site")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return (folder / "site").resolve()


@pytest.mark.long
def test_links_of_the_built_site_lead_somewhere_and_none_loads_from_the_net(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    ids = {page: set(re.findall(r'\bid="([^"]+)"', text)) for page, text in texts.items()}
    assert len(pages) > 300 and sum(page.is_relative_to(site / "boards") for page in pages) > 150
    assert 'href="thesis/index.html"' in texts[site / "reproduction.html"] and site / "thesis/index.html" in texts
    for page, text in texts.items():
        loaded = re.findall(r'<(?:script|link|img|iframe|source)\b[^>]*?\b(?:src|href)="([^"]+)', text)
        assert not [name for name in loaded if "//" in name and not name.startswith("data:")], page
        for name, _, anchor in (unquote(found).partition("#") for found in {*loaded, *re.findall(r'<a\b[^>]*?\bhref="([^"]+)', text)}):
            at = (page.parent / name.partition("?")[0]).resolve() if name else page
            if "://" in name or name.startswith(("mailto:", "data:")):
                continue
            assert at.is_file(), f"{page}: {name}"
            assert not anchor or at not in ids or anchor in ids[at], f"{page}: {name}#{anchor}"


@pytest.mark.long
@pytest.mark.page
def test_search_works_from_the_folder(site: Path, browser: Any, asked: Any) -> None:
    for width in (400, 1300):
        browser.set_window_size(width, 900)
        asked()
        browser.get((site / "search.html").as_uri() + "?q=chi2_kf")
        deadline = time.monotonic() + 20
        while not (found := browser.find_elements("css selector", "#search-results li a")) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert found[0].text.startswith("chi2_kf")
        assert all(address.startswith("file:") for address in asked())
        assert browser.execute_script("return document.documentElement.scrollWidth <= document.documentElement.clientWidth")


SEEN = """
const lin = x => (x /= 255) <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4
const parts = c => { const [r, g, b, a = 1] = c.match(/[\\d.]+/g).map(Number); return [r, g, b, a] }
const grey = ([r, g, b]) => 0.2126 * lin(r) + 0.7152 * lin(g) + 0.0722 * lin(b)
const ground = e => { for (; e; e = e.parentElement) { const c = parts(getComputedStyle(e).backgroundColor); if (c[3] === 1) return c } return [255, 255, 255] }
const contrast = (ink, e) => { const [low, high] = [grey(parts(ink)), grey(ground(e))].sort((a, b) => a - b); return (high + 0.05) / (low + 0.05) }
const texts = [], walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT)
for (let t; (t = walk.nextNode());) {
  const e = t.parentElement
  if (t.data.trim() && !e.closest('script, style, .headerlink') && e.checkVisibility({checkOpacity: true, checkVisibilityCSS: true}))
    texts.push([t.data.trim(), contrast(getComputedStyle(e).color, e)])
}
const links = [...document.querySelectorAll('article a[href]:not(.headerlink)')].filter(a => a.textContent.trim() && a.checkVisibility()).map(a => {
  const s = getComputedStyle(a)
  return [a.textContent.trim(), s.textDecorationLine, contrast(s.textDecorationColor, a)]
})
return {texts, links, bare: [...document.images].filter(i => !i.alt).map(i => i.src),
        wide: document.documentElement.scrollWidth, room: document.documentElement.clientWidth}
"""


@pytest.mark.long
@pytest.mark.page
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_pages_fit_a_phone_and_need_no_colour(site: Path, browser: Any, show: Any, scheme: str) -> None:
    """No page is wider than 400 px. In greys text is readable, links are ruled, and pictures have words."""
    show(400, scheme)
    for name in ("index", "generated/components/defence/chi2_kf", "generated/replays", "guide", "thesis/index"):
        browser.get((site / f"{name}.html").as_uri())
        seen = browser.execute_script(SEEN)
        assert seen["wide"] <= seen["room"] <= 400, name
        assert len(seen["texts"]) > 100 and [text for text, contrast in seen["texts"] if contrast < 4.5] == [], name
        assert [text for text, line, contrast in seen["links"] if "underline" not in line or contrast < 3] == [], name
        assert (seen["links"] or name == "thesis/index") and seen["bare"] == [], name
