"""The attacker's decision process: the loop with the attack left open, from checked arguments. Environments, learners and games use it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from tailgate.base import sizes
from tailgate.base.errors import InputError, UnknownArgument, unknown
from tailgate.core import Array, Command, Defence, Frame, Kind, View
from tailgate.core.loop import Loop, LoopState
from tailgate.core.registry import Spec
from tailgate.core.scenario import ScenarioLike, load_scenario
from tailgate.core.schema import as_data, build, digest, fields_of
from tailgate.core.threat import ThreatModel
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.observations import FRAMES, ObservationCodec
from tailgate.envs.gym.rewards import NEAR, Paying, Payment, Reward

CAR_FOLLOWING = "tailgate/CarFollowing-v0"
FACES: dict[str, dict[str, Any]] = {  # defaults of each id
    CAR_FOLLOWING: {"scenario": "stop-and-go-v0", "defence": "chi2_kf"},
    "tailgate/RadarFollowing-v0": {"scenario": "radar-following-v0", "defence": "cra"},
    "tailgate/Platoon-v0": {"scenario": "platoon-braking-v0", "defence": "lasso_dkf"},
    "tailgate/SensorNetwork-v0": {"scenario": "thesis-ch5-v0", "defence": "norm_resilient", "reward": "error"},
    "tailgate/LaneKeeping-v0": {"scenario": "lane-keeping-v0", "defence": "chi2_kf", "value": 0.5},
    "tailgate/Highway-v0": {"scenario": "highway-v0", "defence": "chi2_kf"},
}
OTHERS = (  # arguments of environments that are no options of actions and rewards
    "scenario", "defence", "threat", "knowledge", "frames", "engine", "render_mode", "viewer", "size", "max_episode_steps", "device",
    "threads", "autoreset", "autoreset_mode",
)  # fmt: skip
AUTORESET = "autoreset", "autoreset_mode"  # the second is Gymnasium's word
RETURN = {"gap_shaping", "error_shaping", "horizon_ends"}  # options that go with a reward that is given as an object, too
_LEARN: dict[str, Any] = {"error_shaping": 0.0, "gap_shaping": 0.0}
FACES |= {  # tasks that are worth learning: a budget, decisions that last, no shaping
    "tailgate/CarFollowing-v1": _LEARN | {
        "scenario": "gusty-stop-and-go-v0", "defence": "chi2_kf", "value": -3.0, "interval": 20,
        "threat": {"kinds": ["fdi"], "fdi_bound": 3.0, "budget": 60},
    },
    "tailgate/RadarFollowing-v1": _LEARN | {
        "scenario": "radar-braking-v0", "defence": "chi2_kf", "delay": 60.0, "shares": [0.1], "interval": 5,
        "threat": {"kinds": ["echo_delay"], "delay_bound": 60.0, "budget": 15},
    },
    "tailgate/Platoon-v1": _LEARN | {
        "scenario": "platoon-braking-v0", "defence": "lasso_dkf", "value": 5.0, "interval": 40,
        "threat": {"kinds": ["dos_hold", "fdi"], "targets": ["distance", "velocity"], "fdi_bound": 5.0, "budget": 80},
    },
    "tailgate/SensorNetwork-v1": _LEARN | {
        "scenario": "thesis-ch5-v0", "defence": "trust_dkf", "reward": "error", "interval": 5, "threat": {"budget": 20},
    },
    "tailgate/LaneKeeping-v1": _LEARN | {
        "scenario": "lane-keeping-v0", "defence": "chi2_kf", "value": 0.5, "interval": 20, "threat": {"budget": 60},
    },
}  # fmt: skip
for _name in ("CarFollowing", "RadarFollowing", "Platoon"):
    _face = {key: value for key, value in FACES[f"tailgate/{_name}-v1"].items() if key != "shares"}  # a vector has every size
    FACES[f"tailgate/{_name}Continuous-v1"] = _face | {"action": "continuous"}


def without_autoreset(arguments: dict[str, Any], expected: str) -> dict[str, Any]:
    """Return the arguments of an environment that resets in one way only; raise InputError if they name a mode."""
    for name in AUTORESET:
        if name in arguments:
            raise InputError(name, arguments[name], expected)
    return arguments


class Tally(NamedTuple):
    """The reward's memory of each episode, (B,) each."""

    potential: Array  # shaping potential
    least: Array  # smallest gap so far, within the reward's reach [m]
    error: Array  # largest error of an agent, where there is no road
    peak: Array  # the largest of the episode so far, where the reward is for that
    crashed: Array  # bool: there was a collision, where none ends an episode


class Sums(NamedTuple):
    """Sums over the steps of a decision, (B,) each."""

    raw: Array  # reward of the steps
    begun: Array  # the potential before the decision
    collided: Array
    rear_collided: Array
    refused: Array  # a command was, in a step that counts
    accepted: Array


