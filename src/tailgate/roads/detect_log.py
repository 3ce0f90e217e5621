"""Defences over recordings in the open loop: alarms an hour, delay of detection, errors against a smoother."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import yaml

from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.files import write_atomic
from tailgate.core import Array
from tailgate.core.registry import Spec
from tailgate.core.schema import build
from tailgate.core.threat import ThreatModel
from tailgate.evaluation.attack_free import Bench
from tailgate.evaluation.calibrate import calibrate
from tailgate.evaluation.stats import mean_time
from tailgate.play.trace import Trace, rollout
from tailgate.roads.recording import Recording
from tailgate.roads.replayed import Cut, Noise, cut, loop_over, process_var, rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SETTLING = 5.0  # of a filter, in which alarms do not count [s]
WINDOW = 60.0  # of a piece that is attacked [s]
ONSET = 10.0  # time at which an attack is granted [s]
DOSE = 4.0  # seconds of attack
ONE_EVENT = 5.0  # alarms within this time of each other are one event [s]
BOUND = 10.0  # of injected range and range rate, as in road-v0 [m], [m/s]
KINDS = ("dos_jam", "dos_hold", "dos_hold_fresh", "dropout", "fdi", "delay", "replay")
JERK_VAR = 0.5  # of the smoother: growth of the variance of the acceleration ahead [m^2/s^4 per s]


@dataclass(frozen=True)
class Settings:
    """How recordings are replayed; see `tailgate detect-log --help`."""

    noise: Noise = Noise()
    window: float = WINDOW
    dose: float = DOSE
    threat: tuple[tuple[str, Any], ...] = ()
    hours: float | None = None  # thresholds for one false alarm in this time on synthetic roads; none: as given


class Played(NamedTuple):
    """One defence against one attack (or none) over one recording."""

    recording: str
    defence: str
    attack: str
    pieces: Cut
    trace: Trace
    smooth: Array  # (R, K, 2) gap [m] and relative speed [m/s] of the smoother; NaN behind the end of a piece


def smoothed(held: Cut) -> Array:
    """Return gap and relative speed (R, K, 2) by the smoother of Rauch, Tung and Striebel (filterpy); NaN behind the end of a piece.

    Its state is place, speed and acceleration of the car ahead; the own place is the recorded speed, summed. No input is needed then.
    """
    from filterpy.kalman import KalmanFilter

    plant, dt = held.plant, held.plant.dt
    out = np.full((*plant.gap.shape, 2), np.nan)
    for i, length in enumerate(held.length.tolist()):
        gap, relative, speed, seen = (x[i, :length] for x in (plant.gap, plant.relative, plant.speed, plant.seen))
        own = np.concatenate([[0.0], np.cumsum(0.5 * dt * (speed[1:] + speed[:-1]))])
        filter_ = KalmanFilter(dim_x=3, dim_z=2)
        filter_.F = np.array([[1.0, dt, dt * dt / 2.0], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
        filter_.H, filter_.Q = np.eye(2, 3), np.diag([1e-8, 1e-8, JERK_VAR * dt])
        filter_.R = np.diag([plant.noise.range_sd**2, plant.noise.speed_sd**2])
        filter_.x = np.array([gap[0], relative[0] + speed[0], 0.0])
        filter_.P = np.diag([1.0, 1.0, 1.0])
        z = [np.array([gap[k] + own[k], relative[k] + speed[k]]) if seen[k] else None for k in range(length)]
        means, covariances, _, _ = filter_.batch_filter(z, update_first=True)
        x = filter_.rts_smoother(means, covariances)[0]
        out[i, :length] = np.stack([x[:, 0] - own, x[:, 1] - speed], axis=1)
    return out


def threat_of(settings: Settings, dt: float, horizon: int) -> ThreatModel:
    """Return the threat model of a replay: every kind of a wire, within the bounds of road-v0."""
    onset = max(1, round(max(min(ONSET, horizon * dt / 4.0), SETTLING) / dt))  # what comes before is not counted
    held = {
        "kinds": KINDS, "fdi_bound": BOUND, "jam_range": (0.0, 200.0), "budget": max(1, round(settings.dose / dt)), "onset": onset,
        "memory": max(1, round(5.0 / dt)),
    }  # fmt: skip
    return build(ThreatModel, held | dict(settings.threat), "threat_model")


def synthetic(dt: float, noise: Noise) -> dict[str, Any]:
    """Return a scenario as data: the car of road-v0 behind a made-up leader in stop-and-go, with a radar that is not late."""
    return {
        "name": f"synthetic-{dt:g}", "about": "The car of road-v0 behind a leader in stop-and-go.",
        "plant": {"name": "acc_string", "dt": dt, "kept": 0, "noise_var": [0.0, 2e-4 * dt, 2e-2 * dt], "process_var": list(process_var(dt)),
                  "lead_speed": 29.05},
        "sensor": {"name": "vehicle_radar", "range_sd": noise.range_sd, "speed_sd": noise.speed_sd, "late": 0},
        "controller": "acc_production", "manoeuvre": {"name": "stop_and_go"}, "horizon": round(60.0 / dt),
        "threat_model": {"kinds": ["fdi"]},
    }  # fmt: skip


def at_hours(defence: str, dt: float, noise: Noise, hours: float, onsets: int = 100) -> dict[str, Any]:
    """Return the threshold of a defence for one false alarm in `hours` on the synthetic road, with its count on fresh seeds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "synthetic.yaml"
        path.write_text(yaml.safe_dump(synthetic(dt, noise)), encoding="utf-8")
        found = calibrate(defence, hours, scenarios=[str(path)], onsets=onsets, check=True)
    return found.as_data()


