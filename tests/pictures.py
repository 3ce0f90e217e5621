"""Environments after some steps, plain pictures of them with the regions that differ, and states changed for a picture."""

import numpy as np

from tailgate.core import Kind
from tailgate.envs.gym.gymnasium_env import AdversaryVectorEnv
from tailgate.envs.render import canvas
from tailgate.envs.render import picture as render

HEADER = int(canvas.HEADER)
LEFT_OF_LAMP = int(canvas.LAMP - 2 * canvas.LAMP_SIZE)
TOP = {
    "badge": np.s_[:HEADER, int(canvas.BADGE[0]) : int(canvas.BADGE[1])],
    "budget": np.s_[:HEADER, int(canvas.BUDGET) : LEFT_OF_LAMP], "lamp": np.s_[:HEADER, LEFT_OF_LAMP:],
}  # fmt: skip


def made(rows=1, steps=3, action=0, seed=5, **arguments):
    """A vector environment after some steps."""
    env = AdversaryVectorEnv(rows, render_mode="rgb_array", engine="plain", **arguments)
    env.reset(seed=seed)
    for _ in range(steps):
        env.step(np.full(rows, action))
    return env


def picture(env, state=None, frame=None, row=0):
    return render.plain(env.seat.loop, state or env.state, frame or env.frame, row)


def differ(a, b, regions):
    """Names of the regions that differ, those of the top included."""
    return {name for name, region in (TOP | regions).items() if (a[region] != b[region]).any()}


def with_command(state, kind, value=0.0, at=slice(None)):
    """The state right after a command at some agents and wires."""
    last = state.channel.last
    target = np.zeros_like(last.target)
    target[at] = kind != Kind.NONE
    command = last._replace(kind=np.full_like(last.kind, kind), target=target, value=np.where(target, value, 0.0))
    return state._replace(channel=state.channel._replace(last=command))


def with_estimate(state, **leaves):
    return state._replace(estimate=state.estimate._replace(**leaves))
