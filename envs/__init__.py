"""Plants, sensors, controllers and manoeuvres, and the Gymnasium faces over the loop."""

from .controllers import AdaptiveCruise
from .following import CarFollowing
from .manoeuvres import Braking, Constant, OrnsteinUhlenbeck, Profile, StopAndGo
from .sensors import Odometry

__all__ = ["AdaptiveCruise", "Braking", "CarFollowing", "Constant", "Odometry", "OrnsteinUhlenbeck", "Profile", "StopAndGo"]
