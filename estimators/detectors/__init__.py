"""Detectors: an alarm from innovations."""

from tailgate.moved import former

__getattr__ = former(__name__)
