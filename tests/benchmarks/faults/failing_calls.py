"""A disk that fails at one call: every call of a process that writes below a folder is counted, one refused.

The kernel hands the calls over (seccomp's user notification), so that none is missed, whichever library makes
it, in whichever process that the first has started. Linux on x86-64 only.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import platform
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

_BY_DESCRIPTOR = {
    "write": (1, 0), "pwrite": (18, 0), "writev": (20, 0), "pwritev": (296, 0), "pwritev2": (328, 0),
    "sendfile": (40, 0), "fsync": (74, 0), "fdatasync": (75, 0), "ftruncate": (77, 0), "fallocate": (285, 0),
    "copy_file_range": (326, 2),
}  # fmt: skip
"""Calls on an open file: their number, and which argument is its descriptor."""

_BY_PATH: dict[str, tuple[int, int | None, int]] = {
    "truncate": (76, None, 0), "rename": (82, None, 1), "mkdir": (83, None, 0), "creat": (85, None, 0),
    "link": (86, None, 1), "symlink": (88, None, 1), "mkdirat": (258, 0, 1), "renameat": (264, 2, 3),
    "linkat": (265, 2, 3), "symlinkat": (266, 1, 2), "renameat2": (316, 2, 3),
}  # fmt: skip
"""Calls on a name: their number, which argument is the folder that it is relative to, and which the name."""

_OPENING: dict[str, tuple[int, int | None, int, int]] = {"open": (2, None, 0, 1), "openat": (257, 0, 1, 2)}
"""The same of calls that open, and which argument holds the flags."""

_TO_WRITE = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_HERE = -100  # AT_FDCWD
_LONGEST_NAME = 4096

_SECCOMP, _FILTER, _NEW_LISTENER, _NO_NEW_PRIVILEGES = 317, 1, 8, 38
_RECEIVE, _SEND, _GO_ON = 0xC0502100, 0xC0182101, 1
_NOTIFICATION = struct.Struct("=QIIiIQ6Q")
_ANSWER = struct.Struct("=QqiI")
_X86_64 = 0xC000003E


@dataclass(frozen=True)
class Failure:
    """The call ``at`` this place among those that write fails; with ``lasts`` all later ones as well."""

    at: int
    number: int = errno.ENOSPC
    lasts: bool = True


@dataclass
class Watched:
    """How a watched process ended: its exit code (None if it had to be killed), and the calls that wrote."""

    code: int | None = None
    calls: list[str] = field(default_factory=list)


def why_not() -> str | None:
    """Why calls cannot be watched here; None if they can."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return "calls are watched on Linux and x86-64 only"
    return None


def watch(work: Callable[[], int], below: Path, failure: Failure | None, longest_s: float) -> Watched:
    """Do ``work`` in a fork of this process, whose calls that write below a folder are counted or fail.

    Args:
        work: its result is the exit code.
        below: calls that write elsewhere are not looked at.
        failure: what is to fail; None for nothing.
        longest_s: the process is killed after this time.
    """
    ours, theirs = socket.socketpair()
    process = os.fork()
    if not process:
        code = 1
        try:
            ours.close()
            os.setsid()
            listener = _filtered()
            socket.send_fds(theirs, [b"."], [listener])
            os.close(listener)
            theirs.close()
            code = work()
        finally:
            os._exit(code)
    theirs.close()
    _, (listener, *_), _, _ = socket.recv_fds(ours, 1, 1)
    ours.close()
    watched = Watched()
    try:
        watched.code = _answer_all(listener, process, f"{below}/", failure, longest_s, watched.calls)
    finally:
        os.close(listener)
    return watched


def _answer_all(
    listener: int, process: int, below: str, failure: Failure | None, longest_s: float, calls: list[str]
) -> int | None:
    """Answer the calls of a process until it has ended; returns its exit code."""
    end_s = time.monotonic() + longest_s
    waiting = select.poll()
    waiting.register(listener, select.POLLIN)
    ended = None
    while time.monotonic() < end_s:
        events = waiting.poll(200)
        if events and events[0][1] & select.POLLIN:
            _answer(listener, below, failure, calls)
        elif ended is None and (waited := os.waitpid(process, os.WNOHANG))[0]:
            ended = os.waitstatus_to_exitcode(waited[1])
        if ended is not None and (not events or events[0][1] & select.POLLHUP):
            return ended
    os.killpg(process, signal.SIGKILL)
    if ended is None:
        os.waitpid(process, 0)
    return None


