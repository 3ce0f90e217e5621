"""Training: exact resume, clear errors, and the whole run end to end on a small budget."""

import dataclasses
import json
import shlex
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from safetensors import safe_open
from safetensors.numpy import save_file

from tailgate import cli
from tailgate.agents.learners.ppo import Config, Learner
from tailgate.base.errors import InputError
from tailgate.studies import distil
from tailgate.training import comparison, train

ENVIRONMENT: dict[str, Any] = {
    "scenario": "gusty-stop-and-go-v0", "defence": "kf", "threat": {"kinds": ["dos_jam", "fdi"], "budget": 30}, "interval": 5,
}  # fmt: skip
SMALL = Config(envs=16, rollout=40, batch_size=160, epochs=2, hidden=(16,))
UPDATE = SMALL.envs * SMALL.rollout


def _learner(seed: int = 3, **changes: Any) -> Learner:
    return Learner(seed, 0.99, SMALL, ENVIRONMENT | changes)


@pytest.mark.thin(2)
@pytest.mark.parametrize("action", ["mode", "increment"])
def test_a_resumed_run_gives_the_policy_of_an_uninterrupted_one(tmp_path: Path, action: str) -> None:
    """To the last bit, episodes in flight included: the interruption falls in the middle of them."""
    straight = _learner(action=action)
    straight.learn(7 * UPDATE, lambda progress: None)
    first = _learner(action=action)
    first.learn(4 * UPDATE, lambda progress: None, tmp_path / "c.safetensors")
    second = _learner(action=action)
    np.random.rand(5)  # noqa: NPY002 - a restarted process has another global state
    second.load(tmp_path / "c.safetensors")
    second.learn(7 * UPDATE, lambda progress: None)
    assert second.model.num_timesteps == 7 * UPDATE
    for name, value in straight.model.policy.state_dict().items():
        assert np.array_equal(value.numpy(), second.model.policy.state_dict()[name].numpy()), name
    held, again = (learner.env.batch.episodes.held() for learner in (straight, second))
    for name, leaf in held.items():
        assert np.array_equal(leaf, again[name]), name
    assert straight.curve == second.curve
    a, b = straight.export(tmp_path / "a", {}), second.export(tmp_path / "b", {})
    assert a.with_suffix(".safetensors").read_bytes() == b.with_suffix(".safetensors").read_bytes()


def test_two_runs_of_one_seed_are_equal_and_of_two_seeds_are_not() -> None:
    weights = []
    for seed in (3, 3, 4):
        run = _learner(seed)
        run.learn(2 * UPDATE, lambda progress: None)
        weights.append(run.model.policy.action_net.weight.detach().numpy().copy())
    first, second, third = weights
    assert np.array_equal(first, second) and not np.array_equal(first, third)


def test_a_checkpoint_is_written_on_the_way(tmp_path: Path) -> None:
    learner, path = _learner(), tmp_path / "c.safetensors"
    seen: list[bool] = []
    learner.learn(4 * UPDATE, lambda progress: seen.append(path.exists()), path, every=2 * UPDATE)
    assert seen == [False, False, True, True]  # after two updates, when the third rollout starts


