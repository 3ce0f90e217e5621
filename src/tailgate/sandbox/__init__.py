"""A sandbox for submitted defences: separate processes, secretly mixed batches, and seeds that nobody knew before.

`play_submission` makes the rows of a suite; `Isolated` is a defence for any loop; `Limits` bounds a submission's resources.
"""

from tailgate.base.lazy import exported

# imported on use: the child imports this package and needs no parent code
_HOMES = {"isolated": "Isolated", "limits": "Limits", "mixed": "play_mixed", "play": "play_submission", "source": "digest_of"}
__getattr__, __all__ = exported(__name__, _HOMES)
