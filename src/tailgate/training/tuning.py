"""Search for hyper-parameters of a learner with Optuna (Akiba et al. 2019; extra: tune).

A trial trains one policy with the values that the sampler proposes. Its objective is the policy's mean outcome on fresh episodes of the
purpose `tune`, never on those that are reported. Trials are kept as a journal of JSON lines, so that the same command goes on where an
interrupted one stopped. A trial that was cut off is marked as failed and played again, with the same values if one process searches.

A space is a mapping of dotted fields of the training's configuration to one of

    {range: [low, high]}    even; whole numbers where both ends are
    {log: [low, high]}      even in the logarithm
    {choices: [a, b, ...]}  any values
"""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from tailgate.agents.learners.learning import Progress, learner_of
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base import sizes
from tailgate.base.errors import InputError, Killed, NotWritable, said, unknown
from tailgate.base.files import writable_directory, write_atomic, write_json
from tailgate.base.locks import alone
from tailgate.base.pool import apart, each
from tailgate.base.reading import lines_of, parse_json
from tailgate.core import draws
from tailgate.core.registry import Spec
from tailgate.core.schema import as_data, digest, fields_of, read_yaml
from tailgate.evaluation.cells import Cell
from tailgate.play.metrics import METRICS
from tailgate.play.trace import episodes_at_once, rollout
from tailgate.training.train import ENVIRONMENT, TrainConfig, load_config, outcome_of, train

if TYPE_CHECKING:
    from optuna import Study, Trial

Space = dict[str, dict[str, Any]]
SPACES: dict[str, Space] = {
    "ppo": {
        "ppo.learning_rate": {"log": [3e-4, 1e-2]},
        "ppo.epochs": {"range": [3, 15]},
        "ppo.gae_lambda": {"range": [0.8, 1.0]},
        "ppo.clip": {"range": [0.1, 0.4]},
        "ppo.entropy": {"choices": [0.0, 0.001, 0.003, 0.01]},
        "ppo.hidden": {"choices": [[32, 32], [64, 64], [128, 64]]},
        "ppo.rest": {"log": [0.02, 0.5]},
        "gamma": {"choices": [0.95, 0.98, 0.99, 0.995, 1.0]},
    },
    "cem": {
        "cem.population": {"choices": [16, 32, 64, 128]},
        "cem.episodes": {"choices": [8, 16, 24]},
        "cem.elite": {"range": [0.05, 0.3]},
        "cem.step": {"range": [0.4, 1.0]},
        "cem.sd": {"log": [0.2, 3.0]},
        "cem.extra": {"range": [0.0, 0.3]},
        "cem.hidden": {"choices": [[], [8], [16], [32]]},
        "cem.rest": {"range": [0.1, 0.9]},
    },
}
APART = 100  # between the seed of the trials and the first one of the preset: the best of many trials was lucky with its seed
FORMS = ("range", "log", "choices")
JOURNAL = "journal.jsonl"
BATCH = 256  # episodes side by side; changes no result
SAMPLER_STRIDE = 100_003  # between the sampler's seeds of two searches


@dataclass(frozen=True)
class Search:
    """One search: what is trained (the preset under the search's name), what is varied, and on how many episodes a trial is measured."""

    base: TrainConfig
    space: Space
    trials: int
    episodes: int = 400
    seed: int = 0

    @property
    def directory(self) -> Path:
        return self.base.directory

    @property
    def trained(self) -> TrainConfig:
        """The training of a trial: a seed that the run with the best parameters does not use, and no more than the trial needs."""
        rivals = self.base.rivals if self.base.teacher is not None else ()
        seed = self.base.first_seed + max(APART, self.base.seeds)
        one = dataclasses.replace(self.base, first_seed=seed, seeds=1, workers=1, tensorboard=False)
        return dataclasses.replace(one, rivals=rivals, white_box=(), others=())

    @property
    def digest(self) -> str:
        """A digest of everything that decides what a trial gives: a search goes on with the same one only."""
        return digest([self.trained, self.space, self.episodes, self.seed])


