"""The space of programs: two phases one after the other, each with its family, wires and trigger."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import yaml

from tailgate.base.files import write_atomic
from tailgate.core import Array
from tailgate.core.schema import digest
from tailgate.ensemble.space import GENES, TRIGGERS, Rows, Sequence, Space

HALF = len(GENES)


@dataclass(frozen=True)
class Programs:
    """All programs of two phases that a threat model grants. A genome holds the genes of both phases, then the length of the first."""

    phase: Space  # of each phase

    genes: ClassVar[int] = 2 * HALF + 1
    leads: ClassVar[tuple[int, ...]] = (0, HALF)

    @property
    def families(self) -> tuple[Any, ...]:
        """The families of a phase."""
        return self.phase.families if self.phase.budget > 1 else ()

    def scripts(self, genomes: Array) -> Sequence:
        """Return the programs of genomes (B, genes)."""
        phases = tuple(self.phase.rows(genomes[:, part]) for part in (slice(0, HALF), slice(HALF, 2 * HALF)))
        return Sequence(phases, 1 + np.minimum((genomes[:, -1] * (self.phase.budget - 1)).astype(np.int64), self.phase.budget - 2))

    def label(self, genome: Array) -> str:
        """Return a short text of one program."""
        first, second = (self.phase.text(genome[part]) for part in (slice(0, HALF), slice(HALF, 2 * HALF)))
        return f"{first} ({self.scripts(genome[None]).length[0]} steps), then {second}"

    def text(self, genome: Array, folder: Path | None = None) -> str:
        """Write one program as YAML below `folder`; return its text on the command line."""
        assert folder is not None, "a program is a file"
        sheet = self.sheet(genome)
        path = folder / "programs" / f"{digest(sheet)}.yaml"
        write_atomic(path, yaml.safe_dump(sheet, sort_keys=False).encode())
        return f"program:path={path}"

    def sheet(self, genome: Array) -> dict[str, Any]:
        """Return one program as a mapping, as `tailgate.agents.scripts.program` reads it."""
        scripts = self.scripts(genome[None])
        first, second = (
            self._phase(genome[part], row) for part, row in zip((slice(0, HALF), slice(HALF, 2 * HALF)), scripts.phases, strict=True)
        )
        return {"about": "Found by a search.", "phases": [first | {"length": int(scripts.length[0])}, second]}

    def _phase(self, genome: Array, row: Rows) -> dict[str, Any]:
        family, (names, agent) = self.phase.family(genome), self.phase.sets(genome)
        out: dict[str, Any] = {"kind": family.kind.name.lower()}
        if names and not family.air:
            out["targets"] = list(names)
        if agent is not None:
            out["agents"] = [agent]
        base = float(row.base[0])
        if family.ramp:
            out["value"] = {"name": "ramp", "base": base, "rate": float(row.rate[0]), "limit": self.phase.reach(family.kind)[1]}
        elif family.value:
            out["value"] = base
        name = TRIGGERS[int(row.trigger[0])]
        if name == "time":
            out["trigger"] = {"name": name, "start": int(row.start[0])}
        else:
            out["trigger"] = {"name": name, "threshold": float(row.threshold[0])}
        return out

    def around(self, scripts: Space, genomes: Array, rng: np.random.Generator) -> Array:
        """Return genomes (P, genes) of programs that hold a script as one phase, or that split one that changes its kind."""
        out, at = [], {name: i for i, name in enumerate(GENES)}
        for genome in genomes:
            family = scripts.family(genome)
            if family.then is None:
                mine = self._as(genome, self.families.index(family))
                other = rng.random((2, HALF))
                out += [np.concatenate([mine, other[0], rng.random(1)]), np.concatenate([other[1], mine, rng.random(1)])]
                continue
            row, halves = scripts.rows(genome[None]), []
            for kind in (family.kind, family.then):
                place = next(i for i, one in enumerate(self.families) if one.kind == kind and not one.ramp)
                half, (low, high) = self._as(genome, place), self.phase.reach(kind)
                half[at["size"]] = np.clip(np.log(abs(row.base[0]) / low) / np.log(high / low), 0.0, np.nextafter(1.0, 0.0))
                halves.append(half)
            halves[1][[at["trigger"], at["when"]]] = 0.0  # at once
            length = (row.switch[0] - 0.5) / max(self.phase.budget - 1, 1)
            out.append(np.concatenate([*halves, [np.clip(length, 0.0, np.nextafter(1.0, 0.0))]]))
        return np.array(out) if out else np.zeros((0, self.genes))

    def _as(self, genome: Array, family: int) -> Array:
        """Return the genome of a phase that is a script's, with a family by its place here."""
        out = genome.copy()
        out[0] = (family + 0.5) / len(self.families)
        return out
