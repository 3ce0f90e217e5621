"""The related works of the thesis's second chapter, played: results/literature-v0 and the figures and the table of docs/literature.md.

    python benchmarks/literature.py [--method NAME ...] [--no-search] [--show] [--out results/literature-v0] [--scratch DIR]

Each method has four parts, each in its own file. Parts that exist are not played again:

* calibrated: the threshold for one false alarm in HOURS of clean driving, and the clean errors
* compromised: the position error under a bias, and under a ramp, on 0, 1, ..., 7 of the sensors, the most accurate first
* listed: a bias of -30 on two sensors for 50 steps: collisions, and if the alarm sounds
* searched: what scripts, programs and feedbacks of the standard ensemble, budget quick, do where two sensors can be reached. With
  --no-search only what exists is shown

--show plays nothing: figure and table are of the parts that exist.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.files import writable_directory, write_atomic
from tailgate.base.plots import canvas, png
from tailgate.base.progress import progress
from tailgate.base.reading import load_json
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario, load_suite
from tailgate.core.spec_text import split_text
from tailgate.ensemble.members import BUDGETS, Hunt, harvest
from tailgate.ensemble.standard import jobs_of
from tailgate.evaluation.calibrate import calibrate
from tailgate.evaluation.stats import proportion
from tailgate.play.trace import Trace, rollout

METHODS = {
    "kf": "kf",
    "rkf": "rkf",
    "chi2_kf": "chi2_kf",
    "chi2_kf_sparse": "chi2_kf_sparse",
    "bernoulli": "bernoulli",
    "kf_bank": "kf_bank:s=2",
    "kf_bank, sliding": "kf_bank:s=2,sliding=true",
    "observer_bank": "observer_bank:s=2",
    "l1_decoder": "l1_decoder:s=2,window=10",
    "etpg": "etpg:s=2,window=10",
    "etpl": "etpl:s=2,window=10",
    "l0_robust": "l0_robust:s=2,window=10",
    "minimax": "minimax:attacked=2",
    "envelope": "envelope:path=redundant",
}
SLOW = ("l0_robust",)  # is not traced: a search against it would take days
ORDER = ("lidar", "radar_long", "wheels", "radar_short", "v2v", "gnss", "camera")  # the most accurate first
SCENARIO, SUITE, DOSE = "redundant-two-v0", "redundant-v0", 50
HOURS, ONSETS, EPISODES = 0.1, 60, 100
SEEDS, HORIZON, FIRST, LENGTH = 20, 300, 100, 100
LIES = {"bias": "fdi:value=-10", "ramp": "fdi_ramp:rate=-0.1"}  # the ramp reaches -10 at its end
BUDGET, MEMBERS = "quick", ("scripts", "programs", "feedback")  # all members take a quarter of an hour for each method
LISTED = "fdi:trigger=near,threshold=40,value=-30"


def with_threshold(text: str, field: str, value: float) -> str:
    """Return the text of a defence with another threshold."""
    _, parameters = split_text(text)
    return f"{text}{',' if parameters else ':'}{field}={value:.6g}"


def errors(trace: Trace, first: int = 0, last: int | None = None) -> list[float]:
    """Return the root mean square of the position's error [m] of each episode, over the steps that were driven."""
    off = np.where(trace.live, trace.estimate[..., 0, 0] - trace.truth[..., 0, 0], np.nan)[first:last]
    return np.sqrt(np.nanmean(off * off, axis=0)).tolist()


def quantiles(values: list[float]) -> list[float]:
    """Return the quartiles, rounded."""
    return [float(f"{x:.4g}") for x in np.quantile(values, [0.25, 0.5, 0.75])]


def played(place: Scenario, text: str, against: str, seeds: int, terminate: bool = True) -> Trace:
    """Return report episodes of a defence under an attack."""
    defence = Spec("defence", text)
    loop = place.loop(defence.make(), defence.entry.uses)
    return rollout(loop, Spec("attack", against).make(), draws.keys("report", range(seeds)), terminate=terminate)


