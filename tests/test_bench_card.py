"""The record of a card: bits first, figures that hang together, and a command that fails where bits differ."""

import json
from typing import Any

import numpy as np
import pytest

from tailgate.bench import cards
from tailgate.cli import main
from tailgate.evaluation import golden

from .card import HostCard, host_card, needs_compiler

__all__ = ["host_card"]
pytestmark = needs_compiler


@pytest.fixture
def little(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cards, "PLANTS", {"car following": cards.Plant("gusty-stop-and-go-v0", "chi2_kf", 96)})
    monkeypatch.setattr(cards, "CHECKED", (40, 16))
    monkeypatch.setattr(cards, "MANY", 7)
    monkeypatch.setattr(cards, "COPIED", 1 << 16)


@pytest.mark.usefixtures("little")
def test_the_record(host_card: HostCard, tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "--device", "cuda", "--rounds", "2", "--seconds", "0.05", "--out", str(tmp_path), "--json"]
    assert main(words) == 0
    record = json.loads(capsys.readouterr().out)
    assert record == json.loads((tmp_path / "cuda.json").read_text()) and record["format"] == "tailgate-bench-cuda-1"
    assert record["card"]["name"] == "this processor" and record["equal"]
    assert [check["values"] > 0 for check in record["checks"]] == [True, True]
    one, many = record["lines"]
    assert (one["steps_a_launch"], many["steps_a_launch"]) == (1, 6) and one["rows"] == many["rows"] == 96
    assert one["bytes_of_a_step"] > many["bytes_of_a_step"] > 0 and min(one["rounds"] + many["rounds"]) > 0
    assert main(["bench", "--device", "cuda", "--only", "ships"]) == 2
    assert main(["bench", "--device", "cuda", "--list"]) == 0 and "gusty-stop-and-go-v0" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.usefixtures("little")
def test_bits_that_differ(host_card: HostCard, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    fetch = HostCard.fetch_rows

    def wrong(held: np.ndarray, at: int, pitch: int) -> None:
        fetch(host_card, held, at, pitch)
        if len(held) == 2:  # the compared rows
            held[0, 0] ^= 1

    cards.programs(cards.PLANTS["car following"], 1, "cuda")  # found equal to the plain loop before
    monkeypatch.setattr(host_card, "fetch_rows", wrong)
    monkeypatch.setattr(cards.Flight, "rate", lambda self, seconds: 1.0)
    assert main(["bench", "--device", "cuda", "--rounds", "1", "--seconds", "0.01"]) == 1
    assert "this processor" in capsys.readouterr().out


@pytest.mark.usefixtures("little")
def test_episodes_begin_again(host_card: HostCard) -> None:
    """A flight plays whole episodes, one after the other."""
    flight = cards.Flight(cards.PLANTS["car following"], 7)
    before = flight._state.state.get_leaf("loop.keys.episode").copy()
    for _ in range(100):
        flight.decide()
    after = flight._state.state.get_leaf("loop.keys.episode")
    assert (after > before).all() and flight._state.state.get_leaf("loop.k").max() <= flight.programs.loop.horizon


@pytest.mark.long
def test_golden_traces_on_the_card(host_card: HostCard) -> None:
    """One scenario of the published suites; the others take minutes."""
    assert golden.main(["--check", "--scenario", "stop-and-go-v0", "--device", "cuda"]) == 0 and host_card.launches > 0


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(golden.read()["scenarios"]))
def test_golden_traces_of_all_suites(name: str, host_card: HostCard) -> None:
    held = golden.read()
    from tailgate.engine.cards import playing_on

    wanted = golden.check(name, held)
    with playing_on("cuda"):
        assert golden.check(name, held) == wanted
