"""Sensors: the measurements of a plant's agents."""

from tailgate.moved import former

__getattr__ = former(__name__)