def optuna() -> ModuleType:
    """Return the Optuna module, without its log."""
    try:
        import optuna as module
    except ImportError as error:
        raise ImportError("the search needs Optuna: pip install 'tailgate[tune]'") from error
    module.logging.set_verbosity(module.logging.WARNING)
    return module


def read_space(source: str, learner: str) -> Space:
    """Return the built-in space of a learner (`default`), or one from a YAML file; every field and form checked."""
    if source == "default":
        if learner not in SPACES:
            raise InputError("space", source, f"a YAML file: only {', '.join(SPACES)} have a built-in space, {learner} has none")
        return SPACES[learner]
    space = read_yaml(Path(source), "space")
    for field, form in space.items():
        where = f"space.{field}"
        _known_field(where, field, learner)
        if not isinstance(form, dict) or len(form) != 1 or next(iter(form)) not in FORMS:
            raise InputError(where, form, f"one of {', '.join(FORMS)}")
        ((kind, values),) = form.items()
        if not isinstance(values, list) or not values:
            raise InputError(f"{where}.{kind}", values, "a list")
        if kind == "choices":
            continue
        numbers = len(values) == 2 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
        if not numbers or not values[0] < values[1] or (kind == "log" and values[0] <= 0):
            raise InputError(f"{where}.{kind}", values, "two numbers, low < high" + (", above 0" if kind == "log" else ""))
    if not space:
        raise InputError("space", source, "at least one field")
    return space


def _known_field(where: str, field: str, learner: str) -> None:
    """Raise InputError for a field that is none, or that would change what is attacked and not who learns."""
    below = {learner: fields_of(learner_of(learner).Config), "environment": ENVIRONMENT}
    known = {"gamma"} | {f"{name}.{inner}" for name, fields in below.items() for inner in fields if inner != "gamma"}
    if field not in known:
        raise unknown(where, field, known)


def make_search(
    source: str | None, overrides: list[str], trials: int, space: str = "default", learner: str | None = None, episodes: int = 400,
    seed: int = 0,
) -> Search:  # fmt: skip
    """Return the search of a preset; its files go to the folder `NAME-tune` among the runs. One training seed per trial."""
    sizes.check("trials", trials)
    sizes.check("episodes", episodes)
    config = load_config(source, overrides + ([f"learner={learner}"] if learner else []))
    base = dataclasses.replace(config, name=f"{config.name}-tune")
    if seed < 0:
        raise InputError("--seed", seed, "a whole number, not below 0")
    return Search(base, read_space(space, base.learner), trials, episodes, seed)


def configured(base: TrainConfig, values: dict[str, Any]) -> TrainConfig:
    """Return the base with dotted fields changed."""
    data: dict[str, Any] = {}
    for field, value in values.items():
        head, dot, leaf = field.partition(".")
        if dot and head not in fields_of(TrainConfig):  # a learner without a field
            head, leaf, value = "settings", head, {**data.get("settings", base.settings).get(head, {}), leaf: value}
        data[head] = {**data.get(head, getattr(base, head)), leaf: value} if dot else value
    return dataclasses.replace(base, **data)


def propose(trial: Trial, space: Space) -> dict[str, Any]:
    """Return values of every field, from an Optuna trial. Choices go by their JSON text, as they may be lists."""
    out: dict[str, Any] = {}
    for field, form in space.items():
        ((kind, values),) = form.items()
        if kind == "choices":
            out[field] = json.loads(trial.suggest_categorical(field, [json.dumps(value) for value in values]))
        elif all(isinstance(value, int) for value in values):
            out[field] = trial.suggest_int(field, *values, log=kind == "log")
        else:
            out[field] = trial.suggest_float(field, *map(float, values), log=kind == "log")
    return out