class Outcome(NamedTuple):
    """The result of a decision of the attacker, (B,) each; zero for rows that were over before it."""

    reward: Array
    collided: Array
    rear_collided: Array
    illegal: Array  # a command was refused, and in no step of the decision one was accepted
    terminated: Array  # a collision ended the episode, or the horizon where it `horizon_ends`
    truncated: Array  # the horizon cut it off


def _reward(options: dict[str, Any]) -> Reward:
    """Return the reward from its options; or the object given in their place, with the options of RETURN: ids of `-v1` set the shaping."""
    own = options.get("reward")
    if isinstance(own, Payment):
        rest = build(Reward, {key: value for key, value in options.items() if key != "reward"}, "reward")
        return Paying(**{name: getattr(rest, name) for name in fields_of(Reward) if name != "reward"}, paid=own)
    if own is None or isinstance(own, str):
        return build(Reward, options, "reward")
    if not isinstance(own, Reward):
        raise InputError("reward", own, "a name (tailgate list rewards), or an object of a subclass of Payment or Reward")
    for key in options.keys() - {"reward"} - RETURN:
        raise InputError(key, options[key], f"no such option: {type(own).__name__}, the reward given as an object, holds it")
    changed = {key: value for key, value in options.items() if key in RETURN}
    return dataclasses.replace(own, **changed) if changed else own