def calibrated(text: str) -> dict[str, Any]:
    place = load_scenario(SCENARIO)
    defence = Spec("defence", text).make()
    out: dict[str, Any] = {"defence": text, "clean_rmse": quantiles(errors(played(place, text, "none", EPISODES)))}
    if text != "kf" and not text.startswith("minimax"):
        found = calibrate(defence, HOURS, scenarios=(SCENARIO,), onsets=ONSETS)
        out |= {"field": found.field, "threshold": found.threshold, "settled": found.settled, "measured": found.measured.as_data()}
        out["defence"] = with_threshold(text, found.field, found.threshold)
    return out


def compromised(text: str) -> dict[str, Any]:
    place, rows = dataclasses.replace(load_scenario(SCENARIO), horizon=HORIZON), []
    for count in range(len(ORDER) + 1):
        here = place.with_threat(targets=ORDER[:count] or ("lidar",), budget=None)
        for lie, attack in LIES.items():
            against = f"{attack},start_step={FIRST},length={LENGTH}" if count else "none"
            off = quantiles(errors(played(here, text, against, SEEDS, False), FIRST, FIRST + LENGTH))
            rows.append({"sensors": count, "lie": lie, "rmse": off})
    return {"defence": text, "order": list(ORDER), "lies": LIES, "rows": rows}


def listed(text: str) -> dict[str, Any]:
    place = load_scenario(SCENARIO).with_threat(**(load_suite(SUITE).granted | {"budget": DOSE}))
    trace = played(place, text, LISTED, EPISODES)
    struck = (trace.kind != 0) & trace.live
    alarmed, collided = (struck & trace.alarm[..., 0]).any(axis=0), (trace.gap[..., 0] <= 0.0).any(axis=0)
    return {"defence": text, "dose": DOSE, "attack": LISTED, "collisions": float(collided.mean()), "alarm": float(alarmed.mean())}


def searched(text: str, scratch: Path) -> dict[str, Any]:
    folder = writable_directory(scratch, "--scratch")
    suite = load_suite(SUITE)
    arena = jobs_of(suite, text, (SCENARIO,), (DOSE,), BUDGET, 0)[0].arena
    members = harvest(Hunt(arena, BUDGETS[BUDGET], 0, folder, only=MEMBERS))

    def harm(against: str) -> dict[str, Any]:
        share = proportion(round(arena.confirmed(against, "report", 0, EPISODES)[0] * EPISODES), EPISODES)
        return {"attack": against.replace(f"{folder}/", ""), "damage": share.value, "low": share.low, "high": share.high}

    best = max((one.found[0] for one in members if one.found), key=lambda found: found.score)
    tried = {one: arena.confirmed(one, "select", 0, EPISODES)[1] for one in suite.attacks if Spec("attack", one).entry.knowledge == "black"}
    who = [{"member": one.member, "knowledge": one.knowledge, **harm(one.found[0].attack)} for one in members if one.found]
    out = {"defence": text, "budget": BUDGET, "only": list(MEMBERS), "listed": harm(max(tried, key=lambda one: tried[one]))}
    return out | {"found": harm(best.attack), "members": who}


def part(out: Path, name: str, method: str, make: Callable[[], dict[str, Any]] | None) -> dict[str, Any] | None:
    """Return a part of a method, from its file where there is one; none where there is not and nothing makes it."""
    path = out / name / f"{method.replace(', ', '-')}.json"
    if path.is_file():
        held: dict[str, Any] = load_json(path)
        return held
    if make is None:
        return None
    made = make()
    write_atomic(path, json.dumps(made, indent=1).encode() + b"\n")
    return made


def figure(out: Path, held: dict[str, dict[str, Any]]) -> None:
    """Draw the error over the number of compromised sensors, and what the ensemble damages."""
    shown, axes = canvas(13.0, 4.8, 1, 3, width_ratios=[1.2, 1.2, 1.0])
    for ax, (lie, attack) in zip(axes[0], LIES.items(), strict=False):
        for i, (name, parts) in enumerate(held.items()):
            if parts["compromised"] is not None:
                middle = [row["rmse"][1] for row in parts["compromised"]["rows"] if row["lie"] == lie]
                line = f"{'osD^v<>PX*hp8d'[i % 14]}{'-' if i < 10 else ':'}"
                ax.plot(range(len(middle)), middle, line, color=f"C{i % 10}", markersize=4, label=name)
        ax.axvspan(2.5, 7.2, color="0.92", zorder=0)
        ax.set(yscale="log", xlabel=f"sensors of 7 with {attack}", ylabel="position RMSE during the attack [m], median")
        ax.set_title(f"a {lie}; grey: more than the two that can be corrected", fontsize=9)
        ax.grid(alpha=0.3)
    _found(axes[0, 2], {name: parts["searched"] for name, parts in held.items() if parts["searched"]})
    shown.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", fontsize=8, ncols=7)
    write_atomic(out / "literature.png", png(shown))


