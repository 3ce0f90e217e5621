"""The attacker's seat as a lane: actions to commands, rewards, observations (`tailgate.agents.codec`, `reward`, `observation`)."""

from __future__ import annotations

import numpy as np

from tailgate.agents import reward
from tailgate.agents.reward import NEAR
from tailgate.agents.values import FAINTEST
from tailgate.elementwise import clip
from tailgate.kinds import Kind

from . import channel
from . import constants as of
from .compiled import formula, phase
from .rows import (
    ACCEPTED,
    ALARM,
    ANY_HIT,
    ANY_REAR,
    ANY_REFUSED,
    ATTACKING,
    BEFORE,
    BURST,
    COOLDOWN,
    EARNED,
    EGO,
    ENDED,
    HIT,
    INFINITE,
    KIND,
    LANES,
    LEAD_V,
    LEAD_X,
    LEAST,
    LEFT_OVER,
    LIVE,
    OFF,
    ON,
    OPEN,
    OVER,
    PART,
    PEAK,
    POTENTIAL,
    RAW,
    REAR_HIT,
    REAR_V,
    REAR_X,
    REFUSED,
    SENT,
    TRUTH,
    USED,
    VALUE,
    WANT_KIND,
    WANT_TARGET,
    WANT_VALUE,
    WIRES,
    ZERO,
    K,
    U,
    X,
)

closeness, fooled, small = formula(reward.closeness), formula(reward.fooled), formula(reward.small)
_1, _2, _3, _4 = (np.uint64(LANES * i) for i in range(1, 5))
FDI = float(Kind.FDI)

# What an observation shows: the difference of two rows, the second of which is mostly 0.
QUANTITIES = {
    "progress": (K, ZERO), "allowed": (ON, ZERO), "budget_left": (LEFT_OVER, ZERO), "burst": (BURST, ZERO), "cooldown": (COOLDOWN, ZERO),
    "gap": (LEAD_X, EGO), "speed": (EGO + _1, ZERO), "lead_speed": (LEAD_V, ZERO), "closing": (EGO + _1, LEAD_V), "accel": (EGO + _2, ZERO),
    "rear_gap": (EGO, REAR_X), "rear_closing": (REAR_V, EGO + _1), "control0": (U, ZERO), "noise_position": (SENT, EGO),
    "noise_velocity": (SENT + _1, EGO + _1), "attacking": (ATTACKING, ZERO), "last_position": (VALUE, ZERO),
    "last_velocity": (VALUE + _1, ZERO),
    "last_leader_position": (VALUE + _2, ZERO), "last_leader_velocity": (VALUE + _3, ZERO), "last_acceleration": (VALUE + _4, ZERO),
}  # fmt: skip
ALONE = {"rear_gap": (INFINITE, ZERO), "rear_closing": (ZERO, ZERO)}  # without a driver behind


@phase
def decode(s, window, c, f, table, action, first, n):
    """Actions (B, ACTIONS), of this block from `first` on, into the rows WANT_*. -> whether there is any command."""
    kind, rate = f[of.ACTION], c[of.RATE]
    some = 0
    for i in range(n):
        s[WANT_KIND + i] = 0.0
        some += 1 if action[first + i, 0] > 0.0 else 0  # the trigger, or the number of the action: 0 is none
    if some == 0:
        return False
    if kind == of.DISCRETE or kind == of.RAMPING:
        for i in range(n):
            row = of.TABLE + of.MODE_WIDTH * np.int64(action[first + i, 0])
            wanted, sign = c[row], c[row + 1]
            delays = wanted == channel.ECHO_DELAY
            ramps = (kind == of.RAMPING) & ((wanted == FDI) | delays) & (s[KIND + i] == wanted)
            s[WANT_KIND + i] = wanted
            for w in range(WIRES):
                at = np.uint64(w * LANES) + i
                aimed, value = c[row + 2 + w], c[row + 7 + w]
                if ramps:
                    low, high = FAINTEST if delays else -c[of.BOUND + w], c[of.LATEST] if delays else c[of.BOUND + w]
                    value = clip(s[VALUE + at] + rate * sign, low, high)
                s[WANT_TARGET + at] = aimed
                s[WANT_VALUE + at] = value if aimed != 0.0 else 0.0
        return True
    for i in range(n):
        s[ON + i] = clip(action[first + i, 0], -1.0, 1.0) > 0.0
        s[WANT_KIND + i] = FDI if s[ON + i] != 0.0 else 0.0
    place: int = 1
    for w in range(WIRES):
        down, bound, mine = np.uint64(w * LANES), c[of.BOUND + w], c[of.WIRE + w] != 0.0
        for i in range(n):
            share = clip(action[first + i, place if mine else 0], -1.0, 1.0)
            before = s[VALUE + down + i] if s[KIND + i] == FDI else 0.0
            value = clip(before + rate * share, -bound, bound) if kind == of.INCREMENT else bound * share
            on = mine & (s[ON + i] != 0.0)
            s[WANT_TARGET + down + i] = on
            s[WANT_VALUE + down + i] = value if on else 0.0
        place += int(mine)
    return True


