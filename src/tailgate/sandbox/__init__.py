"""A sandbox for submitted defences: separate processes, secretly mixed batches, and seeds that nobody knew before.

`play_submission` makes the rows of a suite; `Isolated` is a defence for any loop; `Limits` bounds a submission's resources.
"""

from typing import Any

from tailgate.sandbox.limits import Limits

__all__ = ["Isolated", "Limits", "digest_of", "play_mixed", "play_submission"]
_HOMES = {"Isolated": "isolated", "digest_of": "source", "play_mixed": "mixed", "play_submission": "play"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tailgate.sandbox' has no attribute {name!r}")
    from importlib import import_module  # late: the child imports this package and needs no parent code

    return getattr(import_module(f"tailgate.sandbox.{_HOMES[name]}"), name)
