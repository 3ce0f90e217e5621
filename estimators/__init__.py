"""Defences: one method per file, its reference in the docstring."""

from .chi_square import ChiSquare, GatedKalman
from .compose import AcceptAll, Composed, GateOut, Score, Stateless, compose
from .kalman import Kalman, KalmanFilter
from .oracle import Oracle
from .per_episode import PerEpisode, per_episode
from .raw import Raw
from .sentinels import AlarmSentinel, BrakeSentinel, StandStillSentinel

__all__ = [
    "AcceptAll", "AlarmSentinel", "BrakeSentinel", "ChiSquare", "Composed", "GateOut", "GatedKalman", "Kalman", "KalmanFilter",
    "Oracle", "PerEpisode", "Raw", "Score", "StandStillSentinel", "Stateless", "compose", "per_episode",
]  # fmt: skip
