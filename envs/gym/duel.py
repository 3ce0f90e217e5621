"""The game of two: an attacker and a defender decide at the same time, every `interval` steps of one loop (docs/two-players.md).

The attacker acts as in the one-player environments (`Seat`). The defender turns the knobs of its defence (`Steered`). It sees what the
defence sees, and nothing else of the road or of the attack. `Duel` is the batched core: the PettingZoo environment is a batch of one.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from tailgate.base.errors import InputError, unknown
from tailgate.base.pytree import put_rows
from tailgate.core import Array, Attack, Command, Defence, Frame, NonNegative, View, draws, param
from tailgate.core.draws import Keys, Role
from tailgate.core.loop import LoopState
from tailgate.core.registry import Spec, entry_for
from tailgate.core.scenario import ScenarioLike
from tailgate.core.schema import as_data, build, digest, fields_of
from tailgate.core.threat import KNOWLEDGE
from tailgate.envs.gym.actions import ActionSpec
from tailgate.envs.gym.attacker_mdp import CAR_FOLLOWING, FACES, Outcome, Seat, Tally
from tailgate.envs.gym.mixture import Mixture
from tailgate.envs.gym.specs import Specified, check_options, in_box, shown
from tailgate.estimators.challenge.steered import Steered, SteeredChallenge, SteeredPlan, SteeredState
from tailgate.estimators.challenge.steering import LIMIT, Menu

DEFENDER = "tailgate/Defender-v0"


@dataclass(frozen=True)
class Payoff:
    """The defender's payment. Scores never use it.

    safety: -1 at a collision, and the costs of being careful. zero_sum: minus what the attacker is paid, which forgives any care. The costs
    are no potentials: they say how much driving is worth.
    """

    payoff: Literal["safety", "zero_sum"] = param("safety", "safety or zero_sum")
    mode_cost: NonNegative = param(0.01, "safety: cost of another mode than normal [1/s]")
    alarm_cost: NonNegative = param(0.01, "safety: cost of an alarm in a decision without an attack step: a false one [1/s]")
    gap_cost: NonNegative = param(0.01, "safety: cost of twice the desired gap or more, of less in proportion [1/s]")


class DuelState(NamedTuple):
    """B games; every leaf has B first."""

    loop: LoopState
    tally: Tally
    seen: Array  # (B, d) float32: the attacker's observation


class Attacker:
    """An attack with its memory over B episodes."""

    def __init__(self, attack: Attack, seat: Seat, keys: Keys) -> None:
        self.attack, self.keys, self.plan = attack, keys, attack.prepare(seat.loop.brief)
        batch = len(keys.key)
        self.memory = attack.start(self.plan, batch, keys.at(Role.ATTACK, np.zeros(batch, np.int64)))

    def decide(self, view: View) -> Command:
        self.memory, command = self.attack.decide(self.plan, self.memory, view, self.keys.at(Role.ATTACK, view.k))
        return command


def steered(defence: str | Defence, menu: Menu) -> Steered:
    """Return the defence with its knobs in the defender's hands: from a registered name, or a steered defence."""
    if isinstance(defence, str):
        Spec("defence", defence).refuse_imports("duel")
        defence = Spec("defence", defence).make()
    if isinstance(defence, Steered):
        if menu != Menu(interval=menu.interval):
            raise InputError("menu", as_data(menu), "none: a steered defence has its own")
        if defence.policy is not None or defence.setting is not None:
            raise InputError("defence", as_data(defence), "a defence whose knobs are free: without a policy and a setting")
        return dataclasses.replace(defence, menu=dataclasses.replace(defence.menu, interval=menu.interval))
    if not all(hasattr(defence, name) for name in ("prepare", "start", "step")):
        raise InputError("defence", defence, "a registered name, or a steered defence")
    entry = entry_for("defence", type(defence))
    params = {key: value for key, value in as_data(defence).items() if key != "class"}
    cls = SteeredChallenge if "probe" in entry.uses else Steered
    return cls(defence={"name": entry.name, **params}, menu=menu)


