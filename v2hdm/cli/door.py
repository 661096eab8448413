"""What the doors share: a user's mistake, or Ctrl-C, is one line on stderr and exit code 2.

Nothing heavy is imported here. A door imports this first and all else within its work, so that Ctrl-C is
one line while torch is still being loaded, too.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from v2hdm import __version__
from v2hdm.errors import V2hdmError
from v2hdm.store.inputs import protected_inputs

EXIT_USER_ERROR = 2
EXIT_FAILED_VERDICT = 3
_ONE_PRESS_S = 2.0
_OURS = ("v2hdm", "models", "train", "export")
_TOLD = (("torch",), ("onnxruntime", "onnxruntime-gpu"), ("numba",))
"""Libraries whose version decides what a run gives, and how fast, each by its packages."""

_WEIGHTS_DIGITS = 8
"""Of the SHA-256 of the shipped network: enough to tell any two."""


def open_door(name: str, extra: str | None, interrupted: str, work: Callable[[], int | None]) -> int:
    """Do the work of a process; the exit code is that of the work, 0 unless it returns one.

    It is 2, with one line on stderr, for what a user can mend.

    Args:
        name: of the door, as in ``python -m name``.
        extra: the optional dependencies that it needs, if any.
        interrupted: what to say after Ctrl-C.
        work: imports what it needs.
    """
    # OpenMP's threads sleep while they wait for each other. Spinning, they hold up those that they wait for
    # as soon as the machine is busy otherwise. Libraries read this when they are loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        with protected_inputs():
            return _to_the_end(work)
    except BrokenPipeError:  # the reader of our output has had enough
        from v2hdm.store.files import forget_stdout

        forget_stdout()
        return 0
    except V2hdmError as error:
        return _fail(str(error))
    except (MemoryError, OSError) as error:
        line = told(error)
        if line is None:
            raise
        _forget_full_stdout()
        return _fail(line)
    except ModuleNotFoundError as error:
        if extra is None or error.name is None or error.name.split(".")[0] in _OURS:
            raise
        return _fail(
            f"python -m {name} needs {error.name}: install the {extra} extra, pip install 'v2hdm[{extra}]'"
        )
    except KeyboardInterrupt:
        return _fail(interrupted)


def told(error: BaseException) -> str | None:
    """What a user is told of an error in one line; None for what is a bug of ours."""
    if isinstance(error, V2hdmError):
        return str(error)
    if isinstance(error, MemoryError):
        return "the memory is not enough for this; give less at once, or fewer workers"
    # Disks that are full, gone or read-only can fail any call.
    if isinstance(error, OSError) and not isinstance(error, ConnectionError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}; free space or check the disk, then start again"
    return None


def _to_the_end(work: Callable[[], int | None]) -> int:
    """Do the work and write all that it printed, while it can still be told that nobody reads it."""
    try:
        code = work() or 0
    except SystemExit:  # argparse, after --help
        sys.stdout.flush()
        raise
    sys.stdout.flush()
    return code


def _forget_full_stdout() -> None:
    """Keep Python from failing once more at its end, where nothing can be printed."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        from v2hdm.store.files import forget_stdout

        forget_stdout()


def _fail(message: str) -> int:
    print(f"error: {one_line(message)}", file=sys.stderr)
    return EXIT_USER_ERROR


def one_line(message: str) -> str:
    """A message whose words come from files of strangers: none ends the line or moves the cursor."""
    return "".join(c if c.isprintable() else "?" for c in " ".join(message.split()))


def answer_signals() -> None:
    """Take SIGTERM, a service manager's way to say Ctrl-C, for it, and several presses in a row for one.

    Otherwise the second would interrupt the tidying up after the first.
    """
    pressed_s = -_ONE_PRESS_S

    def interrupt(*_: object) -> None:
        nonlocal pressed_s
        before_s, pressed_s = pressed_s, time.monotonic()
        if pressed_s - before_s > _ONE_PRESS_S:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, interrupt)


def version_line() -> str:
    """What is installed, in one line: this package, the libraries that count, and the detector's weights.

    Nothing of it is imported: it answers where an install is broken, too.
    """
    told = [f"v2hdm {__version__}"]
    for packages in _TOLD:
        found = []
        for name in packages:
            with suppress(metadata.PackageNotFoundError):
                found.append(f"{name} {metadata.version(name)}")
        told += found or [f"no {packages[0]}"]
    return ", ".join([*told, _weights()])


def _weights() -> str:
    manifest = Path(__file__).parents[1] / "detection" / "weights" / "manifest.json"
    try:
        network = json.loads(manifest.read_text(encoding="utf-8"))["files"]["default.onnx"]["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        return "no weights"
    return f"weights {network[:_WEIGHTS_DIGITS]}"


class ShowVersion(argparse.Action):
    """``--version``: say what is installed, and end."""

    def __init__(self, option_strings: Sequence[str], dest: str, **_: object) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, help="say what is installed, and end")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Say it."""
        print(version_line())
        parser.exit()
