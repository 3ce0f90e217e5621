"""The working directory as the place of the user's own modules: it joins the path behind all others, and only when one is named.

In front, or from the start, any file there could take the place of a package that is imported later.
"""

from __future__ import annotations

import os
import sys

_wanted = False


def allow() -> None:
    """Let modules that the user names be found in the working directory. Nothing is imported, and the path stays as it is."""
    global _wanted
    _wanted = True


def folders() -> list[str]:
    """Return the working directory where the user's modules may lie there, else nothing."""
    return [os.getcwd()] if _wanted else []


def join() -> None:
    """Put the place of the user's modules on the path: one of them is about to be imported."""
    sys.path += [folder for folder in folders() if folder not in sys.path]
