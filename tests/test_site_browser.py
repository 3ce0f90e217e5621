"""The site of boards in a browser: sorting, filters, menus, links, widths, colours, and that it asks for nothing."""

import itertools

import pytest

from tailgate.board.words import percent
from tailgate.site.build import build_site

from . import boards
from .boards import HOSTILE, LONG, dark_and_light, entry, make_board


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    return boards.make_site(tmp_path_factory.mktemp("site"), boards.crashed_row())


@pytest.fixture
def tab(load, site):
    """A fresh load of the first page at desktop size, in light colours."""
    return load(site)


def groups(tab, column, key="sort"):
    """Sort keys (or texts) of a column of the first suite's table, one list per group, of the rows that are shown."""
    script = """return [...document.querySelectorAll('#suite-1 .ranks tbody:not([hidden])')].map(b => [...b.querySelectorAll('tr[data-row]:not([hidden])')]
      .map(r => r.cells[arguments[0]].dataset[arguments[1]] ?? r.cells[arguments[0]].textContent.trim()))"""
    return tab.execute_script(script, column, key)


def texts(tab, selector):
    return tab.execute_script(f"return [...document.querySelectorAll('{selector}')].map(x => x.textContent.trim())")


@pytest.mark.page
def test_every_heading_sorts_both_ways_within_groups(tab):
    """Enter on a heading sorts each group up, again down; figures by value, dashes last, beyond the largest dose above all."""
    buttons = tab.find_elements("css selector", "#suite-1 .ranks thead button")
    assert len(buttons) == 11
    names = [sorted(group) for group in groups(tab, 0)]
    for column, button in enumerate(buttons):
        key = "black" if column in (2, 3, 4) else "sort"
        for direction in ("ascending", "descending"):
            tab.execute_script("arguments[0].focus()", button)
            tab.switch_to.active_element.send_keys("\ue007")  # Enter: the keyboard is enough
            heads = tab.execute_script("return [...document.querySelectorAll('#suite-1 .ranks thead th')].map(h => h.getAttribute('aria-sort'))")
            assert heads[column] == direction and heads.count("none") == 10
            for group in groups(tab, column, key):
                there = [x for x in group if x]
                assert group == there + [""] * (len(group) - len(there))
                if column > 1:
                    numbers = [float(x) for x in there]
                    assert numbers == sorted(numbers, reverse=direction == "descending")
    assert [sorted(group) for group in groups(tab, 0)] == names
    buttons[6].click()
    assert groups(tab, 6)[0][-1] == "Infinity" and groups(tab, 0)[0][-1] == "brake_kf"
    heads = texts(tab, "#suite-1 .ranks thead th")
    assert heads[8] == "Trust: lower bound against these 5 attacks" and groups(tab, 8)[1][-1] == ""  # one of them was not checked
    assert not any(head.startswith("Trust") for head in texts(tab, "#suite-2 .ranks thead th"))


@pytest.mark.page
def test_filters_hide_rows_of_table_and_map(tab):
    """Text, class and status each narrow both tables; a group without rows goes with its head."""
    assert sum(len(group) for group in groups(tab, 0)) == 12
    find = tab.find_element("css selector", "#suite-1 .find")
    find.send_keys("KF")
    kept = ["kf", "chi2_kf eta=15", "cusum_kf", "reacquire_kf", "brake_kf"]
    assert groups(tab, 0) == [kept] and texts(tab, "#suite-1 .map tbody tr[data-row]:not([hidden]) .name")[0] == "kf"
    assert len(texts(tab, "#suite-1 .map tbody tr[data-row]:not([hidden])")) == 5
    assert tab.find_element("css selector", "#suite-1 output").text == "5 of 12 defences"
    pick(tab, "#suite-1 [data-key=class]", "measurements")
    assert groups(tab, 0) == [kept[:3]]
    find.send_keys("\ue003\ue003")
    pick(tab, "#suite-1 [data-key=status]", "unattacked")
    assert [len(group) for group in groups(tab, 0)] == [2] and len(texts(tab, "#suite-1 .ranks tbody:not([hidden])")) == 1
    assert len(texts(tab, "#suite-2 .ranks tr[data-row]:not([hidden])")) == 2  # the other suite keeps its rows


