"""Boards in parts: finished searches are packed with the files of their attacks, once, and come out as they were."""

import importlib.util
import json
import subprocess
import tarfile
from pathlib import Path

import pytest


@pytest.fixture
def parts(tmp_path, monkeypatch):
    path = Path(__file__).parents[1] / "benchmarks" / "board_in_parts.py"
    spec = importlib.util.spec_from_file_location("board_in_parts", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "ROOT", tmp_path)
    return module


def test_a_finished_search_is_kept_with_its_files(parts, tmp_path):
    tree, kept = tmp_path / "tree", tmp_path / "kept"
    kept.mkdir()
    place = Path("results/s/attacked/searches/kf")
    (tree / place / "searches").mkdir(parents=True)
    (tree / place / "attacks").mkdir()
    texts = {f"{place}/attacks/a.json": "policy", f"{place}/attacks/a.safetensors": "weights", f"{place}/attacks/b.yaml": "program"}
    for name, text in texts.items():
        (tree / name).write_text(text)
    (tree / place / "attacks" / "unused.yaml").write_text("of an attack that is not kept")
    attacks = [f"policy:path={place}/attacks/a.json", f"program:path={place}/attacks/b.yaml", "fdi:value=3"]
    found = {"members": [{"found": [{"attack": one} for one in attacks]}, {"found": []}]}
    texts[f"{place}/searches/one-20.json"] = json.dumps(found)
    (tree / place / "searches" / "one-20.json").write_text(json.dumps(found))
    (tree / place / "searches" / "two-20.journal").write_text("half a search")
    parts.keep(tree, "s", kept)
    (packed,) = kept.iterdir()
    first = packed.read_bytes()
    parts.keep(tree, "s", kept)
    assert packed.name == "kf-one-20.tar.xz" and packed.read_bytes() == first
    with tarfile.open(packed) as held:
        held.extractall(tmp_path / "again", filter="data")
    assert {str(path.relative_to(tmp_path / "again")): path.read_text() for path in (tmp_path / "again").rglob("*.*")} == texts


def test_a_search_that_was_begun_is_kept_until_it_is_finished(parts, tmp_path):
    """Its journal, and the attacks that it has found so far."""
    tree, kept = tmp_path / "tree", tmp_path / "kept"
    kept.mkdir()
    place = Path("results/s/attacked/searches/kf")
    texts = {f"{place}/searches/two-20.journal": "half a search", f"{place}/attacks/two-20/programs/a.yaml": "program"}
    for name, text in texts.items():
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        (tree / name).write_text(text)
    parts.keep_begun(tree, "s", kept)
    (packed,) = kept.iterdir()
    with tarfile.open(packed) as held:
        held.extractall(tmp_path / "again", filter="data")
    assert packed.name == "kf-two-20.begun.tar.xz"
    assert {str(path.relative_to(tmp_path / "again")): path.read_text() for path in (tmp_path / "again").rglob("*.*")} == texts
    (tree / place / "searches" / "two-20.json").write_text(json.dumps({"members": []}))
    parts.keep(tree, "s", kept)
    parts.keep_begun(tree, "s", kept)
    assert [path.name for path in kept.iterdir()] == ["kf-two-20.tar.xz"]


def test_searches_belong_to_the_commit_of_the_first_sitting(parts, tmp_path):
    def git(*words):
        return subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *words], cwd=tmp_path, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "--quiet")
    (tmp_path / "code.py").write_text("1")
    git("add", "code.py")
    git("commit", "--quiet", "-m", "one")
    first, kept = git("rev-parse", "HEAD"), tmp_path / "results" / "under-way" / "s"
    (tmp_path / "code.py").write_text("2")
    with pytest.raises(SystemExit, match="commit them"):
        parts.commit_of(kept)
    git("checkout", "--quiet", "code.py")
    assert parts.commit_of(kept) == first
    (tmp_path / "code.py").write_text("3")
    git("commit", "--quiet", "-am", "two")
    assert parts.commit_of(kept) == first != git("rev-parse", "HEAD")