def detect(
    recordings: Sequence[Recording], defences: Sequence[str], attacks: Sequence[str] = (), settings: Settings = Settings(),
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[dict[str, Any]], list[Played]]:  # fmt: skip
    """Replay each recording under each defence, without an attack and under each of `attacks`.

    Returns
    -------
    tuple
        A row of figures for each recording, defence and attack as JSON data, and what was played, for plots and files.
    """
    if not recordings or not defences:
        raise InputError("detect-log", len(recordings), "a recording and a defence")
    _check(settings)
    attacks = [text for text in dict.fromkeys(attacks) if text != "none"]
    for text in defences:
        Spec("defence", text).make()
    for text in attacks:
        Spec("attack", text).make()
    for recording in recordings if attacks else ():
        if (longest := max(len(part.gap) for part in recording.segments) * recording.dt) < settings.window:
            wanted = f"a segment as long as a window ({settings.window:g} s; --window sets it)"
            raise InputError(f"recording {recording.name}".rstrip(), f"{longest:g} s", wanted)
    out: list[dict[str, Any]] = []
    kept: list[Played] = []
    total = len(recordings) * len(defences) * (1 + len(attacks))
    thresholds: dict[tuple[str, float], dict[str, Any]] = {}
    for recording in recordings:
        for attack in ("none", *attacks):
            held = cut(recording, settings.noise, None if attack == "none" else settings.window)
            smooth = smoothed(held)
            for text in defences:
                key = (text, recording.dt)
                if settings.hours is not None and key not in thresholds:
                    thresholds[key] = at_hours(text, recording.dt, settings.noise, settings.hours)
                row, played = _one(recording, held, smooth, text, attack, settings, thresholds.get(key))
                out.append(row)
                if played is not None:
                    kept.append(played)
                if progress is not None:
                    progress(len(out), total)
    return out, kept


def _check(settings: Settings) -> None:
    for name, value, low, high in (
        ("window", settings.window, 10.0, 3600.0), ("dose", settings.dose, 0.001, 3600.0),
        ("range-sd", settings.noise.range_sd, 1e-3, 100.0), ("speed-sd", settings.noise.speed_sd, 1e-3, 100.0),
    ):  # fmt: skip
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(f"--{name}", value, f"a number from {low:g} to {high:g}")


