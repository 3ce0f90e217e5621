"""Scoring: every figure of a board from rows whose answer is known by hand."""

import copy
import json
import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tailgate.base.errors import InputError
from tailgate.board import score
from tailgate.board.files import read_board
from tailgate.evaluation.paired import mcnemar
from tailgate.evaluation.stats import limits
from tailgate.studies.policies import rising

from .scored import NETWORK, OTHER, ROAD, board, cell, clean, entry, rate, suite


def test_the_critical_dose_lies_where_the_straight_line_between_two_doses_passes_a_tenth() -> None:
    """0, 1 and 5 of 20 at 10, 20 and 40 steps: 5 % and 25 %, so a tenth at 25 steps."""
    made = entry(board([*clean("a"), *cell("none", "fdi"), *cell("a", "fdi", [0, 1, 5])]), "a")["critical_dose"]["black"]
    assert made["value"] == pytest.approx(25.0)
    assert made["low"] <= 25.0 and (made["high"] is None or made["high"] >= 25.0)
    assert made["worst"] == {"scenario": ROAD, "attack": "fdi"}


def test_a_curve_that_falls_is_made_monotone_before_the_dose_is_read_off() -> None:
    """0, 6 and 2 of 20 pool to 0, 4 and 4: 20 % from 20 steps on, a tenth half way between 10 and 20."""
    made = board([*clean("a"), *cell("none", "fdi"), *cell("a", "fdi", [0, 6, 2])])
    assert entry(made, "a")["critical_dose"]["black"]["value"] == pytest.approx(15.0)
    curve = next(c for c in made["curves"] if c["defence"] == "a" and c["knowledge"] == "black")
    assert [p["dose"] for p in curve["points"]] == [0, 10, 20, 40] and curve["fitted"] == pytest.approx([0, 0, 0.2, 0.2])
    assert all(p["low"] <= p["value"] <= p["high"] for p in curve["points"])


def test_no_critical_dose_beyond_the_largest_and_yet_a_lower_end_of_the_interval() -> None:
    """14 of 200 are no more than a tenth, but the upper limit is; where nothing ever happens in as many there is no lower end either."""
    rows = [*clean("a", "b", n=200), *cell("none", "fdi", n=200), *cell("a", "fdi", [0, 0, 14], n=200), *cell("b", "fdi", n=200)]
    made = board(rows)
    near, far = (entry(made, name)["critical_dose"]["black"] for name in "ab")
    assert near["value"] is None and near["high"] is None and 20.0 < near["low"] <= 40.0
    assert far["value"] is None and far["low"] is None


def test_the_figure_is_the_worst_over_attacks_and_scenarios_and_names_it() -> None:
    """Each dose may have another worst attack; a limit that holds for all of them together is the one of alpha over their number."""
    where = suite(scenarios=(ROAD, OTHER), attacks=("none", "fdi", "jam"))
    rows = [row for s in (ROAD, OTHER) for row in clean("a", scenario=s)]
    rows += [row for s in (ROAD, OTHER) for attack in ("fdi", "jam") for row in cell("none", attack, scenario=s)]
    rows += [*cell("a", "fdi", [3, 0, 0]), *cell("a", "jam", [0, 4, 0]), *cell("a", "fdi", [0, 0, 8], scenario=OTHER), *cell("a", "jam", scenario=OTHER)]
    found = entry(board(rows, where), "a")
    assert [rate(found, d)["undamaged"]["value"] for d in (10, 20, 40)] == [0.85, 0.8, 0.6]
    assert [tuple(rate(found, d)["worst"].values()) for d in (10, 20, 40)] == [(ROAD, "fdi"), (ROAD, "jam"), (OTHER, "fdi")]
    low = stats.beta.ppf(0.05 / 4, 17, 4)
    assert rate(found, 10)["undamaged"]["low"] == pytest.approx(low) and rate(found, 10)["attacks"] == 2


