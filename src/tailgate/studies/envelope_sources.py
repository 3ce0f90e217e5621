"""Clean steps that a safety envelope is learned from: episodes of scenarios, or a log that `tailgate log` wrote."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, Field

from tailgate.agents.scripts.scripted import NoAttack
from tailgate.base import sizes
from tailgate.base.errors import InputError, said
from tailgate.core import draws
from tailgate.core.quantities import Step
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, load_scenario
from tailgate.core.schema import read_model
from tailgate.estimators.safe_set.envelope import Sheet
from tailgate.studies.envelope import Progress, Samples, Settings, Signals, joined, sampled, sheet_of
from tailgate.studies.log import SPLITS, pyarrow, steps
from tailgate.studies.log_card import unit_of

AT_ONCE = 64  # episodes that are played together


def played(place: Scenario, purpose: str, seeds: range, progress: Callable[[int], None] | None = None) -> Samples:
    """Return the steps of clean episodes, driven by `kf`."""
    loop = place.loop(Spec("defence", "kf").make())
    parts = []
    for first in range(seeds.start, seeds.stop, AT_ONCE):
        some = range(first, min(first + AT_ONCE, seeds.stop))
        rows = []
        for state, frame, _, live in steps(loop, NoAttack(), draws.keys(purpose, some)):
            received = frame.received
            assert received.v2v is not None
            arrived = np.concatenate([received.valid, np.ones(received.v2v.shape, bool)], axis=-1) & live[:, None, None]
            z = np.concatenate([received.y, received.v2v], axis=-1)
            rows.append((z, arrived, state.known_u, np.broadcast_to(live[:, None], arrived.shape[:2])))
        by_episode = (np.moveaxis(np.array(column), 0, 2) for column in zip(*rows, strict=True))  # (B, N, steps, ...)
        z, arrived, u, driven = (column.reshape(-1, *column.shape[3:]) for column in by_episode)
        step = np.arange(len(z))
        made = sampled(z, arrived, u, step % len(rows) == 0, step // (len(z) // len(some)))
        parts.append(Samples(*(column[driven] for column in made)))
        if progress is not None:
            progress(len(some))
    return joined(parts)


def from_scenarios(names: Sequence[str], episodes: int, held_out: int, settings: Settings, progress: Progress | None = None) -> Sheet:
    """Return an envelope of scenarios that share their signals, from clean episodes of the purposes train and tune (held out).

    Raise InputError for scenarios of different signals, or too few episodes.
    """
    for name, value in (("episodes", episodes), ("held_out", held_out)):
        sizes.check("episodes", value, name)
    if not names or len(set(names)) < len(names):
        raise InputError("scenario", list(names), "at least one, each once")
    places = [load_scenario(name) for name in names]
    signals = [Signals.of(place.brief().model) for place in places]
    for name, has in zip(names, signals, strict=True):
        _same(f"scenario {name}", has, signals[0])
    fewest, each = settings.fewest(), len(places)
    if settings.unit == "step":
        each = sum(place.horizon * place.brief().model.agents for place in places)
    if held_out * each < fewest:
        raise InputError("held_out", held_out, f"at least {math.ceil(fewest / each)} episodes, to show a rate below {settings.rate:g}")
    total, done, splits, counts = len(places) * (episodes + held_out), 0, [], {}

    def more(count: int) -> None:
        nonlocal done
        done += count
        if progress is not None:
            progress("playing", done, total)

    for split, count in (("train", episodes), ("dev", held_out)):
        parts = [played(place, SPLITS[split], range(count), more) for place in places]
        counts[split] = {"purpose": SPLITS[split], "seeds": [0, count - 1], "steps": [len(part.columns) for part in parts]}
        splits.append(joined(parts))
    made = {"from": {place.name: place.config_hash for place in places}, "driven_by": ["kf"], **counts}
    return sheet_of(signals[0], splits[0], splits[1], settings, made, progress)


def _same(where: str, has: Signals, wanted: Signals) -> None:
    for field in Signals._fields:
        if getattr(has, field) != getattr(wanted, field):
            raise InputError(f"{where}: {field}", getattr(has, field), f"{getattr(wanted, field)}, as the first scenario has")


class _Column(BaseModel):
    name: str


class _Place(BaseModel):
    """A scenario of a log."""

    columns: list[_Column]
    dt: Step
    config_hash: str

    def signals(self, name: str) -> Signals:
        """Return the signals of the scenario `name`: their units are those of its model, where the package has this very scenario."""
        try:
            place = load_scenario(name)
        except InputError:
            place = None
        if place is not None and place.config_hash == self.config_hash:
            return Signals.of(place.brief().model)
        names = [column.name for column in self.columns]
        readings, messages = (
            tuple(name.removeprefix(prefix) for name in names if name.startswith(prefix)) for prefix in ("reading_", "message_")
        )
        return Signals(readings, messages, sum(name.startswith("known_input_") for name in names), self.dt,
                       tuple(unit_of(name) for name in readings + messages), tuple("position" in name for name in readings + messages))


class _File(BaseModel):
    """A file of a log, in the folder of its split."""

    path: Annotated[str, Field(pattern=r"^(train|dev)/[^/\x00]+\.parquet$")]
    split: Literal["train", "dev"]
    scenario: str
    sha256: str


class _Log(BaseModel):
    """The fields of a log's schema.json that learning needs."""

    format: Literal["tailgate-log-1"]
    files: list[_File]
    scenarios: Annotated[dict[str, _Place], Field(min_length=1)]
    defences: Annotated[list[str], Field(min_length=1)]


