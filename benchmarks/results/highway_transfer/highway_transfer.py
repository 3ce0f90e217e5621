"""Does the fast radar car tell the truth about the road scene? Attackers of either are played on both, and the defences' order is compared.

    python benchmarks/results/highway_transfer/highway_transfer.py [--episodes 8] [--runs runs/highway-transfer] [--out FILE]

Three worlds, the same kinds of attack and bounds: `radar-following-v0` as published, in steps of 1 s, at a dose of 9 s (3 s break one
defence there); the same plant tuned to the scene (0.1 s, its controller, a leader who brakes as hard); and `highway-braking-v0`, both at
3 s. Attackers are trained by the cross-entropy method, many episodes in the fast worlds and few in the scene. Finished trainings and cells
are not made again.
Writes the record, and its picture for the documentation.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from scipy.stats import kendalltau

from tailgate.base.files import write_atomic
from tailgate.base.plots import MARKERS, canvas, png
from tailgate.base.progress import cells as words
from tailgate.base.progress import progress
from tailgate.bench.study import arguments, made_by, write_record
from tailgate.core import Array
from tailgate.core.scenario import Suite
from tailgate.evaluation.baselines import outcomes
from tailgate.evaluation.cells import cells_of, run
from tailgate.evaluation.stats import proportion
from tailgate.training.adaptive import train_against
from tailgate.training.train import TrainConfig, load_config

DEFENCES = ("none", "kf", "rkf", "imm", "chi2_kf", "reacquire_kf", "brake_kf", "cra")
AGAINST = {"radar": ("chi2_kf", "cra"), "tuned": ("kf", "chi2_kf", "cra"), "highway": ("chi2_kf",)}  # what attackers are trained against
GENERATIONS = {"radar": 15, "tuned": 12, "highway": 4}
GRANTED = {"kinds": ["dos_hold", "fdi", "noise_jam", "echo_delay"], "fdi_bound": 30.0, "delay_bound": 60.0}
SCRIPTS = {  # label: attack, with a threshold that fits the world
    "fdi near": "fdi:trigger=near,threshold={near},value=30",
    "fdi at braking": "fdi:trigger=leader_braking,threshold={braking},value=30",
    "echo at braking": "echo_delay:trigger=leader_braking,threshold={braking},delay=60",
}
TUNED = """\
about: The radar car in the scene's steps, driven by its controller, behind a leader who brakes as hard.
plant: {name: radar_following, dt: 0.1, gap: 55.0, lead_speed: 24.5, speed: 25.0, rear: true, process_var: [3.0e-3, 1.0e-1, 3.0, 1.0e-6]}
sensor: {name: fmcw_radar}
controller: {name: acc_radar, headway: 2.0, set_speed: 28.0}
manoeuvre: {name: stop_and_go, cruise: [2.0, 8.0], dwell: [0.0, 1.0], decel: 6.0, accel_rate: 1.5, low_speed: 12.0, cruise_speed: 24.5}
horizon: 500
threat_model: {onset: 50, end: 420}
"""
CUT_INS = ("none", "fdi at braking")  # what is played on highway-cut-in-v0, which no fast world has an equal of
LEVEL = 0.95
RESAMPLES = 2000


class World(NamedTuple):
    """Where attackers are trained and played."""

    name: str
    scenario: str
    dose: int  # [steps]
    interval: int  # steps that a decision holds
    near: float  # [m]
    braking: float  # [m/s^2]
    episodes: int  # of a cell


def worlds(runs: Path, episodes: int, fast: int) -> dict[str, World]:
    """Both fast ones, and the scene."""
    tuned = runs / "tuned.yaml"
    tuned.parent.mkdir(parents=True, exist_ok=True)
    if not tuned.is_file() or tuned.read_text(encoding="utf-8") != TUNED:
        write_atomic(tuned, TUNED.encode())
    return {
        "radar": World("radar", "radar-following-v0", 9, 1, 70.0, 0.3, fast),
        "tuned": World("tuned", str(tuned), 30, 5, 45.0, 1.0, fast),
        "highway": World("highway", "highway-braking-v0", 30, 5, 45.0, 1.0, episodes),
    }


def training(world: World, defence: str, runs: Path) -> TrainConfig:
    """A short search from nothing, whose generations are of 512 episodes in a fast world and of 64 in the scene."""
    fast, count = world.name != "highway", GENERATIONS[world.name]
    search = {"population": 32, "episodes": 16} if fast else {"population": 16, "episodes": 4}
    decisions = 240 if world.name == "radar" else 100  # of an episode without a collision
    most = count * search["population"] * search["episodes"] * decisions
    held = {"hidden": [], "sd": 2.0, "extra": 0.3, "extra_until": count}
    changes = [
        f"name={world.name}-{defence}", f"out={runs}", f"scenario={world.scenario}", f"defence={defence}", "learner=cem", "teacher=null",
        "gamma=1.0", "rivals=[]", "others=[]", "white_box=[]", "tensorboard=false", "workers=1", f"steps={most}",
        f"cem={json.dumps(search | held)}", f"threat={json.dumps(GRANTED | {'budget': world.dose})}",
        f"environment={json.dumps({'action': 'mode', 'value': 30.0, 'delay': 60.0, 'reward': 'min_gap', 'interval': world.interval})}",
    ]  # fmt: skip
    return load_config("radar", changes)


def stretched(path: Path, steps: int) -> Path:
    """The same policy, each decision of which holds for `steps`: what was trained in steps of 1 s then decides once a second at 0.1 s."""
    header = json.loads(path.read_text(encoding="utf-8"))
    header["action"]["interval"] = steps
    out = path.with_name(f"{path.stem}-every-{steps}.json")
    write_atomic(out, json.dumps(header, indent=1).encode() + b"\n")
    return out


def attacks_of(world: World, trained: dict[str, tuple[World, Path]]) -> dict[str, str]:
    """Label to attack, as this world plays it: scripts, and what was trained anywhere with decisions of the time that they had there."""
    out = {"none": "none"} | {label: text.format(near=world.near, braking=world.braking) for label, text in SCRIPTS.items()}
    for label, (origin, path) in trained.items():
        ratio = {"radar": 1.0, "tuned": 0.1, "highway": 0.1}
        steps = max(1, round(origin.interval * ratio[origin.name] / (0.1 * (10 if world.name == "radar" else 1))))
        held = path if steps == origin.interval else stretched(path, steps)
        out[label] = str(held)
    return out


def played(world: World, scenario: str, attacks: dict[str, str], options: argparse.Namespace, update: Any) -> dict[tuple[str, str], Array]:
    """(episodes,) of 0 and 1, collisions, by label and defence."""
    suite = Suite(f"transfer-{world.name}", "", (scenario,), (world.dose,), DEFENCES, tuple(attacks.values()), world.episodes, GRANTED)
    chosen = cells_of(suite)
    label = f"{world.name}, {Path(scenario).stem}"
    file = Path(options.runs) / f"rows-{label.replace(', ', '-')}.jsonl"
    rows = run(chosen, file, options.workers, lambda done, of: update(label, done, of, words(done, of)))
    names = {text: name for name, text in attacks.items()}
    return {
        (names[cell.attack], cell.defence): outcomes(rows[i * world.episodes : (i + 1) * world.episodes], "crashed")
        for i, cell in enumerate(chosen)
    }  # fmt: skip


def stack(found: dict[tuple[str, str], Array], labels: list[str]) -> Array:
    """(attacks, defences, episodes)."""
    return np.array([[found[label, defence] for defence in DEFENCES] for label in labels])


def tau(a: Array, b: Array) -> float:
    """Kendall's tau-b of two scores of the defences; 0 where one of them tells none apart."""
    found = float(kendalltau(a, b).statistic)
    return found if np.isfinite(found) else 0.0


