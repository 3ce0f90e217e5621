"""The command line: tailgate COMMAND, one file of `tailgate.cli` each.

Results go to standard output (tables for people, --json for machines), progress and errors to standard error.
"""

from __future__ import annotations

import argparse
import difflib
import errno
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn

import tailgate
from tailgate.base import sizes
from tailgate.base.errors import InputError, Killed
from tailgate.base.files import check_regular
from tailgate.base.interrupts import Ending, orderly
from tailgate.base.progress import silent
from tailgate.cli.completion import complete
from tailgate.cli.examples import EXAMPLES, GROUPS

EXIT_INPUT = 2
WRITTEN = ("out", "plot", "parquet", "video")  # options that name something to write
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # a stream that takes no more
OVERRIDE = re.compile(r"[A-Za-z_][\w.]*=")  # the beginning of key=value
CHOICE, OPTION = 0.6, 0.75  # likeness from which a name is suggested; options have their dashes in common
COMMANDS = (
    "train", "tune", "selfplay", "ensemble", "distil", "evaluate", "timing", "dose", "transfer", "zoo", "calibrate", "learn_envelope",
    "leaderboard", "log", "replay", "detect_log", "fit", "reproduce", "cost", "trust", "falsify", "rare", "bench", "list", "explain",
)  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns the exit code: 0 done, 1 a component failed, 2 bad input, 130 interrupted, 143 terminated."""
    complete(_parser)
    for name in ("stdout", "stderr"):  # closed by the shell, as by >&-
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 - until the process ends
    chosen = argparse.Namespace()
    sizes.tell = lambda text: print(f"tailgate: {text}", file=sys.stderr)
    with orderly(lambda: _kept(chosen)) as ending:
        return _done(arguments, chosen, ending)


def _done(arguments: Sequence[str] | None, chosen: argparse.Namespace, ending: Ending) -> int:
    try:
        _parser().parse_args(arguments, chosen)
        _check_paths(chosen)
        with _place(chosen):
            done = int(chosen.run(chosen))
            sys.stdout.flush()  # a full disk is an error of the command
            return done
    except BrokenPipeError:  # the reader of our output has gone
        sys.stderr.close()
        return 0
    except KeyboardInterrupt as error:
        return ending.last_words(error)
    except Exception as error:
        if ending.number:  # a module whose import is cut off may not be importable again while the command unwinds
            return ending.last_words(error)
        if isinstance(error, OSError) and (error.filename is not None or error.errno in FULL):
            error = InputError("file", str(error.filename or "standard output"), f"one that can be used ({error.strerror})")
        from tailgate.sandbox.limits import Lost

        if isinstance(error, Lost):
            error = InputError("defence", "in a sandbox", f"a class whose process goes on ({error})")
        if not isinstance(error, InputError) and not (isinstance(error, ImportError) and "tailgate[" in str(error)):
            raise
        print(f"tailgate: error: {error}", file=sys.stderr)
        if isinstance(error, Killed):
            print(f"tailgate: {_kept(chosen)}", file=sys.stderr)
        return EXIT_INPUT


def _check_paths(chosen: argparse.Namespace) -> None:
    """Raise InputError for an empty path of something to write: it would be the working directory, or nothing."""
    for name in WRITTEN:
        if getattr(chosen, name, None) == "":
            raise InputError(f"--{name}", "", "a path")
        if getattr(chosen, name, None):
            check_regular(Path(getattr(chosen, name)), f"--{name}")


@contextmanager
def _place(chosen: argparse.Namespace) -> Iterator[None]:
    """Play on the device, and where the workers run, that a command was given."""
    engine, address = getattr(chosen, "engine", "local"), getattr(chosen, "address", None)
    if address is not None and engine != "ray":
        raise InputError("--address", address, "--engine ray with it")
    with ExitStack() as stack:
        if getattr(chosen, "quiet", False):
            stack.enter_context(silent())
        if getattr(chosen, "device", "cpu") != "cpu":
            from tailgate.engine.cards import playing_on

            stack.enter_context(playing_on(chosen.device))
        if engine == "ray":
            from tailgate.base.cluster import on_ray

            stack.enter_context(on_ray(address, chosen.workers))
        yield


def _kept(chosen: argparse.Namespace) -> str:
    """Return what is left of a command that ended before its time."""
    return getattr(chosen, "kept", "nothing of it is kept")


class _Parser(argparse.ArgumentParser):
    """Says in one line what is wrong with the arguments, and which --help explains it; argparse shows the whole usage."""

    given: tuple[str, ...] = ()

    def __init__(self, *arguments: Any, keys: Callable[[], str] | None = None, **options: Any) -> None:
        """keys: returns what --help lists behind all else, which no other use of the command has to wait for."""
        super().__init__(*arguments, **{"formatter_class": _Formatter} | options)
        self.keys = keys
        self.add_argument("--quiet", action="store_true", default=argparse.SUPPRESS, help="show no progress")

    def format_help(self) -> str:
        return super().format_help() if self.keys is None else f"{super().format_help()}\n{self.keys()}\n"

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        self.given = tuple(map(str, sys.argv[1:] if args is None else args))
        found, rest = super().parse_known_args(args, namespace)
        if rest and hasattr(found, "overrides") and all(OVERRIDE.match(text) for text in rest):  # behind an option
            found.overrides, rest = [*found.overrides, *rest], []
        if rest:
            self.error(f"unrecognized arguments: {' '.join(rest)}")
        return found, rest

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_INPUT, f"{self.prog}: error: {' '.join(message.split())}{self._near(message)} (see {self.prog} --help)\n")

    def _near(self, message: str) -> str:
        """Return the nearest option of one that this command does not know, or the nearest choice."""
        if found := re.search(r"invalid choice: '?([^\s']+)'? \(choose from (.*)\)$", message, re.DOTALL):
            likeness, wrong, names = CHOICE, [found[1]], re.findall(r"[\w-]+", found[2])
        else:
            names = [name for name in self._option_string_actions if name.startswith("--")]
            options = [text.partition("=")[0] for text in self.given if text.startswith("--")]
            likeness, wrong = OPTION, [text for text in options if not any(name.startswith(text) for name in names)]
        if "--budget" in wrong and "--dose" in names:
            return "; did you mean --dose?"  # what training calls a budget
        near = [match for text in wrong for match in difflib.get_close_matches(text[:100], names, n=1, cutoff=likeness)]
        return f"; did you mean {near[0]}?" if near else ""


class _Formatter(argparse.HelpFormatter):
    """Wraps paragraphs. Lines that begin with a blank, such as those of an example, stay; a long one goes on as a shell reads it."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = []
        for line in text.split("\n"):
            lines.append(_command(line, width) if line.startswith(" ") else line and super()._fill_text(line, width, indent))
        return "\n".join(lines)


