# ruff: noqa: E501 - tables
"""Real roads: the fit, false alarms on recordings, the time gap, and the order of defences on made-up and recorded roads and by time gap.

    python benchmarks/roads.py [--out results/roads-v0] [--parts fit,alarms,order,headway,boards,gaps,aeb,noise,speed] [--episodes 100]

Each part writes PART.json into the folder, and a figure into docs/images with --figures. A part that has its file is not played again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import kendalltau, spearmanr

from tailgate.base.errors import NotApplicable
from tailgate.base.files import write_atomic
from tailgate.base.plots import canvas, png
from tailgate.board.files import load
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario, load_suite
from tailgate.evaluation.stats import mean_time
from tailgate.play.metrics import METRICS
from tailgate.play.trace import rollout
from tailgate.roads import detect_log, fit
from tailgate.roads.readers import read
from tailgate.roads.replayed import Noise, cut, loop_over, rows

ROOT = Path(__file__).parents[1]
DEFENCES = ("none", "kf", "rkf", "imm", "chi2_kf", "chi2_kf_sparse", "windowed_chi2_kf", "cusum_kf", "mewma_kf", "reacquire_kf",
            "cusum_reacquire_kf", "widen_kf", "brake_kf")  # fmt: skip
NOISY = {"range_sd": 0.38, "speed_sd": 0.14}  # 1.5 % of 25 m, and the largest published figure of range rate at 77 GHz [m, m/s]
DETECTORS = ("chi2_kf", "chi2_kf_sparse", "windowed_chi2_kf", "cusum_kf", "mewma_kf", "rkf", "imm")
RECORDINGS = (("asta-string", "asta-braking"), ("comma2k19-radar",))  # of one rate each
RESAMPLES, GAPS = 2000, (1.2, 3.0)  # time gaps [s] of the comparison with all else equal


def crashed(scenario: Scenario, defence: str, attack: str, dose: int, episodes: int) -> np.ndarray | None:
    """Collisions (B,) of report episodes; None where the pairing has no meaning."""
    guard, rival = Spec("defence", defence), Spec("attack", attack)
    made = rival.make()
    place = scenario.with_threat(budget=dose, knowledge=getattr(made, "knowledge", rival.entry.knowledge))
    try:
        trace = rollout(place.loop(guard.make(), guard.entry.uses), made, draws.keys("report", range(episodes)))
    except NotApplicable:
        return None
    return METRICS["crashed"](trace) > 0.0


def harms(scenario: Scenario, attacks: Sequence[str], dose: int, episodes: int, defences: Sequence[str] = DEFENCES) -> dict[str, dict[str, str]]:
    """For each defence and attack the episodes with a collision, a 0 or 1 each."""
    out: dict[str, dict[str, str]] = {}
    for defence in defences:
        held = {attack: crashed(scenario, defence, attack, dose, episodes) for attack in attacks}
        out[defence] = {attack: "".join(map(str, hit.astype(int))) for attack, hit in held.items() if hit is not None}
        worst = max(out[defence], key=lambda attack: out[defence][attack].count("1"))
        print(f"  {scenario.name} dose {dose}: {defence} {out[defence][worst].count('1')} of {episodes} under {worst}", file=sys.stderr, flush=True)
    return out


def part_fit(options: argparse.Namespace) -> dict[str, Any]:
    return fit.fit()


def part_alarms(options: argparse.Namespace) -> dict[str, Any]:
    """Thresholds of one false alarm an hour on the synthetic road, counted on recordings without an attack."""
    out: dict[str, Any] = {"hours": 1.0, "defences": {}}
    for names in RECORDINGS:
        recordings = [(name, recording) for name in names for recording in read(name)]
        dt = recordings[0][1].dt
        for defence in DETECTORS:
            try:
                found = detect_log.at_hours(defence, dt, Noise(), 1.0, onsets=options.onsets)
                bench = detect_log.Bench(Spec("defence", defence).make(), Spec("defence", defence).entry.uses, defence, (), 1, lambda *_: None)
                guard = bench.at(found["threshold"])
            except (NotApplicable, ValueError) as error:
                out["defences"].setdefault(defence, {})[f"{dt:g}"] = {"left out": str(error)}
                continue
            alarms, hours, each, when = 0, 0.0, {}, {}
            for name, recording in recordings:
                held = cut(recording, Noise(), None)
                threat = detect_log.threat_of(detect_log.Settings(), dt, held.plant.gap.shape[1] - 1)
                trace = rollout(loop_over(held, guard, bench.uses, threat), Spec("attack", "none").make(), rows(held))
                row = detect_log.figures(detect_log.Played(recording.name, defence, "none", held, trace, detect_log.smoothed(held)), dt)
                alarms, hours = alarms + row["alarms"], hours + row["hours"]
                when.setdefault(name, []).extend(row["alarm_times"])
                each[f"{name} {recording.name}".strip()] = {key: row[key] for key in ("alarms", "alarm_times", "hours", "alarm_share")}
            events = sum(map(detect_log.events_of, when.values()))  # alarms of all cars of a drive
            low, high = mean_time(events, hours)
            out["defences"].setdefault(defence, {})[f"{dt:g}"] = {
                "threshold": found["threshold"], "synthetic": found["measured"], "synthetic_fresh": found["fresh"], "alarms": alarms, "events": events, "hours": hours,
                "per_hour": events / hours, "low": 0.0 if high is None else 1.0 / high, "high": 1.0 / low, "recordings": each,
            }  # fmt: skip
            print(f"  {defence} at {dt:g} s: {alarms} alarms, {events} events in {hours:.3f} h", file=sys.stderr, flush=True)
    return out


def part_order(options: argparse.Namespace) -> dict[str, Any]:
    """Each defence under the scripts of its suite, on the synthetic 3 s road, and on recorded roads at 1.2 s with one and five cars."""
    old, new = load_suite("car-following-v0"), load_suite("road-v0")
    synthetic = load_scenario("gusty-stop-and-go-v0").with_threat(**old.threat)
    black = [text for text in old.attacks if not Spec("attack", text).entry.learned and Spec("attack", text).entry.knowledge == "black"]
    mine = [text for text in new.attacks if Spec("attack", text).entry.knowledge == "black"]
    places = {
        "synthetic": (synthetic, black, old.doses, options.episodes), "road": (load_scenario("road-following-v0"), mine, new.doses, options.episodes),
        "string": (load_scenario("road-string-v0"), mine, new.doses, max(10, options.episodes // 2)),
    }  # fmt: skip
    out: dict[str, Any] = {"seconds": {"synthetic": [0.1 * d for d in old.doses], "road": [0.05 * d for d in new.doses]}, "attacks": {"synthetic": black, "road": mine}}
    out["harm"] = {name: {str(dose): harms(place, attacks, dose, n) for dose in doses} for name, (place, attacks, doses, n) in places.items()}
    out["summary"] = summary(out["harm"], options.episodes)
    return out


Harm = dict[str, dict[str, dict[str, str]]]  # dose, defence, attack -> the episodes with a collision, a 0 or 1 each


def scores(doses: Harm, pick: Any = slice(None)) -> dict[str, float]:
    """The mean over doses of the share of undamaged episodes under the worst attack, of each defence; `pick`: of these episodes."""
    each = [{
        defence: 1.0 - float(np.array([np.frombuffer(hits.encode(), np.uint8) - 48 for hits in attacks.values()])[:, pick].mean(axis=1).max())
        for defence, attacks in held.items()
    } for held in doses.values()]  # fmt: skip
    return {defence: float(np.mean([part[defence] for part in each])) for defence in each[0]}


def resampled(held: Harm, rng: np.random.Generator, blocks: list[np.ndarray] | None) -> dict[str, float]:
    """Scores on resampled episodes, the same for all defences, attacks and doses: whole blocks of a recording, or single episodes."""
    count = len(next(iter(next(iter(next(iter(held.values())).values())).values())))
    if blocks is None:
        return scores(held, rng.integers(0, count, count))
    some = [block[block < count] for block in blocks]
    some = [block for block in some if len(block)]
    return scores(held, np.concatenate([some[i] for i in rng.integers(0, len(some), len(some))]))


def report_blocks(episodes: int) -> list[np.ndarray]:
    """Report episodes by the block of the recording in which they begin."""
    place = load_scenario("road-following-v0")
    begun = place.loop(Spec("defence", "kf").make(), ()).start(draws.keys("report", range(episodes))).manoeuvre.at
    joined = [block for block in place.manoeuvre.blocks(place.plant.dt)[1] if block.purpose == "report"]
    return [np.flatnonzero((begun >= block.first) & (begun < block.last)) for block in joined]


def correlations(harm: dict[str, Harm], pairs: Sequence[tuple[str, str]], episodes: int) -> dict[str, Any]:
    """Rank correlations of the scores in pairs of places, and the last less the first, with intervals.

    Defences are resampled, and episodes: by blocks on the recorded road, one by one on the synthetic one. All pairs share what is drawn.
    """
    base, blocks = {name: scores(held) for name, held in harm.items()}, report_blocks(episodes)
    names = list(next(iter(base.values())))
    rng, drawn = np.random.default_rng(0), []
    for _ in range(RESAMPLES):
        some = [names[i] for i in rng.integers(0, len(names), len(names))]
        own = {name: resampled(held, rng, None if name == "synthetic" else blocks) for name, held in harm.items()}
        columns = {name: [part[defence] for defence in some] for name, part in own.items()}
        if all(len(set(column)) > 1 for column in columns.values()):
            drawn.append([spearmanr(columns[one], columns[two]).statistic for one, two in pairs])
    table = np.array(drawn)
    low, high = np.quantile(table, [0.025, 0.975], axis=0)
    out: dict[str, Any] = {}
    for i, (one, two) in enumerate(pairs):
        x, y = ([base[place][name] for name in names] for place in (one, two))
        out[f"{one}, {two}"] = {"spearman": float(spearmanr(x, y).statistic), "spearman_interval": [float(low[i]), float(high[i])],
                                "kendall": float(kendalltau(x, y).statistic)}  # fmt: skip
    if len(pairs) > 1:
        first, last = (out[f"{one}, {two}"]["spearman"] for one, two in (pairs[0], pairs[-1]))
        out["last less first"] = {"spearman": last - first, "spearman_interval": [float(x) for x in np.quantile(table[:, -1] - table[:, 0], [0.025, 0.975])]}
    return out


def summary(harm: dict[str, Harm], episodes: int) -> dict[str, Any]:
    """Scores of each place, and rank correlations with intervals."""
    pairs = (("synthetic", "road"), ("synthetic", "string"), ("road", "string"))
    return {"scores": {name: scores(doses) for name, doses in harm.items()}, "defences": len(DEFENCES), "correlation": correlations(harm, pairs, episodes)}


def at_gap(gap: float) -> tuple[Scenario, list[str]]:
    """The car of road-v0 at another time gap [s], and the black-box scripts of the suite; a trigger at a gap moves with it."""
    base, threshold = load_scenario("road-following-v0"), f"threshold={round(3.5 + 21.5 * gap / 1.2, 1):g}"  # met at the speed at which 25 m are at 1.2 s
    scripts = [text for text in load_suite("road-v0").attacks if Spec("attack", text).entry.knowledge == "black"]
    place = dataclasses.replace(base, controller=dataclasses.replace(base.controller, headway=gap), plant=dataclasses.replace(base.plant, time_gap=gap))
    return place, [text.replace("threshold=25", threshold) for text in scripts]


def part_headway(options: argparse.Namespace) -> dict[str, Any]:
    """The order of the defences at 1.2 and at 3 s: same car, sensor, leaders, and kinds and sizes of attacks. By blocks of the recording too.

    What was played at 1.2 s is that of the part `order`: the same scenario, scripts and episodes.
    """
    order = json.loads((options.out / "order.json").read_text(encoding="utf-8"))
    near, far = GAPS
    assert at_gap(near) == (load_scenario("road-following-v0"), order["attacks"]["road"])
    place, attacks = at_gap(far)
    held = {"synthetic": order["harm"]["synthetic"], f"{near:g}": order["harm"]["road"],
            f"{far:g}": {str(dose): harms(place, attacks, dose, options.episodes) for dose in load_suite("road-v0").doses}}  # fmt: skip
    pairs = ("synthetic", f"{near:g}"), (f"{near:g}", f"{far:g}")
    out: dict[str, Any] = {"scores": {name: scores(part) for name, part in held.items()}, "correlation": correlations(held, pairs, options.episodes)}
    out["blocks"] = []
    for mine in report_blocks(options.episodes):
        found = [scores(held[f"{gap:g}"], mine) for gap in GAPS]
        out["blocks"].append({"episodes": len(mine), "spearman": float(spearmanr(*([part[name] for name in DEFENCES] for part in found)).statistic)})
    return out | {"harm": held[f"{far:g}"]}


def part_boards(options: argparse.Namespace) -> dict[str, Any]:
    """The order of the defences that both boards rank, of car following and of recorded roads: searched black-box attacks, mean over doses."""
    one, two = (load(ROOT / "results" / name / "board.json.xz") for name in ("car-following-v1", "road-v0"))
    held = [
        {entry["defence"]: float(np.mean([rate["undamaged"]["value"] for rate in entry["rates"] if rate["knowledge"] == "black"]))
         for entry in board["entries"] if entry["status"] == "ranked"} for board in (one, two)
    ]  # fmt: skip
    names = [name for name in held[0] if name in held[1]]
    x, y = (np.array([part[name] for name in names]) for part in held)
    rng, drawn = np.random.default_rng(0), []
    for _ in range(RESAMPLES):
        some = rng.integers(0, len(names), len(names))
        if len(set(x[some])) > 1 and len(set(y[some])) > 1:
            drawn.append(spearmanr(x[some], y[some]).statistic)
    low, high = np.quantile(drawn, [0.025, 0.975])
    return {
        "undamaged": {name: [float(a), float(b)] for name, a, b in zip(names, x, y, strict=True)},
        "spearman": float(spearmanr(x, y).statistic), "spearman_interval": [float(low), float(high)],
    }  # fmt: skip


def part_gaps(options: argparse.Namespace) -> dict[str, Any]:
    """Collisions by time gap: the car of road-v0 at 0.8 to 3 s, under the worst script of the suite at each dose."""
    suite, out = load_suite("road-v0"), {}
    for gap in (0.8, 1.2, 2.0, 3.0):
        place, attacks = at_gap(gap)
        out[f"{gap:g}"] = {str(dose): {
            defence: 1.0 - share
            for defence, share in scores({"": harms(place, attacks, dose, options.episodes, ("kf", "chi2_kf", "cusum_kf", "rkf"))}).items()
        } for dose in suite.doses}  # fmt: skip
    return out


def part_aeb(options: argparse.Namespace) -> dict[str, Any]:
    """Collisions and emergency brakings without an emergency brake, on its own sensor, and on the attacked one."""
    suite, out = load_suite("road-aeb-v0"), {}
    for name in ("road-following-v0", "road-aeb-own-v0", "road-aeb-shared-v0"):
        for defence in ("kf", "chi2_kf"):
            for attack in suite.attacks:
                guard, rival = Spec("defence", defence), Spec("attack", attack)
                place = load_scenario(name).with_threat(budget=80)
                trace = rollout(place.loop(guard.make(), guard.entry.uses), rival.make(), draws.keys("report", range(options.episodes)))
                speed = METRICS["impact_speed"](trace)
                out[f"{name}, {defence}, {attack}"] = {
                    "collisions": float(METRICS["collided"](trace).mean()), "mean_impact_speed": float(np.nanmean(speed)) if np.isfinite(speed).any() else None,
                    "brakings": float((np.where(trace.live[:, :, None], trace.signals["accel"], 0.0) < -5.5).any(axis=(0, 2)).mean()),
                }  # fmt: skip
    return out


def part_noise(options: argparse.Namespace) -> dict[str, Any]:
    """Collisions with a noisier radar, under the worst attack without knowledge that the board's searches found with the usual one."""
    suite, out = load_suite("road-v0"), {}
    usual = load_scenario("road-following-v0")
    noisy = dataclasses.replace(usual, sensor=dataclasses.replace(usual.sensor, **NOISY))
    for line in load(ROOT / "results" / "road-v0" / "board.json.xz")["searches"]:
        (cell,) = [cell for cell in line["cells"] if (cell["scenario"], cell["dose"]) == (usual.name, 40)]
        found = [one["attack"] for one in cell["members"] if one["attack"] and (one["knowledge"] == "black" or one["member"] == "gradient")]
        guard, share = Spec("defence", line["defence"]), {}
        for name, place in (("usual", usual), ("noisy", noisy)):
            loop = place.with_threat(**(suite.granted | {"budget": 40})).loop(guard.make(), guard.entry.uses)
            share[name] = max(
                float(METRICS["collided"](rollout(loop, Spec("attack", text).make(), draws.keys("report", range(options.episodes)))).mean())
                for text in found
            )  # fmt: skip
        out[line["defence"]] = share
    return {"noisy": NOISY, "collisions": out}


