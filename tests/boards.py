"""A made-up board in the format tailgate-board-1: deterministic, with what real ones have (nulls, optima, failures, long names)."""

import math
import re
from html.parser import HTMLParser

from tailgate.evaluation.cells import evaluate
from tailgate.evaluation.stats import mean_time
from tailgate.site.build import build_site, slug

LEVELS = ("black", "grey", "white")
DOSES = [5, 10, 20, 40, 200]
SCENARIOS = ["stop-and-go-v0", "car-following-heavy-v0"]
HOSTILE = "evil:<script>document.title='owned'</script>&\"'"
LONG = "a_very_long_module_name_without_any_space." * 3 + "Defence:threshold=12.5"
DEFENCES = (  # text, class, strength (dose that half of the episodes withstand), status, why
    ("kf", "measurements", 14, "ranked", ""),
    ("chi2_kf:eta=15", "measurements", 33, "ranked", ""),
    ("cusum_kf", "measurements", 60, "ranked", ""),
    ("reacquire_kf", "measurements + odometry", 90, "ranked", ""),
    ("brake_kf", "measurements + odometry", 900, "ranked", ""),
    ("cra:probability=0.3,quiet=5", "measurements + probe", 40, "ranked", ""),
    ("imm", "measurements", 25, "unattacked", "no attacker was trained against it"),
    (LONG, "measurements", 30, "unattacked", "no attacker was trained against it"),
    ("none", "measurements", 8, "unranked", "baseline: no defence"),
    ("oracle", "truth", 1e6, "unranked", "reference: is told what is attacked"),
    ("always_alarm", "measurements", 20, "unranked", "sentinel: fails the gate false_alarms"),
    (HOSTILE, "measurements", 10, "unranked", "failed: <b>boom</b>"),
)
ATTACKS = (  # text, knowledge, power, learned, optimal
    ("dos_hold:trigger=near,threshold=40", "black", 1.0, False, False),
    ("dos_jam:trigger=near,threshold=40", "black", 0.8, False, False),
    ("dropout:trigger=near,threshold=40", "black", 0.5, False, False),
    ("fdi:start_step=200,value=-4", "black", 0.6, False, False),
    ("zoo:name=radar-ppo-3", "black", 1.2, True, False),
    ("program:path=burst_jamming", "grey", 0.9, False, False),
    ("/home/x/runs/sac-a/policy.json", "grey", 1.3, True, False),
    ("stealth:trigger=near,threshold=40", "white", 1.6, False, False),
    ("ghost:size=20,grow=20", "white", 1.1, False, False),
    ("optimal_stealth", "white", 2.5, False, True),
)
ATTACK_CARD = {
    "name": "A bias that is held", "reference": "https://example.org/attack", "licence": "BSD-3-Clause", "threat_model": "Adds <b>any</b> value.",
    "training": "none", "code": "https://example.org/attack-code",
}  # fmt: skip


