"""A learned policy as an attack: safetensors + JSON, played without torch, Stable-Baselines3 or pickle.

The network is a tanh perceptron in float64 with a fixed order of summation, so that a trace does not depend on the batch. An LSTM, which
remembers the episode, may come before it. The JSON file names the tensor file, its SHA-256, the action and observation codecs, and how
the policy was made.
"""

from __future__ import annotations

import dataclasses
import json
import shlex
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from tailgate import num
from tailgate.agents.policy.granted import remedy
from tailgate.base.errors import InputError
from tailgate.core import Array, Command, PositiveCount, View, param
from tailgate.core.draws import Draws, Role
from tailgate.core.neural import Lstm, Memory, Network, layers_of, pair, perceptron, read_trained, write_trained
from tailgate.core.registry import register
from tailgate.core.schema import as_data
from tailgate.core.threat import Brief, Knowledge
from tailgate.envs.gym.actions import ActionCodec, ActionSpec
from tailgate.envs.gym.observations import FRAMES, ObservationCodec

FORMAT = "tailgate-policy-1"
SOME = 8  # names in an error, at most
LONGEST = 500  # characters of options in an error, at most


@dataclass(frozen=True, kw_only=True)
class Seen:
    """The part of a policy's file that says what it sees, what it may do, and how it was made."""

    action: ActionSpec
    observation: tuple[str, ...]
    knowledge: Knowledge
    sees_measurement: bool = False
    frames: PositiveCount = 1
    agents: PositiveCount | None = None  # agents of the system that it was trained on; older files have none
    training: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Header(Seen):
    """The JSON file of a network."""

    format: Literal["tailgate-policy-1"]
    tensors: str
    sha256: str
    layers: PositiveCount
    squashed: bool = False  # the outputs go through tanh
    masked: bool = False  # chooses among the actions that the channel would accept
    recurrent: bool = False  # an LSTM comes before the perceptron
    greedy: bool = False  # its outputs are no distribution that actions could be drawn from


def choose(
    network: Network, codec: ActionCodec, observation: Array, draws: Draws | None = None, always: bool = False, mask: Array | None = None
) -> Array:
    """Return actions (B,) or (B, size): the likeliest, or drawn when `draws` is given. With `always`, the best one that attacks.

    observation: what the perceptron reads, the hidden state of a network with an LSTM. mask (B, size) bool: the discrete actions that are
    to be chosen from; `always` has none, as all attacks are allowed or none is.
    """
    out = network(observation)
    if codec.discrete:
        if draws is not None:
            out = out - num.log(-num.log(np.ascontiguousarray(draws.uniform((out.shape[1],)))))
        if always:
            return np.asarray(1 + np.argmax(out[:, 1:], axis=1))
        return np.asarray(np.argmax(out if mask is None else np.where(mask, out, -np.inf), axis=1))
    if draws is not None and network.log_std is not None:
        out = out + num.exp(network.log_std) * draws.normal((out.shape[1],))
    if always:
        out = np.concatenate([np.maximum(out[:, :1], 1e-9), out[:, 1:]], axis=1)  # the nearest trigger that attacks
    return np.clip(out, -1.0, 1.0)


def save_policy(path: Path, network: Network, header: dict[str, Any]) -> Path:
    """Write PATH.safetensors and PATH.json; `header` holds the other fields of `Header`: action, observation, knowledge and so on."""
    tensors = layers_of(network.weights, network.biases)
    if network.log_std is not None:
        tensors["log_std"] = network.log_std
    kind: dict[str, Any] = {"squashed": True} if network.squashed else {}
    if network.lstm is not None:
        tensors |= {"lstm.weight": network.lstm.weight, "lstm.bias": network.lstm.bias}
        kind["recurrent"] = True
    return write_trained(path, FORMAT, tensors, len(network.weights), kind | as_data(header))


