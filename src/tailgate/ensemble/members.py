"""The members of the standard attack ensemble: each looks for attacks in its own way, and may begin where another ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tailgate.agents.policy.zoo import zoo_names
from tailgate.base.errors import InputError, NotApplicable
from tailgate.core import Array
from tailgate.core.registry import Spec, entries
from tailgate.core.schema import fields_of
from tailgate.engine.untraceable import Untraceable
from tailgate.ensemble.climb import Climb, Stage, climbed
from tailgate.ensemble.gradient import Pace, gradient
from tailgate.ensemble.networks import FORMS, PUBLISHED, Phase, Race, is_ramp, learned, transferred
from tailgate.ensemble.points import Points
from tailgate.ensemble.published import found_against_others
from tailgate.ensemble.search import FINALISTS, Arena, Effort, Found, Meaningless, Tell, search

ALIKE = 2  # finalists of a family: others may come from behind
IMITATED = 2  # scripts that networks imitate at the start
OPENED = (0.1, 0.25, 0.5, 0.75)  # of the range of gaps: where white boxes begin
STARTS = len(FORMS) * (2 + IMITATED) + 4 + PUBLISHED  # of a race of policies, at most: four move a value step by step
GREY = 3  # starts of the race of those that know the control too: the best of the race of the others


@dataclass(frozen=True)
class Budget:
    """The size of each member's search."""

    scripts: Effort
    programs: Effort
    climb: Climb  # of feedback, and of segments
    ghosts: Climb
    population: int  # of a generation of policies
    phases: tuple[tuple[int, int], ...]  # of the race of policies: generations, and episodes of each member
    pace: Pace  # of the gradient attack

    @property
    def race(self) -> Race:
        """The search of policies."""
        return Race(self.population, tuple(Phase(*phase) for phase in self.phases))

    def episodes(self, agents: int, whole: bool = True, traced: bool = True) -> int:
        """Return the episodes that all members play in a scenario, about; those that do not learn unless `whole`."""
        race = self.race if traced else self.race.shorter()
        races = race.episodes(STARTS, agents) + race.episodes(GREY + PUBLISHED, agents)
        scripts = self.scripts.episodes(agents) + self.programs.episodes(agents) + 2 * self.climb.sized(agents, traced).episodes
        return scripts + (races if whole else 0)


BUDGETS = {
    "quick": Budget(
        Effort(512, 5), Effort(256, 4), Climb(8192, (Stage(8, 12), Stage(4, 12), Stage(2, 24))),
        Climb(640, (Stage(20, 6),)), 32, ((16, 16), (12, 32), (24, 64)), Pace(256, 1, 8, 64),
    ),
    "standard": Budget(
        Effort(2048, 12), Effort(1024, 10), Climb(32768, (Stage(16, 16), Stage(8, 32), Stage(4, 64))),
        Climb(2560, (Stage(40, 12),)), 64, ((40, 32), (40, 64), (60, 128)), Pace(2048, 2, 20, 128),
    ),
}


@dataclass
class Hunt:
    """A search of all members against a defence in one scenario at one dose."""

    arena: Arena
    budget: Budget
    seed: int
    folder: Path  # of the files that attacks need
    tell: Tell | None = None
    only: tuple[str, ...] = ()  # members that search; empty: all
    genomes: Array | None = None  # of the best scripts
    starts: list[str] = field(default_factory=list)  # of the black-box networks, the best first
    found: dict[str, list[Found]] = field(default_factory=dict)  # by member

    @property
    def best_scripts(self) -> list[str]:
        """The best scripts so far, each of another family; and the best ramp."""
        out: dict[str, str] = {}
        for one in self.found.get("scripts", []):
            out.setdefault(one.attack.partition(":")[0], one.attack)
        return list(dict.fromkeys([*list(out.values())[:IMITATED], *filter(is_ramp, out.values())]))[: IMITATED + 1]


def _scripts(hunt: Hunt) -> list[str]:
    """Search scripts of every family."""
    space = hunt.arena.space
    hunt.genomes = search(hunt.arena, space, hunt.budget.scripts, hunt.seed, first=space.rhythms, tell=hunt.tell)
    out: dict[str, list[str]] = {}
    for genome in hunt.genomes:
        mine = out.setdefault(space.family(genome).name, [])
        if len(mine) < ALIKE and (text := space.text(genome)) not in mine:
            mine.append(text)
    return [text for mine in out.values() for text in mine][:FINALISTS]


def _programs(hunt: Hunt) -> list[str]:
    """Search programs of two phases, at first around the best scripts."""
    arena, space = hunt.arena, hunt.arena.programs
    rng = np.random.default_rng([hunt.seed, 2])
    first = space.around(arena.space, hunt.genomes, rng) if hunt.genomes is not None and space.families else None
    found = search(arena, space, hunt.budget.programs, hunt.seed, first=first, tell=hunt.tell)
    return [space.text(genome, hunt.folder) for genome in found[:FINALISTS]]


def _feedback(hunt: Hunt) -> list[str]:
    """Search values that follow the road, of every kind."""
    return _climbed(hunt, hunt.arena.feedbacks)


def _segments(hunt: Hunt) -> list[str]:
    """Search lies one after the other, of every kind with a value."""
    if hunt.arena.space.budget < 2:
        raise Meaningless("dose", hunt.arena.space.budget, "2 attacked steps or more: feedback searches single ones")
    return _climbed(hunt, hunt.arena.segments)


