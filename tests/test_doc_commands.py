"""Commands of the documentation: every `tailgate ...` of README and docs has options that exist, and names what exists."""

import re
import shlex
from pathlib import Path

import pytest

from tailgate.cli.command_line import _parser
from tailgate.core.registry import Spec
from tailgate.core.scenario import list_scenarios, list_suites

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *(p for p in sorted((ROOT / "docs").rglob("*.md")) if not {"generated", "extension"} & set(p.relative_to(ROOT).parts))]
OWN = re.compile(r"my\w*:|\.ya?ml|\.json|path=|\$|^bwrap/|[A-Z]|^all$")  # a reader's, or a word that stands for one


def _commands() -> list[tuple[str, str]]:
    """Return page and words of each command; without those that other commands write a part of."""
    out = []
    for page in PAGES:
        for block in re.findall(r"```console\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                for part in re.split(r" && |; done", line.strip().removeprefix("do ").removeprefix(".venv/bin/")):
                    if part.startswith("tailgate ") and "..." not in part and "$(" not in part:
                        out.append((page.name, part.removeprefix("tailgate ")))
    return out


def test_there_are_many() -> None:
    assert len(_commands()) > 150


@pytest.mark.parametrize(("page", "text"), _commands())
def test_a_documented_command_is_parsed(page: str, text: str) -> None:
    words = shlex.split(text, comments=True)
    options = vars(_parser().parse_args(words))

    def named(key: str) -> list[str]:
        held = options.get(key) or []
        return [name for name in ([held] if isinstance(held, str) else held) if name in words and not OWN.search(name)]

    assert {*named("suite"), *named("scenario")} <= {*list_suites(), *list_scenarios()}
    for name in named("defence"):
        Spec("defence", name).make()
    for name in named("attack"):
        Spec("attack", name).make()
