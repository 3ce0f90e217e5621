"""Attacks: scripted ones, learned policies, and the learners."""

from .scripted import (
    Dropout, Hold, Inject, InjectBernoulli, InjectGaussian, InjectRamp, Jam, NoAttack, Script, Stealth, ThesisTimes,
)  # fmt: skip

__all__ = [
    "Dropout", "Hold", "Inject", "InjectBernoulli", "InjectGaussian", "InjectRamp", "Jam", "NoAttack", "Script", "Stealth",
    "ThesisTimes",
]  # fmt: skip
