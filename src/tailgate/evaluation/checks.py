"""One act: play something again and compare.

Rows (`leaderboard verify`), cells of a board (`check`), figures of detection (`check --detection`) and policies (`retrain`) share it. Names
in a claim are read and never run: registered names, the zoo, and files. A claim that cannot be played here is `unchecked`, which is neither
equal nor wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from tailgate.base import sizes
from tailgate.base.errors import InputError
from tailgate.base.reading import YAML_ENDS
from tailgate.core.draws import constants
from tailgate.core.registry import Family, Spec

LAST_BITS = "only: decisions and figures agree, as between two platforms whose last bits differ"
Data = dict[str, Any]
Thing = TypeVar("Thing", bound=Hashable)
Job = TypeVar("Job")
Result = TypeVar("Result")


class Unplayable(Exception):
    """Raised with the reason by what prepares something that cannot be played here."""


@dataclass
class Finding:
    """The verdict on one thing. `differences`: field, the claim's value, and the value here; `here`: the result, if it was played."""

    verdict: str
    why: str = ""
    differences: list[Data] = field(default_factory=list)
    here: Any = None


def again(
    things: Iterable[Thing], prepare: Callable[[Thing], Job], play: Callable[[Mapping[Thing, Job]], Iterable[tuple[Thing, Result]]],
    compare: Callable[[Thing, Result], Finding],
) -> dict[Thing, Finding]:  # fmt: skip
    """Play things again and compare them with what is claimed of them; return a finding for each, in their order.

    Parameters
    ----------
    prepare
        Returns how to play a thing. Whatever it raises is the reason why the thing is `unchecked`: a claim can hold anything.
    play
        Plays all that was prepared, in any order.
    compare
        Compares a thing with what came out.
    """
    found: dict[Thing, Finding] = {}
    jobs: dict[Thing, Job] = {}
    order = list(things)
    for thing in order:
        try:
            jobs[thing] = prepare(thing)
        except Exception as error:
            why = str(error) if isinstance(error, InputError | Unplayable) else f"{type(error).__name__}: {error}"
            found[thing] = Finding("unchecked", why)
    for thing, result in play(jobs):
        found[thing] = compare(thing, result)
    return {thing: found[thing] for thing in order}


def drawn(things: Sequence[Thing], sample: int | None, seed: int, act: str) -> list[Thing]:
    """Return a number of the things, in their order; all where no number is asked for, or a larger one. `act` names the random stream."""
    if sample is not None:
        sizes.check("sample", sample)
    if sample is None or sample >= len(things):
        return list(things)
    order = constants(act, seed).uniform((len(things),))[0].argsort()
    return [things[i] for i in sorted(int(i) for i in order[:sample])]


def differences(
    names: Iterable[str], claim: Mapping[str, Any], here: Mapping[str, Any], same: Callable[[Any, Any], bool], claimed: str
) -> list[Data]:
    """Return the fields in which a claim differs from what came out: `field`, what the claim says (named `claimed`), and `here`."""
    return [
        {"field": name, claimed: claim.get(name), "here": here.get(name)} for name in names if not same(claim.get(name), here.get(name))
    ]


def counts(findings: Iterable[Finding], verdicts: Sequence[str]) -> dict[str, int]:
    """Return how many findings have each verdict."""
    every = [finding.verdict for finding in findings]
    return {verdict: every.count(verdict) for verdict in verdicts}


def sampling(sample: int | None, seed: int) -> Data:
    """Return what a report says of its sample: a seed only where there is one."""
    return {"sample": sample} | ({} if sample is None else {"sample_seed": seed})


def files_of(spec: Spec) -> list[Path]:
    """Return the files that a component's text names."""
    head, params = spec._parts()
    named = [head] if spec.family == "attack" and Path(head).suffix in (".json", *YAML_ENDS) else []
    path, policy = params.get("path"), params.get("policy")
    named += [path] if isinstance(path, str) and Path(path).suffix in (".json", *YAML_ENDS) else []
    named += policy if isinstance(policy, list) else [policy] if policy is not None else []
    return [Path(str(name)) for name in named]


def refused(family: Family, text: str) -> str:
    """Return why a component that a board names is not played here; empty where it is."""
    spec = Spec(family, text)
    if spec.foreign or spec.sandboxed:
        return f"the {family} {text!r} is code to import, which a board may not make us do"
    return f"the {family}'s file is not here" if any(not path.is_file() for path in files_of(spec)) else ""
