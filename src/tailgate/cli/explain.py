"""tailgate explain: what the engine can trace, and where not, why."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from tailgate.cli.shared import Commands, own_classes, show, table

if TYPE_CHECKING:
    from tailgate.engine.agreement import Untraced
    from tailgate.engine.program import Program
    from tailgate.engine.remembered import Programs


def add(commands: Commands) -> None:
    """Add `explain` to the commands."""
    command = commands.add_parser(
        "explain", help="whether a scenario, a defence and an attack are traced, and if not, why",
        description="Say whether the engine can trace environments of a scenario and a defence, and, with an attack, whole episodes. "
        "Where it cannot, the line and what to write in its place are named (docs/engine.md).",
    )  # fmt: skip
    command.add_argument("what", choices=["engine"], help="what is explained")
    command.add_argument("--scenario", metavar="NAME", help="name or YAML file (default: stop-and-go-v0)")
    command.add_argument("--defence", metavar="NAME", help="name or module:Class (default: chi2_kf)")
    command.add_argument("--attack", metavar="NAME", help="also whole episodes under this attack")
    command.add_argument("--json", action="store_true", help="print JSON")
    command.set_defaults(run=_explain)


def _explain(options: argparse.Namespace) -> int:
    own_classes()
    found = explanation(options.scenario, options.defence, options.attack)
    rows = [(what, "no" if "why" in said else "yes", said.get("why") or said["size"]) for what, said in found.items()]
    show(options, found, lambda _: table(("what", "traced", "why not, or how large"), rows))
    return 0


def explanation(scenario: str | None, defence: str | None, attack: str | None) -> dict[str, dict[str, str]]:
    """Return for each thing that is played `why` it cannot be traced, or the `size` of its code."""
    from tailgate.core.registry import Spec
    from tailgate.engine.agreement import Untraced
    from tailgate.envs.gym.attacker_mdp import Seat
    from tailgate.envs.gym.programs import programs_of
    from tailgate.play.commanded import commanded
    from tailgate.play.rollouts import rollout_of

    seat = Seat.make(scenario, defence)
    made: dict[str, Programs | Untraced] = {"environments": programs_of(seat)}
    if attack is not None:
        attacker = Spec("attack", attack).make()
        attacker.prepare(seat.loop.brief)  # raises if it does not fit
        made |= {"episodes": commanded(seat.loop), "episodes, attack included": rollout_of(seat.loop, attacker)}
    return {what: {"why": held.why} if isinstance(held, Untraced) else _size(held.programs[0]) for what, held in made.items()}


def _size(program: Program) -> dict[str, str]:
    size, memory = program.size, program.stride // program.lanes
    return {"size": f"{size['nodes']} operations, {size['branches']} branches, {memory} bytes an episode"}
