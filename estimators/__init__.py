"""Defences: one method per file, its reference in the docstring."""

from .chi_square import ChiSquare, GatedKalman
from .compose import AcceptAll, Composed, Decision, GateOut, NamedParts, Score, Stateless, Verdict, blame_all, compose
from .detectors import Cusum, Mewma, WindowedChiSquare
from .filterpy_filters import FilterpyExtended, FilterpyHInfinity, FilterpyInteracting, FilterpyKalman, FilterpyUnscented
from .imm import InteractingModels
from .kalman import Kalman, KalmanFilter
from .mitigations import Brake, Hold, Latch, Reacquire, Widen
from .monitored import (
    BrakingKalman,
    CusumKalman,
    CusumReacquiringKalman,
    MewmaKalman,
    ReacquiringKalman,
    WideningKalman,
    WindowedKalman,
)
from .oracle import Oracle
from .per_episode import EpisodeByEpisode, PerEpisode, per_episode
from .raw import Raw
from .robust import Outlier, RobustKalman, RobustKalmanFilter
from .sentinels import AlarmSentinel, BrakeSentinel, StandStillSentinel
from .sparse import SparseChiSquare, SparseGatedKalman

__all__ = [
    "AcceptAll", "AlarmSentinel", "Brake", "BrakeSentinel", "BrakingKalman", "ChiSquare", "Composed", "Cusum", "CusumKalman",
    "CusumReacquiringKalman", "Decision", "EpisodeByEpisode", "FilterpyExtended", "FilterpyHInfinity", "FilterpyInteracting",
    "FilterpyKalman", "FilterpyUnscented", "GateOut", "GatedKalman", "Hold", "InteractingModels", "Kalman", "KalmanFilter",
    "Latch", "Mewma", "MewmaKalman", "NamedParts", "Oracle", "Outlier", "PerEpisode", "Raw", "Reacquire", "ReacquiringKalman",
    "RobustKalman", "RobustKalmanFilter", "Score", "SparseChiSquare", "SparseGatedKalman", "StandStillSentinel", "Stateless",
    "Verdict", "Widen", "WideningKalman", "WindowedChiSquare", "WindowedKalman", "blame_all", "compose", "per_episode",
]  # fmt: skip