def _one(
    recording: Recording, held: Cut, smooth: Array, text: str, attack: str, settings: Settings, found: dict[str, Any] | None
) -> tuple[dict[str, Any], Played | None]:  # fmt: skip
    row: dict[str, Any] = {"recording": recording.name, "defence": text, "attack": attack, "threshold": found and found["threshold"]}
    spec, attacker = Spec("defence", text), Spec("attack", attack)
    try:
        bench = Bench(spec.make(), spec.entry.uses, text, (), 1, lambda *_: None)
        defence = bench.defence if found is None else bench.at(found["threshold"])
        threat = threat_of(settings, recording.dt, held.plant.gap.shape[1] - 1)
        rival = attacker.make()
        threat = dataclasses.replace(threat, knowledge=getattr(rival, "knowledge", None) or attacker.entry.knowledge)  # type: ignore[arg-type]
        trace = rollout(loop_over(held, defence, spec.entry.uses, threat), rival, rows(held))
    except NotApplicable as error:
        return row | {"status": "skipped", "reason": str(error)}, None
    played = Played(recording.name, text, attack, held, trace, smooth)
    return row | {"status": "ok", "repairs": recording.repairs} | figures(played, recording.dt), played


def events_of(times: Sequence[float]) -> int:
    """Return how many events alarms at these times [s] are: one fault of the data often sets off several."""
    return 1 + int((np.diff(np.sort(times)) > ONE_EVENT).sum()) if len(times) else 0


def figures(played: Played, dt: float) -> dict[str, Any]:
    """Return the figures of a replay; step k of the loop is sample k, and the first sample is the prior."""
    trace, held = played.trace, played.pieces
    steps = trace.alarm.shape[0]
    counts = (np.arange(1, steps + 1)[:, None] < held.length) & (np.arange(1, steps + 1)[:, None] * dt > SETTLING)  # (K, R)
    alarm = trace.alarm[:, :, 0] & counts
    rises = alarm & ~np.concatenate([np.zeros((1, alarm.shape[1]), bool), alarm[:-1]])  # one that is on when the filter has settled counts
    estimate, smooth = trace.estimate[:, :, 0, :2], np.moveaxis(played.smooth, 0, 1)[1 : steps + 1]
    off = estimate - smooth
    attacked = (trace.kind != 0) & counts
    seen = counts & np.moveaxis(held.plant.seen, 0, 1)[1 : steps + 1]  # without readings a filter and the smoother both guess
    hours = float(seen.sum() * dt / 3600.0)
    times = sorted(round(float(held.begin[r] + (k + 1) * dt), 6) for k, r in np.argwhere(rises))
    events = events_of(times)
    low, high = mean_time(events, hours)
    out: dict[str, Any] = {
        "hours": hours, "pieces": len(held.length), "alarms": len(times), "alarm_times": times, "events": events,
        "alarms_per_hour": events / hours if hours else None,
        "alarms_per_hour_low": 0.0 if high is None else 1.0 / high, "alarms_per_hour_high": 1.0 / low if low else None,
        "alarm_share": float(alarm.sum() / max(1, counts.sum())), "gap_error": _rms(off[..., 0], seen),
        "speed_error": _rms(off[..., 1], seen), "largest_gap_error": float(np.max(np.abs(off[..., 0]), where=seen, initial=0.0)),
        "missing_share": float(1.0 - seen.sum() / max(1, counts.sum())), "mean_score": _mean(trace.score[:, :, 0], seen),
    }  # fmt: skip
    if played.attack == "none":
        return out
    hit = attacked.any(axis=0)
    first = np.argmax(attacked, axis=0)
    last = steps - 1 - np.argmax(attacked[::-1], axis=0)
    k = np.arange(steps)[:, None]
    during = alarm & (k >= first) & (k <= last + round(1.0 / dt)) & hit
    found = during.any(axis=0)
    delays = (np.argmax(during, axis=0) - first)[found] * dt
    before = alarm & (k < first) & (k >= first - (last - first) - round(1.0 / dt)) & hit
    return out | {
        "attacked": int(hit.sum()), "detected": int(found.sum()), "detected_share": float(found.sum() / max(1, hit.sum())),
        "delay": float(np.median(delays)) if len(delays) else None, "alarmed_before": int(before.any(axis=0).sum()),
        "gap_error_attacked": _rms(off[..., 0], attacked & seen),
    }  # fmt: skip


