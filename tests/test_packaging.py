"""The house: every package is listed, every file has its size, the scored path keeps to its arithmetic."""

import ast
import re
import tomllib
from pathlib import Path

import pytest
import yaml

from tailgate.base.version import ALIKE
from tailgate.board.export import TITLE
from tailgate.board.files import load

ROOT = Path(__file__).parents[1]
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FOLDERS = CONFIG["tool"]["setuptools"]["package-dir"]
SOURCES = sorted({p.resolve() for folder in FOLDERS.values() for p in (ROOT / folder).glob("*.py")})

# What a trace is made of. Their results must not depend on the batch, so no BLAS, no einsum, no sums by shape, no library transcendentals.
SCORED = [
    *(ROOT / "envs").rglob("*.py"), *(ROOT / "estimators").rglob("*.py"), *(ROOT / "agents").rglob("*.py"),
    *(ROOT / "src/tailgate/core" / f"{n}.py" for n in ("channel", "draws", "kinds", "loop", "neural", "score_threshold", "threat")),
    *(ROOT / "src/tailgate" / f"{n}.py" for n in ("num", "base/pytree", "engine/hints", "play/metrics", "play/trace")),
    *(ROOT / "src/tailgate/engine" / f"{n}.py" for n in ("elementary", "matrices", "loops")),
]  # fmt: skip
UNSCORED = {"exploring.py", "graph.py", "picture.py", "programs.py", "sb3.py", "ppo.py", "cem.py", "schedules.py", "stable.py", "teacher.py"}
FORBIDDEN = {
    "einsum", "dot", "matmul", "inner", "tensordot", "vdot", "sum", "mean", "std", "var", "prod", "nansum", "nanmean", "exp", "log", "log1p", "expm1",
    "sin", "cos", "tan", "tanh", "arctan2", "power", "float_power", "exp2", "log2", "log10", "hypot", "cbrt", "linalg", "random",
}  # fmt: skip


def test_every_folder_with_code_is_a_listed_package() -> None:
    listed = {(ROOT / folder).resolve() for folder in FOLDERS.values()}
    top = [ROOT / name for name in ("envs", "estimators", "agents", "configs")]
    found = {p.parent.resolve() for base in (*top, ROOT / "src") for p in base.rglob("__init__.py")}
    assert found == listed
    assert set(FOLDERS) == set(CONFIG["tool"]["setuptools"]["packages"])


def test_package_data_covers_every_data_file() -> None:
    patterns = CONFIG["tool"]["setuptools"]["package-data"]
    for name, folder in FOLDERS.items():
        matched = {p for pattern in patterns.get(name, []) for p in (ROOT / folder).glob(pattern)}
        children = {(ROOT / other).resolve() for other in FOLDERS.values()} - {(ROOT / folder).resolve()}
        data = {
            p for p in (ROOT / folder).rglob("*")
            if p.is_file() and p.suffix != ".py" and "__pycache__" not in p.parts and not children & set(p.resolve().parents) - set((ROOT / folder).resolve().parents)
        }  # fmt: skip
        assert data == matched, name


def test_the_description_for_an_index_links_to_nothing_that_it_lacks() -> None:
    page = (ROOT / CONFIG["project"]["readme"]).read_text(encoding="utf-8")
    assert re.findall(r"\]\((?!https?://|#)[^)]*\)|<img", page) == [] and "pip install" in page