class Outline(HTMLParser):
    """Tags with their attributes, the text outside of scripts and styles, and that of every table row by the table's class."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self.lines, self.table = [], [], [], None
        self.feed(text.replace("<wbr>", ""))

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "table":
            self.table = dict(attrs).get("class")
        if tag == "tr":
            self.lines.append([self.table, ""])

    def handle_data(self, data):
        if self.tags[-1:] and self.tags[-1][0] not in ("script", "style"):
            self.words.append(data)
        if self.lines:
            self.lines[-1][1] += " " + " ".join(data.split())

    def rows(self, table):
        return [re.sub(r"\s+", " ", text).strip() for kind, text in self.lines if kind == table]


def asks_for_nothing(outline):
    """No element of a page asks for anything, and no style or handler hides in an attribute."""
    for tag, attrs in outline.tags:
        assert tag not in ("img", "iframe", "object", "embed", "base", "form")
        assert "style" not in attrs and not any(name.startswith("on") for name in attrs)
        for name in ("src", "srcset", "href", "action"):
            value = attrs.get(name) or ""
            assert not value.startswith(("http", "//")) or (tag == "a" and name == "href" and attrs["rel"] == "noopener noreferrer")
        assert (attrs.get("href") or "").split(":")[0] != "javascript"


def dark_and_light(tab, show):
    """The ground follows the wish of the reader."""
    ground = "return getComputedStyle(document.body).backgroundColor"
    light = tab.execute_script(ground)
    show(1280, "dark")
    assert (light, tab.execute_script(ground)) == ("rgb(255, 255, 255)", "rgb(20, 22, 26)")


def share(k, n=200):
    """A share of episodes with an interval (a rough one: a page only draws it)."""
    p = k / n
    half = 1.96 * math.sqrt(max(p * (1 - p), 0.001) / n)
    return {"value": p, "low": max(0.0, p - half), "high": min(1.0, p + half)}


def damaged(strength, power, dose, scenario):
    """Episodes of 200 that come to damage."""
    hard = 1.25 if scenario == SCENARIOS[1] else 1.0
    return round(200 / (1 + (strength / (dose * power * hard)) ** 2.2))


def cells_of(defences, attacks, scenarios, doses):
    out = []
    for text, _, strength, *_ in defences:
        for attack, knowledge, power, learned, optimal in attacks:
            for scenario in scenarios:
                for dose in doses:
                    cell = {"scenario": scenario, "dose": dose, "defence": text, "attack": attack, "knowledge": knowledge, "learned": learned,
                            "optimal": optimal, "n": 200, "failed": 0, "reason": "", "damage": share(damaged(strength, power, dose, scenario))}
                    if text == HOSTILE and knowledge == "grey":
                        cell |= {"n": 0, "failed": 200, "reason": "ValueError: <b>boom</b>", "damage": None}
                    elif text == "none" and attack.startswith("stealth"):
                        cell |= {"n": 0, "reason": "no gate to pass", "damage": None}
                    elif text == LONG and attack.startswith("ghost"):
                        cell |= {"n": 190, "failed": 10, "reason": "an overrun"}
                    out.append(cell)
    return out


def curve(cells, defence, level, doses):
    allowed = LEVELS[: LEVELS.index(level) + 1]
    points = []
    for dose in doses:
        known = [c for c in cells if (c["defence"], c["dose"]) == (defence, dose) and c["knowledge"] in allowed and c["damage"] and not c["optimal"]]
        worst = max(known, key=lambda c: c["damage"]["value"])
        points.append({"dose": dose, **worst["damage"], "scenario": worst["scenario"], "attack": worst["attack"]})
    return {"defence": defence, "knowledge": level, "points": points, "fitted": [p["value"] for p in points]}


def critical(line, limit):
    """Where the curve crosses the limit, between doses in a straight line; None beyond the largest."""
    least = line["points"][0]["dose"]  # below it nothing was played

    def cross(key):
        before = (0, 0.0)
        for p in line["points"]:
            if p[key] > limit:
                return max(least, before[0] + (p["dose"] - before[0]) * (limit - before[1]) / (p[key] - before[1]))
            before = (p["dose"], p[key])
        return None

    last = line["points"][-1]
    worst = {"scenario": last["scenario"], "attack": last["attack"]}
    return {"value": cross("value"), "low": cross("high"), "high": cross("low"), "worst": worst}


def bound_of(attacks, scenarios, dose, level, k, n=200):
    """A lower bound (a rough one: a page only draws it) of k runs of n in the worst cell; the clean run is a cell too."""
    met = [a for a, knowledge, _, _, optimal in attacks if not optimal and LEVELS.index(knowledge) <= LEVELS.index(level)]
    return {"lower": max(0.0, k / n - 0.0625), "k": k, "n": n, "of": ["no_collision", "brakes"], "scenario": scenarios[-1], "dose": dose,
            "attack": met[-1] if k < n else "none", "cells": (1 + len(met)) * len(scenarios), "alpha": 0.05, "alpha_cell": 0.001, "attacks": met}


def trust_of(text, attacks, scenarios, dose):
    """Bounds of an entry: full ones, of none at white box, of none at all, and null where it was not checked."""
    if text == LONG:
        return None
    held = {"safety": {}, "all": {}}
    for i, level in enumerate(LEVELS):
        k = 200 if text == "oracle" else 190 - 40 * i - (len(text) * 7) % 20
        lost = text == HOSTILE or (text == "none" and level == "white")
        for name, runs in (("safety", k), ("all", k // 3)):
            held[name][level] = None if lost else bound_of(attacks, scenarios, dose, level, runs)
    for bound in filter(None, held["all"].values()):
        bound["of"] = ["no_collision", "brakes", "detects"]
    return held | {"why": "incomplete: /home/x/runs/sac-a/policy.json on a-v0: <b>boom</b>" if text == HOSTILE else "incomplete: stealth: no gate to pass" if text == "none" else ""}


def about_trust(attacks, scenarios, doses):
    return {
        "alpha": 0.05, "runs": 200, "purpose": "report", "beacon": "", "scenarios": scenarios, "doses": doses,
        "attacks": [{"attack": "none", "knowledge": "black", "note": ""}]
        + [{"attack": a, "knowledge": k, "note": "a computed optimum: shown, and not counted" if o else ""} for a, k, _, _, o in attacks],
        "unsafe": {"response": 0.6, "accel": 2.0, "brake": 5.0, "lead_brake": 5.0}, "demands": {"deadline": 0.6, "steps": 4, "braking": 2.0, "stands": 0.1, "detection": 10},
        "properties": [
            {"name": "no_collision", "about": "no collision, in front or behind, until the horizon", "safety": True},
            {"name": "brakes", "about": "brakes within 600 ms whenever it is too close to stop after an attack began", "safety": True},
            {"name": "detects", "about": "an alarm within 10 steps of the first attack step", "safety": False},
        ],
    }  # fmt: skip


def make_board(name="synthetic-v0", *, bound=None, beacon="", trusted=True, defences=DEFENCES, attacks=ATTACKS, scenarios=SCENARIOS, doses=DOSES):
    cells = cells_of(defences, attacks, scenarios, doses)
    curves = [curve(cells, text, level, doses) for text, *_ in defences for level in LEVELS]
    entries, ranks = [], {}
    for text, kind, strength, status, why in defences:
        mine = {c["knowledge"]: c for c in curves if c["defence"] == text}
        if status == "ranked":
            ranks[kind] = ranks.get(kind, 0) + 1
        rates = [
            {"dose": dose, "knowledge": level, "undamaged": {"value": 1 - p["value"], "low": max(0.0, 1 - p["high"] - 0.02)},
             "worst": {"scenario": p["scenario"], "attack": p["attack"]}, "attacks": 9}
            for level, line in mine.items() for p in line["points"] for dose in [p["dose"]]
        ]
        entries.append({
            "defence": text, "class": kind, "uses": kind.split(" + "), "status": status, "why": why,
            "card": None if text == HOSTILE else {
                "name": text, "summary": f"What {text.split(':')[0]} does.", "reference": "https://example.org/paper", "licence": "MIT",
                "code": "https://example.org/code", "uses": kind.split(" + "), "version": 1,
                "parameters": {"eta": {"default": 15.0, "doc": "threshold of the gate [1]"}}, "training_budget": {"steps": 20000},
            },
            "gates": [
                {"gate": g, "scenario": s, "value": v, "limit": l, "passed": not (text == "always_alarm" and g == "false_alarms")}
                for s in scenarios for g, v, l in (("gap", 1.02, 1.1), ("jerk", 1.05, 1.2), ("distance", 0.995, 0.98), ("false_alarms", None, None))
            ],
            "critical_dose": {level: critical(line, 0.1) for level, line in mine.items()}, "rates": rates,
            "rank": {"best": max(1, ranks[kind] - 1), "worst": ranks[kind]} if status == "ranked" else None,
            "clean": {"min_gap": {"median": 12.0, "q25": 11.5, "q75": 12.25}, "rms_jerk": None, "max_error": {"median": 0.5, "q25": 0.4, "q75": 0.75}},
            "flags": ["the budget was not spent", "seed spread 12 %"] if text.startswith("chi2") else [],
            "worst_episode": {"scenario": "nowhere-v0"} if text == "imm" else None,
            "robustness": [{"scenario": scenarios[-1], "undamaged": {"value": 0.8, "low": 0.74}, "change": -0.07}],
            "stealth": [{"hours": h, "threshold": 9.0 + h, "deviation": (x := 1.5 + math.log10(h) + 40 / strength), "low": x - 0.2, "high": x + 0.3} for h in (0.1, 1, 10)]
            if text in ("kf", "chi2_kf:eta=15", "cusum_kf", "reacquire_kf") else [{"hours": 1, "threshold": 3.0, "deviation": None, "low": None, "high": None, "reason": "shows no <b>gate</b>"}] if text == "imm" else None,
            "trust": trust_of(text, attacks, scenarios, doses[-1]) if trusted else None,
        })  # fmt: skip
    ranked = [e["defence"] for e in entries if e["rank"] and e["class"] == "measurements"]
    duels = [(a, b) for i, a in enumerate(ranked) for b in ranked[i + 1 :]]
    seen = [
        {"defence": e["defence"], "scenario": scenarios[0], "attack": attacks[0][0], "hours": h, "threshold": 9.0 + h, "detected": share(150 - 20 * i),
         "delay": 2.0} | ({"watched": True} if e["defence"] == "kf" else {}) | ({"rarer": True} if e["defence"] == "kf" and h == 10 else {}) for e in entries[:4] for i, h in enumerate((0.1, 1, 10))
    ]
    return {
        "format": "tailgate-board-1",
        "suite": {
            "name": name, "about": "A made-up suite.", "version": "1", "doses": doses, "shown": {str(d): f"why {d}" for d in doses[1:4]}, "limit": 0.1,
            "bound": bound, "alpha": 0.05, "scenarios": [{"name": s, "about": "", "robustness": "heavy" in s, "hash": "ab12"} for s in scenarios],
            "episodes": 200, "purpose": "report", "beacon": beacon, "rows": 200 * len(cells),
        },
        "attacks": [{"attack": a, "knowledge": k, "learned": l, "optimal": o, "trained_on": "chi2_kf:eta=15" if l else None, "admitted": None if i else {"date": "2026-11-22", "p": 0.001}, "card": ATTACK_CARD if a.startswith("fdi:") else None}
                    for i, (a, k, _, l, o) in enumerate(attacks)],
        "entries": entries, "cells": cells, "curves": curves,
        "comparisons": [{"class": "measurements", "a": a, "b": b, "only_a": 42, "only_b": 3 + 30 * i, "weaker": a if i < 2 else b, "p": 1e-7 if i == 0 else 0.3, "adjusted": 1e-6 if i == 0 else 0.6}
                        for i, (a, b) in enumerate(duels)],
        "detection": {"hours": [0.1, 1, 10], "entries": seen, "alarms": [alarm | {"scenario": s} for alarm in false_alarms(seen) for s in scenarios]},
        "trust": about_trust(attacks, scenarios, doses) if trusted else None,
    }  # fmt: skip


def false_alarms(seen):
    """As often as wanted, but ten times as often at one an hour."""
    lines = [{k: line[k] for k in ("defence", "hours", "threshold")} for line in seen]
    return [line | gave({0.1: 20, 1: 200, 10: 0}[line["hours"]], {0.1: 2.0, 1: 20.0, 10: 20.0}[line["hours"]], first=0, late=5) for line in lines]


def gave(onsets, running, dispersion=1.0, first=0, early=0, late=0):
    """What so many false alarms in so many hours say."""
    low, high = mean_time(onsets, running, dispersion)
    mean = running / onsets if onsets else None
    if not onsets:
        early = late = 0
    return {"onsets": onsets, "running": running, "dispersion": dispersion, "mean": mean, "low": low, "high": high, "first": first, "early": early, "late": late}


def network():
    """A board without a road, of two defences and one scenario, where damage is an error above a bound; of a round, and without trust."""
    return make_board("network-v0", bound=25.0, beacon="drand <3> 5f1c", trusted=False, defences=DEFENCES[:2], attacks=ATTACKS[:3], scenarios=["net-v0"], doses=[3])


def crashed_row():
    """A row of an episode that ended in a collision and can be played again."""
    rows = evaluate(scenarios=["gusty-stop-and-go-v0"], defences=["kf"], attacks=["dos_jam:trigger=near,threshold=40"], doses=[12], seeds=2)
    return next(row for row in rows if row["crashed"])


def make_site(folder, row):
    """The site of the made-up board and of the network's; kf's worst episode is the given row."""
    first = make_board()
    first["entries"][0]["worst_episode"] = row
    return build_site([first, network()], folder, title="A <small> board")


def entry(site, defence, suite="synthetic-v0"):
    return site.parent / suite / f"{slug(defence)}.html"
