"""Attacks: scripted ones, learned policies, and the learners."""

from .policy import PolicyAttack, Yoked, load_policy, save_policy
from .scripted import (
    Dropout,
    Hold,
    Inject,
    InjectBernoulli,
    InjectGaussian,
    InjectRamp,
    InjectThenJam,
    Jam,
    NoAttack,
    Script,
    Stealth,
    ThesisTimes,
)  # fmt: skip

__all__ = [
    "Dropout",
    "Hold",
    "Inject",
    "InjectBernoulli",
    "InjectGaussian",
    "InjectRamp", "InjectThenJam",
    "Jam",
    "NoAttack",
    "PolicyAttack",
    "Script",
    "Stealth",
    "ThesisTimes",
    "Yoked",
    "load_policy",
    "save_policy",
]  # fmt: skip
