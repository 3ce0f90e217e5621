"""Filters of several agents that exchange messages."""

from tailgate.moved import former

__getattr__ = former(__name__)
