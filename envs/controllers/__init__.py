"""Controllers: how a vehicle drives on its estimate."""

from tailgate.moved import former

__getattr__ = former(__name__)
