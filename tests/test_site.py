"""The site of boards: what its pages say, and that nothing in a board becomes markup."""

import copy
import hashlib
import json
import lzma
import math
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tailgate.board.files import read_board
from tailgate.board.words import at_least, percent
from tailgate.site.build import build_site
from tailgate.site.cards import LICENCE
from tailgate.site.entry import _imported, _worst, replay_of
from tailgate.site.suite import Suite, critical_of

from . import boards
from .boards import HOSTILE, LONG, Outline, asks_for_nothing, entry, make_board, network

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def worst_row():
    return boards.crashed_row()


@pytest.fixture(scope="module")
def site(tmp_path_factory, worst_row):
    return boards.make_site(tmp_path_factory.mktemp("site"), worst_row)


@pytest.fixture(scope="module")
def index(site):
    return Outline(site.read_text(encoding="utf-8"))


def test_every_file_is_listed_with_its_hash(site):
    """The summary names every file of the site but itself, with the hash of what is there."""
    data = json.loads((site.parent / "summary.json").read_text())
    there = {str(p.relative_to(site.parent)) for p in site.parent.rglob("*") if p.is_file()}
    assert set(data["sha256"]) == there - {"summary.json"} and data["suites"] == ["synthetic-v0", "network-v0"]
    for name, digest in data["sha256"].items():
        assert hashlib.sha256((site.parent / name).read_bytes()).hexdigest() == digest
    assert json.loads((site.parent / "network-v0" / "board.json").read_text()) == network()
    kf = next(e for e in data["entries"] if e["defence"] == "kf")
    assert kf["replay"] == "synthetic-v0/kf-replay.html" and kf["replay"] in there and data["sha256"]["network-v0/board.json"][:16] in site.read_text()


def test_the_same_boards_give_the_same_bytes(site, worst_row, tmp_path):
    """Nothing of a time or a place gets into the site."""
    again = boards.make_site(tmp_path, worst_row)
    for path in site.parent.rglob("*.*"):
        assert path.read_bytes() == (again.parent / path.relative_to(site.parent)).read_bytes(), path.name


def test_groups_order_and_figures(index):
    """Ranked entries come first by class and rank, then the unattacked, then the unranked with their reasons; figures are those of the board."""
    rows = [row for row in index.rows("cells ranks") if row][1:]
    heads = [i for i, row in enumerate(rows) if row.startswith(("Ranked", "Not attacked yet", "Unranked, for comparison"))]
    assert heads[:3] == [0, 7, 10] and len(heads) == 4
    assert [row.split()[0] for row in rows[1:7]] == ["kf", "chi2_kf", "cusum_kf", "reacquire_kf", "brake_kf", "cra"]
    board = make_board()
    kf = next(e for e in board["entries"] if e["defence"] == "kf")
    assert kf["critical_dose"]["black"]["value"] == 5 and "\N{LESS-THAN OR EQUAL TO} 5 \N{LESS-THAN OR EQUAL TO} 5 to" in rows[1] and "1 of 3" in rows[1]
    dose = next(e for e in board["entries"] if e["defence"].startswith("chi2_kf"))["critical_dose"]["black"]
    assert f"{dose['value']:.3g} {dose['low']:.3g} to {dose['high']:.3g}" in rows[2]
    rates = {(r["dose"], r["knowledge"]): r["undamaged"] for r in kf["rates"]}
    for dose in (10, 20, 40):
        assert f"{percent(rates[dose, 'white']['value'])} ≥ {at_least(rates[dose, 'white']['low'])}" in rows[1]
    assert re.match(r"kf measurements (\d+% ≥ \d+% ){9}1 of 3 ≤ 5", rows[1])  # the shares, then the rank
    brake = next(row for row in rows if row.startswith("brake_kf"))
    assert "> 200" in brake and "to > 200" in brake  # beyond the largest dose
    assert any(row.startswith("none baseline: no defence") for row in rows)
    assert any(row.startswith("always_alarm sentinel") and "6 of 8 not false alarms" in row for row in rows)
    last = rows[heads[3] :]
    assert [row.split()[0] for row in last[1:]] == ["kf", "chi2_kf"] and re.search(r"kf measurements (96% ≥ 91% )+1 of 2", last[1])