def agreement(there: Array, here: Array, seed: int = 0) -> dict[str, Any]:
    """How well the order there is that here, by the mean over attacks and by the worst attack; bootstrap over the episodes of each.

    `itself` is the mean of the order on half of the episodes here against that on the other half: what so few episodes can show.
    """
    rng, out = np.random.default_rng(seed), {}
    for name, of in (("mean", lambda x: x.mean(axis=(0, 2))), ("worst", lambda x: x.mean(axis=2).max(axis=0))):
        drawn, itself = [], []
        for _ in range(RESAMPLES):
            some = [x[:, :, rng.integers(x.shape[2], size=x.shape[2])] for x in (there, here)]
            drawn.append(tau(of(some[0]), of(some[1])))
            order, half = rng.permutation(here.shape[2]), here.shape[2] // 2
            itself.append(tau(of(here[:, :, order[:half]]), of(here[:, :, order[half:]])))
        low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        out[name] = {
            "tau": tau(of(there), of(here)), "low": float(low), "high": float(high), "itself": float(np.mean(itself)),
            "there": dict(zip(DEFENCES, of(there).tolist(), strict=True)), "here": dict(zip(DEFENCES, of(here).tolist(), strict=True)),
        }  # fmt: skip
    flat = [x.mean(axis=2).ravel() for x in (there, here)]
    return out | {"cells": tau(*flat)}