def objective(config: TrainConfig, policy: Path, episodes: int) -> float:
    """Return the mean outcome of a policy against the defence that it was trained on, on the purpose `tune`."""
    attack, spec, outcome = PolicyAttack(policy), Spec("defence", config.defence), outcome_of(config)
    cell = Cell("tune", config.scenario, None, config.defence, str(policy), episodes, "tune", threat=config.threat)
    loop = cell.place(attack, "black").loop(spec.make(), spec.entry.uses)
    size = episodes_at_once(loop.model, loop.horizon, BATCH)
    parts = [range(start, min(start + size, episodes)) for start in range(0, episodes, size)]
    return float(np.concatenate([METRICS[outcome](rollout(loop, attack, draws.keys("tune", part))) for part in parts]).mean())


class _JournalLock:
    """The kernel's lock on the journal, in place of Optuna's, which outlives a process that is killed and then costs 30 seconds."""

    def __init__(self, path: Path) -> None:
        self.path, self.handles = path, list[int]()

    def acquire(self) -> bool:
        self.handles.append(os.open(self.path, os.O_RDONLY | os.O_CREAT, 0o644))
        fcntl.flock(self.handles[-1], fcntl.LOCK_EX)
        return True

    def release(self) -> None:
        os.close(self.handles.pop())


def _mend(path: Path) -> None:
    """Take back what a killed process had begun to write: the journal ends with a whole line."""
    if path.is_file():
        held = path.read_bytes()
        whole = held.rfind(b"\n") + 1
        with contextlib.suppress(ValueError):  # no journal at all: it stays as it is, for its reader to refuse
            for line in held[:whole].splitlines():
                parse_json(line, strict=False)
            if held[whole:].startswith(b"{"):
                os.truncate(path, whole)


def _open(search: Search, ordinal: int | None = None) -> Study:
    """Return the search's study. Each trial gets a fresh sampler: a search that goes on proposes what an uninterrupted one would."""
    module = optuna()
    path = search.directory / JOURNAL
    backend = module.storages.journal.JournalFileBackend(str(path), _JournalLock(path))  # JSON lines, never pickles
    sampler = module.samplers.TPESampler(seed=(search.seed * SAMPLER_STRIDE + (ordinal or 0)) % 2**32, multivariate=False)
    with _journal_of(search):
        storage = module.storages.JournalStorage(backend)
        study: Study = module.create_study(
            storage=storage, sampler=sampler, study_name=search.base.name, direction="maximize", load_if_exists=True
        )
    return study


@contextlib.contextmanager
def _journal_of(search: Search) -> Iterator[None]:
    """Turn, within a block, what Optuna says of a journal into an InputError that names the file: it checks nothing that it reads."""
    path = search.directory / JOURNAL
    try:
        if path.is_file():
            lock = _JournalLock(path)
            lock.acquire()  # another worker may be writing a line
            try:
                for line in lines_of(path):
                    parse_json(line, strict=False)
            finally:
                lock.release()
        yield
    except InputError:
        raise
    except (OSError, ValueError, LookupError, TypeError, AttributeError, AssertionError, ArithmeticError) as error:
        raise InputError("tune", str(path), f"a journal of a search ({type(error).__name__}: {said(error)})") from None


def _trial(search: Search, ordinal: int, report: Callable[[int, Progress | None], None] | None = None) -> None:
    """Train and measure one trial. Values that a learner refuses, and a policy without an outcome, cost this trial alone."""
    module, study = optuna(), _open(search, ordinal)
    trial = study.ask()
    trial.set_user_attr("ordinal", ordinal)
    values = propose(trial, search.space)
    started = time.perf_counter()
    config = dataclasses.replace(configured(search.trained, values), name=f"trial-{ordinal}", out=str(search.directory))
    try:
        (policy,) = train(config, lambda seed, now: None if report is None else report(ordinal, now))
        value = objective(config, policy, search.episodes)
        if not np.isfinite(value):
            raise InputError("outcome", value, "a metric that every episode has")
    except (NotWritable, Killed):
        raise
    except InputError as error:
        trial.set_user_attr("reason", str(error))
        study.tell(trial, state=module.trial.TrialState.FAIL)
        return
    trial.set_user_attr("seconds", time.perf_counter() - started)
    trial.set_user_attr("policy", str(policy))
    study.tell(trial, value)


