"""The page of a replay in a browser: quiet, moved by slider, keys and pointer, nothing cut, nothing told by colour alone."""


import pytest
import yaml

from tailgate.core import Kind
from tailgate.evaluation.cells import Cell, run_cell
from tailgate.replay.page import write_page
from tailgate.replay.replay import play

from .replays import HOSTILE, SCENARIO, text_of, to


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A page of each sort: many kinds of attack with hostile texts, none at all, a crash of the published thesis case."""
    where = tmp_path_factory.mktemp("pages")
    (where / "tiny.yaml").write_text(yaml.safe_dump(SCENARIO))
    tiny, mixed = str(where / "tiny.yaml"), "fdi_then_jam:start_step=10,inject=4,value=-1.5"
    cells = {
        "attacked": Cell("s", tiny, None, "chi2_kf:eta=9", mixed, 1), "quiet": Cell("s", tiny, None, "always_brake", "none", 1),
        "thesis": Cell("s", "thesis-ch4-v0", None, "chi2_kf", "thesis_times:kind=dos", 1, first_seed=1),
    }  # fmt: skip
    rows = {name: run_cell(cell)[0] | {"suite": HOSTILE} for name, cell in cells.items()}
    assert rows["thesis"]["crashed"] == 1.0
    return {name: write_page(play(row), where / f"{name}.html") for name, row in rows.items()}


@pytest.fixture
def tab(load, pages):
    """Loads a page at a width; logs are empty before."""
    return lambda name="attacked", width=1280: load(pages[name], width)


@pytest.mark.page
@pytest.mark.parametrize("name", ["attacked", "quiet", "thesis"])
def test_the_page_is_quiet(tab, pages, name, asked):
    """No console message, no request but for the file itself, and no script of the row ran."""
    page = tab(name)
    assert page.title.startswith("Replay: ") and page.get_log("browser") == []
    assert asked() == {pages[name].as_uri()}


@pytest.mark.page
def test_the_slider_moves_the_playhead_and_the_words(tab):
    """Time, attack, alarm, budget, values and playhead at a step are those of the trace, and the road changes."""
    page = tab()
    to(page, 0)
    shot = "return document.getElementById('road').toDataURL()"
    assert text_of(page, "time") == "t = 0.0 s" and "before the first step" in text_of(page, "attack")
    start, before = page.execute_script(shot), page.find_element("css selector", ".playhead").get_attribute("x1")
    to(page, 11)
    assert text_of(page, "time") == "t = 1.1 s" and text_of(page, "step") == "step 11 of 40"
    assert "ATTACK: false data injection" in text_of(page, "attack") and "position \N{MINUS SIGN}1.5 m, velocity \N{MINUS SIGN}1.5 m/s" in text_of(page, "attack")
    assert "28 of 30" in text_of(page, "budget")
    assert page.execute_script(shot) != start
    heads = {line.get_attribute("x1") for line in page.find_elements("css selector", ".playhead")}
    assert len(heads) == 1 and float(heads.pop()) > float(before)
    data = page.execute_script("return JSON.parse(document.getElementById('episode').textContent)")
    shown = page.find_element("css selector", "#plot-gap output").text
    assert float(shown) == pytest.approx(data["road"]["gap"][11], abs=0.051)
    alarmed = data["alarm"].index(1) + 1
    to(page, alarmed)
    assert "ALARM" in text_of(page, "alarm") and "jam" in text_of(page, "attack").lower()
    spoken = page.find_element("id", "slider").get_attribute("aria-valuetext")
    assert "alarm" in spoken and "gap" in spoken and "ATTACK" in spoken


@pytest.mark.page
@pytest.mark.parametrize(("name", "step"), [("11", 11), ("metrics", 0), ("9999", 40)])
def test_an_address_opens_at_its_step(tab, pages, name, step):
    """page.html#11 begins at step 11; a name of a part of the page is no step, and the last one is the end."""
    page = tab("quiet")
    page.get("about:blank")
    page.get(f"{pages['quiet'].as_uri()}#{name}")
    assert text_of(page, "step") == f"step {step} of 40"


@pytest.mark.page
@pytest.mark.parametrize("name", ["attacked", "thesis"])
def test_a_page_opens_at_the_first_attacked_step(tab, pages, name):
    """The attack is seen at once, where the address names no step; step 0 can be named."""
    page = tab(name)
    kinds = page.execute_script("return JSON.parse(document.getElementById('episode').textContent).kind")
    first = next(step for step, kind in enumerate(kinds, 1) if kind)
    assert first > 1 and text_of(page, "step").startswith(f"step {first} of ") and "ATTACK" in text_of(page, "attack")
    for part, step in (("metrics", first), ("0", 0)):
        page.get("about:blank")
        page.get(f"{pages[name].as_uri()}#{part}")
        assert text_of(page, "step").startswith(f"step {step} of ")


