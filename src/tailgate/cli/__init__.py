"""The command line: tailgate COMMAND, one file each; each file adds its own parser and runs it."""

from tailgate.cli.command_line import COMMANDS, EXIT_INPUT, main

__all__ = ["COMMANDS", "EXIT_INPUT", "main"]
