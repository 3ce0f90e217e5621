"""Options that grant a policy the threat model of its training."""

from __future__ import annotations

import json
import shlex
from typing import Any

from tailgate.core.scenario import list_scenarios, list_suites, load_scenario, load_suite
from tailgate.core.schema import as_data
from tailgate.core.threat import ThreatModel

GRANTS = ("kinds", "targets", "agents", "fdi_bound", "actuator_bound", "jam_range", "jam_power", "delay_bound", "memory")
SOME = 2  # suites that are named, at most


def remedy(training: dict[str, Any], threat: ThreatModel) -> str:
    """Return the options that grant a policy what it was trained with, as the end of an error; empty where its file does not say.

    Parameters
    ----------
    training
        The part of the policy's file on its training.
    threat
        The threat model that it meets.
    """
    record, config, here = training.get("threat_model"), training.get("config"), as_data(threat)
    if not isinstance(record, dict):
        return ""
    missing = {name: record[name] for name in GRANTS if name in record and record[name] != here[name]}
    options = shlex.join(word for name, value in missing.items() for word in ("--threat", f"{name}={_text(value)}"))
    if not options or not options.isprintable():
        return ""
    scenario = config.get("scenario") if isinstance(config, dict) else None
    suites = _granting(scenario, missing) if scenario in list_scenarios() else []
    return f"; add {options}" + (f", or {' or '.join(f'--suite {name}' for name in suites)}" if suites else "")


def _text(value: object) -> str:
    return f"[{','.join(map(str, value))}]" if isinstance(value, list) else value if isinstance(value, str) else json.dumps(value)


def _granting(scenario: str, missing: dict[str, Any]) -> list[str]:
    """Return suites that grant these fields of the threat model on the scenario."""
    out, place = [], load_scenario(scenario)
    for name in list_suites():
        suite = load_suite(name)
        if scenario in suite.scenarios:
            granted = as_data(place.with_threat(**suite.granted).threat_model)
            out += [name] if all(granted[key] == value for key, value in missing.items()) else []
    return out[:SOME]
