"""The leaderboard page: what it says, that nothing in the rows becomes markup, and how it behaves in a browser."""

import json
import re
from importlib.resources import files

import pytest

from tailgate.base.errors import InputError
from tailgate.board.words import at_least, breakable, names_of, percent, shade, spans, steps, ticks
from tailgate.play.metrics import METRICS
from tailgate.site.rows_page import build

from .boards import Outline, asks_for_nothing, dark_and_light

HOSTILE = "evil:<script>document.title='owned'</script>&\"'"
LONG = "a_very_long_module_name_without_any_space." * 4 + "Defence"
NONE, JAM, STEALTH, POLICY = "none", "dos_jam:trigger=near,threshold=40", "stealth", "/home/x/runs/sac-a/policy.json"


def cell(defence, attack, crashes, *, n=20, failed=0, skipped="", knowledge="black", optimal=False, uses=(), **more):
    """Rows of one cell: the first `crashes` of n crash, then come the failed ones."""
    head = {
        "suite": "tiny-v0", "scenario": "stop-and-go-v0", "dose": 12, "knowledge": knowledge, "defence": defence, "attack": attack,
        "learned": attack.endswith(".json"), "optimal": optimal, "uses": ["measurements", *uses], "purpose": "report", "version": "0.1.0",
        "engine": "plain", "config_hash": "abc123", "defence_digest": "", "attack_digest": "",
    } | more  # fmt: skip
    empty = dict.fromkeys(METRICS)
    rows = []
    for seed in range(n + failed):
        if skipped:
            rows.append(head | empty | {"seed": seed, "status": "skipped", "reason": skipped})
        elif seed >= n:
            rows.append(head | empty | {"seed": seed, "status": "error", "reason": "ValueError: <b>boom</b>"})
        else:
            values = dict.fromkeys(METRICS, 1.0) | {"crashed": float(seed < crashes), "min_gap": 10.0 - crashes, "recovery_time": None}
            rows.append(head | values | {"seed": seed, "status": "ok", "reason": ""})
    return rows


def board():
    return [
        *cell("kf", NONE, 0), *cell("kf", JAM, 12), *cell("kf", STEALTH, 1, knowledge="white"), *cell("kf", POLICY, 17),
        *cell("chi2_kf:eta=15", NONE, 0), *cell("chi2_kf:eta=15", JAM, 5), *cell("chi2_kf:eta=15", STEALTH, 8, knowledge="white"),
        *cell("chi2_kf:eta=15", POLICY, 6),
        *cell("none", NONE, 0), *cell("none", JAM, 3), *cell("none", STEALTH, 0, knowledge="white", skipped="no gate to pass"),
        *cell("none", POLICY, 2),
        *cell("oracle", NONE, 0, uses=("truth",)), *cell("oracle", JAM, 0, uses=("truth",)),
        *cell("always_brake", NONE, 0), *cell("always_brake", JAM, 0),
        *cell(HOSTILE, NONE, 0), *cell(HOSTILE, JAM, 0, n=0, failed=20),
        *cell(LONG, NONE, 0), *cell(LONG, JAM, 20, n=20, failed=2),
        *cell("kf", JAM, 2, scenario="braking-v0", dose=None),
    ]  # fmt: skip


CURVE = [{"steps": 1000 * k, "seed": s, "crash": k / 20} for s in (3, 1) for k in range(15)]
HEADLINE = {
    "text": "Learned beats <i>scripted</i>.",
    "items": [
        {"label": "Learned", "value": 0.7, "low": 0.55, "high": 0.82, "note": "3 seeds"},
        {"label": "Scripted & best", "value": 0.25, "low": 0.1, "high": 0.4, "note": ""},
    ],
}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return build(board(), tmp_path_factory.mktemp("page"), title="A <small> board", curve=CURVE, headline=HEADLINE)


@pytest.fixture(scope="module")
def outline(page):
    return Outline(page.read_text(encoding="utf-8"))


def test_no_rows_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="rows"):
        build([], tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("field", "value"), [("purpose", "tune"), ("config_hash", "def456"), ("version", "0.2.0")])