@formula
def _potential(s, gap_shaping, error_shaping, belief, i):
    """The reward's potential of the gap, and of what the car believes that it has on top."""
    near = closeness(s[LEAD_X + i] - s[EGO + i])
    return gap_shaping * near + error_shaping * (fooled(belief) + 0.0)


@phase
def begin(s, c, n):
    """The reward's memory of episodes that have just begun."""
    gap_shaping, error_shaping = c[of.GAP_SHAPING], c[of.ERROR_SHAPING]
    for i in range(n):
        s[POTENTIAL + i] = _potential(s, gap_shaping, error_shaping, 0.0, i)
        s[LEAST + i] = np.minimum(small(s[LEAD_X + i] - s[EGO + i]), NEAR)
        s[PEAK + i] = s[OVER + i] = 0.0


@phase
def before(s, n):
    """Before a decision is played."""
    for i in range(n):
        s[RAW + i] = s[ANY_REFUSED + i] = s[ACCEPTED + i] = s[ANY_HIT + i] = s[ANY_REAR + i] = 0.0
        s[BEFORE + i] = s[POTENTIAL + i]


@phase
def alive(s, c, n):
    """Before a step of it: whether the step counts."""
    horizon = c[of.HORIZON]
    for i in range(n):
        s[LIVE + i] = (s[OVER + i] == 0.0) & (s[ENDED + i] == 0.0) & (s[K + i] <= horizon)


@formula
def _costs(s, cost, i):
    """What a step's attack costs, below zero."""
    return -cost * (1.0 if s[KIND + i] != 0.0 else 0.0)


def paying(many):
    """The phase `pay`: of one car, or of `many`.

    Of many the smallest gap and the largest belief stand in the place of a single car's, and the largest error in row OFF.
    """

    @phase
    def pay(s, c, f, n):
        """After a step of it: its reward, and what happened."""
        kind, cost, scale, dt, horizon = f[of.REWARD], c[of.COST], c[of.REWARD_SCALE], c[of.DT], c[of.HORIZON]
        gap_shaping, error_shaping, sign = c[of.GAP_SHAPING], c[of.ERROR_SHAPING], c[of.BELIEF]
        if kind == of.CRASH or kind == of.MIN_GAP:
            nearer = kind == of.MIN_GAP
            for i in range(n):
                before = s[LEAST + i]
                least = np.minimum(small(s[LEAD_X + i] - s[EGO + i]), before)
                earned = _costs(s, cost, i) + (1.0 if (s[HIT + i] != 0.0) | (s[REAR_HIT + i] != 0.0) else 0.0)
                s[EARNED + i] = earned + (before - least) / NEAR if nearer else earned
                s[LEAST + i] = least
        else:
            for i in range(n):
                s[EARNED + i] = _costs(s, cost, i)
                s[PART + i] = s[OFF + i] if many else abs(0.0 + sign * (s[X + i] - s[TRUTH + i]))
            if kind == of.PEAK:
                for i in range(n):
                    lower = s[PEAK + i]
                    s[PEAK + i] = np.maximum(s[PART + i], lower)
                    s[EARNED + i] += (s[PEAK + i] - lower) / scale
            for i in range(n):
                s[PART + i] /= scale
            if kind == of.FINAL:
                for i in range(n):
                    s[EARNED + i] += s[PART + i] * s[PART + i] if s[K + i] - 1.0 == horizon else 0.0
            elif kind != of.PEAK:
                for i in range(n):
                    s[EARNED + i] += dt * np.minimum(s[PART + i], 1.0)
                for i in range(n if kind == of.STEALTH else np.uint64(0)):
                    s[EARNED + i] -= dt * s[ALARM + i]
        for i in range(n):
            live, refused, hit, rear = s[LIVE + i] != 0.0, s[REFUSED + i] != 0.0, s[HIT + i] != 0.0, s[REAR_HIT + i] != 0.0
            now = _potential(s, gap_shaping, error_shaping, 0.0 + sign * (s[X + i] - s[TRUTH + i]), i)
            before, earned = s[POTENTIAL + i], s[EARNED + i]
            s[RAW + i] += earned if live else 0.0
            s[POTENTIAL + i] = now if live else before
            s[ANY_REFUSED + i] = 1.0 if (live & refused) | (s[ANY_REFUSED + i] != 0.0) else 0.0
            s[ACCEPTED + i] = 1.0 if (s[KIND + i] != 0.0) | (s[ACCEPTED + i] != 0.0) else 0.0
            s[ANY_HIT + i] = 1.0 if (live & hit) | (s[ANY_HIT + i] != 0.0) else 0.0
            s[ANY_REAR + i] = 1.0 if (live & rear) | (s[ANY_REAR + i] != 0.0) else 0.0

    return pay


