"""Evaluation: cells (scenario x dose x defence x attack) to rows, one per episode.

A row names everything that is needed to play it again. Finished cells are kept next to the output until all are done.
An interrupted run therefore resumes, and a component that crashes loses only its own rows.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import hashlib
import inspect
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.base import own_modules, sizes, sources
from tailgate.base.errors import InputError, NotApplicable, known_arguments
from tailgate.base.files import set_aside, writable_directory, write_atomic
from tailgate.base.locks import alone
from tailgate.base.pool import apart, each
from tailgate.base.reading import YAML_ENDS
from tailgate.base.version import VERSION
from tailgate.core import Attack, Defence, Model, draws
from tailgate.core.foreign import with_place
from tailgate.core.registry import Entry, Family, Spec, entry_for, text_of
from tailgate.core.scenario import Scenario, ScenarioLike, Suite, load_scenario, load_suite
from tailgate.core.schema import as_data, canonical
from tailgate.core.threat import Brief
from tailgate.engine.cards import DeviceError, device, playing_on
from tailgate.evaluation.arguments import distinct, named_scenarios, several
from tailgate.evaluation.devices import check_cells
from tailgate.evaluation.frame import Rows
from tailgate.evaluation.resume import complete
from tailgate.evaluation.rounds import numbered
from tailgate.evaluation.rows import packed
from tailgate.evaluation.summary import ENTRY
from tailgate.play.metrics import METRICS, Function, Own, measure, own_metric
from tailgate.play.shapes import culprit
from tailgate.play.trace import Trace, episode_memory, episodes_at_once, rollout

ENGINE = "plain"
RESULT = ("seed", "status", "reason", "trace_hash", "decision_hash")  # columns that the head of a row has not, next to metrics


@dataclass(frozen=True)
class Cell:
    """Episodes that share everything but their seed."""

    suite: str
    scenario: str
    dose: int | None
    defence: str
    attack: str
    seeds: int
    purpose: str = "report"
    first_seed: int = 0
    batch: int = 256
    threat: dict[str, Any] = field(default_factory=dict)
    beacon: str = ""
    metrics: tuple[str, ...] = ()  # of somebody's own, as `own_metric` takes them
    given: Scenario | None = None  # the scenario, where it is an object and `scenario` only its name

    @property
    def episodes(self) -> Sequence[int]:
        """Seeds of its episodes: numbers, or those of the round of its beacon."""
        return numbered(self.beacon, self.suite, self.purpose, self.first_seed, self.seeds)

    @property
    def base(self) -> Scenario:
        """The scenario at its own dose, with its own threat model."""
        return load_scenario(self.scenario) if self.given is None else self.given

    def place(self, attack: Attack, knowledge: str) -> Scenario:
        """Return the scenario at the cell's dose, with the knowledge that the attack needs."""
        changes: dict[str, Any] = dict(self.threat)
        if self.dose is not None:
            changes["budget"] = self.dose
        changes.setdefault("knowledge", getattr(attack, "knowledge", knowledge))
        if getattr(attack, "sees_measurement", False):
            changes["sees_measurement"] = True
        return self.base.with_threat(**changes)


def component(family: Family, value: object) -> tuple[Any, Entry, str]:
    """Return (object, entry, text) of a spec text or an object."""
    if isinstance(value, str):
        spec = Spec(family, value)
        return spec.make(), spec.entry, value
    entry = entry_for(family, type(value))
    return value, entry, text_of(entry, value)


def run_cell(
    cell: Cell, defence: Defence | None = None, attack: Attack | None = None, *, uses: tuple[str, ...] | None = None
) -> list[dict[str, Any]]:
    """Play a cell and return its rows.

    `defence` and `attack` replace the cell's texts by objects; `uses` overrides what the defence may use.
    """
    identity = cell_id(cell) if defence is None and attack is None else ""
    defence, defence_entry, _ = component("defence", cell.defence if defence is None else defence)
    attack, attack_entry, _ = component("attack", cell.attack if attack is None else attack)
    place = cell.place(attack, attack_entry.knowledge)
    head = _head(cell, place, defence_entry, attack_entry, identity)
    rows, seeds = list[dict[str, Any]](), cell.episodes
    own = [own_metric(text) for text in cell.metrics]
    try:
        loop = place.loop(defence, defence_entry.uses if uses is None else uses)
        size = episodes_at_once(loop.model, loop.horizon, cell.batch)
    except Exception as error:
        return _failed(head, seeds, *_why(error))
    for start in range(0, cell.seeds, size):
        chunk = seeds[start : start + size]
        try:
            rows += _played(head, chunk, rollout(loop, attack, draws.keys(cell.purpose, chunk)), own)
        except Exception as error:  # a component may raise anything; only its own rows are lost
            rows += _failed(head, chunk, *_why(error, chunk, culprit(error, loop, attack, draws.keys(cell.purpose, chunk))))
    return rows


