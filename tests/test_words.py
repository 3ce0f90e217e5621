"""The words of docstrings, comments and messages: plain English (docs/glossary.md)."""

import ast
import inspect
import io
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
DIALECT = re.compile(r"\b(beside|anew|so many|whoever|told|stands|of (its|his|their) own)\b", re.IGNORECASE)
CODE = re.compile(r"`[^`\n]*`")  # names of the code
WORD = re.compile(r"(?<!\S)[A-Za-z'`-]+[,;:.]*(?!\S)")  # parts of formulas do not count
MOST = 25  # words in a sentence
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


@pytest.mark.parametrize("name", sorted(FILES.keys() - EARLIER))
def test_words_are_plain(name: str) -> None:
    source = FILES[name].read_text(encoding="utf-8")
    tree = ast.parse(source)
    docstrings = _docstrings(tree)
    comments = [(t.start[0], t.string) for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.type == tokenize.COMMENT]
    strings = [(n.lineno, n.value) for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str) and " " in n.value]
    strings = docstrings if name in RECORDED else strings
    found = [(line, f"opens with {at[0]}") for line, text in docstrings if (at := OPENINGS.match(text))]
    found += [(line, f"says {at[0]!r}") for line, text in [*comments, *strings] if (at := DIALECT.search(CODE.sub("", text)))]
    long = [(line, part) for line, text in docstrings for part in _sentences(text) if len(WORD.findall(part)) > MOST]
    assert found + long == [], "plain words: see docs/glossary.md and CONTRIBUTING.md"
