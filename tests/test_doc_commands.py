"""Commands of the documentation: every `tailgate ...` of README and docs has options that exist, and names what exists."""

import re
import shlex

import pytest

from tailgate.cli.command_line import _parser
from tailgate.core.registry import Spec
from tailgate.core.scenario import list_scenarios, list_suites
from tests.pages import PAGES, commands

OWN = re.compile(r"my\w*:|\.ya?ml|\.json|path=|\$|^bwrap/|[A-Z]|^all$")  # a reader's, or a word that stands for one


def _commands() -> list[tuple[str, str]]:
    """Return page and words of each command; without those that other commands write a part of."""
    parts = [(page, part.removeprefix("do ")) for page in PAGES for line in commands(page) for part in line.split("; ")]
    return [(page, part.removeprefix("tailgate ")) for page, part in parts if part.startswith("tailgate ") and "..." not in part and "$(" not in part]


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
