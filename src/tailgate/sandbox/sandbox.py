"""The sandbox command of a submission's process: bubblewrap or a container. Without one it runs with the user's rights."""

from __future__ import annotations

import os
import re
import shutil
import sys
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from tailgate.base.errors import InputError
from tailgate.base.version import FOLDER
from tailgate.core import param
from tailgate.engine.objects import copied_to
from tailgate.sandbox.calls import FILTER, program
from tailgate.sandbox.limits import Limits

Program = Literal["bwrap", "docker"]
HOME = "/scratch"  # working directory of a sandboxed submission
IMAGE = re.compile(r"[a-z0-9][\w./:@-]*")  # never an option of the client
_SYSTEM = ("/usr", "/bin", "/lib", "/lib32", "/lib64", "/etc/ld.so.cache", "/etc/alternatives")


@dataclass(frozen=True)
class Sandbox:
    """The barrier between a submission's process and this machine."""

    program: Program = param("bwrap", "bwrap (bubblewrap), or docker")
    image: str = param("tailgate", "docker: name of an image with this version of tailgate")

    @property
    def processes(self) -> int:
        """Number of the sandbox's own processes, which the guard counts too."""
        return 3

    def command(
        self, module: Sequence[str], folder: Path, source: Path | None, environment: dict[str, str], limits: Limits
    ) -> tuple[list[str], list[str]]:
        """Return the command that runs `python MODULE` inside, and the one that cleans up afterwards (empty: none).

        `folder` holds the exchanged files, `source` the submission.
        """
        if shutil.which(self.program) is None:
            raise InputError("sandbox", self.program, f"an installed program: {self.program} is not on the PATH")
        if self.program == "bwrap":
            copied = copied_to(folder / "objects")
            return [*bwrap(folder, source, limits, copied), sys.executable, *module], []
        name = f"tailgate-{uuid.uuid4().hex}"
        return [*docker(name, folder, source, environment, limits), self.image, "python", *module], ["docker", "rm", "--force", name]

    def outside(self, environment: dict[str, str]) -> dict[str, str] | None:
        """Return the environment of the sandbox program: bwrap passes it on; a container's client keeps the user's (None)."""
        return environment if self.program == "bwrap" else None


def sandbox_of(text: str | None) -> Sandbox | None:
    """Return a sandbox by name (bwrap, docker, docker:IMAGE), or None for an empty one; raise InputError if it is not installed."""
    if not text:
        return None
    program, _, image = text.partition(":")
    if program not in get_args(Program) or (image and program != "docker"):
        raise InputError("sandbox", text, "bwrap, docker or docker:IMAGE")
    if image and not IMAGE.fullmatch(image):
        raise InputError("sandbox", text, "docker:IMAGE with the name of an image")
    if shutil.which(program) is None:
        raise InputError("sandbox", text, f"an installed program: {program} is not on the PATH")
    return Sandbox(program, image) if image else Sandbox(program)  # type: ignore[arg-type]


def bwrap(folder: Path, source: Path | None, limits: Limits, objects: Path) -> list[str]:
    """Return bubblewrap's command: new namespaces, so no network and no other process.

    All is read-only but `out` and three directories in memory. `objects` is a copy of machine code. The guard puts the descriptor of the
    filter of calls in the place of the word FILTER.
    """
    package = FOLDER
    parts = [package, *(path.resolve() for path in package.iterdir() if path.is_symlink())]
    prefixes = dict.fromkeys(str(Path(path)) for path in (sys.prefix, sys.base_prefix, *map(str, parts)))
    out = ["bwrap", "--unshare-all", "--die-with-parent", "--new-session", "--cap-drop", "ALL", "--hostname", "submission"]
    for path in _SYSTEM:
        out += ["--ro-bind-try", path, path]
    out += ["--proc", "/proc", "--dev", "/dev"]
    for path in ("/dev/shm", "/tmp", HOME):
        out += ["--size", str(limits.file_size), "--tmpfs", path]
    for prefix in prefixes:
        if not any(prefix == path or prefix.startswith(f"{path}/") for path in _SYSTEM):
            out += ["--ro-bind", prefix, prefix]
    out += ["--ro-bind", str(objects), f"{HOME}/.cache/tailgate/objects"]
    out += ["--ro-bind", str(folder / "in"), str(folder / "in"), "--bind", str(folder / "out"), str(folder / "out")]
    if source is not None:
        out += ["--ro-bind", str(source), str(source)]
    filtered = ["--seccomp", FILTER] if program() else []
    return [*out, "--remount-ro", "/dev", "--remount-ro", "/", *filtered, "--chdir", HOME, "--"]


def docker(name: str, folder: Path, source: Path | None, environment: dict[str, str], limits: Limits) -> list[str]:
    """Return docker's command: no network, capabilities or new privileges, this user's id, the image's python and tailgate."""
    out = ["docker", "run", "--rm", "--interactive", "--init", "--pull", "never", "--name", name, "--network", "none", "--cap-drop", "ALL"]
    out += ["--security-opt", "no-new-privileges", "--ipc", "none", "--user", f"{os.getuid()}:{os.getgid()}"]
    out += ["--pids-limit", str(32 + limits.processes), "--memory", str(limits.memory), "--memory-swap", str(limits.memory)]
    for path in ("/tmp", HOME):
        out += ["--tmpfs", f"{path}:rw,mode=1777,size={limits.file_size}"]
    out += ["--read-only", "--workdir", HOME]
    for key, value in environment.items():
        if key not in ("PATH", "LD_LIBRARY_PATH", "PYTHONPATH"):  # the image has its own
            out += ["--env", f"{key}={value}"]
    out += ["--volume", f"{folder / 'in'}:{folder / 'in'}:ro", "--volume", f"{folder / 'out'}:{folder / 'out'}:rw"]
    if source is not None:
        out += ["--volume", f"{source}:{source}:ro"]
    return out
