"""A defence whose knobs are turned while it runs: by a trained policy, by a fixed hand, or from outside (docs/two-players.md).

A trained defender is a small tanh perceptron over `Sight`. Its largest output names the setting of the knobs for the next `interval`
steps. It is a JSON file and a safetensors file; loading them executes nothing. Played through `steered` it is a defence like
any other: every evaluation, learner and page takes it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable, unknown
from tailgate.core import Array, Count, Estimate, Model, PositiveCount, Prior, Received, param
from tailgate.core.draws import Draws
from tailgate.core.neural import Network, layers_of, perceptron, read_trained, write_trained
from tailgate.core.registry import entries, entry_for, register
from tailgate.core.schema import as_data, build
from tailgate.estimators.challenge.steering import Hand, HandPlan, HandState, Memory, Menu, Sight, settings
from tailgate.estimators.compose import Look

FORMAT = "tailgate-defender-1"
SETTINGS = 1024  # that a menu has in all, at most
TAG = 255  # tag of the draw that picks a policy: the steered defence draws with others
POLICY = "JSON file of a trained defender, or several, of which each episode draws one; none: a fixed setting"


@dataclass(frozen=True)
class Header:
    """The JSON file of a trained defender."""

    format: Literal["tailgate-defender-1"]
    tensors: str
    sha256: str
    layers: PositiveCount
    defence: dict[str, Any]
    menu: Menu
    observation: tuple[str, ...]
    training: dict[str, Any] = dataclasses.field(default_factory=dict)


def save_defender(path: Path, network: Network, header: dict[str, Any]) -> Path:
    """Write PATH.safetensors and PATH.json; `header` holds the other fields of `Header`: defence, menu, observation, training."""
    menu = {key: value for key, value in as_data(header["menu"]).items() if key != "class"}
    tensors = layers_of(network.weights, network.biases)
    return write_trained(path, FORMAT, tensors, len(network.weights), as_data(header) | {"menu": menu})


def load_defender(path: Path) -> tuple[Header, Network]:
    """Read a trained defender; raises InputError when a file is missing, damaged, or does not fit its header."""
    where = f"defender {path.name}"
    header, tensors = read_trained(Header, FORMAT, path, "steered.policy", where)
    return header, Network(*perceptron(tensors, header.layers, len(header.observation), where))


class SteeredPlan(NamedTuple):
    hand: Hand
    inner: HandPlan
    sight: Sight
    settings: Array  # (S, K) the menu
    start: Array  # (K,) where the knobs stand first
    networks: tuple[Network, ...]


class SteeredState(NamedTuple):
    """Every leaf has B first."""

    inner: HandState
    knobs: Array  # (B, K) where they stand
    k: Array  # (B,) int64: steps done
    member: Array  # (B,) int64: whose policy turns them; -1 before the first step
    memory: Memory
    seen: Array  # (B, d) float32: what was seen in the last step


def _imports(data: object) -> bool:
    """Return True if any text in the data names a class to import."""
    if isinstance(data, (dict, list, tuple)):
        return any(_imports(value) for value in (data.values() if isinstance(data, dict) else data))
    return isinstance(data, str) and ":" in data


@register("defence", "steered", uses=("measurements", "v2v"), reference="docs/two-players.md")
@dataclass(frozen=True, kw_only=True)
class Steered:
    """A filter with a detector whose threshold and reaction are set again every few steps, by a trained policy or by hand."""

    uses: ClassVar[tuple[str, ...]] = ("measurements", "v2v")

    defence: object = param("chi2_kf", "defence whose knobs are turned: a registered name, or a mapping with name and parameters")
    menu: Menu = param(Menu(), "settings of the knobs")
    setting: Count | None = param(None, "number of the menu's combination that is held throughout; none: the defence's own values")
    policy: Path | tuple[Path, ...] | None = param(None, f"{POLICY}. It brings its own defence and menu")

    def __post_init__(self) -> None:
        if self.policy is not None and self.setting is not None:
            raise InputError("defence steered.setting", self.setting, "none: the policy sets the knobs")
        _ = self.hand  # a wrong name shall fail here

    @property
    def paths(self) -> tuple[Path, ...]:
        return () if self.policy is None else (self.policy,) if isinstance(self.policy, Path) else self.policy

    @cached_property
    def _loaded(self) -> list[tuple[Header, Network]]:
        return [load_defender(path) for path in self.paths]

    @cached_property
    def menu_used(self) -> Menu:
        """The menu: that of the policies, where there are any."""
        if not self._loaded:
            return self.menu
        first = self._loaded[0][0]
        for path, (header, _) in zip(self.paths, self._loaded, strict=True):
            if (header.menu, header.defence, header.observation) != (first.menu, first.defence, first.observation):
                raise InputError("defence steered.policy", path.name, f"a policy for the defence and menu of {self.paths[0].name}")
        return first.menu

    @cached_property
    def inner_defence(self) -> Any:
        """The defence whose knobs are turned."""
        data, where = (self._loaded[0][0].defence, f"defender {self.paths[0].name}") if self._loaded else (self.defence, "defence steered")
        where = f"{where}.defence"
        params = dict(data) if isinstance(data, dict) else {"name": data}
        name = params.pop("name", type(self).__dataclass_fields__["defence"].default)
        if not isinstance(name, str) or _imports(data):  # a configuration or a policy from elsewhere shall not run code
            raise InputError(where, data, "registered names")
        known = entries("defence")
        if name not in known:
            raise unknown(where, name, known)
        entry = known[name]
        if issubclass(entry.cls, Steered) or not set(entry.uses) <= {*self.uses}:  # before it is made: a policy may name itself
            wanted = f"a defence that uses nothing but {', '.join(self.uses)}, and is not steered itself"
            raise NotApplicable(where, name, f"{wanted}; a challenge-response defence: steered_cra")
        return build(entry.cls, params, f"{where} {name}")

    @cached_property
    def hand(self) -> Hand:
        """The defence with its knobs."""
        hand = Hand.on(self.inner_defence, self.menu_used)
        count = math.prod(len(knob.levels) for knob in hand.knobs)
        if count > SETTINGS:
            where = f"defender {self.paths[0].name}" if self._loaded else "defence steered"
            raise InputError(f"{where}.menu", f"{count} combinations of settings", f"at most {SETTINGS}")
        return hand

    @property
    def described(self) -> dict[str, Any]:
        """The defence whose knobs are turned, as a mapping with name and parameters."""
        params = {key: value for key, value in as_data(self.inner_defence).items() if key != "class"}
        return {"name": entry_for("defence", type(self.inner_defence)).name, **params}

    def prepare(self, model: Model) -> SteeredPlan:
        hand = self.hand
        menu, sight = settings(hand.knobs), Sight(model, hand.knobs, "v2v" in self.uses)
        start = hand.own
        if self.setting is not None:
            if self.setting >= len(menu):
                raise InputError("defence steered.setting", self.setting, f"a number from 0 to {len(menu) - 1}")
            start = menu[self.setting]
        for path, (header, network) in zip(self.paths, self._loaded, strict=True):
            if header.observation != sight.names:
                differing = sorted(set(header.observation) ^ set(sight.names)) or ["in another order"]
                raise InputError(f"defender {path.name}", f"observation {', '.join(differing)}", "this defence's own observation")
            if network.weights[-1].shape[1] != len(menu):
                raise InputError(f"defender {path.name}", f"{network.weights[-1].shape[1]} settings", f"{len(menu)}, as its menu has")
        return SteeredPlan(hand, hand.prepare(model), sight, menu, start, tuple(network for _, network in self._loaded))

    def start(self, plan: SteeredPlan, prior: Prior) -> SteeredState:
        batch = len(prior.mean)
        knobs = np.repeat(plan.start[None], batch, axis=0)
        inner = plan.hand.start(plan.inner, prior)
        k = np.zeros(batch, np.int64)
        return SteeredState(inner, knobs, k, k - 1, plan.sight.begin(batch), plan.sight.blank(knobs))

    def step(
        self, plan: SteeredPlan, state: SteeredState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[SteeredState, Estimate]:
        if plan.networks:
            state = self._consider(plan, state, draws)
        inner, estimate = plan.hand.step(plan.inner, state.inner, state.knobs, received, known_u, draws)
        memory, seen = plan.sight.look(state.memory, estimate, received, inner, state.knobs)
        return SteeredState(inner, state.knobs, state.k + 1, state.member, memory, seen), estimate

    def look(self, plan: SteeredPlan, state: SteeredState, received: Received, known_u: Array) -> Look:
        """Return what the defence would see of a measurement, with its knobs at their present values."""
        if plan.networks and (state.member >= 0).all():
            state = self._chosen(plan, state)
        defence, inner = plan.hand.turned(plan.inner, state.knobs)
        out: Look = defence.look(inner, state.inner, received, known_u)  # type: ignore[attr-defined]
        return out

    def steer(self, plan: SteeredPlan, state: SteeredState, values: Array) -> SteeredState:
        """Return the state with the knobs at `values` (B, K)."""
        return state._replace(knobs=np.array(values, np.float64))

    def _consider(self, plan: SteeredPlan, state: SteeredState, draws: Draws) -> SteeredState:
        new = state.member < 0
        if num.some(new):
            some = len(plan.networks)
            drawn = (draws.uniform((), TAG) * some).astype(np.int64) if some > 1 else np.zeros(len(new), np.int64)
            state = state._replace(member=np.where(new, np.minimum(drawn, some - 1), state.member))
        return self._chosen(plan, state)

    def _chosen(self, plan: SteeredPlan, state: SteeredState) -> SteeredState:
        """Return the state with the knobs after a decision, in the rows where one is due."""
        due = state.k % self.menu_used.interval == 0
        if not num.some(due):
            return state
        chosen = np.zeros(len(due), np.int64)
        for i, network in enumerate(plan.networks):
            mine = np.flatnonzero(state.member == i)
            if len(mine):
                chosen[mine] = np.argmax(network(state.seen[mine]), axis=1)
        return state._replace(knobs=np.where(due[:, None], plan.settings[chosen], state.knobs))


@register("defence", "steered_cra", uses=("measurements", "odometry", "probe"), reference="docs/two-players.md")
@dataclass(frozen=True, kw_only=True)
class SteeredChallenge(Steered):
    """Challenge-response authentication whose challenges and reaction are set again every few steps, by a trained policy or by hand."""

    uses: ClassVar[tuple[str, ...]] = ("measurements", "odometry", "probe")

    defence: object = param("cra", "defence whose knobs are turned: a registered name, or a mapping with name and parameters")
