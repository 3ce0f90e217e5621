"""Challenge-response authentication as a lane, whatever predicts: `tailgate.estimators.challenge`.

What is remembered stands in rows of its own, m: what was heard at the last challenge, how many have yet to pass, and below what the
predictor keeps (`regression`, `printed`).
"""

import numpy as np

from tailgate.draws import Role

from . import constants as of
from . import kalman, road
from .compiled import phase
from .rows import (
    ACCEPT,
    ALARM,
    ARRIVED,
    ASIDE,
    BACK,
    CALM,
    DEFENCE_KEY,
    DRAW,
    HEARD,
    LANES,
    LEFT,
    MODE,
    MUTED,
    PROBE,
    PROBED,
    SCORE,
    VALID,
    K,
    R,
    S,
    X,
)

_1, _3 = np.uint64(LANES), np.uint64(3 * LANES)  # rows further down
_DEFENCE = np.uint64(int(Role.DEFENCE) << 16)
_HEARD, _OWED = (np.uint64(LANES * i) for i in range(2))
REMEMBERED = 2  # rows of m


@phase
def listen(s, m, c, n):
    """Score, alarm, and how the challenge went; -> whether there was one anywhere."""
    threshold, quiet = c[of.THRESHOLD], c[of.QUIET]
    for i in range(n):
        s[MUTED + i] = 1.0 - s[PROBE + i]
    for i in range(n):
        s[SCORE + i] = s[HEARD + i] if s[MUTED + i] != 0.0 else m[_HEARD + i]
    for i in range(n):
        m[_HEARD + i] = s[SCORE + i]
    some = 0
    for i in range(n):
        muted, left = s[MUTED + i] != 0.0, m[_OWED + i]
        after = quiet if s[SCORE + i] > threshold else np.maximum(left - 1.0, 0.0)
        left = after if muted else left
        s[ALARM + i] = left > 0.0
        s[BACK + i], s[CALM + i] = muted & (left > 0.0), muted & (not left > 0.0)
        s[ASIDE + i] = left
        some += 1 if muted else 0
    for i in range(n):
        m[_OWED + i] = s[ASIDE + i]
    return some > 0


@phase
def use(s, f, n):
    """Which readings the filter uses, into ACCEPT."""
    freezes = f[of.FREEZES] != 0
    for i in range(n):
        used = (s[MUTED + i] == 0.0) & (not (freezes & (s[ALARM + i] != 0.0)))
        s[ACCEPT + i], s[ACCEPT + _1 + i] = (s[VALID + i] != 0.0) & used, (s[VALID + _1 + i] != 0.0) & used


@phase
def finish(s, g, c, f, n):
    """What follows from the belief: the next challenge, the readings that the controller is shown as they are, and a mode."""
    _ask(s, g, c, f, n)
    _react(s, c, f, n)
    stops = f[of.STOPS] != 0
    for i in range(n if f[of.PASSES] != 0 else np.uint64(0)):
        shown = (s[MUTED + i] == 0.0) & (not (stops & (s[ALARM + i] != 0.0)))
        s[X + i] = s[ARRIVED + i] if shown & (s[VALID + i] != 0.0) else s[X + i]
        s[X + _1 + i] = s[ARRIVED + _1 + i] if shown & (s[VALID + _1 + i] != 0.0) else s[X + _1 + i]


@phase
def _ask(s, g, c, f, n):
    """Whether the next measurement is a challenge: PROBE is 0 where it is."""
    usual, watched, suspicion, times = c[of.USUAL], c[of.WATCHED], c[of.SUSPICION], f[of.FIXED]
    road.uniforms(s, g, DEFENCE_KEY, _DEFENCE, np.uint64(0), DRAW, n)
    for i in range(n):
        alarm = s[ALARM + i] != 0.0
        g2 = kalman.normalised(s[R + i], s[R + _1 + i], s[S + i], s[S + _1 + i], s[S + _3 + i])
        due = (s[DRAW + i] < (watched if alarm else usual)) | ((g2 > suspicion) & (s[MUTED + i] == 0.0))
        s[PROBED + i] = s[PROBE + i]
        s[PROBE + i] = 0.0 if due else 1.0
    for t in range(times):
        at = c[of.TIMES + t] - 1.0
        for i in range(n):
            s[PROBE + i] = 0.0 if s[K + i] == at else s[PROBE + i]


@phase
def _react(s, c, f, n):
    """What is asked of the controller."""
    asked, linger = c[of.ASKED], c[of.LINGER]
    for i in range(n if f[of.MODED] != 0 else np.uint64(0)):
        left = linger + 1.0 if s[ALARM + i] != 0.0 else max(s[LEFT + i] - 1.0, 0.0)
        s[LEFT + i] = left
        s[MODE + i] = asked if left > 0.0 else 0.0