@pytest.mark.page
def test_the_cards_of_attacks_are_folded_away_and_open(tab):
    """A click shows what came with an attack, and what is registered of the others; nothing of it is seen before."""
    fold = tab.find_element("css selector", "#suite-1 details.told-attacks")
    assert not fold.find_element("css selector", "dl").is_displayed()
    fold.find_element("css selector", "summary").click()
    assert fold.find_element("link text", "https://example.org/attack-code").is_displayed()
    assert fold.find_element("css selector", "summary").text == "Cards of the attacks (10)"
    assert "the receiver reads uniform random values" in fold.text and "BSD-3-Clause" in fold.text


def pick(tab, selector, value):
    script = "const m = document.querySelector(arguments[0]); m.value = arguments[1]; m.dispatchEvent(new Event('change')); return m.value"
    assert tab.execute_script(script, selector, value) == value


@pytest.mark.page
def test_the_map_follows_its_menus(tab):
    """The script draws what the page was written with, and any other scenario and dose from the board's figures."""
    look = "return [...document.querySelectorAll('#suite-1 .map td')].map(t => [t.textContent, t.className.trim(), t.title])"
    first = tab.execute_script(look)
    pick(tab, "#suite-1 select.dose", "4")
    assert tab.execute_script(look) != first
    pick(tab, "#suite-1 select.dose", "2")
    assert [(a, b) for a, b in zip(tab.execute_script(look), first, strict=True) if a != b] == []
    pick(tab, "#suite-1 select.scenario", "0")
    pick(tab, "#suite-1 select.dose", "0")
    assert texts(tab, "#suite-1 .told") == ["stop-and-go-v0, 5 attacked steps"]
    cells = {(c["defence"], c["attack"]): c for c in make_board()["cells"] if c["scenario"] == "stop-and-go-v0" and c["dose"] == 5}
    shown = tab.execute_script("return [...document.querySelectorAll('#suite-1 .map tr[data-row=\"0\"] td')].map(t => t.firstChild.textContent.trim())")
    mine = [cells["kf", a]["damage"]["value"] for a, *_ in boards.ATTACKS]
    assert shown == [percent(max(mine[:-1])), *(percent(x) for x in mine)]


@pytest.mark.page
def test_knowledge_and_scale_are_chosen(tab):
    """The shares against a white box are shown and sorted by on demand; the dose axis turns linear."""
    black = tab.execute_script("return document.querySelector('#suite-1 tr[data-row=\"0\"] td:nth-child(5)').innerText")
    pick(tab, "#suite-1 .knows", "white")
    white = tab.execute_script("return document.querySelector('#suite-1 tr[data-row=\"0\"] td:nth-child(5)').innerText")
    assert float(white.split("%")[0]) < float(black.split("%")[0])
    boxes = "#suite-1 .scale:not([hidden]) > .plot:not(.small)"
    assert tab.execute_script(f"return document.querySelector('{boxes}').parentElement.className") == "scale log"
    pick(tab, "#suite-1 select.axis", "linear")
    assert tab.execute_script(f"return document.querySelector('{boxes}').parentElement.className") == "scale linear"
    assert len(tab.find_elements("css selector", boxes)) == 1


@pytest.mark.page
def test_pages_are_quiet_and_links_work(tab, site, asked):
    """No script of a board runs, no console message comes, and no request leaves the file system, through a click to an entry and its replay."""
    assert tab.title == "A <small> board"
    tab.find_element("link text", "kf").click()
    assert tab.current_url == entry(site, "kf").as_uri() and tab.title.startswith("kf, synthetic-v0")
    tab.find_element("link text", "Replay of this episode").click()
    assert tab.current_url.endswith("/synthetic-v0/kf-replay.html")
    tab.get(entry(site, HOSTILE).as_uri())
    assert tab.title.startswith("evil:") and tab.get_log("browser") == []
    urls = asked()
    assert len(urls) == 4 and all(url.startswith(site.parent.as_uri()) for url in urls)