@dataclass(frozen=True, eq=False)
class Duel:
    """The batched game; see `make` for the arguments."""

    seat: Seat
    guard: Steered
    payoff: Payoff
    action: Literal["menu", "box"] = "menu"

    @classmethod
    def make(
        cls, scenario: ScenarioLike | None = None, defence: str | Defence | None = None, menu: dict[str, Any] | Menu | None = None,
        defender_action: Literal["menu", "box"] = "menu", **arguments: Any,
    ) -> Duel:  # fmt: skip
        """Return a game.

        defence: the defence with the knobs. menu: their settings. defender_action: menu (a number) or box ([-1, 1] per knob).

        arguments: the fields of Payoff, and those of `Seat.make`; both players decide every `interval` steps.
        """
        if defender_action not in ("menu", "box"):
            raise unknown("defender_action", defender_action, ("menu", "box"))
        if menu is not None and not isinstance(menu, (dict, Menu)):
            raise InputError("menu", menu, "a mapping of knobs to settings")
        menu = menu if isinstance(menu, Menu) else build(Menu, dict(menu or {}), "menu")
        if menu.interval != Menu().interval:
            raise InputError("menu.interval", menu.interval, "the argument interval: both decide at the same time")
        interval = build(ActionSpec, {k: v for k, v in arguments.items() if k == "interval"}, "action").interval
        payoff = build(Payoff, {k: arguments.pop(k) for k in list(arguments) if k in fields_of(Payoff)}, "payoff")
        defence = FACES[CAR_FOLLOWING]["defence"] if defence is None else defence
        guard = steered(defence, dataclasses.replace(menu, interval=interval))
        return cls(Seat.make(scenario=scenario, defence=guard, **arguments), guard, payoff, defender_action)

    def card(self, **more: object) -> dict[str, Any]:
        """Return JSON data that names this game completely: the seat's card, the defender's side and additions, with a hash of all."""
        side = as_data({"payoff": self.payoff, "defender_action": self.action, **more})
        return {"seat": self.seat.card(), **side, "hash": digest({"seat": self.seat.config, **side})}

    @property
    def plan(self) -> SteeredPlan:
        plan: SteeredPlan = self.seat.loop.plan.defence
        return plan

    @property
    def settings(self) -> Array:
        """(S, K) the menu."""
        return self.plan.settings

    # -- playing

    def begin(self, keys: Keys) -> DuelState:
        return self._started(self.seat.loop.start(keys))

    def restart(self, state: DuelState, rows: Array) -> DuelState:
        """Return the next games of `rows` (B,) bool."""
        again = self._started(self.seat.loop.restart(state.loop, rows))
        held = np.flatnonzero(~rows)
        if not len(held):
            return again
        kept = DuelState(again.loop, Tally(*(leaf[held] for leaf in state.tally)), state.seen[held])
        return DuelState(again.loop, put_rows(again.tally, held, kept.tally), put_rows(again.seen, held, kept.seen))

    def _started(self, state: LoopState) -> DuelState:
        return DuelState(state, self.seat.begin(state), self.seat.observation.observe(self.seat.loop.sense(state)))

    def defender_sees(self, state: DuelState) -> Array:
        """Return the defender's observation (B, d) float32."""
        held: SteeredState = state.loop.defence
        return held.seen

    def mask(self, state: DuelState) -> Array:
        """Return (B, actions) bool: the attacker's discrete actions that the channel would accept in a step of the next decision."""
        return self.seat.action.mask(self.seat.loop.sense(state.loop))

    def step(
        self, state: DuelState, attack: Array | Attacker, defend: Array | None, over: Array
    ) -> tuple[DuelState, Outcome, Array, Frame]:
        """Play one decision of both; return state, outcome, the defender's reward and the last step.

        Rows that are `over` (B,) do not count.

        attack: actions as `Seat` takes them, or an attack that plays. defend: numbers of the menu (B,), or vectors (B, K); None leaves
        the knobs where they are.
        """
        loop = state.loop
        if defend is not None:
            loop = loop._replace(defence=self.guard.steer(self.plan, loop.defence, self.values(defend)))
        before, decision = loop, attack.decide if isinstance(attack, Attacker) else attack
        loop, tally, outcome, frame = self.seat.step(loop, state.tally, decision, over)
        seen = self.seat.observation.observe(self.seat.loop.sense(loop), state.seen)
        return DuelState(loop, tally, seen), outcome, self._paid(before, loop, outcome, over), frame

    def values(self, defend: Array) -> Array:
        """Return the knobs' values (B, K) of the defender's actions."""
        if self.action == "menu":
            return np.asarray(self.settings[np.asarray(defend, np.int64)])
        return np.stack([knob.at(np.asarray(defend, np.float64)[:, i]) for i, knob in enumerate(self.guard.hand.knobs)], axis=1)

    def _paid(self, before: LoopState, after: LoopState, outcome: Outcome, over: Array) -> Array:
        """Return the defender's reward (B,) of a decision."""
        if self.payoff.payoff == "zero_sum":
            return np.asarray(0.0 - outcome.reward)
        crashed = (outcome.collided | outcome.rear_collided).astype(np.float64)
        return np.where(over, 0.0, -crashed - self.care(before, after))

    def care(self, before: LoopState, after: LoopState) -> Array:
        """Return the costs (B,) of being careful in a decision, as `safety` counts them."""
        pay, dt, model = self.payoff, self.seat.loop.model.dt, self.seat.loop.model
        then, now = before.defence.memory, after.defence.memory
        quiet = after.channel.used == before.channel.used
        cost = pay.mode_cost * (now.asked - then.asked) + pay.alarm_cost * np.where(quiet, now.alarmed - then.alarmed, 0.0)
        if self.seat.road:  # the view at the end of the decision counts for the whole of it
            scene, cars = self.seat.loop.plant.scene(self.seat.loop.plan.plant, after.plant), np.flatnonzero(model.followers)
            wanted = self.seat.loop.controller.desired_gap(scene.speed[:, cars])
            wide = np.max(np.clip(scene.gap[:, cars] / np.maximum(wanted, 1.0) - 1.0, 0.0, 1.0), axis=1)
            cost = cost + pay.gap_cost * wide * (after.k - before.k)
        return np.asarray(dt * cost)

    # -- spaces

    def defender_spaces(self) -> tuple[Any, Any]:
        """Return Gymnasium's spaces of one defender: its observation and its action."""
        sight = gymnasium.spaces.Box(-LIMIT, LIMIT, (len(self.plan.sight.names),), np.float32)
        if self.action == "menu":
            return sight, gymnasium.spaces.Discrete(len(self.settings))
        return sight, gymnasium.spaces.Box(-1.0, 1.0, (len(self.guard.hand.knobs),), np.float32)

    def told(self, state: DuelState) -> dict[str, Any]:
        """Return the defender's information about the first row: the step, and the values of its knobs."""
        knobs = {knob.name: state.loop.defence.knobs[0, i] for i, knob in enumerate(self.guard.hand.knobs)}
        return {"step": state.loop.k[0], **knobs}


