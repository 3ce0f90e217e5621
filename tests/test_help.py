"""Help texts: commands in groups, and an example of each that its parser takes."""

import argparse
import json
import re
import shlex
import sys
from collections.abc import Iterator
from typing import Any

import pytest

from tailgate.agents.learners import cem
from tailgate.agents.learners.learning import LEARNERS, learner_of
from tailgate.base.reading import load_yaml
from tailgate.cli import COMMANDS, main
from tailgate.cli.command_line import _parser
from tailgate.cli.examples import EXAMPLES, GROUPS
from tailgate.core.scenario import config_path
from tailgate.core.schema import as_data, fields_of
from tailgate.core.threat import ThreatModel
from tailgate.envs.gym.actions import ActionSpec
from tailgate.envs.gym.duel import Payoff
from tailgate.envs.gym.rewards import Reward
from tailgate.estimators.challenge.steering import Menu


def leaves(parser: argparse.ArgumentParser, words: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield every command that runs something, by its words."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        yield words, parser
    for action in inner:
        for name, command in action.choices.items():
            yield from leaves(command, f"{words} {name}".strip())


def commands_of(parser: argparse.ArgumentParser, words: str = "") -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield every parser with a help, by its words."""
    yield words, parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield from commands_of(command, f"{words} {name}".strip())


def help_of(name: str) -> str:
    return dict(leaves(_parser()))[name].format_help()


def test_every_command_has_an_example_that_its_parser_takes() -> None:
    commands = dict(leaves(_parser()))
    assert commands.keys() == EXAMPLES.keys()
    for words, command in commands.items():
        (shown,) = re.findall(r"^example:\n((?:  .*\\\n)*  .*)$", command.format_help(), flags=re.M)
        assert shlex.split(shown.replace("\\\n", "")) == ["tailgate", *words.split(), *shlex.split(EXAMPLES[words])]  # as a shell reads it
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


def test_every_help_fits_a_terminal_of_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    found = dict(commands_of(_parser()))
    assert {"", "train", "leaderboard", "leaderboard export"} < found.keys() and len(found) > len(COMMANDS)
    wide = {words: long for words, command in found.items() if (long := [line for line in command.format_help().splitlines() if len(line) > 80])}
    assert not wide


def known(text: str) -> dict[str, Any]:
    """Return the default of each key that a help lists, without those that are cut."""
    shown = dict(re.findall(r"(?m)^  ([a-z_.0-9]+)\s+[^\n]*\(default: (.*)\)$", text.replace("\n" + " " * 24, " ")))
    values = {key: value.partition("; in a preset")[0] for key, value in shown.items()}
    return {key: json.loads(value) for key, value in values.items() if not value.endswith("...")}


@pytest.mark.thin(2)
@pytest.mark.parametrize(("command", "folder", "preset"), [("train", "", "quickstart"), ("selfplay", "games", "selfplay")])
def test_help_lists_every_nested_key_with_its_default(command: str, folder: str, preset: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And what the preset of the bare command sets in its place."""
    monkeypatch.setenv("COLUMNS", "9999")
    places: dict[str, tuple[type, ...]] = {"environment": (ActionSpec, Reward), "threat": (ThreatModel,)}
    if command == "train":
        pytest.importorskip("sb3_contrib")
        places |= {name: (learner_of(name).Config,) for name in LEARNERS}
    else:
        places |= {"attacker": (cem.Config,), "defender": (cem.Config,), "menu": (Menu,), "payoff": (Payoff,)}
    elsewhere = {"environment.gamma", "environment.horizon_ends", "menu.interval"}  # keys themselves; environment.interval is that of the menu
    fields = {f"{place}.{name}": field for place, kinds in places.items() for kind in kinds for name, field in fields_of(kind).items()}
    held = load_yaml(config_path(folder or ".", preset, "config"))
    found = known(help_of(command))
    wanted = {key: as_data(held.get(key.partition(".")[0], {}).get(key.partition(".")[2], f.default)) for key, f in fields.items()}
    nested = {key: value for key, value in found.items() if "." in key}
    assert nested == {key: value for key, value in wanted.items() if key not in elsewhere} | {"environment.frames": 1}
    monkeypatch.setenv("COLUMNS", "80")
    assert all(re.search(rf"^  {re.escape(key)}(  |$)", help_of(command), flags=re.M) for key in nested)


def test_help_without_an_extra_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [name for name in sys.modules if name.startswith("tailgate.agents.learners.") and name.rpartition(".")[2] in {"ppo", "sac"}]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "tailgate.agents.learners.stable", None)
    shown = " ".join(help_of("train").split())
    assert "keys below ppo: hyper-parameters of PPO; they are listed where tailgate[train] is installed" in shown
    assert "cem.population" in shown and " ppo.epochs " not in shown
