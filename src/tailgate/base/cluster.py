"""Jobs on a Ray cluster, given and answered as those of local worker processes are.

A cluster is trusted: jobs and their results are pickled, as Ray does it. Anybody who may send it jobs may run any code there.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

from tailgate.base import own_modules, sizes, sources
from tailgate.base.errors import InputError, said
from tailgate.base.extras import optional
from tailgate.base.pool import Answer, answer, done, hired

RETRIES = 3  # times that a job is given again whose worker was lost
PATIENCE = 5.0  # for the head of a cluster to answer [s]
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class _Given(NamedTuple):
    """A job that is not answered yet, and how often its worker was lost."""

    job: int
    function: Callable[..., object]
    arguments: tuple[object, ...]
    lost: int = 0


class RayCrew:
    """Takes up to `most` jobs at a time and has them done on a Ray cluster; `tailgate.base.pool.Hands`.

    A job whose worker or node is lost is given again, RETRIES times; then its answer is that it died.
    """

    def __init__(self, ray: ModuleType, most: int) -> None:
        self.ray, self.most = ray, most
        self._given: dict[Any, _Given] = {}
        self._done = ray.remote(num_cpus=1, max_retries=0)(_done)

    def __enter__(self) -> RayCrew:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        for task in self._given:
            self.ray.cancel(task, force=True)
        self._given.clear()

    @property
    def busy(self) -> list[_Given]:
        """The jobs that are not answered yet."""
        return list(self._given.values())

    @property
    def free(self) -> bool:
        """If another job can be given."""
        return len(self._given) < self.most

    def give(self, job: int, function: Callable[..., object], *arguments: object) -> None:
        """Give the job number `job`: function(*arguments)."""
        self._start(_Given(job, function, arguments))

    def _start(self, given: _Given) -> None:
        self._given[self._done.remote(sources.own(), given.function, given.arguments)] = given

    def wait(self) -> list[Answer]:
        """Return all answers that have arrived; wait for the first one."""
        found: list[Answer] = []
        while not found and self._given:
            tasks = list(self._given)
            self.ray.wait(tasks, num_returns=1)
            ready, _ = self.ray.wait(tasks, num_returns=len(tasks), timeout=0)
            found += [one for task in ready if (one := self._answer(task, self._given.pop(task))) is not None]
        return found

    def _answer(self, task: object, given: _Given) -> Answer | None:
        errors = self.ray.exceptions
        try:
            word, value = self.ray.get(task)
        except errors.RayTaskError as error:  # the job did not begin
            first = str(error).strip().splitlines()[-1]
            raise InputError("--engine", "ray", f"nodes that have tailgate and all that is named by its path ({first})") from error
        except errors.RayError:
            if given.lost == RETRIES:
                return Answer(given.job, "died")
            self._start(given._replace(lost=given.lost + 1))
            return None
        return answer(given.job, word, value)


def _done(digest: str, function: Callable[..., object], arguments: tuple[object, ...]) -> tuple[str, object]:
    """Do a job on a node, with the driver's version of this package only."""
    if sources.own() != digest:
        return "failed", (InputError("--engine", "ray", "the same version of tailgate on every node of the cluster"), "")
    return done(function, arguments)


def _answers(address: str) -> None:
    """Raise InputError unless something listens at HOST:PORT. Ray itself would wait for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise InputError("--address", address, "HOST:PORT, for example head:6379")
    try:
        socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()
    except OSError as error:
        raise InputError("--address", address, f"HOST:PORT of a Ray cluster that answers ({said(error)})") from None


@contextlib.contextmanager
def on_ray(address: str | None = None, workers: int = 1) -> Iterator[None]:
    """Have jobs done on a Ray cluster within a block.

    Parameters
    ----------
    address
        HOST:PORT of the head of a cluster that runs. None: a cluster on this machine, which ends with the block.
    workers
        Processes of a cluster on this machine.

    Raises
    ------
    InputError
        For a cluster that does not answer.
    ImportError
        Without the extra `ray`.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    ray = optional("ray", "ray", "a cluster needs Ray")
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    size: dict[str, Any] = {"num_cpus": sizes.check("workers", workers)} if address is None else {}
    if address is not None:
        _answers(address)
    try:
        ray.init(
            address or "local", include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR, **size,
            runtime_env={"env_vars": {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, [*sys.path, *own_modules.folders()]))}},
        )  # fmt: skip
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise InputError("--address", address, f"a Ray cluster that answers ({said(error).strip().splitlines()[0]})") from error
    for number, handler in before.items():  # Ray has its own, which would end a command without its last words
        signal.signal(number, handler)
    try:
        with hired(partial(RayCrew, ray)):
            yield
    finally:
        ray.shutdown()
