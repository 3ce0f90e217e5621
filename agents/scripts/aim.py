"""The wires and agents that an attack aims at, and the check that the threat model grants them."""

from collections.abc import Iterable

import numpy as np

from tailgate.base.errors import NotApplicable, unknown
from tailgate.core import Array
from tailgate.core.threat import Brief


def chosen(brief: Brief, names: tuple[str, ...], default: Array, agents: tuple[int, ...] = (), where: str = "attack ") -> Array:
    """Return (N, w) bool: the wires in `names`, or else `default` (w,) or (N, w), of `agents`, or else of all that are granted.

    Raises InputError for a wire that the model has not, NotApplicable for an agent; `where` is what the fields' names begin with.
    """
    model = brief.model
    for name in names:
        if name not in model.wires:
            raise unknown(f"{where}targets", name, model.wires)
    for i in agents:
        if i >= model.agents:
            raise NotApplicable(f"{where}agents", i, f"an agent's number, from 0 to {model.agents - 1}")
    some = np.asarray(np.isin(np.arange(model.agents), agents) if agents else np.any(brief.granted, axis=1))
    if agents and default.ndim == 2:  # named agents are aimed at even where not granted: `require` then raises
        default = np.any(default, axis=0)
    return np.asarray(some[:, None] & (np.array([w in names for w in model.wires]) if names else default))


def require(brief: Brief, attack: str, kinds: Iterable[str] = (), target: Array | None = None) -> None:
    """Raise NotApplicable unless the threat model grants every one of `kinds` and the wires of `target` (N, w)."""
    threat = brief.threat
    for kind in kinds:
        if kind not in threat.kinds:
            raise NotApplicable(f"{attack}: threat_model.kinds", list(threat.kinds), f"a threat model that grants {kind}")
    beyond = np.zeros_like(brief.granted) if target is None else target & ~brief.granted
    if beyond.any():
        missing = [name for name, m in zip(brief.model.wires, np.any(beyond, axis=0).tolist(), strict=True) if m]
        granted = [name for name, g in zip(brief.model.wires, np.any(brief.granted, axis=0).tolist(), strict=True) if g]
        strangers = np.flatnonzero(beyond.any(axis=1) & ~brief.granted.any(axis=1)).tolist()
        whose = f" of agents {', '.join(map(str, strangers))}" if strangers else ""
        raise NotApplicable(f"{attack}: threat_model.targets", granted, f"a threat model that grants {', '.join(missing)}{whose}")
