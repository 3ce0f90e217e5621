"""A class behind a sandbox on any command line, from its rows to a rank that somebody else has verified."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.board import score
from tailgate.core.draws import Draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, load_suite
from tailgate.core.veil import veiled
from tailgate.evaluation.cells import evaluate
from tailgate.evaluation.rounds import seeds_of
from tailgate.evaluation.verify import verify
from tailgate.sandbox import play_submission
from tailgate.sandbox.isolated import IsolatedPlan, _shown
from tailgate.training.adaptive import configs_of, train_against

pytestmark = pytest.mark.skipif(shutil.which("bwrap") is None, reason="bubblewrap is not installed")
BEACON, MINE = "0123456789abcdef", "bwrap/mine:Mine"
PLAN = {
    "config": "car-following", "dose": 12, "changes": ["environment.interval=20", "environment.frames=1", "teacher=null"], "seeds": 1,
    "learners": {"cem": ["steps=600", "cem={population: 4, episodes: 5, hidden: []}"]}, "knowledge": ["black"],
}  # fmt: skip
SMALL = Suite(
    "small-v0", "", ("gusty-stop-and-go-v0",), (12,), ("none", "chi2_kf"), ("none", "fdi:value=-4"), 4, {"kinds": ["fdi"], "fdi_bound": 5.0}, adaptive=PLAN,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where somebody's class lies: a copy of a built-in one, so that its rows are known."""
    where = tmp_path_factory.mktemp("theirs")
    (where / "mine.py").write_text("from tailgate.estimators.detectors.chi_square import GatedKalman\n\nclass Mine(GatedKalman):\n    '''A copy.'''\n", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(where)
        yield where


def test_it_plays_as_it_would_here_and_nobody_looks_into_it(folder: Path) -> None:
    """Rows, hash for hash, are those of the class itself; a white-box attack is skipped with the reason."""
    rows = evaluate(dataclasses.replace(SMALL, scenarios=("thesis-ch4-v0",)), defences=["chi2_kf", MINE], attacks=["fdi:value=-4", "stealth"])
    theirs = {(row["attack"], row["seed"]): row for row in rows if row["defence"] == MINE}
    for row in (row for row in rows if row["defence"] == "chi2_kf" and row["knowledge"] == "black"):
        assert theirs[row["attack"], row["seed"]]["trace_hash"] == row["trace_hash"]
    skipped = [row for row in theirs.values() if row["attack"] == "stealth"]
    assert len(skipped) == 4 and all(row["status"] == "skipped" and "cannot look ahead" in row["reason"] for row in skipped)


def test_training_does_not_show_in_the_keys_that_it_draws_with() -> None:
    """Within a veil an episode keeps its key, and no key or number of an episode is the real one.

    Rows of one episode share their key, as where they count: else a class could tell by it.
    """
    key, episode = np.array([5, 5, 9, 9], np.uint64), np.array([0, 1, 0, 0], np.uint32)
    drawn, plan = Draws(key, episode, np.zeros(4, np.uint32), 0), IsolatedPlan(None, None)
    assert _shown(plan, drawn)[0] is key and _shown(plan, drawn)[1] is episode
    seen = []
    for _ in range(2):
        with veiled():
            first, number = _shown(plan, drawn)
            later, _ = _shown(plan, drawn._replace(episode=np.array([0, 2, 0, 0], np.uint32)))
            again, _ = _shown(IsolatedPlan(None, None), drawn)
        assert np.array_equal(first, again) and (first == later).tolist() == [True, False, True, True] and not number.any()
        assert len(set(first.tolist())) == 3 and first[2] == first[3]
        seen += [*first[:3].tolist(), int(later[1])]
    assert len(set(seen)) == 8 and not {5, 9} & set(seen)


def test_a_file_may_name_a_class_in_a_sandbox_and_none_without(tmp_path: Path, folder: Path) -> None:
    """What a configuration names runs nowhere but in a sandbox."""
    for text, allowed in ((MINE, True), ("mine:Mine", False)):
        (tmp_path / "s.yaml").write_text(f"scenarios: [stop-and-go-v0]\ndefences: ['{text}']\nattacks: [none]\n", encoding="utf-8")
        if allowed:
            assert load_suite(str(tmp_path / "s.yaml")).defences == (MINE,)
        else:
            with pytest.raises(InputError, match="a configuration imports nothing"):
                load_suite(str(tmp_path / "s.yaml"))
    assert not Spec("defence", MINE).imports and Spec("defence", MINE).target == "mine:Mine" and len(Spec("defence", MINE).digest) == 64


@pytest.mark.long
def test_from_a_submission_to_a_rank_that_others_verify(folder: Path, tmp_path: Path) -> None:
    """The round's rows, those of the attackers that were trained against the class in its sandbox, its rank; and each row played again."""
    rows = evaluate(SMALL, beacon=BEACON) + play_submission("mine:Mine", SMALL, sandbox="bwrap", beacon=BEACON)
    assert {row["seed"] for row in rows} == set(seeds_of(BEACON, "small-v0", "report", 4))

    def entry(more: list) -> dict:
        return next(e for e in score([*rows, *more], SMALL)["entries"] if e["defence"] == "mine:Mine")

    assert entry([])["status"] == "unattacked"
    policies = train_against(configs_of(SMALL, MINE, tmp_path, extra=("workers=1",)), lambda *_: None)
    attacked = dataclasses.replace(SMALL, attacks=tuple(str(path) for path in policies))
    own = play_submission("mine:Mine", attacked, sandbox="bwrap", beacon=BEACON)
    assert own[0]["trained"]["defence"] == "mine:Mine" and own[0]["trained"]["digest"] == own[0]["defence_digest"] != ""
    assert entry(own)["status"] == "ranked" and entry(own)["rank"] == {"best": 1, "worst": 1}

    every = [*rows, *own]
    forged = [row | {"min_gap": row["min_gap"] + 1.0} if row["defence"] == "mine:Mine" else row for row in own]
    found = verify([*every, *forged, own[0] | {"seed": 7}], submissions=[MINE])
    assert found["counts"] == {"verified": len(every), "differs": len(own), "unchecked": 1} and any("none of the first" in one["why"] for one in found["reasons"])
    alone = verify(every)
    assert alone["counts"]["unchecked"] == sum(row["defence"] == "mine:Mine" for row in every) and "--submission bwrap/mine:Mine" in alone["reasons"][0]["why"]
    (folder / "mine.py").write_text((folder / "mine.py").read_text() + "# changed\n", encoding="utf-8")
    assert "digest" in verify(own, submissions=[MINE])["reasons"][0]["why"]
