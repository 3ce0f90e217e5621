"""Pictures of one episode (extra: viz)."""

from tailgate.moved import former

__getattr__ = former(__name__)
