"""Training: from a configuration to policies, one for each training seed."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tailgate.agents.learners.finished import finished
from tailgate.agents.learners.learning import DISCRETE, LEARNERS, Config, Progress, Teachable, check_action, learner_of
from tailgate.base import sizes
from tailgate.base.errors import InputError, said, unknown
from tailgate.base.files import set_aside, writable_directory, write_json
from tailgate.base.locks import alone
from tailgate.base.reading import load_json
from tailgate.base.sizes import Episodes, Seeds, Steps, Workers
from tailgate.core import Count, Discount, PositiveCount, param
from tailgate.core.registry import Spec
from tailgate.core.scenario import Suite, config_path, load_scenario
from tailgate.core.schema import as_data, build, canonical, fields_of, override, read_yaml
from tailgate.core.threat import KNOWLEDGE, ThreatModel
from tailgate.engine import cards
from tailgate.envs.gym.actions import ActionSpec
from tailgate.envs.gym.attacker_mdp import Seat
from tailgate.envs.gym.rewards import Reward
from tailgate.evaluation.baselines import best_of
from tailgate.evaluation.cells import cells_of
from tailgate.play.metrics import check_outcome
from tailgate.training.settings import check_folder, check_mappings, check_places, mapping, parameters_of, started_with
from tailgate.training.trainings import Training, train_all

BARE = "quickstart"  # the preset where none is named
ENVIRONMENT = (fields_of(ActionSpec) | fields_of(Reward) | {"frames": None}).keys() - {"gamma", "horizon_ends"}  # that it may hold
# fields that change no policy; those of CHOSEN do where the best rival teaches
COMPARED = {"episodes", "first_episode", "white_box", "others", "workers", "device"}
CHOSEN = {"rivals", "select_episodes", "outcome"}
# fields that joined when policies had been published, with the values that those were trained with
LATER: dict[str, Any] = {"demonstrations": 1024, "horizon_ends": False}


@dataclass(frozen=True)
class TrainConfig:
    """The configuration of `train.py`. A learner's settings are below its name, the environment's below `environment`."""

    name: str = param("quickstart", "name of the run; its files go to out/name")
    out: str = param("runs", "directory of the runs")
    scenario: str = param("gusty-stop-and-go-v0", "scenario, by name or YAML file")
    defence: str = param("chi2_kf", "registered defence to attack")
    threat: dict[str, Any] = mapping("changes of the scenario's threat model")
    environment: dict[str, Any] = mapping("action and reward settings of the environment")
    learner: str = param("ppo", f"who learns: {', '.join(LEARNERS)}")
    ppo: dict[str, Any] = mapping("hyper-parameters of PPO")
    maskable_ppo: dict[str, Any] = mapping("hyper-parameters of PPO with action masks")
    recurrent_ppo: dict[str, Any] = mapping("hyper-parameters of PPO with an LSTM")
    dqn: dict[str, Any] = mapping("hyper-parameters of DQN")
    sac: dict[str, Any] = mapping("hyper-parameters of SAC")
    tqc: dict[str, Any] = mapping("hyper-parameters of TQC")
    cem: dict[str, Any] = mapping("hyper-parameters of the cross-entropy method")
    settings: dict[str, Any] = mapping("hyper-parameters of a learner that has no field here", if_any=True)
    teacher: str | None = param(None, "script that PPO imitates before it learns: one by name, or `best` of the rivals; none: from scratch")
    demonstrations: Episodes = param(1024, "episodes of its teacher that a learner is shown")
    gamma: Discount = param(0.995, "discount, of the learner and of the shaping [-]")
    horizon_ends: bool = param(True, "nothing is expected behind the horizon, which the observation shows coming; false: as before 0.3")
    steps: Steps = param(3_000_000, "decisions per training seed, over all environments")
    first_seed: Count = param(0, "first training seed")
    seeds: Seeds = param(1, "training seeds, one policy each")
    checkpoint_every: PositiveCount = param(500_000, "decisions between checkpoints, or a tenth of `steps` where that is less")
    tensorboard: bool = param(True, "write TensorBoard event files")
    outcome: str | None = param(None, "metric that is compared, the larger the worse; none: crashed, or rmse_position without a road")
    episodes: Episodes = param(400, "fresh episodes per attack in the final comparison")
    first_episode: Count = param(0, "number of the first of them: another block has not been seen", if_any=True)
    select_episodes: Episodes = param(1024, "other episodes, that the best rival is chosen on: fewer choose by chance")
    workers: Workers = param(2, "processes, of the training seeds and of the comparison; change no result")
    device: str | None = param(None, "device of the training's environments, cpu or cuda; changes no result", if_any=True)
    rivals: tuple[str, ...] = param((), "scripted attacks of equal knowledge and dose to compare with")
    white_box: tuple[str, ...] = param(("stealth:trigger=near,threshold=40",), "attacks that know more, shown next to the others")
    others: tuple[str, ...] = param(("none", "kf", "oracle"), "further defences that the attacks are played on")

    @property
    def directory(self) -> Path:
        return Path(self.out) / self.name

    def settings_of(self, learner: str) -> dict[str, Any]:
        """Return the hyper-parameters that this run gives to a learner."""
        return dict(getattr(self, learner) if learner in fields_of(TrainConfig) else self.settings.get(learner, {}))


def load_config(source: str | None, overrides: list[str], resume: bool = False) -> TrainConfig:
    """Return a preset by name or YAML file (default: quickstart) with `key=value` overrides; with `resume` the run's own configuration."""
    config = checked(override(_preset(source or BARE), overrides, TrainConfig))
    held = _told(config)
    if not resume:
        return config
    if not config.directory.is_dir():
        known = sorted(p.parent.name for p in Path(config.out).glob("*/config.json"))
        raise InputError("resume", config.name, f"the name of a run in {config.out}: {', '.join(known) or 'there is none'}")
    return checked(override(LATER | started_with(held), overrides, TrainConfig))


