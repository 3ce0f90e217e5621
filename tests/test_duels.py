"""Duels of a board that knows numbers of episodes only."""

import itertools
from typing import Any

import numpy as np
import pytest

from tailgate.evaluation.paired import Harm, credible, duel


def _sets(n: int, k: int) -> list[Any]:
    """All ways in which k of n episodes can have come to damage, the first ones first."""
    return [np.isin(range(n), which).astype(float) for which in itertools.combinations(range(n), k)]


@pytest.mark.parametrize(("k", "counts"), [(k, (m,)) for k in range(6) for m in range(6)] + [(4, (1, 2)), (4, (0, 3)), (3, (2, 2))])
def test_p_lies_between_what_numbers_allow(k: int, counts: tuple[int, ...]) -> None:
    """Over all ways in which as many episodes can have come to damage, of one attack of a and some of b (a search of all of them)."""
    one, sure = np.ones(1, bool), np.zeros(len(counts), bool)
    mine = Harm((), _sets(5, k)[0][None], 0, ~one)
    found = [duel("g", "a", "b", mine, Harm((), np.stack(ways), int(np.argmax(counts)), sure)) for ways in itertools.product(*(_sets(5, m) for m in counts))]
    first = np.stack([_sets(5, m)[0] for m in counts])
    for x, y in (((~one), ~sure), (one, sure), (one, ~sure)):
        a, b = mine._replace(vague=x), Harm((), first, int(np.argmax(counts)), y)
        here = duel("g", "a", "b", a, b)
        assert here["bound"] and here["p"] == pytest.approx(max(made["p"] for made in found), abs=1e-12)
        assert here["only_a"] == max(made["only_a"] for made in found)
        assert all(credible(made, here, a, b) for made in found)
        for made in found:
            assert not credible(made | {"only_a": made["only_a"] + 1}, here, a, b)
            assert here["p"] == 1.0 or not credible(made | {"weaker": "b" if made["weaker"] == "a" else "a"}, here, a, b)
        low = min(made["p"] for made in found)
        assert not any(credible(made | {"p": low * 0.99}, here, a, b) for made in found)
    if len(counts) > 1:  # one attack of b is known, the other not
        some, held = np.array([True, False]), first[1]
        mixed = [made["p"] for made in (duel("g", "a", "b", mine, Harm((), np.stack([way, held]), int(np.argmax(counts)), sure)) for way in _sets(5, counts[0]))]
        assert duel("g", "a", "b", mine, Harm((), first, int(np.argmax(counts)), some))["p"] == pytest.approx(max(mixed), abs=1e-12)
