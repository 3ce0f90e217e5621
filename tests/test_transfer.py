"""The matrix of transfer: trained on one defence, played on others."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tailgate import cli
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base.errors import InputError
from tailgate.core.registry import entries
from tailgate.studies.figures import transfer_figure
from tailgate.studies.policies import mean, trained
from tailgate.studies.transfer import _registered, difference, transfer

from . import strong
from .strong import THREAT, ZOO
from .strong import always as _always
from .strong import recorded as _recorded

brief_place, half_place = strong.brief_place, strong.half_place


@pytest.mark.long
def test_many_defences_have_a_line_each(capsys: pytest.CaptureFixture[str], tmp_path: Path, brief_place: str) -> None:
    """A few of them are columns beside their intervals."""
    policy = str(_recorded(_always(tmp_path, "policy-0"), scenario=brief_place))
    many = ["none", "kf", "rkf", "chi2_kf", "imm", "cusum_kf", "mewma_kf", "widen_kf", "brake_kf"]
    for some, head in ((many, "played on"), (many[:2], "trained on")):
        arguments = [word for name in some for word in ("--defence", name)]
        assert cli.main(["transfer", policy, "--scenario", brief_place, "--episodes", "2", *arguments]) == 0
        said = capsys.readouterr().out
        assert head in said and all(name in said for name in some)


def test_a_copy_is_no_training_seed_more(tmp_path: Path, half_place: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Under another name; and a matrix of which nothing was played says so by its exit code."""
    first, copy = (str(_recorded(_always(tmp_path, name), scenario=half_place)) for name in ("first", "copy"))
    report = transfer([first, copy], ["kf"], scenario=half_place, episodes=2)
    assert [entry["seeds"] for entry in report["entries"]] == [1]
    assert cli.main(["transfer", first, "--scenario", half_place, "--episodes", "2", "--defence", "cra"]) == 1
    assert "skipped" in capsys.readouterr().out


def test_a_difference_of_unequal_numbers_of_runs() -> None:
    """Welch by hand: with equal episodes the interval is t times the root of s1^2 / n1 + s2^2 / n2."""
    from scipy import stats

    a, b = np.repeat([[0.6], [0.8], [0.7]], 50, axis=1), np.repeat([[0.1], [0.3]], 50, axis=1)
    found = difference(a, b)
    va, vb = 0.01 / 3, 0.02 / 2
    freedom = (va + vb) ** 2 / (va**2 / 2 + vb**2 / 1)
    assert found.value == pytest.approx(0.5)
    assert found.high - found.value == pytest.approx(stats.t.ppf(0.975, freedom) * math.sqrt(va + vb))
    single = difference(a[:1], b[:1])
    assert single.low == single.high == pytest.approx(0.5)  # one policy each, and no difference among episodes


def test_few_episodes_have_students_interval() -> None:
    """Without an effect a difference of ten episodes seldom seems one: the bootstrap's interval alone leaves 0 out twice as often as it says."""
    rng, none = np.random.default_rng(0), np.zeros((1, 10))
    found = [difference(rng.standard_normal((1, 10)), none).low > 0.0 for _ in range(400)]
    assert 0.005 <= np.mean(found) <= 0.04  # 2.5 %


def test_a_mean_over_seeds_stays_a_share() -> None:
    """All ones: the interval ends at 1 and does not have zero width."""
    found = mean(np.ones((3, 40)), "crashed")
    assert found.value == found.high == 1.0 and 0.5 < found.low < 1.0


def test_transferred_beats_own_is_flagged(tmp_path: Path, half_place: str) -> None:
    """A policy 'trained on kf' that collides against chi2_kf beats one 'trained on chi2_kf' that injects nothing harmful."""
    weak = [str(_always(tmp_path, f"weak{i}", value=0.01, seed=i)) for i in range(2)]
    strong = _copy_as(tmp_path, "kf")
    report = transfer([*weak, str(strong)], ["chi2_kf", "kf", "cra"], scenario=half_place, episodes=40)
    held = {(e["trained_on"], e["played_on"]): e for e in report["entries"]}
    assert held["kf", "chi2_kf"]["flags"] == ["transferred beats own"] and held["kf", "chi2_kf"]["over_own"]["low"] > 0.0
    assert held["chi2_kf", "kf"]["flags"] == [] and "over_own" not in held["kf", "kf"]
    assert held["chi2_kf", "chi2_kf"]["seeds"] == 2 and held["chi2_kf", "chi2_kf"]["value"] == 0.0
    assert report["no_attack"] == {"chi2_kf": 0.0, "kf": 0.0}
    assert [item["defence"] for item in report["skipped"]] == ["cra"]
    assert transfer_figure(report)[:4] == b"\x89PNG"


@pytest.mark.long
def test_all_defences_are_those_that_have_a_meaning_there() -> None:
    """First what was trained on, then what suites play in the scenario; everybody else is named with a reason."""
    report = transfer([ZOO], ["all"], episodes=1)
    columns, skipped = report["played_on"], {item["defence"]: item["reason"] for item in report["skipped"]}
    assert columns[0] == "chi2_kf" and {"none", "kf", "rkf", "safe_state", "oracle"} < set(columns) and len(set(columns)) == len(columns)
    assert [entry["played_on"] for entry in report["entries"]] == columns == list(report["no_attack"])
    assert not set(columns) & set(skipped) and set(entries("defence")) <= set(columns) | set(skipped)
    for name, word in (("always_brake", "sentinel"), ("filterpy_kf", "one episode after the other"), ("dkf", "no suite")):
        assert word in skipped[name] and "named" in skipped[name]


def test_where_no_suite_goes_all_are_the_registered_ones() -> None:
    """Whether the scenario admits them is found when they are played."""
    found, skipped = _registered("thesis-ch3-switched-v0.yaml", ["coast"])
    assert {"kf", "dkf", "cra"} < set(found) and "coast" not in found
    assert {"always_alarm", "filterpy_imm"} < {item["defence"] for item in skipped}
    assert not any("no suite" in item["reason"] for item in skipped)


def _copy_as(directory: Path, defence: str) -> Path:
    """The zoo's first policy with another record."""
    source = PolicyAttack(trained(ZOO).policy.path).path
    data = json.loads(source.read_text())
    data["training"]["config"] |= {"defence": defence, "threat": THREAT}
    (directory / data["tensors"]).write_bytes(source.with_suffix(".safetensors").read_bytes())
    (directory / "strong.json").write_text(json.dumps(data))
    return directory / "strong.json"


def test_policies_of_different_cells_need_one_named(tmp_path: Path, brief_place: str) -> None:
    """Their threat models differ: which one is meant has to be said, and what then does not fit is skipped."""
    texts = [str(_always(tmp_path, "a")), str(_always(tmp_path, "b", kinds=["fdi"]))]
    with pytest.raises(InputError, match="--threat"):
        transfer(texts, episodes=2)
    report = transfer(texts, scenario=brief_place, threat=THREAT, episodes=2)
    assert [item["policy"].split("/")[-1] for item in report["skipped"]] == ["b"] and "3 actions" in report["skipped"][0]["reason"]
    assert [e["seeds"] for e in report["entries"]] == [1]
