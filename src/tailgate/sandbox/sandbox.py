"""The command in front of a stranger's process: bubblewrap or a container. Without one a submission runs with the user's rights."""

from __future__ import annotations

import os
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
from tailgate.engine.objects import folder as kept_objects
from tailgate.sandbox.limits import Limits

Program = Literal["bwrap", "docker"]
HOME = "/scratch"  # where a sandboxed submission works
_SYSTEM = ("/usr", "/bin", "/lib", "/lib32", "/lib64", "/etc/ld.so.cache", "/etc/alternatives")


@dataclass(frozen=True)
class Sandbox:
    """What stands between a stranger's process and this machine."""

    program: Program = param("bwrap", "bwrap (bubblewrap), or docker")
    image: str = param("tailgate", "docker: name of an image whose python imports this very version of tailgate")

    @property
    def processes(self) -> int:
        """Processes of the sandbox itself, which count among those that the guard sees."""
        return 3

    def command(
        self, module: Sequence[str], folder: Path, source: Path | None, environment: dict[str, str], limits: Limits
    ) -> tuple[list[str], list[str]]:
        """The command that runs `python MODULE` inside, and the one that removes what it leaves behind (empty: nothing).

        `folder` holds the exchanged files, `source` the submission.
        """
        if shutil.which(self.program) is None:
            raise InputError("sandbox", self.program, f"an installed program: {self.program} is not on the PATH")
        if self.program == "bwrap":
            return [*bwrap(folder, source, limits), sys.executable, *module], []
        name = f"tailgate-{uuid.uuid4().hex}"
        return [*docker(name, folder, source, environment, limits), self.image, "python", *module], ["docker", "rm", "--force", name]

    def outside(self, environment: dict[str, str]) -> dict[str, str] | None:
        """Variables of the sandbox's own process: bwrap hands on all it has; a container's client inherits ours (None): its engine."""
        return environment if self.program == "bwrap" else None


def sandbox_of(text: str | None) -> Sandbox | None:
    """A sandbox by its name: bwrap, docker, docker:IMAGE; none for an empty one. Raises InputError for one that is not installed."""
    if not text:
        return None
    program, _, image = text.partition(":")
    if program not in get_args(Program) or (image and program != "docker"):
        raise InputError("sandbox", text, "bwrap, docker or docker:IMAGE")
    if shutil.which(program) is None:
        raise InputError("sandbox", text, f"an installed program: {program} is not on the PATH")
    return Sandbox(program, image) if image else Sandbox(program)  # type: ignore[arg-type]


def bwrap(folder: Path, source: Path | None, limits: Limits) -> list[str]:
    """bubblewrap: new namespaces of every kind, so no network and no other process; what is bound can only be read, but for `out`."""
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
    if objects := kept_objects():  # machine code of products and inverses, to be read
        out += ["--ro-bind", str(objects), f"{HOME}/.cache/tailgate/objects"]
    out += ["--ro-bind", str(folder / "in"), str(folder / "in"), "--bind", str(folder / "out"), str(folder / "out")]
    if source is not None:
        out += ["--ro-bind", str(source), str(source)]
    return [*out, "--chdir", HOME, "--"]


def docker(name: str, folder: Path, source: Path | None, environment: dict[str, str], limits: Limits) -> list[str]:
    """A container without network, capabilities or new privileges, under this user's number. It has a python and tailgate of its own."""
    out = ["docker", "run", "--rm", "--interactive", "--init", "--pull", "never", "--name", name, "--network", "none", "--cap-drop", "ALL"]
    out += ["--security-opt", "no-new-privileges", "--ipc", "none", "--user", f"{os.getuid()}:{os.getgid()}"]
    out += ["--pids-limit", str(32 + limits.processes), "--memory", str(limits.memory), "--memory-swap", str(limits.memory)]
    out += ["--tmpfs", f"{HOME}:rw,mode=1777,size={limits.file_size}", "--workdir", HOME]
    for key, value in environment.items():
        if key not in ("PATH", "LD_LIBRARY_PATH", "PYTHONPATH"):  # the image's own
            out += ["--env", f"{key}={value}"]
    out += ["--volume", f"{folder / 'in'}:{folder / 'in'}:ro", "--volume", f"{folder / 'out'}:{folder / 'out'}:rw"]
    if source is not None:
        out += ["--volume", f"{source}:{source}:ro"]
    return out
