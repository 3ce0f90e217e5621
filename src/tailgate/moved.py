"""Import paths of the previous release: each forwards to its module with a DeprecationWarning. The next release removes them."""

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
PACKAGES = {"commands": "cli", "reproduce": "thesis", "strength": "studies", "submission": "sandbox"}


def _table() -> dict[str, str]:
    out = {f"tailgate.{old}": f"tailgate.{new}" for old, new in PACKAGES.items()}
    for room, names in ROOMS.items():
        for name in names.split():
            old, _, new = name.partition("=")
            out[f"tailgate.{old}"] = f"tailgate.{room}.{new or old}"
    return out


MOVED = _table()


def now(name: str) -> str:
    """Return the present name of a moved module; empty if it has not moved."""
    head = ".".join(name.split(".")[:2])
    return MOVED[head] + name[len(head) :] if head in MOVED else ""


class Forwarding(MetaPathFinder, Loader):
    """A finder of moved modules by their earlier names."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if now(fullname) else None

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        warnings.warn(f"{name} is now {now(name)}", DeprecationWarning, stacklevel=2)
        sys.modules[name] = import_module(now(name))  # not a copy, which would register its components twice


sys.meta_path.insert(0, Forwarding())  # before finders that would load a copy from the folder
