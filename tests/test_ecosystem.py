"""Snippets of the page of other libraries, and its table against the record."""

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
PAGE, RECORD = ROOT / "docs/ecosystem.md", ROOT / "benchmarks/results/ecosystem.json"


def _script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ecosystem", ROOT / "benchmarks/ecosystem.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


ecosystem = _script()
NEEDS = {"Gymnasium": "gymnasium", "Stable-Baselines3": "stable_baselines3", "TorchRL": "torchrl", "PettingZoo": "pettingzoo"}


def test_the_table_is_that_of_the_record() -> None:
    table = re.search(r"<!-- ecosystem -->\n(.*?)\n<!-- end -->", PAGE.read_text(encoding="utf-8"), flags=re.S)
    assert table is not None and table[1] == ecosystem.table(json.loads(RECORD.read_text(encoding="utf-8")))


def test_each_library_has_a_section() -> None:
    """And each section has a snippet that compiles."""
    page = PAGE.read_text(encoding="utf-8")
    codes = [ecosystem.snippet(name, page) for name in ecosystem.LIBRARIES]
    assert len(set(codes)) == len(codes) and all("tailgate" in code for code in codes)
    for name, code in zip(ecosystem.LIBRARIES, codes, strict=True):
        compile(code, name, "exec")
        assert len(code.splitlines()) <= (25 if name == "TorchRL" else 15), name


def test_the_tests_cover_the_extras() -> None:
    assert set(NEEDS) == {name for name, library in ecosystem.LIBRARIES.items() if library.extra}


@pytest.mark.long
@pytest.mark.parametrize("name", NEEDS)
def test_a_snippet_runs(name: str, tmp_path: Path) -> None:
    """The recipes learn: most of their last episodes end in a collision."""
    pytest.importorskip(NEEDS[name])
    code = ecosystem.snippet(name, PAGE.read_text(encoding="utf-8"))
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    assert ecosystem.reached(done.stdout) >= ecosystem.LIBRARIES[name].learns


def test_the_recorded_recipes_learned() -> None:
    record = {entry["library"]: entry["printed"] for entry in json.loads(RECORD.read_text(encoding="utf-8"))}
    learns = {name: library.learns for name, library in ecosystem.LIBRARIES.items() if library.learns}
    assert len(learns) == 2 and all(ecosystem.reached(record[name]) >= share for name, share in learns.items())