def _preset(source: str) -> dict[str, Any]:
    """Return the fields of a preset; those of its `base`, another preset, where it does not have them. A field is replaced as a whole."""
    data = read_yaml(config_path(".", source, "config"), "config")
    base = data.pop("base", None)
    if base is None:
        return data
    under = read_yaml(config_path(".", base, "config.base"), "config.base") if isinstance(base, str) else {"base": base}
    if "base" in under:  # one level, so that nobody looks for a field in many files
        raise InputError("config.base", base, "a preset, by name or YAML file, that has no base")
    return under | data


def checked(data: dict[str, Any]) -> TrainConfig:
    """Return a configuration from JSON data. Raises InputError for a field that makes no sense, and for one that names code to import."""
    check_mappings(data, ("threat", "environment", *LEARNERS))
    if others := {name: data[name] for name in data if name in LEARNERS and name not in fields_of(TrainConfig)}:
        data = {key: value for key, value in data.items() if key not in others}
        data["settings"] = data.get("settings", {}) | others
    if not data.keys() <= fields_of(TrainConfig).keys():
        check_places(data, fields_of(TrainConfig), _places(data.get("learner")))
    config = build(TrainConfig, data, "config")
    check_folder(config.out, config.name)
    if config.device is not None:
        cards.checked(config.device)
    if config.outcome is not None:
        check_outcome("config.outcome", config.outcome)
    shown = () if config.teacher in (None, "best") else (config.teacher,)
    for defence in (config.defence, *config.others):
        Spec("defence", defence).refuse_imports("config")
    for attack in (*config.rivals, *config.white_box, *shown):
        Spec("attack", attack).refuse_imports("config")
    if shown:
        _ = Spec("attack", shown[0]).entry  # a name that exists
    return config


def recorded(data: dict[str, Any]) -> TrainConfig:
    """Return the configuration that the record of a policy holds. Records without `horizon_ends` are of trainings that had none."""
    return checked(LATER | {key: value for key, value in data.items() if key != "class"})


