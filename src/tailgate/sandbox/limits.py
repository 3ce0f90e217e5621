"""The resource limits of a submission, and the error of exceeding them."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from tailgate.core import Positive, PositiveCount, param

Bytes = Annotated[int, Field(ge=1, le=2**50)]
FEWEST = 256  # rows of a batch, if there are as many


class Lost(Exception):
    """A submission's process failed or was ended; the text is the reason in its rows."""


@dataclass(frozen=True)
class Limits:
    """The resources of one process of a submission; exceeding them ends it, and the rows of that batch get the reason.

    RLIMIT_DATA limits memory: it counts private writable memory.
    RLIMIT_AS would also count address space that libraries reserve and never touch, and would stop honest programs.
    The guard checks five times a second what RLIMIT_DATA does not see: shared memory, and several processes.
    """

    memory: Bytes = param(4 * 2**30, "memory of all processes of the submission together [bytes]")
    start_time: Positive = param(60.0, "processor time for importing, prepare and start [s]")
    step_time: Positive = param(1.2e-3, "processor time per step, row and agent, on average: ten times what kf needs at batch 1 [s]")
    cpu: PositiveCount = param(7200, "processor time of any one process (RLIMIT_CPU) [s]")
    silence: Positive = param(120.0, "longest wait for one answer; the sum of all waits may be this plus the granted processor time [s]")
    output: Bytes = param(2**20, "what may be printed to standard output and error together [bytes]")
    file_size: Bytes = param(64 * 2**20, "largest file that may be written (RLIMIT_FSIZE) [bytes]")
    processes: PositiveCount = param(8, "processes at a time, the submission's own among them")

    def steps(self, count: int, rows: int, agents: int) -> float:
        """Return the processor time [s] that `count` steps of a batch get; fewer than FEWEST rows count as FEWEST."""
        return self.step_time * count * max(rows, FEWEST) * agents
