"""The channel: the only place where a command changes what a receiver reads."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tailgate import num
from tailgate.core.kinds import EFFECTS, Kind, Limits, Memory, Recording
from tailgate.core.nouns import Air, Array, Command, Received, no_command
from tailgate.core.threat import Brief, ThreatModel

NONE, DOS_JAM, DROPOUT, REPLAY, NOISE_JAM, ECHO_DELAY, INSIDER = map(  # plain numbers: numpy looks for methods of an enumeration's members
    int, (Kind.NONE, Kind.DOS_JAM, Kind.DROPOUT, Kind.REPLAY, Kind.NOISE_JAM, Kind.ECHO_DELAY, Kind.INSIDER)
)
_VALUED, _ON_AIR, _RADIATED = (
    np.array([kind in EFFECTS and getattr(EFFECTS[kind], trait) for kind in map(int, Kind)]) for trait in ("valued", "over_air", "radiated")
)
Number = Array | float


class ChannelPlan(NamedTuple):
    """The threat model as arrays."""

    threat: ThreatModel
    granted: Array  # (N, w) bool
    kinds: Array  # (kinds,) bool
    limits: Limits
    last_step: int
    sensors: int
    air: bool
    recorded: int  # samples kept for delay and replay; 0 where neither is granted
    sealed: Array  # (w,) bool: the wires whose values are authenticated
    geared: Array  # (N, w) bool: the wires whose signal a car's own law weighs by a gain
    gears: tuple[int, ...]  # their places, in the order of the model's `gains`


class ChannelState(NamedTuple):
    """The channel's memory; every leaf has B first."""

    used: Array  # (B,) attack steps charged
    burst: Array  # (B,) length of the running burst
    cooldown: Array  # (B,) steps before the next burst
    played: Array  # (B,) steps that the running replay has lasted
    taped: Array  # (B,) samples recorded so far
    anchor: Array  # (B,) samples recorded before the running replay began
    links: Memory  # memory of sensors and V2V fields
    drives: Memory  # memory of actuators
    last: Command


def accepts(
    k: Number, steps: Number, left: Number, burst: Number, cooldown: Number, onset: Number, last: Number, longest: Number, pause: Number
) -> Array:
    """Return elementwise if the channel accepts, in at least one of the `steps` steps from k on, a command that is legal in itself.

    left: attack steps in the budget. burst, cooldown: lengths so far and to come [steps]. onset, last, longest, pause: from the threat
    model.

    Nothing is charged before the first accepted step. A cooldown counts down; a full burst ends, and the step that ends it is the first of
    its pause. So the first open step alone decides.
    """
    first = np.maximum(k + np.where(burst < longest, cooldown, np.maximum(pause, 1)), onset)
    return (left > 0) & (first <= last) & (first < k + steps)


