"""Scoring: from rows to a board, the list of admitted attacks, and the figures of detection."""

from .attacks import Admitted, admit, withdraw
from .attacks import read as read_attacks
from .board import score

__all__ = ["Admitted", "admit", "read_attacks", "score", "withdraw"]
