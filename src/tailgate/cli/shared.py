"""Shared parts of commands: options, progress, tables, and results for people, or with --json for machines."""

from __future__ import annotations

import argparse
import contextlib
import json
import secrets
import shlex
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from rich.console import Console

from tailgate.base import own_modules
from tailgate.base.errors import InputError, one_line
from tailgate.base.extras import optional
from tailgate.base.files import aside, set_aside, writable_directory
from tailgate.base.plots import FORMS
from tailgate.base.progress import Update, console, progress
from tailgate.cli.tables import table as table
from tailgate.core.schema import scalar

T = TypeVar("T")
Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # that a command is added to
SHOWN = 20  # lines of one kind that are listed, at most
MORE = "; --json lists them all"
OPTIONS: dict[str, dict[str, Any]] = {  # that several commands have in the same words
    "suite": {"metavar": "SUITE", "help": "suite by name or YAML file"},
    "policies": {"nargs": "+", "metavar": "POLICY", "help": "JSON file of an exported policy, or zoo:name=NAME"},
    "overrides": {"nargs": "*", "metavar": "key=value", "help": "change a field of the configuration"},
    "--suite": {"metavar": "NAME", "help": "suite by name or YAML file (default: quick-v0; with --scenario at the scenario's own dose)"},
    "--defence": {"action": "append", "metavar": "NAME", "help": "a defence instead of the suite's (repeatable)"},
    "--attack": {"action": "append", "metavar": "NAME", "help": "an attack instead of the suite's (repeatable)"},
    "--scenario": {"action": "append", "metavar": "NAME", "help": "a scenario instead of the suite's (repeatable)"},
    "--dose": {"action": "append", "metavar": "STEPS", "help": "attack budget; none: the scenario's own (repeatable)"},
    "--threat": {"action": "append", "metavar": "key=value", "default": [], "help": "change the threat model (repeatable)"},
    "--purpose": {"default": "report", "help": "which seeds: train, tune, calibrate, select or report (default)"},
    "--outcome": {"metavar": "METRIC", "help": "metric that is counted (default: the training's)"},
    "--workers": {"type": int, "default": 1, "metavar": "N", "help": "processes (default 1); changes no result"},
    "--device": {"default": "cpu", "metavar": "NAME", "help": "where episodes are played: cpu (default) or cuda; changes no result"},
    "--engine": {"default": "local", "choices": ["local", "ray"], "help": "where workers run: this machine (default), or a Ray cluster"},
    "--address": {"metavar": "HOST:PORT", "help": "of the head of a cluster (default: one on this machine, for this command)"},
    "--sample-seed": {"type": int, "metavar": "N", "help": "which ones (default: a new secret each time; the report names it)"},
    "--out": {"required": True, "metavar": "DIR", "help": "folder of the boards"},
    "--title": {"help": "title of the page"},
    "--picture": {"default": "png", "choices": list(FORMS), "help": "form of pictures (default png); svg and pdf are vectors, for papers"},
    "--no-replays": {"action": "store_true", "help": "leave out the replays of the worst episodes"},
    "--json": {"action": "store_true", "help": "print the report as JSON"},
}


def add_options(command: argparse.ArgumentParser, *names: str) -> None:
    """Add shared options to a command."""
    for name in names:
        command.add_argument(name, **OPTIONS[name])


def sample_seed(options: argparse.Namespace) -> int:
    """Return the seed of a sample: a new secret unless given, since who could foresee the sample would forge all else."""
    return secrets.randbits(32) if options.sample_seed is None else int(options.sample_seed)


def drawn_by(report: dict[str, Any]) -> str:
    """Return the seed of a report's sample, in words; empty where all was asked for."""
    return "" if report["sample"] is None else f", drawn by the seed {report['sample_seed']}"


def own_classes() -> None:
    """Look for module:Class in the working directory too, behind the installed packages."""
    own_modules.allow()


