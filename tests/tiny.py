"""A scenario of 40 steps for each id of Gymnasium, short enough for many episodes."""

import yaml

from tailgate.envs.gym.attacker_mdp import FACES

SYSTEMS = {name: defaults for name, defaults in FACES.items() if name.endswith("-v0")}  # an id for each kind of system
AUTORESETS = ("next_step", "same_step", "disabled")
CRASHES = {"scenario": "stop-and-go-v0", "defence": "kf", "value": -30.0, "threat": {"onset": 1}, "interval": 5}  # unguarded: it collides
KINDS = ["dos_jam", "dos_hold", "dropout", "fdi"]
TINY = {  # scenarios of 40 steps, short enough for many episodes
    "tailgate/CarFollowing-v0": {
        "plant": {"name": "car_following", "gap": 20.0}, "sensor": "odometry", "controller": "acc", "horizon": 40,
        "manoeuvre": {"name": "braking", "onset": [0.0, 1.0]}, "threat_model": {"kinds": KINDS, "onset": 3},
    },
    "tailgate/RadarFollowing-v0": {
        "plant": {"name": "radar_following", "gap": 60.0, "rear": True}, "sensor": "fmcw_radar", "controller": "acc_radar", "horizon": 40,
        "manoeuvre": {"name": "braking", "onset": [0.0, 1.0]},
        "threat_model": {"kinds": ["noise_jam", "echo_delay", "fdi"], "onset": 3},
    },
    "tailgate/Platoon-v0": {
        "plant": {"name": "platoon", "followers": 2, "gap": 14.0}, "sensor": "platoon_sensors", "controller": "cacc", "horizon": 40,
        "manoeuvre": {"name": "braking", "onset": [0.0, 1.0]},
        "threat_model": {"kinds": KINDS, "targets": ["distance", "velocity"], "agents": [1, 2], "onset": 3},
    },
    "tailgate/SensorNetwork-v0": {
        "plant": {"name": "sensor_network", "agents": 4, "states": 3, "graph": "ring"}, "sensor": {"name": "linear_sensors", "sensors": 2},
        "controller": "none", "manoeuvre": {"name": "constant", "value": 0.0}, "horizon": 40,
        "threat_model": {"kinds": KINDS, "agents": [0, 2], "onset": 3},
    },
    "tailgate/LaneKeeping-v0": {
        "plant": {"name": "lane_keeping", "half_lane": 0.7}, "sensor": "lane_camera", "controller": {"name": "lane_lqr", "margin": 0.7},
        "horizon": 40, "manoeuvre": "curves", "threat_model": {"kinds": KINDS, "onset": 3},
    },
    "tailgate/Highway-v0": {
        "plant": {"name": "highway", "lanes": 2, "ahead": 1}, "sensor": "fmcw_radar", "controller": "acc_radar", "horizon": 40,
        "manoeuvre": {"name": "constant", "value": 0.0}, "threat_model": {"kinds": KINDS, "onset": 3},
    },
}  # fmt: skip


def write(folder):
    """The scenarios as files; -> arguments of each id."""
    out = {}
    for name, data in TINY.items():
        path = folder / f"{name.split('/')[1]}.yaml"
        path.write_text(yaml.safe_dump(data))
        out[name] = {"scenario": str(path)}
    return out