def test_rows_of_two_kinds_do_not_share_a_cell(tmp_path, field, value):
    """Which of them would be the cell's figure? Nothing is written."""
    with pytest.raises(InputError, match=field):
        build([*cell("kf", JAM, 12), *cell("kf", JAM, 2, **{field: value})], tmp_path / "page")
    assert not (tmp_path / "page").exists()
    build([*cell("kf", JAM, 12), *cell("kf", JAM, 2, knowledge="white", **{field: value})], tmp_path / "page")


def test_the_order_is_that_of_the_page(page):
    text = page.read_text(encoding="utf-8")
    marks = ["<h1>", "lower is better", "Learned beats", "Learning curve", 'class="heat"', 'class="cells"', '<h2 id="defences"', "<footer"]
    places = [text.index(mark) for mark in marks]
    assert places == sorted(places)
    assert "without the adaptive-attack rule" in text and "Clopper" in text and "abc123" in text and "0.1.0" in text


def test_ranks_and_reasons(outline):
    lines = [line for line in outline.rows("heat") if line]
    first = lines[1 : lines.index("Unranked, for comparison")]
    assert first[0].startswith("Rank 1 chi2_kf eta=15 40% stealth") and first[1].startswith("Rank 2 kf 85%") and len(first) == 2
    rest = " | ".join(lines)
    for why in (
        "none unranked; baseline",
        "oracle unranked; reference: is told",
        "always_brake unranked; sentinel",
        "unranked; incomplete: 3",
    ):
        assert why in rest
    assert "over 3 of 4" in next(line for line in lines if line.startswith("none unranked"))


def test_cells_say_their_share_interval_and_reason(outline):
    cells = {(a.get("class"), a.get("title")) for tag, a in outline.tags if tag == "td" and a.get("title")}
    assert ("s6", "95% interval 36% to 81%, 20 episodes") in cells
    assert ("na", "skipped: no gate to pass") in cells and ("na", "not played") in cells
    assert ("na", "failed: ValueError: <b>boom</b>") in cells
    assert ("s10", "95% interval 83% to 100%, 20 episodes; 2 more failed: ValueError: <b>boom</b>") in cells
    table = outline.rows("cells")
    assert any(line.startswith("kf dos_jam trigger=near threshold=40 black no 20 60% 36\N{EN DASH}81% -2.0 1.0 1 1") for line in table)
    assert any("sac-a/policy learned black yes 20 85%" in line for line in table)


def test_an_optimal_attack_is_not_in_the_worst_case(tmp_path):
    rows = [*cell("kf", NONE, 1), *cell("kf", "dos_hold", 20, optimal=True)]
    lines = Outline(build(rows, tmp_path).read_text(encoding="utf-8")).rows("heat")
    assert lines[1].startswith("Rank 1 kf 5% none")


def test_equal_worst_cases_share_a_rank(tmp_path):
    rows = [*cell("kf", JAM, 3), *cell("chi2_kf", JAM, 3), *cell("chi2_kf:eta=9", JAM, 4)]
    lines = Outline(build(rows, tmp_path).read_text(encoding="utf-8")).rows("heat")
    assert [line.split()[1] for line in lines[1:]] == ["1", "1", "3"]


def test_texts_of_the_rows_stay_texts(page, outline):
    assert [tag for tag, _ in outline.tags].count("script") == 1
    assert not any(tag in ("b", "i", "small") and attrs for tag, attrs in outline.tags)
    text = page.read_text(encoding="utf-8")
    assert "<script>document" not in text and "&lt;script&gt;document" in text
    assert "<b>boom" not in text and "<i>scripted" not in text and "A &lt;small&gt; board" in text
    assert "/home/x" not in text


def test_nothing_is_fetched(outline, page):
    asks_for_nothing(outline)
    text = page.read_text(encoding="utf-8")
    assert "@import" not in text and "url(" not in text and not re.findall(r"https?://", text)


def test_the_same_rows_give_the_same_bytes(page, tmp_path):
    again = build(board(), tmp_path / "new", title="A <small> board", curve=CURVE, headline=HEADLINE)
    assert again == tmp_path / "new" / "index.html"
    for name in ("index.html", "summary.json"):
        assert (again.parent / name).read_bytes() == (page.parent / name).read_bytes()
    assert sorted(path.name for path in again.parent.iterdir()) == ["index.html", "summary.json"]


