"""The reference of the public names: one page a package, from `__all__` and the docstrings."""

import importlib
import inspect
import types
from collections.abc import Iterator
from typing import Any

from sphinx.util.inspect import stringify_signature

from .docstrings import escaped, markdown, summary

PACKAGES = (
    "tailgate", "tailgate.core", "tailgate.envs", "tailgate.envs.torch", "tailgate.estimators", "tailgate.agents", "tailgate.evaluation", "tailgate.plot",
    "tailgate.board", "tailgate.sandbox", "tailgate.thesis", "tailgate.cli",
)  # fmt: skip
MODULES = ("tailgate.num",)  # without __all__, and yet what components are written with
SHORT = 300  # characters of a value that are shown
OUTER, INNER = "`" * 7, "`" * 6


def public(package: str) -> list[str]:
    """Return the public names of a package; of a module without `__all__` its own functions and classes."""
    module = importlib.import_module(package)
    if package in MODULES:
        own = [name for name, held in vars(module).items() if callable(held) and getattr(held, "__module__", "") == package]
        return sorted(name for name in own if not name.startswith("_"))
    return sorted(module.__all__)


def _signature(thing: Any, typed: bool) -> str:
    """Return a signature as text; empty where Python knows none."""
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return "()"
    if not typed:
        plain = [p.replace(annotation=p.empty) for p in signature.parameters.values()]
        signature = signature.replace(parameters=plain, return_annotation=signature.empty)
    first = next(iter(signature.parameters), "")
    if first in ("self", "cls"):
        signature = signature.replace(parameters=list(signature.parameters.values())[1:])
    if str(signature) == "(*args, **kwargs)":  # a base class that is never made
        return ""
    text = stringify_signature(signature, unqualified_typehints=True, short_literals=True)
    return text if "<" not in text else stringify_signature(signature, show_annotation=False)


def _members(cls: type, module: str) -> Iterator[str]:
    """Yield entries of the documented methods and properties that a class defines itself."""
    for name, held in vars(cls).items():
        plain = held.__func__ if isinstance(held, (classmethod, staticmethod)) else held
        if name.startswith("_"):
            continue
        if isinstance(plain, property) and markdown(plain):
            yield "\n".join([f"{INNER}{{py:property}} {name}", "", markdown(plain), INNER, ""])
        elif isinstance(plain, types.FunctionType) and (plain.__doc__ or "").strip():
            options = [":classmethod:"] if isinstance(held, classmethod) else [":staticmethod:"] if isinstance(held, staticmethod) else []
            yield "\n".join([f"{INNER}{{py:method}} {name}{_signature(plain, True)}", *options, "", markdown(plain), INNER, ""])


def _entry(package: str, name: str, thing: Any, pages: dict[type, str], seen: list[Any]) -> str:
    """Return the entry of a public name, or a link to the page of a component."""
    if inspect.isclass(thing) and thing in pages:
        return f"- `{name}`: [{pages[thing].rsplit('/', 1)[1][:-3]}](../{pages[thing]}), {summary(thing)}\n"
    home = getattr(thing, "__module__", package) or package
    if not (inspect.isclass(thing) or inspect.isfunction(thing)) or not home.startswith("tailgate"):
        text = str(thing).replace("tailgate.", "").replace("typing.", "")
        said = f"`{text}`" if len(text) < SHORT else f"A value of {escaped(type(thing).__name__)}."
        return "\n".join([f"{OUTER}{{py:data}} {name}", f":module: {package}", "", said, OUTER, ""])
    if thing in seen:
        return f"- `{name}`: the same as {{py:obj}}`{home}.{name}`\n"
    seen.append(thing)
    module = home if getattr(importlib.import_module(home), name, None) is thing else package
    if inspect.isclass(thing):
        kind = "exception" if issubclass(thing, Exception) else "class"
        body = [markdown(thing) or "A class.", "", *_members(thing, module)]
        head = f"{OUTER}{{py:{kind}}} {name}{_signature(thing, False)}"
    else:
        body = [markdown(thing) or "A function.", ""]
        head = f"{OUTER}{{py:function}} {name}{_signature(thing, True)}"
    return "\n".join([head, f":module: {module}", "", *body, OUTER, ""])


def pages(components: dict[type, str]) -> dict[str, str]:
    """Return path -> Markdown of the reference; `components` has the page of each registered class."""
    out = {}
    rows = []
    seen: list[Any] = []
    for package in (*PACKAGES, *MODULES):
        module, names = importlib.import_module(package), public(package)
        shown: dict[str, str] = {}
        for name in names:
            try:
                thing = getattr(module, name)
            except ImportError as error:  # of an extra
                shown[name] = f"- `{name}` could not be imported where this page was built: {escaped(str(error))}\n"
                continue
            shown[name] = _entry(package, name, thing, components, seen)
        linked = [text for text in shown.values() if text.startswith("- ")]
        text = [f"# {package}", "", markdown(module), "", f"These names are imported from `{package}`.", ""]
        if linked:
            text += ["## Elsewhere", "", "Components have a page of their parameters each.", "", *linked, ""]
        text += ["## Names", "", *(text for text in shown.values() if not text.startswith("- "))]
        out[f"{package}.md"] = "\n".join(text)
        rows.append(f"| [{package}]({package}.md) | {summary(module)} | {len(names)} |")
    tree = ["```{toctree}", ":hidden:", ":maxdepth: 1", "", *(name.removesuffix(".md") for name in out), "```", ""]
    head = ["# API", "", "Public names, from the docstrings. Other names may change without an entry in the changelog.", ""]
    out["index.md"] = "\n".join([*head, *tree, "| package | what it is | names |", "|---|---|---|", *rows, ""])
    return out