def values(option: str, texts: Iterable[str], example: str = "") -> dict[str, Any]:
    """Return what a repeatable option of key=value gives. Raises InputError for a text without `=`."""
    out = {}
    for text in texts:
        key, sep, value = text.partition("=")
        if not sep:
            raise InputError(option, text, f"key=value{example}")
        out[key] = scalar(value)
    return out


def threat_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return the changes of a threat model that --threat gives."""
    return values("--threat", options.threat, ", for example fdi_bound=10")


def played_by(scenario: str, defence: str, attack: str, threat: dict[str, Any]) -> str:
    """Return the command that plays an attack on a defence in a scenario, under these changes of its threat model."""
    words = ["tailgate", "evaluate", "--scenario", scenario, "--defence", defence, "--attack", attack]
    for key, value in threat.items():
        words += ["--dose", str(value)] if key == "budget" and value is not None else ["--threat", f"{key}={json.dumps(value)}"]
    return shlex.join(words)


def picture(option: str, text: str | None) -> Path | None:
    """Return the file of a picture, if any. Raises InputError for one that cannot be written, or has another ending than a picture's."""
    if text is not None and Path(text).suffix.lower().removeprefix(".") not in FORMS:
        raise InputError(option, text, f"a file name that ends in {', '.join('.' + form for form in FORMS)}")
    if text is not None:
        figures()
    return written(option, text)


def figures() -> None:
    """Raise ImportError with what installs it if the package for figures is missing, before anything is played."""
    optional("matplotlib", "viz", "figures need matplotlib")


@contextmanager
def telling_aside(path: Path | str | None, held: str = "something else") -> Iterator[None]:
    """Say at the end of a block what was set aside at a path meanwhile; held: what it held before."""
    before = aside(path)
    yield
    for earlier in sorted(aside(path) - before):
        tell(f"{path} held {held}; it is in {earlier}")


def written(option: str, text: str | None) -> Path | None:
    """Return the file that an option names, once it is sure that it can be written. Raises InputError where it cannot."""
    if text is None:
        return None
    path = Path(text)
    writable_directory(path.parent, option, asked=path)
    if path.is_dir() or not path.name:
        raise InputError(option, text, "a file, not a directory")
    return path


@contextmanager
def written_to(path: Path) -> Iterator[None]:
    """Try that a file can be written before the work of a block, and set aside at its end what was there; say so."""
    written("--out", str(path))
    yield
    if path.exists():
        tell(f"{path} held something else; it is in {set_aside(path)}")


def working() -> AbstractContextManager[Update]:
    """Show progress on standard error."""
    return progress(Console(stderr=True))


def counted(update: Update, label: str, of: str = "cells") -> Callable[[int, int], None]:
    """Return a progress that counts under a label."""
    return lambda done, total: update(label, done, total, f"{done} of {total} {of}")


def tell(text: str) -> None:
    """Print a line for people on standard error."""
    with contextlib.suppress(OSError):  # nobody reads it, or the disk is full
        print(f"tailgate: {one_line(text)}", file=sys.stderr)


def print_json(data: object) -> None:
    """Print data as JSON."""
    print(json.dumps(data, indent=1, allow_nan=False))


def show(options: argparse.Namespace, data: T, tables: Callable[[T], None]) -> None:
    """Print data as JSON with --json, else as tables."""
    (print_json if options.json else tables)(data)


def say(text: str, soft_wrap: bool = False) -> None:
    """Print a line on standard output, without markup and control characters."""
    console().print("\n".join(map(one_line, text.split("\n"))), markup=False, highlight=False, soft_wrap=soft_wrap)


def say_most(lines: Sequence[str], more: str = MORE, soft_wrap: bool = False) -> None:
    """Print the first lines, and how many there are beyond."""
    for line in lines[:SHOWN]:
        say(line, soft_wrap)
    if len(lines) > SHOWN:
        say(f"and {len(lines) - SHOWN} more{more}")
