"""Logs: clean and attacked episodes as Parquet, for those who learn a detector.

One row per step and agent. Training episodes have seeds of the purpose `train` and development episodes of `tune`: neither ever meets the
seeds of a board. The attacks that a suite holds out are not in its logs: a board also shows how a detector handles unseen attacks. Each
cell is a separate part until all are done, so that an interrupted log goes on; the same log has the same bytes.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from tailgate.base import sizes
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.extras import optional
from tailgate.base.files import replacing, sweep, writable_directory, write_atomic, write_json
from tailgate.base.locks import alone
from tailgate.base.pytree import duplicate
from tailgate.base.reading import load_json
from tailgate.base.version import VERSION
from tailgate.core import Array, Attack, Frame, Model, draws
from tailgate.core.draws import Role
from tailgate.core.kinds import Kind, Mode
from tailgate.core.loop import Loop, LoopState
from tailgate.core.registry import Spec
from tailgate.core.scenario import Scenario, Suite, load_suite
from tailgate.evaluation.cells import Cell, cell_id, cells_of
from tailgate.evaluation.excluded_attacks import families
from tailgate.studies.log_card import Column, columns_of, readme, recordings_of

FORMAT = "tailgate-log-1"
SPLITS = {"train": "train", "dev": "tune"}  # and the purpose of its seeds
GROUP = 200_000  # rows of a row group, at most: what is held in memory at once
PARTS = ".parts"
OWN = {PARTS, "schema.json", "README.md", *SPLITS}
_KINDS = np.array([kind.name.lower() for kind in Kind])
_MODES = np.array([mode.name.lower() for mode in Mode])


def pyarrow() -> tuple[ModuleType, ModuleType]:
    """Import pyarrow and pyarrow.parquet."""
    first, second = (optional(name, "log", "logs need pyarrow") for name in ("pyarrow", "pyarrow.parquet"))
    return first, second


def write_log(
    suite: str | Suite,
    out: Path | str,
    *,
    episodes: int = 100,
    dev_episodes: int = 25,
    scenarios: Sequence[str] | None = None,
    doses: Sequence[int | None] | None = None,
    defences: Sequence[str] | None = None,
    attacks: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Write SPLIT/SCENARIO.parquet, schema.json and README.md into the directory `out`; returns what schema.json holds.

    `episodes`, `dev_episodes`: of each cell. `doses`: default the suite's middle one; `defences`: default its standard one (kf, or the
    first); `attacks`: default all but those held out, and none. A log that is whole is left as it is, one that was interrupted goes on.
    """
    pyarrow()
    base = load_suite(suite) if isinstance(suite, str) else suite
    for name, value in (("episodes", episodes), ("dev_episodes", dev_episodes)):
        sizes.check("episodes", value, name)
    chosen = _chosen(base, scenarios, doses, defences, attacks)
    cells = {
        split: cells_of(dataclasses.replace(chosen, seeds=count), purpose=SPLITS[split])
        for split, count in (("train", episodes), ("dev", dev_episodes))
    }  # fmt: skip
    identity = hashlib.blake2b("".join([FORMAT, *(cell_id(c) for s in SPLITS for c in cells[s])]).encode(), digest_size=12).hexdigest()
    folder = Path(out)
    if folder.is_file():
        raise InputError("out", str(folder), "a directory, not a file")
    if folder.is_dir() and (strange := sorted(set(os.listdir(folder)) - OWN)):
        raise InputError("out", str(folder), f"an empty directory, or one with this log (it holds {strange[0]})")
    parts = folder / PARTS
    if (held := _whole(folder)) is not None:
        if held["identity"] != identity:
            raise InputError("out", str(folder), "an empty directory, or one with this log (it holds another one)")
    else:
        with alone(folder):
            held = _written(base, chosen, cells, identity, writable_directory(folder), writable_directory(parts), progress)
    shutil.rmtree(parts, ignore_errors=True)
    return held


