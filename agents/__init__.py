"""Attacks: scripted ones, learned policies, and the learners."""

from tailgate.base.lazy import exported

HOMES = {  # modules, and what they give to the package
    "burst_loss": "BurstLoss",
    "ghost": "GhostState",
    "model_based": "Covert Stealth ZeroDynamics",
    "optimal_dos": "OptimalDos",
    "optimal_hold": "OptimalHold",
    "optimal_stealth": "OptimalStealth",
    "policy": "PolicyAttack Yoked load_policy save_policy",
    "program": "Program",
    "radio": "EchoDelay EchoPullOff NoiseJam RadarJam",
    "scripted": "Delay Dropout Hold Inject InjectActuator InjectBernoulli InjectGaussian InjectRamp InjectSparse InjectThenJam "
    "InjectUniform Jam NoAttack Replay Script ThesisTimes",
    "zoo": "ZooAttack",
}
__getattr__, __all__ = exported(__name__, HOMES)