def part_speed(options: argparse.Namespace) -> dict[str, Any]:
    """Million steps/s of random actions through the environment, 4096 episodes, one core; the median of three."""
    import gymnasium

    out = {}
    for name in ("road-following-v0", "road-string-v0"):
        for defence in ("kf", "chi2_kf", "cusum_kf"):
            env = gymnasium.make_vec("tailgate:tailgate/CarFollowing-v0", num_envs=4096, scenario=name, defence=defence)
            env.reset(seed=0)
            rng, rates = np.random.default_rng(0), []
            actions = [rng.integers(0, env.single_action_space.n, 4096) for _ in range(20)]
            for _ in range(4):
                begin = time.perf_counter()
                for action in actions * 5:
                    env.step(action)
                rates.append(100 * 4096 / (time.perf_counter() - begin) / 1e6)
            out[f"{name}, {defence}"] = {"engine": env.engine, "million_steps_a_second": float(np.median(rates[1:]))}
    return out


PARTS = {"fit": part_fit, "alarms": part_alarms, "order": part_order, "headway": part_headway, "boards": part_boards, "gaps": part_gaps, "aeb": part_aeb, "noise": part_noise, "speed": part_speed}


def draw_order(held: dict[str, Any]) -> bytes:
    figure, axes = canvas(10.5, 4.8, 1, 2)
    scored = held["summary"]["scores"]
    for ax, other, title in zip(axes[0], ("road", "string"), ("recorded road at 1.2 s, one car", "five cars"), strict=True):
        found = held["summary"]["correlation"][f"synthetic, {other}"]
        names = list(scored["synthetic"])
        x, y = ([100.0 * scored[part][name] for name in names] for part in ("synthetic", other))
        ax.scatter(x, y, color="C0", s=22)
        for i, name in enumerate(names):
            left = any(0.0 < x[j] - x[i] < 9.0 and abs(y[j] - y[i]) < 4.0 for j in range(len(names)))  # a neighbour's room
            ax.annotate(name, (x[i], y[i]), (-4 if left else 4, 3), fontsize=7, textcoords="offset points", ha="right" if left else "left")
        low, high = found["spearman_interval"]
        ax.set_title(f"{title}: rank correlation {found['spearman']:+.2f} [{low:+.2f}, {high:+.2f}]", fontsize=9)
        ax.set(xlabel="undamaged on the synthetic 3 s road [%]", ylabel=f"undamaged, {title} [%]", xlim=(30, 125), ylim=(-5, 105))
        ax.grid(alpha=0.3)
    return png(figure)


