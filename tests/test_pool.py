"""Worker processes: how many threads they have, and what happens if one cannot begin."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tailgate.base.pool import THREADS, each


def threads(name: str) -> str | None:
    return os.environ.get(name)


@pytest.mark.thin(3)
@pytest.mark.parametrize("given", [{}, {"OPENBLAS_NUM_THREADS": "3"}, {"OMP_NUM_THREADS": "2"}])
def test_workers_have_one_thread_each(given: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in THREADS:
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    before = dict(os.environ)
    found = dict(each(threads, [(name,) for name in THREADS], 1))
    assert [found[0], found[1]] == [given.get("OPENBLAS_NUM_THREADS") or (None if given else "1"), given.get("OMP_NUM_THREADS")]
    assert dict(os.environ) == before


UNGUARDED = """
import os
from tailgate.base.pool import each
print(dict(each(os.path.basename, [("a/b",), ("a/c",)], 2)))
"""


def test_a_script_that_starts_workers_in_its_main_module_gets_one_clear_error(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    for text, status in ((UNGUARDED, 1), (UNGUARDED.replace("print", "if __name__ == '__main__': print"), 0)):
        script.write_text(text)
        ran = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60)
        assert ran.returncode == status, ran.stderr
        if status:
            error = ran.stderr.splitlines()[-1]
            assert error.endswith("each worker imports it") and "main module starts workers itself" in error and "RuntimeError" not in ran.stderr
        else:
            assert ran.stdout == "{0: 'b', 1: 'c'}\n" or ran.stdout == "{1: 'c', 0: 'b'}\n"