def _rms(x: Array, where: Array) -> float | None:
    return float(np.sqrt(np.mean(x[where] ** 2))) if where.any() else None


def _mean(x: Array, where: Array) -> float | None:
    return float(np.mean(x[where])) if where.any() else None


def draw(played: Played, form: str = "png") -> bytes:
    """Return a picture of one piece: gap as recorded, received, believed and smoothed, and the score with its alarms."""
    from tailgate.base.plots import canvas, drawn

    trace, held = played.trace, played.pieces
    hits = (trace.kind != 0).sum(axis=0) + trace.alarm[:, :, 0].sum(axis=0)
    i = int(np.argmax(hits))
    n = int(held.length[i]) - 1
    t = held.begin[i] + held.plant.dt * np.arange(1, n + 1)
    figure, axes = canvas(10.0, 5.6, 2, 1, sharex=True)
    gap, score = axes[0, 0], axes[1, 0]
    gap.plot(t, np.where(trace.valid[:n, i, 0, 0], trace.wires[:n, i, 0, 0], np.nan), color="0.6", linewidth=0.8, label="received")
    gap.plot(t, trace.estimate[:n, i, 0, 0], color="C0", label="estimate")
    gap.plot(t, played.smooth[i, 1 : n + 1, 0], color="black", linestyle="--", linewidth=1.0, label="smoother")
    score.plot(t, trace.score[:n, i, 0], color="C0", linewidth=0.8, label="score")
    for ax in (gap, score):
        _shade(ax, t, trace.kind[:n, i] != 0, "C3", "attacked")
        _shade(ax, t, trace.alarm[:n, i, 0], "C1", "alarm")
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8, loc="upper right")
    gap.set(ylabel="gap [m]", title=f"{played.recording or 'recording'}: {played.defence}, attack {played.attack}")
    score.set(ylabel="score", xlabel="time [s]", yscale="symlog")
    return drawn(figure, form)


def _shade(ax: Axes, t: Array, on: Array, colour: str, label: str) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
    for j, (a, b) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        ax.axvspan(t[a], t[min(b, len(t) - 1)], color=colour, alpha=0.25, label=label if j == 0 else None)


def write_parquet(path: Path, replays: Sequence[Played]) -> int:
    """Write a row for each step of each replay as Parquet; returns how many."""
    from tailgate.studies.log import pyarrow

    pa, pq = pyarrow()
    parts = []
    for played in replays:
        trace, held = played.trace, played.pieces
        for i, length in enumerate(held.length.tolist()):
            n = length - 1
            columns: dict[str, Any] = {
                "recording": [played.recording] * n, "defence": [played.defence] * n, "attack": [played.attack] * n,
                "piece": np.full(n, i), "t": held.begin[i] + held.plant.dt * np.arange(1, n + 1),
                "own_speed": held.plant.speed[i, 1:length], "received_distance": trace.wires[:n, i, 0, 0],
                "received_relative_speed": trace.wires[:n, i, 0, 1], "valid": trace.valid[:n, i, 0, 0],
                "estimate_distance": trace.estimate[:n, i, 0, 0], "estimate_relative_speed": trace.estimate[:n, i, 0, 1],
                "smooth_distance": played.smooth[i, 1:length, 0], "smooth_relative_speed": played.smooth[i, 1:length, 1],
                "score": trace.score[:n, i, 0], "alarm": trace.alarm[:n, i, 0], "attacked": trace.kind[:n, i] != 0,
            }  # fmt: skip
            parts.append(pa.table(columns))
    table = pa.concat_tables(parts)
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    write_atomic(path, sink.getvalue().to_pybytes(), "parquet")
    return int(table.num_rows)
