"""Attacks: scripts, white boxes, optimal ones, learned policies; and the learners."""

from tailgate.base.lazy import exported

__getattr__, __dir__ = exported(__name__, "Script", "Yoked", "load_policy", "save_policy")
