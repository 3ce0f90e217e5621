"""Rows of a submission, played again in the sandbox."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tailgate.core.registry import Spec
from tailgate.evaluation.cells import Cell
from tailgate.sandbox.limits import Limits
from tailgate.sandbox.mixed import Submission, play_again
from tailgate.sandbox.process import Process
from tailgate.sandbox.sandbox import sandbox_of
from tailgate.sandbox.source import staged

AT_ONCE = 4096  # rows of a batch

Row = dict[str, Any]


def replay(text: str, groups: Sequence[tuple[Cell, Sequence[int]]]) -> list[list[Row]]:
    """Play the seeds of each cell for a class in a sandbox, `bwrap/module:Class`, with its local files; return the rows."""
    spec = Spec("defence", text)
    assert spec.sandboxed is not None
    program, target = spec.sandboxed
    sandbox = sandbox_of(program)
    out: dict[int, list[Row]] = {}
    with staged(target) as source:
        with Process(source.text, source.path, Limits(), sandbox) as process:
            card = process.card
        submission = Submission(source, card, Limits(), sandbox)
        for name in dict.fromkeys(cell.scenario for cell, _ in groups):
            batch: list[int] = []
            for i in [i for i, (cell, _) in enumerate(groups) if cell.scenario == name] + [-1]:
                full = batch and (i < 0 or sum(len(groups[k][1]) for k in [*batch, i]) > AT_ONCE)
                if full:
                    out |= dict(zip(batch, play_again([groups[k] for k in batch], submission), strict=True))
                    batch = []
                batch += [i] * (i >= 0)
    return [out[i] for i in range(len(groups))]