def test_the_limit_of_a_perfect_record_has_a_closed_form() -> None:
    """n of n undamaged: the share at which that has a chance of alpha over the number of attacks."""
    found = entry(board([*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]), "a")
    assert rate(found, 20)["undamaged"] == {"value": 1.0, "low": pytest.approx(0.05 ** (1 / 20))}


def test_the_simultaneous_limit_covers_the_worst_as_often_as_it_says() -> None:
    """Of five attacks with known chances the true worst lies above the limit in at most 5 % of the worlds (99.9 % tolerance)."""
    rng, n, chances, worlds = np.random.default_rng(7), 60, np.array([0.1, 0.3, 0.3, 0.3, 0.28]), 4000
    kept = n - rng.binomial(n, chances, (worlds, 5))
    low = limits(kept, np.full_like(kept, n), 0.05 / 5)[0].min(axis=1)
    missed = int((low > 1.0 - chances.max()).sum())
    assert missed <= stats.binom.ppf(0.999, worlds, 0.05)
    single = limits(kept[:, 1], np.full(worlds, n), 0.05)[0]
    assert 0 < int((single > 0.7).sum()) <= stats.binom.ppf(0.999, worlds, 0.05)


def test_knowledge_adds_attacks_and_computed_optima_count_nowhere() -> None:
    """Black is a part of grey, and grey of white."""
    where = suite(attacks=("none", "fdi", "grey", "white", "best"))
    rows = clean("a")
    for defence in ("none", "a"):
        rows += cell(defence, "fdi", 2) + cell(defence, "grey", 4, knowledge="grey") + cell(defence, "white", 6, knowledge="white")
        rows += cell(defence, "best", 20, knowledge="white", optimal=True)
    made = board(rows, where)
    assert [rate(entry(made, "a"), 20, k)["undamaged"]["value"] for k in ("black", "grey", "white")] == [0.9, 0.8, 0.7]
    assert [rate(entry(made, "a"), 20, k)["attacks"] for k in ("black", "grey", "white")] == [1, 2, 3]
    best = next(a for a in made["attacks"] if a["attack"] == "best")
    assert best["optimal"] and "not counted" in best["note"]
    assert any(c["attack"] == "best" and c["damage"]["value"] == 1.0 for c in made["cells"])


def test_ranks_are_those_that_exact_tests_after_holm_cannot_exclude() -> None:
    """Damage in 0, 2 and 20 of 20 episodes: the first two cannot be told apart, both beat the third."""
    rows = [*clean("a", "b", "c"), *cell("none", "fdi"), *cell("a", "fdi"), *cell("b", "fdi", 2), *cell("c", "fdi", 20)]
    made = board(rows)
    assert {n: tuple(entry(made, n)["rank"].values()) for n in "abc"} == {"a": (1, 2), "b": (1, 2), "c": (3, 3)}
    duels = {(d["a"], d["b"]): d for d in made["comparisons"]}
    assert duels["a", "b"]["p"] == pytest.approx(0.5) and (duels["a", "b"]["only_a"], duels["a", "b"]["only_b"]) == (0, 2)
    assert duels["a", "c"]["p"] == pytest.approx(2 * 0.5**20) and duels["a", "c"]["adjusted"] == pytest.approx(3 * 2 * 0.5**20)
    assert duels["b", "c"]["p"] == pytest.approx(2 * 0.5**18) and duels["b", "c"]["adjusted"] == pytest.approx(2 * 2 * 0.5**18)


def test_mcnemar_counts_only_the_episodes_that_differ() -> None:
    """6 to 0 has p = 2 / 2^6, and no difference has p = 1, however many episodes agree."""
    assert mcnemar(6, 0) == pytest.approx(2 / 64) and mcnemar(0, 0) == 1.0 and mcnemar(3, 3) == 1.0


