"""A command as its file declares it, and its run: a user's mistake or Ctrl-C is one line and exit code 2."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, NoReturn

from v2hdm.errors import EXIT_USER_ERROR, describe, one_line
from v2hdm.progress import failures_of_stdout

GO_ON = "the same command resumes from there"

_OURS = ("v2hdm", "models", "train", "export")  # packages whose absence is a bug, and no extra's


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        name: as it is typed.
        says: a sentence on what it does.
        extra: the extra that it needs; None where the base install is enough.
        interrupted: the message after Ctrl-C.
        run: does its work on the arguments after its name; returns the exit code, None for 0.
    """

    name: str
    says: str
    run: Callable[[Sequence[str]], int | None]
    extra: str | None = "map"
    interrupted: str = "interrupted; nothing was written"

    def __call__(self, arguments: Sequence[str]) -> int:
        """Run it; its exit code, or 2, with one line on stderr, for a user's mistake."""
        # OpenMP's threads sleep while they wait for each other. Spinning, they hold up those that they wait
        # for as soon as the machine is busy otherwise. Libraries read this when they are loaded.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        # Matrices are small here, and OpenBLAS's threads spin after each product, whatever that says:
        # they took 20 of 48 s of CPU of the adjustment of a port, and held up those that had work.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        try:
            from v2hdm.store.inputs import protected_inputs

            failures_of_stdout.clear()
            with protected_inputs():
                try:
                    code = self.run(arguments) or 0
                except SystemExit:  # argparse, after --help
                    sys.stdout.flush()
                    raise
                try:
                    sys.stdout.flush()  # while an error of writing can still be reported
                    if failures_of_stdout:
                        raise failures_of_stdout.pop()
                except OSError as failure:
                    failure.filename = "standard output, when all files were written"
                    raise
                return code
        except BrokenPipeError:  # the reader of our output has had enough
            _leave_stdout()
            return 0
        except ModuleNotFoundError as error:
            if (error.name or "v2hdm").split(".")[0] in _OURS:
                raise
            extra = f"[{self.extra}]" if self.extra else ""
            install = f"install the {self.extra} extra, " if self.extra else ""
            return fail(f"{self.name} needs {error.name}: {install}pip install 'v2hdm{extra}'")
        except KeyboardInterrupt:
            return fail(self.interrupted)
        except Exception as error:
            if (line := describe(error)) is None:
                raise
            _leave_stdout()
            return fail(line)

    def parser(self) -> argparse.ArgumentParser:
        """The beginning of its parser of arguments."""
        return _Parser(prog=self.name, description=self.says)


_NEGATIVE_NUMBER = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, and which takes -1e-05 for a number, as Python 3.14's does."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._negative_number_matcher = _NEGATIVE_NUMBER

    def error(self, message: str) -> NoReturn:
        sys.exit(fail(f"{message}; see {self.prog} --help"))


def need_installed(*modules: str) -> None:
    """Raise ModuleNotFoundError for the first of ``modules`` that is not installed; imports none of them."""
    for module in modules:
        if find_spec(module) is None:
            raise ModuleNotFoundError(f"No module named '{module}'", name=module)


def fail(message: str) -> int:
    """Print an error as one line; returns the exit code."""
    print(f"error: {one_line(message)}", file=sys.stderr)
    return EXIT_USER_ERROR


def _leave_stdout() -> None:
    """Keep Python from failing once more at its end, where nothing can be printed."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123
