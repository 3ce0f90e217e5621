"""tailgate explain: which engine plays something, and why no faster one does."""

from __future__ import annotations

import argparse
import json
import sys
from typing import Any

from rich.markup import escape
from rich.table import Table

from tailgate.progress import console


def add(commands: Any) -> None:
    command = commands.add_parser(
        "explain", help="which engine plays a scenario, a defence and an attack, and why no faster one does",
        description="Say which engines can play environments of a scenario and a defence, and, with an attack, whole episodes. "
        "Where code cannot be traced, the line and what to write in its place are named (docs/engine.md).",
    )  # fmt: skip
    command.add_argument("what", choices=["engine"], help="what is explained")
    command.add_argument("--scenario", metavar="NAME", help="name or YAML file (default: stop-and-go-v0)")
    command.add_argument("--defence", metavar="NAME", help="name or module:Class (default: chi2_kf)")
    command.add_argument("--attack", metavar="NAME", help="also whole episodes under this attack")
    command.add_argument("--json", action="store_true", help="print JSON")
    command.set_defaults(run=_explain)


def _explain(options: argparse.Namespace) -> int:
    sys.path.insert(0, "")  # module:Class is looked for in the working directory, as `tailgate evaluate` does
    found = explanation(options.scenario, options.defence, options.attack)
    if options.json:
        print(json.dumps(found, indent=1))
        return 0
    table = Table("what", "engine", "can it", "why not, or how large")
    for what, engines in found.items():
        for engine, said in engines.items():
            table.add_row(what, engine, "no" if said.get("why") else "yes", escape(said.get("why") or said.get("size", "")))
    console().print(table)
    return 0


def explanation(scenario: str | None, defence: str | None, attack: str | None) -> dict[str, dict[str, dict[str, str]]]:
    """By what is played and by engine: `why` it cannot play, or the `size` of its code."""
    from tailgate.engine.agreement import Untraced
    from tailgate.engine.rollouts import rollout_of
    from tailgate.engine.seats import programs_of
    from tailgate.envs.seat import Seat
    from tailgate.fused import Refused, fuse
    from tailgate.fused.cockpit import fuse_seat
    from tailgate.registry import Spec

    seat = Seat.make(scenario, defence)
    lanes, programs = fuse_seat(seat), programs_of(seat)
    found = {"environments": {"fused": _why(lanes, Refused), "traced": _why(programs, Untraced)}}
    if not isinstance(programs, Untraced):
        found["environments"]["traced"] = _size(programs.decide)
    if attack is not None:
        rival = Spec("attack", attack).make()
        rival.prepare(seat.loop.brief)  # what does not fit says so
        rollout = rollout_of(seat.loop, rival)
        traced = {"why": rollout.why} if isinstance(rollout, Untraced) else _size(rollout.program)
        found["episodes"] = {"fused": _why(fuse(seat.loop, rival), Refused), "traced": traced}
    return found


def _why(held: Any, refused: Any) -> dict[str, str]:
    return {"why": held.why} if isinstance(held, refused) else {}


def _size(program: Any) -> dict[str, str]:
    size, memory = program.size, program.stride // program.lanes
    return {"size": f"{size['nodes']} operations, {size['branches']} branches, {memory} bytes an episode"}
