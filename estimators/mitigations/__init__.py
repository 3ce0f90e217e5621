"""Mitigations: what a defence does after an alarm."""

from tailgate.moved import former

__getattr__ = former(__name__)