@pytest.mark.page
@pytest.mark.parametrize("width", [375, 800, 1280])
def test_only_tables_scroll_sideways(tab, site, width, show):
    """No page is wider than its window, with all folded parts open."""
    show(width, "light")
    for path in (site, entry(site, "chi2_kf:eta=15"), entry(site, LONG)):
        tab.get(path.as_uri())
        tab.execute_script("document.querySelectorAll('details').forEach(d => d.open = true)")
        page, room = tab.execute_script("return [document.documentElement.scrollWidth, document.documentElement.clientWidth]")
        assert page <= room <= width, path.name
    tab.get(site.as_uri())
    wide = tab.execute_script("const t = document.querySelector('#suite-1 .map'); return t.offsetWidth > t.parentElement.clientWidth")
    assert wide or width > 375  # so that this does test something


SEEN = """return [...document.querySelectorAll(arguments[0])].map(t => [t.innerText.replace(/\\s+/g, ' ').trim(), t.offsetParent !== null
  && t.getBoundingClientRect().right <= t.closest('.scroll').getBoundingClientRect().right])"""


@pytest.mark.page
def test_what_tells_most_stands_in_a_phone_without_scrolling(tab, site, show):
    """A board shows name and undamaged shares, the class below the name. An entry shows gates, the worst damage and who is weaker."""
    show(420, "light")
    tab.get(site.as_uri())
    heads = dict(tab.execute_script(SEEN, "#suite-1 .ranks thead th"))
    whole = [head for head, seen in heads.items() if seen]
    assert whole[0] == "Defence" and sum("Undamaged" in head for head in whole) >= 2 and heads["Class"] is False
    below = "return getComputedStyle(document.querySelector('#suite-1 tr[data-row=\"0\"] th'), '::after').content"
    assert tab.execute_script(below) == '"measurements"'
    tab.get(entry(site, "chi2_kf:eta=15").as_uri())
    for section, head in (("gates", "Passed"), ("worst", "Damaged"), ("detection", "Detected"), ("pairs", "Surely weaker")):
        assert dict(tab.execute_script(SEEN, f"section[aria-labelledby={section}] thead th"))[head], section
    show(1280, "light")
    tab.get(site.as_uri())
    assert dict(tab.execute_script(SEEN, "#suite-1 .ranks thead th"))["Class"]
    assert tab.execute_script(below) == "none"


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    """A page for each of two boards, as a board is published: one with several doses, one with one dose."""
    several, one = make_board("of-several-doses-v0"), make_board("of-a-single-dose-v0", doses=[3])
    for board in (several, one):  # as long as a published one
        board["suite"]["about"] = "Cars with adaptive cruise control on a windy road, behind one that brakes hard. The attacker may add up to 3 m (m/s), or jam."
    return [build_site([board], tmp_path_factory.mktemp("single"), title=f"Tailgate: {board['suite']['name']}", replays=False) for board in (several, one)]


@pytest.mark.page
@pytest.mark.parametrize("which", [0, 1], ids=["several doses", "one dose"])
def test_the_first_defence_is_seen_in_a_phone_without_scrolling(browser, single, which, show):
    """Filters are folded there and open on demand; the name of the suite is not shown twice. The share comes before the rank."""
    show(400)
    browser.get(single[which].as_uri())
    place = "const b = document.querySelector(arguments[0]).getBoundingClientRect(); return [b.top, b.bottom]"
    top, bottom = browser.execute_script(place, "#suite-1 .ranks tr[data-row]")
    assert 0 < top < bottom <= 800
    assert browser.execute_script("return scrollY") == 0 and browser.find_element("id", "title-1").size["height"] <= 1
    heads = browser.execute_script("return [...document.querySelectorAll('#suite-1 .ranks thead th')].map(h => h.textContent.trim())")
    shares = [i for i, head in enumerate(heads) if head.startswith("Undamaged")]
    assert len(shares) == (1 if which else 3) and shares[-1] + 1 == heads.index("Rank")
    find, fold = browser.find_element("css selector", "#suite-1 .find"), browser.find_element("css selector", "#suite-1 .fold > summary")
    assert not find.is_displayed() and browser.find_element("css selector", "#suite-1 .filters output").text == "12 of 12 defences"
    fold.click()
    find.send_keys("cusum")
    assert browser.find_element("css selector", "#suite-1 .filters output").text == "1 of 12 defences"
    show(1280)
    browser.get(single[which].as_uri())
    assert browser.find_element("css selector", "#suite-1 .find").is_displayed() and not browser.find_element("css selector", "#suite-1 .fold > summary").is_displayed()


