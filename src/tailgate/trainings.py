"""Trainings, each of one seed, one after another or side by side in processes."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from queue import Empty
from typing import TYPE_CHECKING, Any, NamedTuple

from tailgate.agents.learning import Learner, Progress, Teachable, learner_of, made_with
from tailgate.agents.teacher import demonstrate
from tailgate.errors import InputError
from tailgate.files import write_atomic
from tailgate.registry import Spec
from tailgate.schema import as_data

if TYPE_CHECKING:
    from tailgate.train import TrainConfig


class Training(NamedTuple):
    """The training of one seed."""

    config: TrainConfig
    seed: int
    resume: bool
    settings: Any  # the learner's hyper-parameters, checked
    environment: dict[str, Any]  # arguments of the environment
    teacher: str | None  # whose decisions the learner is shown first


def train_all(trainings: Sequence[Training], progress: Callable[[Training, Progress], None], workers: int) -> list[Path]:
    """JSON files of the policies, in the order of the trainings, as many of which run at a time as there are workers."""
    if min(workers, len(trainings)) <= 1:
        return [_train(training, partial(progress, training)) for training in trainings]
    return _train_apart(trainings, progress, min(workers, len(trainings)))


def _train(training: Training, report: Callable[[Progress], None]) -> Path:
    config, seed, resume, settings, environment, teacher = training
    module, directory = learner_of(config.learner), config.directory
    board = directory / "tensorboard" if config.tensorboard else None
    learner: Learner = module.Learner(seed, config.gamma, settings, environment, board)
    checkpoint = directory / f"checkpoint-{seed}.safetensors"
    record = directory / f"curve-{seed}.json"
    spent = json.loads(record.read_text()).get("seconds", 0.0) if resume and record.is_file() else 0.0
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
    curve = {"curve": learner.curve, "seconds": spent + time.process_time() - started}
    write_atomic(record, json.dumps(curve).encode() + b"\n")
    learner.close()
    return policy


def _apart(defence: str) -> contextlib.AbstractContextManager[None]:
    """Within it a defence in a sandbox cannot tell training from scoring by the keys that it draws with."""
    if Spec("defence", defence).sandboxed is None:
        return contextlib.nullcontext()
    from tailgate.submission.isolated import veiled

    return veiled()


_line: Any = None  # in a process that trains: where it reports to, and the event that stops it


class Stopped(Exception):
    """Training was asked to stop."""


def _hold_line(queue: Any, stop: Any) -> None:
    global _line
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent asks us to stop
    _line = (queue, stop)


def _train_in_child(training: Training, place: int) -> Path:
    queue, stop = _line

    def report(progress: Progress) -> None:
        parent = multiprocessing.parent_process()
        if stop.is_set() or parent is None or not parent.is_alive():  # killed without a word: nobody waits for this policy
            raise Stopped(f"{training.config.name}, seed {training.seed}")
        queue.put((place, progress))

    return _train(training, report)


def _train_apart(trainings: Sequence[Training], progress: Callable[[Training, Progress], None], workers: int) -> list[Path]:
    """In processes of their own. An interrupt stops them at their next report."""
    context = multiprocessing.get_context("spawn")  # a fork would copy the threads of compiled kernels
    queue, stop = context.Queue(), context.Event()

    def told(place: int, now: Progress) -> None:
        progress(trainings[place], now)

    with ProcessPoolExecutor(workers, context, _hold_line, (queue, stop)) as pool:
        futures = [pool.submit(_train_in_child, training, place) for place, training in enumerate(trainings)]
        try:
            while not all(future.done() for future in futures):
                with contextlib.suppress(Empty):
                    told(*queue.get(timeout=0.2))
                for future in futures:
                    if future.done():
                        future.result()  # raises what went wrong
            while not queue.empty():
                told(*queue.get())
            return [future.result() for future in futures]
        except BrokenProcessPool:
            expected = f"memory for {workers} of them, or workers=1; a run that is resumed goes on where it was"
            raise InputError("training", "a process that was killed", expected) from None
        finally:
            stop.set()
            for future in futures:
                future.cancel()
