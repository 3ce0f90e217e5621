"""Challenge-response authentication (thesis 3.4.2; Shoukry et al., PyCRA, 2015): mute the radar's probe, and listen.

A sensor that mutes its own probe hears noise alone; an answer then comes from an attacker. At a muted step

    energy > threshold        alarm; the belief rolls back to the one at the last challenge that passed, with the odometry since replayed
    else                      the alarm ends, at once or after a few such steps; without one, this belief is the one to roll back to

and the controller drives on the prediction. While alarmed no reading is used. Both beliefs, the live one and the safe one, are predicted
with the known input in every step, which is the replay.

The energy of N complex samples of noise, over their expected one, is Gamma(N, 1/N). The threshold is its upper quantile at the probability
of a false alarm a challenge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Generic, Literal, NamedTuple

import numpy as np
from pydantic import Field

from tailgate import num
from tailgate.base.errors import InputError, NotApplicable
from tailgate.base.pytree import map_leaves
from tailgate.core import Array, Estimate, Model, NonNegative, Positive, PositiveCount, Prior, Probability, Received, param
from tailgate.core.draws import Draws
from tailgate.core.nouns import P, S
from tailgate.core.registry import register
from tailgate.envs.sensors.fmcw import false_alarm_threshold, from_db
from tailgate.estimators.compose import AcceptAll, Look, ModeName, ReactionPlan, ReactionState, part_from
from tailgate.estimators.filters.predictors import read_states
from tailgate.estimators.parts import Filter, Verdict, normalised

Chance = Annotated[float, Field(gt=0, lt=1)]
Steps = tuple[PositiveCount, ...]
THESIS_TIMES = (15, 50, 175, 182)
CHANCE = 0.1
PREDICTOR = "joint_rls"
FILTER = "filter that predicts: a name, or a mapping with name and parameters"
QUIET = "challenges in a row that have to pass before an alarm ends"
WATCH = "probability of a challenge a step while alarmed, in place of the random ones or besides the list [-]; none: as without an alarm"


class Response(NamedTuple):
    """The use of readings in a step that is no challenge."""

    passes: bool  # the controller drives on them as they are; else on what the filter makes of them
    stops: bool  # not so during an alarm
    freezes: bool  # the filter uses none during an alarm
    rolls_back: bool  # it forgets those since the last challenge that passed when an alarm begins


class ChallengePlan(NamedTuple, Generic[P, S]):
    filter: Filter[P, S]
    filter_plan: P
    reaction: AcceptAll
    reaction_plan: ReactionPlan
    response: Response
    threshold: float  # on the energy over that of the noise
    state: Array  # (N, q) which state each sensor reads
    times: Array  # (T,) challenges that are fixed


class ChallengeState(NamedTuple, Generic[S]):
    """Every leaf has B first."""

    live: S  # the filter's belief
    safe: S  # that at the last challenge that passed, predicted since
    reaction: ReactionState
    k: Array  # (B,) steps done
    probe: Array  # (B, N) bool: what the last step asked for
    heard: Array  # (B, N) energy at the last challenge
    owed: Array  # (B, N) int64: challenges that have yet to pass before the alarm ends; 0 without an alarm


def pick(mask: Array, chosen: S, other: S) -> S:
    """Return the state `chosen` in the rows of `mask` (B, 1), else `other`."""
    if not num.some(mask):
        return other
    out: S = map_leaves(lambda a, b: np.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b), chosen, other)
    return out


@dataclass(frozen=True, kw_only=True)
class Challenger:
    """Base class: when to challenge, and what is heard. A subclass chooses the filter that predicts, and what an alarm changes."""

    label: ClassVar[str]  # its registered name

    challenge: Literal["random", "fixed"] = param("random", "random: each step with a probability; fixed: at the steps of a list")
    probability: Probability | None = param(None, f"random: probability of a challenge a step [-]; none: {CHANCE}")
    times: Steps | None = param(None, f"fixed: steps of the challenges; none: the thesis's {', '.join(map(str, THESIS_TIMES))}")
    watch: Probability | None = param(0.3, WATCH)
    quiet: PositiveCount = param(3, QUIET)
    suspicion: Positive | None = param(
        None, "r' S^-1 r of a reading above which the next step is a challenge, besides those of the schedule [-]; none: never"
    )
    false_alarm: Chance = param(1e-6, "probability of a false alarm a challenge [-]")
    margin: NonNegative = param(0.0, "how much stronger than it is told the receiver's noise may be, on top of the threshold [dB]")
    mode: ModeName = param(AcceptAll.mode, "what is asked of the controller while alarmed: normal, widen, brake, stop or acc")
    linger: NonNegative = param(AcceptAll.linger, "time that the mode outlasts the last alarm [s]")

    def __post_init__(self) -> None:
        unused = "times" if self.challenge == "random" else "probability"
        if getattr(self, unused) is not None:
            raise InputError(f"defence {self.label}.{unused}", getattr(self, unused), f"none: challenges are {self.challenge}")
        if self.times is not None and (1 in self.times or not self.times):
            raise InputError(f"defence {self.label}.times", self.times, "at least one step, from 2 on: the first step has no challenge")
        self.predictor()  # a wrong name shall fail here

    def predictor(self) -> Filter:
        """Return the filter that predicts the readings."""
        raise TypeError(f"{type(self).__name__} must define predictor()")

    def response(self) -> Response:
        """Return the use of the readings."""
        raise TypeError(f"{type(self).__name__} must define response()")

    def prepare(self, model: Model) -> ChallengePlan:
        name = f"defence {self.label}"
        if not model.air or model.agents != 1:
            raise NotApplicable(name, list(model.sensors), "one vehicle whose sensor listens to the echo of its own probe")
        predictor, reaction = self.predictor(), AcceptAll(mode=self.mode, linger=self.linger)
        return ChallengePlan(
            predictor, predictor.prepare(model), reaction, reaction.prepare(model), self.response(),
            from_db(self.margin) * false_alarm_threshold(self.false_alarm, model.challenge), read_states(model, name),
            np.array(THESIS_TIMES if self.times is None else self.times, np.int64),
        )  # fmt: skip

    def start(self, plan: ChallengePlan, prior: Prior) -> ChallengeState:
        """Return the state at step 1; before the first challenge the belief to roll back to is the prior."""
        batch, belief = len(prior.mean), plan.filter.start(plan.filter_plan, prior)
        nothing = num.zeros((batch, 1))
        reaction = plan.reaction.start(plan.reaction_plan, batch)
        return ChallengeState(belief, belief, reaction, np.zeros(batch, np.int64), nothing == 0.0, nothing, num.zeros((batch, 1), np.int64))

    def step(
        self, plan: ChallengePlan, state: ChallengeState, received: Received, known_u: Array, draws: Draws
    ) -> tuple[ChallengeState, Estimate]:
        live, safe = (plan.filter.predict(plan.filter_plan, belief, known_u) for belief in (state.live, state.safe))
        muted = ~state.probe
        heard = np.where(muted, received.energy, state.heard)
        after = np.where(heard > plan.threshold, self.quiet, np.maximum(state.owed - 1, 0))
        owed = np.where(muted, after, state.owed)
        alarm = owed > 0
        if plan.response.rolls_back:
            live = pick(muted & alarm, safe, live)
            safe = pick(muted & ~alarm, live, safe)
        innovation = plan.filter.innovation(plan.filter_plan, live, received)
        used, shown = _used(plan, received, muted, alarm)
        live = plan.filter.update(plan.filter_plan, live, innovation, used)
        x = plan.filter.estimate(live).copy(order="K")
        for i, column in enumerate(plan.state[0]):
            x[..., column] = np.where(shown[..., i], received.y[..., i], x[..., column])
        verdict = Verdict(heard, alarm, np.broadcast_to(alarm[..., None], shown.shape))
        reaction, decision = plan.reaction.step(plan.reaction_plan, state.reaction, verdict, received)
        probe = ~self._due(plan, state.k + 2, alarm, draws)
        if self.suspicion is not None:
            odd = normalised(innovation) > self.suspicion
            probe &= ~(odd & ~muted)
        return ChallengeState(live, safe, reaction, state.k + 1, probe, heard, owed), Estimate(x, heard, alarm, decision.mode, probe)

    def look(self, plan: ChallengePlan, state: ChallengeState, received: Received, known_u: Array) -> Look:
        """Return the innovation that `received` would meet, and how far it would move the controller's input; it meets no gate."""
        live = plan.filter.predict(plan.filter_plan, state.live, known_u)
        innovation = plan.filter.innovation(plan.filter_plan, live, received)
        used, shown = _used(plan, received, ~state.probe, state.owed > 0)
        gain = np.where(used[..., None, :], plan.filter.gain(plan.filter_plan, live, innovation), 0.0)
        for i, column in enumerate(plan.state[0]):
            gain[..., column, :] = np.where(shown[..., i, None], np.eye(len(plan.state[0]))[i], gain[..., column, :])
        return Look(innovation, gain, None)

    def _due(self, plan: ChallengePlan, k: Array, alarm: Array, draws: Draws) -> Array:
        """Return (B, N) bool: step k (B,) is a challenge by the schedule, or by the closer watch during an alarm."""
        chance = CHANCE if self.probability is None else self.probability
        u, usual = draws.uniform((1,)), chance if self.challenge == "random" else 0.0
        due = u < (usual if self.watch is None else np.where(alarm, self.watch, usual))
        return np.asarray(due if self.challenge == "random" else due | np.isin(k, plan.times)[:, None])