def _places(learner: object) -> dict[str, Iterable[str]]:
    """Return the fields below each field: those of the learner in use, then those of the other ones that are installed."""
    places: dict[str, Iterable[str]] = {}
    for name in sorted(LEARNERS, key=lambda name: name != learner):
        with contextlib.suppress(ImportError):
            places[name] = fields_of(learner_of(name).Config)
    return places | {"environment": ENVIRONMENT, "threat": fields_of(ThreatModel)}


def environment_of(config: TrainConfig) -> dict[str, Any]:
    """Return arguments of the adversary environment."""
    for key in config.environment:
        if key not in ENVIRONMENT:  # the scenario, the defence, the threat model and gamma have other fields
            raise unknown("config.environment: unknown field", key, ENVIRONMENT)
    place = {"scenario": config.scenario, "defence": config.defence, "threat": dict(config.threat)}
    return place | config.environment | {"horizon_ends": config.horizon_ends}


def outcome_of(config: TrainConfig) -> str:
    """Return the metric that the comparison counts."""
    if config.outcome is not None:
        return config.outcome
    return "crashed" if load_scenario(config.scenario).brief().model.followers.any() else "rmse_position"


def check(config: TrainConfig) -> None:
    """Try everything that a run will need before anything is written: a typing error shall not cost an hour."""
    settings = _settings(config)
    for name in set(LEARNERS) - {config.learner}:  # a typing error there as well, where that learner is installed
        with contextlib.suppress(ImportError):
            build(learner_of(name).Config, config.settings_of(name), f"config.{name}")
    seat = Seat.make(**environment_of(config))
    check_action(config.learner, seat)
    _check_memory(config, settings, seat)
    if config.teacher is not None:
        _check_teacher(config, seat)
    cells_of(suite_of(config, (*config.rivals, *config.white_box)), threat=config.threat)


def _check_memory(config: TrainConfig, settings: Config, seat: Seat) -> None:
    """Raise InputError where the environments side by side, and the decisions that a learner keeps, take more memory than is free."""
    rows = getattr(settings, "envs", 0) or getattr(settings, "population", 0) * getattr(settings, "episodes", 0)
    kept = max(rows * getattr(settings, "rollout", 0), getattr(settings, "buffer_size", 0))
    side_by_side, seen = min(config.workers, config.seeds), 16 * len(seat.observation.names)  # bytes: before and after, and half for copies
    needed = side_by_side * (rows * seat.memory + kept * (seen + 64))
    what = f"{rows:,} environments and {kept:,} kept decisions in each of {side_by_side} trainings"
    sizes.fits(needed, f"config.{config.learner}: size", rows, what)


