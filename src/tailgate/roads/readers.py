"""Readers of recordings in the field's formats. Files are others': nothing in them is executed, and each limit is checked.

openacc   CSV of OpenACC: Time or t, Speed1.., IVS1.. (bumper gaps); a recording for each car that follows
ultra-av  CSV of ULTra-AV: Time_Index, Speed_LV, Speed_FAV, Space_Gap, and Trajectory_ID where there are several
comma2k19 folder of a segment with CAN/radar and CAN/speed (t and value, npy)
sumo-fcd  XML of SUMO's floating car data: a vehicle and the one ahead of it in its lane
veremi    JSON Lines of VeReMi: own positions (type 2) and messages of a sender (type 3)
csv       any CSV, with a mapping of columns and units
"""

from __future__ import annotations

import csv
import dataclasses
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base.errors import InputError, said, unknown
from tailgate.base.reading import lines_of, parse_json, read_bytes
from tailgate.core import Array
from tailgate.core.traces import cards, npy, trace
from tailgate.roads.fcd import read_fcd
from tailgate.roads.recording import FEWEST, LEAST, MOST, Raw, Recording, checked
from tailgate.roads.recording import SILENCE as HOLE

FORMATS = ("openacc", "ultra-av", "comma2k19", "sumo-fcd", "veremi", "csv", "trace")
TIMES, LENGTHS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}, {"m": 1.0, "km": 1000.0, "ft": 0.3048}
SPEEDS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "mph": 0.44704, "ft/s": 0.3048}
UNITS = TIMES | LENGTHS | SPEEDS
WANTED = {"t": TIMES, "gap": LENGTHS, "speed": SPEEDS, "relative_speed": SPEEDS, "lead_speed": SPEEDS}  # and their units
TAKES = {
    "openacc": ("vehicle",), "ultra-av": ("vehicle",), "comma2k19": ("vehicle",), "sumo-fcd": ("vehicle", "lead", "length"),
    "veremi": ("lead", "length"), "csv": ("map",), "trace": ("vehicle",),
}  # fmt: skip
HEADER = 20  # lines before the header of an OpenACC file, at most
LENGTH = 5.0  # of a vehicle whose length nobody tells [m]
SILENCE = 2.5  # times the usual time between two messages: nothing is interpolated across a longer one


@dataclass(frozen=True)
class Choice:
    """Which part of a file is read: `vehicle`, a car's number, track, or id; `lead`: id of the one ahead; `length` of cars [m]."""

    vehicle: str | None = None
    lead: str | None = None
    length: float = LENGTH
    mapping: tuple[tuple[str, str, str], ...] = ()  # what, column, unit; no unit: s, m or m/s


def mapping_of(texts: Sequence[str]) -> tuple[tuple[str, str, str], ...]:
    """Return what, column and unit, empty where none is named, of texts such as `speed=v_ego:km/h`. Raise InputError for anything else."""
    out: list[tuple[str, str, str]] = []
    for text in texts:
        what, sep, rest = text.partition("=")
        column, _, unit = rest.rpartition(":") if rest.rpartition(":")[2] in UNITS else (rest, "", "")  # a column's name may have a colon
        if not sep or not column:
            raise InputError("--map", text, "WHAT=COLUMN or WHAT=COLUMN:UNIT, such as speed=v_ego:km/h")
        if what not in WANTED:
            raise unknown("--map", what, WANTED)
        if unit and unit not in WANTED[what]:
            raise unknown(f"--map: unit of {what}", unit, WANTED[what])
        if any(what == other for other, _, _ in out):
            raise InputError("--map", text, f"{what} once")
        out.append((what, column, unit))
    return tuple(out)


