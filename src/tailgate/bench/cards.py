"""The speed of a card: whole steps in one launch each and in launches of many, with the bits of the processor checked first."""

from __future__ import annotations

import datetime
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tailgate.base.errors import unknown
from tailgate.base.files import writable_directory, write_json
from tailgate.base.provenance import commit
from tailgate.base.version import VERSION
from tailgate.core import draws
from tailgate.engine.agreement import Untraced, same
from tailgate.engine.cards import Card, Memory, card
from tailgate.engine.on_device import CudaProgram, DeviceCall, bound
from tailgate.engine.program import Call
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.programs import Rows, SeatPrograms, programs_of

from .run import Report, machine

FORMAT, FILE = "tailgate-bench-cuda-1", "cuda.json"
MANY = 100  # steps of a launch
CHECKED = 2048, 48  # rows and decisions that are compared with the processor
COPIED = 1 << 30  # bytes of the copy that measures the memory


class Plant(NamedTuple):
    """A scenario, a defence, and the rows, fewer where a card has no room for them."""

    scenario: str
    defence: str
    rows: int


PLANTS = {
    "car following": Plant("gusty-stop-and-go-v0", "chi2_kf", 1 << 20),
    "radar": Plant("radar-following-v0", "cra", 1 << 20),
    "platoon of 5": Plant("platoon-gusty-v0", "dkf", 1 << 20),
    "platoon of 5, chi2_dkf": Plant("platoon-gusty-v0", "chi2_dkf", 1 << 16),
}


def seat_of(plant: Plant, interval: int) -> Seat:
    """Return the seat that is measured: each decision of the attacker is an injection or nothing."""
    action: dict[str, Any] = {"action": "timing", "kind": "fdi", "value": -1.0, "interval": interval}
    return Seat.make(scenario=plant.scenario, defence=plant.defence, threat={"kinds": ["fdi"]}, **action)


def programs(plant: Plant, interval: int, device: str) -> SeatPrograms:
    """Return the programs of a plant; those of a card have been compared with the plain loop."""
    found = programs_of(seat_of(plant, interval), device)
    if isinstance(found, Untraced):
        raise RuntimeError(f"{plant.scenario}, {plant.defence}: {found.why}")
    return found


def compared(plant: Plant, rows: int, decisions: int, interval: int) -> dict[str, Any]:
    """Play rows on the card and on the processor, with restarts; return how many arrays of the state and results differ."""
    there, here = (Rows(programs(plant, interval, device), rows) for device in ("cuda", "cpu"))
    chance, differ, values = np.random.default_rng(0), 0, 0
    for of in (there, here):
        of.begin(np.ones(rows, bool), draws.keys("tune", range(rows)))
    for _ in range(decisions):
        actions, over = (chance.random(rows) < 0.3).astype(np.int64), chance.random(rows) < 0.05
        for of in (there, here):
            of.decide(actions, over, over)
        wanted = here.held() | here.brought
        for name, got in (there.held() | there.brought).items():
            differ += not same(got, wanted[name])
            values += got.size
    return {"rows": rows, "steps": decisions * interval, "values": values, "arrays_that_differ": differ}


