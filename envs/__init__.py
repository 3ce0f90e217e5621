"""Plants, sensors, controllers and manoeuvres, and the Gymnasium faces over the loop."""

from .cacc import FeedForward
from .consensus_cacc import Consensus
from .controllers import AdaptiveCruise
from .following import CarFollowing
from .highway import Highway
from .idm import IntelligentDriver
from .linear_platoon import LinearPlatoon
from .literal import CarFollowingLiteral, RelativeDistance
from .manoeuvres import Braking, Constant, OrnsteinUhlenbeck, Profile, Pulse, Sine, StopAndGo, Switched
from .network import LinearSensors, NoControl, SensorNetwork
from .platoon import Platoon, PlatoonSensors
from .ploeg import Ploeg
from .radar import FmcwRadar
from .radar_car import RadarCruise
from .radar_following import RadarFollowing
from .scalar_loop import ExactReading, ScalarLoop, StateFeedback
from .sensors import Odometry

__all__ = [
    "AdaptiveCruise", "Braking", "CarFollowing", "CarFollowingLiteral", "Consensus", "Constant", "ExactReading", "FeedForward",
    "FmcwRadar", "Highway", "IntelligentDriver", "LinearPlatoon", "LinearSensors", "NoControl", "Odometry", "OrnsteinUhlenbeck", "Platoon",
    "PlatoonSensors", "Ploeg", "Profile", "Pulse", "RadarCruise", "RadarFollowing", "RelativeDistance", "ScalarLoop", "SensorNetwork",
    "Sine", "StateFeedback", "StopAndGo", "Switched",
]  # fmt: skip
