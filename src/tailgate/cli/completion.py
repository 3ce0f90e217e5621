"""Completion of command lines in a shell, by argcomplete (extra `completion`)."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable

NAMES = {"suite": "suites", "suites": "suites", "scenario": "scenarios", "defence": "defences", "attack": "attacks"}


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
        elif action.dest in NAMES:
            action.completer = _known(NAMES[action.dest])  # type: ignore[attr-defined]


def _known(group: str) -> Callable[..., list[str]]:
    def names(**_: object) -> list[str]:
        import tailgate
        from tailgate.core.scenario import list_scenarios, list_suites

        makers = {"suites": list_suites, "scenarios": list_scenarios, "defences": tailgate.list_defences, "attacks": tailgate.list_attacks}
        return makers[group]()

    return names
