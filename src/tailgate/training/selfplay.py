"""Self-play: attacker and defender train in turns against growing pools; then a fresh attacker measures what the defender is worth.

Round r trains attacker r against the uniform mixture of defenders 0 to r - 1. Then it trains defender r against the uniform mixture of
attackers 1 to r. Defender 0 is the defence with its knobs at the menu's setting nearest to its own values. At the end the last defender is
frozen, and an attacker with new seeds and the same budget is trained against it: the best response. The same is done for the best fixed
setting.

    exploitability = collisions under the worst known attack - collisions under the last attacker of self-play

The known attacks are scripts, pool and fresh attackers. The worst is chosen on select seeds and reported on report seeds, for the trained
defender and for the best fixed setting. The best answer there is does at least as much. If the fresh attacker does less than the other
known attacks, the search was too weak: the report says so.

A member is trained for certain opponents: a run that goes on trains again what was trained for others.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tailgate.agents.learners.cem import Config
from tailgate.agents.learners.learning import LEARNERS, Progress, check_action, learner_of
from tailgate.agents.learners.selfplay import Learner, Played, constant, export, play
from tailgate.agents.policy.network_policy import PolicyAttack
from tailgate.base.errors import InputError, said
from tailgate.base.files import set_aside, writable_directory, write_json
from tailgate.base.locks import alone
from tailgate.base.reading import load_json
from tailgate.base.sizes import Episodes, Passes, Seeds, Steps
from tailgate.core import Array, Attack, Count, Discount, draws, param
from tailgate.core.registry import Spec
from tailgate.core.scenario import config_path
from tailgate.core.schema import as_data, build, digest, fields_of, override, read_yaml
from tailgate.envs.gym.duel import Duel, Payoff
from tailgate.estimators.challenge.steered import Steered
from tailgate.estimators.challenge.steering import nearest
from tailgate.evaluation.stats import Interval, paired_difference, proportion
from tailgate.training.settings import check_folder, check_mappings, mapping, parameters_of, started_with
from tailgate.training.train import TrainConfig, environment_of

BARE = "selfplay"  # the preset where none is named
FRESH, DEFENDERS = 1000, 500  # added to the first seed: seeds of best responses and of defenders differ from those of self-play's attackers
SELECT_EPISODES = 512  # that the best fixed setting and the worst attack are chosen on
BATCH = 4096  # games side by side
AS_IS, FIXED, TRAINED = "as it is", "best fixed setting", "trained"
Update = Callable[[str, int, int, str], None]
Crashed = dict[tuple[str, str], Array]  # by defender and attack: (episodes,) 0 or 1


@dataclass(frozen=True)
class GameConfig:
    """The configuration of `tailgate selfplay`."""

    name: str = param("selfplay", "name of the run; its files go to out/name")
    out: str = param("runs", "directory of the runs")
    scenario: str = param("gusty-stop-and-go-v0", "scenario, by name or YAML file")
    defence: str = param("chi2_kf", "registered defence whose knobs the defender turns")
    menu: dict[str, Any] = mapping("settings of the knobs: thresholds, challenges, modes")
    payoff: dict[str, Any] = mapping("what the defender is paid for")
    threat: dict[str, Any] = mapping("changes of the scenario's threat model")
    environment: dict[str, Any] = mapping("action and reward settings of the attacker")
    learner: str = param("cem", f"how the attacker learns: {', '.join(LEARNERS)}; the defender learns by cem")
    attacker: dict[str, Any] = mapping("hyper-parameters of the attacker's learner")
    defender: dict[str, Any] = mapping("hyper-parameters of the defender's learner")
    gamma: Discount = param(0.99, "discount of both [-]")
    rounds: Passes = param(2, "rounds: an attacker and a defender each")
    steps: Steps = param(300_000, "decisions of a training, over all environments")
    first_seed: Count = param(0, "first training seed")
    fresh: Seeds = param(1, "fresh attackers against the frozen defender, one training seed each")
    episodes: Episodes = param(1000, "report episodes per pair in the final table")
    rivals: tuple[str, ...] = param((), "scripted attacks in the final table")

    @property
    def directory(self) -> Path:
        return Path(self.out) / self.name


def load_config(source: str | None, overrides: list[str], resume: bool = False) -> GameConfig:
    """Return a preset by name or YAML file (default: selfplay) with `key=value` overrides; with `resume` the run's own configuration."""
    config = _checked(override(_preset(source or BARE), overrides, GameConfig))
    if not resume:
        return config
    return _checked(override(started_with(config.directory / "config.json"), overrides, GameConfig))


