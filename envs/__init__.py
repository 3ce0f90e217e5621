"""Plants, sensors, controllers and manoeuvres, and the Gymnasium faces over the loop."""

from .controllers import AdaptiveCruise
from .following import CarFollowing
from .literal import CarFollowingLiteral, RelativeDistance
from .manoeuvres import Braking, Constant, OrnsteinUhlenbeck, Profile, StopAndGo
from .sensors import Odometry

__all__ = [
    "AdaptiveCruise", "Braking", "CarFollowing", "CarFollowingLiteral", "Constant", "Odometry", "OrnsteinUhlenbeck", "Profile",
    "RelativeDistance", "StopAndGo",
]  # fmt: skip
