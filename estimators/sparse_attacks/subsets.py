"""The subsets of sensors that an estimator goes through, and how many attacked ones it can correct.

s attacked sensors can be corrected where the system is 2s-sparse observable (Fawzi, Tabuada and Diggavi 2014; Shoukry and Tabuada 2016).
Two explanations of the same readings differ in 2s sensors at most.
"""

from itertools import combinations
from math import comb

import numpy as np

from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array, Model
from tailgate.core.reach import sparsity

MOST = 5000  # filters, or subsets that are looked through


def correctable(model: Model) -> int:
    """Return the largest number s of attacked sensors that every agent can correct on its own readings; -1 if one observes too little."""
    return int(np.min(sparsity(model) // 2))


def require(model: Model, s: int, name: str, most: int = MOST) -> None:
    """Raise NotApplicable where s attacked sensors cannot be corrected; it names the largest s that can.

    Raises InputError where there are more than `most` subsets without s sensors.
    """
    largest = correctable(model)
    if s > largest:
        q, k = len(model.sensors), int(np.min(sparsity(model)))
        wanted = f"at most {largest}: the {q} sensors" if largest >= 0 else f"another system: the {q} sensors"
        reason = f"are {k}-sparse observable, and s needs 2s" if k >= 0 else "do not observe the state"
        raise NotApplicable(f"{name}.s", s, f"{wanted} of an agent {reason}")
    if comb(len(model.sensors), s) > most:
        raise InputError(f"{name}.s", s, f"fewer subsets than {comb(len(model.sensors), s)}: at most {most}")


def without(q: int, s: int) -> Array:
    """Return (K, q) bool, the subsets of q - s sensors; in the first, the last sensors are left out."""
    kept = [np.isin(np.arange(q), some) for some in combinations(range(q), q - s)]
    return np.array(kept).reshape(-1, q)