class Flight:
    """Decisions of a plant on the card: nothing is copied from or to it. The attacker rests; episodes that end begin again."""

    def __init__(self, plant: Plant, interval: int) -> None:
        made = programs(plant, interval, "cuda")
        assert isinstance(made.decide, CudaProgram)
        self.programs, self.interval, self.card = made, interval, made.decide.card
        free = max(1, int(0.5 * self.card.free() / (made.decide.bytes_of_row() + 64)))
        self.rows = min(plant.rows, max(32, free // 32 * 32))
        self._state = Rows(made, self.rows)
        self._state.begin(np.ones(self.rows, bool), draws.keys("tune", range(self.rows)))
        self._decide = _on_card(made.decide.call(self._state.state, values=made.values))
        self._calls = [self._decide]
        if made.advance is not None:
            advance = made.advance.call(self._state.state, made.between, made.values, like=self._decide)
            self._calls = [_on_card(advance), self._decide]
        self._rest = Memory(self.card, 8 * self.rows)  # actions: none
        self._sheets = [Memory(self.card, self._decide.size) for _ in range(2)]  # of the last decision, and of this one
        self._empty = Memory(self.card, max(call.size for call in self._calls))
        self._ends = self._decide.places()["truncated"][2]

    def decide(self) -> int:
        """Play a decision of all rows; return its steps."""
        over = self._sheets[0].at + self._ends  # those whose time was up with the last decision
        for call in self._calls:
            call.sheet_at = self._sheets[1].at if call is self._decide else self._empty.at
            call.arguments_at = {"action": self._rest.at, "over": over, "again": over}
            call.begin()
            call.play(call.steps)
        self._sheets.reverse()
        return self.rows * self.interval

    def rate(self, seconds: float) -> float:
        """Return steps per second over about these seconds."""
        self.card.wait()
        begun, done = time.perf_counter(), 0
        while True:
            done += self.decide()
            self.card.wait()
            if (spent := time.perf_counter() - begun) >= seconds:
                return done / spent

    def facts(self) -> dict[str, Any]:
        """Return what bounds the speed: registers, local memory, buffers, and bytes that a step has to move at least."""
        call = self._calls[0]
        program = call.program
        assert isinstance(program, CudaProgram)
        moved = 2.0 * program.stride / 32 / call.steps + program.bytes_of_row(1) - program.stride / 32
        facts = self.card.facts(program.code.kernel(call.kernel))
        return facts | {"buffers": program.room // 32, "bytes_of_a_step": round(moved, 1), **program.size}


def _on_card(call: Call) -> DeviceCall:
    assert isinstance(call, DeviceCall)
    return call


def bandwidth(on: Card) -> float:
    """Return the bytes per second that a copy on the card reads and writes."""
    size = min(COPIED, on.free() // 8)
    one, two = Memory(on, size), Memory(on, size)
    times = []
    for _ in range(5):
        on.wait()
        begun = time.perf_counter()
        on.copy(two.at, one.at, size)
        on.wait()
        times.append(time.perf_counter() - begun)
    return 2.0 * size / min(times)


def bench(only: Sequence[str] | None = None, rounds: int = 7, seconds: float = 0.5, progress: Report | None = None) -> dict[str, Any]:
    """Measure the card, and return the record: bits first, then the median of rounds of each line."""
    for name in only or ():
        if name not in PLANTS:
            raise unknown("only", name, PLANTS)
    chosen = {name: plant for name, plant in PLANTS.items() if not only or name in only}
    on, turn, total = card(), 0, 3 * len(chosen)

    def said(what: str) -> None:
        nonlocal turn
        if progress is not None:
            progress("measuring the card", turn, total, what)
        turn += 1

    copy = bandwidth(on)
    checks: list[dict[str, Any]] = []
    lines: list[dict[str, Any]] = []
    for name, plant in chosen.items():
        said(f"{name}: bits")
        checks += [{"name": name} | compared(plant, CHECKED[0], CHECKED[1] // (1 if interval == 1 else 8), interval) for interval in (1, 4)]
        for interval in (1, MANY):
            said(f"{name}: {interval} steps a launch")
            lines.append(_line(name, plant, interval, rounds, seconds, copy))
    said("done")
    return {
        "format": FORMAT, "version": VERSION, "commit": commit(), "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "card": {"name": on.name, "compiler": on.kind, "copy_bytes_per_second": copy, "blocks": bound()}, "machine": machine(),
        "equal": not any(check["arrays_that_differ"] for check in checks), "checks": checks, "lines": lines,
    }  # fmt: skip


def _line(name: str, plant: Plant, interval: int, rounds: int, seconds: float, copy: float) -> dict[str, Any]:
    begun = time.perf_counter()
    flight = Flight(plant, interval)
    made = time.perf_counter() - begun
    flight.rate(0.0)
    rates = [flight.rate(seconds) for _ in range(rounds)]
    facts, rate = flight.facts(), statistics.median(rates)
    return {
        "name": name, "scenario": plant.scenario, "defence": plant.defence, "rows": flight.rows, "steps_a_launch": max(1, interval - 1),
        "steps_per_second": rate, "rounds": rates, "made_seconds": made, **facts, "share_of_copy": rate * facts["bytes_of_a_step"] / copy,
    }  # fmt: skip


def print_record(record: dict[str, Any], table: Callable[..., None]) -> None:
    """Print a record as tables."""
    rows = [
        (line["name"], f"{line['rows']:,}", str(line["steps_a_launch"]), f"{line['steps_per_second'] / 1e6:,.1f}", str(line["registers"]),
         str(line["local"]), f"{line['bytes_of_a_step']:,.0f}", f"{100 * line['share_of_copy']:.0f} %")
        for line in record["lines"]
    ]  # fmt: skip
    heads = ("plant", "rows", "steps a launch", "M steps/s", "registers", "local [bytes]", "bytes a step", "of a copy's bytes/s")
    table(heads, rows, record["card"]["name"])
    table(
        ("compared with the processor", "rows", "steps", "values", "arrays that differ"),
        [(c["name"], str(c["rows"]), str(c["steps"]), f"{c['values']:,}", str(c["arrays_that_differ"])) for c in record["checks"]],
    )


def write(record: dict[str, Any], folder: Path) -> Path:
    """Write the record; return its file."""
    path = writable_directory(folder) / FILE
    write_json(path, record)
    return path
