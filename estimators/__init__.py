"""Defences: one method per file, its reference in the docstring."""

from .chi_square import ChiSquare, GatedKalman
from .compose import AcceptAll, Composed, Decision, GateOut, NamedParts, Score, Stateless, Verdict, blame_all, compose
from .kalman import Kalman, KalmanFilter
from .oracle import Oracle
from .per_episode import PerEpisode, per_episode
from .raw import Raw
from .sentinels import AlarmSentinel, BrakeSentinel, StandStillSentinel

__all__ = [
    "AcceptAll", "AlarmSentinel", "BrakeSentinel", "ChiSquare", "Composed", "Decision", "GateOut", "GatedKalman", "Kalman",
    "KalmanFilter", "NamedParts", "Oracle", "PerEpisode", "Raw", "Score", "StandStillSentinel", "Stateless", "Verdict", "blame_all",
    "compose", "per_episode",
]  # fmt: skip