@pytest.mark.page
def test_the_keyboard_is_enough(tab):
    """Arrows step, Shift makes it ten, Home and End go to the ends on the slider, space plays and halts."""
    page = tab()
    to(page, 0)
    slider = page.find_element("id", "slider")
    page.execute_script("arguments[0].focus()", slider)
    for key, step in (("\ue014", 1), ("\ue014", 2), ("\ue012", 1), ("\ue010", None), ("\ue011", 0)):  # right, right, left, end, home
        slider.send_keys(key)
        last = int(slider.get_attribute("max"))
        assert int(slider.get_attribute("value")) == (last if step is None else step)
    page.execute_script("document.activeElement.blur()")
    body = page.find_element("tag name", "body")
    body.send_keys("\ue008\ue014")  # Shift + right, with nothing focused
    assert slider.get_attribute("value") == "10"
    body.send_keys(" ")
    assert page.find_element("id", "play").get_attribute("aria-label") == "Pause"
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(page, 10).until(lambda _: int(slider.get_attribute("value")) > 11)
    body.send_keys(" ")
    assert page.find_element("id", "play").get_attribute("aria-label") == "Play"
    halted = slider.get_attribute("value")
    page.execute_async_script("setTimeout(arguments[0], 300)")
    assert slider.get_attribute("value") == halted


@pytest.mark.page
def test_a_click_in_a_plot_and_a_jump_move_there(tab):
    """The time under the pointer becomes the present one; a jump names its time."""
    page = tab("thesis")
    from selenium.webdriver import ActionChains

    plot = page.find_element("css selector", "#plot-speed > svg")
    ActionChains(page).move_to_element(plot).click().perform()
    middle = int(page.find_element("id", "slider").get_attribute("value"))
    assert 60 < middle < 90
    buttons = {b.text.split(",")[0]: b for b in page.find_elements("css selector", "#jumps button")}
    assert {"Start", "First attack", "First alarm", "Smallest gap", "Collision", "End"} <= set(buttons)
    page.execute_script("arguments[0].click()", buttons["Collision"])
    assert f"t = {buttons['Collision'].text.split(', ')[1]}" == text_of(page, "time")


@pytest.mark.page
@pytest.mark.parametrize("width", [360, 1280])
@pytest.mark.parametrize("name", ["attacked", "quiet", "thesis"])
def test_nothing_is_cut_or_overlaps(tab, name, width):
    """No sideways scrolling; in each plot the letters lie inside, and no two of them on each other; every plot has its axes."""
    page = tab(name, width)
    wide, room = page.execute_script("return [document.documentElement.scrollWidth, document.documentElement.clientWidth]")
    assert wide <= room <= width
    plots = page.execute_script("""
        return [...document.querySelectorAll('.plot')].map((plot) => {
          const svg = plot.querySelector(':scope > svg'), box = svg.getBoundingClientRect();
          const texts = [...svg.querySelectorAll('text')].map((t) => [t.textContent, t.getBoundingClientRect()]);
          return [plot.id, [box.left, box.top, box.right, box.bottom], texts.map(([w, b]) => [w, b.left, b.top, b.right, b.bottom])];
        })""")
    names = [name for name, _, _ in plots]
    assert names[:6] == ["plot-gap", "plot-speed", "plot-position", "plot-velocity", "plot-score", "plot-control"] and "plot-attack" in names
    for name, (left, top, right, bottom), texts in plots:
        assert sum(words.endswith(" s") for words, *_ in texts) >= 3, name  # the time axis with its unit
        for i, (words, x0, y0, x1, y1) in enumerate(texts):
            assert x0 >= left - 1 and y0 >= top - 3 and x1 <= right + 1 and y1 <= bottom + 3, (name, words)
            for other, u0, v0, u1, v1 in texts[:i]:
                assert min(x1, u1) - max(x0, u0) <= 1 or min(y1, v1) - max(y0, v0) <= 4, (name, words, other)
    units = {"plot-gap": "[m]", "plot-speed": "[m/s]", "plot-velocity": "[m/s]", "plot-control": "[m/s²]"}
    for plot, unit in units.items():
        assert unit in page.find_element("css selector", f"#{plot} h2").text


@pytest.mark.page
def test_decisions_are_told_without_colour(tab):
    """A lane for every wire and kind with its name, a pattern of its own for each kind, every attacked step in a run, every alarm marked."""
    page = tab()
    data = page.execute_script("return JSON.parse(document.getElementById('episode').textContent)")
    lanes = page.execute_script("return [...document.querySelectorAll('#plot-attack .lanename')].map((t) => t.textContent)")
    kinds = {Kind.FDI: "FDI", Kind.DOS_JAM: "JAM"}
    assert {lane.split(",")[0] for lane in lanes} >= {f"{wire['name']}: {kinds[k]}" for wire in data["wires"] for k in wire["kinds"]}
    fills = page.execute_script("return [...document.querySelectorAll('#plot-attack .hit')].map((r) => r.getAttribute('fill'))")
    assert {f"url(#kind-{int(k)})" for k in kinds} <= set(fills)
    shapes = page.execute_script("return [...document.querySelectorAll('[id^=kind-] path')].map((p) => p.getAttribute('d'))")
    assert len(set(shapes)) == len(shapes) == len(Kind) - 1
    onsets = sum(a and not b for a, b in zip(data["alarm"], [0, *data["alarm"]], strict=False))
    assert onsets and len(page.find_elements("css selector", "#plot-score .alarm")) == onsets
    steps = page.execute_script("return [...document.querySelectorAll('#plot-attack .value')].map((p) => p.getAttribute('d').split('H').length - 1)")
    assert sum(steps) == sum(sum(wire["hit"]) for wire in data["wires"])  # a level for each attacked step of each wire
    quiet = tab("quiet")
    assert "No attack took effect" in quiet.find_element("id", "plot-attack").text
    assert "BRAKE" in quiet.find_element("id", "plot-mode").text
