"""Attacks: scripted ones, learned policies, and the learners."""

from .burst_loss import BurstLoss
from .ghost import GhostState
from .model_based import Covert, Stealth, ZeroDynamics
from .optimal_dos import OptimalDos
from .optimal_hold import OptimalHold
from .optimal_stealth import OptimalStealth
from .policy import PolicyAttack, Yoked, load_policy, save_policy
from .program import Program
from .radio import EchoDelay, EchoPullOff, NoiseJam, RadarJam
from .scripted import (
    Delay,
    Dropout,
    Hold,
    Inject,
    InjectActuator,
    InjectBernoulli,
    InjectGaussian,
    InjectRamp,
    InjectSparse,
    InjectThenJam,
    InjectUniform,
    Jam,
    NoAttack,
    Replay,
    Script,
    ThesisTimes,
)  # fmt: skip
from .zoo import ZooAttack

__all__ = [
    "BurstLoss",
    "Covert",
    "Delay",
    "Dropout",
    "EchoDelay",
    "EchoPullOff",
    "GhostState",
    "Hold",
    "Inject",
    "InjectActuator",
    "InjectBernoulli",
    "InjectGaussian",
    "InjectRamp",
    "InjectSparse",
    "InjectThenJam",
    "InjectUniform",
    "Jam",
    "NoAttack",
    "NoiseJam",
    "OptimalDos",
    "OptimalHold",
    "OptimalStealth",
    "PolicyAttack",
    "Program",
    "RadarJam",
    "Replay",
    "Script",
    "Stealth",
    "ThesisTimes",
    "Yoked",
    "ZeroDynamics",
    "ZooAttack",
    "load_policy",
    "save_policy",
]  # fmt: skip