def test_one_version_is_said_everywhere() -> None:
    """The package, how to cite it, and the newest release of the changelog, with one date; above that is what is not released."""
    released = re.findall(r"^## \[(.+?)\](?: - (\S+))?$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.M)
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    (version, date), own = released[1], CONFIG["project"]["version"]
    assert released[0] == ("Unreleased", "") and version == own and date
    assert f"\nversion: {own}\n" in cited and f"\ndate-released: {date}\n" in cited
    entry = (ROOT / "docs/index.md").read_text(encoding="utf-8").partition("@software{")[2].partition("\n}")[0]
    assert f"version = {{{own}}}" in entry and f"year = {{{date[:4]}}}" in entry and f"title = {{{TITLE}}}" in entry and TITLE in cited
    assert own not in ALIKE and ALIKE[-1] == released[2][0]


@pytest.mark.long
def test_published_boards_are_of_versions_that_play_the_same() -> None:
    boards = [*(ROOT / "results").glob("*/board.json*"), *(ROOT / "configs/boards").iterdir()]
    assert len(boards) >= 10
    assert {load(path)["suite"]["version"] for path in boards} <= {*ALIKE, CONFIG["project"]["version"]}


def test_packaged_boards_and_lists_are_those_of_results() -> None:
    """A board by name, and the list of attacks that joined its suite."""
    for path in (ROOT / "configs/boards").iterdir():
        folder = ROOT / "results" / path.name.partition(".")[0]
        assert path.read_bytes() == (folder / "board.json.xz").read_bytes(), path
    for path in (ROOT / "results").glob("*/attacks.jsonl"):
        assert (ROOT / f"configs/suites/{path.parent.name}.attacks.jsonl").read_bytes() == path.read_bytes(), path


def test_no_module_shadows_a_well_known_name() -> None:
    names = {p.name for folder in ("envs", "estimators", "agents", "configs") for p in (ROOT / folder).glob("*.py")}
    assert not names & {"types.py", "gym.py", "typing.py", "random.py", "copy.py", "io.py"}


def test_no_file_grows_past_400_lines() -> None:
    assert [path for path in SOURCES if len(path.read_text(encoding="utf-8").splitlines()) > 400] == []


def _called(tree: ast.AST) -> set[tuple[int, str]]:
    out = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("np", "numpy") and node.attr in FORBIDDEN:
            out.add((node.lineno, f"np.{node.attr}"))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ("sum", "mean", "std", "var", "prod", "dot"):
            owner = node.func.value
            if not (isinstance(owner, ast.Name) and owner.id in ("num", "math")):
                out.add((node.lineno, f".{node.func.attr}()"))
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult):
            out.add((node.lineno, "@"))
    return out


def test_the_scored_path_keeps_to_elementwise_arithmetic() -> None:
    found = {path: _called(ast.parse(path.read_text(encoding="utf-8"))) for path in SCORED if path.name not in UNSCORED}
    assert {path: calls for path, calls in found.items() if calls} == {}


def test_the_lint_sees_what_it_forbids() -> None:
    source = "import numpy as np\na = b @ c\nd = np.einsum('ij,j', b, c)\ne = b.sum(axis=0)\nf = np.exp(b)\ng = num.dot(b, c)\n"
    assert {line for line, _ in _called(ast.parse(source))} == {2, 3, 4, 5}


def test_nothing_made_by_others_can_execute() -> None:
    risky = re.compile(r"import (cloud)?pickle|pickle\.\w|\byaml\.(unsafe_)?load\(|(?<![\w.])(eval|exec)\(|torch\.load\(|np\.load\(|allow_pickle")
    assert {path: found[0] for path in SOURCES if (found := risky.search(path.read_text(encoding="utf-8")))} == {}


def test_constraints_pin_every_requirement_and_name_no_index() -> None:
    text = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    pinned = {line.split("==")[0].lower().replace("_", "-") for line in text.splitlines() if line}
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line) for line in text.splitlines() if line)
    wanted = CONFIG["project"]["dependencies"] + [r for group in CONFIG["project"]["optional-dependencies"].values() for r in group]
    names = {re.split(r"[\[><=~! ]", requirement)[0].lower().replace("_", "-") for requirement in wanted} - {"tailgate"}
    assert names <= pinned


def test_the_second_set_of_versions_differs_where_rllib_pins() -> None:
    first, second = (dict(line.split("==") for line in (ROOT / f"constraints{end}.txt").read_text("utf-8").split()) for end in ("", "-rllib"))
    assert {name: (first[name], second[name]) for name in first if second[name] != first[name]} == {"gymnasium": ("1.4.0", "1.2.2")}
    assert set(second) - set(first) == {"dm-tree", "lz4", "ormsgpack", "tensorboardX", "wrapt"}  # what RLlib brings


def test_the_public_workflows_run_what_there_is() -> None:
    """Every target of make and script that a workflow names exists; the nightly one runs the long tests and the libraries' snippets."""
    targets = set(re.findall(r"^([\w./$()-]+(?: [\w-]+)*):", (ROOT / "Makefile").read_text("utf-8").replace("$(VENV)", ".venv"), flags=re.M))
    known = {target for line in targets for target in line.split()}
    runs = {}
    for path in (ROOT / ".github/workflows").glob("*.yml"):
        jobs = yaml.safe_load(path.read_text("utf-8"))["jobs"]
        runs[path.stem] = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
        for text in runs[path.stem]:
            assert not (made := re.match(r"make (\S+)", text)) or made[1] in known, text
            for script in re.findall(r"(?:benchmarks|\.ci)/[\w./]+", text):
                assert (ROOT / script).is_file(), text
    assert ".ci/run" in runs["ci"] and {"make test-long", "make test-rllib"} <= set(runs["nightly"])
    assert any("benchmarks/ecosystem.py" in text for text in runs["nightly"])
