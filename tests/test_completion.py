"""Completion of command lines, and commands without progress."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tailgate.cli import main


def completed(line: str, out: Path) -> set[str]:
    """Return how a shell may go on with a line."""
    asked = {"_ARGCOMPLETE": "1", "COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE_STDOUT_FILENAME": str(out), "_ARGCOMPLETE_IFS": "\n"}
    subprocess.run([sys.executable, "-m", "tailgate"], env=os.environ | asked, check=False, timeout=60)
    return {text.strip() for text in out.read_text().splitlines()}


@pytest.mark.thin(6)
@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("tailgate eval", {"evaluate"}), ("tailgate evaluate --sui", {"--suite"}), ("tailgate evaluate --suite quick", {"quick-v0", "quick-v1"}),
        ("tailgate leaderboard run radar", {"radar-v0", "radar-v1"}), ("tailgate attack chi2_kf", {"chi2_kf", "chi2_kf_sparse"}),
        ("tailgate evaluate --attack dos_ho", {"dos_hold"}), ("tailgate leaderboard export quick", {"quick-v1"}),
        ("tailgate leaderboard export quick-v1 --format ", {"csv", "latex", "bibtex", "svg", "pdf"}),
    ],
)  # fmt: skip
def test_a_shell_is_told_how_a_line_may_go_on(line: str, words: set[str], tmp_path: Path) -> None:
    pytest.importorskip("argcomplete")
    assert completed(line, tmp_path / "out") == words


def test_without_the_library_no_command_is_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """The shell asked for words, not for the command."""
    monkeypatch.setenv("_ARGCOMPLETE", "1")
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    with pytest.raises(SystemExit) as ended:
        main(["list"])
    assert ended.value.code == 1


def test_quiet_shows_no_progress(capsys: pytest.CaptureFixture[str]) -> None:
    """The option may stand before or behind the command; the table is the same, and errors are shown."""
    line = ["evaluate", "--scenario", "stop-and-go-v0", "--defence", "kf", "--attack", "none", "--seeds", "2", "--json"]
    assert main(line) == 0
    loud = capsys.readouterr()
    for quiet in ([*line, "--quiet"], ["--quiet", *line]):
        assert main(quiet) == 0
        shown = capsys.readouterr()
        assert shown.out == loud.out and "playing" in loud.err and not shown.err
    assert main([*line, "--quiet", "--dose", "x"]) == 2 and "dose" in capsys.readouterr().err


def test_a_command_line_is_read_before_anything_heavy_is_loaded() -> None:
    """A key press waits for it, and so does every command."""
    code = "import sys; from tailgate.cli.command_line import _parser; _parser(); print(sorted({name.partition('.')[0] for name in sys.modules}))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "'numpy'" in found
    assert not [name for name in ("scipy", "torch", "matplotlib", "llvmlite", "cvxpy", "highway_env", "cmaes") if f"'{name}'" in found]
