"""The words of docstrings, comments and messages: plain English (docs/glossary.md)."""

import ast
import inspect
import io
import json
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src/tailgate"
TOP = ("envs", "estimators", "agents", "configs")  # src/tailgate has links to them, which a walk does not follow
EARLIER = {"moved.py"}  # it holds earlier names
RECORDED = {  # their strings are in published boards, and in reports of claims
    "board/entry.py", "thesis/ch4_theory.py", "thesis/ch5_theory.py", "thesis/ch6_cases.py", "thesis/ch6_loop.py",
    "thesis/ch7_automata.py", "thesis/ch7_trust.py", "estimators/challenge/challenge_response.py", "estimators/safe_set/safe_state.py",
}  # fmt: skip
OPENINGS = re.compile(r"(What|Of|Whose|Whether|Whoever)\b")
DIALECT = re.compile(  # "a rule of its own", and not "the echo of its own probe"
    r"\b(beside|anew|so many|whoever|told|stands|of (its|his|their) own(?! (?!(that|which|for|in|on|and|or|at|to|with|by|as|is)\b)\w))\b",
    re.IGNORECASE,
)
CODE = re.compile(r"`[^`\n]*`")  # names of the code
QUOTED = re.compile(r'"[^"]*"')
WORD = re.compile(r"(?<!\S)[A-Za-z'`-]+[,;:.]*(?!\S)")  # parts of formulas do not count
MOST = 25  # words in a sentence
PAGES = ["README.md", "CONTRIBUTING.md", "PACKAGE.md", "SECURITY.md"]
TEMPLATES = [path for path in SOURCE.rglob("*.html") if path.relative_to(SOURCE).parts[0] not in TOP]
PAGES += [str(path.relative_to(ROOT)) for folder in ("docs", "docs/results") for path in (ROOT / folder).glob("*.md")]
FILES = {str(path.relative_to(SOURCE)): path for path in SOURCE.rglob("*.py") if path.relative_to(SOURCE).parts[0] not in TOP}
FILES |= {str(path.relative_to(ROOT)): path for folder in TOP for path in (ROOT / folder).rglob("*.py")}


def _docstrings(tree: ast.Module) -> list[tuple[int, str]]:
    """Return line and text of all docstrings, attribute docstrings included."""
    bodies = [node.body for node in ast.walk(tree) if isinstance(getattr(node, "body", None), list)]
    held = [statement.value for body in bodies for statement in body if isinstance(statement, ast.Expr)]
    return [(value.lineno, value.value) for value in held if isinstance(value, ast.Constant) and isinstance(value.value, str)]


def _sentences(text: str) -> list[str]:
    """Return the sentences of a docstring; formulas and other indented lines, section entries and list items are not prose."""
    prose = re.sub(r"(?m)^[ ]*(?:[-*] |\w[\w, ]* : |\S+  +).*$|^ {4,}.*$", "", inspect.cleandoc(text))
    return re.split(r"(?<=[.?!])\s+|\n\s*\n", prose)


def _dialect(name: str) -> list[tuple[int, str]]:
    """Return the lines of a file that are not plain, and what is wrong with them."""
    source = FILES[name].read_text(encoding="utf-8")
    tree = ast.parse(source)
    docstrings = _docstrings(tree)
    comments = [(t.start[0], t.string) for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.type == tokenize.COMMENT]
    strings = [(n.lineno, n.value) for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str) and " " in n.value]
    strings = docstrings if name in RECORDED else strings
    found = [(line, f"opens with {at[0]}") for line, text in docstrings if (at := OPENINGS.match(text))]
    found += [(line, f"says {at[0]!r}") for line, text in [*comments, *strings] if (at := DIALECT.search(CODE.sub("", text)))]
    long = [(line, part) for line, text in docstrings for part in _sentences(text) if len(WORD.findall(part)) > MOST]
    return found + long


def test_words_are_plain() -> None:
    found = {name: lines for name in sorted(FILES.keys() - EARLIER) if (lines := _dialect(name))}
    assert found == {}, "plain words: see docs/glossary.md and CONTRIBUTING.md"


