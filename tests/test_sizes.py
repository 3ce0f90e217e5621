"""Sizes: what is too large is refused in one line before anything is made, and what is long is announced."""

import time
from pathlib import Path
from typing import Any

import pytest

from tailgate import cli, evaluate
from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.pool import Crew
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.training import train

SOME = ["--scenario", "thesis-ch4-v0", "--defence", "kf", "--attack", "none"]
HUGE = "1000000000000"
TOO_LARGE = [
    (["evaluate", *SOME, "--seeds", HUGE, "--out", "x"], "seeds"), (["evaluate", *SOME, "--workers", "100000", "--out", "x"], "workers"),
    (["evaluate", *SOME, "--batch", HUGE, "--out", "x"], "batch"), (["trust", *SOME, "--runs", HUGE, "--out", "x"], "runs"),
    (["trust", *SOME, "--workers", "100000", "--out", "x"], "workers"), (["trust", *SOME, "--batch", HUGE, "--out", "x"], "batch"),
    (["train", "ppo.envs=1000000000"], "config.ppo.envs"), (["train", f"steps={HUGE}"], "config.steps"),
    (["train", "workers=100000"], "config.workers"), (["train", "seeds=1000000000"], "config.seeds"),
    (["train", "learner=cem", "cem.population=1000000000"], "config.cem.population"), (["train", f"episodes={HUGE}"], "config.episodes"),
    (["train", "learner=cem", "cem.hidden=[1000000000]"], "config.cem.hidden.0"), (["train", f"demonstrations={HUGE}"], "config.demonstrations"),
    (["train", "learner=sac", f"sac.buffer_size={HUGE}"], "config.sac.buffer_size"), (["train", f"select_episodes={HUGE}"], "config.select_episodes"),
    (["tune", "--trials", HUGE], "trials"), (["tune", "--trials", "1", "--episodes", HUGE], "episodes"),
    (["tune", "--trials", "2", "--workers", "100000"], "workers"), (["selfplay", "rounds=1000000000"], "config.rounds"),
    (["selfplay", f"episodes={HUGE}"], "config.episodes"), (["selfplay", f"steps={HUGE}"], "config.steps"),
    (["reproduce", "ch7", "--seeds", HUGE], "seeds"), (["log", "--out", "x", "--episodes", HUGE], "episodes"),
    (["calibrate", "--defence", "chi2_kf", "--hours", "1", "--onsets", HUGE], "onsets"),
    (["calibrate", "--defence", "chi2_kf", "--hours", "1", "--batch", HUGE], "batch"),
    (["calibrate", "--defence", "chi2_kf", "--hours", "1", "--steps", "1" + HUGE], "steps"),
    (["timing", "zoo:name=none", "--episodes", HUGE], "episodes"), (["transfer", "zoo:name=none", "--episodes", HUGE], "episodes"),
    (["dose-response", "fdi", "--defence", "kf", "--scenario", "braking-v0", "--doses", "5", "--episodes", HUGE], "episodes"),
    (["leaderboard", "run", "quick-v0", "--out", "x", "--workers", "100000"], "workers"),
    (["leaderboard", "attack", "kf", "--suite", "quick-v0", "--out", "x", "--workers", "100000"], "workers"),
    (["leaderboard", "attack", "kf", "--suite", "quick-v0", "--out", "x", "--seeds", HUGE], "seeds"),
    (["leaderboard", "clock", "quick-v0", "--out", "x", "--rounds", HUGE], "rounds"), (["bench", "--rounds", HUGE], "rounds"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "field"), TOO_LARGE, ids=[f"{words[0]}-{field}" for words, field in TOO_LARGE])
def test_a_size_above_its_limit_is_refused_before_anything_is_made(
    words: list[str], field: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    started = time.process_time()
    assert cli.main(words) == 2
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and said.startswith(f"tailgate: error: {field}: got 1"), said
    assert not list(tmp_path.iterdir()) and time.process_time() - started < 20.0


@pytest.mark.parametrize(("given", "field"), [({"num_envs": 10**9}, "num_envs"), ({"threads": 10**6}, "threads"), ({"num_envs": True}, "num_envs")])
def test_so_it_is_in_python(given: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=rf"^{field}: got "):
        AdversaryVectorEnv(**given)
    with pytest.raises(InputError, match="workers: got 5000; expected a whole number from 1 to 1,024"):
        Crew(5000)
    with pytest.raises(InputError, match="seeds: got 100000000; expected"):
        evaluate("quick-v0", seeds=10**8)


def test_what_takes_more_memory_than_is_free_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Rows, environments, processes and a learner's decisions, each with what they take and what there is; the earlier run stays."""
    monkeypatch.setattr(sizes, "free", lambda: 2e9)
    ends = r"GB, and 2\.0 GB of memory are free$"
    with pytest.raises(InputError, match=r"^num_envs: got 5000000; expected less: 5,000,000 environments take about .* " + ends):
        AdversaryVectorEnv(5_000_000)
    with pytest.raises(InputError, match=r"^workers: got 100; .*100 processes take about 15.0 " + ends):
        evaluate("quick-v0", seeds=1, workers=100)
    with pytest.raises(InputError, match=r"^seeds: got 5000000; .*5,000,000 rows take about 45.0 " + ends):
        evaluate(defences=["kf"], attacks=["none"], scenarios=["thesis-ch4-v0"], doses=[5], seeds=5_000_000)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "policy-0.json").write_text("a result")
    config = train.load_config("gusty", ["name=a", f"out={tmp_path}", "ppo.envs=5000000", "ppo.batch_size=5000000", "ppo.rollout=1"])
    with pytest.raises(InputError, match=r"^config\.ppo: size: got 5000000; .* in each of 1 trainings take about .* " + ends):
        train.train(config, lambda *_: None)
    assert [path.name for path in tmp_path.rglob("*")] == ["a", "policy-0.json"]


def test_a_horizon_that_no_memory_holds_is_refused(tmp_path: Path) -> None:
    base = next(path for path in Path("configs/scenarios").glob("thesis-ch4-v0.yaml")).read_text()
    assert "horizon: " in base
    for horizon, said in (("10000000000", r"scenario long\.horizon: got 10000000000; expected"), ("999999", r"scenario .*: horizon: got 999999; expected less: the signals of one episode take about")):
        (tmp_path / "long.yaml").write_text("\n".join(f"horizon: {horizon}" if line.startswith("horizon:") else line for line in base.splitlines()))
        with pytest.MonkeyPatch.context() as patch, pytest.raises(InputError, match=said):
            patch.setattr(sizes, "free", lambda: 2e8)
            evaluate(defences=["kf"], attacks=["none"], scenarios=[str(tmp_path / "long.yaml")], doses=[None], seeds=1)


def test_what_is_long_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(sizes, "tell", told.append)
    train.long(train.load_config(None, ["steps=100_000_000_000", "seeds=3", "workers=2"]))
    train.long(train.load_config(None, []))
    sizes.announce(7200.0, 5e9, "9 episodes")
    assert told == [
        "3 trainings of 100,000,000,000 decisions take at least 1.2 days, on a fast machine",
        "9 episodes take at least 2.0 hours and 5.0 GB of memory, on a fast machine",
    ]


def test_the_free_memory_is_known_here() -> None:
    assert 1e7 < sizes.free() < 1e14