def test_the_summary_holds_the_figures(page):
    data = json.loads((page.parent / "summary.json").read_text())
    jam = next(c for c in data["cells"] if (c["defence"], c["attack"], c["dose"]) == ("kf", JAM, 12))
    assert jam["n"] == 20 and jam["crash"]["value"] == 0.6
    assert data["rows"] == len(board()) and data["seeds"] == "0\N{EN DASH}21" and data["headline"] == HEADLINE and data["curve"] == CURVE


def test_the_page_does_without_curve_and_headline(tmp_path):
    text = build(cell("kf", NONE, 0), tmp_path).read_text(encoding="utf-8")
    assert "Learning curve" not in text and "learned adversary did" not in text and "<title>Tailgate leaderboard</title>" in text


@pytest.mark.parametrize(
    "more",
    [
        {"curve": [{"steps": 1, "seed": 0}]},
        {"curve": [{"steps": 1, "seed": 0, "crash": 1.5}]},
        {"curve": [{"steps": 1, "seed": 0, "crash": float("nan")}]},
        {"headline": {"text": "", "items": [{"label": "x", "value": 0.5, "low": 0.6, "high": 0.7}]}},
        {"headline": {"text": "", "items": ["x"]}},
    ],
)
def test_what_cannot_be_drawn_is_an_input_error(tmp_path, more):
    with pytest.raises(InputError):
        build(cell("kf", NONE, 0), tmp_path, **more)


def test_names():
    names = names_of(
        ["runs/a/policy.json", "runs/b/x/p.json", "runs/c/x/p.json:stochastic=true", "policy:path=z/q.json", "m:Cls:k=[1,2],l=3"]
    )
    assert [n.label for n in names.values()] == ["a/policy", "b/x/p", "c/x/p", "z/q", "m:Cls"]
    assert names["m:Cls:k=[1,2],l=3"].params == ("k=[1,2]", "l=3") and names["policy:path=z/q.json"].policy
    assert names_of(['Gate({"eta":3.0})'])['Gate({"eta":3.0})'].full == "Gate eta:3.0"


def test_numbers_in_words():
    assert [percent(x) for x in (0, 0.0001, 0.004, 0.5, 0.997, 0.9999, 1, -0.2)] == [
        "0%", "<0.1%", "0.4%", "50%", "99.7%", ">99.9%", "100%", "\N{MINUS SIGN}20%",
    ]  # fmt: skip
    assert [at_least(x) for x in (0, 0.0001, 0.0079, 0.0299, 0.876, 0.995, 0.9999, 1)] == ["0%", "0%", "0.7%", "2%", "87%", "99%", "99%", "100%"]
    assert [at_least(x, 1) for x in (0, 0.0079, 0.29, 0.99999, 1)] == ["0.0%", "0.7%", "29.0%", "99.9%", "100.0%"]
    assert [shade(x) for x in (0, 0.001, 0.1, 0.3, 0.31, 1)] == ["s0", "s1", "s1", "s3", "s4", "s10"]
    assert spans([3, 1, 2, 7]) == "1\N{EN DASH}3, 7"
    assert [steps(x) for x in (0, 999, 1500, 999_999, 2e6)] == ["0", "999", "1.5k", "1000k", "2M"]
    assert [t["text"] for t in ticks(295_000)] == ["0", "100k", "200k"] and ticks(1)[-1]["x"] == 100
    assert breakable("a_<b>=1") == "a_<wbr>&lt;b&gt;=<wbr>1"


def luminance(colour):
    digits = colour[1:] if len(colour) == 7 else "".join(c * 2 for c in colour[1:])
    parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    return sum(
        w * (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4) for w, c in zip((0.2126, 0.7152, 0.0722), parts, strict=True)
    )