def _preset(source: str) -> dict[str, Any]:
    return read_yaml(config_path("games", source, "config"), "config")


def bare() -> dict[str, Any]:
    """Return the fields that the preset of a bare `tailgate selfplay` sets; the others have their defaults."""
    return _preset(BARE)


def _checked(data: dict[str, Any]) -> GameConfig:
    check_mappings(data, ("menu", "payoff", "threat", "environment", "attacker", "defender"))
    config = build(GameConfig, data, "config")
    check_folder(config.out, config.name)
    Spec("defence", config.defence).refuse_imports("config")
    for name in config.rivals:
        Spec("attack", name).refuse_imports("config")
    build(Payoff, dict(config.payoff), "config.payoff")
    _seat_of(config)
    return config


def _seat_of(config: GameConfig) -> dict[str, Any]:
    """Return arguments of the attacker's environment, checked as those of a training are."""
    names = ("scenario", "defence", "threat", "environment")
    return environment_of(TrainConfig(**{name: getattr(config, name) for name in names}))


class Game:
    """A run: what it plays, and the files that it keeps."""

    def __init__(self, config: GameConfig, update: Update, resume: bool = False) -> None:
        self.config, self.update = config, update
        if "interval" in config.menu:
            raise InputError("config.menu.interval", config.menu["interval"], "environment.interval: both decide at the same time")
        self.duel = Duel.make(**_seat_of(config), menu=config.menu, gamma=config.gamma, **config.payoff)
        if not self.duel.seat.road:
            raise InputError("config.scenario", config.scenario, "one with a road: outcomes are collisions")
        check_action(config.learner, self.duel.seat)
        module = learner_of(config.learner)
        if others := dict(config.attacker).keys() - fields_of(module.Config).keys():
            expected = f"settings of {config.learner}, or attacker={{}} for its defaults; those of the preset are of another learner"
            raise InputError("config.attacker", sorted(others), expected)
        self.settings = build(module.Config, dict(config.attacker), "config.attacker")
        self.settings.check()
        self.defender = build(Config, dict(config.defender), "config.defender")
        self.defender.check()
        self.scripts = {name: Spec("attack", name).make() for name in ("none", *config.rivals)}
        for name, attack in self.scripts.items():
            if Spec("attack", name).entry.knowledge != "black":
                raise InputError("config.rivals", name, "attacks that know no more than the learned one, which sees the road")
            attack.prepare(self.duel.seat.loop.brief)
        self.directory = config.directory
        with contextlib.ExitStack() as held:  # from here to the end of `run`
            held.enter_context(alone(config.directory))
            if not resume and config.directory.is_dir() and any(config.directory.iterdir()):
                set_aside(config.directory)
            writable_directory(config.directory)
            self._keep(resume)
            self.held = held.pop_all()

    def _keep(self, resume: bool) -> None:
        """Write the configuration, or raises InputError when the run that is resumed had another one."""
        held, now = self.directory / "config.json", as_data(self.config)
        if resume and held.is_file():
            before, free = started_with(held), ("class", "rounds", "episodes", "fresh", "rivals")
            changed = [key for key in now if key not in free and before.get(key) != now[key]]
            if changed:
                raise InputError("resume", ", ".join(changed), f"the configuration in {held}, apart from {', '.join(free[1:])}")
        write_json(held, now)

    # -- training

    def run(self) -> dict[str, Any]:
        """Play all rounds and the fresh best responses; writes and returns the report.

        What the run has finished is not trained again, as long as it was trained for the opponents of now.
        """
        with self.held:
            return self._run()

    def _run(self) -> dict[str, Any]:
        defenders, attackers = [self._as_it_is()], []
        for r in range(1, self.config.rounds + 1):
            pool = replace(self.duel.guard, policy=tuple(defenders))
            attackers.append(self._attacker(f"attacker-{r}", self.config.first_seed + r, pool))
            defenders.append(self._defender(r, tuple(PolicyAttack(path) for path in attackers)))
        frozen = replace(self.duel.guard, policy=defenders[-1])
        setting = self._best_setting(tuple(PolicyAttack(path) for path in attackers))
        fixed = replace(self.duel.guard, setting=setting)
        fresh = [self._fresh(f"fresh-{i}", i, frozen) for i in range(self.config.fresh)]
        other = [self._fresh(f"fresh-fixed-{i}", i, fixed) for i in range(self.config.fresh)]
        return self._report({AS_IS: self.duel.guard, FIXED: fixed, TRAINED: frozen}, attackers, fresh, other, setting)

    def _as_it_is(self) -> Path:
        path, setting = self.directory / "defender-0", nearest(self.duel.guard.hand.knobs)
        facts = {"learner": "none", "setting": setting}
        if _finished(path.with_suffix(".json"), facts):
            return path.with_suffix(".json")
        return export(path, self.duel, constant(self.duel, setting), facts)

    def _fresh(self, name: str, i: int, defence: Steered) -> Path:
        return self._attacker(name, self.config.first_seed + FRESH + i, defence)

    def _attacker(self, name: str, seed: int, defence: Steered) -> Path:
        environment = _seat_of(self.config) | {"defence": defence}
        module = learner_of(self.config.learner)
        facts = {"learner": self.config.learner, "seed": seed, "against": as_data(defence), "settings": as_data(self.settings)}
        return self._train(name, lambda: module.Learner(seed, self.config.gamma, self.settings, environment), facts)

    def _defender(self, r: int, attacks: tuple[Attack, ...]) -> Path:
        seed = self.config.first_seed + DEFENDERS + r
        facts = {"learner": "cem", "seed": seed, "against": as_data(attacks), "settings": as_data(self.defender)}
        return self._train(f"defender-{r}", lambda: Learner(seed, self.config.gamma, self.defender, self.duel, attacks), facts)

    def _train(self, name: str, make: Callable[[], Any], facts: dict[str, Any]) -> Path:
        """Train a member of the pools, unless it was trained with these facts, the digests of its opponents among them."""
        path, steps = self.directory / name, self.config.steps
        if _finished(path.with_suffix(".json"), facts):
            return path.with_suffix(".json")
        checkpoint = self.directory / f"checkpoint-{name}-{digest(facts)}.safetensors"  # the run may have been cut off with other opponents
        learner = make()
        if checkpoint.is_file():
            learner.load(checkpoint)

        def report(now: Progress) -> None:
            crash = "" if now.crash is None else f"collisions {100 * now.crash:4.1f} %"
            self.update(name, min(now.steps, steps), steps, crash)

        learner.learn(steps, report, checkpoint, max(steps // 10, 1))
        done: Path = learner.export(path, facts | {"steps": learner.steps, "curve": learner.curve})
        learner.close()
        for old in self.directory.glob(f"checkpoint-{name}-*.safetensors"):
            old.unlink()
        return done

    # -- measuring

    def _best_setting(self, attacks: tuple[Attack, ...]) -> int:
        """Return the setting that pays best when held throughout, against self-play's attackers in equal shares on select seeds."""
        count = len(self.duel.settings)
        paid = np.zeros(count)
        chunk = max(1, BATCH // SELECT_EPISODES)
        for attack in attacks:
            for start in range(0, count, chunk):
                chosen = np.arange(start, min(start + chunk, count))
                keys = draws.keys("select", list(range(SELECT_EPISODES)) * len(chosen))
                held = np.repeat(chosen, SELECT_EPISODES)
                out = play(self.duel, attack, keys, lambda _, held=held: held)  # type: ignore[misc]
                paid[chosen] += out.paid.reshape(len(chosen), -1).mean(axis=1)
            self.update("fixed settings", attacks.index(attack) + 1, len(attacks), "")
        return int(np.argmax(paid))

    def _play(self, defence: Steered, attack: Attack, purpose: str, episodes: int) -> Played:
        """Play the first episodes of a pair on seeds of a purpose."""
        seat = replace(self.duel.seat, loop=replace(self.duel.seat.loop, defence=defence))
        duel = replace(self.duel, seat=seat, guard=defence)
        parts = [play(duel, attack, draws.keys(purpose, range(at, min(at + BATCH, episodes)))) for at in range(0, episodes, BATCH)]
        paid, crashed, cost = (np.concatenate([getattr(part, name) for part in parts]) for name in ("paid", "crashed", "cost"))
        return Played(paid, crashed, cost, sum(part.decisions for part in parts))

    def _table(self, defenders: dict[str, Steered], attacks: dict[str, Attack]) -> tuple[list[dict[str, Any]], Crashed]:
        """Return every defender against every attack on report seeds: the rows of the table, and who crashed in which episode."""
        table: list[dict[str, Any]] = []
        crashed: Crashed = {}
        total = len(defenders) * len(attacks)
        for (defender, defence), (name, attack) in itertools.product(defenders.items(), attacks.items()):
            out = self._play(defence, attack, "report", self.config.episodes)
            crashed[defender, name] = out.crashed.astype(np.float64)
            share = _share(out.crashed)._asdict()
            table.append({"defender": defender, "attack": name, "collisions": share, "cost": float(out.cost.mean())})
            self.update("final table", len(table), total, f"{len(table)} of {total} pairs")
        return table, crashed

    def _select(self, defender: str, defence: Steered, attacks: dict[str, Attack]) -> dict[str, Interval]:
        """Return the collisions of each attack on select seeds."""
        shares = {}
        for name, attack in attacks.items():
            shares[name] = _share(self._play(defence, attack, "select", SELECT_EPISODES).crashed)
            self.update(f"worst attack, {defender}", len(shares), len(attacks), "")
        return shares

    def _report(
        self, defenders: dict[str, Steered], attackers: list[Path], fresh: list[Path], other: list[Path], setting: int
    ) -> dict[str, Any]:
        attacks: dict[str, Attack] = self.scripts | {path.stem: PolicyAttack(path) for path in (*attackers, *fresh, *other)}
        table, crashed = self._table(defenders, attacks)
        last = attackers[-1].stem
        worst: dict[str, dict[str, Any]] = {}
        exploitability: dict[str, dict[str, Any]] = {}
        for defender, own in {TRAINED: [path.stem for path in fresh], FIXED: [path.stem for path in other]}.items():
            shares = self._select(defender, defenders[defender], attacks)
            name, found = (max(names, key=lambda one: shares[one].value) for names in (attacks, own))  # of equal ones the first
            share = {one: _share(crashed[defender, one]) for one in (name, found)}
            most = max(attacks, key=lambda one: np.count_nonzero(crashed[defender, one]))
            worst[defender] = {"attack": name, "select": shares[name]._asdict(), "collisions": share[name]._asdict()}
            exploitability[defender] = {
                **paired_difference(crashed[defender, name], crashed[defender, last], share=True)._asdict(), "attack": name,
                "fresh": {"attack": found, "collisions": share[found]._asdict()},
                "weak_search": paired_difference(crashed[defender, most], crashed[defender, found], share=True).low > 0.0,
            }  # fmt: skip
        fixed, trained = (crashed[defender, worst[defender]["attack"]] for defender in (FIXED, TRAINED))
        saved = paired_difference(fixed, trained, share=True)
        knobs = self.duel.guard.hand.knobs
        values = {knob.name: float(value) for knob, value in zip(knobs, self.duel.settings[setting], strict=True)}
        config = self.config
        report = {
            "name": config.name, "scenario": config.scenario, "defence": self.duel.guard.described, "episodes": config.episodes,
            "select_episodes": SELECT_EPISODES, "config": as_data(config), "knobs": {knob.name: list(knob.levels) for knob in knobs},
            "fixed": {"setting": setting, **values}, "defender": str(self.directory / f"defender-{config.rounds}.json"),
            "self_play_attacker": last, "table": table, "exploitability": exploitability, "worst": worst,
            "worst_fixed_minus_trained": saved._asdict(),
        }  # fmt: skip
        write_json(self.directory / "report.json", report)
        return report


def _share(crashed: Array) -> Interval:
    """Return share of the episodes (B,) with a collision."""
    return proportion(int(np.count_nonzero(crashed)), len(crashed))


def _finished(path: Path, facts: dict[str, Any]) -> bool:
    """Return whether a policy lies there whose record holds these facts."""
    if not path.is_file():
        return False
    try:
        held = load_json(path, strict=False)["training"]
        return all(held.get(key) == value for key, value in facts.items())
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise InputError("resume", str(path), f"a policy of this run ({said(error)})") from None


parameters = partial(parameters_of, GameConfig)
