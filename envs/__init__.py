"""Plants, sensors, controllers and manoeuvres; the environments (gym) and their pictures (render)."""

from tailgate.base.lazy import exported

__getattr__, __dir__ = exported(__name__)
