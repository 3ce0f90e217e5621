"""A defence with a watch on its score (tailgate.core.score_threshold)."""

from tailgate.core import Defence
from tailgate.core.score_threshold import Watched
from tailgate.estimators.compose import AcceptAll, Composed, Score, compose
from tailgate.estimators.detectors.chi_square import ChiSquare

OWN = ("prepare", "start", "step", "look")  # methods that a composed defence inherits, unless it overrides them


def watched(defence: Defence, threshold: float) -> Composed | Watched:
    """Return the defence with an alarm at a threshold on its score.

    A defence that only filters is composed with the chi-square test, whose alarm then changes nothing: a white-box attacker has a gate to
    stay below.
    """
    if isinstance(defence, Composed) and all(getattr(type(defence), name) is getattr(Composed, name) for name in OWN):
        filter_, detector, mitigation = defence.parts()
        if type(detector) is Score and type(mitigation) is AcceptAll and mitigation.mode == "normal":
            return compose(filter_, ChiSquare(threshold), mitigation)
    return Watched(defence, threshold)
