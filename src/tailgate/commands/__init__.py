"""The commands of the command line; each file adds its own parser and runs it."""
