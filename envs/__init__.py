"""Plants, sensors, controllers and manoeuvres; the environments (gym) and their pictures (render)."""

from tailgate.base.lazy import discovered

__getattr__, __dir__ = discovered(__name__)