def checked(space: gymnasium.Space[Any], action: ArrayLike, who: str) -> Array:
    """Return one row's action as a batch of one. Raise InputError for one outside of its space."""
    given = np.asarray(action)
    fits = given.shape == space.shape
    if fits and isinstance(space, gymnasium.spaces.Discrete):
        fits = given.dtype.kind in "iu" and 0 <= int(given) < space.n
    elif fits:
        fits = in_box(given)
    if not fits:
        raise InputError(f"actions.{who}", action, f"an action of {space}")
    return given[None]


def next_game(duel: Duel, held: DuelState | None, seed: int | None, rng: Generator) -> DuelState:
    """Return a batch of one: the game of `seed`, or without one the next of the episodes that were running."""
    if held is not None and seed is None:
        return duel.restart(held, np.ones(1, bool))
    return duel.begin(draws.keys("train", [int(rng.integers(2**31)) if seed is None else int(seed)]))


class DefenderEnv(Specified, gymnasium.Env[Array, Any]):
    """An environment in which the agent is the defender, against given attacks: an action sets the knobs for `interval` steps.

    attack: one as on the command line, an object, or a list of them, of which each episode draws one. Other arguments: see `Duel.make`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - Gymnasium's own annotation

    def __init__(self, *, attack: Any = "fdi", **arguments: Any) -> None:
        some = [attack] if isinstance(attack, str) or not isinstance(attack, (list, tuple)) else list(attack)
        if not some:
            raise InputError("attack", attack, "at least one attack")
        made = [Spec("attack", held).make() if isinstance(held, str) else held for held in some]
        if not all(callable(getattr(player, name, None)) for player in made for name in ("prepare", "start", "decide")):
            raise InputError("attack", attack, "a registered name, a policy's file, or an object with prepare, start and decide")
        known = [getattr(player, "knowledge", entry_for("attack", type(player)).knowledge) for player in made]
        arguments.setdefault("knowledge", max(known, key=KNOWLEDGE.index))
        self.duel = Duel.make(**arguments)
        self.attack: Attack = made[0] if len(made) == 1 else Mixture(tuple(made))
        self.attack.prepare(self.duel.seat.loop.brief)  # fail here, not in the first step
        self.observation_space, self.action_space = self.duel.defender_spaces()
        self.horizon = self.duel.seat.decisions
        self.state: DuelState | None = None
        self.attacker: Attacker | None = None
        self.over = np.zeros(1, bool)

    def __repr__(self) -> str:
        return shown(self, self.spec, self.duel.seat)

    def card(self) -> dict[str, Any]:
        """Return JSON data that names this environment completely, its attacks among them, with a hash."""
        return self.duel.card(attack=self.attack)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        check_options(options)
        super().reset(seed=seed)
        self.state = next_game(self.duel, self.state, seed, self.np_random)
        self.attacker, self.over = Attacker(self.attack, self.duel.seat, self.state.loop.keys), np.zeros(1, bool)
        return self.duel.defender_sees(self.state)[0].copy(), self.duel.told(self.state)

    def step(self, action: ArrayLike) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        if self.state is None or self.attacker is None or self.over.any():
            raise InputError("step", "no episode", "reset() first")
        self.state, outcome, paid, _ = self.duel.step(self.state, self.attacker, checked(self.action_space, action, "defender"), self.over)
        self.over = outcome.terminated | outcome.truncated
        seen = self.duel.defender_sees(self.state)[0].copy()
        return seen, float(paid[0]), bool(outcome.terminated[0]), bool(outcome.truncated[0]), self.duel.told(self.state)


gymnasium.register(id=DEFENDER, entry_point="tailgate.envs.gym.duel:DefenderEnv", order_enforce=True)
