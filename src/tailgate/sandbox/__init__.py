"""Playing a defence that somebody else wrote: in a process of its own, in secretly mixed batches, on seeds that nobody knew before.

`play_submission` makes the rows of a suite; `Isolated` is a defence for any loop; `Limits` says what a submission may take.
"""

from typing import Any

from tailgate.sandbox.limits import Limits

__all__ = ["Isolated", "Limits", "digest_of", "play_mixed", "play_submission"]
_HOMES = {"Isolated": "isolated", "digest_of": "source", "play_mixed": "mixed", "play_submission": "play"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tailgate.sandbox' has no attribute {name!r}")
    from importlib import import_module  # late: the child imports this package, and needs nothing of the parent's side

    return getattr(import_module(f"tailgate.sandbox.{_HOMES[name]}"), name)