def _found(ax: Any, found: dict[str, dict[str, Any]]) -> None:
    """Draw what the best listed and the best found attack damage."""
    for i, one in enumerate(found.values()):
        for key, colour, mark in (("listed", "C0", "o"), ("found", "C3", "s")):
            if one[key]:
                value, low, high = (100.0 * one[key][name] for name in ("damage", "low", "high"))
                ax.errorbar(value, i, xerr=[[value - low], [high - value]], color=colour, marker=mark, label=key if i == 0 else None)
    ax.set_yticks(range(len(found)), list(found))
    ax.set(xlabel=f"episodes damaged [%], two sensors, {DOSE} steps", xlim=(-2, 102))
    ax.set_title("the best listed and the best found attack", fontsize=10)
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3, axis="x")


def table(held: dict[str, dict[str, Any]]) -> str:
    """Return the table of the page, as Markdown."""
    lines = [
        "| method | clean RMSE [m] | threshold | alarm, listed | best listed | best found | by |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, parts in held.items():
        clean, cell, struck = parts["calibrated"], parts["searched"], parts["listed"]
        if clean is None:
            continue
        limit = f"{clean['threshold']:.4g}{'' if clean['settled'] else ' (not settled)'}" if "threshold" in clean else "none"
        cells = [name, f"{clean['clean_rmse'][1]:.3f}", limit, f"{100 * struck['alarm']:.0f} %" if struck else "-"]
        for key in ("listed", "found"):
            found = cell and cell[key]
            cells.append(f"{100 * found['damage']:.0f} % ({100 * found['low']:.0f} to {100 * found['high']:.0f})" if found else "-")
        best = cell and cell["found"] and next((m for m in cell["members"] if m["attack"] == cell["found"]["attack"]), None)
        cells.append(f"{best['member']}, {best['knowledge']}" if best else "-")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", action="append", choices=list(METHODS), help="only this one (repeatable; default: all)")
    parser.add_argument("--no-search", action="store_true", help="show only the searches that exist")
    parser.add_argument("--show", action="store_true", help="play nothing; show the parts that exist")
    parser.add_argument("--out", type=Path, default=Path("results/literature-v0"), help="folder of the results")
    parser.add_argument("--scratch", type=Path, default=Path("runs/literature"), help="folder of the searches and of what they find")
    options = parser.parse_args()
    names = options.method or list(METHODS)
    held: dict[str, dict[str, Any]] = {name: {} for name in names}
    makers: dict[str, Callable[[str], dict[str, Any]]] = {
        "calibrated": lambda name: calibrated(METHODS[name]),
        "compromised": lambda name: compromised(held[name]["calibrated"]["defence"]),
        "listed": lambda name: listed(held[name]["calibrated"]["defence"]),
        "searched": lambda name: searched(held[name]["calibrated"]["defence"], options.scratch / name.replace(", ", "-")),
    }
    try:
        with progress(Console(stderr=True)) as update:
            for number, (kind, make) in enumerate(makers.items()):
                writable_directory(options.out / kind, "--out")
                for done, name in enumerate(names):
                    update(kind, number * len(names) + done, len(makers) * len(names), name)
                    left_out = options.show or (kind == "searched" and (options.no_search or name in SLOW))
                    held[name][kind] = part(options.out, kind, name, None if left_out else partial(make, name))
    except (InputError, NotApplicable) as error:
        print(f"literature: error: {error}", file=sys.stderr)
        return 2
    if not options.method:
        figure(options.out, held)
        write_atomic(options.out / "table.md", table(held).encode())
    print(table(held), end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