def _begin(search: Search) -> Study:
    """Open the study, check that it is of this very search, and mark the trials of an interrupted one as failed."""
    module = optuna()
    writable_directory(search.directory)
    _mend(search.directory / JOURNAL)
    study = _open(search)
    held = study.user_attrs.get("digest")
    if held is None:
        study.set_user_attr("digest", search.digest)
    elif held != search.digest:
        raise InputError("tune", str(search.directory), "a search of this configuration, space, episodes and seed, or another name=NAME")
    for trial in study.get_trials(deepcopy=False, states=(module.trial.TrialState.RUNNING,)):
        study.tell(trial.number, state=module.trial.TrialState.FAIL)
    return study


def tune(search: Search, workers: int = 1, progress: Callable[[int, Progress | None], None] | None = None) -> dict[str, Any]:
    """Play the trials that are missing; writes best.yaml and trials.json into the search's directory; returns the report.

    With several workers that many trials are played at a time; which values they get then depends on who ends first.
    """
    sizes.check("workers", workers)
    sizes.announce(search.trials * search.base.steps / sizes.DECISIONS_A_SECOND / workers, 0.0, f"{search.trials:,} trainings")
    with alone(search.directory):
        return _tuned(search, workers, progress)


def _tuned(search: Search, workers: int, progress: Callable[[int, Progress | None], None] | None) -> dict[str, Any]:
    study = _begin(search)
    settled = {entry["ordinal"] for entry in _entries(study) if entry["state"] == "complete" or entry["reason"]}
    missing = [i for i in range(search.trials) if i not in settled]
    if not apart(workers, len(missing)):
        for ordinal in missing:
            _trial(search, ordinal, progress)
    else:
        with contextlib.closing(each(_trial, [(search, ordinal) for ordinal in missing], workers)) as trials:
            for i, _ in trials:
                if progress is not None:
                    progress(missing[i], None)
    return _report(search, _open(search))


def _entries(study: Study) -> list[dict[str, Any]]:
    """Return what is known of each trial, in its order."""
    return [
        {
            "ordinal": trial.user_attrs.get("ordinal"), "state": trial.state.name.lower(), "value": trial.value,
            "parameters": {
                field: json.loads(value) if isinstance(value, str) else value for field, value in trial.params.items()
            },
            "seconds": trial.user_attrs.get("seconds"), "policy": trial.user_attrs.get("policy"),
            "reason": trial.user_attrs.get("reason", ""),
        }
        for trial in study.get_trials(deepcopy=False)
    ]  # fmt: skip


def _report(search: Search, study: Study) -> dict[str, Any]:
    entries = sorted((e for e in _entries(study) if e["state"] == "complete" or e["reason"]), key=lambda e: e["ordinal"])
    good = [entry for entry in entries if entry["state"] == "complete"]
    best = max(good, key=lambda entry: (entry["value"], -entry["ordinal"]), default=None)
    report: dict[str, Any] = {
        "name": search.base.name, "scenario": search.base.scenario, "defence": search.base.defence, "learner": search.base.learner,
        "steps": search.base.steps, "outcome": outcome_of(search.base), "purpose": "tune", "episodes": search.episodes, "seed": search.seed,
        "space": as_data(search.space), "best": best, "trials": entries,
    }  # fmt: skip
    if best is not None:
        name = search.base.name.removesuffix("-tune")
        data = as_data(dataclasses.replace(configured(search.base, best["parameters"]), name=f"{name}-tuned"))
        kept = {key: value for key, value in data.items() if key != "class" and value not in ({}, None)}
        path = search.directory / "best.yaml"
        write_atomic(path, yaml.safe_dump(kept, sort_keys=False).encode())
        report["config"] = str(path)
    write_json(search.directory / "trials.json", report)
    return report