@pytest.mark.page
def test_dark_light_and_numbers(tab, show):
    """The ground follows the wish of the reader; figures stand to the right in figures of one width."""
    dark_and_light(tab, show)
    style = "const s = getComputedStyle(document.querySelector('.ranks td.num')); return [s.textAlign, s.fontVariantNumeric]"
    assert tab.execute_script(style) == ["right", "tabular-nums"]


GREYS = """
const value = c => { const [r, g, b] = c.match(/[\\d.]+/g).map(Number); return 0.2126 * lin(r) + 0.7152 * lin(g) + 0.0722 * lin(b) }
const lin = x => (x /= 255) <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4
return [...document.querySelectorAll('#suite-1 .map tr[data-row] td')].map(t => {
  const s = getComputedStyle(t), clear = s.backgroundColor === 'rgba(0, 0, 0, 0)', ground = clear ? getComputedStyle(document.body).backgroundColor : s.backgroundColor
  const [low, high] = [value(s.color), value(ground)].sort((a, b) => a - b)
  return {text: t.firstChild.textContent.trim(), contrast: (high + 0.05) / (low + 0.05), grey: value(ground), marked: s.textDecorationLine === 'underline', over: parseInt(t.firstChild.textContent) > 10}
})"""


@pytest.mark.page
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_told_by_colour_alone(tab, show, scheme):
    """In greys: each cell has its figure in readable contrast, damage above the limit is underlined and more damage is further from no damage;
    lines of a chart that have their names are dashed differently."""
    show(1280, scheme)
    cells = tab.execute_script(GREYS)
    assert len(cells) > 100 and all(c["text"] and c["contrast"] >= 4.5 for c in cells)
    told = [c for c in cells if c["text"].endswith("%") and c["text"] != "10%"]  # 10.4 % is above 10
    assert all(c["marked"] == c["over"] for c in told) and {c["over"] for c in told} == {True, False}
    greys: dict[int, list[float]] = {}
    for cell in told:
        greys.setdefault(int(cell["text"].rstrip("%")), []).append(cell["grey"] if scheme == "dark" else -cell["grey"])
    shades = [greys[percent] for percent in sorted(greys)]
    assert len(shades) > 20 and all(max(less) <= min(more) for less, more in itertools.pairwise(shades))
    dashes = "return [...document.querySelectorAll('#suite-1 .plot')].map(p => [...p.querySelectorAll('.field polyline.run')].map(l => getComputedStyle(l).strokeDasharray))"
    charts = [held for held in tab.execute_script(dashes) if len(held) > 1]
    assert charts and all(len(set(held)) == len(held) for held in charts)


@pytest.mark.page
def test_without_scripts_the_page_stands(browser, site):
    """Tables and the map at the middle dose are there; menus that would do nothing are not."""
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        browser.get(site.as_uri())
        shown = [e.is_displayed() for e in browser.find_elements("css selector", ".filters")]
        assert shown and not any(shown) and len(browser.find_elements("css selector", "#suite-1 .map tr[data-row]")) == 12
        assert browser.find_element("css selector", "#suite-1 .told").text == "worst of all scenarios, 20 attacked steps"
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
