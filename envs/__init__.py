"""Plants, sensors, controllers and manoeuvres, and the Gymnasium faces over the loop."""

from tailgate.base.lazy import exported

HOMES = {  # modules, and what they give to the package
    "cacc": "FeedForward",
    "consensus_cacc": "Consensus",
    "controllers": "AdaptiveCruise",
    "following": "CarFollowing",
    "highway": "Highway",
    "idm": "IntelligentDriver",
    "linear_platoon": "LinearPlatoon",
    "literal": "CarFollowingLiteral RelativeDistance",
    "manoeuvres": "Braking Constant OrnsteinUhlenbeck Profile Pulse Sine StopAndGo Switched",
    "network": "LinearSensors NoControl SensorNetwork",
    "platoon": "Platoon PlatoonSensors",
    "ploeg": "Ploeg",
    "radar": "FmcwRadar",
    "radar_car": "RadarCruise",
    "radar_following": "RadarFollowing",
    "scalar_loop": "ExactReading ScalarLoop StateFeedback",
    "sensors": "Odometry",
}
__getattr__, __all__ = exported(__name__, HOMES)
