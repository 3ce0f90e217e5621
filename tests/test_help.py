"""Help texts: commands in groups, and an example of each that its parser takes."""

import argparse
import shlex
from collections.abc import Iterator

import pytest

from tailgate.cli import COMMANDS, main
from tailgate.cli.command_line import _parser
from tailgate.cli.examples import EXAMPLES, GROUPS


def leaves(parser: argparse.ArgumentParser, words: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield every command that runs something, by its words."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        yield words, parser
    for action in inner:
        for name, command in action.choices.items():
            yield from leaves(command, f"{words} {name}".strip())


def test_every_command_has_an_example_that_its_parser_takes() -> None:
    commands = dict(leaves(_parser()))
    assert commands.keys() == EXAMPLES.keys()
    for words, command in commands.items():
        assert f"example:\n  tailgate {words} {EXAMPLES[words]}" in command.format_help()
        assert callable(_parser().parse_args([*words.split(), *shlex.split(EXAMPLES[words])]).run)


def test_the_first_help_lists_every_command_in_a_group(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """In lines that fit the terminal."""
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    names = [name for group in GROUPS.values() for name in group]
    assert len(names) == len(set(names)) == len(COMMANDS) and all(f"\n  {name} " in shown for name in names)
    assert all(f"{group}:" in shown for group in GROUPS)
