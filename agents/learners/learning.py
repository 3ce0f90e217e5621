"""The common part of all learners: the configuration's name, the reports, and the file of the policy."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

from tailgate.base.errors import InputError, unknown
from tailgate.base.files import write_atomic
from tailgate.base.lazy import components
from tailgate.base.reading import TENSORS, parse_json, read_bytes, tensors_of

if TYPE_CHECKING:
    from tailgate.agents.learners.teacher import Demonstration
    from tailgate.envs.gym.attacker_mdp import Seat

LEARNERS = tuple(sorted(name for family, name in components("tailgate.agents") if family == "learner"))
SEED_STRIDE = 1_000_000  # between the episodes of two training seeds
DISCRETE, CONTINUOUS = ("timing", "mode", "ramp"), ("continuous", "increment")  # kinds of action


@dataclass(frozen=True)
class Progress:
    """The report of a training run after each round."""

    steps: int
    crash: float | None  # share of collisions in the latest episodes; none also where there is no road
    reward: float | None


class Config(Protocol):
    """Hyper-parameters of a learner: a frozen dataclass of `param` fields."""

    def check(self) -> None:
        """Raise InputError when the fields do not fit each other."""


class BatchConfig(Config, Protocol):
    """Hyper-parameters of a learner that plays a batch of environments."""

    @property
    def envs(self) -> int: ...
    @property
    def learning_rate(self) -> float: ...


class Learner(Protocol):
    """One training run of one seed. Resumed from a checkpoint it gives the policy of an uninterrupted one.

    Register the class with `@register("learner", NAME)`, in a module that also defines its `Config`.
    """

    actions: ClassVar[tuple[str, ...]]  # kinds of action that it can decide on
    packages: ClassVar[tuple[str, ...]]  # on whose versions the last bits of its weights depend
    seat: Seat
    steps: int  # decisions taken so far
    curve: list[dict[str, Any]]

    def learn(self, steps: int, report: Callable[[Progress], None], checkpoint: Path | None = None, every: int = 1_000_000) -> None:
        """Train until `steps` decisions in total, with a checkpoint every `every` of them and one at the end."""

    def load(self, path: Path) -> None:
        """Continue from a checkpoint. Raises InputError when it is damaged or of another run."""

    def export(self, path: Path, training: dict[str, Any]) -> Path:
        """Write the policy as safetensors + JSON; `training` describes how it was made."""

    def close(self) -> None:
        """Free all resources."""


@runtime_checkable
class Teachable(Protocol):
    """A learner that can be shown somebody else's decisions before it learns."""

    def imitate(self, shown: Demonstration) -> None:
        """Make the first policy one that decides as in the demonstration."""


def learner_of(name: str) -> Any:
    """Return the module of a learner, with its classes `Config` and `Learner`. Raise InputError for an unknown name."""
    if name not in LEARNERS:
        raise unknown("learner", name, LEARNERS)
    return import_module(components("tailgate.agents")["learner", name])


def made_with(name: str) -> dict[str, str]:
    """Return all that the last bits of a learner's weights may depend on: the machine type, numpy, and its packages."""
    found = {"machine": platform.machine(), "numpy": version("numpy")}
    packages = learner_of(name).Learner.packages
    if not packages:
        return found
    import torch

    return found | {package: version(package) for package in packages} | {"torch CPU capability": torch.backends.cpu.get_cpu_capability()}


def check_action(name: str, seat: Seat) -> None:
    """Raise InputError when the learner cannot decide on the actions of this seat."""
    action, actions = seat.action.spec.action, learner_of(name).Learner.actions
    if action not in actions:
        raise InputError("learner", name, f"one for the action {action}, or for {name} one of: {', '.join(actions)}")


def write_checkpoint(path: Path, save_tensors: Callable[[Any, dict[str, str]], bytes], tensors: Any, facts: dict[str, Any]) -> None:
    """Write tensors and facts, with a digest of both."""
    text = json.dumps(facts)
    digest = _digest(save_tensors(tensors, {}), text)
    write_atomic(path, save_tensors(tensors, {"facts": text, "sha256": digest}))


def _digest(content: bytes, facts: str) -> str:
    """Return the digest of the numbers in safetensors, which follow a header of a length, and of facts."""
    header = int.from_bytes(content[:8], "little")
    return hashlib.sha256(content[8 + header :] + facts.encode()).hexdigest()


def open_checkpoint(path: Path, wanted: dict[str, Any], load_tensors: Callable[[bytes], Any]) -> tuple[Any, dict[str, Any]]:
    """Return tensors and facts of a checkpoint. Raise InputError when it is damaged, or when its facts are not the `wanted` ones."""
    try:
        content = read_bytes(path, TENSORS)
        tensors, about = tensors_of(content, load_tensors)
        if about.get("sha256", "") not in ("", _digest(content, about["facts"])):
            raise ValueError("another digest")
        facts = parse_json(about["facts"], strict=False)
        held = {key: facts.get(key) for key in wanted}
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise InputError("checkpoint", str(path), f"a checkpoint of this program ({type(error).__name__})") from None
    if held != wanted:
        raise InputError("checkpoint", f"{path}: {held}", f"one of this run: {wanted}")
    return tensors, facts


def header_of(seat: Seat, training: dict[str, Any]) -> dict[str, Any]:
    """Return the JSON of a policy that was trained in this seat, apart from its tensors."""
    threat = seat.loop.threat
    return {
        "action": seat.action.spec, "observation": seat.observation.names, "knowledge": threat.knowledge,
        "sees_measurement": threat.sees_measurement, "frames": seat.observation.frames,
        "agents": seat.loop.model.agents, "training": training,
    }  # fmt: skip
