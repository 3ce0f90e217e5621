"""The documentation's examples run as they stand."""

import dataclasses
import importlib
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tailgate.cli import main
from tailgate.core.registry import GROUPS

ROOT = Path(__file__).parents[1]
PAGES = ["README.md", *(f"docs/{name.name}" for name in sorted((ROOT / "docs").glob("*.md")))]


def _blocks(name: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / name).read_text(encoding="utf-8"), flags=re.S)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    (tmp_path / "mydefence.py").write_text(_blocks("docs/new-defence.md", "python")[0], encoding="utf-8")
    return tmp_path


def test_the_new_defence_has_at_most_30_lines_of_code() -> None:
    code = [line for line in _blocks("docs/new-defence.md", "python")[0].splitlines() if line.strip()]
    assert 10 < len(code) <= 30


def test_the_new_defence_is_evaluated_from_the_command_line(package: Path) -> None:
    """Found in the working directory, played in two spawned processes, and on the page."""
    command = [sys.executable, "-m", "tailgate", "evaluate", "--suite", "quick-v0", "--scenario", "gusty-stop-and-go-v0"]
    command += ["--defence", "mydefence:Saturated:gain=0.1", "--attack", "none", "--attack", "fdi:trigger=near,threshold=30,value=-4"]
    done = subprocess.run(
        [*command, "--seeds", "20", "--workers", "2", "--out", "rows.jsonl", "--json"], cwd=package, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    table = json.loads(done.stdout)
    assert [entry["n"] for entry in table] == [20, 20]
    assert table[0]["crash"]["value"] == 0.0
    rows = [json.loads(line) for line in (package / "rows.jsonl").read_text().splitlines()]
    assert {row["status"] for row in rows} == {"ok"}
    assert main(["leaderboard", "build", "--rows", str(package / "rows.jsonl"), "--out", str(package / "page")]) == 0
    assert "mydefence:Saturated" in (package / "page" / "index.html").read_text(encoding="utf-8")


def test_the_new_defence_plays_as_an_object(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(package)
    scope: dict[str, object] = {}
    exec(_blocks("docs/new-defence.md", "python")[1], scope)
    env = scope["env"]
    env.reset(seed=0)  # type: ignore[attr-defined]
    assert env.step(0)[4]["gap"] > 50.0  # type: ignore[attr-defined]
    sys.modules.pop("mydefence", None)


@pytest.mark.long
def test_the_radar_example_challenges_and_hears(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fifth of the steps are muted, and an attacker who radiates is heard."""
    (package / "myradar.py").write_text(_blocks("docs/new-defence.md", "python")[2], encoding="utf-8")
    monkeypatch.chdir(package)
    command = ["evaluate", "--scenario", "radar-following-v0", "--defence", "myradar:Listening", "--attack", "none"]
    assert main([*command, "--attack", "echo_delay:start_step=60", "--seeds", "20", "--workers", "1", "--out", "rows.jsonl"]) == 0
    rows = [json.loads(line) for line in (package / "rows.jsonl").read_text(encoding="utf-8").splitlines()]
    assert {row["status"] for row in rows} == {"ok"} and {row["dose"] for row in rows} == {10}  # the scenario's own
    clean, attacked = ([row for row in rows if (row["attack"] == "none") == quiet] for quiet in (True, False))
    assert 35 < sum(row["muted_steps"] for row in clean) / 20 < 60 and not any(row["alarm_onsets"] for row in clean)
    assert sum(row["alarm_onsets"] > 0 for row in attacked) > 10


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", *PAGES])
def test_links_to_files_exist(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", text):
        if "://" not in target:
            assert ((ROOT / name).parent / target).exists(), f"{name}: {target}"


def _code(text: str) -> str:
    """Code blocks and code spans."""
    blocks = re.findall(r"^```.*?^```", text, flags=re.S | re.M)
    return "\n".join([*blocks, *re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M))])


def _named(code: str) -> set[str]:
    """Dotted names of the package: as they stand, of `from tailgate.x import y, z`, and of `num`."""
    names = set(re.findall(r"(?<![\w./\-])tailgate(?:\.[A-Za-z_]\w*)+", code))
    for module, listed in re.findall(r"from (tailgate[\w.]*) import ([\w, ]+)", code):
        names |= {f"{module}.{name.strip().split()[0]}" for name in listed.split(",")}
    return names | {f"tailgate.{name}" for name in re.findall(r"(?<![\w./\-])num\.[a-z_]+", code)}


def _is_there(name: str) -> bool:
    parts = name.split(".")
    for n in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:n]))
        except ModuleNotFoundError as error:
            if error.name and not f"{name}.".startswith(f"{error.name}."):
                raise  # a library that it needs
            continue
        for part in parts[n:]:
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def test_what_is_no_name_of_the_package_is_seen() -> None:
    text = "`tailgate.make_vec` and `num.dot(x, y)`\n```python\nfrom tailgate.core import Mode, Nothing\n```\n`src/tailgate/num.py`, `tailgate[train]`, `tailgate log`"
    named = _named(_code(text))
    assert named == {"tailgate.make_vec", "tailgate.num.dot", "tailgate.core", "tailgate.core.Mode", "tailgate.core.Nothing"}
    assert {name for name in named if not _is_there(name)} == {"tailgate.make_vec", "tailgate.core.Nothing"}


@pytest.mark.parametrize("name", PAGES)
def test_names_of_the_package_are_there(name: str) -> None:
    named = _named(_code((ROOT / name).read_text(encoding="utf-8")))
    assert not {found for found in named if not _is_there(found)} - set(GROUPS.values())


def test_the_scenario_of_the_documentation_plays(tmp_path: Path) -> None:
    from tailgate import make_attack, make_defence
    from tailgate.core import draws
    from tailgate.core.scenario import load_scenario
    from tailgate.play.trace import rollout

    (tmp_path / "mine.yaml").write_text(_blocks("docs/scenarios.md", "yaml")[0], encoding="utf-8")
    (tmp_path / "leader.csv").write_text(_blocks("docs/scenarios.md", "csv")[0], encoding="utf-8")
    loop = load_scenario(str(tmp_path / "mine.yaml")).loop(make_defence("kf"))
    trace = rollout(loop, make_attack("none"), draws.keys("tune", range(3)))
    assert trace.lead_speed[149 - 2, 0, 0] == pytest.approx(5.0, abs=0.35) and not trace.collided.any()


Evaluated = Callable[..., list[dict[str, Any]]]


@pytest.fixture
def evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Evaluated:
    """Return a function that runs `tailgate evaluate` with these options in the folder of the test."""

    def called(*arguments: str) -> list[dict[str, Any]]:
        monkeypatch.chdir(tmp_path)
        assert main(["evaluate", "--scenario", "thesis-ch4-v0", "--dose", "none", "--seeds", "4", "--workers", "1", "--json", *arguments]) == 0
        return list(json.loads(capsys.readouterr().out))

    return called


@pytest.mark.long
def test_the_detector_of_the_documentation_plays(tmp_path: Path, evaluated: Evaluated) -> None:
    """As a part named on the command line, attacked through its own gate as well."""
    (tmp_path / "mydetector.py").write_text(_blocks("docs/detectors.md", "python")[0], encoding="utf-8")
    guard = "composed:detector=mydetector:Leaky,detector.threshold=40"
    quiet, stealth = evaluated("--defence", guard, "--attack", "none", "--attack", "stealth")
    assert quiet["n"] == stealth["n"] == 4
    assert stealth["alarm_onsets"]["median"] == 0.0 and stealth["max_error"]["median"] > 20.0


@pytest.mark.long
def test_the_adapted_filter_of_the_documentation_plays(tmp_path: Path, evaluated: Evaluated) -> None:
    """filterpy's fading-memory filter, named as module:Class with its parameter."""
    (tmp_path / "myfilter.py").write_text(_blocks("docs/new-defence.md", "python")[3], encoding="utf-8")
    (entry,) = evaluated("--defence", "myfilter:Fading:alpha=1.05", "--attack", "none")
    assert entry["n"] == 4 and 0.3 < entry["rmse_position"]["median"] < 1.5


def test_the_kalman_filter_of_the_documentation_is_the_built_in_one(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Trace for trace, while every reading arrives."""
    from tailgate import make_attack, make_defence
    from tailgate.core import draws
    from tailgate.core.scenario import load_scenario
    from tailgate.play.trace import rollout

    code = _blocks("docs/new-defence.md", "python")[4]
    assert len([line for line in code.splitlines() if line.strip()]) <= 31
    (package / "mykalman.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(package)
    from mykalman import Textbook  # type: ignore[import-not-found]

    scenario, keys = load_scenario("gusty-stop-and-go-v0"), draws.keys("tune", range(2))
    own, built_in = (rollout(scenario.loop(defence), make_attack("none"), keys) for defence in (Textbook(), make_defence("kf")))
    assert [own.trace_hash(row) for row in range(2)] == [built_in.trace_hash(row) for row in range(2)]
    sys.modules.pop("mykalman", None)


def test_the_published_head_is_that_of_the_published_board() -> None:
    """Figure for figure; and no board speaks of another machine's directories."""
    from tailgate.board.files import load
    from tailgate.board.head import markdown

    found = []
    older = ["car-following-v1/board.json.xz", "radar-v1/board.json.xz", "lane-v0/board.json.xz", "road-v0/board.json.xz", "network-v1/board.json.xz", "quick-v0/board.json", "car-following-v0/board.json"]
    for page, boards in (("README.md", ["quick-v1/board.json.xz"]), ("docs/boards.md", older)):
        heads = re.findall(r"<!-- head: (\S+) -->\n(.*?)<!-- end -->", (ROOT / page).read_text(encoding="utf-8"), flags=re.S)
        assert [name for name, _ in heads] == [f"results/{board}" for board in boards]
        found += heads
    for name, table in found:
        board = load(ROOT / name)
        ranked = sum(entry["rank"] is not None for entry in board["entries"])
        assert ranked >= 8 and table.strip() == markdown(board, ranked).strip()
        assert '"/' not in json.dumps(board)


def test_the_tables_of_robustness_are_those_of_the_files() -> None:
    """Scenarios whose vehicle is not as told, and which suite plays which."""
    from tailgate.core.scenario import list_scenarios, list_suites, load_scenario, load_suite

    told = (ROOT / "docs/scenarios.md").read_text(encoding="utf-8").split("| scenario | differs from")[1].split("\n\n")[0].split("|---|---|")[1]
    differs = {name: load_scenario(name).truth for name in list_scenarios() if load_scenario(name).truth}
    assert set(re.findall(r"`([\w-]+)`", told)) == set(differs)
    assert {name: truth["load"] for name, truth in differs.items() if "load" in truth} == {
        "car-following-heavy-v0": 1.2, "car-following-light-v0": 0.8, "platoon-heavy-v0": 1.2, "radar-heavy-v0": 1.2,
    }  # fmt: skip
    assert (differs["car-following-lossy-v0"], differs["platoon-lossy-v0"], differs["car-following-late-v0"]) == ({"loss": 0.2}, {"loss": 0.1}, {"latency": 3})
    table = (ROOT / "docs/scoring.md").read_text(encoding="utf-8").split("| suite | mass and lag +20 %")[1].split("\n\n")[0]
    played = {cells[1].strip(" `"): set("".join(cells[2:]).split()) for cells in (line.split("|") for line in table.splitlines() if line.startswith("| `"))}
    kinds = {name: {scenario.split("-")[-2] for scenario in load_suite(name).robustness} for name in list_suites()}
    assert played == {name: kind for name, kind in kinds.items() if kind}


@pytest.fixture
def creeping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (tmp_path / "myattack.py").write_text(_blocks("docs/new-attack.md", "python")[0], encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("myattack", None)


def test_the_new_attack_does_what_its_page_says(creeping: Path) -> None:
    """At most 30 lines of code; the table of collisions comes out; the engine compiles it."""
    from tailgate.core.scenario import load_suite
    from tailgate.evaluation.cells import evaluate

    code = [line for line in _blocks("docs/new-attack.md", "python")[0].splitlines() if line.strip()]
    assert 10 < len(code) <= 30
    suite = dataclasses.replace(load_suite("quick-v1"), scenarios=("gusty-stop-and-go-v0",))
    rows = evaluate(suite, defences=["kf", "chi2_kf", "safe_state"], attacks=["myattack:Creeping", "myattack:Creeping:rate=-1"], seeds=50)
    page = (ROOT / "docs/new-attack.md").read_text(encoding="utf-8")
    for attack, name in (("myattack:Creeping", "`rate=-0.5`, the default"), ("myattack:Creeping:rate=-1", "`rate=-1`")):
        shares = [sum(r["crashed"] for r in rows if (r["defence"], r["attack"]) == (d, attack)) / 50 for d in ("kf", "chi2_kf", "safe_state")]
        assert f"| {name} | {' | '.join(f'{share:.0%}'.replace('%', ' %') for share in shares)} |" in page
    assert main(["explain", "engine", "--scenario", "gusty-stop-and-go-v0", "--defence", "kf", "--attack", "myattack:Creeping"]) == 0


def test_the_new_attack_has_a_name_once_it_is_registered(creeping: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tailgate
    from tailgate.core import registry

    registry.built_in("attack")  # a module that is imported below registers in the copy alone
    monkeypatch.setitem(registry._entries, "attack", dict(registry._entries["attack"]))
    exec(_blocks("docs/new-attack.md", "python")[1], {})
    assert tailgate.make_attack("creeping", rate=-1.0).rate == -1.0