def load_policy(path: Path) -> tuple[Header, Network]:
    """Return a policy from its files; raise InputError when one is missing, damaged, or does not fit its header."""
    where = f"policy {path.name}"
    header, tensors = read_trained(Header, FORMAT, path, "policy", where)
    if header.frames > FRAMES:
        raise InputError(f"{where}.frames", header.frames, f"at most {FRAMES}")
    width, lstm = len(header.observation), None
    if header.recurrent:
        fits = f"{width} + width, 4 width"
        lstm = Lstm(*pair(tensors, "lstm", where, fits, lambda w: w.shape[1] > 0 and w.shape[1] == 4 * (w.shape[0] - width)))
    weights, biases = perceptron(tensors, header.layers, width if lstm is None else lstm.size, where)
    log_std, outputs = tensors.get("log_std"), len(biases[-1])
    if log_std is not None:
        if log_std.shape != (outputs,) or log_std.dtype.kind != "f" or not np.isfinite(log_std).all():
            raise InputError(f"{where}: log_std", log_std.shape, f"finite, ({outputs},)")
        log_std = log_std.astype(np.float64)
    return header, Network(weights, biases, log_std, lstm, header.squashed)


class PolicyState(NamedTuple):
    action: Array  # (B,) or (B, size): the decision that holds
    seen: Array  # (B, d) the observation that it was taken on
    memory: Memory | None = None  # memory of an LSTM after that observation


class PolicyPlan(NamedTuple):
    network: Network
    action: ActionCodec
    observation: ObservationCodec
    masked: bool = False


@register("attack", "policy")
@dataclass(frozen=True)
class PolicyAttack:
    """A learned policy from a JSON + safetensors file."""

    learned: ClassVar[bool] = True
    path: Path = param(Path("policy.json"), "the JSON file of an exported policy")
    stochastic: bool = param(False, "draw actions from the policy instead of taking the likeliest")

    @cached_property
    def _loaded(self) -> tuple[Header, Network]:
        return load_policy(self.path)

    @property
    def knowledge(self) -> str:
        """The knowledge that the policy was trained with."""
        return self._loaded[0].knowledge

    @property
    def sees_measurement(self) -> bool:
        return self._loaded[0].sees_measurement

    @property
    def action(self) -> ActionSpec:
        """The decisions that it takes."""
        return self._loaded[0].action

    def prepare(self, brief: Brief) -> PolicyPlan:
        header, network = self._loaded
        brief, agents = _learned_under(header, brief), brief.model.agents
        if (1 if header.agents is None else header.agents) != agents:
            made = f"a policy for {_count(header.agents or 1)}"
            raise InputError(f"policy {self.path.name}", made, f"one for this scenario's {_count(agents)}")
        try:
            action, observation = ActionCodec(header.action, brief), ObservationCodec(brief, header.frames)
        except InputError as error:
            hint = _trained_with(header) + remedy(header.training, brief.threat)
            raise InputError(f"policy {self.path.name}: {error.field}", error.value, error.expected + hint) from None
        if observation.names != header.observation:
            differing = sorted(set(header.observation) ^ set(observation.names)) or ["in another order"]
            shown = ", ".join(differing[:SOME]) + (f" and {len(differing) - SOME} more" if len(differing) > SOME else "")
            wanted = f"the observation of this scenario and threat model{_trained_with(header)}"
            raise InputError(f"policy {self.path.name}", f"observation {shown}", wanted)
        outputs = network.outputs
        if outputs != action.size:
            names, what = (f" ({', '.join(mode.name for mode in action.modes)})", "actions") if action.discrete else ("", "outputs")
            wanted = f"{action.size}, as environment.action={header.action.action} has under this threat model{names}"
            raise InputError(f"policy {self.path.name}", f"{outputs} {what}", wanted + _trained_with(header))
        if (header.masked and not action.discrete) or (header.squashed and action.discrete):
            made = "masked" if header.masked else "squashed"
            raise InputError(f"policy {self.path.name}.{made}", True, f"another kind of action than {header.action.action}")
        if self.stochastic and header.greedy:
            raise InputError("policy.stochastic", True, f"false: the outputs of {self.path.name} are no distribution to draw actions from")
        return PolicyPlan(network, action, observation, header.masked)

    def start(self, plan: PolicyPlan, batch: int, draws: Draws) -> PolicyState:
        action = np.zeros(batch, np.int64) if plan.action.discrete else np.zeros((batch, plan.action.size))
        memory = None if plan.network.lstm is None else plan.network.lstm.blank(batch)
        return PolicyState(action, np.zeros((batch, len(plan.observation.names)), np.float32), memory)

    def decide(self, plan: PolicyPlan, state: PolicyState, view: View, draws: Draws) -> tuple[PolicyState, Command]:
        state = self.consider(plan, state, view, draws)
        return state, plan.action.decode(state.action, view)

    def consider(self, plan: PolicyPlan, state: PolicyState, view: View, draws: Draws, always: bool = False) -> PolicyState:
        """Take a new decision in the rows where one is due; the others hold theirs."""
        due = (view.k - 1) % plan.action.spec.interval == 0
        if not num.some(due):
            return state
        chance = policy_draws(draws) if self.stochastic else None
        first = (view.k == 1)[:, None]
        seen = plan.observation.observe(view, state.seen)
        if plan.observation.frames > 1 and num.some(first):
            seen = np.where(first, plan.observation.observe(view), seen)
        read, memory = seen, state.memory
        if plan.network.lstm is not None and memory is not None:
            fresh = plan.network.lstm(seen, Memory(*(np.where(first, 0.0, part) for part in memory)))
            read, memory = fresh.hidden, Memory(*(np.where(due[:, None], new, old) for new, old in zip(fresh, memory, strict=True)))
        chosen = choose(plan.network, plan.action, read, chance, always, plan.action.mask(view) if plan.masked else None)
        action = np.where(due if chosen.ndim == 1 else due[:, None], chosen, state.action)
        return PolicyState(action, np.where(due[:, None], seen, state.seen), memory)


