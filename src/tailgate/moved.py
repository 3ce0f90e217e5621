"""Import paths of the previous release: each forwards to its module with a DeprecationWarning. The next release removes them."""

import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ROOMS = {
    "base": "assets errors files interrupts lazy locks plots pool progress reading sizes sources machine=provenance tree=pytree",
    "core": "draws kinds loop quantities reach registry scenario schema threat link=lossy_link watch=score_threshold",
    "engine": "hints",
    "evaluation": "calibrate golden rounds rows stats summary verify "
    "clean=attack_free held_out=excluded_attacks parts=resume rivals=baselines",
    "play": "metrics trace",
    "studies": "log log_card",
    "thesis": "bounds resilience string_stability",
    "training": "adaptive comparison selfplay train trainings tuning",
}
SUBROOMS = {  # of the folders envs, estimators and agents
    "envs.plants": "following=car_following radar_following platoon linear_platoon network=sensor_network highway highway_scene "
    "scalar_loop=scalar literal=thesis_printed",
    "envs.sensors": "radar=fmcw_radar fmcw fmcw_signal",
    "envs.controllers": "cacc consensus_cacc idm ploeg radar_car",
    "envs.gym": "batches duel faces=gymnasium_env seat=attacker_mdp shadow parallel sb3 specs",
    "envs.render": "render_canvas=canvas render_stage=stage render_platoon=platoon render_following=following render_network=network "
    "render_radar=radar render_highway=highway render_sheet=sheet render_viewer=viewer render_labels=labels render_bars=bars "
    "render_road=road",
    "estimators.filters": "kalman imm kinematic robust filterpy_filters predictors",
    "estimators.detectors": "chi_square monitored sparse",
    "estimators.mitigations": "control_defences",
    "estimators.distributed": "consensus disagreement trimmed trust saturated lasso centralised norm_resilient",
    "estimators.challenge": "steered steering",
    "estimators.safe_set": "safe_state reactive_brake algorithm2",
    "estimators.reference": "oracle sentinels raw",
    "agents.scripts": "scripted radio burst_loss program aim triggers values",
    "agents.white_box": "model_based ghost",
    "agents.optimal": "optimal_dos optimal_hold optimal_stealth",
    "agents.policy": "zoo",
    "agents.learners": "cem dqn ppo recurrent_ppo maskable_ppo sac tqc stable learning selfplay teacher finished",
}
PACKAGES = {
    "commands": "cli", "reproduce": "thesis", "strength": "studies", "submission": "sandbox", "leaderboard": "board", "scoring": "board",
}  # fmt: skip
OTHERS = {
    "drawing": "envs.render.graph",
    "core.drawing": "envs.render.graph",
    "optimal": "agents.optimal.schedules",
    "core.optimal": "agents.optimal.schedules",
    "agents.codec": "envs.gym.actions",
    "agents.observation": "envs.gym.observations",
    "agents.reward": "envs.gym.rewards",
    "agents.mixture": "envs.gym.mixture",
}
PROMOTED = {  # modules whose name a folder has today: the folder gives what they defined
    "envs.sensors": "envs.sensors.odometry",
    "envs.controllers": "envs.controllers.adaptive_cruise",
    "envs.render": "envs.render.picture",
    "estimators.detectors": "estimators.detectors.sequential",
    "estimators.mitigations": "estimators.mitigations.responses",
    "estimators.distributed": "estimators.distributed.distributed_kalman",
    "estimators.challenge": "estimators.challenge.challenge_response",
    "agents.policy": "agents.policy.network_policy",
}
WITHIN = {  # rooms whose modules are in several rooms today, or have other names
    "leaderboard": "attacked card check clock detect head order run run_record timing verified kept=update errata=attachments "
    "measured=attachments run_time=attachments board_format=files board_parts=schema build=site.rows_page charts=site.charts "
    "site=site.build site_alarms=site.alarms site_cards=site.cards site_curves=site.curves site_entry=site.entry "
    "site_index=site.index site_suite=site.suite site_timing=site.timing site_trust=site.trust",
    "scoring": "cells damage detection entry false_alarms flags gates words attacks=admission beside=update board=score doses=worst "
    "follow=consistency ranks=evaluation.paired",
}


def _table() -> dict[str, str]:
    out = PACKAGES | OTHERS
    for room, names in (ROOMS | SUBROOMS).items():
        top = room.partition(".")[0] + "." if room in SUBROOMS else ""
        for name in names.split():
            old, _, new = name.partition("=")
            out[top + old] = f"{room}.{new or old}"
    for package, names in WITHIN.items():
        for name in names.split():
            old, _, new = name.partition("=")
            out[f"{package}.{old}"] = new if "." in new else f"board.{new or old}"
    return {f"tailgate.{old}": f"tailgate.{new}" for old, new in out.items()}


MOVED = _table()


def now(name: str) -> str:
    """Return the present name of a moved module; empty if it has not moved."""
    parts = name.split(".")
    for size in (3, 2):
        head = ".".join(parts[:size])
        if head in MOVED:
            return MOVED[head] + name[len(head) :]
    return ""


def former(package: str) -> Callable[[str], object]:
    """Return the `__getattr__` of a folder that has the name of an earlier module."""
    module = f"tailgate.{PROMOTED[package.removeprefix('tailgate.')]}"

    def get(name: str) -> object:
        if name.startswith("__"):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(module), name)
        warnings.warn(f"{package}.{name} is now {module}.{name}", DeprecationWarning, stacklevel=2)
        return value

    return get


class Forwarding(MetaPathFinder, Loader):
    """A finder of moved modules by their earlier names."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if now(fullname) else None

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        warnings.warn(f"{name} is now {now(name)}", DeprecationWarning, stacklevel=2)
        sys.modules[name] = import_module(now(name))  # not a copy, which would register its components twice


sys.meta_path.insert(0, Forwarding())  # before finders that would load a copy from the folder