def from_log(folder: Path, scenarios: Sequence[str] | None, settings: Settings, progress: Progress | None = None) -> Sheet:
    """Return an envelope of the clean episodes of a log (`tailgate log`): its train split, held out its dev split.

    Raise InputError for a folder that is no whole log, or scenarios of different signals.
    """
    held = read_model(_Log, folder / "schema.json", "log", "tailgate log")
    names = list(scenarios or held.scenarios)
    if strange := [name for name in names if name not in held.scenarios]:
        raise InputError("scenario", strange[0], f"one of the log: {', '.join(held.scenarios)}")
    signals = [held.scenarios[name].signals(name) for name in names]
    for name, has in zip(names, signals, strict=True):
        _same(f"scenario {name}", has, signals[0])
    files = [file for file in held.files if file.scenario in names]
    splits, counts, digests = [], {}, {}
    for split in SPLITS:
        parts = []
        for file in (file for file in files if file.split == split):
            parts.append(_read_file(folder, file, signals[0], held.defences[0]))
            digests[file.path] = file.sha256
            if progress is not None:
                progress("reading", len(digests), len(files))
        if not parts:
            raise InputError("log", str(folder), f"a log with files of the split {split}")
        splits.append(joined(parts))
        counts[split] = {"purpose": SPLITS[split], "steps": [len(part.columns) for part in parts]}
    made = {"from": {name: held.scenarios[name].config_hash for name in names}, "driven_by": held.defences[:1], **counts}
    return sheet_of(signals[0], splits[0], splits[1], settings, made | {"log": digests}, progress)


def _read_file(folder: Path, file: _File, signals: Signals, driver: str) -> Samples:
    """Return the clean steps of a file of a log, under one defence: others drive on the same roads, and are no further evidence.

    Raise InputError where it is not the file that schema.json describes.
    """
    pa, pq = pyarrow()
    path = folder / file.path
    columns = [
        "attack", "episode", "k", "agent", "defence", *(f"reading_{name}" for name in signals.sensors),
        *(f"valid_{name}" for name in signals.sensors), *(f"message_{name}" for name in signals.v2v),
        *(f"known_input_{i}" for i in range(signals.inputs)),
    ]  # fmt: skip
    try:
        with path.open("rb") as content:
            digest = hashlib.file_digest(content, "sha256").hexdigest()
        if digest != file.sha256:
            raise InputError("log", str(path), "the file whose SHA-256 schema.json names: it is damaged or another one")
        table = pq.read_table(path, columns=columns, filters=[("attack", "==", "none"), ("defence", "==", driver)])
        held = {name: table[name].to_numpy() for name in columns}
        numbers = [np.asarray(held[name], np.float64) for name in columns[5:]]
    except (OSError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("log", str(path), f"a Parquet file with the columns of a log ({said(error)})") from None
    q, p = len(signals.sensors), len(signals.v2v)
    y, valid, rest = np.array(numbers[:q]).T, np.array(numbers[q : 2 * q]).T > 0.5, np.array(numbers[2 * q :]).T
    z, arrived = np.concatenate([y, rest[:, :p]], axis=1), np.concatenate([valid, np.ones((len(y), p), bool)], axis=1)
    if not np.isfinite(z[arrived]).all() or not np.isfinite(rest).all():
        raise InputError("log", str(path), "finite readings, messages and known inputs")
    order = np.lexsort((held["k"], held["agent"], held["episode"]))
    k, run = held["k"][order], np.stack([held["agent"][order], held["episode"][order]])
    same = np.concatenate([[False], (run[:, 1:] == run[:, :-1]).all(axis=0)])
    fresh = np.concatenate([[True], np.diff(k) != 0]) | ~same  # clean episodes are the same at every dose
    order, k, same = order[fresh], k[fresh], same[fresh]
    begins = ~same | (np.diff(k, prepend=0) != 1)
    return sampled(z[order], arrived[order], rest[order][:, p:], begins, np.unique(held["episode"][order], return_inverse=True)[1])