def test_a_difference_counts_only_against_every_attack_of_the_other() -> None:
    """b falls to jam in 20 episodes and to fdi in none; a falls to fdi in 20: neither is better. The price of the choice is 2 attacks."""
    rows = [*clean("a", "b"), *cell("none", "fdi"), *cell("none", "jam"), *cell("a", "fdi", 20), *cell("a", "jam"), *cell("b", "fdi"), *cell("b", "jam", 20)]
    where = suite(attacks=("none", "fdi", "jam"))
    assert board(rows, where)["comparisons"][0]["p"] == 1.0
    better = [row | {"crashed": 0.0} if (row["defence"], row["attack"]) == ("b", "jam") else row for row in rows]
    made = board(better, where)["comparisons"][0]
    assert made["weaker"] == "a" and made["p"] == pytest.approx(2 * 2 * 0.5**20)


def test_a_strangers_class_is_ranked_only_from_a_sandbox_and_on_seeds_of_a_beacon() -> None:
    """Whoever knows the seeds can take the noise away, and whoever runs free can read it."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]
    assert entry(board(rows), "a")["status"] == "ranked"
    free = board([row | {"submission": {"sandbox": ""}} if row["defence"] == "a" else row for row in rows])
    assert entry(free, "a")["why"].startswith("claimed: not played by") and entry(free, "a")["rank"] is None
    part = board([row | ({"defence": "composed:detector=mine:Mine", "submission": None} if row["defence"] == "a" else {}) for row in rows])
    assert entry(part, "composed:detector=mine:Mine")["why"].startswith("claimed: not played by")  # somebody's part in a built-in shell
    public = board([row | {"beacon": ""} for row in rows])
    assert entry(public, "a")["why"] == "claimed: played on public seeds"


def test_holm_keeps_a_difference_from_counting_that_is_one_of_many() -> None:
    """6 to 0 alone is significant; with two more pairs it is not, as 3 x 2 / 64 exceeds 5 %."""
    two = [*clean("a", "b"), *cell("none", "fdi"), *cell("a", "fdi"), *cell("b", "fdi", 6)]
    assert entry(board(two), "b")["rank"] == {"best": 2, "worst": 2}
    three = [*two, *cell("c"), *cell("c", "fdi", [[19]] * 3)]
    assert entry(board(three), "b")["rank"] == {"best": 1, "worst": 3}


def test_ranks_exist_within_what_defences_use_and_never_for_those_told_the_truth() -> None:
    """A class of one has rank 1; the oracle has none."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi", 20)]
    rows += cell("b", uses=["odometry", "measurements"]) + cell("b", "fdi", uses=["odometry", "measurements"])
    rows += cell("o", uses=["measurements", "truth"]) + cell("o", "fdi", uses=["measurements", "truth"])
    made = board(rows)
    assert entry(made, "a")["rank"] == {"best": 1, "worst": 1} == entry(made, "b")["rank"]
    assert entry(made, "b")["class"] == "measurements + odometry"
    assert entry(made, "o")["rank"] is None and entry(made, "o")["status"] == "unranked" and not made["comparisons"]


@pytest.mark.parametrize(
    ("gate", "at", "beyond"),
    [
        ("gap", {"time_gap_inflation": 0.154}, {"time_gap_inflation": 0.156}),  # 1.05 times 1.1 is 1.155
        ("jerk", {"rms_jerk": 2.39}, {"rms_jerk": 2.41}),
        ("progress", {"distance_travelled": 981.0}, {"distance_travelled": 979.0}),
        ("false alarms", {"alarm_rate": 0.5, "alarm_onsets": 1.0}, {"alarm_rate": 0.51, "alarm_onsets": 1.0}),
    ],
)  # fmt: skip
def test_each_gate_has_its_limit_and_takes_the_rank(gate, at, beyond) -> None:
    """A little inside passes, a little outside takes the rank and is named with its figure."""
    for changes, passed in ((at, True), (beyond, False)):
        found = entry(board([*clean(), *cell("none", "fdi"), *cell("a", **changes), *cell("a", "fdi")]), "a")
        assert [g["passed"] for g in found["gates"] if g["gate"] == gate] == [passed]
        assert found["status"] == ("ranked" if passed else "unranked")
        assert passed or (found["why"].startswith(f"gate {gate}: ") and found["rank"] is None)


