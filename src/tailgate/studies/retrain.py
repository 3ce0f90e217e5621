"""A policy trained again, as its file says it was: the same weights, or not."""

from __future__ import annotations

import dataclasses
import hashlib
import tempfile
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal, NamedTuple

from tailgate.agents.learners.learning import Progress, made_with
from tailgate.agents.policy.network_policy import load_policy
from tailgate.base.errors import InputError
from tailgate.core.registry import Spec
from tailgate.core.schema import as_data
from tailgate.evaluation.checks import Finding, again
from tailgate.training import train

from .collect import packed
from .policies import Trained, scenario_of, trained

Verdict = Literal["same", "differs", "unchecked"]
# of a policy's file: what it sees, and how its outputs become an attack. Older files do not say `agents`
HEADER = ("action", "observation", "knowledge", "sees_measurement", "frames", "layers", "squashed", "masked", "recurrent", "greedy")


class Again(NamedTuple):
    """The verdict on one policy; `sha256` of its weights as they are shared, and of those that came out here."""

    policy: str
    verdict: Verdict
    why: str = ""
    sha256: str = ""
    here: str = ""
    steps: int = 0


def retrain(text: str, progress: Callable[[train.TrainConfig, Progress], None] | None = None) -> Again:
    """Train the policy of a JSON file, or of the zoo (`zoo:name=NAME`), once more with its configuration and seed, in a temporary folder.

    A record is read and never run. It cannot be checked if it names code to import, a scenario that is not built in, or another version
    of a defence. The reason is then returned. Weights are the same to the last bit on one machine type with the versions
    of constraints.txt. PPO and others that use torch may differ elsewhere, and `why` names the differences.
    """
    def play(jobs: Mapping[str, tuple[Trained, train.TrainConfig]]) -> Iterator[tuple[str, Again]]:
        for name, (who, config) in jobs.items():
            yield name, _trained_again(who, config, progress)

    finding = again([text], _prepared, play, lambda _, made: Finding(made.verdict, made.why, here=made))[text]
    return finding.here or Again(text, "unchecked", finding.why)


def _prepared(text: str) -> tuple[Trained, train.TrainConfig]:
    who = trained(text)
    return who, _config(who)


def _trained_again(who: Trained, config: train.TrainConfig, progress: Callable[[train.TrainConfig, Progress], None] | None) -> Again:
    """Train a policy in a temporary folder, and compare its weights with those of its file."""
    text, there = who.text, who.header.sha256
    with tempfile.TemporaryDirectory(prefix="tailgate-retrain-") as folder:
        config = dataclasses.replace(config, out=folder)

        def told(seed: int, now: Progress) -> None:
            if progress is not None:
                progress(config, now)

        try:
            (path,) = train.train(config, told)
        except (InputError, ImportError) as error:  # a learner that is not installed, a field that this version does not know
            return Again(text, "unchecked", str(error), there)
        made, _ = load_policy(path)
        here = made.sha256
        if "source_sha256" in who.header.training:  # of the zoo, whose weights are packed: these, as the record might claim any hash
            here = hashlib.sha256(packed(path.with_name(made.tensors))).hexdigest()
    steps = int(made.training["steps"])
    if off := [name for name in HEADER if as_data(getattr(made, name)) != as_data(getattr(who.header, name))]:
        return Again(text, "differs", f"{', '.join(off)}: not what its training gives it", there, here, steps)
    if here == there:
        return Again(text, "same", "", there, here, steps)
    return Again(text, "differs", f"weights {there[:12]} there, {here[:12]} here; {_unlike(who)}", there, here, steps)


def _unlike(who: Trained) -> str:
    """Say in which versions the training of a policy's file differs from one here."""
    held, here = who.header.training.get("made_with"), made_with(who.learner)
    if not isinstance(held, dict):
        return "not recorded what it was trained with"
    differing = [f"{key} {str(held.get(key, 'none'))[:40]} there, {mine} here" for key, mine in here.items() if held.get(key) != mine]
    return "; ".join(differing) or "the same versions and instructions"


def _config(who: Trained) -> train.TrainConfig:
    """Return the training as the policy's file records it, of the one seed. Raises InputError where it cannot be repeated here."""
    where, record = f"policy {who.name}: training", who.header.training
    held = record.get("config")
    if not isinstance(held, dict) or who.seed is None:
        raise InputError(where, record.get("seed"), "the configuration and the seed of a training")
    scenario_of(who)
    config = train.recorded(held)
    spec = Spec("defence", config.defence)
    recorded = str(record.get("defence_digest", "")), record.get("defence_version", 1)
    if recorded != (spec.digest, spec.entry.version):
        meant = f"version {recorded[1]}, digest {recorded[0] or 'none'}, which is not what is here"
        raise InputError(f"{where}.defence", config.defence, meant)
    one = dataclasses.replace(config, first_seed=who.seed, seeds=1, workers=1, tensorboard=False)
    return dataclasses.replace(one, device=None, teacher=_teacher(record, config))


def _teacher(record: dict[str, Any], config: train.TrainConfig) -> str | None:
    """Return the script that was shown: where the best of the rivals was, the record names it, which saves choosing it again."""
    held = record.get("teacher", config.teacher)
    return held if held is None or isinstance(held, str) else config.teacher