def _played(head: dict[str, Any], seeds: Sequence[int], trace: Trace, own: Sequence[Own] = ()) -> list[dict[str, Any]]:
    """Return the rows of a trace, one per seed."""
    rows, values = [], measure(trace) | {one.name: one(trace) for one in own}
    for i, seed in enumerate(seeds):
        numbers = {name: None if np.isnan(v[i]) else float(v[i]) for name, v in values.items()}
        hashes = {"trace_hash": trace.trace_hash(i), "decision_hash": trace.decision_hash(i)}
        rows.append(_own(head) | {"seed": seed, "status": "ok", "reason": "", **numbers, **hashes})
    return rows


def _why(error: Exception, seeds: Sequence[int] = (), more: str = "") -> tuple[str, str]:
    """Return the reason and status of the rows of these seeds, which an error affects. more: what else is known."""
    if isinstance(error, DeviceError):
        raise error
    if isinstance(error, NotApplicable):
        return str(error), "skipped"
    row = error.row if isinstance(error, InputError) else None
    more = f"row {row}: seed {seeds[row]}" if row is not None and row < len(seeds) else more
    return with_place(error) + (f" ({more})" if more else ""), "error"


def _head(cell: Cell, place: Scenario, defence: Entry, attack: Entry, identity: str) -> dict[str, Any]:
    threat = place.threat_model
    head = {
        "suite": cell.suite, "scenario": place.name, "scenario_file": cell.scenario if cell.scenario.endswith(YAML_ENDS) else "",
        "threat_model": as_data(threat), "dose": threat.budget,
        "knowledge": threat.knowledge, "defence": cell.defence, "uses": list(defence.uses), "attack": cell.attack,
        "learned": attack.learned, "optimal": attack.optimal, "purpose": cell.purpose, "beacon": cell.beacon, "batch": cell.batch,
        "engine": ENGINE, "versions": {"defence": defence.version, "attack": attack.version},
        "defence_digest": _digest("defence", cell.defence, identity), "attack_digest": _digest("attack", cell.attack, identity),
        "config_hash": place.config_hash, "version": VERSION, "cell": identity,
        "trained": origin(cell.attack) if identity else None, **({} if device() == "cpu" else {"device": device()}),
    }  # fmt: skip
    own = [own_metric(text).name for text in cell.metrics]
    for i, name in enumerate(own):
        if name in (*head, *RESULT, "metrics", *ENTRY) or name in own[:i]:
            raise InputError("metric", name, "a name that no column of a row has, and no other metric")
    return head | ({"metrics": own} if own else {})


def origin(attack: str) -> dict[str, Any] | None:
    """Return how a learned attack was trained, from its file; None for other attacks."""
    from tailgate.studies.policies import origin_of

    return origin_of(attack)


def _digest(family: Family, text: str, identity: str) -> str:
    """Return the digest of the file of a component that is not built in; objects have none."""
    return Spec(family, text).digest if identity else ""


def _failed(head: dict[str, Any], seeds: Iterable[int], reason: str, status: str = "error") -> list[dict[str, Any]]:
    empty = dict.fromkeys([*METRICS, *head.get("metrics", ()), "trace_hash", "decision_hash"])
    return [_own(head) | {"seed": seed, "status": status, "reason": " ".join(reason.split())[:500], **empty} for seed in seeds]