@pytest.mark.parametrize("mode", [0, 1])
def test_text_stands_out_on_every_shade_and_shades_are_in_order(mode):
    css = files("tailgate.site").joinpath("page.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"--(\w+): (#\w+)", css.split(":root {")[1 + mode]))
    shades = [luminance(colours[f"s{i}"]) for i in range(11)]
    assert shades == sorted(shades, reverse=mode == 0)
    pairs = [(f"s{i}", f"s{i}t") for i in range(11)] + [(ground, ink) for ground in ("page", "panel") for ink in ("text", "quiet", "link")]
    for ground, ink in pairs:
        dark, light = sorted((luminance(colours[ground]), luminance(colours[ink])))
        assert (light + 0.05) / (dark + 0.05) >= 4.5, (ground, ink)
    for line in (f"c{i}" for i in range(8)):
        dark, light = sorted((luminance(colours["page"]), luminance(colours[line])))
        assert (light + 0.05) / (dark + 0.05) >= 3, line


@pytest.fixture
def tab(load, page):
    """A fresh load of the page at desktop size, in light colours."""
    return load(page)


def column(tab, number):
    """Texts of a column of the first board's table of every cell, of the rows that are shown."""
    shown = "document.querySelectorAll('#board-1 .cells tbody tr:not([hidden])')"
    return tab.execute_script(f"return [...{shown}].map(r => r.cells[{number}]?.textContent.trim())")


@pytest.mark.page
def test_a_heading_sorts_its_table(tab):
    head = tab.find_elements("css selector", "#board-1 .cells thead th")[5]
    before = column(tab, 0)
    assert head.get_attribute("aria-sort") == "none"
    tab.execute_script("arguments[0].focus()", head.find_element("tag name", "button"))
    for direction in ("ascending", "descending"):
        tab.switch_to.active_element.send_keys("\ue007")  # Enter: the keyboard is enough
        assert head.get_attribute("aria-sort") == direction
        shares = [float(re.match(r"\d+", text)[0]) for text in column(tab, 5) if not text.startswith("n/a")]
        assert shares == sorted(shares, reverse=direction == "descending") and len(set(shares)) > 3
        assert column(tab, 5)[-1].startswith("n/a")  # whatever the direction
    assert column(tab, 0) != before and sorted(column(tab, 0)) == sorted(before)
    tab.find_element("css selector", "#board-1 .cells thead button").click()
    assert head.get_attribute("aria-sort") == "none"
    assert column(tab, 0)[0].startswith("a_very_long") and column(tab, 0)[-1] == "oracle"


@pytest.mark.page
def test_filters_hide_rows(tab):
    everything = len(column(tab, 0))
    find = tab.find_element("css selector", "#board-1 .find")
    find.send_keys("KF jam")
    assert sorted(column(tab, 0)) == ["chi2_kf eta=15", "kf"]
    assert tab.find_element("css selector", "#board-1 output").text == f"2 of {everything} cells"
    assert tab.execute_script("return document.querySelectorAll('#board-2 .cells tbody tr:not([hidden])').length") == 1
    find.send_keys("\ue003" * 6)  # backspace
    assert len(column(tab, 0)) == everything
    tab.find_element("css selector", "#board-1 [data-key=learned] option[value=yes]").click()
    assert set(column(tab, 3)) == {"yes"}
    tab.find_element("css selector", "#board-1 [data-key=defence] option[value='1']").click()
    assert column(tab, 0) == ["chi2_kf eta=15"]


@pytest.mark.page
def test_the_page_is_quiet(tab, page, asked):
    """No script of the rows runs, no console message, and no request but for the file itself."""
    assert tab.title == "A <small> board"
    assert tab.get_log("browser") == []
    assert asked() == {page.as_uri()}


@pytest.mark.page
@pytest.mark.parametrize("width", [375, 800, 1280])
def test_only_tables_scroll_sideways(tab, width, show):
    show(width, "light")
    wide = "return [document.documentElement.scrollWidth, document.body.scrollWidth, document.documentElement.clientWidth]"
    page, body, room = tab.execute_script(wide)
    assert page <= room <= width and body <= room
    boxes = tab.execute_script("return [...document.querySelectorAll('.heat')].map(t => t.offsetWidth > t.parentElement.clientWidth)")
    assert width > 375 or boxes[0]  # so that this does test something


@pytest.mark.page
def test_dark_and_light(tab, show):
    dark_and_light(tab, show)


def test_where_nobody_drives_the_figure_is_the_error(tmp_path):
    """Ranks and shades follow it, and nothing is said of collisions or metres."""
    rows = cell("dkf", JAM, 0) + cell("kf", JAM, 0)
    for row in rows:
        row |= {"distance_travelled": None, "max_error": 8.0 if row["defence"] == "kf" else 2.0}
    text = build(rows, tmp_path).read_text(encoding="utf-8")
    assert re.findall(r"Rank </span>(\d)</span> \D*?\b(d?kf)<", text) == [("1", "dkf"), ("2", "kf")]
    assert "collision" not in text.split("<main>")[0] and ">8<" in text and 'class="s10"' in text and "Max. error [m]" not in text