def _used(plan: ChallengePlan, received: Received, muted: Array, alarm: Array) -> tuple[Array, Array]:
    """Return (B, N, q) bool each: the readings that the filter uses, and those that the controller gets as they are."""
    there = received.valid & ~muted[..., None]
    calm = there & ~alarm[..., None]
    used, shown = (calm if until else there for until in (plan.response.freezes, plan.response.stops))
    return used, shown & plan.response.passes


@register(
    "defence", "cra", uses=("measurements", "odometry", "probe"),
    reference="Dutta 2018, Algorithms 1 and 2, corrected; Shoukry, Martin, Yona, Diggavi, Srivastava, PyCRA, CCS 2015",
)  # fmt: skip
@dataclass(frozen=True, kw_only=True)
class ChallengeResponse(Challenger):
    """Challenge-response authentication: an answer to a muted probe is an attack; the prediction is driven on until challenges pass."""

    label = "cra"

    filter: object = param(PREDICTOR, FILTER)
    passes: bool = param(True, "without an attack the controller drives on the readings as they are, else on the filter's estimate")
    rollback: bool = param(True, "an alarm takes back what was used since the last challenge that passed")
    freeze: bool = param(True, "the filter uses no reading during an alarm")

    def predictor(self) -> Filter:
        predictor: Filter = part_from("filter", self.filter, PREDICTOR, "defence cra.filter")
        return predictor

    def response(self) -> Response:
        return Response(self.passes, True, self.freeze, self.rollback)


@register(
    "defence", "pycra", uses=("measurements", "odometry", "probe"),
    reference="Shoukry, Martin, Yona, Diggavi, Srivastava, PyCRA: Physical Challenge-Response Authentication for Active Sensors, CCS 2015",
)  # fmt: skip
@dataclass(frozen=True, kw_only=True)
class PyCra(Challenger):
    """Challenge-response authentication that only tells of an attack: readings are believed, and predicted at challenges alone."""

    label = "pycra"

    watch: Probability | None = param(None, WATCH)
    quiet: PositiveCount = param(1, QUIET)
    filter: object = param(PREDICTOR, FILTER)

    def predictor(self) -> Filter:
        predictor: Filter = part_from("filter", self.filter, PREDICTOR, "defence pycra.filter")
        return predictor

    def response(self) -> Response:
        return Response(passes=True, stops=False, freezes=False, rolls_back=False)
