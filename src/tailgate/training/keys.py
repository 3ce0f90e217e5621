"""All keys of the configurations of a training and of self-play, with their defaults: what --help lists."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias

from tailgate.agents.learners import cem
from tailgate.agents.learners.learning import LEARNERS, learner_of
from tailgate.core.schema import as_data, fields_of
from tailgate.core.threat import ThreatModel
from tailgate.envs.gym.actions import ActionSpec
from tailgate.envs.gym.duel import Payoff
from tailgate.envs.gym.observations import ObservationCodec
from tailgate.envs.gym.rewards import Reward
from tailgate.estimators.challenge.steering import Menu
from tailgate.training import selfplay, train
from tailgate.training.settings import parameters_of

Fields: TypeAlias = tuple[str, list[dict[str, Any]]]  # a note, and what `parameters_of` returns
SCENARIO = "a scenario may grant other things than these defaults"


class Key(NamedTuple):
    """One key, dotted; values are JSON data."""

    name: str
    doc: str
    used: Any  # by the preset that a bare command takes
    default: Any  # in a preset that leaves it out


class Place(NamedTuple):
    """The keys of a configuration itself (name: empty), or below one of its mappings."""

    name: str
    doc: str
    keys: tuple[Key, ...]


def train_keys() -> list[Place]:
    """Return all keys of `tailgate train`. A learner whose extra is missing has none, and says so."""
    below: dict[str, Fields] = {}
    for name in LEARNERS:
        try:
            below[name] = "", parameters_of(learner_of(name).Config)
        except ImportError:
            below[name] = "they are listed where tailgate[train] is installed", []
    return _places(train.parameters(), train.bare(), below | _shared())


def selfplay_keys() -> list[Place]:
    """Return all keys of `tailgate selfplay`; those of the attacker are of the learner that it has by default."""
    menu = [field for field in parameters_of(Menu) if field["name"] != "interval"]  # environment.interval takes its place
    learner = "those of cem, the default; `tailgate train --help` has those of the other learners"
    below = {
        "menu": ("", menu), "payoff": ("", parameters_of(Payoff)),
        "attacker": (learner, parameters_of(cem.Config)), "defender": ("", parameters_of(cem.Config)),
    }  # fmt: skip
    return _places(selfplay.parameters(), selfplay.bare(), below | _shared())


def _shared() -> dict[str, Fields]:
    """Return the fields of the environment and of the threat model."""
    fields = [field for kind in (ActionSpec, Reward) for field in parameters_of(kind)]
    one = fields_of(ObservationCodec)["frames"].default
    frames = {"name": "frames", "doc": "decisions that the observation shows at once", "default": one}
    environment = [field for field in [*fields, frames] if field["name"] in train.ENVIRONMENT]
    return {"environment": ("", environment), "threat": (SCENARIO, parameters_of(ThreatModel))}


def _places(
    fields: Iterable[dict[str, Any]], preset: Mapping[str, Any], below: Mapping[str, Fields],
) -> list[Place]:  # fmt: skip
    """Return the fields, those that are mappings of other fields (below: a note and the fields) behind the others."""
    fields = list(fields)
    out = [Place("", "", _keys("", [field for field in fields if field["name"] not in below], preset))]
    docs = {field["name"]: field["doc"] for field in fields}
    for name in [*(name for name in docs if name in below), *(name for name in below if name not in docs)]:
        (note, inner), doc = below[name], docs.get(name, "hyper-parameters")
        out.append(Place(name, f"{doc}; {note}" if note else doc, _keys(f"{name}.", inner, preset.get(name, {}))))
    return out


def _keys(prefix: str, fields: Iterable[dict[str, Any]], preset: Mapping[str, Any]) -> tuple[Key, ...]:
    return tuple(
        Key(f"{prefix}{name}", field["doc"], as_data(preset.get(name, field["default"])), field["default"])
        for field in fields for name in [field["name"]]
    )  # fmt: skip