def test_a_clean_collision_fails_and_rare_long_alarms_do_not() -> None:
    """One collision in a clean run is one too many. An alarm of most of the time fails only if it goes on oftener than once in 0.1 h."""
    rows = [*clean(), *cell("none", "fdi"), *cell("a", hits=1), *cell("a", "fdi")]
    assert entry(board(rows), "a")["why"].startswith("gate collisions: 1 on")
    long = cell("a", alarm_rate=0.6)
    long[0]["alarm_onsets"] = 3.0  # 20 episodes of 60 s are a third of an hour
    for row in long:
        row["alarm_onsets"] = long[0]["alarm_onsets"] if row["number"] == 0 else 0.0
    assert entry(board([*clean(), *cell("none", "fdi"), *long, *cell("a", "fdi")]), "a")["status"] == "ranked"


def test_a_gate_without_an_undefended_run_cannot_be_passed() -> None:
    """Rows without the defence `none` rank nobody."""
    found = entry(board([*cell("a"), *cell("a", "fdi")]), "a")
    assert found["status"] == "unranked" and "no clean run to judge by" in found["why"]


def test_an_attack_that_some_defence_escapes_takes_its_rank_and_one_that_all_escape_is_named() -> None:
    """Skipped for one, failed for another, missing for a third; skipped for all is left out and noted."""
    where = suite(attacks=("none", "fdi", "jam"))
    gone = {"status": "skipped", "reason": "no gate"}
    rows = [*clean("a", "b", "c", "d"), *(row for d in ("none", "a", "b", "c", "d") for row in cell(d, "fdi"))]
    played = [*cell("none", "jam"), *cell("a", "jam"), *cell("b", "jam", **gone), *cell("c", "jam", status="error", reason="batch: rows depend on one another")]
    made = board([*rows, *played], where)
    assert entry(made, "a")["status"] == "ranked"
    for name, why in (("b", "no gate"), ("c", "depend on one another"), ("d", "not played")):
        found = entry(made, name)
        assert found["status"] == "unranked" and found["why"].startswith("incomplete: 1 attack") and why in found["why"]
        assert found["critical_dose"]["black"] is None and not found["rates"]
    assert entry(made, "c")["flags"] == ["failed: 60 episodes: batch: rows depend on one another"]
    made = board([*rows, *(row for d in ("none", "a", "b", "c", "d") for row in cell(d, "jam", **gone))], where)
    assert entry(made, "b")["status"] == "ranked" and rate(entry(made, "b"), 20)["attacks"] == 1
    assert "no gate" in next(a for a in made["attacks"] if a["attack"] == "jam")["note"]


def test_an_attack_beyond_the_list_counts_where_it_was_played_and_is_asked_of_nobody_else() -> None:
    """An attacker that was trained against one defence is that one's alone."""
    rows = [*clean("a", "b"), *(row for d in ("none", "a", "b") for row in cell(d, "fdi")), *cell("a", "new", 20)]
    made = board(rows)
    assert rate(entry(made, "a"), 20)["undamaged"]["value"] == 0.0 and rate(entry(made, "a"), 20)["attacks"] == 2
    assert entry(made, "b")["status"] == "ranked" and rate(entry(made, "b"), 20)["undamaged"]["value"] == 1.0