def long(config: TrainConfig) -> None:
    """Say before it begins what takes long."""
    rounds = -(-config.seeds // config.workers)
    sizes.announce(rounds * config.steps / sizes.DECISIONS_A_SECOND, 0.0, f"{config.seeds} trainings of {config.steps:,} decisions")


def _check_teacher(config: TrainConfig, seat: Seat) -> None:
    """Raise InputError unless the learner can be shown what is wanted, and a script is shown that knows no more than the learner."""
    where, name = "config.teacher", config.teacher
    if not issubclass(learner_of(config.learner).Learner, Teachable):
        raise InputError(where, name, f"none: {config.learner} is not shown anything; ppo, maskable_ppo and cem are")
    if not seat.action.discrete:
        raise InputError(where, name, f"none, or an action of {', '.join(DISCRETE)}: what is shown is one of a few")
    if name == "best" and not config.rivals:
        raise InputError(where, name, "rivals to choose it from; there are none")
    granted = KNOWLEDGE.index(seat.loop.threat.knowledge)
    for text in config.rivals if name == "best" else (str(name),):
        spec = Spec("attack", text)
        if spec.entry.optimal or spec.entry.learned or KNOWLEDGE.index(spec.entry.knowledge) > granted:
            raise InputError(where, text, "a script that knows no more than the learner, and is neither learned nor a computed optimum")
        spec.make().prepare(seat.loop.brief)


def suite_of(config: TrainConfig, attacks: tuple[str, ...]) -> Suite:
    """Return the final comparison, with these attacks."""
    defences = tuple(dict.fromkeys((config.defence, *config.others)))  # each once
    return Suite(config.name, "", (config.scenario,), (None,), defences, attacks, config.episodes)


def rivals_of(config: TrainConfig) -> Suite:
    """Return the scripts against the defence, on as many episodes as a choice needs."""
    return Suite(config.name, "", (config.scenario,), (None,), (config.defence,), config.rivals, config.select_episodes)


def _teacher(config: TrainConfig, chosen: dict[str, str | None]) -> str | None:
    """Return the script that the learner is shown; `best` is chosen on tune seeds, once for all that ask the same (chosen)."""
    if config.teacher != "best":
        return config.teacher
    rivals = dataclasses.replace(rivals_of(config), name="rivals")
    asked = canonical([as_data(rivals), config.threat, outcome_of(config)])
    if asked not in chosen:
        chosen[asked] = best_of(rivals, dict(config.threat), outcome_of(config), "tune", config.workers)
    if chosen[asked] is None:
        raise InputError("config.teacher", "best", "a rival that can act here")
    return chosen[asked]


def train(config: TrainConfig, progress: Callable[[int, Progress], None], resume: bool = False) -> list[Path]:
    """Train one policy per seed; returns their JSON files. `progress(seed, Progress)` is called after each rollout."""
    (found,) = train_together([(config, resume)], lambda _, seed, now: progress(seed, now), config.workers)
    return found


def train_together(
    runs: Sequence[tuple[TrainConfig, bool]], progress: Callable[[TrainConfig, int, Progress], None], workers: int
) -> list[list[Path]]:
    """Train the policies of several runs, a list for each; their seeds share the workers. A run comes with whether it is resumed.

    Nothing is written before all runs are known to make sense, nor of a run before its turn comes.
    """
    for config, _ in runs:
        check(config)
        with cards.playing_on(config.device or "cpu"):  # a card that cannot play is found out now
            pass
    with contextlib.ExitStack() as locks:
        for directory in sorted({config.directory for config, _ in runs}):
            locks.enter_context(alone(directory))
        return _together(runs, progress, workers)


def _together(
    runs: Sequence[tuple[TrainConfig, bool]], progress: Callable[[TrainConfig, int, Progress], None], workers: int
) -> list[list[Path]]:
    chosen: dict[str, str | None] = {}
    ready = [_prepared(config, resume, chosen) for config, resume in runs]
    begun: set[str] = set()

    def begin(training: Training) -> None:
        if str(training.config.directory) not in begun:
            begun.add(str(training.config.directory))
            _begin(training.config, training.resume)

    for (config, resume), (_, left) in zip(runs, ready, strict=True):
        if not left:  # all is there, and the comparison may be another one
            _begin(config, resume)
    trainings = [training for _, left in ready for training in left]
    new = iter(train_all(trainings, begin, lambda training, now: progress(training.config, training.seed, now), workers))
    found = [done | {training.seed: next(new) for training in left} for done, left in ready]
    return [[paths[seed] for seed in training_seeds(config)] for (config, _), paths in zip(runs, found, strict=True)]


def training_seeds(config: TrainConfig) -> range:
    """Return the training seeds of a run."""
    return range(config.first_seed, config.first_seed + config.seeds)


def _prepared(config: TrainConfig, resume: bool, chosen: dict[str, str | None]) -> tuple[dict[int, Path], list[Training]]:
    """Return the policies that a run has, by seed, and the trainings that are left. Writes nothing."""
    done: dict[int, Path] = {}
    if resume and _told(config).is_file():
        same_run(config)
    if resume:
        same = partial(_same_training, as_data(config))
        found = {seed: finished(config.directory, seed, config.defence, same) for seed in training_seeds(config)}
        done = {seed: path for seed, path in found.items() if path is not None}
    left = [seed for seed in training_seeds(config) if seed not in done]
    if not left:
        return done, []
    shared = _settings(config), environment_of(config), _teacher(config, chosen)
    return done, [Training(config, seed, resume, *shared) for seed in left]


def _begin(config: TrainConfig, resume: bool) -> None:
    """Write the configuration into a run's directory; set aside what another run left there."""
    if not resume and config.directory.is_dir() and any(config.directory.iterdir()):
        set_aside(config.directory)
    writable_directory(config.directory)
    if not _is_held(config, _told(config)):
        write_json(_told(config), as_data(config))


def _told(config: TrainConfig) -> Path:
    return config.directory / "config.json"


def _is_held(config: TrainConfig, held: Path) -> bool:
    """Return whether a file has this configuration already, workers apart, which change no result: published files stay as they are."""
    try:
        before = load_json(held, strict=False)
    except (OSError, ValueError):
        return False
    return isinstance(before, dict) and before | {"workers": config.workers} == as_data(config)


def _settings(config: TrainConfig) -> Config:
    """Return the learner's hyper-parameters, checked."""
    settings: Config = build(learner_of(config.learner).Config, config.settings_of(config.learner), f"config.{config.learner}")
    settings.check()
    return settings


def free_of(teacher: str | None) -> set[str]:
    """Return fields of a configuration that change no policy."""
    return COMPARED | (set() if teacher == "best" else CHOSEN)


def training_of(config: dict[str, Any]) -> str:
    """Return what decides the policies of a configuration, as a text that is the same for the same training in any folder."""
    free = free_of(config.get("teacher")) | {"out", "name"}
    free |= {name for name, before in LATER.items() if config.get(name, before) == before}
    return canonical({key: value for key, value in config.items() if key not in free})


def _same_training(config: dict[str, Any], other: object) -> bool:
    """Return whether the data of a file are a configuration of the same training."""
    return isinstance(other, dict) and training_of(other) == training_of(config)


def is_training(config: TrainConfig, held: Path) -> bool:
    """Return whether a file holds a configuration of this training; one that cannot be read holds none."""
    try:
        return _same_training(as_data(config), load_json(held, strict=False))
    except (OSError, ValueError):
        return False


def plan_key(config: dict[str, Any]) -> str:
    """Return the training of a configuration but for the defence that it is against: what a suite's plan asks of everybody."""
    text = training_of({key: value for key, value in config.items() if key not in ("defence", "horizon_ends")})
    return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def same_run(config: TrainConfig) -> None:
    """Raise InputError when a run would be resumed with another training; more steps, and another comparison, may be asked for."""
    held = _told(config)
    now, blank, free = as_data(config), as_data(TrainConfig()), free_of(config.teacher) | {"steps", "name", "out"}  # it may have been moved
    try:
        before = load_json(held, strict=False)
        pairs = {key: (before.get(key, LATER.get(key, blank[key])), now[key]) for key in now if key not in free}
        changed = {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise InputError("resume", str(held), f"the configuration of the run ({said(error)})") from None
    if changed:
        was = ", ".join(f"{key}={json.dumps(old)}" for key, (old, _) in changed.items())
        asked = ", ".join(f"{key}={json.dumps(new)}" for key, (_, new) in changed.items())
        raise InputError("resume", asked, f"{was}, as in {held}: steps and the comparison's fields may change")
    made = before.get("steps", blank["steps"])
    if done := sorted(config.directory.glob("policy-*.json")) if config.steps < made else []:
        raise InputError("steps", config.steps, f"at least {made}, as {done[0]} was trained: what was learned is not taken back")


def figures(progress: Progress) -> str:
    """Return the curve's latest figures, as a progress bar shows them."""
    text = f"{progress.steps / 1e6:5.2f} M decisions"
    if progress.crash is not None:
        text += f", collisions {100 * progress.crash:4.1f} %"
    return text if progress.reward is None else f"{text}, return {progress.reward:+.2f}"


parameters = partial(parameters_of, TrainConfig)


def bare() -> dict[str, Any]:
    """Return the fields that the preset of a bare `tailgate train` sets; the others have their defaults."""
    return _preset(BARE)
