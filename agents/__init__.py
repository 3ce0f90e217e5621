"""Attacks: scripts, white boxes, optimal ones, learned policies; and the learners."""

from tailgate.base.lazy import discovered

__getattr__, __dir__ = discovered(__name__, "Script", "Yoked", "load_policy", "save_policy")