def test_a_rank_asks_for_an_attack_that_was_trained_against_that_very_defence() -> None:
    """A policy of the zoo that was trained against chi2_kf speaks for chi2_kf alone, and only for the files that it was trained against."""
    from tailgate.core.registry import Spec
    from tailgate.studies.policies import origin_of

    text = "zoo:name=car-following-chi2_kf-0"
    mine = {"learned": True, "attack_digest": Spec("attack", text).digest, "trained": origin_of(text)}
    where = suite(attacks=("none", text))
    rows = [*clean("kf", "chi2_kf"), *(row for d in ("none", "kf", "chi2_kf") for row in cell(d, text, **mine))]
    made = score(rows, where)
    assert (entry(made, "chi2_kf")["status"], entry(made, "kf")["status"]) == ("ranked", "unattacked")
    assert entry(made, "kf")["rank"] is None and "trained against" in entry(made, "kf")["why"]
    assert made["attacks"][0]["trained_on"] == "chi2_kf"
    other = [row | {"defence_digest": "x"} if row["defence"] == "chi2_kf" else row for row in rows]
    assert entry(score(other, where), "chi2_kf")["status"] == "unattacked"


def test_without_a_road_the_bound_decides_and_has_to_be_there() -> None:
    """An error above the bound is damage, one at the bound is none; clean it fails the gate."""
    where = suite(scenarios=(NETWORK,), bound=2.0)
    road = dict.fromkeys(("distance_travelled", "min_gap", "time_gap_inflation", "rms_jerk"))
    rows = cell("a", scenario=NETWORK, **road, max_error=2.0) + cell("b", scenario=NETWORK, **road, max_error=2.1)
    rows += cell("a", "fdi", scenario=NETWORK, **road, max_error=2.1) + cell("b", "fdi", scenario=NETWORK, **road)
    made = board(rows, where)
    assert entry(made, "a")["status"] == "ranked" and rate(entry(made, "a"), 20)["undamaged"]["value"] == 0.0
    assert entry(made, "b")["why"].startswith("gate bound: 20")
    with pytest.raises(InputError, match="bound"):
        board(rows, suite(scenarios=(NETWORK,)))


def test_robustness_is_the_change_against_the_worst_of_the_plants_that_are_told() -> None:
    """2 of 20 damaged where the plant is the one that is told, 5 of 20 where it is not."""
    where = suite(scenarios=(ROAD, OTHER), robustness=(OTHER,))
    rows = [row for s in (ROAD, OTHER) for row in [*clean("a", scenario=s), *cell("none", "fdi", scenario=s)]]
    rows += cell("a", "fdi", 2) + cell("a", "fdi", 5, scenario=OTHER)
    found = entry(board(rows, where), "a")["robustness"]
    assert [(r["scenario"], r["undamaged"]["value"]) for r in found] == [(OTHER, 0.75)] and found[0]["change"] == pytest.approx(-0.15)


def _worst(rows, defence, where=None):
    """(attack, dose, number) of a defence's worst episode."""
    row = entry(board([*clean(defence), *cell("none", "fdi"), *rows], where), defence)["worst_episode"]
    return row["attack"], row["dose"], row["number"]


def _with_gaps(rows, gap):
    return [row | {"min_gap": gap(row)} for row in rows]


def test_the_worst_episode_is_a_damaged_one_with_the_smallest_gap() -> None:
    """Of the worst attack at the middle dose, whatever came nearer without damage."""
    assert _worst(_with_gaps(cell("a", "fdi", [0, 3, 3]), lambda row: -float(row["number"] % 3)), "a") == ("fdi", 20, 2)
    assert _worst(_with_gaps(cell("a", "fdi", [1, [7], 3]), lambda row: -9.0 if row["dose"] == 10 else float(row["number"])), "a") == ("fdi", 20, 7)


def test_an_entry_that_is_undamaged_at_the_middle_dose_shows_the_smallest_with_damage() -> None:
    """Of doses that are shown; the least knowing attacker first."""
    doses = (5, 10, 20, 40)
    where = suite(attacks=("none", "fdi", "seer"), doses=doses, shown={10: "a", 20: "b", 40: "c"})
    rows = [row for defence in ("a", "none") for row in cell(defence, doses=doses)]
    rows += cell("none", "fdi", doses=doses) + cell("none", "seer", doses=doses, knowledge="grey")
    for hits, seen, found in (([2, 0, 0, 4], [0] * 4, ("fdi", 40)), ([0, 3, 0, 4], [0, 9, 0, 0], ("fdi", 10)), ([0] * 4, [0, 0, 0, 9], ("seer", 40))):
        mine = cell("a", "fdi", hits, doses=doses) + cell("a", "seer", seen, doses=doses, knowledge="grey")
        row = entry(board([*rows, *mine], where), "a")["worst_episode"]
        assert (row["attack"], row["dose"], row["crashed"]) == (*found, 1.0)