def _command(line: str, width: int) -> str:
    """Return a command in lines of this width, with a backslash at the end of each that goes on; quoted words stay whole."""
    if len(line) <= width:
        return line
    whole = re.sub('"[^"]*"', lambda found: found[0].replace(" ", "\0"), line)
    lines = textwrap.wrap(whole, width - len(" \\"), subsequent_indent=" " * 6, break_long_words=False, break_on_hyphens=False)
    return " \\\n".join(lines).replace("\0", " ")


def _shown(parser: argparse.ArgumentParser, words: str = "") -> None:
    """Give each command its example."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                _shown(command, f"{words} {name}".strip())
    if words in EXAMPLES:
        example = f"example:\n  {parser.prog} {EXAMPLES[words]}"
        parser.epilog = example if parser.epilog is None else f"{example}\n\n{parser.epilog}"


def _grouped(commands: argparse._SubParsersAction[Any]) -> str:
    """Return the commands by group with their helps, and leave them out of the usual list."""
    helps = {action.dest: action.help for action in commands._choices_actions}
    commands._choices_actions.clear()
    wide = max(map(len, helps)) + 2
    indent, width, lines = " " * (wide + 2), shutil.get_terminal_size().columns - 2, list[str]()
    for group, names in GROUPS.items():
        lines.append(f"{group}:")
        for name in names:
            lines += textwrap.wrap(helps[name] or "", max(width, 60), initial_indent=f"  {name:{wide}}", subsequent_indent=indent)
        lines.append("")
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="tailgate", description=(tailgate.__doc__ or "").split("\n")[0])
    parser.add_argument("--version", action="version", version=f"tailgate {tailgate.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name in COMMANDS:
        import_module(f"tailgate.cli.{name}").add(commands)
    _shown(parser)
    parser.epilog = f"{_grouped(commands)}\ntailgate COMMAND --help explains one, with an example."
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
