"""What figures were made on: the processor and the source."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

from tailgate.base.version import FOLDER


def cpuinfo(key: str) -> str:
    """What Linux says of the first processor; empty elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), "")


def processor() -> str:
    """The processor's name."""
    return cpuinfo("model name") or platform.processor() or "unknown"


def cores() -> int:
    """Processors that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def commit() -> str | None:
    """The commit of the source, marked where files differ from it; None outside of a repository."""

    def asked(*words: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(FOLDER.resolve()), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return asked("rev-parse", "HEAD") + (" with changes" if asked("status", "--porcelain", "-uno", ".") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
