"""Defences: one method per file, its reference in the docstring."""

from tailgate.base.lazy import exported

from .compose import compose as compose  # which stands here in place of the module of its name
from .per_episode import per_episode as per_episode  # likewise

HOMES = {  # modules, and what they give to the package
    "algorithm2": "AsPrinted",
    "centralised": "CentralisedKalman CentralisedLasso",
    "challenge": "Challenger ChallengeResponse PyCra",
    "chi_square": "ChiSquare GatedKalman",
    "compose": "AcceptAll Composed Decision GateOut NamedParts Score Stateless Verdict blame_all",
    "consensus": "ConsensusFilter ConsensusKalman",
    "control_defences": "AccFallback InputClip SlidingMode",
    "detectors": "Cusum Mewma WindowedChiSquare",
    "disagreement": "DisagreeingDistributedKalman DisagreementFilter",
    "distributed": "DistributedFilter DistributedKalman DistributedKalmanFilter GatedDistributedKalman TailChiSquare",
    "filterpy_filters": "FilterpyExtended FilterpyHInfinity FilterpyInteracting FilterpyKalman FilterpyUnscented",
    "imm": "InteractingModels",
    "kalman": "Kalman KalmanFilter",
    "kinematic": "JointRegression",
    "lasso": "LassoFilter LassoKalman",
    "mitigations": "Brake Hold Latch Reacquire Widen",
    "monitored": "BrakingKalman CusumKalman CusumReacquiringKalman MewmaKalman ReacquiringKalman WideningKalman WindowedKalman",
    "norm_resilient": "NormResilient NormResilientFilter",
    "oracle": "DistributedOracle Oracle",
    "per_episode": "EpisodeByEpisode PerEpisode",
    "predictors": "Autoregressive HoldLast Polynomial Predictor",
    "raw": "Raw",
    "reactive_brake": "SafeState SafeStateBrake",
    "robust": "Outlier RobustKalman RobustKalmanFilter",
    "safe_state": "SafeSet",
    "saturated": "SaturatedDistributedKalman SaturatedFilter",
    "sentinels": "AlarmSentinel BrakeSentinel StandStillSentinel",
    "sparse": "SparseChiSquare SparseGatedKalman",
    "steered": "Steered SteeredChallenge",
    "trimmed": "TrimmedConsensus TrimmedFilter",
    "trust": "TrustFilter TrustingDistributedKalman",
}
__getattr__, __all__ = exported(__name__, HOMES)
