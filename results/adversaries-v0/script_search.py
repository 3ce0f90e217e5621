"""Scripts that are searched for: a template's numbers are drawn, tried on tune episodes, and the best few join the rivals.

A template is a script with ranges in it: `{20..90}` is a whole number, `{0.5..4.0}` a number, `{2|4|8}` one of a few.
"""

from __future__ import annotations

import re

import numpy as np

from tailgate.base.errors import InputError
from tailgate.evaluation.baselines import BATCH, outcomes
from tailgate.evaluation.cells import cells_of, run
from tailgate.training import train

TRIES, TRIED_ON, KEPT, KEPT_ON, JOIN = 48, 64, 8, 512, 2  # scripts of a template; episodes of each; of these; episodes; and of these
_HOLE = re.compile(r"\{([^{}]*)\}")


def drawn(template: str, rng: np.random.Generator) -> str:
    """One script of a template. Raises InputError for a range that is none."""

    def number(hole: re.Match[str]) -> str:
        if "|" in hole[1]:
            return str(rng.choice(hole[1].split("|")))
        low, dots, high = hole[1].partition("..")
        try:
            if "." in low or "." in high:
                least, most = float(low), float(high)
                if least > most:
                    raise ValueError("ends below its start")
                return f"{rng.uniform(least, most):.3g}"
            return str(rng.integers(int(low), int(high) + 1))
        except ValueError:
            raise InputError("search", template, f"{{a..b}} or {{a|b|c}}, not {hole[0]}{'' if dots else ' without ..'}") from None

    return _HOLE.sub(number, template)


def found(config: train.TrainConfig, templates: list[str], share: float = 1.0) -> list[str]:
    """Of each template the scripts that do most against the configuration's defence; `share` of the episodes where they are slow."""
    out: list[str] = []
    for i, template in enumerate(templates):
        rng = np.random.default_rng([i, len(template)])
        best = list(dict.fromkeys(drawn(template, rng) for _ in range(TRIES)))
        for episodes, left in ((TRIED_ON, KEPT), (KEPT_ON, JOIN)):
            best = ranked(config, best, max(int(share * episodes), 16))[:left]
        out += best
    return out


def ranked(config: train.TrainConfig, scripts: list[str], episodes: int) -> list[str]:
    """The scripts, what does most on tune episodes first."""
    suite = train.Suite("search", "", (config.scenario,), (None,), (config.defence,), tuple(scripts), episodes)
    rows = run(cells_of(suite, batch=BATCH, purpose="tune", threat=dict(config.threat)), workers=config.workers)
    counted = train.outcome_of(config)
    mean = {script: float(outcomes([row for row in rows if row["attack"] == script], counted).mean()) for script in scripts}
    return sorted(scripts, key=lambda script: -mean[script])
