"""The attacker's seat of a network as a lane: what differs from `tailgate.fused.seat`, which pays for the agent that errs most."""

from . import network, seat, wires
from .compiled import phase

_pay = seat.paying(many=True)


@phase
def pay(s, c, f, n):
    """After a step of a decision: its reward, what happened, and how large the largest error is."""
    _pay(s, c, f, n)
    network.damage(s, n)


@phase
def look(s, window, c, f, table, paid, flags, count, mask, first, n):
    """What the information of a step shows of the state that it led to, and what the observation needs of it."""
    network.still(s, n)
    seat.look(s, window, c, f, table, paid, flags, count, mask, first, n)
    wires.look(s, window, f, table, n)
