"""The lines of use on the page of each component work as they are printed."""

import re
import shlex
from pathlib import Path

import pytest

from tailgate.cli import main
from tailgate.core.registry import Family, entries, find

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```$", flags=re.M | re.S)
OTHERS = {"rules", "policy"}  # their files come from a training, which the pages of learners play
FAMILIES: tuple[Family, ...] = ("defence", "filter", "detector", "mitigation", "attack")


@pytest.fixture(autouse=True)
def pages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs" / "extension")
    monkeypatch.chdir(tmp_path)


def play(lines: str) -> int:
    """Play the blocks of a text, each command with one episode, a suite's without an attack; return how many there were."""
    blocks = BLOCK.findall(lines)
    for kind, text in blocks:
        if kind == "python":
            exec(compile(text.replace("seeds=5", "seeds=1"), "page", "exec"), {})
            continue
        for line in text.splitlines():
            words = shlex.split(line.replace("--seeds 5", "--seeds 1"))
            assert words[0] == "tailgate" and "--seeds" in words, line
            words += [] if "--attack" in words else ["--attack", "none"]
            assert main([*words[1:], "--quiet"]) == 0, line
            Path("rows.jsonl").unlink()
    return len(blocks)


@pytest.mark.parametrize(
    ("family", "name"),
    [("attack", "insider"), ("attack", "zero_dynamics"), ("attack", "feedback"), ("attack", "segments"), ("attack", "optimal_stealth"), ("mitigation", "sliding_mode"), ("filter", "joint_rls")],
)
def test_a_component_is_shown_where_it_has_a_meaning(family: Family, name: str) -> None:
    from tailgate_docs.usage import usage  # type: ignore[import-not-found]

    assert play("\n".join(usage(find(family, name), []))) == 1


@pytest.mark.long
@pytest.mark.parametrize("family", [*FAMILIES, "plant", "sensor", "controller", "manoeuvre", "reward", "scenario"])
def test_what_a_page_prints_works(family: str) -> None:
    pytest.importorskip("numpydoc", reason="the extra docs is not installed")
    from tailgate_docs.components import Pages  # type: ignore[import-not-found]

    made = Pages(ROOT, [family] if family != "scenario" else [*FAMILIES, "plant", "sensor", "controller", "manoeuvre"])  # type: ignore[list-item]
    if family == "scenario":
        texts = {name: made._scenario(name, place) for name, place in made.scenarios.items()}
    else:
        texts = {name: made._component(entry) for name, entry in entries(family).items()}  # type: ignore[arg-type]
    for name, text in texts.items():
        shown = text[text.index("## Use") :].split("\n## ", 1)[0]
        if name not in OTHERS:
            assert "No scenario" not in shown and (play(shown) or "A scenario's file names it" in shown), name
