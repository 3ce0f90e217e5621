"""The channel of several agents."""

import numpy as np
import pytest

from tailgate.base.errors import InputError
from tailgate.core import Command, Kind, Received
from tailgate.core.channel import Channel
from tailgate.core.scenario import load_scenario
from tailgate.core.threat import Brief, ThreatModel

ALL = ("dos_jam", "dos_hold", "dos_hold_fresh", "dropout", "fdi", "delay", "replay")

CARS = load_scenario("platoon-braking-v0").brief().model  # 5 agents; wires: 3 sensors, 3 V2V fields, the acceleration command

FIRST = np.arange(35.0).reshape(1, 5, 7)  # what is expected at the prior, and the first input


class Wires:
    """A channel of five agents in one episode, stepped by hand: agent i sends 100 k + 10 i + wire / 10 at step k."""

    def __init__(self, **threat):
        self.plan = Channel().prepare(Brief(CARS, ThreatModel(**({"kinds": ALL, "targets": CARS.wires} | threat)), 1000))
        self.state = Channel().start(self.plan, FIRST[..., :6].copy(), FIRST[..., 6:].copy())
        self.k = 0

    @staticmethod
    def sent(k):
        return 100.0 * k + 10.0 * np.arange(5)[:, None] + np.arange(7) / 10.0

    def step(self, kind=Kind.NONE, targets=(), value=0.0):
        """-> wires (5, 7), valid (5, 3), refused; targets are pairs (agent, wire), value has one number for each."""
        self.k += 1
        target, values = np.zeros((1, 5, 7), bool), np.zeros((1, 5, 7))
        for (i, w), number in zip(targets, np.broadcast_to(value, len(targets)), strict=True):
            target[0, i, w], values[0, i, w] = True, number
        wires = self.sent(self.k)[None]
        received = Received(wires[..., :3].copy(), np.ones((1, 5, 3), bool), np.zeros((1, 5)))
        command = Command(np.array([kind], np.int8), target, values)
        self.state, out, links, refused = Channel().apply(self.plan, self.state, wires[..., :6].copy(), received, command, np.array([self.k]))
        np.testing.assert_array_equal(out.attacked, target[..., :3] & ~refused)
        self.state, applied = Channel().actuate(self.plan, self.state, wires[..., 6:].copy())
        return np.concatenate([links[0], applied[0]], axis=-1), out.valid[0], bool(refused[0])


def test_a_command_on_an_agent_that_is_not_granted_is_refused():
    """One agent too many refuses the whole command, on any of its wires; without `agents` all are granted, and only those that exist."""
    for agent, wire in ((i, w) for i in (0, 1, 3, 4) for w in (0, 4, 6)):
        held = Wires(agents=(2,))
        for targets in ([(agent, wire)], [(2, 0), (agent, wire)]):
            wires, valid, refused = held.step(Kind.FDI, targets, 1.0)
            assert refused and valid.all() and held.state.used == 0 and (wires == held.sent(held.k)).all()
        wires, _, refused = held.step(Kind.FDI, [(2, wire)], 1.0)
        assert not refused and np.argwhere(wires != held.sent(held.k)).tolist() == [[2, wire]]
        assert not Wires().step(Kind.FDI, [(agent, wire)], 1.0)[2]


def test_a_step_is_charged_once_however_many_agents_it_hits():
    """The budget counts steps."""
    held, every = Wires(budget=2), [(i, w) for i in range(5) for w in range(7)]
    assert [held.step(Kind.FDI, every, 1.0)[2] for _ in range(4)] == [False, False, True, True]


def test_each_agent_has_its_own_memory():
    """Holds, losses, delays and replays repeat what the same agent sent on the same wire, each with its own age and window."""
    at = [(1, 0), (2, 5), (4, 6)]
    rows, columns = zip(*at, strict=True)

    def played(held, kind, value=0.0):
        (wires, _, refused), others = held.step(kind, at, value), np.ones((5, 7), bool)
        others[rows, columns] = False
        assert not refused and (wires == held.sent(held.k))[others].all()
        return wires[rows, columns].tolist()

    def was(held, *steps):
        return [held.sent(k)[i, w] for k, (i, w) in zip(steps, at, strict=True)]

    assert played(Wires(), Kind.DOS_HOLD) == [FIRST[0, i, w] for i, w in at]
    held = Wires(memory=6)
    _ = [held.step() for _ in range(8)]
    assert played(held, Kind.DELAY, [1.0, 3.0, 6.0]) == was(held, 8, 6, 3)
    held.step(Kind.FDI, [(1, 0)], 5.0)  # step 10: of the three only agent 1 has no good sample then
    assert played(held, Kind.DOS_HOLD_FRESH) == was(held, 8, 10, 10)
    assert played(held, Kind.DOS_HOLD) == was(held, 8, 8, 8)  # the first attack was in step 9
    assert [played(held, Kind.REPLAY, [1.0, 2.0, 3.0]) for _ in range(3)] == [was(held, 12, 11, 10), was(held, 12, 12, 11), was(held, 12, 11, 12)]
    wires, valid, _ = held.step(Kind.DROPOUT, [(3, 1), (0, 2)])
    assert np.argwhere(~valid).tolist() == [[0, 2], [3, 1]] and wires[3, 1] == held.sent(15)[3, 1]


@pytest.mark.parametrize(
    "name, agents, message",
    [
        ("platoon-braking-v0", (1, 5), r"threat_model\.agents: got 5; expected an agent's number, from 0 to 4"),
        ("thesis-ch5-v0", (10,), r"threat_model\.agents: got 10.*from 0 to 9"), ("stop-and-go-v0", (1,), r"agents: got 1.*from 0 to 0"),
        ("platoon-braking-v0", (-1,), r"threat_model\.agents\.0: got -1"), ("platoon-braking-v0", (0.5,), r"threat_model\.agents\.0: got 0\.5"),
    ],
)  # fmt: skip
def test_agents_that_do_not_exist_are_input_errors(name, agents, message, short, loop_of):
    """The field, the number and the range are named before the first step."""
    with pytest.raises(InputError, match=message):
        loop_of(short(name, agents=agents), "kf")
