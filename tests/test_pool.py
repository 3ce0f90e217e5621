"""Worker processes multiply matrices in one thread each, unless the user says otherwise."""

import os

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
