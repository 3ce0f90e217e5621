# ruff: noqa: E501 - tables
"""Every reader of the package: valid files for it, and the call that reads one that was made of them."""

from __future__ import annotations

import hashlib
import json
import operator
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from fuzz_roads import ROADS, beside_recorded, read_recorded, recorded
from fuzz_texts import TEXTS

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "results"
BOARD = RESULTS / "quick-v0"
POLICY = ROOT / "agents" / "policies" / "car-following-chi2_kf-0.json"
_held: dict[str, Any] = {}  # what is made once in a process
SHORT = 40_000  # bytes of a valid file, at most, where the reader has shorter ones


@dataclass(frozen=True)
class Reader:
    """A reader: the format and the name of its file, valid contents, the files beside it, and the call that reads it in a folder."""

    name: str
    form: str
    file: str
    valid: Callable[[], Sequence[bytes]]
    read: Callable[[Path], Any]
    beside: Callable[[Path], Any] = lambda folder: None
    command: tuple[str, ...] = ()  # a real command line, {} for the file
    slow: float = 1.0  # inputs are fewer by this factor: of readers that take long for a valid file


def _files(*patterns: str) -> Callable[[], list[bytes]]:
    def found() -> list[bytes]:
        held = [path.read_bytes() for pattern in patterns for path in sorted(ROOT.glob(pattern))]
        return [blob for blob in held if len(blob) < SHORT] or held

    return found


def _call(module: str, function: str, file: str, *more: Any, text: bool = False) -> Callable[[Path], Any]:
    """Return a reader: a function of the package that is given the path of the file (as `text` where it takes one), and more.

    A list among `more` is of overrides, in which {} is the folder.
    """

    def read(folder: Path) -> Any:
        path: Path | str = str(folder / file) if text else folder / file
        rest = [[part.format(folder) for part in value] if isinstance(value, list) else value for value in more]
        return operator.attrgetter(function)(import_module(f"tailgate.{module}"))(path, *rest)

    return read


# -- valid files that have to be made


def _rows() -> list[bytes]:
    from tailgate.core.scenario import load_suite
    from tailgate.evaluation.cells import evaluate
    from tailgate.evaluation.rows import encode

    rows = evaluate(load_suite("quick-v0"), defences=["kf"], attacks=["none"], seeds=3)
    return [encode([*rows, rows[0] | {"status": "error", "reason": "x"}])]


def _board() -> list[bytes]:
    """The published board of quick-v0, with two of its entries."""
    board = json.loads((BOARD / "board.json").read_text(encoding="utf-8"))
    names = [entry["defence"] for entry in board["entries"]][:2]
    for part, keys in (("entries", ("defence",)), ("cells", ("defence",)), ("curves", ("defence",)), ("comparisons", ("a", "b"))):
        board[part] = [held for held in board[part] if all(held[key] in names for key in keys)][:40]
    if board.get("detection"):
        for part in ("entries", "alarms"):
            board["detection"][part] = [held for held in board["detection"][part] if held["defence"] in names][:5]
    return [json.dumps(board).encode()]


def _sealed(blob: bytes) -> bytes:
    """The JSON file of a policy whose tensors are these bytes."""
    return json.dumps(json.loads(POLICY.read_bytes()) | {"sha256": hashlib.sha256(blob).hexdigest(), "tensors": "p.safetensors"}).encode()


def _policy(folder: Path) -> Any:
    from tailgate.agents.policy.network_policy import load_policy

    return load_policy(folder / "p.json")


def _tensors(folder: Path) -> Any:
    (folder / "p.json").write_bytes(_sealed((folder / "p.safetensors").read_bytes()))
    return _policy(folder)


def _resumed(folder: Path) -> Any:
    from tailgate.training.train import load_config, same_run

    run = folder / "runs" / "quickstart"  # the folder is the worker's own
    run.mkdir(exist_ok=True, parents=True)
    shutil.copyfile(folder / "config.json", run / "config.json")
    config = load_config(None, [], resume=True)
    same_run(config)
    return config


def _started() -> list[bytes]:
    from tailgate.core.schema import as_data
    from tailgate.training.train import load_config

    return [json.dumps(as_data(load_config(None, [])), indent=1).encode()]


def _program(folder: Path) -> Any:
    from tailgate.core.registry import Spec

    return Spec("attack", str(folder / "program.yaml")).make()