def test_the_map_shows_the_worst_scenario_at_the_middle_dose(index):
    """A cell of the first map is the largest share over the scenarios; the computed optimum is not in the worst of the row."""
    board = make_board()
    row = next(r for r in index.rows("heat map") if r.startswith("chi2_kf"))
    cells = [c for c in board["cells"] if c["defence"] == "chi2_kf:eta=15" and c["dose"] == 20]
    by_attack = {}
    for c in cells:
        by_attack[c["attack"]] = max(by_attack.get(c["attack"], 0), c["damage"]["value"])
    shown = [float(x) / 100 for x in re.findall(r"(\d+)% ,", row)]
    counted = [by_attack[a] for a, _, _, _, optimal in boards.ATTACKS if not optimal]
    assert shown[0] == pytest.approx(max(counted), abs=0.0051) and by_attack["optimal_stealth"] > max(counted)
    assert shown[1:] == pytest.approx([by_attack[a] for a, *_ in boards.ATTACKS], abs=0.0051)


def test_attackers_that_only_their_own_defence_met_share_a_column(tmp_path):
    """At each knowledge: the worst of those trained against the row's defence. One that others met too keeps its own, and a shared reason
    stands once.
    """
    board, own = make_board(), {"kf": ("a/p-0.json", "a/p-1.json"), "chi2_kf:eta=15": ("b/p-0.json",)}
    for i, (defence, policies) in enumerate(own.items()):
        for j, policy in enumerate(policies):
            part = {"attack": policy, "knowledge": "black", "learned": True, "optimal": False}
            board["attacks"].append(part | {"trained_on": defence, "admitted": None, "note": ""})
            for c in [c for c in board["cells"] if c["attack"] == boards.ATTACKS[0][0] and c["defence"] == defence]:
                board["cells"].append(c | part | {"damage": boards.share(20 + 60 * i + 30 * j)})
    page = Outline(build_site([board], tmp_path, replays=False).read_text(encoding="utf-8"))
    heads, *rows = page.rows("heat map")
    assert heads.count("made against it the worst") == 1 and "p-0" not in heads and "policy" in heads
    first = {r.split()[0]: re.findall(r"(\d+%|n/a) ,", r)[1] for r in rows if " ," in r}
    assert first["kf"] == "25%" and first["chi2_kf"] == "40%" and first["cusum_kf"] == "n/a"
    lines = [row for row in page.rows("cells ranks") if row.startswith("Not attacked yet")]
    assert lines and lines[0].endswith("(all: no attacker was trained against it)")


def test_a_board_without_a_road_names_its_bound(site):
    """Where nobody can collide, damage is an error above the suite's bound."""
    text = site.read_text(encoding="utf-8")
    assert "an error above 25" in text and text.count("a collision, in front or behind") == 1
    assert "an error above 25" in entry(site, "kf", "network-v0").read_text(encoding="utf-8")
    road, network = (Outline(entry(site, "kf", *suite).read_text(encoding="utf-8")).lines for suite in ((), ("network-v0",)))
    units = [next(line for _, line in lines if line.split()[:2] == ["max", "error"]).split()[5] for lines in (road, network)]
    assert units == ["m", "-"]


def test_an_entry_s_page_has_all_parts(site):
    """Card, gates, flags, worst attacks, curves, robustness, stealth, detection, comparisons, and a link to the other suite."""
    text = entry(site, "chi2_kf:eta=15").read_text(encoding="utf-8")
    for part in ("https://example.org/paper", "Licence", "threshold of the gate [1]", "the budget was not spent", "car-following-heavy-v0", "<td>\N{MINUS SIGN}7</td>", "false alarms",
                 "Only A damaged", "steps: 20000", "../network-v0/chi2_kf", "other plant", "Delay [steps]"):  # fmt: skip
        assert part in text, part
    assert text.count('class="plot ') == 3  # a chart on each scale, and that of stealth impact
    assert "leaderboard check OUT/synthetic-v0/board.json --defence chi2_kf:eta=15" in text and "leaderboard check FILE" in site.read_text(encoding="utf-8")
    bare = entry(site, HOSTILE).read_text(encoding="utf-8")
    assert "came without a card" in bare and "No replay. The board holds no worst episode" in bare and "Stealth and impact" not in bare
    assert "no board imports a class from outside the package" in bare and "leaderboard check" not in bare  # a board does not import it
    assert [_imported(text) for text in ("chi2_kf:eta=3", "composed:detector=mine:D", "bwrap/mine:D", HOSTILE)] == [False, True, True, True]