def _ghosts(hunt: Hunt) -> list[str]:
    """Search the readings of a second state, of every size and growth."""
    if hunt.arena.space.road:
        raise Meaningless("scenario", hunt.arena.name, "one where nobody drives: segments and feedback search what lasts on a road")
    return climbed(hunt.arena, hunt.arena.ghosts, hunt.budget.ghosts, hunt.seed, hunt.tell)


def _climbed(hunt: Hunt, space: Points) -> list[str]:
    if not hunt.arena.space.road:
        raise Meaningless("scenario", hunt.arena.name, "one with a road: nobody drives here")
    return climbed(hunt.arena, space, hunt.budget.climb, hunt.seed, hunt.tell)


def _policies(hunt: Hunt, knowledge: str) -> list[str]:
    """Learn networks; those that know more than the road begin as the best of the others did."""
    found = learned(
        hunt.arena, knowledge, hunt.best_scripts, hunt.budget.race, hunt.seed, hunt.folder, hunt.tell, hunt.starts[:GREY],
        [one.attack for one in hunt.found.get("transfer", [])],
    )  # fmt: skip
    hunt.starts = hunt.starts or found.starts
    return found.attacks


def _transfer(hunt: Hunt) -> list[str]:
    """Play the policies of the zoo that have a meaning here, and what a published board found here against other defences."""
    found = transferred(hunt.arena) + found_against_others(hunt.arena, hunt.folder / "published")
    if not found:
        raise Meaningless("zoo", f"{len(zoo_names())} policies", "one with the observations and the actions of this threat model")
    return hunt.arena.promising(found)


def _white_box(hunt: Hunt) -> list[str]:
    """Play the attacks that know the defence's state: at once, and from several gaps on."""
    out, (low, high) = [], hunt.arena.space.road.get("near", (0.0, 0.0))
    opened = [f"trigger=near,threshold={low + share * (high - low):.4g}" for share in OPENED] if high > low else []
    for name, entry in entries("attack").items():
        if entry.knowledge != "white" or entry.optimal:  # a computed optimum is a ceiling, and counts for no rank
            continue
        for text in (name, *(f"{name}:{words}" for words in opened if "trigger" in fields_of(entry.cls))):
            try:
                attack = Spec("attack", text).make()
                attack.prepare(hunt.arena.seat("white", attack).brief)
            except (NotApplicable, InputError):
                continue
            out.append(text)
    return hunt.arena.promising(out)


def _gradient(hunt: Hunt) -> list[str]:
    """Follow the derivatives of the closed loop, from the best scripts of false data."""
    scripts = [one.attack for one in hunt.found.get("scripts", []) if one.attack.partition(":")[0] in ("fdi", "fdi_ramp")]
    return [one.attack for one in gradient(hunt.arena, hunt.budget.pace, hunt.folder / "programs", hunt.seed, hunt.tell, scripts)]


class Member(NamedTuple):
    """A way to find attacks, and what the attacks know."""

    name: str
    knowledge: str
    find: Callable[[Hunt], list[str]]  # attacks as on the command line
    share: int  # of the time of a search, about, in percent
    learns: bool = False


MEMBERS = (
    Member("scripts", "black", _scripts, 7),
    Member("programs", "black", _programs, 7),
    Member("feedback", "black", _feedback, 10),
    Member("segments", "black", _segments, 10),
    Member("ghosts", "black", _ghosts, 3),
    Member("transfer", "black", _transfer, 1),
    Member("networks", "black", lambda hunt: _policies(hunt, "black"), 42, learns=True),
    Member("grey networks", "grey", lambda hunt: _policies(hunt, "grey"), 26, learns=True),
    Member("white box", "white", _white_box, 3),
    Member("gradient", "white", _gradient, 4, learns=True),
)


class Harvest(NamedTuple):
    """The attacks that a member found, the most harmful first; or the reason why it has no meaning here."""

    member: str
    knowledge: str
    found: list[Found]
    why: str = ""


def _share(tell: Tell, members: Sequence[Member], number: int) -> Tell:
    """Return a function that counts the steps of one member as a part of the whole search, in percent."""
    before, whole = (sum(member.share for member in some) for some in (members[:number], members))
    own = members[number].share
    return lambda done, total, text, mean: tell(int(100 * (before + own * done / total) / whole), 100, text, mean)


def members_of(hunt: Hunt) -> list[Member]:
    """Return the members that search, in order."""
    return [one for one in MEMBERS if not hunt.only or one.name in hunt.only]


def harvest(hunt: Hunt, before: Sequence[Harvest] = (), after: Callable[[list[Harvest]], None] | None = None) -> list[Harvest]:
    """Let every member search that is asked for; return what each found. `hunt.tell` is called with the share of the whole search.

    before: what the first members have found already; after: called behind each member with what is found by then.
    """
    out, tell = list(before), hunt.tell
    searching = members_of(hunt)
    for number, member in enumerate(searching[len(out) :], len(out)):
        hunt.tell = None if tell is None else _share(tell, searching, number)
        found, why = [], ""
        try:
            found = hunt.arena.best(member.find(hunt))
            why = "" if found else "the threat model grants nothing for it"
        except (Meaningless, ImportError, Untraceable) as error:  # not traced: no derivative. An error of the defence ends the search
            why = str(error)
        hunt.found[member.name] = found
        out.append(Harvest(member.name, member.knowledge, found, why))
        if after is not None:
            after(out)
    return out