def test_where_nothing_is_damaged_the_episode_that_came_nearest_is_shown() -> None:
    """The smallest gap at a shown dose; without a road the largest error."""
    near = {(10, 4): 0.5, (40, 11): 0.25}
    assert _worst(_with_gaps(cell("a", "fdi"), lambda row: near.get((row["dose"], row["number"]), 8.0)), "a") == ("fdi", 40, 11)
    assert _worst(_with_gaps(cell("a", "fdi"), lambda row: near.get((row["dose"], row["number"]), 8.0)), "a", suite(shown={10: "a"})) == ("fdi", 10, 4)
    still = {"scenario": NETWORK, "distance_travelled": None, "min_gap": None}
    rows = [*cell("a", **still), *cell("none", **still), *cell("none", "fdi", **still), *cell("a", "fdi", **still)]
    rows[-9]["max_error"] = 5.0
    row = entry(board(rows, suite(scenarios=(NETWORK,), bound=9.0)), "a")["worst_episode"]
    assert (row["dose"], row["number"], row["max_error"]) == (40, 11, 5.0)


def test_flags_name_unspent_budgets_and_transfers_that_beat_own_training() -> None:
    """The worst attack spends 5 of 20 steps where it fails; a policy trained on b does more damage to a than the one trained on a."""
    where = suite(attacks=("none", "mine", "theirs"))
    mine, theirs = ({"trained": {"defence": name, "digest": "", "plan": "p", "seed": 0}} for name in "ab")
    rows = [*clean("a", "b"), *cell("none", "mine", **mine), *cell("none", "theirs", **theirs), *cell("b", "mine", **mine)]
    rows += [*cell("b", "theirs", **theirs), *cell("a", "mine", 1, **mine), *cell("a", "theirs", 12, attack_steps=5.0, **theirs)]
    found = entry(board(rows, where), "a")["flags"]
    assert any(f.startswith("unspent budget: the worst attack, theirs") and "5.0 of 20" in f for f in found)
    assert [f for f in found if f.startswith("transferred")] == [f"transferred beats own: theirs, trained on b, on {ROAD} (black box)"]
    assert not [f for f in entry(board(rows, where), "b")["flags"] if f.startswith("transferred")]


def test_flags_name_trainings_that_had_not_ended_and_seeds_that_differ() -> None:
    """Two seeds of one plan do 0 and 12 of 20 damage, and one of them was still learning."""
    first, second = ({"trained": {"defence": "a", "digest": "", "plan": "p", "seed": seed, "rising": seed == 1}} for seed in (0, 1))
    rows = [*clean("a"), *cell("none", "x", **first), *cell("none", "y", **second), *cell("a", "x", **first), *cell("a", "y", 12, **second)]
    found = entry(board(rows, suite(attacks=("none", "x", "y"))), "a")["flags"]
    assert "still learning: the curves of 1 of 2 attackers rose when training ended" in found
    assert f"seeds differ: 2 trainings of one plan (black box) do 0 to 60 % damage on {ROAD}" in found
    flat, steep = ([{"reward": level} for level in levels] for levels in ([0.0, 1.0] * 8 + [1.0, 0.9] * 8, [0.1 * k for k in range(32)]))
    assert rising(steep) and not rising(flat) and not rising(steep[:12]) and not rising(None)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"suite": "t"}, "suite"), ({"scenario": OTHER}, "scenario"), ({"dose": 11}, "dose"), ({"config_hash": "x"}, "config_hash"),
        ({"version": "2"}, "version"), ({"defence_digest": "x"}, "defence_digest"), ({"purpose": "select"}, "seeds"), ({"seed": 77}, "seeds"),
        ({"beacon": "another beacon 1"}, "beacon"),
    ],
)  # fmt: skip
def test_rows_that_do_not_belong_together_are_refused_by_name(change, field) -> None:
    """One row of another version, place or file, or with another seed."""
    rows = [*clean("a"), *cell("none", "fdi"), *cell("a", "fdi")]
    rows[-1] = rows[-1] | change
    with pytest.raises(InputError, match="purpose" if field == "seeds" and "purpose" in change else field):
        board(rows)