class Channel:
    """Apply commands to the wires and enforce the threat model, for scripts and learned policies alike.

    A step has two halves: `apply` decides on the command and changes what is measured and heard, `actuate` then changes what the
    controller commands.
    """

    def prepare(self, brief: Brief) -> ChannelPlan:
        threat = brief.threat
        kinds = np.zeros(len(Kind), bool)
        for name in threat.kinds:
            kinds[Kind[name.upper()]] = True
        last = brief.horizon if threat.end is None else min(threat.end, brief.horizon)
        recorded = threat.memory if any(EFFECTS[kind].recorded for kind in np.flatnonzero(kinds).tolist()) else 0
        sensors = len(brief.model.sensors)
        gears = tuple(brief.model.wires.index(name) for name in brief.model.gains)
        return ChannelPlan(
            threat, brief.granted, kinds, brief.limits, last, sensors, brief.model.air, recorded, brief.sealed, brief.geared, gears,
        )  # fmt: skip

    def start(self, plan: ChannelPlan, expected: Array, u: Array) -> ChannelState:
        """Return the memory at step 1; an early attack holds the expected links (B, N, q+p) and the first input u (B, N, m)."""
        batch, agents, links = expected.shape
        count = np.zeros(batch, np.int64)
        return ChannelState(
            count, count.copy(), count.copy(), count.copy(), count.copy(), count.copy(),
            self._memory(plan, expected), self._memory(plan, u), no_command(batch, agents, links + u.shape[-1]),
        )  # fmt: skip

    def _memory(self, plan: ChannelPlan, expected: Array) -> Memory:
        history = num.zeros((*expected.shape, plan.recorded))
        history[...] = expected[..., None]
        return Memory(num.batch_last(expected), num.batch_last(expected), history, history.copy(order="K"))

    def budget_left(self, plan: ChannelPlan, state: ChannelState) -> Array:
        if plan.threat.budget is None:
            return np.full(len(state.used), np.inf)
        return np.asarray(plan.threat.budget - state.used, np.float64)

    def allowed(self, plan: ChannelPlan, state: ChannelState, k: Array) -> Array:
        """Return (B,) bool: a command of a granted kind, target and value would be accepted at step k (B,)."""
        return self.open(plan, k, self.budget_left(plan, state), state.burst, state.cooldown)

    def open(self, plan: ChannelPlan, k: Array, left: Array, burst: Array, cooldown: Array, steps: int = 1) -> Array:
        """Return (B,) bool: such a command, given in each of `steps` steps from k on, would be accepted in at least one (`accepts`)."""
        threat = plan.threat
        longest = np.inf if threat.duration is None else threat.duration
        return np.asarray(accepts(k, steps, left, burst, cooldown, threat.onset, plan.last_step, longest, threat.cooldown))

    def apply(
        self, plan: ChannelPlan, state: ChannelState, sent: Array, received: Received, command: Command, k: Array,
        again: Callable[[Air], Received] | None = None,
    ) -> tuple[ChannelState, Received, Array, Array]:  # fmt: skip
        """Return the next state, what is received, the links (B, N, q+p) as they arrived, and refused (B,) bool.

        `sent` (B, N, q+p) holds the sensor readings and the V2V message before the attack; `again` measures under what is radiated.
        """
        threat, kind, aimed = plan.threat, command.kind, command.target.any(axis=(1, 2))
        charged = (kind != NONE) & aimed
        if num.some(charged):
            charged = charged & self._legal(plan, state, command) & self.allowed(plan, state, k)
        refused = ((kind != NONE) | aimed) & ~charged

        hit = command.target & charged[:, None, None]
        kind = np.where(charged, kind, 0).astype(np.int8)
        q, value = plan.sensors, command.value
        if plan.air and num.some(aired := num.take(_ON_AIR, kind)):  # over the air a command hits all readings of a receiver
            strength = np.max(np.where(hit, value, 0.0), axis=2, keepdims=True)
            whole = aired[:, None, None] & hit.any(axis=2, keepdims=True) & (np.arange(hit.shape[2]) < q)
            hit, value = hit | whole, np.where(whole, strength, value)
        valued = num.take(_VALUED, kind)[:, None, None]
        last = Command(kind, hit, np.where(hit & valued, value, 0.0))
        begins_to_hold = np.asarray(k) == threat.onset if threat.hold_from_onset else charged & (state.used == 0)
        ended = (state.burst > 0) & ~charged
        # the step that ends a burst is itself the first of the pause
        cooldown = np.where(ended, max(threat.cooldown - 1, 0), np.maximum(state.cooldown - 1, 0))
        state = state._replace(
            used=state.used + charged, burst=np.where(charged, state.burst + 1, 0), cooldown=cooldown, last=last,
        )  # fmt: skip
        if plan.kinds[INSIDER]:  # the wires arrive as they were sent
            hit = hit & (kind != INSIDER)[:, None, None]
        if num.some(begins_to_hold):
            state = state._replace(links=_hold(state.links, begins_to_hold), drives=_hold(state.drives, begins_to_hold))
        begins = (kind == REPLAY) & (state.played == 0)
        if plan.kinds[REPLAY] and num.some(begins):
            anchor = np.where(begins, state.taped, state.anchor)
            state = state._replace(anchor=anchor, links=_copy_tape(state.links, begins), drives=_copy_tape(state.drives, begins))
        heard, under = sent, received
        if again is not None and num.some(num.take(_RADIATED, kind)):
            under, left = again(self._radiated(plan, last)), (kind == DOS_JAM)[:, None, None] & hit[..., :q]
            under = under._replace(valid=np.where(left, received.valid, under.valid))  # what a jammer leaves is read where anything is
            heard = num.stack([under.y[..., i] for i in range(q)] + [sent[..., i] for i in range(q, sent.shape[-1])])
        links = self._arrive(plan, state, state.links, heard, slice(0, sent.shape[-1]))
        lost = hit & (kind == DROPOUT)[:, None, None] if plan.kinds[DROPOUT] else np.zeros_like(hit)
        out = under._replace(
            y=links[..., :q], valid=under.valid & ~lost[..., :q], v2v=links[..., q:], attacked=hit[..., :q]
        )
        good = sent
        if not num.every(received.valid):  # a muted sensor gives no sample: the last one takes its place
            good = sent.copy(order="K")
            good[..., :q] = np.where(received.valid, sent[..., :q], state.links.fresh[..., :q])
        return state._replace(links=self._keep(plan, state, state.links, good, hit[..., : sent.shape[-1]])), out, links, refused

    def actuate(self, plan: ChannelPlan, state: ChannelState, u: Array) -> tuple[ChannelState, Array]:
        """Return the next state and u (B, N, m) as the actuators get it."""
        wires = slice(plan.granted.shape[1] - u.shape[-1], None)
        applied, drives = u, state.drives
        if plan.granted[:, wires].any():
            applied = self._arrive(plan, state, state.drives, u, wires)
            drives = self._keep(plan, state, state.drives, u, state.last.target[..., wires])
        played = np.where(state.last.kind == REPLAY, state.played + 1, 0)
        return state._replace(drives=drives, played=played, taped=state.taped + 1), applied

    def factors(self, plan: ChannelPlan, state: ChannelState) -> tuple[Array, Array]:
        """Return the factors (B, N, gains) on the gains of each agent's own law, and (B, N) bool: an insider drives it."""
        inside = state.last.target & (state.last.kind == INSIDER)[:, None, None]
        scaled = num.stack([np.where(inside[..., w], state.last.value[..., w], 1.0) for w in plan.gears])
        return scaled, inside.any(axis=2)

    def _legal(self, plan: ChannelPlan, state: ChannelState, command: Command) -> Array:
        """Return (B,) bool: the threat model grants kind, targets and values."""
        kind, value = command.kind, command.value
        known = (kind >= 0) & (kind < len(plan.kinds))
        legal = known & num.take(plan.kinds, np.where(known, kind, 0))
        ok = plan.granted
        with np.errstate(invalid="ignore"):
            for one in num.present(kind, np.flatnonzero(plan.kinds).tolist()):
                effect = EFFECTS[one]
                if effect.valued:
                    fits = effect.grants(plan.limits, value)
                    if effect.over_air:
                        fits = plan.air & (np.arange(value.shape[2]) < plan.sensors) & fits
                    if effect.inside:  # an insider has the keys
                        fits = plan.geared & fits
                    elif plan.sealed.any() and not effect.over_air:  # a forged value is not accepted; an old one is until its key is known
                        age = value
                        if one == REPLAY:  # its window, round after round
                            played, window = state.played[:, None, None], np.maximum(value, 1.0)
                            age = window * (1.0 + np.floor(played / window))
                        fits = fits & (~plan.sealed | (effect.recorded & (age <= plan.threat.key_interval)))
                    ok = ok & ((kind != one)[:, None, None] | fits)
        return np.asarray(legal & ~(command.target & ~ok).any(axis=(1, 2)))

    def _radiated(self, plan: ChannelPlan, command: Command) -> Air:
        """Return the noise and delay that a command in force radiates at each receiver."""
        hit = command.target[..., : plan.sensors].any(axis=2)
        strength = np.max(command.value[..., : plan.sensors], axis=2)
        kind = command.kind[:, None]
        power = np.where(kind == NOISE_JAM, strength, np.where(kind == DOS_JAM, plan.threat.jam_power, 0.0))
        reaction = np.inf if plan.threat.reaction is None else plan.threat.reaction
        return Air(np.where(hit, power, 0.0), np.where(hit & (kind == ECHO_DELAY), strength, 0.0), reaction)

    def _arrive(self, plan: ChannelPlan, state: ChannelState, memory: Memory, sent: Array, wires: slice) -> Array:
        """Return `sent` (B, N, .), the part `wires` of all wires, as it arrives under the command in force."""
        command, out = state.last, sent
        target, value = command.target[..., wires], command.value[..., wires]
        recording = Recording(plan.recorded, *(part[:, None, None] for part in (state.taped, state.anchor, state.played)))
        known = [kind for kind in np.flatnonzero(plan.kinds).tolist() if not (EFFECTS[kind].over_air or EFFECTS[kind].inside)]
        for kind in num.present(np.where(target.any(axis=(1, 2)), command.kind, NONE), known):
            now, effect = (command.kind == kind)[:, None, None], EFFECTS[kind]
            hit = target & now
            given = np.where(hit, value, 1.0) if effect.recorded else value
            read = np.where(hit, effect.reads(sent, given, memory, recording), out)
            out = np.where(now, read, out) if effect.recorded else read  # one mask of all wires: traced code skips the search of the rings
        return out

    def _keep(self, plan: ChannelPlan, state: ChannelState, memory: Memory, sent: Array, hit: Array) -> Memory:
        """Return the memory after this step's `sent` (B, N, .), of which `hit` was attacked."""
        history = memory.history
        if plan.recorded:
            history = num.put(history, (state.taped % plan.recorded)[:, None, None], sent)
        return memory._replace(fresh=np.where(hit, memory.fresh, sent) if num.some(hit) else sent, history=history)


def _hold(memory: Memory, rows: Array) -> Memory:
    """Return the memory with its held sample taken in `rows` (B,) bool."""
    return memory._replace(held=np.where(rows[:, None, None], memory.fresh, memory.held))


def _copy_tape(memory: Memory, rows: Array) -> Memory:
    """Return the memory with the recording of `rows` (B,) bool copied for a replay: the recorder itself runs on."""
    return memory._replace(tape=np.where(rows[:, None, None, None], memory.history, memory.tape))
