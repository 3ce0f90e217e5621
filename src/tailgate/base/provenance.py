"""Provenance of figures: the processor and the commit of the source."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

from tailgate.base.version import FOLDER


def cpuinfo(key: str) -> str:
    """Return the first value of a key in Linux's /proc/cpuinfo; empty on other systems."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")


def processor() -> str:
    """Return the processor's name."""
    return cpuinfo("model name") or platform.processor() or "unknown"


def cores() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def commit() -> str | None:
    """Return the commit of the source, marked if tracked files have changed; None outside a repository."""

    def asked(*words: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(FOLDER.resolve()), *words]
        rest = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}  # which may name another repository
        return subprocess.run(command, capture_output=True, text=True, check=True, env=rest).stdout.strip()

    try:
        asked("ls-files", "--error-unmatch", "__init__.py")  # else it is installed in somebody's own repository
        return asked("rev-parse", "HEAD") + (" with changes" if asked("status", "--porcelain", "-uno", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
