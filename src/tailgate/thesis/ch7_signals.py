"""Table 7.1: which signals are to be trusted, by the thesis's reading and by what the automata say."""

from __future__ import annotations

from collections.abc import Iterator

from tailgate.trust.automata import Atom, load_network
from tailgate.trust.taint import one_hop, signals, table

from .ch7_automata import NETWORK
from .claims import Claim, Part, Table, verdict

UNTRUSTED = ("obs_detect!", "obs_detect?")  # in the thesis


def parts() -> Iterator[Part]:
    """Return claims and a table on the signals."""
    network = load_network(NETWORK)
    rows, direct = table(network), one_hop(network)
    reached = [row.sync for row in rows if row.transitive]
    literal = one_hop(network.with_edge("monitor", "warning", "safe", guard=(Atom("clk_p", "<=", 4.0),)))
    found = {
        "a guard on sensor state, and who hears it": sorted(direct),
        "the same where clk_p <= 4 is a guard, as section 7.4 words it": sorted(literal),
    }
    yield Claim(
        "table-7.1", "obs_detect! and obs_detect? are untrusted, the six other signals are trusted", list(UNTRUSTED), found,
        verdict(direct == literal == set(UNTRUSTED), set(UNTRUSTED) not in (direct, literal)),
        "reproduced by one hop where clk_p <= 4 is an invariant; as a guard it is on sensor state as well, and obs_clear falls with it",
    )  # fmt: skip
    trusted = [sync for sync in signals(network) if sync not in UNTRUSTED]
    wrong = [sync for sync in trusted if sync in reached]
    yield Claim(
        "table-7.1-transitive", "The other signals do not depend on bad states", trusted, {"on sensor state": wrong, "of": len(trusted)},
        verdict(not wrong, len(wrong) == len(trusted)),
        "reachability in the declaration: a false alarm moves the controller, which moves the actuator; all eight follow from clk_p",
    )  # fmt: skip
    cells = tuple((r.sync, _word(r.sync in UNTRUSTED), _word(r.one_hop), _word(r.transitive), " -> ".join(r.path)) for r in rows)
    yield Table("Table 7.1 again", ("signal", "thesis", "one hop", "transitive", "how sensor state gets there"), cells)


def _word(untrusted: bool) -> str:
    return "untrusted" if untrusted else "trusted"
