"""What a site refuses, and what its pages are put together of: names of files, axes, numbers in words, the head of a board."""

import copy
import json
import re

import pytest

from tailgate.base.errors import InputError
from tailgate.board import head
from tailgate.board.files import read_board
from tailgate.board.order import ordered
from tailgate.site.build import build_site, slug
from tailgate.site.charts import Axis, Dot, Line, chart, nice, spread, ticks_at
from tailgate.site.suite import figure

from .boards import HOSTILE, LONG, make_board, network


@pytest.mark.thin(4)
@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda b: b.update(format="tailgate-board-0"), "board.format"),
        (lambda b: b.pop("suite"), "board.suite"),
        (lambda b: b["suite"].update(doses=[]), "board.suite.doses"),
        (lambda b: b["suite"].update(shown={"7": "why"}), "board.suite.shown"),
        (lambda b: b["entries"][1].update(status="first"), "board.entries[1].status"),
        (lambda b: b["entries"][1].update(defence="kf"), "board.entries[1].defence"),
        (lambda b: b["entries"][0].update(flags="none"), "board.entries[0].flags"),
        (lambda b: b["entries"][0]["critical_dose"]["black"].update(value="20"), "board.entries[0].critical_dose.black.value"),
        (lambda b: b["cells"][3]["damage"].update(low=float("nan")), "board.cells[3].damage.low"),
        (lambda b: b["cells"][3].update(scenario="nowhere"), "board.cells[3].scenario"),
        (lambda b: b["cells"][3].update(defence="nobody"), "board.cells[3].defence"),
        (lambda b: b["cells"][3].update(dose=True), "board.cells[3].dose"),
        (lambda b: b["curves"][0]["points"][0].update(value=1.5), "board.curves[0].points[0].value"),
        (lambda b: b["curves"][0].update(fitted=[0.1]), "board.curves[0].fitted"),
        (lambda b: b["comparisons"][0].update(b="nobody"), "board.comparisons[0].b"),
        (lambda b: b["comparisons"][0].update(weaker="cra"), "board.comparisons[0].weaker"),
        (lambda b: b["suite"].update(beacon=7), "board.suite.beacon"),
        (lambda b: b["attacks"][0].update(trained_on=["kf"]), "board.attacks[0].trained_on"),
        (lambda b: b["attacks"][0].update(card="mine"), "board.attacks[0].card"),
        (lambda b: b.update(trust=None), "board.entries[0].trust"),
        (lambda b: b["trust"].update(alpha="5 %"), "board.trust.alpha"),
        (lambda b: b["entries"][0]["trust"].pop("safety"), "board.entries[0].trust.safety"),
        (lambda b: b["entries"][0]["trust"]["all"]["grey"].update(lower=1.5), "board.entries[0].trust.all.grey.lower"),
        (lambda b: b["entries"][0]["trust"]["all"]["grey"].update(k=201), "board.entries[0].trust.all.grey.k"),
        (lambda b: b["entries"][0]["trust"]["all"]["grey"].update(attacks=["x"]), "board.entries[0].trust.all.grey.attacks"),
    ],
)  # fmt: skip
def test_what_is_not_of_the_format_names_its_field(change, field, tmp_path):
    """The first field that is wrong is named, and nothing is written."""
    board = copy.deepcopy(make_board())
    change(board)
    with pytest.raises(InputError) as error:
        build_site([board], tmp_path)
    assert error.value.field == field and not list(tmp_path.iterdir())


def test_no_board_and_two_of_a_suite_are_input_errors(tmp_path):
    """A site needs a board, and a suite one place."""
    for given in ([], [network(), network()], [3]):
        with pytest.raises(InputError):
            build_site(given, tmp_path)
    assert read_board(make_board() | {"more": 1}).suite.limit == 0.1  # what a page does not show is let through


