"""Trained policies as attacks, and the zoo."""

from tailgate.moved import former

__getattr__ = former(__name__)
