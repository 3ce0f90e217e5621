"""Import paths of earlier releases: they lead to the modules of today, with a DeprecationWarning. They go with the next release."""

import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

ROOMS = {
    "base": "assets errors files interrupts lazy locks plots pool progress reading sizes sources machine=provenance tree=pytree",
    "core": "drawing draws kinds loop optimal quantities reach registry scenario schema threat link=lossy_link watch=score_threshold",
    "engine": "hints",
    "evaluation": "calibrate golden rounds rows stats summary verify "
    "clean=attack_free held_out=excluded_attacks parts=resume rivals=baselines",
    "play": "metrics trace",
    "studies": "log log_card",
    "thesis": "bounds resilience string_stability",
    "training": "adaptive comparison selfplay train trainings tuning",
}
PACKAGES = {
    "commands": "cli", "reproduce": "thesis", "strength": "studies", "submission": "sandbox", "leaderboard": "board", "scoring": "board",
}  # fmt: skip
WITHIN = {  # rooms whose modules are in several rooms today, or have other names
    "leaderboard": "attacked card check clock detect head order run run_record timing verified kept=update errata=attachments "
    "measured=attachments run_time=attachments board_format=files board_parts=schema build=site.rows_page charts=site.charts "
    "site=site.build site_alarms=site.alarms site_cards=site.cards site_curves=site.curves site_entry=site.entry "
    "site_index=site.index site_suite=site.suite site_timing=site.timing site_trust=site.trust",
    "scoring": "cells damage detection entry false_alarms flags gates words attacks=admission beside=update board=score doses=worst "
    "follow=consistency ranks=evaluation.paired",
}


def _table() -> dict[str, str]:
    out = {f"tailgate.{old}": f"tailgate.{new}" for old, new in PACKAGES.items()}
    for room, names in ROOMS.items():
        for name in names.split():
            old, _, new = name.partition("=")
            out[f"tailgate.{old}"] = f"tailgate.{room}.{new or old}"
    for package, names in WITHIN.items():
        for name in names.split():
            old, _, new = name.partition("=")
            out[f"tailgate.{package}.{old}"] = f"tailgate.{new if '.' in new else f'board.{new or old}'}"
    return out


MOVED = _table()


def now(name: str) -> str:
    """Where a module is today; empty where it has not moved."""
    parts = name.split(".")
    head = next((head for n in (3, 2) if (head := ".".join(parts[:n])) in MOVED), "")
    return MOVED[head] + name[len(head) :] if head else ""


class Forwarding(MetaPathFinder, Loader):
    """Finds moved modules by their earlier names."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if now(fullname) else None

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        warnings.warn(f"{name} is now {now(name)}", DeprecationWarning, stacklevel=2)
        sys.modules[name] = import_module(now(name))  # not a copy, which would register its components twice


sys.meta_path.insert(0, Forwarding())  # before those that would load a copy from the folder