def draw_gaps(held: dict[str, Any]) -> bytes:
    figure, axes = canvas(10.5, 3.4, 1, 3, sharey=True)
    for ax, dose in zip(axes[0], next(iter(held.values())), strict=True):
        gaps = [float(gap) for gap in held]
        for defence in held[next(iter(held))][dose]:
            ax.plot(gaps, [100.0 * held[gap][dose][defence] for gap in held], marker="o", markersize=4, label=defence)
        ax.set(xlabel="time gap [s]", title=f"{0.05 * int(dose):g} s of attack", ylim=(-3, 103))
        ax.grid(alpha=0.3)
    axes[0, 0].set_ylabel("collisions, worst script [%]")
    axes[0, -1].legend(fontsize=8)
    return png(figure)


DRAWN = {"fit": ("roads-fit.png", fit.draw), "order": ("roads-order.png", draw_order), "gaps": ("roads-gaps.png", draw_gaps)}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "roads-v0")
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--onsets", type=int, default=40, help="false alarms that a threshold is found on")
    parser.add_argument("--figures", action="store_true", help="draw into docs/images")
    options = parser.parse_args()
    for name in options.parts.split(","):
        path = options.out / f"{name}.json"
        if path.is_file():
            held = json.loads(path.read_text(encoding="utf-8"))
        else:
            begin = time.perf_counter()
            held = PARTS[name](options)
            write_atomic(path, json.dumps(held, indent=1).encode() + b"\n")
            print(f"{path}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
        if options.figures and name in DRAWN:
            file, draw = DRAWN[name]
            write_atomic(ROOT / "docs" / "images" / file, draw(held))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