def _answer(listener: int, below: str, failure: Failure | None, calls: list[str]) -> None:
    notification = bytearray(_NOTIFICATION.size)
    try:
        fcntl.ioctl(listener, _RECEIVE, notification)
    except FileNotFoundError:  # who asked was killed meanwhile
        return
    key, process, _, number, _, _, *arguments = _NOTIFICATION.unpack(notification)
    name, path = _NAMES[number], _written(process, number, arguments)
    error = 0
    if path is not None and path.startswith(below):
        at = len(calls)
        calls.append(f"{name} {path.removeprefix(below)}")
        if failure is not None and (at == failure.at or (failure.lasts and at > failure.at)):
            error = failure.number
    try:
        fcntl.ioctl(listener, _SEND, _ANSWER.pack(key, 0, -error, 0 if error else _GO_ON))
    except FileNotFoundError:
        return


_NAMES = {call[0]: name for kind in (_BY_DESCRIPTOR, _BY_PATH, _OPENING) for name, call in kind.items()}  # type: ignore[attr-defined]


def _written(process: int, number: int, arguments: list[int]) -> str | None:
    """The path that a call writes to; None where it cannot be told, as of a process that has ended."""
    name = _NAMES[number]
    try:
        if name in _BY_DESCRIPTOR:
            return str(
                Path(f"/proc/{process}/fd/{arguments[_BY_DESCRIPTOR[name][1]] & 0xFFFFFFFF}").readlink()
            )
        _, folder, at = _BY_PATH[name] if name in _BY_PATH else _OPENING[name][:3]
        path = _text(process, arguments[at])
        if path.startswith("/"):
            return os.path.normpath(path)
        start = _HERE if folder is None else ctypes.c_int(arguments[folder]).value
        base = Path(f"/proc/{process}", "cwd" if start == _HERE else f"fd/{start}").readlink()
        return os.path.normpath(f"{base}/{path}")
    except OSError:
        return None


def _text(process: int, address: int) -> str:
    """The text that ends with a zero byte at an address of a process."""
    page = os.sysconf("SC_PAGESIZE")
    text = b""
    with Path(f"/proc/{process}/mem").open("rb", buffering=0) as memory:
        while b"\0" not in text and len(text) < _LONGEST_NAME:
            memory.seek(address + len(text))
            text += memory.read(page - (address + len(text)) % page)
    return os.fsdecode(text.split(b"\0", 1)[0])


def _filtered() -> int:
    """Hand over the calls of this process from now on; returns the descriptor that tells of them."""
    program = _program()
    code = ctypes.create_string_buffer(program, len(program))
    about = struct.pack("HxxxxxxQ", len(program) // 8, ctypes.addressof(code))
    library = ctypes.CDLL(None, use_errno=True)
    if library.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl")
    listener: int = library.syscall(_SECCOMP, _FILTER, _NEW_LISTENER, about)
    if listener < 0:
        raise OSError(ctypes.get_errno(), "seccomp")
    return listener


def _program() -> bytes:
    """The kernel's filter: calls of the tables above are handed over, those that open only if to write."""
    load, equal, any_bit, give = 0x20, 0x15, 0x45, 0x06
    hand_over, allow = 0x7FC00000, 0x7FFF0000
    plain = [call[0] for kind in (_BY_DESCRIPTOR, _BY_PATH) for call in kind.values()]  # type: ignore[attr-defined]
    steps: list[tuple[int, int | str, int | str, int]] = [
        (load, 0, 0, 4),
        (equal, 0, "allow", _X86_64),
        (load, 0, 0, 0),
    ]
    steps += [(equal, "hand over", 0, number) for number in plain]
    for number, _, _, flags in _OPENING.values():
        steps += [
            (equal, 0, 2, number),
            (load, 0, 0, 16 + 8 * flags),
            (any_bit, "hand over", "allow", _TO_WRITE),
        ]
    ends = {"allow": len(steps), "hand over": len(steps) + 1}
    steps += [(give, 0, 0, allow), (give, 0, 0, hand_over)]

    def jump(to: int | str, row: int) -> int:
        return ends[to] - row - 1 if isinstance(to, str) else to

    return b"".join(
        struct.pack("HBBI", code, jump(yes, row), jump(no, row), value)
        for row, (code, yes, no, value) in enumerate(steps)
    )