def _learned_under(header: Header, brief: Brief) -> Brief:
    """Return the brief with the kinds of attack that a policy learned with, where these are a part of the granted ones."""
    record, granted = header.training.get("threat_model"), brief.threat.kinds
    held = record.get("kinds") if isinstance(record, dict) else None
    kinds = held if isinstance(held, list) else []
    own = [kind for kind in granted if kind in kinds]
    if not own or len(own) != len(kinds) or len(own) == len(granted):
        return brief
    return dataclasses.replace(brief, threat=dataclasses.replace(brief.threat, kinds=tuple(kinds)))


def _trained_with(header: Header) -> str:
    """Return the options that describe the scenario and the threat model of its training, as far as a policy's file holds them."""
    config = header.training.get("config")
    config = config if isinstance(config, dict) else {}
    scenario, threat = config.get("scenario"), config.get("threat")
    words = ["--scenario", scenario] if isinstance(scenario, str) else []
    if isinstance(threat, dict):
        texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in threat.items()}
        words += [word for key, text in texts.items() for word in ("--threat", f"{key}={text}")]
    text = shlex.join(words)
    return f"; it was trained with {text}" if text and text.isprintable() and len(text) <= LONGEST else ""


def _count(agents: int) -> str:
    return f"{agents} agent{'' if agents == 1 else 's'}"


def policy_draws(draws: Draws) -> Draws:
    """Return the POLICY stream that belongs to the ATTACK stream given to `decide`."""
    return draws._replace(stream=int(Role.POLICY))


class YokedState(NamedTuple):
    row: Array  # (B,) index into the schedule
    policy: PolicyState


@dataclass(frozen=True, eq=False)
class Yoked:
    """The policy with somebody else's timing: on and off as `schedule` (K, B) bool says, values chosen in its own state."""

    policy: PolicyAttack
    schedule: Array

    def prepare(self, brief: Brief) -> PolicyPlan:
        return self.policy.prepare(brief)

    def start(self, plan: PolicyPlan, batch: int, draws: Draws) -> YokedState:
        if batch != self.schedule.shape[1]:
            raise InputError("schedule", self.schedule.shape, f"(steps, {batch})")
        return YokedState(np.arange(batch), self.policy.start(plan, batch, draws))

    def decide(self, plan: PolicyPlan, state: YokedState, view: View, draws: Draws) -> tuple[YokedState, Command]:
        held = self.policy.consider(plan, state.policy, view, draws, always=True)
        on = self.schedule[view.k - 1, state.row]
        command = plan.action.decode(held.action, view)
        keep = on[:, None, None]
        quiet = Command(np.where(on, command.kind, 0).astype(np.int8), command.target & keep, np.where(keep, command.value, 0.0))
        return YokedState(state.row, held), quiet