pay = paying(many=False)


@phase
def settle(s, c, paid, flags, first, n):
    """After a decision: what it brought, into paid (PAID, B) and flags (FLAGS, B); of rows that were over before it nothing."""
    gamma, horizon, penalty = c[of.GAMMA_PAID], c[of.HORIZON], c[of.ILLEGAL]
    for i in range(n):
        open_row = s[OVER + i] == 0.0
        terminated = open_row & (s[ENDED + i] != 0.0)
        truncated = open_row & (not terminated) & (s[K + i] > horizon)
        after = 0.0 if terminated else s[POTENTIAL + i]
        illegal = (s[ANY_REFUSED + i] != 0.0) & (s[ACCEPTED + i] == 0.0)
        paid[0, first + i] = s[RAW + i] - penalty * (1.0 if illegal else 0.0) + gamma * after - s[BEFORE + i] if open_row else 0.0
        flags[0, first + i], flags[1, first + i], flags[2, first + i] = terminated, truncated, illegal
    for i in range(n):
        flags[3, first + i], flags[4, first + i] = s[ANY_HIT + i] != 0.0, s[ANY_REAR + i] != 0.0


@phase
def close(s, flags, first, n):
    """Which rows are over now."""
    for i in range(n):
        s[OVER + i] = flags[0, first + i] | flags[1, first + i]


@phase
def look(s, window, c, f, table, paid, flags, count, mask, first, n):
    """What the information of a step shows of the state that it led to, and what the observation needs of it."""
    channel.open_within(s, c, 1.0, ON, n)
    channel.open_within(s, c, c[of.INTERVAL], OPEN, n)
    budget, share = c[of.BUDGET], c[of.BUDGET_SHARE]
    bounded = budget < np.inf
    for i in range(n):
        paid[1, first + i] = s[LEAD_X + i] - s[EGO + i]
        flags[5, first + i], count[first + i] = s[ON + i] != 0.0, np.int64(s[K + i])
    for j in range(mask.shape[1]):
        for i in range(n):
            mask[first + i, j] = (s[OPEN + i] != 0.0) | (j == 0)
    for i in range(n):
        s[LEFT_OVER + i] = (budget - s[USED + i]) / share if bounded else 1.0
        s[ATTACKING + i] = 1.0 if s[KIND + i] != 0.0 else 0.0
        s[ZERO + i], s[INFINITE + i] = 0.0, np.inf


@phase
def observe(s, c, f, seen, first, n):
    """The observation, seen (B, FEATURES), of the rows that `look` has filled."""
    limit = c[of.SEEN_MOST]
    for j in range(f[of.FEATURES]):
        row, other, scale = np.uint64(f[of.SEEN + j]), np.uint64(f[of.FROM + j]), c[of.SEEN_SCALE + j]
        for i in range(n):  # apart from what follows, which goes to every FEATURES-th place and so is not vectorised
            s[PART + i] = clip((s[row + i] - s[other + i]) / scale, -limit, limit)
        for i in range(n):
            seen[first + i, j] = s[PART + i]