SPACE = b"ppo.learning_rate: {log: [1.0e-4, 1.0e-2]}\nppo.gae_lambda: {range: [0.9, 1.0]}\ngamma: {choices: [0.99, 0.995]}\n"
PROFILE = b"t,v\n0,20\n1.5,21.25\n10,25\n20.5,0\n"


def _profile(folder: Path) -> Any:
    from tailgate.envs.manoeuvres import Profile

    profile = Profile(folder / "profile.csv")
    return profile.initial_speed, profile.prepare(0.1)


def _read_rows(name: str) -> Callable[[Path], Any]:
    def read(folder: Path) -> Any:
        from tailgate.board import run
        from tailgate.evaluation.rows import read_rows

        run._one_round(folder, "")
        return read_rows(folder / name)

    return read


def _read_board(folder: Path) -> Any:
    from tailgate.board.files import load, read_board

    return read_board(load(folder / "board.json"))


def _trust(folder: Path) -> Any:
    import tailgate
    from tailgate.board.files import read_json
    from tailgate.trust.run import with_trust

    if "board" not in _held:
        _held["board"] = json.loads(_board()[0])
        _held["board"]["suite"]["version"] = tailgate.__version__
    return with_trust(_held["board"], read_json(folder / "trust.json", "trust"))


def _trust_files() -> list[bytes]:
    import dataclasses

    from tailgate.core.scenario import load_suite
    from tailgate.trust.run import check

    suite = dataclasses.replace(load_suite("quick-v0"), defences=("kf",), attacks=("none",))
    return [json.dumps(check(suite, runs=20)).encode()]


def _counterexamples() -> list[bytes]:
    from tailgate.falsify.case import Case
    from tailgate.falsify.run import falsify
    from tailgate.falsify.search import Search

    cases = (Case("", "linear-dos-v0", 8, "kf", (), "G error < 3", attack) for attack in ("none", "dropout:start_step=20"))
    return [json.dumps(falsify(Search(case, trials=2))["counterexample"]).encode() for case in cases]


CARD = {
    "kind": "defence", "text": "kf", "name": "Kalman", "authors": "A, B", "reference": "doi", "code": "https://example.org", "licence": "MIT",
    "uses": ["measurements"], "threat_model": "any", "training": "none", "digest": "",
}  # fmt: skip


def _learner(name: str, changes: dict[str, Any]) -> Any:
    if name not in _held:
        from tailgate.agents.learners.learning import learner_of
        from tailgate.core.schema import build

        module = learner_of(name)
        _held[name] = module.Learner(0, 0.995, build(module.Config, changes, name), {"scenario": "gusty-stop-and-go-v0", "defence": "kf"})
    return _held[name]


def _checkpoint(name: str, **changes: Any) -> tuple[Callable[[], list[bytes]], Callable[[Path], Any]]:
    def valid() -> list[bytes]:
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            learner = _learner(name, changes)
            if name == "ppo":
                learner.model._setup_learn(1, None)
            learner.save(Path(folder, "c"))
            return [Path(folder, "c").read_bytes()]

    return valid, lambda folder: _learner(name, changes).load(folder / "checkpoint.safetensors")


def _cem_checkpoint() -> tuple[Callable[[], list[bytes]], Callable[[Path], Any]]:
    return _checkpoint("cem")


def _defender_files() -> list[bytes]:
    return [path.read_bytes() for path in _defenders()]


def _defenders() -> list[Path]:
    found = [path for path in sorted(RESULTS.glob("selfplay-v0/**/*.json")) if b"tailgate-defender-1" in path.read_bytes()[:2000]]
    return found[:3]


def _defender(folder: Path) -> Any:
    from tailgate.core.registry import Spec

    return Spec("defence", f"steered:policy={folder / 'd.json'}").make()


def _defender_tensors(folder: Path) -> None:
    for path in _defenders():
        for tensors in path.parent.glob("*.safetensors"):
            shutil.copyfile(tensors, folder / tensors.name)


def _log(folder: Path) -> Any:
    from tailgate.studies.log import _whole

    (folder / "README.md").touch()
    return _whole(folder)