def _own(head: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of the head of a row, so that rows share no mutable values."""
    return {key: copy.deepcopy(value) if isinstance(value, (dict, list)) else value for key, value in head.items()}


def failed_rows(cell: Cell, reason: str) -> list[dict[str, Any]]:
    """Return the rows of a cell that could not be played."""
    spec = Spec("attack", cell.attack)
    head = _head(cell, cell.place(spec.make(), spec.entry.knowledge), Spec("defence", cell.defence).entry, spec.entry, cell_id(cell))
    return _failed(head, cell.episodes, reason)


def cell_id(cell: Cell) -> str:
    """Return a hash of everything that determines a cell's rows; a finished cell with this id is not played again."""
    data = dataclasses.asdict(dataclasses.replace(cell, given=None))
    data["sources"] = [Spec("defence", cell.defence).digest, Spec("attack", cell.attack).digest]
    place = cell.base
    data["scenario"] = place.config_hash
    parts: list[type | Function] = [type(part) for part in (place.plant, place.sensor, place.controller, place.manoeuvre)]
    data["code"] = [_code(one) for one in (*parts, *(own_metric(text).function for text in cell.metrics))]
    return hashlib.blake2b(f"{VERSION}/{sources.own()}/{canonical(data)}".encode(), digest_size=12).hexdigest()


def _code(value: type | Function) -> str:
    """Return the hash of the file that defines somebody's class or function, or of the source in a notebook; empty for this package's."""
    if value.__module__.partition(".")[0] == "tailgate":
        return ""
    if files := own_modules.files_of(value):
        return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
    with contextlib.suppress(OSError, TypeError):
        return hashlib.sha256(inspect.getsource(value).encode()).hexdigest()
    return ""


@contextlib.contextmanager
def _sparing() -> Iterator[None]:
    """Let only InputError through: a component that fails or does not apply loses its own rows when it is played."""
    try:
        yield
    except NotApplicable:
        return
    except InputError:
        raise
    except (Exception, SystemExit):
        return


def cells_of(
    suite: Suite, *, batch: int = 256, purpose: str = "report", threat: dict[str, Any] | None = None, beacon: str = "",
    first_seed: int = 0, metrics: Sequence[str] = (), given: Mapping[str, Scenario] | None = None,
) -> list[Cell]:  # fmt: skip
    """Return the cells of a suite in order, from episode `first_seed` on; raise InputError for anything that does not exist.

    given: scenarios that are objects, by the names that the suite has.
    """
    if purpose not in draws.PURPOSES:
        raise InputError("purpose", purpose, f"one of {', '.join(draws.PURPOSES)}")
    _ = numbered(beacon, suite.name, purpose, 0, 1)  # checks the beacon
    rest = suite.seeds, purpose, first_seed, batch, suite.granted | dict(threat or {}), beacon, tuple(metrics)
    out = [
        Cell(suite.name, scenario, dose, defence, attack, *rest, (given or {}).get(scenario))
        for scenario in suite.scenarios for dose in suite.doses for defence in suite.defences for attack in suite.attacks
    ]  # fmt: skip
    models: dict[str, Model] = {}
    fitted: set[tuple[str, str]] = set()
    for cell in out:
        attack_spec, defence_spec = Spec("attack", cell.attack), Spec("defence", cell.defence)
        attack, defence = attack_spec.make(), defence_spec.make()
        place = cell.place(attack, attack_spec.entry.knowledge)
        if (cell.scenario, cell.defence) not in fitted:  # once, because a filter of a large network is slow to prepare
            fitted.add((cell.scenario, cell.defence))
            with _sparing():
                place.loop(defence, defence_spec.entry.uses)
        if cell.scenario not in models:
            models[cell.scenario] = model = place.brief().model
            needed = 2 * episode_memory(model, place.horizon)  # twice, for the metrics
            sizes.fits(needed, f"scenario {place.name}: horizon", place.horizon, "the signals of one episode")
        brief = Brief(models[cell.scenario], place.threat_model, place.horizon)
        _ = brief.granted  # checks the names of wires and agents
        with _sparing():
            attack.prepare(brief)
    return out


def run(
    cells: Sequence[Cell], out: Path | None = None, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> list[dict[str, Any]]:
    """Play cells and return their rows in order; with `out`, skip cells that an interrupted run finished."""
    sizes.check("workers", workers)
    count = sum(sizes.check("seeds", cell.seeds) for cell in cells)
    sizes.fits(count * sizes.ROW, "seeds", max((cell.seeds for cell in cells), default=0), f"{count:,} rows")
    sizes.announce(count / sizes.EPISODES_A_SECOND / workers, count * sizes.ROW, f"{count:,} episodes")
    check_cells(cells, workers)
    ids = [cell_id(cell) for cell in cells]
    pieces = {i: [(i, seed) for seed in cell.episodes] for i, cell in zip(ids, cells, strict=True)}
    return complete(ids, pieces, out, lambda missing: _play([cells[i] for i in missing], workers), progress)


def _play(cells: Sequence[Cell], workers: int) -> Generator[tuple[int, list[dict[str, Any]]]]:
    foreign = any(Spec("defence", cell.defence).imports or Spec("attack", cell.attack).imports for cell in cells)
    if device() != "cpu" or not (foreign or apart(workers, len(cells))):
        for i, cell in enumerate(cells):
            yield i, run_cell(cell)
        return
    yield from each(
        run_cell, [(cell,) for cell in cells], workers, lambda i: failed_rows(cells[i], "the process that played this cell died")
    )


@known_arguments
def evaluate(
    suite: str | Suite | None = None,
    *,
    defences: object | Sequence[object] | None = None,
    attacks: object | Sequence[object] | None = None,
    scenarios: ScenarioLike | Sequence[ScenarioLike] | None = None,
    doses: int | Sequence[int | None] | None = None,
    seeds: int | None = None,
    purpose: str = "report",
    batch: int = 256,
    workers: int = 1,
    out: Path | str | None = None,
    threat: dict[str, Any] | None = None,
    beacon: str = "",
    progress: Callable[[int, int], None] | None = None,
    device: str | None = None,
    metrics: str | Sequence[str] = (),
) -> Rows:
    """Play a suite, or the part of it given by the arguments, and return its rows: a list, which a notebook shows as a table.

    Parameters
    ----------
    suite : name or object; without it, give scenarios, defences and attacks
    defences, attacks : names or objects, one or a list
    scenarios : one or a list: names, YAML files, mappings of fields, or objects
    doses : one or a list; with scenarios and seeds, they replace those of the suite
    threat : changes of the scenarios' threat models; rows then belong to the suite `custom`
    beacon : the round that the episodes belong to
    batch, workers : episodes played together, and processes; they change no bit
    out : file for the rows
    metrics : your own, one or a list: names of entry points, or module:function; a column of the rows each
    device : cpu or cuda; changes no bit. None is that of `tailgate.engine.cards.playing_on`, cpu if nobody chose

    Raises
    ------
    InputError
        An argument is invalid; nothing is played then.
    """
    if device is not None:
        with playing_on(device):
            return evaluate(
                suite, defences=defences, attacks=attacks, scenarios=scenarios, doses=doses, seeds=seeds, purpose=purpose, batch=batch,
                workers=workers, out=out, threat=threat, beacon=beacon, progress=progress, metrics=metrics,
            )  # fmt: skip
    base = load_suite(suite) if isinstance(suite, str) else suite if suite is not None else Suite(name="custom")
    defences, attacks = several(base.defences if defences is None else defences), several(base.attacks if attacks is None else attacks)
    if threat and base.granted | threat != base.granted and not beacon:  # no longer what the suite is about; a beacon's seeds need the name
        base = dataclasses.replace(base, name="custom")
    sizes.check("batch", batch)
    sizes.check("workers", workers)
    sizes.check("seeds", base.seeds if seeds is None else seeds)
    places = named_scenarios(several(base.scenarios if scenarios is None else scenarios))
    given = {name: place for name, place in places.items() if place is not None}
    named = dataclasses.replace(
        base,
        scenarios=tuple(places),
        doses=tuple(several(base.doses if doses is None else doses)),
        defences=tuple(d for d in defences if isinstance(d, str)),
        attacks=tuple(a for a in attacks if isinstance(a, str)),
        seeds=base.seeds if seeds is None else seeds,
    )
    for name, value in (("scenarios", named.scenarios), ("defences", defences), ("attacks", attacks)):
        if not value:
            raise InputError(name, list(value), "at least one")
    for dose in named.doses:
        if dose is not None and (isinstance(dose, bool) or not isinstance(dose, int) or dose < 0):
            raise InputError("dose", dose, "a whole number of attack steps, not below 0")
    distinct("defence", [(component("defence", one)[2], one) for one in defences])
    distinct("attack", [(component("attack", one)[2], one) for one in attacks])
    own, place = tuple(several(metrics)), Path(out) if out is not None else None
    objects = not all(isinstance(one, str) for one in (*defences, *attacks))
    if place is not None and objects:
        writable_directory(place.parent, asked=place)
        if place.is_dir():
            raise InputError("out", str(place), "a file, not a directory")
    cells = cells_of(named, batch=batch, purpose=purpose, threat=threat, beacon=beacon, metrics=own, given=given)
    rows = run(cells, place, workers, progress) if cells else []
    with alone(place) if place is not None and objects else contextlib.nullcontext():
        for defence in defences:
            for attack in attacks:
                if isinstance(defence, str) and isinstance(attack, str):
                    continue
                guard, adversary = component("defence", defence)[2], component("attack", attack)[2]
                for scenario in named.scenarios:
                    for dose in named.doses:
                        rest = named.seeds, purpose, 0, batch, named.granted | dict(threat or {}), beacon, own, given.get(scenario)
                        rows += run_cell(Cell(named.name, scenario, dose, guard, adversary, *rest), defence, attack)
        if place is not None and objects:
            if not cells and place.exists():  # else `run` has set aside what was there
                set_aside(place)
            write_atomic(place, packed(rows, place))
    return Rows(rows)
