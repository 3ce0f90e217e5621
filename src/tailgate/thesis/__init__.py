"""The thesis, claim by claim: what it says, what is measured here, and whether it holds. Every figure is recomputed."""

from .claims import Claim, Report
from .run import CHAPTERS, reproduce, write

__all__ = ["CHAPTERS", "Claim", "Report", "reproduce", "write"]
