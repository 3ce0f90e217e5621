"""Defences: one method per file, its reference in the docstring."""

from tailgate.base.lazy import discovered

from .compose import compose as compose  # the function, not the module of the same name
from .per_episode import per_episode as per_episode  # likewise

__getattr__, __dir__ = discovered(
    __name__, "Challenger", "Composed", "Decision", "DistributedFilter", "EpisodeByEpisode", "PerEpisode", "Predictor", "SafeSet",
    "Stateless", "Verdict", "blame_all",
)  # fmt: skip