def read(source: str, format: str | None = None, choice: Choice = Choice()) -> list[Recording]:
    """Return the recordings of a file or folder, or of a trace of the package, each validated.

    format: one of FORMATS; none: found from the name and the header.
    """
    path = Path(source)
    if format is not None and format not in FORMATS:
        raise unknown("--format", format, FORMATS)
    kind = format or _kind(source, path, choice)
    _check_choice(kind, choice)
    readers: dict[str, Callable[[], list[Raw]]] = {
        "openacc": lambda: _openacc(_table(path, _is_openacc), choice), "ultra-av": lambda: _ultra_av(_table(path), choice),
        "comma2k19": lambda: _comma(path, choice), "veremi": lambda: _veremi(path, choice), "csv": lambda: _mapped(_table(path), choice),
        "sumo-fcd": lambda: read_fcd(path, choice.vehicle, choice.lead, choice.length), "trace": lambda: _trace(source, choice),
    }  # fmt: skip
    try:
        raws = readers[kind]()
    except (OSError, UnicodeDecodeError, csv.Error, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{kind} file", source, f"a readable one ({said(error)})") from None
    long = [raw for raw in raws if len(raw.t) >= FEWEST and not raw.t[-1] - raw.t[0] < LEAST] or raws
    found = [checked(raw, f"{kind} file {path.name}") for raw in long]
    if dropped := len(raws) - len(long):
        found[0].repairs[f"recordings below {LEAST:g} s or {FEWEST} samples dropped"] = dropped
    return [dataclasses.replace(one, name=one.name or path.name) for one in found]


def _check_choice(kind: str, choice: Choice) -> None:
    """Raise InputError for an option that a format does not have."""
    given: dict[str, Any] = {"vehicle": choice.vehicle, "lead": choice.lead, "length": choice.length if choice.length != LENGTH else None}
    given["map"] = " ".join(f"{what}={column}" for what, column, _ in choice.mapping) or None
    for name, value in given.items():
        if value is not None and name not in TAKES[kind]:
            wanted = f"none: of these options the format {kind} takes {' and '.join(f'--{other}' for other in TAKES[kind])}"
            raise InputError(f"--{name}", value, wanted)


def _kind(source: str, path: Path, choice: Choice) -> str:
    if source in cards():
        return "trace"
    if choice.mapping:
        return "csv"
    if path.is_dir():
        return "comma2k19"
    if path.suffix == ".xml":
        return "sumo-fcd"
    if path.suffix in (".json", ".jsonl", ".xz"):
        return "veremi"
    try:
        head = read_bytes(path)[:65536].decode("utf-8-sig", errors="replace").splitlines()[: HEADER + 1]
    except OSError as error:
        raise InputError("file", source, f"a readable file, or a trace of the package ({said(error)})") from None
    for line in head:
        cells = [cell.strip() for cell in line.split(",")]
        if _is_openacc(cells):
            return "openacc"
        if "Space_Gap" in cells:
            return "ultra-av"
    mapped = " ".join(f"--map {what}=COLUMN" for what in ("t", "gap", "speed", "lead_speed"))
    raise InputError("file", source, f"a known header, or --format ({', '.join(FORMATS)}), or {mapped}")


# -- tables


@dataclass(frozen=True)
class Table:
    """The columns of a CSV file by name, texts."""

    columns: dict[str, list[str]]
    first: int  # line of the first row
    name: str

    def numbers(self, column: str, empty_is_nan: bool = True) -> Array:
        """Return a column (K,) as numbers; an empty cell or nan is NaN. Raise InputError that names the line."""
        if column not in self.columns and column.rpartition(":")[0] in self.columns:
            raise unknown(f"{self.name}: unit of {column.rpartition(':')[0]}", column.rpartition(":")[2], UNITS)
        if column not in self.columns:
            raise unknown(f"{self.name}: column", column, self.columns)
        out = np.empty(len(self.columns[column]))
        for i, text in enumerate(self.columns[column]):
            try:
                out[i] = float(text.replace("_", "?")) if text or not empty_is_nan else np.nan  # Python reads 3_0 as 30
            except ValueError:
                raise InputError(f"{self.name}, line {self.first + i}, column {column}", text, "a number") from None
        return out


def _is_openacc(cells: Sequence[str]) -> bool:
    return "Speed1" in cells and "IVS1" in cells


def _table(path: Path, begins: Callable[[Sequence[str]], bool] | None = None) -> Table:
    rows = list(csv.reader(read_bytes(path, 512 << 20).decode("utf-8-sig").splitlines()))
    at = 0
    if begins is not None:
        at = next((i for i, row in enumerate(rows[: HEADER + 1]) if begins([cell.strip() for cell in row])), -1)
        if at < 0:
            raise InputError(f"{path.name}: header", rows[0][:9] if rows else "an empty file", "columns Speed1 and IVS1")
    if not rows:
        raise InputError(f"{path.name}: header", "an empty file", "names of columns")
    names = [cell.strip() for cell in rows[at]]
    if len({name for name in names if name}) < len([name for name in names if name]):
        raise InputError(f"{path.name}: header", names, "names of which no two are equal")
    held: list[list[str]] = [[] for _ in names]
    for i, row in enumerate(rows[at + 1 :], at + 2):
        if not row:
            if i == len(rows):
                break
            raise InputError(f"{path.name}, line {i}", "an empty line", "a row of numbers")
        if len(row) != len(names):
            raise InputError(f"{path.name}, line {i}", f"{len(row)} cells", f"{len(names)}, as the header has")
        for cells, cell in zip(held, row, strict=True):
            cells.append(cell.strip())
    return Table(dict(zip(names, held, strict=True)), at + 2, path.name)


def _followers(number: Callable[[str], Array], names: Sequence[str], t: Array, choice: Choice, where: str) -> list[Raw]:
    """Return a recording of each car behind the first of a string: speeds `SpeedI`, gaps `IVSI`."""
    cars = [i for i in range(2, 100) if f"Speed{i}" in names and f"Speed{i - 1}" in names and f"IVS{i - 1}" in names]
    if choice.vehicle is not None:
        if choice.vehicle not in map(str, cars):
            raise unknown(f"{where}: --vehicle", choice.vehicle, map(str, cars))
        cars = [int(choice.vehicle)]
    if not cars:
        raise InputError(f"{where}: header", list(names)[:12], "Speed1, Speed2 and IVS1: a car that follows")
    out = []
    for i in cars:
        speed = number(f"Speed{i}")
        out.append(Raw(f"car {i}", t, number(f"IVS{i - 1}"), number(f"Speed{i - 1}") - speed, speed))
    return out


def _openacc(table: Table, choice: Choice) -> list[Raw]:
    time = next((name for name in ("Time", "t", "time") if name in table.columns), "Time")
    return _followers(table.numbers, list(table.columns), table.numbers(time), choice, table.name)


def _ultra_av(table: Table, choice: Choice) -> list[Raw]:
    t, gap, lead, own = (table.numbers(name) for name in ("Time_Index", "Space_Gap", "Speed_LV", "Speed_FAV"))
    ids = np.array(table.columns.get("Trajectory_ID", ["0"] * len(t)))
    names = list(dict.fromkeys(ids.tolist())) or ["0"]
    if choice.vehicle is not None:
        if choice.vehicle not in names:
            raise unknown(f"{table.name}: --vehicle", choice.vehicle, names)
        names = [choice.vehicle]
    return [Raw(f"trajectory {name}", *(x[ids == name] for x in (t, gap, lead - own, own))) for name in names]


def _mapped(table: Table, choice: Choice) -> list[Raw]:
    held = {what: UNITS.get(unit, 1.0) * table.numbers(column) for what, column, unit in choice.mapping}
    for what in ("t", "gap", "speed"):
        if what not in held:
            raise InputError("--map", sorted(held), f"{what}=COLUMN too")
    if ("relative_speed" in held) == ("lead_speed" in held):
        raise InputError("--map", sorted(held), "one of relative_speed=COLUMN and lead_speed=COLUMN")
    relative = held["relative_speed"] if "relative_speed" in held else held["lead_speed"] - held["speed"]
    return [Raw("", held["t"], held["gap"], relative, held["speed"])]


def _trace(source: str, choice: Choice) -> list[Raw]:
    held = trace(source, "file")
    if "relative_speed1" in held:
        if choice.vehicle is not None:
            raise InputError("--vehicle", choice.vehicle, f"none: {source} has one car")
        return [Raw("", held["t"], held["gap1"], held["relative_speed1"], held["speed2"])]
    named = {key.replace("speed", "Speed").replace("gap", "IVS"): value for key, value in held.items()}
    return _followers(lambda name: named[name], list(named), held["t"], choice, source)


# -- folders and messages


def _comma(path: Path, choice: Choice) -> list[Raw]:
    folder = next((at for at in (path / "processed_log" / "CAN", path / "CAN", path) if (at / "radar").is_dir()), None)
    if folder is None:
        raise InputError("comma2k19 file", str(path), "the folder of a segment, with processed_log/CAN/radar")
    own = next((folder / name for name in ("speed", "car_speed") if (folder / name).is_dir()), None)
    if own is None:
        raise InputError("comma2k19 file", str(folder), "a folder speed or car_speed")

    def array(at: Path, name: str, dimensions: tuple[int, ...]) -> Array:
        held = npy(read_bytes(at / name, 512 << 20))
        if held.dtype.kind not in "fiu" or held.ndim not in dimensions or not 20 <= len(held) <= MOST:
            got = f"{held.dtype} {held.shape}"
            raise InputError(f"comma2k19 file {at.name}/{name}", got, "20 numbers and more, one row for each sample")
        return held.astype(np.float64)

    t, values = array(folder / "radar", "t", (1,)), array(folder / "radar", "value", (2,))
    at, speed = array(own, "t", (1,)), array(own, "value", (1, 2)).reshape(-1)
    if values.shape != (len(t), 7):
        raise InputError("comma2k19 file radar/value", values.shape, f"({len(t)}, 7): distances, relative speed, address, new track")
    if len(speed) != len(at) or not (np.diff(at) > 0).all():
        raise InputError(f"comma2k19 file {own.name}/t", len(at), f"rising times, as many as values ({len(speed)})")
    addresses = values[:, 5].astype(np.int64)
    if choice.vehicle is not None and choice.vehicle not in map(str, set(addresses.tolist())):
        raise unknown("comma2k19 file: --vehicle", choice.vehicle, map(str, sorted(set(addresses.tolist()))))
    begun, fresh = Counter[int](), dict[int, bool]()  # of each address: another car gets it where the radar says that the track is new
    tracks: list[tuple[int, int]] = []
    for address, new in zip(addresses.tolist(), (values[:, 6] != 0.0).tolist(), strict=True):
        begun[address] += new and not fresh.get(address, False)
        fresh[address] = new
        tracks.append((address, begun[address]))
    long = Counter(track for track in tracks if choice.vehicle in (None, str(track[0])))
    chosen = max(long, key=lambda track: (long[track], -track[0], -track[1]))
    known = (t >= at[0]) & (t <= at[-1])
    known[known] = np.diff(at)[np.clip(np.searchsorted(at, t[known], "right") - 1, 0, len(at) - 2)] <= HOLE  # else a hole in time
    mine = np.array([track == chosen for track in tracks]) & known
    return [Raw(f"track {chosen[0]}", t[mine], values[mine, 0], values[mine, 2], np.interp(t[mine], at, speed))]


def _veremi(path: Path, choice: Choice) -> list[Raw]:
    own: list[tuple[float, Array, Array]] = []
    heard: dict[str, list[tuple[float, Array, Array]]] = {}
    for i, line in enumerate(lines_of(path), 1):
        if not line.strip():
            continue
        where = f"{path.name}, line {i}"
        try:
            data = parse_json(line)
        except (ValueError, UnicodeDecodeError) as error:
            raise InputError(where, line[:60].decode("utf-8", "replace"), f"a JSON object ({said(error)})") from None
        if not isinstance(data, dict):
            raise InputError(where, type(data).__name__, "a JSON object")
        if data.get("type") == 2:
            own.append((_number(data, "rcvTime", where), _vector(data, "pos", where), _vector(data, "spd", where)))
        elif data.get("type") == 3:
            sender = str(data.get("sender"))
            place = _number(data, "rcvTime", where), _vector(data, "pos", where), _vector(data, "spd", where)
            heard.setdefault(sender, []).append(place)
        if len(own) > MOST:
            raise InputError(where, len(own), f"at most {MOST} own positions")
    if len(own) < 20:
        raise InputError(f"{path.name}: messages of type 2", len(own), "at least 20 own positions")
    wanted = choice.lead or max(heard, key=lambda key: (len(heard[key]), key), default="")
    if wanted not in heard:
        raise unknown(f"{path.name}: sender", wanted or "none", heard)
    t, x, v = _columns(own)
    at, there, fast = _columns(heard[wanted])
    order = np.argsort(at, kind="stable")
    at, there, fast = at[order], there[order], fast[order]
    there, fast = (np.stack([np.interp(t, at, column) for column in part.T], axis=1) for part in (there, fast))
    speed, lead = np.sqrt((v * v).sum(axis=1)), np.sqrt((fast * fast).sum(axis=1))
    off = there - x
    gap = np.sqrt((off * off).sum(axis=1)) - choice.length
    before, after = (np.clip(i, 0, len(at) - 1) for i in (np.searchsorted(at, t, "right") - 1, np.searchsorted(at, t)))
    usual = float(np.median(np.diff(at))) if len(at) > 1 else 0.0
    known = (t >= at[0]) & (t <= at[-1]) & (at[after] - at[before] <= SILENCE * usual)
    ahead = ((off * v).sum(axis=1) >= 0.0) & ((fast * v).sum(axis=1) >= 0.0)  # in front, and no oncoming car
    return [Raw(f"sender {wanted}", t, np.where(known & ahead, gap, np.nan), np.where(known & ahead, lead - speed, np.nan), speed)]


def _columns(messages: Sequence[tuple[float, Array, Array]]) -> tuple[Array, Array, Array]:
    return np.array([m[0] for m in messages]), np.array([m[1] for m in messages]), np.array([m[2] for m in messages])


def _number(data: dict[str, Any], key: str, where: str) -> float:
    value = data.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: {key}", value, "a number")
    return float(value)


def _vector(data: dict[str, Any], key: str, where: str) -> Array:
    value = data.get(key)
    if not isinstance(value, list) or len(value) not in (2, 3) or any(isinstance(x, bool) or not isinstance(x, int | float) for x in value):
        raise InputError(f"{where}: {key}", value, "two or three numbers [m] or [m/s]")
    return np.array(value[:2], np.float64)