def _envelope(folder: Path) -> Any:
    """An envelope, with a digest that fits where there can be one: the checks behind it meet the inputs too."""
    import tempfile

    from tailgate.core.scenario import load_scenario
    from tailgate.estimators.safe_set.envelope import Envelope, Sheet

    path = folder / "envelope.json"
    with tempfile.TemporaryDirectory() as aside:
        with suppress(ValueError):
            sheet = Sheet.model_validate_json(path.read_bytes())
            path = Path(aside, "envelope.json")
            path.write_text(sheet.model_copy(update={"sha256": sheet.digest}).model_dump_json(), encoding="utf-8")
        return Envelope(path).prepare(load_scenario("stop-and-go-v0").brief().model)


def _taught() -> list[bytes]:
    columns = [{"name": name} for name in ("reading_a", "valid_a", "message_b", "known_input_0")]
    file = {"path": "train/a.parquet", "split": "train", "scenario": "a", "sha256": "x"}
    held = {"format": "tailgate-log-1", "files": [file], "defences": ["kf"], "scenarios": {"a": {"columns": columns, "dt": 0.1, "config_hash": "x"}}}
    return [json.dumps(held).encode()]


def _teach(folder: Path) -> Any:
    from tailgate.studies.envelope import Settings
    from tailgate.studies.envelope_sources import from_log

    return from_log(folder, None, Settings())


def _parquet() -> list[bytes]:
    import io

    import pyarrow
    import pyarrow.parquet

    out = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table({"a": [1, 2, 3]}).replace_schema_metadata({"cell": "x"}), out)
    return [out.getvalue()]


def _part(folder: Path) -> Any:
    from tailgate.evaluation.cells import Cell
    from tailgate.studies.log import _good

    return _good(folder / "part.parquet", Cell("quick-v0", "gusty-stop-and-go-v0", None, "kf", "none", 1, "train"))


def _journal() -> list[bytes]:
    import logging
    import tempfile

    from tailgate.training.tuning import optuna

    module = optuna()
    logging.getLogger("optuna").setLevel(logging.ERROR)
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder, "journal.jsonl"))
        study = module.create_study(storage=module.storages.JournalStorage(module.storages.journal.JournalFileBackend(file)), study_name="quickstart-tune", direction="maximize")
        study.set_user_attr("digest", "x")
        trial = study.ask()
        trial.suggest_float("gamma", 0.9, 1.0)
        study.tell(trial, 0.5)
        return [Path(file).read_bytes()]


def _search(folder: Path) -> Any:
    from tailgate.training.tuning import _open, make_search

    run = folder / "quickstart-tune"
    run.mkdir(exist_ok=True)
    shutil.copyfile(folder / "journal.jsonl", run / "journal.jsonl")
    return _open(make_search(None, [f"out={folder}"], 1)).user_attrs


# -- texts of the command line


