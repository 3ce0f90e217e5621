"""Figures of rows and traces."""

import io

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.draws import keys
from tailgate.core.scenario import load_scenario
from tailgate.play.trace import Trace, rollout

pytest.importorskip("matplotlib")
ATTACKS = ["none", "dos_jam:trigger=near,threshold=40"]


@pytest.fixture(scope="module")
def rows():
    return tailgate.evaluate(scenarios="gusty-stop-and-go-v0", doses=[5, 20], defences=["kf", "chi2_kf"], attacks=ATTACKS, seeds=4)


def trace_of(scenario: str, defence: str, attack: str) -> Trace:
    loop = load_scenario(scenario).loop(tailgate.make_defence(defence))
    return rollout(loop, tailgate.make_attack(attack, start_step=10), keys("report", range(2)))


@pytest.mark.long
def test_matrices_and_scatter_show_every_cell(rows):
    some = [row for row in rows if row["dose"] == 20]
    figure = tailgate.plot.matrices(some, "twenty steps")
    assert [ax.get_title() for ax in figure.axes] == ["position RMSE [m], median", "smallest gap [m], median", "episodes with a collision [%]"]
    assert all(len(ax.texts) == 4 for ax in figure.axes)
    assert len(tailgate.plot.error_against_gap(rows).axes[0].collections) >= 4
    out = io.BytesIO()
    figure.savefig(out, format="pdf")
    assert out.getvalue().startswith(b"%PDF")


def test_a_line_of_doses_has_the_shares_of_the_rows(rows):
    """A line for each defence and attack, at both doses, in percent."""
    ax = tailgate.plot.dose_response(rows).axes[0]
    drawn = {label: line[0].get_xydata() for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    assert set(drawn) == {f"{defence}, {attack}" for defence in ("kf", "chi2_kf") for attack in ATTACKS}
    for label, points in drawn.items():
        defence, attack = label.split(", ", 1)
        mine = [row for row in rows if (row["defence"], row["attack"]) == (defence, attack)]
        for dose, share in points:
            assert share == 100.0 * np.mean([row["crashed"] for row in mine if row["dose"] == dose])


def test_an_episode_is_drawn_with_its_attack(rows):
    trace = trace_of("gusty-stop-and-go-v0", "chi2_kf", "dos_hold")
    ax = tailgate.plot.episode(trace, row=1).axes[0]
    lines = {line.get_label(): line.get_xydata() for line in ax.lines}
    assert lines["gap"][0].tolist() == [0.0, trace.first["gap"][1, 0]] and len(lines["gap"]) == trace.length[1]
    assert np.array_equal(lines["gap"][1:, 1], trace.gap[: len(lines["gap"]) - 1, 1, 0])
    error = trace.model.gap_error(trace.estimate[:, 1], trace.truth[:, 1])[: len(lines["gap"]), 0]
    assert np.allclose(lines["believed gap"][:, 1] - lines["gap"][:, 1], error)
    spans = [patch.get_extents().transformed(ax.transData.inverted()).intervalx.tolist() for patch in ax.patches]
    hit = np.flatnonzero(trace.kind[: trace.length[1], 1] != 0)
    assert np.isclose(sum(end - begin for begin, end in spans), trace.dt * len(hit)) and np.isclose(spans[0][0], trace.dt * hit[0])
    calm = tailgate.plot.episode(trace_of("stop-and-go-v0", "kf", "dos_hold"), row=0)
    assert len(calm.axes[0].patches) > 0
    calm = tailgate.plot.episode(rollout(load_scenario("stop-and-go-v0").loop(tailgate.make_defence("kf")), tailgate.make_attack("none"), keys("report", [0])))
    assert calm.axes[0].get_legend_handles_labels()[1] == ["gap", "believed gap"]
    network = trace_of("thesis-ch5-v0", "dkf", "fdi")
    (line, *_), truth = tailgate.plot.episode(network, agent=3).axes[0].lines, network.truth[:, 0]
    assert np.array_equal(line.get_ydata(), network.model.error(network.estimate[:, 0], truth)[:, 3])


@pytest.mark.parametrize(
    ("draw", "words"),
    [
        (lambda rows: tailgate.plot.matrices(rows), "2 scenarios and doses"), (lambda rows: tailgate.plot.matrices([]), "none that were played"),
        (lambda rows: tailgate.plot.dose_response([*rows, *(row | {"version": "9"} for row in rows)]), "twice"), (lambda rows: tailgate.plot.dose_response([]), "rows with doses"), (lambda rows: tailgate.plot.error_against_gap([]), "on a road"),
        (lambda rows: tailgate.plot.episode(trace_of("stop-and-go-v0", "kf", "fdi"), row=2), r"row: got 2; expected a whole number from 0 to 1"),
        (lambda rows: tailgate.plot.episode(trace_of("stop-and-go-v0", "kf", "fdi"), agent=-1), "agent: got -1"),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_one_clear_error(rows, draw, words):
    with pytest.raises(InputError, match=words):
        draw(rows)
