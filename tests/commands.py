"""One command of the command line, without the parsers of the others."""

import argparse
from typing import Any


def ran(command: Any, *words: str) -> int:
    """The exit code of a command of `tailgate.cli` with its words."""
    parser = argparse.ArgumentParser()
    command.add(parser.add_subparsers())
    options = parser.parse_args(words)
    return int(options.run(options))