@dataclasses.dataclass(frozen=True, eq=False)
class Seat:
    """An adversary environment apart from its episodes: loop, codecs and reward, from checked arguments."""

    loop: Loop
    action: ActionCodec
    observation: ObservationCodec
    reward: Reward
    config: dict[str, Any]

    @property
    def memory(self) -> float:
        """Bytes that an environment of a batch takes, about: the filter's matrices, what it shows, and the rest."""
        model = self.loop.model
        return sizes.ENVIRONMENT + 8 * model.agents * model.states**2 * 4 + 8 * len(self.observation.names)

    @classmethod
    def make(
        cls, scenario: ScenarioLike | None = None, defence: str | Defence | None = None, threat: dict[str, Any] | None = None,
        **options: Any,
    ) -> Seat:  # fmt: skip
        """Return the environment's core.

        scenario: as `load_scenario` takes it. defence: name (`chi2_kf:eta=15`) or object. threat: changes of the scenario's threat model.

        options: the fields of ActionSpec and Reward, `knowledge`, and `frames`: how many decisions the observation shows at once. Scenario
        and defence default to those of car following. `reward` may be an object of a subclass of Reward.
        """
        scenario = FACES[CAR_FOLLOWING]["scenario"] if scenario is None else scenario
        defence = FACES[CAR_FOLLOWING]["defence"] if defence is None else defence
        if threat is not None and not isinstance(threat, dict):
            raise InputError("threat", threat, "a mapping of changes of the threat model")
        threat = dict(threat or {})
        if "knowledge" in options:
            threat["knowledge"] = options.pop("knowledge")
        frames = options.pop("frames", 1)
        if not isinstance(frames, int) or isinstance(frames, bool) or not 1 <= frames <= FRAMES:
            raise InputError("frames", frames, f"a whole number from 1 to {FRAMES}")
        known = fields_of(ActionSpec) | fields_of(Reward)
        for key in options:
            if key not in known:
                hint = f"threat={{{key!r}: {options[key]!r}}}, or " if key in fields_of(ThreatModel) else ""
                raise UnknownArgument(key, [*known, *OTHERS], hint)
        for key in threat:
            if key not in fields_of(ThreatModel):
                raise unknown("threat: unknown field", key, fields_of(ThreatModel))
        action = build(ActionSpec, {k: v for k, v in options.items() if k in fields_of(ActionSpec)}, "action")
        reward = _reward({k: v for k, v in options.items() if k in fields_of(Reward)})
        place = load_scenario(scenario).with_threat(**threat)
        if isinstance(defence, str):
            spec = Spec("defence", defence)
            built = spec.make()
            uses, named = spec.entry.uses, {"spec": defence, "parameters": as_data(built)}
        else:
            if not all(hasattr(defence, name) for name in ("prepare", "start", "step")):
                raise InputError("defence", defence, "a registered name, or an object with prepare, start and step")
            built, uses = defence, tuple(getattr(defence, "uses", ("measurements",)))
            named = {"spec": type(defence).__name__, "parameters": as_data(defence)}
        loop = place.loop(built, uses)
        reward.check(loop.model)
        config = {"scenario": as_data(place), "defence": named, "action": as_data(action), "reward": as_data(reward)}
        if frames > 1:  # cards from before there were several stay what they are
            config["frames"] = frames
        return cls(loop, ActionCodec(action, loop.brief), ObservationCodec(loop.brief, frames), reward, config)

    def card(self, limit: int | None = None) -> dict[str, Any]:
        """Return the whole configuration with its hash, which papers and rows cite. limit: decisions after which a wrapper truncates."""
        from tailgate.base.version import VERSION

        features, actions = list(self.observation.names), [mode.name for mode in self.action.modes] if self.action.discrete else None
        config = self.config | ({} if limit is None else {"max_episode_steps": limit})
        card = config | {"observation": features, "actions": actions, "version": VERSION, "hash": digest(config)}
        return json.loads(json.dumps(card))  # type: ignore[no-any-return]

    # -- playing

    @property
    def road(self) -> bool:
        """True if somebody drives here, and can collide."""
        return bool(self.loop.model.followers.any())

    @property
    def decisions(self) -> int:
        """Decisions of an episode that nothing ends early."""
        return -(-self.loop.horizon // self.action.spec.interval)

    def begin(self, state: LoopState) -> Tally:
        """Return the reward's memory of episodes that have just begun."""
        gap = self._room(self.loop.plant.scene(self.loop.plan.plant, state.plant).gap)
        none = np.zeros(len(gap))
        return Tally(self.reward.potential(gap), self.reward.least(gap), none, none, np.zeros(len(gap), bool))

    def _room(self, gap: Array) -> Array:
        """Return the gap (B, N) [m] that the reward is for: in a lane, half of its width counts as NEAR."""
        lane = self.loop.model.lane
        return gap * (NEAR / lane) if lane else gap

    def _believed(self, frame: Frame) -> Array:
        """Return by how much each agent overestimates that gap (B, N) [m]."""
        model, x, truth = self.loop.model, frame.estimate.x, frame.truth
        if not model.lane:
            return model.gap_error(x, truth)
        return self._room(np.abs(model.gap_error(truth, np.zeros_like(truth))) - np.abs(model.gap_error(x, np.zeros_like(truth))))

    def step(
        self, state: LoopState, tally: Tally, action: Array | Callable[[View], Command], over: Array
    ) -> tuple[LoopState, Tally, Outcome, Frame]:
        """Play one decision, `interval` steps of the loop; also return its last step. Rows that are `over` (B,) do not count.

        action: as `ActionCodec.decode` takes it, or a function that decides in every step.
        """
        sums = self.opened(tally)
        for _ in range(self.action.spec.interval):
            state, tally, sums, frame = self.advanced(state, tally, sums, action, over)
        return state, tally, self.closed(state, tally, sums, over), frame

    def opened(self, tally: Tally) -> Sums:
        """Return the sums before the first step of a decision."""
        no = np.zeros(len(tally.potential), bool)
        return Sums(np.zeros(len(no)), tally.potential, no, no, no, no)

    def advanced(
        self, state: LoopState, tally: Tally, sums: Sums, action: Array | Callable[[View], Command], over: Array
    ) -> tuple[LoopState, Tally, Sums, Frame]:
        """Play one step of a decision."""
        loop, reward = self.loop, self.reward
        live = ~over & ~state.ended & (state.k <= loop.horizon)
        view = loop.sense(state)
        state, frame = loop.advance(state, action(view) if callable(action) else self.action.decode(action, view))
        gap = self._room(frame.scene.gap)
        least, peak, largest = reward.least(gap, tally.least), tally.peak, tally.error
        if reward.payment.peak:
            peak = np.maximum(np.max(loop.model.error(frame.estimate.x, frame.truth), axis=1), peak)
        first, crashed = frame, tally.crashed
        if not loop.ends_on_collision:  # else there is no second collision
            first = frame._replace(collided=frame.collided & ~crashed, rear_collided=frame.rear_collided & ~crashed)
            crashed = crashed | frame.collided | frame.rear_collided
        gained = reward(loop.model, first, tally.least - least, frame.k == loop.horizon, peak - tally.peak)
        potential = np.where(live, reward.potential(gap, self._believed(frame)), tally.potential)
        if not self.road:
            largest = np.where(live, np.max(loop.model.error(frame.estimate.x, frame.truth), axis=1), largest)
        sums = Sums(
            sums.raw + np.where(live, gained, 0.0), sums.begun, sums.collided | (frame.collided & live),
            sums.rear_collided | (frame.rear_collided & live), sums.refused | (frame.refused & live),
            sums.accepted | (frame.command.kind != Kind.NONE),  # also behind a collision, which no mask foresees
        )  # fmt: skip
        return state, Tally(potential, least, largest, peak, crashed), sums, frame

    def closed(self, state: LoopState, tally: Tally, sums: Sums, over: Array) -> Outcome:
        """Return the outcome of a decision, after its last step."""
        illegal = sums.refused & ~sums.accepted
        late = state.k > self.loop.horizon
        ended = state.ended | late if self.reward.horizon_ends else state.ended
        terminated, truncated = ended & ~over, late & ~ended & ~over
        gained = np.where(over, 0.0, self.reward.decided(sums.raw, illegal, sums.begun, tally.potential, terminated))
        return Outcome(gained, sums.collided, sums.rear_collided, illegal, terminated, truncated)
