"""Defences: one method per file, its reference in the docstring."""

from .algorithm2 import AsPrinted
from .centralised import CentralisedKalman, CentralisedLasso
from .challenge import Challenger, ChallengeResponse, PyCra
from .chi_square import ChiSquare, GatedKalman
from .compose import AcceptAll, Composed, Decision, GateOut, NamedParts, Score, Stateless, Verdict, blame_all, compose
from .consensus import ConsensusFilter, ConsensusKalman
from .control_defences import AccFallback, InputClip, SlidingMode
from .detectors import Cusum, Mewma, WindowedChiSquare
from .disagreement import DisagreeingDistributedKalman, DisagreementFilter
from .distributed import DistributedFilter, DistributedKalman, DistributedKalmanFilter, GatedDistributedKalman, TailChiSquare
from .filterpy_filters import FilterpyExtended, FilterpyHInfinity, FilterpyInteracting, FilterpyKalman, FilterpyUnscented
from .imm import InteractingModels
from .kalman import Kalman, KalmanFilter
from .kinematic import JointRegression
from .lasso import LassoFilter, LassoKalman
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
from .norm_resilient import NormResilient, NormResilientFilter
from .oracle import DistributedOracle, Oracle
from .per_episode import EpisodeByEpisode, PerEpisode, per_episode
from .predictors import Autoregressive, HoldLast, Polynomial, Predictor
from .raw import Raw
from .reactive_brake import SafeState, SafeStateBrake
from .robust import Outlier, RobustKalman, RobustKalmanFilter
from .safe_state import SafeSet
from .saturated import SaturatedDistributedKalman, SaturatedFilter
from .sentinels import AlarmSentinel, BrakeSentinel, StandStillSentinel
from .sparse import SparseChiSquare, SparseGatedKalman
from .steered import Steered, SteeredChallenge
from .trimmed import TrimmedConsensus, TrimmedFilter
from .trust import TrustFilter, TrustingDistributedKalman

__all__ = [
    "AccFallback", "AcceptAll", "AlarmSentinel", "AsPrinted", "Autoregressive", "Brake", "BrakeSentinel", "BrakingKalman",
    "CentralisedKalman", "CentralisedLasso", "ChallengeResponse", "Challenger", "ChiSquare", "Composed", "ConsensusFilter",
    "ConsensusKalman", "Cusum", "CusumKalman", "CusumReacquiringKalman", "Decision", "DisagreeingDistributedKalman",
    "DisagreementFilter", "DistributedFilter", "DistributedKalman", "DistributedKalmanFilter", "DistributedOracle", "EpisodeByEpisode",
    "FilterpyExtended", "FilterpyHInfinity", "FilterpyInteracting", "FilterpyKalman", "FilterpyUnscented", "GateOut",
    "GatedDistributedKalman", "GatedKalman", "Hold", "HoldLast", "InputClip", "InteractingModels", "JointRegression", "Kalman",
    "KalmanFilter", "LassoFilter", "LassoKalman", "Latch", "Mewma", "MewmaKalman", "NamedParts", "NormResilient",
    "NormResilientFilter", "Oracle", "Outlier", "PerEpisode", "Polynomial", "Predictor", "PyCra", "Raw", "Reacquire",
    "ReacquiringKalman", "RobustKalman", "RobustKalmanFilter", "SafeSet", "SafeState", "SafeStateBrake",
    "SaturatedDistributedKalman", "SaturatedFilter", "Score", "SlidingMode", "SparseChiSquare",
    "SparseGatedKalman", "StandStillSentinel", "Stateless", "Steered", "SteeredChallenge", "TailChiSquare",
    "TrimmedConsensus", "TrimmedFilter", "TrustFilter", "TrustingDistributedKalman", "Verdict", "Widen", "WideningKalman",
    "WindowedChiSquare", "WindowedKalman", "blame_all", "compose", "per_episode",
]  # fmt: skip
