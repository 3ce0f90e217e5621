"""Plants, sensors, controllers and manoeuvres, and the Gymnasium faces over the loop."""

from .cacc import FeedForward
from .consensus_cacc import Consensus
from .controllers import AdaptiveCruise
from .following import CarFollowing
from .linear_platoon import LinearPlatoon
from .literal import CarFollowingLiteral, RelativeDistance
from .manoeuvres import Braking, Constant, OrnsteinUhlenbeck, Profile, Pulse, Sine, StopAndGo
from .network import LinearSensors, NoControl, SensorNetwork
from .platoon import Platoon, PlatoonSensors
from .ploeg import Ploeg
from .sensors import Odometry

__all__ = [
    "AdaptiveCruise", "Braking", "CarFollowing", "CarFollowingLiteral", "Consensus", "Constant", "FeedForward", "LinearPlatoon",
    "LinearSensors", "NoControl", "Odometry", "OrnsteinUhlenbeck", "Platoon", "PlatoonSensors", "Ploeg", "Profile", "Pulse",
    "RelativeDistance", "SensorNetwork", "Sine", "StopAndGo",
]  # fmt: skip
