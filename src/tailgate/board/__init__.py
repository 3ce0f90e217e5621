"""Boards: from rows to ranked results, the list of admitted attacks, and the figures of detection."""

from tailgate.evaluation.attack_list import Admitted
from tailgate.evaluation.attack_list import read as read_attacks

from .admission import admit, withdraw
from .score import score

__all__ = ["Admitted", "admit", "read_attacks", "score", "withdraw"]