def test_why_a_knowledge_has_no_critical_dose():
    """An attack of it without full figures, or none at all."""
    board = copy.deepcopy(make_board())
    name = board["entries"][0]["defence"]
    board["entries"][0]["critical_dose"] |= {"grey": None, "white": None}
    board["cells"] = [cell for cell in board["cells"] if (cell["defence"], cell["knowledge"]) != (name, "grey")]
    suite = Suite(read_board(board), "")
    told = {level: critical_of(suite, suite.board.entries[0], level)["about"] for level in ("grey", "white")}
    assert told == {"grey": "no attack that knows just this was met", "white": "not every attack of this knowledge has full figures"}


def facts(text, heading, level=2):
    """The names and texts of the first list of facts after a heading."""
    part = text.replace("<wbr>", "").split(f">{heading}</h{level}>")[1].split("</dl>")[0]
    return dict(re.findall(r"<dt>(.*?)</dt><dd>(?:<a [^>]*>)?(.*?)(?:</a>)?</dd>", part))


def test_every_entry_and_attack_of_a_published_board_has_a_whole_card(tmp_path):
    """Made of the registry and the suite, as the board stores none of it: code, licence, uses, threat model and training."""
    board = json.loads((ROOT / "results/quick-v0/board.json").read_text(encoding="utf-8"))
    page = build_site([board], tmp_path, replays=False)
    granted = "dos_jam, dos_hold, dos_hold_fresh, dropout, fdi of every sensor; fdi_bound 50.0; jam_range -108.0, 3000.0; onset 50; end 500"
    for held in board["entries"]:
        assert not {"licence", "threat_model", "training"} & set(held["card"])
        told = facts(entry(page, held["defence"], "quick-v0").read_text(encoding="utf-8"), "Card")
        assert told["Licence"] == "MIT" and told["Threat model"] == granted and told["Training"] == "none" and told["Uses"] == ", ".join(held["uses"])
        path, cls = told["Code"].split(", ")
        assert re.search(rf"^class {cls}\b", (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE)
    text = page.read_text(encoding="utf-8")
    for name in dict.fromkeys("policy" if a["learned"] else a["attack"].split(":")[0] for a in board["attacks"]):
        told = facts(text, name, 4)
        assert told["Licence"] == "MIT" and told["Threat model"] == granted and (ROOT / told["Code"].split(", ")[0]).is_file()
        assert "cem (gamma=1.0" in told["Training"] if name == "policy" else told["Training"] == "none"
    board |= {"entries": [e for e in board["entries"] if e["defence"] == "kf"], "comparisons": [], "curves": [], "detection": None}
    board["cells"] = [cell for cell in board["cells"] if cell["defence"] == "kf"]
    board["suite"]["hash"] = "0" * 16  # of another suite under the name: nothing is said of what it grants
    other = facts(entry(build_site([board], tmp_path, replays=False), "kf", "quick-v0").read_text(encoding="utf-8"), "Card")
    assert "Threat model" not in other and other["Licence"] == "MIT"


def test_an_attack_that_joined_names_the_test_that_it_won(tmp_path):
    """And no other: against most defences something known before does more."""
    board = make_board()
    lost = {"defence": "kf", "scenario": "s", "dose": 12, "episodes": 100, "only_new": 0, "only_worst": 90, "p": 1e-20, "adjusted": 1e-18, "level": 0.025}
    won = lost | {"defence": "rkf", "only_new": 31, "only_worst": 2, "p": 1e-6, "adjusted": 0.0004, "level": 0.0083333}
    attack = next(a for a in board["attacks"] if not a["admitted"])
    attack["admitted"] = {"attack": attack["attack"], "digest": "", "knowledge": "black", "date": "2026-11-25", "evidence": [lost, won]}
    text = build_site([board], tmp_path, replays=False).read_text(encoding="utf-8").replace("<wbr>", "")
    said = "2026-11-25: 31 of 100 episodes of rkf that the worst before did not damage, 2 the other way, dose 12; p 0.0004, adjusted for 2 tests, at level 0.0083"
    assert said in text and "evidence" not in text


def test_the_card_that_came_with_an_attack_is_drawn(site):
    """Over what is registered of it; the package's licence is the one that stands in pyproject.toml."""
    told = facts(site.read_text(encoding="utf-8"), "A bias that is held", 4)
    assert {"Reference": "https://example.org/attack", "Licence": "BSD-3-Clause", "Threat model": "Adds &lt;b&gt;any&lt;/b&gt; value."}.items() <= told.items()
    assert f'license = "{LICENCE}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_stealth_impact_has_its_interval_and_a_reason_where_there_is_none(site, index, tmp_path):
    """On the curve and in the tables; a board of before the intervals is drawn without them."""
    assert "kf 3.36 3.16 to 3.66 4.36 4.16 to 4.66 5.36 5.16 to 5.66" in index.rows("plain")
    held = make_board()
    page = entry(site, "kf").read_text(encoding="utf-8")
    assert Outline(page).rows("plain").count("0.1 9.1 3.36 3.16 to 3.66") == 1 and "no &lt;b&gt;gate" in entry(site, "imm").read_text(encoding="utf-8")
    for item in held["entries"][0]["stealth"]:
        del item["low"], item["high"]
    old = entry(build_site([held], tmp_path, replays=False), "kf").read_text(encoding="utf-8")
    whiskers = [text.split('id="stealth"')[1].count('class="whisker') for text in (page, old)]
    assert whiskers == [3, 0] and "0.1 9.1 3.36 \N{EN DASH}" in Outline(old).rows("plain")


def cell_of(site, path, defence):
    """Text and title of the trust cell of a defence, and the heads of the tables that it stands in."""
    found = re.search(rf'<th scope="row" data-sort="{defence}"[^>]*>.*?<td class="num" data-sort="([^"]*)" title="([^"]*)"><b>([^<]*)</b></td>\n<td', path.read_text(), re.DOTALL)
    return found.groups()


def test_trust_names_its_attacks_and_is_never_rounded_up(site):
    """The column is of safety at black box, its title of all properties; a dash says why; the entry's page has every bound with its worst cell."""
    board = make_board()
    by_name = {e["defence"]: e["trust"] for e in board["entries"]}
    black = by_name["kf"]["safety"]["black"]
    sort, about, text = cell_of(site, site, "kf")
    assert float(sort) == pytest.approx(black["lower"]) and text == f"{math.floor(1000 * black['lower']) / 10:.1f}%" and at_least(0.99999, 1) == "99.9%"
    assert f"{black['k']} of 200 runs: radar-ppo-3" in about and "all properties" in about
    assert cell_of(site, site, "oracle")[1].startswith("200 of 200 runs: no attack, car-following-heavy-v0, dose 200")
    lines = Outline(entry(site, "none").read_text(encoding="utf-8")).rows("plain trust")
    assert lines[2].startswith(f"black box {at_least(by_name['none']['safety']['black']['lower'], 1)} {by_name['none']['safety']['black']['k']} of 200 5 0.05 / 12 radar-ppo-3")
    assert lines[4] == "white box " + " ".join("\N{EN DASH}" * 4) and lines[5] == "All properties : no collision, brakes, detects" and len(lines) == 9
    text = entry(site, "none").read_text(encoding="utf-8")
    for part in ("incomplete: stealth: no gate to pass", "5 black box, 2 grey box, 3 white box", "a computed optimum: shown", "brakes within 600 ms", "detection 10 steps"):
        assert part in text, part
    assert "incomplete: sac-a/policy on a-v0: &lt;b&gt;boom" in entry(site, HOSTILE).read_text(encoding="utf-8")
    assert "No bound where there is a dash: not among the defences that were checked" in entry(site, LONG).read_text(encoding="utf-8")
    assert 'id="trust"' not in entry(site, "kf", "network-v0").read_text(encoding="utf-8")


def test_round_and_weaker_are_said(site, index):
    """Public seeds would pass for those of a round, or the wrong one of a pair for the weaker."""
    text = site.read_text(encoding="utf-8")
    assert text.count("public seeds: for development") == 1 and "seeds of the beacon drand &lt;3&gt; 5f1c" in text
    pairs = [row for row in index.rows("cells") if row.startswith(("kf chi2_kf", "kf cusum_kf"))]
    assert " kf measurements " in pairs[0] and pairs[0].endswith("< 0.0001 < 0.0001") and " undecided " in pairs[1] and pairs[1].endswith("0.60") and text.count("(intersection-union)") == 2
    assert any(row.startswith("radar-ppo-3 black box learned chi2_kf eta=15") for row in index.rows("cells"))


@pytest.mark.long
def test_a_comparison_by_numbers_is_marked(tmp_path):
    """Where the numbers leave no choice nothing is marked, but what is corrected for the other pairs of the class."""
    board = make_board()
    first, second, *_ = board["comparisons"]
    first |= {"only_b": 0, "bound": True}
    second |= {"bound": True}
    text = build_site([board], tmp_path, replays=False).read_text(encoding="utf-8")
    pairs = [row.partition(" measurements ") for row in Outline(text).rows("cells")]
    told = {(before.split()[-1], figures) for before, _, figures in pairs if figures}
    assert {("kf", "42 0 < 0.0001 < 0.0001"), ("undecided", "≤ 42 ≤ 33 ≤ 0.30 ≤ 0.60")} <= told
    assert "≤: the board knows how many episodes came to damage, but not which" in text
    assert "≤ stands" not in build_site([make_board()], tmp_path / "other", replays=False).read_text(encoding="utf-8")


def test_a_board_of_before_these_fields_is_drawn(tmp_path):
    """Without round, trust, trainings and weaker nothing is claimed of them; no dose at all is damage without an attack."""
    board = make_board(trusted=False)
    for part, key in ((board["suite"], "beacon"), *((a, key) for a in board["attacks"] for key in ("trained_on", "card")), *((c, "weaker") for c in board["comparisons"]), (board, "trust")):
        del part[key]
    board["entries"][0]["critical_dose"]["black"] |= {"value": 0.0, "low": 0.0}
    text = build_site([board], tmp_path, replays=False).read_text(encoding="utf-8")
    assert "public seeds" not in text and "Trust" not in text and "intersection" not in text and "McNemar" in text
    assert 'title="damage without any attack; 95% interval 0 to' in text
    assert "damage without any attack" in entry(tmp_path / "index.html", "kf").read_text(encoding="utf-8")


def test_the_worst_episode_is_played_again(site, worst_row):
    """The entry's page links a replay that is bit for bit the row's episode; a row that cannot be played says why."""
    text = entry(site, "kf").read_text(encoding="utf-8")
    assert 'href="kf-replay.html"' in text and "The same trace, bit for bit" in text and "Collision" in text
    assert worst_row["trace_hash"] in (site.parent / "synthetic-v0" / "kf-replay.html").read_text(encoding="utf-8")
    assert "No replay. The row lacks the field" in entry(site, "imm").read_text(encoding="utf-8")


def test_of_the_worst_episode_dose_and_attack_are_said(site, worst_row, tmp_path):
    """And that it is none with damage, where there is none."""
    words = "gusty-stop-and-go-v0, at a dose of 12 steps."
    text = entry(site, "kf").read_text(encoding="utf-8").replace("<wbr>", "")
    assert words in text and "this one came nearest" not in text and "at a dose of" not in entry(site, "imm").read_text(encoding="utf-8")
    board = network()
    for held in board["entries"]:
        held["worst_episode"] = worst_row
    for rate in board["entries"][0]["rates"]:
        rate["undamaged"] = {"value": 1.0, "low": 0.9}
    page = build_site([board], tmp_path, replays=False)
    near = ["this one came nearest" in entry(page, held["defence"], "network-v0").read_text(encoding="utf-8") for held in board["entries"]]
    assert near == [True, False]


def test_rows_that_cannot_be_played(worst_row, tmp_path):
    """A policy that is not here and a class to import are reasons, without the place of a file; nothing is imported or written."""
    for change, reason in (
        ({"attack": "/home/x/runs/sac-a/policy.json"}, "an existing file"), ({"defence": "os:getcwd"}, "must not import code"),
        ({"status": "error", "reason": "boom"}, "a row that was played"), ({"threat_model": None}, "a mapping of fields"), ({"seed": "x"}, "Error"),
    ):  # fmt: skip
        done = replay_of(worst_row | change, tmp_path / "r.html", "")
        assert not done.page and reason in done.why and "/home/x" not in done.why
    assert not list(tmp_path.iterdir())


def test_without_replays_the_pages_say_so(tmp_path):
    """No replay is written where none is asked for."""
    page = build_site([network()], tmp_path, replays=False)
    assert not list(tmp_path.rglob("*replay*")) and "Replays were not asked for." in entry(page, "kf", "network-v0").read_text()


def test_an_empty_board_is_a_page(tmp_path):
    """A suite without entries, cells and curves is drawn."""
    board = make_board(defences=(), doses=[None])
    board |= {"detection": None}
    text = build_site([board], tmp_path).read_text(encoding="utf-8")
    assert "This board has no entries yet" in text and "the scenario&#39;s own attacked steps" in text


def test_a_suite_without_numbers_for_doses(tmp_path):
    """Where a scenario's own budget is the only dose there is no axis and no largest dose, and the figures stand all the same."""
    board = network()
    board["suite"] |= {"doses": [None], "shown": {}}
    board["curves"] = []
    for part in (*board["cells"], *(rate for e in board["entries"] for rate in e["rates"])):
        part["dose"] = None
    for e in board["entries"]:
        e["critical_dose"]["white"] = None
    rows = Outline(build_site([board], tmp_path).read_text(encoding="utf-8")).rows("cells ranks")
    kf = next(row for row in rows if row.startswith("kf"))
    assert re.search(r"96% ≥ 91% 1 of 2", kf)  # of one dose the critical one says no more, and the shares come first


def test_texts_of_a_board_become_no_markup(site):
    """Names, reasons and cards are escaped on every page, and no place on somebody's machine is shown."""
    for path in [site, *(p for p in site.parent.rglob("*.html") if "replay" not in p.name)]:
        text = path.read_text(encoding="utf-8")
        assert "<script>document" not in text and "<b>boom" not in text and "A &lt;small&gt; board" in text
        assert "/home/x" not in text, path.name
    assert "&lt;script&gt;document" in site.read_text(encoding="utf-8")


def test_nothing_is_fetched(site):
    """No element of a page asks for anything, and no style or handler hides in an attribute."""
    for path in [site, entry(site, "kf"), entry(site, HOSTILE)]:
        asks_for_nothing(Outline(path.read_text(encoding="utf-8")))


def test_links_lead_somewhere(site):
    """Every link to a file or to a place in a page resolves."""
    pages = {path: Outline(path.read_text(encoding="utf-8")) for path in site.parent.rglob("*.html") if "replay" not in path.name}
    count = 0
    for path, outline in pages.items():
        ids = {attrs["id"] for _, attrs in outline.tags if "id" in attrs}
        assert len(ids) == sum("id" in attrs for _, attrs in outline.tags)
        for tag, attrs in outline.tags:
            href = attrs.get("href", "") if tag == "a" else ""
            if href and not href.startswith("https://"):
                parts = urlsplit(href)
                assert not parts.path or (path.parent / unquote(parts.path)).is_file(), href
                assert parts.path or parts.fragment in ids, href
                count += 1
    assert count > 50


@pytest.mark.long
def test_where_nobody_did_damage_no_attack_is_called_the_worst() -> None:
    """`safe_state_brake` on radar-v0: no attack did anything at any dose, where `chi2_kf_sparse` has a worst one."""
    held = json.loads((ROOT / "results/radar-v0/board.json").read_text(encoding="utf-8"))
    suite = Suite(read_board(held), "radar-v0")
    by_name = {e.defence: critical_of(suite, e, "black") for e in suite.board.entries}
    assert by_name["safe_state_brake"]["worst"] == "" and "no attack that knows at most this did damage" in by_name["safe_state_brake"]["about"]
    assert "chi2_kf_sparse-ppo-black" in by_name["chi2_kf_sparse"]["worst"] and "did damage" not in by_name["chi2_kf_sparse"]["about"]


def test_the_worst_of_a_cell_is_an_attack_that_counts() -> None:
    """One that was taken back by an erratum is not shown as the worst, however much it damaged."""
    suite = Suite(read_board(make_board()), "synthetic-v0")
    name = suite.board.entries[0]
    first = {line["cell"].attack for line in _worst(suite, name)}
    assert first
    for attack in suite.board.attacks:
        attack.withdrawn = attack.attack in first
    assert not first & {line["cell"].attack for line in _worst(suite, name)}


def test_damage_in_a_lane_is_leaving_it() -> None:
    board = read_board(json.loads(lzma.decompress((ROOT / "results/lane-v0/board.json.xz").read_bytes())))
    assert Suite(board, "lane-v0").damage == "the lane is left"
    assert Suite(read_board(make_board()), "synthetic-v0").damage == "a collision, in front or behind"
