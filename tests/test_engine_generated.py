"""Generated lines of numpy code: traced, they have the bits, type and shape of numpy, or they are refused with a reason."""

import warnings
from collections import Counter
from types import CodeType
from typing import Any

import numpy as np
import pytest

from tailgate import num
from tailgate.engine.evaluation import evaluate
from tailgate.engine.parameters import lifted
from tailgate.engine.tracing import Trace, traced
from tailgate.engine.untraceable import Untraceable

from .lines import NUMBERS, ROWS, Lines, arrays

GIVEN = arrays(1)


def run(code: CodeType, held: dict[str, Any], numbers: dict[str, Any]) -> Any:
    room = {name: array.copy() for name, array in held.items()} | numbers | {"np": np, "num": num, "__name__": "lines"}
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(code, room)
    return room["out"]


def tracing(code: CodeType) -> Trace:
    def step(_: Any, held: Any) -> Any:
        numbers = lifted(held["f8"], tuple(NUMBERS.values()))
        return (), {"out": run(code, held, dict(zip(NUMBERS, numbers, strict=True)))}

    return traced(step, (), {name: array[:1] for name, array in GIVEN.items()})


def evaluated(trace: Trace) -> np.ndarray:
    nodes = trace.results["out"]
    inputs = {
        node.attr: GIVEN[name][(slice(None), *place)]
        for name, leaf in trace.arguments.items()
        for place, node in zip(np.ndindex(*leaf.shape[1:]), leaf.reshape(-1), strict=True)
    }
    columns = [np.broadcast_to(one, ROWS) for one in evaluate(trace.graph, list(nodes.flat), inputs)]
    return np.stack(columns, axis=1).reshape(ROWS, *nodes.shape[1:])


def same(one: np.ndarray, two: np.ndarray) -> bool:
    if one.dtype.kind == "f":  # of NaN the sign and the payload are nobody's
        one, two = (np.where(np.isnan(x), np.nan, x).astype(x.dtype) for x in (one, two))
    return one.shape == two.shape and one.dtype == two.dtype and one.tobytes() == two.tobytes()


def outcome(text: str) -> str:
    """Play a text plainly and traced. -> "same", "refused", or "no code" where numpy itself refuses."""
    code = compile(text, "lines", "exec")
    wanted: Any
    try:
        wanted = np.asarray(run(code, GIVEN, NUMBERS))
    except Exception as error:
        wanted = error
    try:
        trace = tracing(code)
    except (Untraceable, OverflowError):  # numpy's own words for a number that its type does not hold
        return "refused"
    except Exception as error:
        assert isinstance(wanted, Exception), f"{text}: {error!r}"
        return "no code"
    if isinstance(wanted, Exception):
        return "no code"
    got = evaluated(trace)
    assert same(got, wanted), f"{text}: {got.dtype} {got[:3]} and not {wanted.dtype} {wanted[:3]}"
    return "same"


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.long) for part in range(1, 25))])
def test_lines_of_numpy(part: int) -> None:
    found = Counter(outcome(Lines(seed).code()) for seed in range(1500 * part, 1500 * (part + 1)))
    assert found["same"] > 450 and found["no code"] < 300, found