def spread(x: Array) -> dict[str, float]:
    """Mean over attacks (attacks, episodes) with a bootstrap interval over episodes, which all attacks share."""
    rng, n = np.random.default_rng(0), x.shape[1]
    drawn = x.mean(axis=0)[rng.integers(n, size=(RESAMPLES, n))].mean(axis=1)
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return {"value": float(x.mean()), "low": float(low), "high": float(high)}


def rounded(x: Any) -> Any:
    """JSON data with four digits behind the point."""
    if isinstance(x, dict):
        return {key: rounded(value) for key, value in x.items()}
    return [rounded(value) for value in x] if isinstance(x, list) else round(x, 4) if isinstance(x, float) else x


def percent(held: dict[str, float]) -> tuple[float, ...]:
    """Value, low and high [%]."""
    return tuple(100.0 * held[key] for key in ("value", "low", "high"))


def picture(record: dict[str, Any]) -> bytes:
    """Above, a panel for each fast world: P(crash) of each defence there against here. Below, who trained where does what here."""
    figure, axes = canvas(12.5, 4.6, 1, 3)
    titles = {"radar": "radar-following-v0 (steps of 1 s)", "tuned": "the radar car tuned to the scene (0.1 s)"}
    for axis, (name, title) in zip(axes[0], titles.items(), strict=False):
        held = record["order"][name]
        for i, defence in enumerate(DEFENCES):
            (x, left, right), (y, below, above) = (percent(held["shares"][side][defence]) for side in ("there", "here"))
            axis.errorbar(
                x, y, xerr=[[x - left], [right - x]], yerr=[[y - below], [above - y]],
                marker=MARKERS[i], color=f"C{i}", capsize=2, linestyle="none", markersize=7, label=defence if axis is axes[0, 0] else None,
            )  # fmt: skip
        found = held["mean"]
        axis.plot([0, 100], [0, 100], color="black", linewidth=0.8, linestyle=":")
        axis.set(xlim=(-3, 103), ylim=(-3, 103), xlabel="collisions there [%]", ylabel="collisions on highway-braking-v0 [%]")
        axis.set_title(f"{title}\nKendall's tau {found['tau']:+.2f} ({found['low']:+.2f} to {found['high']:+.2f})", fontsize=10)
        axis.grid(alpha=0.3)
    axis, rows = axes[0, 2], record["attackers"]
    for i, row in enumerate(rows):
        value, low, high = percent(row["highway"])
        marker, colour = ("s", "C0") if row["kind"] == "script" else ("o", "C3")
        axis.errorbar(value, i, xerr=[[value - low], [high - value]], marker=marker, color=colour, capsize=3)
    axis.set_yticks(range(len(rows)), [row["attack"] for row in rows], fontsize=8)
    axis.set_ylim(len(rows) - 0.5, -0.5)
    axis.set(xlim=(-3, 103), xlabel="collisions on highway-braking-v0 [%]", title="each attack, mean over defences")
    axis.title.set_fontsize(10)
    axis.grid(axis="x", alpha=0.3)
    figure.legend(loc="outside lower center", fontsize=9, ncols=len(DEFENCES))
    return png(figure)


