"""The thesis, claim by claim: what it says, what is measured here, and whether it holds. Every figure is recomputed.

A chapter `chN` builds a `Report` from parts (`claims`): claims, tables and drawings, which the functions `parts` of its files yield.
Episodes come from `runs.play`, pictures from `figures`; `bounds`, `resilience` and `string_stability` hold theory.
"""

from .claims import Claim, Report
from .run import CHAPTERS, reproduce, write

__all__ = ["CHAPTERS", "Claim", "Report", "reproduce", "write"]