def test_no_rows_and_a_senseless_alpha_are_refused() -> None:
    """One clear error each."""
    with pytest.raises(InputError, match="at least one row"):
        board([])
    with pytest.raises(InputError, match="alpha"):
        board(clean("a"), alpha=1.0)


def _random_rows(seed, attacks=("fdi", "jam")):
    rng = np.random.default_rng(seed)
    rows = [*clean("a", "b")]
    for defence in ("none", "a", "b"):
        for attack in attacks:
            level = "white" if attack == "white" else "black"
            rows += cell(defence, attack, [int(x) for x in np.sort(rng.integers(0, 21, 3))], knowledge=level)
    return rows


@settings(max_examples=8)
@given(st.integers(0, 10_000))
def test_the_order_of_rows_and_rows_that_come_twice_change_nothing(seed) -> None:
    """To the last character of the JSON, which is of the page's format."""
    rows, where = _random_rows(seed), suite(attacks=("none", "fdi", "jam"))
    first = board(rows, where)
    other = copy.deepcopy(rows) + copy.deepcopy(rows[:50])
    random.Random(seed).shuffle(other)
    assert json.dumps(board(other, where), allow_nan=False) == json.dumps(first, allow_nan=False)
    read_board(first)


@settings(max_examples=12)
@given(st.integers(0, 10_000))
def test_an_attack_more_never_makes_a_figure_better(seed) -> None:
    """Rates, their limits, critical doses and the lower ends of their intervals fall or stay, whatever the new attack does."""
    few, more = suite(attacks=("none", "fdi", "white")), suite(attacks=("none", "fdi", "white", "jam"))
    rows = _random_rows(seed, ("fdi", "jam", "white"))
    before = board([row for row in rows if row["attack"] != "jam"], few)
    after = board(rows, more)
    for name in ("a", "b"):
        old, new = entry(before, name), entry(after, name)
        for level in ("black", "white"):
            for key in ("value", "low"):
                x, y = (e["critical_dose"][level][key] for e in (old, new))
                assert (math.inf if y is None else y) <= (math.inf if x is None else x)
            for dose in (10, 20, 40):
                x, y = rate(old, dose, level)["undamaged"], rate(new, dose, level)["undamaged"]
                assert y["value"] <= x["value"] and y["low"] <= x["low"]


@pytest.mark.long
@pytest.mark.parametrize("attacks", [1, 12])
def test_the_interval_covers_the_critical_dose_of_a_known_curve(attacks) -> None:
    """Chances of 5 % at 20 steps and 25 % at 40 put it at 25, for one attack and for the worst of twelve equal ones, whose largest share is
    biased upwards: of 40 worlds no more miss it than 5 % allow (99.9 % tolerance)."""
    rng, missed, names = np.random.default_rng(11), 0, [f"fdi:value={i}" for i in range(attacks)]
    for _ in range(40):
        rows = [*clean("a", n=100)]
        for name in names:
            u = rng.random(100)
            rows += cell("none", name, n=100)
            rows += cell("a", name, [[], list(np.flatnonzero(u < 0.05)), list(np.flatnonzero(u < 0.25))], n=100)
        made = entry(board(rows, suite(shown={}, attacks=("none", *names))), "a")["critical_dose"]["black"]
        missed += not (made["low"] or math.inf) <= 25.0 <= (made["high"] or math.inf)
    assert missed <= stats.binom.ppf(0.999, 40, 0.05)