def main() -> None:
    parser = arguments(__file__, __doc__)
    parser.add_argument("--episodes", type=int, default=8, help="of a cell of the scene (default 8)")
    parser.add_argument("--fast-episodes", type=int, default=60, help="of a cell of a fast world (default 60)")
    parser.add_argument("--workers", type=int, default=1, help="processes (default 1); change no figure")
    parser.add_argument("--runs", default="runs/highway-transfer", help="where policies and rows lie")
    parser.add_argument("--picture", type=Path, default=Path("docs/images/highway-transfer.png"), help="where the picture goes")
    options = parser.parse_args()
    runs = Path(options.runs)
    places, seconds, trained = worlds(runs, options.episodes, options.fast_episodes), {}, {}
    with progress(Console(stderr=True)) as update:
        for name, world in places.items():
            begun = time.process_time()
            for defence in AGAINST[name]:
                (path,) = train_against([training(world, defence, runs)], update)
                trained[f"{name}, {defence}"] = (world, path)
            seconds[f"train, {name}"] = time.process_time() - begun
        found = {}
        for name, world in places.items():
            begun = time.process_time()
            found[name] = played(world, world.scenario, attacks_of(world, trained), options, update)
            seconds[f"play, {name}"] = time.process_time() - begun
        scene, begun = places["highway"], time.process_time()
        few = {label: text for label, text in attacks_of(scene, {}).items() if label in CUT_INS}
        found["cut-ins"] = played(scene, "highway-cut-in-v0", few, options, update)
        seconds["play, cut-ins"] = time.process_time() - begun
    record = recorded(found, trained, seconds, places, options)
    write_record(options.out, rounded(record), by_lines=True)
    write_atomic(options.picture, picture(record))
    for name, held in record["order"].items():
        found_there = {key: held[key] for key in ("mean", "worst") if key in held}
        print(name, {k: {f: round(v[f], 2) for f in ("tau", "low", "high", "itself")} for k, v in found_there.items()})
    print(json.dumps(record["seconds"]), file=sys.stderr)


def recorded(
    found: dict[str, dict[tuple[str, str], Array]], trained: dict[str, tuple[World, Path]], seconds: dict[str, float],
    places: dict[str, World], options: argparse.Namespace,
) -> dict[str, Any]:  # fmt: skip
    """The record, as JSON data."""
    labels = [*SCRIPTS, *trained]
    here = stack(found["highway"], labels)
    order: dict[str, Any] = {}
    for name in ("radar", "tuned"):
        there = stack(found[name], labels)
        shares = {
            side: {defence: spread(x[:, i]) for i, defence in enumerate(DEFENCES)} for side, x in (("there", there), ("here", here))
        }  # fmt: skip
        order[name] = agreement(there, here) | {"shares": shares}
        order[f"{name}, scripts alone"] = agreement(there[: len(SCRIPTS)], here[: len(SCRIPTS)])
    both = list(CUT_INS)
    order["cut-ins, from tuned"] = agreement(stack(found["tuned"], both), stack(found["cut-ins"], both))
    order["cut-ins, from highway-braking-v0"] = agreement(stack(found["highway"], both), stack(found["cut-ins"], both))
    attackers = [
        {
            "attack": label if label in SCRIPTS else f"learned: {label}", "kind": "learned" if label in trained else "script",
            **{name: spread(stack(found[name], [label])[0]) for name in places},
        }
        for label in labels
    ]  # fmt: skip
    cells: dict[str, Any] = {}  # collisions, with a 95 % interval (Clopper and Pearson)
    for world, table in found.items():
        for (label, defence), x in table.items():
            share = [round(value, 3) for value in proportion(int(x.sum()), len(x))]
            cells.setdefault(world, {}).setdefault(label, {})[defence] = share
    policies = [
        {"attack": label, "world": world.name, "decisions": json.loads(path.read_text(encoding="utf-8"))["training"]["steps"]}
        for label, (world, path) in trained.items()
    ]  # fmt: skip
    return {
        **made_by("highway-env", "numpy"), "workers": options.workers, "seconds": {k: round(v, 1) for k, v in seconds.items()},
        "worlds": {
            name: world._asdict() | {"scenario": Path(world.scenario).stem, "seeds": f"report 0 to {world.episodes - 1}"}
            for name, world in places.items()
        },
        "granted": GRANTED, "scripts": SCRIPTS, "training_seed": 0, "policies": policies, "order": order, "attackers": attackers,
        "cells": cells,
    }  # fmt: skip


if __name__ == "__main__":
    main()