def _chosen(
    base: Suite, scenarios: Sequence[str] | None, doses: Sequence[int | None] | None, defences: Sequence[str] | None,
    attacks: Sequence[str] | None,
) -> Suite:  # fmt: skip
    """Return the part of the suite that is logged, with the episodes without attack."""
    for text in attacks or ():
        if hidden := _hidden(base, text):
            raise InputError("attack", text, f"an attack that {base.name} does not hold out of its logs, as it does {', '.join(hidden)}")
    played = [text for text in (base.attacks if attacks is None else attacks) if not _hidden(base, text)]
    standard = ("kf",) if "kf" in base.defences else base.defences[:1]
    return dataclasses.replace(
        base, scenarios=tuple(base.scenarios if scenarios is None else scenarios), attacks=tuple(dict.fromkeys(["none", *played])),
        doses=tuple((base.doses[len(base.doses) // 2],) if doses is None else doses),
        defences=tuple(standard if defences is None else defences), shown={}, robustness=(),
    )  # fmt: skip


def _held_out(base: Suite) -> set[str]:
    return {Spec("attack", text).entry.name for text in base.held_out}


def _hidden(base: Suite, text: str) -> list[str]:
    """Return the families that the suite holds out and the attack belongs to."""
    return sorted(families(text) & _held_out(base))


def _whole(folder: Path) -> dict[str, Any] | None:
    """Return what schema.json holds, which is written last; None where the log is not whole."""
    try:
        held: dict[str, Any] = load_json(folder / "schema.json")
        sizes = [(folder / file["path"]).stat().st_size == file["bytes"] for file in held["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return held if all(sizes) and held.get("format") == FORMAT and (folder / "README.md").is_file() else None


def _written(
    base: Suite, chosen: Suite, cells: dict[str, list[Cell]], identity: str, folder: Path, parts: Path,
    progress: Callable[[int, int], None] | None,
) -> dict[str, Any]:  # fmt: skip
    for left in (parts, *(folder / split for split in SPLITS), folder / "schema.json", folder / "README.md"):
        sweep(left)
    every = [(split, cell) for split in SPLITS for cell in cells[split]]
    skipped: list[dict[str, Any]] = []
    columns: dict[str, tuple[Scenario, Model, list[Column]]] = {}
    for done, (split, cell) in enumerate(every, 1):
        part = parts / f"{cell_id(cell)}.parquet"
        try:
            loop, scenario, attack = _ready(cell)
            columns.setdefault(cell.scenario, (scenario, loop.model, columns_of(loop)))
            if not _good(part, cell):
                _play_part(part, split, cell, loop, attack, columns[cell.scenario][2])
        except NotApplicable as error:  # some attacks find out only when they look at the defence
            skipped.append({"split": split, **_named(cell), "reason": str(error)})
        if progress is not None:
            progress(done, len(every))
    files = [
        _joined(folder, parts, split, scenario, [cell for cell in cells[split] if cell.scenario == scenario], columns[scenario][2])
        for split in SPLITS for scenario in chosen.scenarios if scenario in columns
    ]  # fmt: skip
    held = {
        "format": FORMAT, "identity": identity, "suite": base.name, "about": base.about, "version": VERSION,
        "held_out": sorted(_held_out(base)), "left_out": [text for text in base.attacks if _hidden(base, text)], "splits": SPLITS,
        "attacks": list(chosen.attacks), "defences": list(chosen.defences), "doses": list(chosen.doses), "files": files, "skipped": skipped,
        "scenarios": {
            name: {
                "about": scenario.about, "config_hash": scenario.config_hash, "dt": model.dt,
                "horizon": scenario.horizon, "agents": model.agents, "recordings": recordings_of(scenario.manoeuvre),
                "columns": [column._asdict() for column in described],
            }
            for name, (scenario, model, described) in columns.items()
        },
    }  # fmt: skip
    write_atomic(folder / "README.md", readme(held).encode())
    write_json(folder / "schema.json", held)
    return held


def _named(cell: Cell) -> dict[str, Any]:
    return {"scenario": cell.scenario, "dose": cell.dose, "defence": cell.defence, "attack": cell.attack}


def _ready(cell: Cell) -> tuple[Loop, Scenario, Attack]:
    """Return the loop, the scenario and the attack of a cell. Raises NotApplicable for a pairing without meaning."""
    defence, spec = Spec("defence", cell.defence), Spec("attack", cell.attack)
    attack: Attack = spec.make()
    scenario = cell.place(attack, spec.entry.knowledge)
    loop = scenario.loop(defence.make(), defence.entry.uses)
    attack.prepare(loop.brief)
    return loop, scenario, attack


def _schema(columns: Sequence[Column]) -> Any:
    pa, _ = pyarrow()
    return pa.schema([pa.field(c.name, getattr(pa, c.type)(), c.name == "dose" or c.name.startswith("innovation")) for c in columns])


def _good(part: Path, cell: Cell) -> bool:
    """Return whether the part is whole: Parquet keeps its index, and this the cell, at the end."""
    pa, pq = pyarrow()
    try:
        held = pq.ParquetFile(part).schema_arrow.metadata or {}
    except (OSError, ValueError, pa.ArrowException):  # names that are no text, among others
        return False
    return bool(held.get(b"cell") == cell_id(cell).encode())


def _play_part(part: Path, split: str, cell: Cell, loop: Loop, attack: Attack, columns: Sequence[Column]) -> None:
    """Play one cell into a Parquet file, with a row group for as many episodes as GROUP holds."""
    pa, pq = pyarrow()
    schema, size = _schema(columns), max(1, GROUP // (loop.horizon * loop.model.agents))
    schema = schema.with_metadata({"cell": cell_id(cell)})
    fixed = {"suite": cell.suite, "split": split, **_named(cell)}
    with replacing(part) as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        for first in range(0, cell.seeds, size):
            seeds = range(first, min(first + size, cell.seeds))
            values = _table(loop, attack, draws.keys(cell.purpose, seeds), seeds)
            count = len(values["k"])
            arrays = [
                _array(pa, field, fixed[field.name], count) if field.name in fixed else _array(pa, field, values[field.name], count)
                for field in schema
            ]  # fmt: skip
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema), row_group_size=count)


def _array(pa: ModuleType, field: Any, value: str | Array, count: int) -> Any:
    if not isinstance(value, np.ndarray):
        return pa.array([value] * count, field.type)
    return pa.array(value, field.type, mask=np.isnan(value) if field.nullable else None)


def steps(loop: Loop, attack: Attack, keys: draws.Keys) -> Iterator[tuple[LoopState, Frame, Array, Array]]:
    """Yield each step of B episodes: the state before it, its frame, the innovation (B, N, q), NaN if none, and live (B,) bool."""
    state = loop.start(keys)
    plan = attack.prepare(loop.brief)
    memory = attack.start(plan, len(keys.key), keys.at(Role.ATTACK, np.zeros(len(keys.key), np.int64)))
    while int(state.k[0]) <= loop.horizon and not state.ended.all():
        live, before = ~state.ended, duplicate(state.defence)
        held = state._replace(defence=before)
        state, memory, frame = loop.step(state, attack, plan, memory)
        yield held, frame, _innovation(loop, held, frame), live


def _innovation(loop: Loop, state: LoopState, frame: Frame) -> Array:
    received = frame.received
    nothing = np.full(received.y.shape, np.nan)
    if not hasattr(loop.defence, "look"):
        return nothing
    heard = received._replace(
        v2v=received.v2v if "v2v" in loop.uses else None, odometry=received.odometry if "odometry" in loop.uses else None, attacked=None
    )
    return np.asarray(loop.defence.look(loop.plan.defence, state.defence, heard, state.known_u).innovation.r)


def _table(loop: Loop, attack: Attack, keys: draws.Keys, seeds: range) -> dict[str, Array]:
    """Return columns of the episodes: episode by episode, in it step by step, in it agent by agent."""
    model, held, alive = loop.model, [], []
    for state, frame, innovation, live in steps(loop, attack, keys):
        held.append(_step(loop, state, frame, innovation))
        alive.append(live)
    live = np.array(alive).T  # (B, K)
    out = {}
    for name in held[0]:
        values = np.moveaxis(np.array([columns[name] for columns in held]), 0, 1)  # (B, K, N)
        out[name] = values[live].reshape(-1)
    batch, count = live.shape
    shape = (batch, count, model.agents)
    out["episode"] = np.broadcast_to(np.asarray(seeds)[:, None, None], shape)[live].reshape(-1)
    out["agent"] = np.broadcast_to(np.arange(model.agents), shape)[live].reshape(-1)
    k = np.broadcast_to(np.arange(1, count + 1)[:, None], shape)[live].reshape(-1)
    return out | {"k": k, "t": k * model.dt}


def _step(loop: Loop, state: LoopState, frame: Frame, innovation: Array) -> dict[str, Array]:
    """Return (B, N) of every column that changes from step to step."""
    model, received, estimate, command = loop.model, frame.received, frame.estimate, frame.command
    sensors, agents = model.sensors, (len(frame.k), model.agents)
    hit = command.target & (command.kind != 0)[:, None, None]
    attacked = hit.any(axis=2)
    out = {f"reading_{name}": received.y[..., i] for i, name in enumerate(sensors)}
    out |= {f"valid_{name}": received.valid[..., i] for i, name in enumerate(sensors)}
    assert received.v2v is not None
    out |= {f"message_{name}": received.v2v[..., i] for i, name in enumerate(model.v2v)}
    odometry = loop.plant.odometry(loop.plan.plant, state.plant)
    out |= {f"odometry_{name}": odometry[..., i] for i, name in zip(range(odometry.shape[-1]), ("position", "speed"), strict=False)}
    if model.air:
        out |= {"energy": received.energy, "probed": state.probed}
    out |= {f"known_input_{i}": state.known_u[..., i] for i in range(model.inputs)}
    out |= {f"estimate_{i}": estimate.x[..., i] for i in range(model.states)}
    out |= {f"innovation_{name}": innovation[..., i] for i, name in enumerate(sensors)}
    out |= {"score": estimate.score, "alarm": estimate.alarm, "mode": _MODES[estimate.mode]}
    out |= {"attacked": attacked, "attack_kind": np.where(attacked, _KINDS[command.kind][:, None], _KINDS[0])}
    out |= {f"truth_attacked_{name}": hit[..., i] for i, name in enumerate(model.wires)}
    out |= {f"truth_sent_{name}": frame.clean[..., i] for i, name in enumerate(sensors + model.v2v)}
    out |= {f"truth_state_{i}": frame.truth[..., i] for i in range(model.states)}
    return out | {"truth_collided": np.broadcast_to((frame.collided | frame.rear_collided)[:, None], agents)}


def _joined(folder: Path, parts: Path, split: str, scenario: str, cells: Sequence[Cell], columns: Sequence[Column]) -> dict[str, Any]:
    """Return one file of the parts, row group by row group; what schema.json says of it."""
    _, pq = pyarrow()
    path, schema = folder / split / f"{Path(scenario).stem}.parquet", _schema(columns)
    rows = groups = 0
    with replacing(path) as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        for cell in cells:
            part = parts / f"{cell_id(cell)}.parquet"
            if not part.is_file():  # a pairing without meaning
                continue
            held = pq.ParquetFile(part)
            for i in range(held.num_row_groups):
                table = held.read_row_group(i).replace_schema_metadata(None)
                writer.write_table(table, row_group_size=table.num_rows)
                rows, groups = rows + table.num_rows, groups + 1
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256")
    return {
        "path": f"{split}/{path.name}", "split": split, "scenario": scenario, "rows": rows, "row_groups": groups,
        "bytes": path.stat().st_size, "sha256": digest.hexdigest(),
    }  # fmt: skip

