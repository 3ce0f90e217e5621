"""Objects and settings that rows have to tell apart."""

import dataclasses
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import tailgate
from tailgate.base.errors import InputError
from tailgate.core.scenario import load_scenario
from tailgate.core.schema import as_data, digest
from tailgate.evaluation.rows import read_rows
from tailgate.evaluation.summary import summarise

HELPED = "from helper_of_test import GAIN\nfrom tailgate.estimators.filters.kalman import KalmanFilter\n\n\nclass Helped:\n    gain = GAIN\n    def later(self):\n        import lazy_of_test\n"


class Tuned:
    """A class whose text says nothing of its settings."""

    uses = ("measurements",)

    def __init__(self, inner):
        self.inner = inner

    def __getattr__(self, name):
        return getattr(self.__dict__["inner"], name)


def _short():
    return dataclasses.replace(load_scenario("stop-and-go-v0"), name="short", horizon=40)


def test_two_objects_of_one_text_are_refused():
    """The second would replace the first in every summary. One object twice, and equal ones, are one."""
    one, two = Tuned(tailgate.make_defence("kf")), Tuned(tailgate.make_defence("imm"))
    with pytest.raises(InputError, match="objects whose text differs"):
        tailgate.evaluate(scenarios=_short(), defences=[one, two], attacks="none", seeds=1)
    rows = tailgate.evaluate(scenarios=_short(), defences=[tailgate.make_defence("kf")] * 2, attacks="none", seeds=1)
    assert len(rows) == 2
    for attacks in (["none", tailgate.make_attack("none")], [tailgate.make_attack("none"), "none"]):
        assert len(tailgate.evaluate(scenarios=_short(), defences="kf", attacks=attacks, seeds=1)) == 2


def test_rows_of_objects_do_not_replace_others(tmp_path):
    out = tmp_path / "rows.jsonl"
    first = tailgate.evaluate(scenarios=_short(), defences="kf", attacks="none", seeds=3, out=out)
    tailgate.evaluate(scenarios=_short(), defences=tailgate.make_defence("imm"), attacks="none", seeds=1, out=out)
    assert [row["seed"] for row in read_rows(tmp_path / "rows.jsonl.1")] == [0, 1, 2] == [row["seed"] for row in first]
    assert len(read_rows(out)) == 1
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="a file, not a directory"):
        tailgate.evaluate(scenarios=_short(), defences=tailgate.make_defence("imm"), attacks="none", seeds=1, out=tmp_path / "folder")


def test_numbers_of_numpy_are_part_of_a_hash():
    same = {digest(np.float32(value)) for value in (0.01, 25.0)} | {digest(np.array([value])) for value in (1.0, 2.0)}
    assert len(same) == 4 and as_data(np.int8(3)) == 3 and json.dumps(as_data({"x": np.arange(3)}))
    places = [dataclasses.replace(_short(), sensor=dataclasses.replace(_short().sensor, noise_var=(np.float32(v),) * 2)) for v in (0.01, 25.0)]
    assert places[0].config_hash != places[1].config_hash


def test_rounds_are_not_pooled():
    rows = tailgate.evaluate(scenarios=_short(), defences="kf", attacks="none", seeds=2)
    other = [row | {"beacon": "a round", "seed": 10 + row["seed"]} for row in rows]
    assert [entry["n"] for entry in summarise([*rows, *other])] == [2, 2]
    assert len(summarise([*rows, *[{k: v for k, v in row.items() if k != "beacon"} | {"seed": 9} for row in rows]])) == 2


def test_a_changed_helper_is_noticed(tmp_path, monkeypatch):
    """The digest of a class covers what its module imports, unless that is installed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    found = []
    Path("helped_of_test.py").write_text(HELPED)
    Path("lazy_of_test.py").write_text("")
    for gain in (0.1, 0.9):
        Path("helper_of_test.py").write_text(f"GAIN = {gain}  # {'x' * int(100 * gain)}\n")
        for name in ("helped_of_test", "helper_of_test", "lazy_of_test"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        found.append(tailgate.core.registry.Spec("defence", "helped_of_test:Helped").digest)
    assert len(set(found)) == 2
    importlib.import_module("lazy_of_test")  # as a step may do: what is loaded by now changes no digest
    assert tailgate.core.registry.Spec("defence", "helped_of_test:Helped").digest == found[-1]
