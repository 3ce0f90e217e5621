"""Trainings, each of one seed, one after another or side by side in processes."""

from __future__ import annotations

import contextlib
import gc
import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tailgate.agents.learners.learning import Config, Learner, Progress, Teachable, learner_of, made_with
from tailgate.agents.learners.teacher import demonstrate
from tailgate.base.errors import InputError, Killed, said
from tailgate.base.files import write_atomic
from tailgate.base.pool import apart, crew, say
from tailgate.base.reading import load_json
from tailgate.core.registry import Spec
from tailgate.core.schema import as_data
from tailgate.engine.cards import playing_on

if TYPE_CHECKING:
    from tailgate.training.train import TrainConfig


class Training(NamedTuple):
    """The training of one seed."""

    config: TrainConfig
    seed: int
    resume: bool
    settings: Config  # the learner's hyper-parameters, checked
    environment: dict[str, Any]  # arguments of the environment
    teacher: str | None  # whose decisions the learner is shown first

    def failed(self, error: BaseException) -> BaseException:
        """Return the error, which says now in which training it came up."""
        if isinstance(error, InputError):
            return type(error)(f"{self}: {error.field}", error.value, error.expected)
        error.add_note(f"in the training {self}")
        return error

    def __str__(self) -> str:
        return f"{self.config.name}, seed {self.seed}"


Report = Callable[[Training, Progress], None]


def train_all(trainings: Sequence[Training], begin: Callable[[Training], None], progress: Report, workers: int) -> list[Path]:
    """Train in as many processes as there are workers, and return JSON files of the policies in the order of the trainings.

    begin: called with each, before anything of it is done. Where one fails, those that have begun end, no other begins, and the error
    names it.
    """
    if apart(workers, len(trainings)):
        return _train_apart(trainings, begin, progress, min(workers, len(trainings)))
    paths = []
    for training in trainings:
        begin(training)
        try:
            paths.append(_train(training, partial(progress, training)))
        except Exception as error:
            raise training.failed(error) from error.__cause__
    return paths


def curve_of(path: Path) -> dict[str, Any]:
    """Return what curve-SEED.json of a run holds: `curve`, a list of points, and `seconds`. Raises InputError for anything else."""
    try:
        held = load_json(path, strict=False)
    except (OSError, ValueError) as error:
        raise InputError("curve", str(path), f"a readable curve of a training ({said(error)})") from None
    data: dict[str, Any] = held if isinstance(held, dict) else {}
    points, seconds = data.get("curve"), data.get("seconds", 0.0)
    if not isinstance(points, list) or not all(isinstance(point, dict) and {"steps", "crash"} <= set(point) for point in points):
        raise InputError("curve", str(path), "the curve of a training, a list of points")
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 <= seconds < float("inf"):
        raise InputError(f"curve {path}: seconds", seconds, "a number of seconds")
    return data


def spent(path: Path) -> float:
    """Return the processor time that a training took before, by its curve [s]."""
    return float(curve_of(path).get("seconds", 0.0))


def _train(training: Training, report: Callable[[Progress], None]) -> Path:
    with playing_on(training.config.device or "cpu"):
        return _trained(training, report)


def _trained(training: Training, report: Callable[[Progress], None]) -> Path:
    config, seed, resume, settings, environment, teacher = training
    module, directory = learner_of(config.learner), config.directory
    board = directory / "tensorboard" if config.tensorboard else None
    learner: Learner = module.Learner(seed, config.gamma, settings, environment, board)
    checkpoint = directory / f"checkpoint-{seed}.safetensors"
    record = directory / f"curve-{seed}.json"
    before = spent(record) if resume and record.is_file() else 0.0
    started = time.process_time()  # of this process alone: others on the machine do not count
    with _apart(config.defence):
        if resume and checkpoint.exists():
            learner.load(checkpoint)
        elif teacher is not None:
            assert isinstance(learner, Teachable)
            learner.imitate(demonstrate(learner.seat, Spec("attack", teacher).make(), seed, config.demonstrations))
        learner.learn(config.steps, report, checkpoint, min(config.checkpoint_every, max(config.steps // 10, 1)))
    facts = {
        "learner": config.learner, "teacher": teacher, "seed": seed, "steps": learner.steps, "config": as_data(config),
        "defence_digest": Spec("defence", config.defence).digest, "defence_version": Spec("defence", config.defence).entry.version,
        "made_with": made_with(config.learner), config.learner: as_data(settings),
        "environment": learner.seat.card()["hash"], "curve": learner.curve,
    }  # fmt: skip
    policy = learner.export(directory / f"policy-{seed}", facts)
    curve = {"curve": learner.curve, "seconds": before + time.process_time() - started}
    write_atomic(record, json.dumps(curve).encode() + b"\n")
    learner.close()
    return policy


def _apart(defence: str) -> contextlib.AbstractContextManager[None]:
    """Hide from a defence in a sandbox, within a block, whether the keys that it draws with are of training or of scoring."""
    if Spec("defence", defence).sandboxed is None:
        return contextlib.nullcontext()
    from tailgate.core.veil import veiled

    return veiled()


def _train_in_child(training: Training) -> Path:
    try:
        return _train(training, say)
    finally:
        gc.collect()  # learners refer to themselves: their buffers, and a sandbox's processes, would lie about during the next training


def _train_apart(trainings: Sequence[Training], begin: Callable[[Training], None], progress: Report, workers: int) -> list[Path]:
    """Train in separate processes, which an interrupt ends."""
    waiting = list(enumerate(trainings))
    paths: dict[int, Path] = {}
    failed: BaseException | None = None
    with crew(workers) as hands:
        while hands.busy or (waiting and failed is None):
            while waiting and failed is None and hands.free:
                place, training = waiting.pop(0)
                begin(training)
                hands.give(place, _train_in_child, training)
            for answer in hands.wait():
                if answer.word == "said":
                    progress(trainings[answer.job], answer.value)
                elif answer.word == "done":
                    paths[answer.job] = answer.value
                elif failed is None:
                    failed = _killed(workers) if answer.word == "died" else trainings[answer.job].failed(answer.value)
    if failed is not None:
        raise failed
    return [paths[place] for place in range(len(trainings))]


def _killed(workers: int) -> Killed:
    expected = f"memory for {workers} of them, or fewer workers; what was learned up to a checkpoint is kept"
    return Killed("training", "a process that was killed", expected)
