"""Sensors: what a plant's agents measure."""

from tailgate.moved import former

__getattr__ = former(__name__)
