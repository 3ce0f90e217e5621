"""An architecture as a model of the probabilistic model checker PRISM, and its questions as PRISM's properties (docs/automata.md)."""

from __future__ import annotations

from pathlib import Path

from tailgate.base.files import write_atomic
from tailgate.trust.ctmc import Architecture

_WORDS = """
A bool clock const ctmc C double dtmc E endinit endinvariant endmodule endobservables endrewards endsystem false formula filter func F
global G init
invariant I int label max mdp min module X nondeterministic observable observables of Pmax Pmin P pomdp popta probabilistic prob pta
rate rewards Rmax Rmin R S stochastic system true U W
"""
KEYWORDS = frozenset(_WORDS.split())


def _names(made: Architecture) -> dict[str, str]:
    """Return a name for each node that PRISM does not keep for itself, none twice."""
    out: dict[str, str] = {}
    for node in made.nodes:
        name = node.name
        while name in KEYWORDS or name in out.values():
            name += "_"
        out[node.name] = name
    return out


def _number(value: float) -> str:
    return repr(float(value))


def model(made: Architecture) -> str:
    """Return the model: one module a node, with a rate to be exploited where it can be reached, and one to be patched."""
    names, out = _names(made), ["ctmc", "", f"// {made.name}; rates in 1/{made.unit}"]
    for node in made.nodes:
        name = names[node.name]
        near = [f"{names[other]}=1" for other in dict.fromkeys(made.neighbours(node.name))]
        reach = "" if node.entry else f" & ({' | '.join(near) or 'false'})"
        out += ["", f"module m_{name}", f"  {name} : [0..1] init 0;"]
        if node.exploit > 0.0:
            out.append(f"  [] {name}=0{reach} -> {_number(node.exploit)} : ({name}'=1);")
        if node.patch > 0.0:
            out.append(f"  [] {name}=1 -> {_number(node.patch)} : ({name}'=0);")
        out.append("endmodule")
    out.append("")
    out += [f'label "{route.name}" = {" | ".join(f"{names[name]}=1" for name in route.through)};' for route in made.messages]
    return "\n".join(out) + "\n"


def properties(made: Architecture) -> str:
    """Return the properties: the long-run share of each message, then the probability of each query."""
    out = [f'S=? [ "{route.name}" ]' for route in made.messages]
    return "\n".join(out + [f'P=? [ F<={_number(query.within)} "{query.message}" ]' for query in made.queries]) + "\n"


def write_prism(made: Architecture, path: Path) -> tuple[Path, Path]:
    """Write the model to `path` and the properties next to it, with the ending .props; return both paths."""
    other = path.with_suffix(".props")
    write_atomic(path, model(made).encode())
    write_atomic(other, properties(made).encode())
    return path, other
