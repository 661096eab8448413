"""``v2hdm NAME``: find a command and run it.

Nothing heavy is imported here, and commands import within their work, so that ``--help`` answers at once and
Ctrl-C is one line while torch is still being loaded, too.
"""

from __future__ import annotations

import difflib
import importlib
import json
import logging
import os
import pkgutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from v2hdm import __version__
from v2hdm.cli import commands
from v2hdm.cli.command import Command, fail
from v2hdm.errors import describe, one_line, shown
from v2hdm.native import which_runs

_FIRST = ("map", "detect", "check")  # at the head of the list, for those who look at it for the first time


def command_names() -> list[str]:
    """The names of all commands as they are typed, in the order of the list; imports none of their files."""
    names = [module.name.replace("_", " ") for module in pkgutil.iter_modules(commands.__path__)]
    return [*_FIRST, *(name for name in sorted(names) if name not in _FIRST)]


def command_of(name: str) -> Command:
    """The command of that name, as its file declares it."""
    module = importlib.import_module(f"{commands.__name__}.{name.replace(' ', '_')}")
    command: Command = module.COMMAND
    return command


def all_commands() -> Mapping[str, Command]:
    """All commands by name."""
    return {name: command_of(name) for name in command_names()}


class _Line(logging.LogRecord):
    """A message of one line, whatever names of a stranger's files are in it."""

    def getMessage(self) -> str:  # noqa: N802
        return one_line(super().getMessage())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this process; returns the exit code."""
    answer_signals()
    logging.setLogRecordFactory(_Line)
    words = sys.argv[1:] if arguments is None else arguments
    if not _is_limited():
        return run(words)
    theirs, ours = os.pipe()  # which ends when this process does, whatever ends it
    child = os.fork()
    if child == 0:
        os.close(ours)
        threading.Thread(target=_end_with, args=(theirs,), daemon=True).start()
        return run(words)
    os.close(theirs)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: os.kill(child, number))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code if code >= 0 else fail(f"ended by signal {-code} under ulimit -v; {describe(MemoryError())}")


_TIDY_S = 5.0  # a child without its parent may take this long to tidy up


def _end_with(pipe: int) -> None:
    """End this process, tidily if it can, when the other end of a pipe does."""
    with suppress(OSError):
        os.read(pipe, 1)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_TIDY_S)
    os.kill(os.getpid(), signal.SIGKILL)


def _is_limited() -> bool:
    """Whether libraries may die of the limit of memory that this process has, without a word (SIGSEGV)."""
    if sys.platform == "win32":
        return False
    import resource

    return resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY


def run(arguments: Sequence[str]) -> int:
    """Run a command line in this process; 0, 2 for an error that the user can fix, 3 for verdict FAIL."""
    words = list(arguments)
    names = command_names()
    name = next((typed for typed in (" ".join(words[:2]), *words[:1]) if typed in names), "")
    after_name = words[len(name.split()) :]
    below = [longer for longer in names if words and longer.startswith(f"{words[0]} ")]
    if name and "--version" not in after_name:
        return command_of(name)(after_name)
    if "--version" in (after_name if name else words[:1]):
        return _overview(version_line)
    if not words or words[0] in ("-h", "--help") or (below and words[1:2] in ([], ["-h"], ["--help"])):
        return _overview(lambda: _list(below or names))
    typed = " ".join(words[: 2 if below else 1])
    similar = difflib.get_close_matches(typed, names, n=1, cutoff=0.6)
    meant = f"did you mean {similar[0]}? " if similar else ""
    return fail(f"v2hdm {shown(typed)[1:-1]}: no such command; {meant}v2hdm --help lists them")


def _overview(text: Callable[[], str]) -> int:
    """Print the overview of ``v2hdm`` without a command; returns the exit code."""
    return Command("v2hdm", "List the commands.", lambda _: print(text()), None, "interrupted")(())


def _list(names: Sequence[str]) -> str:
    width = max(map(len, names))
    lines = [f"  {name:{width}}  {command_of(name).says}" for name in names]
    return "\n".join(["Usage: v2hdm COMMAND ...; v2hdm COMMAND --help explains a command.", "", *lines])


_ONE_PRESS_S = 2.0  # several presses of Ctrl-C within so many seconds count as one


def answer_signals() -> None:
    """Take SIGTERM for Ctrl-C, and several presses in a row for one, which would interrupt the tidying up."""
    pressed_s = -_ONE_PRESS_S

    def interrupt(*_: object) -> None:
        nonlocal pressed_s
        before_s = pressed_s
        pressed_s = time.monotonic()
        if pressed_s - before_s > _ONE_PRESS_S:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)


def version_line() -> str:
    """The versions of this package, its libraries and weights, in one line; nothing of it is imported."""
    from importlib import metadata

    parts = [f"v2hdm {__version__}"]
    for packages in (("torch",), ("onnxruntime", "onnxruntime-gpu"), ("numba",)):
        versions = []
        for name in packages:
            with suppress(metadata.PackageNotFoundError):
                versions.append(f"{name} {metadata.version(name)}")
        parts += versions or [f"no {packages[0]}"]
    manifest = Path(__file__).parents[1] / "detection" / "weights" / "manifest.json"
    try:
        network = json.loads(manifest.read_text(encoding="utf-8"))["files"]["default.onnx"]["sha256"]
        parts.append(f"weights {network[:8]}")
    except (OSError, ValueError, KeyError, TypeError):
        parts.append("no weights")
    parts.append(which_runs())
    return ", ".join(parts)