def test_file_names_are_safe_and_distinct():
    """A plain name stays; any other gets a hash, so that no two meet and none leaves its folder."""
    texts = ["kf", "KF", "kf:eta=1", "kf:eta=1.", "../../kf", HOSTILE, LONG, LONG + "x", "", "."]
    names = [slug(text) for text in texts]
    assert names[0] == "kf" and len({name.lower() for name in names}) == len(texts)
    assert all(re.fullmatch(r"[a-z0-9_-]{1,70}", name) for name in names)


def test_places_on_an_axis():
    """Logarithmic axes have equal ratios of 1 + x, or of x, at equal distances; labels keep their gap and their order."""
    log = Axis(0.0, 63.0, "log")
    assert [log.at(x) for x in (0, 1, 7, 63)] == [0, 16.67, 50, 100] and Axis(0.1, 10, "decades").at(1) == 50 and Axis(5, 5).at(5) == 50
    assert [t["text"] for t in ticks_at(Axis(0, 100), [0, 1, 50, 99, 100])] == ["0", "", "50", "", "100"]
    assert spread([50, 50, 51], 10) == [50, 60, 70] and spread([99, 98, 0], 5) == [100, 95, 0] and spread([10, 10], 5, [2, 1]) == [15, 10]
    assert [nice(x) for x in (0.0, 0.9, 11, 16, 51, 100)] == [1.0, 1.0, 15.0, 20.0, 100.0, 100.0]
    drawn = chart([Line("a", 9, [Dot(0, 0.5, 0.4, 0.6), Dot(7, 1.0)], [0.25, 0.75]), Line("empty", 0, [])], log, [], limit=0.1)
    assert len(drawn["lines"]) == 1 and drawn["limit"] == 90
    line = drawn["lines"][0]
    assert line["path"] == "0.0,750.0 500.0,250.0" and line["style"] == 1 and line["whiskers"] == [{"x": 0, "low": 60, "high": 40}]
    assert [d["y"] for d in line["dots"]] == [50, 0]


def test_numbers_in_words():
    """Small numbers are written out, and none at all is a dash."""
    assert [figure(x) for x in (None, 0.00008333, -0.5, 1234567.0, 0.0)] == ["\N{EN DASH}", "0.000083", "\N{MINUS SIGN}0.5", "1.235e+06", "0"]


def test_the_head_in_words_is_the_board_in_figures():
    """A line for each defence, in the order of the page, cut where it is asked; a bar in a name does not end a cell."""
    board = make_board()
    names = [line[0] for line in head.lines(board)[1:]]
    assert names == [entry.defence for entry in ordered(read_board(board).entries)]
    places = [names.index(name) for name in ("kf", "chi2_kf:eta=15", "cusum_kf", "reacquire_kf", "brake_kf", "imm", "none", "oracle")]
    assert places == sorted(places)  # ranked by class and rank, not attacked, for comparison
    with pytest.raises(InputError, match=r"board\.entries\[0\]\.status"):
        head.lines(board | {"entries": [board["entries"][0] | {"status": "first"}]})
    board = json.loads(json.dumps(board).replace('"kf"', '"a|b"'))
    heading, *body = head.lines(board)
    assert len(body) == len(board["entries"]) and all(len(line) == len(heading) for line in body)
    ranked = [line[2] != "-" for line in body]
    assert ranked == sorted(ranked, reverse=True) and any(ranked)
    by_name = {entry["defence"]: entry for entry in board["entries"]}
    for line in body:
        rates = {str(r["dose"]): r["undamaged"]["value"] for r in by_name[line[0]]["rates"] if r["knowledge"] == "black"}
        shown = [float(cell.split(" %")[0]) for cell in line[4 : 4 + len(board["suite"]["shown"])] if cell != "-"]
        assert shown == [round(100 * rates[dose]) for dose in board["suite"]["shown"] if dose in rates]
    text = head.markdown(board, 2).splitlines()
    assert len(text) == 4 and "a\\|b" in head.markdown(board) and set(text[1]) <= set("|- ")
