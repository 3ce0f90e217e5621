"""Docstrings as Markdown. The project writes them so: code in backticks, formulas indented, sections by numpydoc."""

import inspect
import re

from numpydoc.docscrape import NumpyDocString

# What is code already keeps its characters; in prose they would mean emphasis, links or tags.
_CODE = re.compile(r"(`+[^`]*`+)")
_MARKS = re.compile(r"([*_<>\[\]$])")
_ITEM = re.compile(r"(\s*[*-] )(.*)", re.DOTALL)


def escaped(text: str) -> str:
    """Return one line of prose with Markdown's marks escaped, code spans and the dash of a list item left as they are."""
    item = _ITEM.fullmatch(text)
    head, rest = (item[1], item[2]) if item else ("", text)
    parts = _CODE.split(rest)
    return head + "".join(part if i % 2 else _MARKS.sub(r"\\\1", part) for i, part in enumerate(parts))


def prose(lines: list[str]) -> str:
    """Return lines of a docstring as Markdown; what is indented after an empty line is a formula and stays as it is."""
    out: list[str] = []
    formula = False
    for line in lines:
        indented = line.startswith("    ")
        if not line.strip():
            out.append("")
            continue
        formula = indented and (formula or not out or not out[-1].strip())
        out.append(line.rstrip() if formula else escaped(line.rstrip()))
    return "\n".join(out).strip("\n")


def _listed(title: str, entries: list[tuple[str, str, list[str]]]) -> list[str]:
    """Return a numpydoc section of names, types and descriptions as a list."""
    if not entries:
        return []
    out = [f"**{title}**", ""]
    for name, kind, said in entries:
        head = " : ".join(part for part in (f"`{name}`" if name else "", escaped(kind)) if part)
        text = " ".join(escaped(line.strip()) for line in said if line.strip())
        out.append(f"- {head}" + (f": {text}" if text else ""))
    return [*out, ""]


def markdown(thing: object) -> str:
    """Return the docstring of a class, function or module as Markdown; empty where it has none."""
    text = inspect.getdoc(thing) or ""
    if not text.strip():
        return ""
    if "\n---" not in text:  # no section: as it is
        return prose(text.splitlines())
    doc = NumpyDocString(text)
    out = [prose([*doc["Summary"], "", *doc["Extended Summary"]]), ""]
    for title in ("Parameters", "Returns", "Yields", "Raises", "Attributes"):
        out += _listed(title, [(entry.name, entry.type, entry.desc) for entry in doc[title]])
    for title in ("Notes", "References", "Examples"):
        if doc[title]:
            out += [f"**{title}**", "", prose(doc[title]), ""]
    return "\n".join(out).strip("\n")


def summary(thing: object) -> str:
    """Return the first paragraph of a docstring in one line of Markdown."""
    first = (inspect.getdoc(thing) or "").split("\n\n")[0]
    return escaped(" ".join(first.split())).replace("|", r"\|")