def readers() -> dict[str, Reader]:
    """All of them by name."""
    cem, ppo = _cem_checkpoint(), _checkpoint("ppo", envs=4, rollout=4, batch_size=16)
    game, programs = "configs/games/*.yaml", "configs/attacks/*.yaml"
    tensors = [POLICY.with_suffix(".safetensors")]
    made = [
        Reader("training preset", "yaml", "config.yaml", _files("configs/*.yaml"), _call("training.train", "load_config", "config.yaml", ["out={}"], text=True),
               command=("train", "--config", "{}", "out=runs")),
        Reader("game preset", "yaml", "game.yaml", _files(game), _call("training.selfplay", "load_config", "game.yaml", ["out={}"], text=True),
               command=("selfplay", "--config", "{}", "out=runs")),
        Reader("scenario", "yaml", "scenario.yaml", _files("configs/scenarios/*.yaml"), _call("core.scenario", "load_scenario", "scenario.yaml", text=True),
               command=("evaluate", "--scenario", "{}", "--defence", "kf", "--out", "rows.jsonl")),
        Reader("suite", "yaml", "suite.yaml", _files("configs/suites/*.yaml"), _call("core.scenario", "load_suite", "suite.yaml", text=True),
               command=("evaluate", "--suite", "{}", "--out", "rows.jsonl")),
        Reader("program", "yaml", "program.yaml", _files(programs), _program,
               command=("evaluate", "--scenario", "braking-v0", "--defence", "kf", "--attack", "{}", "--out", "rows.jsonl")),
        Reader("automata", "yaml", "automata.yaml", _files("configs/automata/*.yaml"), _call("trust.automata", "load_network", "automata.yaml", text=True)),
        Reader("search space", "yaml", "space.yaml", lambda: [SPACE], _call("training.tuning", "read_space", "space.yaml", "ppo", text=True),
               command=("tune", "--trials", "1", "--space", "{}", "out=runs")),
        Reader("speed profile", "csv", "profile.csv", lambda: [PROFILE], _profile),
        *(
            Reader(f"recording of {kind}", form, name, partial(recorded, kind), partial(read_recorded, kind, name), partial(beside_recorded, kind))
            for kind, form, name in ROADS
        ),
        Reader("rows", "jsonl", "rows.jsonl", _rows, _read_rows("rows.jsonl"), command=("leaderboard", "build", "--rows", "{}", "--out", "page")),
        Reader("compressed rows", "xz", "rows.jsonl.xz", _rows, _read_rows("rows.jsonl.xz"),
               command=("leaderboard", "build", "--rows", "{}", "--out", "page")),
        Reader("list of attacks", "jsonl", "attacks.jsonl", _files("configs/suites/*.jsonl"), _call("evaluation.attack_list", "read", "attacks.jsonl")),
        Reader("board", "json", "board.json", _board, _read_board, command=("leaderboard", "page", "{}", "--out", "page"), slow=2.0),
        Reader("policy", "json", "p.json", lambda: [_sealed(tensors[0].read_bytes())], _policy,
               lambda folder: shutil.copyfile(tensors[0], folder / "p.safetensors"), ("timing", "{}", "--out", "report")),
        Reader("policy's tensors", "tensors", "p.safetensors", lambda: [tensors[0].read_bytes()], _tensors, lambda folder: (folder / "p.json").touch()),
        Reader("defender", "json", "d.json", _defender_files, _defender, _defender_tensors),
        Reader("checkpoint of cem", "tensors", "checkpoint.safetensors", *cem),
        Reader("checkpoint of ppo", "tensors", "checkpoint.safetensors", *ppo, slow=2.0),
        Reader("run's configuration", "json", "config.json", _started, _resumed),
        Reader("run's curve", "json", "curve-0.json", lambda: [b'{"curve": [], "seconds": 12.5}'], _call("training.trainings", "spent", "curve-0.json")),
        Reader("counterexample", "json", "counterexample.json", _counterexamples,
               _call("falsify.counterexample", "replayed", "counterexample.json", "kf"), command=("falsify", "kf", "--counterexample", "{}"), slow=5.0),
        Reader("card", "json", "card.json", lambda: [json.dumps(CARD).encode()], _call("board.card", "read_card", "card.json")),
        Reader("step times", "json", "step_time.json", _files("results/quick-v0/step_time.json"),
               _call("board.attachments", "Clock.read", "step_time.json")),
        Reader("timing advantages", "json", "timing.json", _files("results/quick-v0/timing.json"),
               _call("board.attachments", "Timing.read", "timing.json")),
        Reader("verification", "json", "verified.json", _files("results/quick-v0/verified/*.json"),
               _call("board.verified", "read_report", "verified.json")),
        Reader("errata", "json", "errata.json", _files("results/quick-v0/errata.json"), _call("board.attachments", "Errata.of", "board.json")),
        Reader("record of a run", "json", "run.json", _files("results/quick-v0/run.json"), _call("board.attachments", "Run.of", "board.json")),
        Reader("trust report", "json", "trust.json", _trust_files, _trust),
        Reader("trust cells", "jsonl", "cells.jsonl", lambda: [b'{"cell": "a", "status": "ok", "properties": [], "conjunctions": {}}\n' * 3],
               _call("trust.run", "_read", "cells.jsonl")),
        Reader("report of claims", "json", "report.json", _files("results/reproduction/report.json"), _call("thesis.run", "read", "")),
        Reader("envelope", "json", "envelope.json", _files("configs/envelopes/*.json"), _envelope,
               command=("evaluate", "--scenario", "stop-and-go-v0", "--defence", "envelope:path={}", "--out", "rows.jsonl")),
        Reader("log to learn from", "json", "schema.json", _taught, _teach),
        Reader("log's schema", "json", "schema.json", lambda: [b'{"format": "tailgate-log-1", "identity": "x", "files": [{"path": "README.md", "bytes": 0}]}'], _log),
        Reader("log's part", "parquet", "part.parquet", _parquet, _part),
        Reader("search's journal", "jsonl", "journal.jsonl", _journal, _search, slow=2.0),
        *(Reader(name, "text", "text", partial(list, texts), read, slow=slow) for name, texts, read, slow in TEXTS),
    ]  # fmt: skip
    return {reader.name: reader for reader in made}
