"""Defences that challenge a sensor, and defences with knobs."""

from tailgate.moved import former

__getattr__ = former(__name__)
