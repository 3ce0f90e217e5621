"""The system calls that a submission in bubblewrap may not make, as a program of the kernel's filter (seccomp, classic BPF).

Some reach what no namespace separates: keyrings, and sockets of a virtual machine's host. Others take memory that no limit of the sandbox
counts: anonymous files, shared segments of System V, and new mounts.
"""

from __future__ import annotations

import platform
import struct

FILTER = "FILTER"  # in a command: the descriptor of the program
_ALLOW, _KILL, _ERROR = 0x7FFF0000, 0x80000000, 0x00050000  # what the kernel does with a call
_EPERM, _ENOSYS = 1, 38
_LOAD, _EQUAL, _ABOVE, _RETURN = 0x20, 0x15, 0x35, 0x06  # ld abs, jeq, jge, ret
_NUMBER, _MACHINE, _FIRST = 0, 4, 16  # places in the kernel's record of a call: its number, the machine, its first argument
_SOCKETS = (1, 2, 10, 16)  # families that a network namespace separates: unix, inet, inet6, netlink
_X32 = 0x40000000  # of x86_64: the calls of another convention

# by machine: the kernel's word for it, clone3 and socket, and the calls that fail: add_key request_key keyctl, memfd_create memfd_secret,
# shmget, unshare setns mount, fsopen open_tree move_mount, io_uring_setup, bpf, userfaultfd
_MACHINES: dict[str, tuple[int, int, int, tuple[int, ...]]] = {
    "x86_64": (0xC000003E, 435, 41, (248, 249, 250, 319, 447, 29, 272, 308, 165, 430, 428, 429, 425, 321, 323)),
    "aarch64": (0xC00000B7, 435, 198, (217, 218, 219, 279, 447, 194, 97, 268, 40, 430, 428, 429, 425, 280, 282)),
}


def program(machine: str = "") -> bytes:
    """Return the filter for a machine, by default this one; empty where the numbers of its calls are not known here."""
    held = _MACHINES.get(machine or platform.machine())
    if held is None:
        return b""
    word, clone3, socket, refused = held
    error = _ERROR | _EPERM
    out = [(_LOAD, 0, 0, _MACHINE), (_EQUAL, 1, 0, word), (_RETURN, 0, 0, _KILL), (_LOAD, 0, 0, _NUMBER)]
    out += [(_ABOVE, 0, 1, _X32), (_RETURN, 0, 0, error)]
    for number in refused:
        out += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, error)]
    out += [(_EQUAL, 0, 1, clone3), (_RETURN, 0, 0, _ERROR | _ENOSYS)]  # a library falls back to clone, whose flags show
    out += [(_EQUAL, 1, 0, socket), (_RETURN, 0, 0, _ALLOW), (_LOAD, 0, 0, _FIRST)]
    for family in _SOCKETS:
        out += [(_EQUAL, 0, 1, family), (_RETURN, 0, 0, _ALLOW)]
    out += [(_RETURN, 0, 0, error)]
    return b"".join(struct.pack("=HBBI", *line) for line in out)
