"""Completion of command lines in a shell, by argcomplete (extra `completion`)."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable
from typing import Any

NAMES = {"suite": "suites", "suites": "suites", "scenario": "scenarios", "defence": "defences", "attack": "attacks"}

WORDS = {("board", "BOARD"): "boards", ("format", "FORM"): "forms"}  # by the name of the value too: other commands mean other things


def complete(make: Callable[[], argparse.ArgumentParser]) -> None:
    """Say how a line may go on, and exit, where a shell asks; else do nothing. make: returns the parser of all commands."""
    if "_ARGCOMPLETE" not in os.environ:
        return
    try:
        import argcomplete
    except ImportError:
        raise SystemExit(1) from None  # not the command itself, which the shell did not ask for
    parser = make()
    _name(parser)
    argcomplete.autocomplete(parser)


def _name(parser: argparse.ArgumentParser) -> None:
    """Let the options of all commands complete names of components."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _name(command)
        elif (group := WORDS.get((action.dest, str(action.metavar)))) is not None:
            action.completer = _known(group)  # type: ignore[attr-defined]
        elif action.dest in NAMES:
            action.completer = _known(NAMES[action.dest])  # type: ignore[attr-defined]


def _known(group: str) -> Callable[..., list[str]]:
    def names(prefix: str, **_: object) -> list[str]:
        from argcomplete.completers import FilesCompleter

        import tailgate
        from tailgate.board.export import FORMATS
        from tailgate.board.files import published
        from tailgate.core.scenario import list_scenarios, list_suites

        def boards() -> list[str]:
            files: Any = FilesCompleter(("json", "xz"))  # which has no types
            return [*published(), *files(prefix)]

        makers: dict[str, Callable[[], Iterable[str]]] = {
            "suites": list_suites, "scenarios": list_scenarios, "defences": tailgate.list_defences,
            "attacks": tailgate.list_attacks, "boards": boards, "forms": lambda: FORMATS,
        }  # fmt: skip
        return list(makers[group]())

    return names