@pytest.mark.parametrize("damage", ["empty", "cut", "foreign", "other seed", "other environment", "few words", "far position"])
def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "c.safetensors"
    learner = _learner()
    learner.learn(UPDATE, lambda progress: None, path)
    blob = path.read_bytes()
    other = learner
    if damage == "empty":
        path.write_bytes(b"")
    elif damage == "cut":
        path.write_bytes(blob[: len(blob) // 2])
    elif damage == "foreign":
        path.write_bytes(learner.export(tmp_path / "p", {}).with_suffix(".safetensors").read_bytes())
    elif damage == "other seed":
        other = _learner(4)
    elif damage == "other environment":
        other = _learner(value=-3.0)
    else:  # of numpy's generator
        with safe_open(path, "np") as file:
            facts = json.loads(file.metadata()["facts"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
        if damage == "few words":
            tensors["numpy"] = tensors["numpy"][:1]
        else:
            facts["numpy_position"] = 10**6
        save_file(tensors, path, {"facts": json.dumps(facts)})
    with pytest.raises(InputError, match="checkpoint"):
        other.load(path)


def test_the_learner_rests_first() -> None:
    """The first policy attacks in about a tenth of its steps, so that some of its budget is left when it matters."""
    for action in ("mode", "increment"):
        learner = _learner(action=action)
        learner.env.reset()
        observation = np.zeros((4000, learner.env.observation_space.shape[0]), np.float32)
        actions, _ = learner.model.predict(observation)
        share = np.mean(actions != 0) if action == "mode" else np.mean(actions[:, 0] > 0)
        assert share == pytest.approx(0.1, abs=0.03)


SMALL_RUN = (
    "--config", "gusty", "name=quickstart", "steps=1280", "ppo={envs: 16, rollout: 40, batch_size: 160, epochs: 1}", "episodes=12", "rivals=['fdi:trigger=near,threshold=30']", "others=[]",
    "white_box=[]", "tensorboard=false", "workers=1",
)  # fmt: skip
COMMAND = (sys.executable, "-m", "tailgate", "train")


@pytest.fixture(scope="module")
def small_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """SMALL_RUN on the preset's scenario cut to 120 steps, attacked from step 10 on."""
    source = Path(__file__).parents[1] / "configs" / "scenarios" / f"{ENVIRONMENT['scenario']}.yaml"
    data = yaml.safe_load(source.read_text())
    data |= {"horizon": 120, "threat_model": data["threat_model"] | {"onset": 10, "end": None}}
    path = tmp_path_factory.mktemp("scenario") / "brief.yaml"
    path.write_text(yaml.safe_dump(data))
    return (*SMALL_RUN, f"scenario={path}")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The directory of the test is the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_command_trains_compares_and_writes_a_page(
    here: Path, tmp_path: Path, small_run: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("SELECT", "SHOWN"):  # episodes of the rules on the page
        monkeypatch.setattr(distil, name, 12)
    assert cli.main(["train", *small_run, "others=[kf]", "--json"]) == 0
    done = capsys.readouterr()
    report = json.loads(done.out)
    assert set(report["advantage"]) == {"no attack", "own yoked schedule", "best scripted attack"}
    assert report["attacks"][0]["label"] == "no attack"
    assert ("did no damage" in done.err) == (report["advantage"]["no attack"]["value"] <= 0.0)
    run = tmp_path / "runs" / "quickstart"
    rows = [json.loads(line) for line in (run / "rows.jsonl").read_text().splitlines()]
    played = {(row["defence"], row["attack"]) for row in rows}
    assert ("chi2_kf", str(Path("runs/quickstart/policy-0.json"))) in played and ("kf", "none") in played
    page = (run / "page" / "index.html").read_text(encoding="utf-8")
    assert "quickstart" in page and "learned" in page
    again = next(line for line in done.err.splitlines() if line.startswith("play:"))
    assert cli.main([*shlex.split(again)[2:], "--seeds", "2", "--json"]) == 0  # what the policy was granted is granted
    (entry,) = json.loads(capsys.readouterr().out)
    assert entry["attack"] == str(Path("runs/quickstart/policy-0.json")) and entry["n"] == 2
    assert cli.main(["train", "steps=1920", "--resume"]) == 0  # the rest of the configuration is the run's own
    decisions = json.loads((run / "policy-0.json").read_text())["training"]["steps"]
    assert decisions == 1920 and f"{decisions:,} decisions" in (run / "page" / "index.html").read_text(encoding="utf-8")
    monkeypatch.setitem(sys.modules, "sklearn.tree", None)  # not installed: a page without rules, no lost run
    assert cli.main(["train", "--resume"]) == 0
    assert "no rules are made of the policy: scikit-learn is missing: pip install 'tailgate[train]'" in capsys.readouterr().err
    assert "No rules were made of it: scikit-learn is missing" in (run / "page" / "index.html").read_text(encoding="utf-8")


@pytest.mark.long
def test_a_finished_comparison_is_not_played_again(
    here: Path, tmp_path: Path, small_run: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As long as policies and comparison are the same; a report that was cut counts as none."""
    assert cli.main(["train", *small_run]) == 0
    first, report = capsys.readouterr().out, tmp_path / "runs" / "quickstart" / "report.json"
    with monkeypatch.context() as patch:
        patch.setattr(comparison, "play_scripts", lambda *_: pytest.fail("played again"))
        assert cli.main(["train", "--resume"]) == 0 and capsys.readouterr().out == first
    held, rows = report.read_text(), report.with_name("rows.jsonl")
    report.write_text(held[:-20])
    assert cli.main(["train", "--resume"]) == 0 and report.read_text() == held
    lines = rows.read_text()
    rows.write_text("".join(lines.splitlines(keepends=True)[:4]))  # rows that the report is not of
    assert cli.main(["train", "--resume"]) == 0 and rows.read_text() == lines and report.read_text() == held
    mine = json.loads((report.with_name("config.json")).read_text())["rivals"]
    program = tmp_path / "mine.yaml"
    for step in (20, 30):  # a rival whose file has changed since
        program.write_text(files("tailgate.configs").joinpath("attacks/brake_and_blind.yaml").read_text() + f"# {step}\n")
        assert cli.main(["train", "--resume", f"rivals={json.dumps([*mine, f'program:path={program}'])}"]) == 0
        assert "the comparison of these policies is there" not in capsys.readouterr().err
    assert cli.main(["train", "--resume", "episodes=5"]) == 0 and json.loads(report.read_text())["episodes"] == 5


@pytest.mark.long
def test_learners_may_share_what_was_played(here: Path, small_run: tuple[str, ...]) -> None:
    """Rows lie with the first of them; the report of the second is no comparison that its own run could go on from."""
    configs = [train.load_config("gusty", [*small_run[2:], f"name={name}"]) for name in ("one", "two")]
    policies = [train.train(config, lambda *_: None) for config in configs]
    scripts = comparison.play_scripts(configs[0], [path for found in policies for path in found])
    reports = [comparison.compare(config, found, scripts=scripts) for config, found in zip(configs, policies, strict=True)]
    assert reports[0]["attacks"] == reports[1]["attacks"] and not (configs[1].directory / "rows.jsonl").exists()
    assert [comparison.finished(config, found) for config, found in zip(configs, policies, strict=True)] == [None, None]


@pytest.mark.long
def test_the_final_comparison_begins_at_the_episode_that_is_named(here: Path, small_run: tuple[str, ...]) -> None:
    """Learned, scripted and yoked alike play that block, and no policy depends on it."""
    wanted, hashes = {}, set()
    for first in (0, 1000):
        assert cli.main(["train", *small_run, f"first_episode={first}"]) == 0
        rows = [json.loads(line) for line in Path("runs/quickstart/rows.jsonl").read_text().splitlines()]
        assert {row["seed"] for row in rows} == set(range(first, first + 12))
        policy = json.loads(Path("runs/quickstart/policy-0.json").read_text())
        hashes.add(policy["sha256"])
        wanted[first] = [row["trace_hash"] for row in rows if row["attack"] == "none"]
    assert len(hashes) == 1 and not set(wanted[0]) & set(wanted[1000])


@pytest.mark.long
def test_decisions_beyond_those_that_were_asked_for_are_said(
    here: Path, capsys: pytest.CaptureFixture[str], small_run: tuple[str, ...]
) -> None:
    """Rollouts are 640 decisions here; what was asked for exactly is not worth a word."""
    assert cli.main(["train", *small_run, "steps=1300"]) == 0
    assert "1,920 decisions a seed (1,300 asked for)" in " ".join(capsys.readouterr().err.split())
    assert cli.main(["train", *small_run]) == 0
    assert "asked for" not in capsys.readouterr().err


SYSTEMS = {"platoon": "crashed", "network": "rmse_position"}


@pytest.mark.long
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_command_trains_on_every_system(here: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Policy, comparison by the system's own outcome, yoked twin and page; the policy plays in an evaluation of its scenario."""
    config = train.load_config(name, [])
    small = [
        "steps=560",
        "ppo.envs=16",
        "ppo.rollout=35",
        "ppo.batch_size=140",
        "ppo.epochs=1",
        "episodes=6",
        f"rivals=['{config.rivals[0]}']",
        "others=[]",
    ]
    assert cli.main(["train", "--config", name, *small, "tensorboard=false", "workers=1", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["outcome"] == SYSTEMS[name] and report["attacks"][0]["label"] == "no attack"
    assert {"learned, seed 0", "learned, seed 0, yoked"} <= {item["label"] for item in report["attacks"]}
    assert all(item["low"] <= item["value"] <= item["high"] for item in report["attacks"])
    run = tmp_path / "runs" / name
    rows = [json.loads(line) for line in (run / "rows.jsonl").read_text().splitlines()]
    learned = [row[report["outcome"]] for row in rows if row["learned"]]
    assert len(learned) == 6 and np.mean(learned) == pytest.approx(report["attacks"][2]["value"])
    page = (run / "page" / "index.html").read_text(encoding="utf-8")
    assert "learned" in page and (name != "network" or "Mean rmse_position of 6 fresh episodes" in page)
    points = json.loads((run / "curve-0.json").read_text())["curve"]
    assert all((point["crash"] is None) == (name == "network") for point in points)


@pytest.mark.long
def test_a_run_that_was_killed_and_resumed_gives_the_policy_of_an_uninterrupted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_run: tuple[str, ...]
) -> None:
    """SIGKILL in the middle of a rollout, at no moment that the program chose."""
    long_run = [*small_run, "steps=15360", "checkpoint_every=640"]  # long enough to be killed in, also where programs are cached
    for name in ("straight", "killed"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "straight")
    assert cli.main(["train", *long_run]) == 0
    process = subprocess.Popen([*COMMAND, *long_run], cwd=tmp_path / "killed", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    run = tmp_path / "killed" / "runs" / "quickstart"
    while not (run / "checkpoint-0.safetensors").exists():
        assert process.poll() is None
        time.sleep(0.02)
    time.sleep(0.15)
    process.kill()
    process.wait()
    assert not (run / "policy-0.json").exists()
    monkeypatch.chdir(tmp_path / "killed")
    assert cli.main(["train", "--resume"]) == 0
    one, two = ((tmp_path / name / "runs" / "quickstart" / "policy-0.safetensors").read_bytes() for name in ("straight", "killed"))
    assert one == two


def _refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What the command says on standard error of an input that it refuses; the first of them in a process of its own."""
    if "stepz=10" in arguments:
        done = subprocess.run([*COMMAND, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 2, done.stderr
        return done.stderr
    assert cli.main(["train", *arguments]) == 2
    return capsys.readouterr().err


@pytest.mark.thin(2)
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["stepz=10"], ["stepz", "steps"]), (["steps=-1"], ["steps", "-1"]), (["defence=kff"], ["kff", "'kf'"]), (["ppo.epoch=1"], ["epoch", "epochs"]),
        (["defence=os:system"], ["os:system", "registered"]), (["threat.budget=-3"], ["budget", "-3"]), (["environment.action=fly"], ["action", "fly"]),
        (["ppo.batch_size=7"], ["batch_size", "7"]), (["--config", "nosuch"], ["nosuch", "quickstart"]), (["--config", "bad.yaml"], ["bad.yaml", "YAML"]),
        (["out=file/below"], ["file", "writable"]), (["steps"], ["steps", "key=value"]), (["scenario=nan.yaml"], ["nan", "line 3"]),
        (["environment.defence=os:system"], ["defence", "environment"]), (["environment.gamma=0.5"], ["gamma"]), (["gamma=1.5"], ["gamma", "1.5"]), (["name=../up"], ["name", "../up"]),
        (["threat.knowledge=gray"], ["knowledge", "gray"]), (["ppo.batch_size=1"], ["batch_size", "1"]),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_error_and_leaves_nothing(
    here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: list[str]
) -> None:
    (tmp_path / "bad.yaml").write_text("a: [1\n")
    (tmp_path / "file").write_text("")
    (tmp_path / "nan.csv").write_text("t,v\n0,20\n1,nan\n")
    (tmp_path / "nan.yaml").write_text(
        "plant: car_following\nsensor: odometry\ncontroller: acc\nmanoeuvre: {name: profile, path: nan.csv}\nhorizon: 10\n"
    )
    before = sorted(p.name for p in tmp_path.rglob("*"))
    said = _refused([*SMALL_RUN, *arguments], capsys)
    error = [line for line in said.splitlines() if line.startswith("tailgate: error: ")]
    assert len(error) == 1 and "Traceback" not in said
    assert all(word in error[0] for word in words) and "expected" in error[0]
    assert sorted(p.name for p in tmp_path.rglob("*")) == before


def test_a_configuration_is_one_schema() -> None:
    config = train.load_config(None, ["threat.budget=5", "ppo.epochs=3", "rivals=[none]"])
    assert config.threat["budget"] == 5 and config.ppo["epochs"] == 3 and config.rivals == ("none",)
    assert train.load_config("quickstart", []).steps == train.load_config(None, []).steps


def test_training_seeds_share_no_environment() -> None:
    """Stable-Baselines3 numbers the rows of seed s from s on: two training seeds must not meet there."""
    keys = []
    for seed in (0, 1):
        learner = _learner(seed, engine="plain")
        learner.learn(UPDATE, lambda progress: None)
        assert learner.env.batch.state is not None
        keys.append({int(k) for k in learner.env.batch.state.keys.key[:, 0]})
    assert not keys[0] & keys[1]


@pytest.mark.long
def test_a_fresh_start_forgets_the_run_before_and_resume_wants_the_same_learner(
    here: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], small_run: tuple[str, ...]
) -> None:
    """A policy of one configuration must not end up beside the JSON of another."""
    learner = _learner()
    learner.learn(UPDATE, lambda progress: None, tmp_path / "c.safetensors")
    other = Learner(3, 0.9, SMALL, ENVIRONMENT)
    with pytest.raises(InputError, match="checkpoint"):
        other.load(tmp_path / "c.safetensors")
    run = tmp_path / "runs" / "quickstart"
    run.mkdir(parents=True)
    (run / "checkpoint-0.safetensors").write_bytes(b"of an older run")
    (run / "policy-7.json").write_text("{}")
    assert cli.main(["train", *small_run]) == 0
    assert not (run / "policy-7.json").exists()
    assert (run.with_name("quickstart.1") / "policy-7.json").read_text() == "{}"  # set aside, not lost
    (run / "config.json").write_text("{")
    capsys.readouterr()
    assert cli.main(["train", *small_run, "--resume"]) == 2
    assert "resume" in capsys.readouterr().err
    assert cli.main(["train", *small_run]) == 0
    assert cli.main(["train", "--resume", "gamma=0.5"]) == 2
    assert "got 'gamma=0.5'; expected gamma=0.99, as in" in capsys.readouterr().err
    held = {path: path.read_bytes() for path in run.glob("*.json")}
    assert cli.main(["train", "--resume", "steps=10"]) == 2
    assert "steps: got 10; expected at least" in capsys.readouterr().err and all(path.read_bytes() == text for path, text in held.items())


@pytest.mark.long
def test_trainings_that_share_processes_give_the_same_policies(tmp_path: Path) -> None:
    """Two seeds of two learners side by side, and one after the other: the same files, whatever ran beside or before them."""
    learners = {
        "ppo": ["steps=1280", "ppo.envs=16", "ppo.rollout=20", "ppo.batch_size=160", "ppo.epochs=1"],
        "cem": ["steps=2400", "cem={population: 6, episodes: 4, hidden: [4]}"],
    }
    shared = [f"out={tmp_path}", "seeds=2", "workers=2", "environment.interval=20", "tensorboard=false", "rivals=[none]"]
    configs = [train.load_config(None, [f"name={name}", f"learner={name}", *shared, *settings]) for name, settings in learners.items()]
    seen: set[tuple[str, int]] = set()
    together = train.train_together([(config, False) for config in configs], lambda config, seed, now: seen.add((config.name, seed)), 2)
    assert seen == {(name, seed) for name in learners for seed in (0, 1)}
    for config, policies in zip(configs, together, strict=True):
        assert [path.parent for path in policies] == [config.directory] * 2
        alone = train.train(dataclasses.replace(config, name=f"{config.name}-alone", workers=1), lambda seed, now: None)
        first, second = ([path.with_suffix(".safetensors").read_bytes() for path in found] for found in (policies, alone))
        assert first == second and first[0] != first[1]