def _prose(page: str) -> list[str]:
    """Return the sentences of a page, list items included; code, tables, headings and comments are not prose."""
    text = re.sub(r"(?ms)^ *```.*?^ *```$|<!--.*?-->|^\$\$.*?^\$\$$", "", page)
    text = re.sub(r"(?m)^(?: *(?:[|#:<]|\[[^\]]*\]: )| {4,}(?![-*] |\d+\. )).*$", "\n", text)  # tables, headings, directives, HTML, code
    text = re.sub(r"(?m)^ *(?:[-*>]|\d+\.) ", "\n\n", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", CODE.sub("0", text)).replace("*", "")
    return [" ".join(part.split()) for part in re.split(r"(?<=[.?!])[)\"]?\s+|\n\s*\n", text) if part.strip()]


def test_prose_is_found() -> None:
    page = """# What a heading says

    A *first* sentence names [what
    it links](x.md#what) and `so many told`. Of course! "What is told"

    | Whose | table |
    - one item
    - another

    ```python
    # Whoever
    ```
    """
    sentences = _prose(inspect.cleandoc(page))
    assert sentences == ["A first sentence names what it links and 0.", "Of course!", '"What is told"', "one item", "another"]
    assert [part for part in sentences if OPENINGS.match(part) or DIALECT.search(QUOTED.sub("", part))] == ["Of course!"]


@pytest.mark.parametrize("text", ["a rule of its own.", "a law of its own that holds", "so many hours", "It stands there", "Whoever"])
def test_the_dialect_is_found(text: str) -> None:
    assert DIALECT.search(text) and not DIALECT.search("It hears the echo of its own probe; as many hours")


def test_prose_of_pages_is_plain() -> None:
    sentences = [(name, part) for name in sorted(PAGES) for part in _prose((ROOT / name).read_text(encoding="utf-8"))]
    found = [at for at in sentences if _is_dialect(at[1])]
    assert found == [], "plain words: see docs/glossary.md"


def _shown(page: str) -> list[str]:
    """Return the sentences that a template of a page shows; headings and values are no prose."""
    page = re.sub(r"(?s)\{#.*?#\}|<!--.*?-->|<(script|style|summary|nav|h\d)\b.*?</\1>", "\n\n", page)
    page = re.sub(r"(?s)\{%-?\s*(?:el(?:if|se)|for|endfor)\b.*?%\}", "\n\n", page)  # between alternatives a sentence ends
    page = re.sub(r"(?s)\{\{.*?\}\}", "0", re.sub(r"(?s)\{%.*?%\}", "", page))
    page = re.sub(r"<(?!/?(?:a|b|em|i|code)\b)[^>]*>", "\n\n", page)
    return [" ".join(part.split()) for part in re.split(r"(?<=[.?!])\s+|\n\s*\n", re.sub(r"<[^>]*>", "", page)) if part.strip()]


def test_what_templates_show_is_found() -> None:
    page = "<h2>What it is</h2><p>One <b>word</b>. {% if x %}Of {{ x|y }} <i>it</i>{% else %}nothing{% endif %}</p><style>Of</style>"
    assert _shown(page) == ["One word.", "Of 0 it", "nothing"]


def test_prose_of_templates_and_notebooks_is_plain() -> None:
    texts = {str(path.relative_to(SOURCE)): _shown(path.read_text(encoding="utf-8")) for path in TEMPLATES}
    for path in (ROOT / "docs/tutorials").glob("*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        texts[path.name] = [part for cell in cells if cell["cell_type"] == "markdown" for part in _prose("".join(cell["source"]))]
    assert len(TEMPLATES) > 8 and len(texts) > len(TEMPLATES) + 4
    found = [(name, part) for name, parts in texts.items() for part in parts if _is_dialect(part)]
    assert found == [], "plain words: see docs/glossary.md"


def _is_dialect(sentence: str) -> bool:
    long = len(WORD.findall(sentence)) > MOST
    return bool(OPENINGS.match(sentence) or DIALECT.search(QUOTED.sub("", sentence)) or long)


def test_the_glossary_is_in_order() -> None:
    """One plain sentence for each word, in alphabetical order."""
    table = re.findall(r"(?m)^\| ([^|]+) \| ([^|]+) \|$", (ROOT / "docs/glossary.md").read_text(encoding="utf-8"))[1:]
    words = [word for word, _ in table]
    assert words == sorted(words) and {"black box", "damage", "dose", "ensemble", "restart", "undamaged", "yoked"} <= set(words)
    assert not [text for _, text in table if text.endswith(".") or ". " in text or len(WORD.findall(text)) > MOST or DIALECT.search(text)]
