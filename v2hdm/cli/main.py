"""``v2hdm NAME``: find a command and run it; a user's mistake or Ctrl-C becomes one line and exit code 2.

Nothing heavy is imported here, and commands import within their work, so that ``--help`` answers at once and
Ctrl-C is one line while torch is still being loaded, too.
"""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from v2hdm import __version__
from v2hdm.errors import EXIT_FAILED_VERDICT, EXIT_USER_ERROR, describe, one_line
from v2hdm.progress import Steps, failures_of_stdout, patient, progress_lines

if TYPE_CHECKING:
    from v2hdm.records import Drive
    from v2hdm.verdict import Verdict

_NOTHING = "interrupted; nothing was written"
_GO_ON = "the same command resumes from there"


@dataclass(frozen=True)
class Command:
    """A command: its name as typed, a sentence, the extra that it needs, and the message after Ctrl-C."""

    name: str
    says: str
    extra: str | None = "map"
    interrupted: str = _NOTHING

    def guard(self, work: Callable[[], int | None]) -> int:
        """Do the work of the command; its exit code, or 2, with one line on stderr, for a user's mistake."""
        # OpenMP's threads sleep while they wait for each other. Spinning, they hold up those that they wait
        # for as soon as the machine is busy otherwise. Libraries read this when they are loaded.
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        try:
            from v2hdm.store.inputs import protected_inputs

            failures_of_stdout.clear()
            with protected_inputs():
                try:
                    code = work() or 0
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
            if (error.name or "v2hdm").split(".")[0] in ("v2hdm", "models", "train", "export"):
                raise
            extra = f"[{self.extra}]" if self.extra else ""
            install = f"install the {self.extra} extra, " if self.extra else ""
            return _fail(f"{self.name} needs {error.name}: {install}pip install 'v2hdm{extra}'")
        except KeyboardInterrupt:
            return _fail(self.interrupted)
        except Exception as error:
            if (line := describe(error)) is None:
                raise
            _leave_stdout()
            return _fail(line)


_SAYS = {
    "map": "Turn a drive into a map, calibrations and a verdict.",
    "detect": "Find markings and lanes in images, one JSON object per image.",
    "check": "Find in seconds what is wrong with a drive.",
    "calibrate points": "Calibrate a camera from surveyed ground points and their pixels.",
    "calibrate ground": "Estimate each camera's mounting from bare ground, without markings.",
    "calibrate compare": "Say whether a camera has moved between two results.",
    "localize": "Find the vehicle's poses from the markings of a map.",
    "report": "Write the report.html of a result again.",
    "view": "View a result in the browser, and correct its markings for the next run.",
    "labels": "Label a result's markings in every image of its drive, for training.",
    "mosaic": "Show the ground of a result from above, before and after the optimisation.",
    "export": "Convert a map or a calibration to other formats.",
    "experiment": "Compare all methods on both ports, as the paper does.",
    "cache": "List or prune the cache of runs.",
    "fleet": "Map many drives, each described by a run file.",
}
_EXTRAS = {"detect": None, "export": None, "cache": None}
_INTERRUPTED = {
    "map": "interrupted; finished stages are kept in the cache, no result was written",
    "detect": "interrupted before the last image; no --output was written",
    "report": "interrupted; the report is unchanged",
    "mosaic": "interrupted; files in the result folder are complete",
    "export": "interrupted; the files listed are complete",
    "experiment": f"interrupted; finished drives and detections are kept, {_GO_ON}",
    "cache": "interrupted; entries removed so far are recomputed when needed",
    "fleet": f"interrupted; finished drives are kept, {_GO_ON}",
}
COMMANDS = {
    name: Command(f"v2hdm {name}", says, _EXTRAS.get(name, "map"), _INTERRUPTED.get(name, _NOTHING))
    for name, says in _SAYS.items()
}
HOMES = {
    **{"check": ("drives", "check"), "localize": ("drives", "localize_drive")},
    **{name: ("results", name) for name in ("report", "view", "labels", "mosaic")},
    **{"map": ("runs", "map_drive"), "experiment": ("runs", "experiment"), "fleet": ("runs", "fleet")},
    "calibrate points": ("calibrate", "from_points"),
    "calibrate ground": ("calibrate", "from_ground"),
    "calibrate compare": ("calibrate", "compare"),
}
"""Modules of ``v2hdm.cli`` with several commands, and their functions; others have ``run(arguments)``."""

_OLD = {"calibrate": "calibrate points", "extrinsic": "calibrate ground", "calibration": "calibrate compare"}
"""Names of console scripts, ``v2hdm-NAME``, of commands that are called otherwise now."""


class _Line(logging.LogRecord):
    """A message of one line, whatever names of a stranger's files are in it."""

    def getMessage(self) -> str:  # noqa: N802
        return one_line(super().getMessage())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this process; returns the exit code."""
    answer_signals()
    logging.setLogRecordFactory(_Line)
    child = os.fork() if _is_limited() else 0
    if child == 0:
        return run(sys.argv[1:] if arguments is None else arguments)
    for one in (signal.SIGINT, signal.SIGTERM):
        signal.signal(one, lambda number, _: os.kill(child, number))
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code if code >= 0 else _fail(f"ended by signal {-code} under ulimit -v; {describe(MemoryError())}")


def _is_limited() -> bool:
    """Whether libraries may die of the limit of memory that this process has, without a word (SIGSEGV)."""
    if sys.platform == "win32":
        return False
    import resource

    return resource.getrlimit(resource.RLIMIT_AS)[0] != resource.RLIM_INFINITY


def script() -> int:
    """Run an old console script, such as ``v2hdm-map``, as the command that it was."""
    name = Path(sys.argv[0]).stem.removeprefix("v2hdm-")
    return main([*_OLD.get(name, name).split(), *sys.argv[1:]])


def run(arguments: Sequence[str]) -> int:
    """Run a command line in this process; 0, 2 for an error that the user can fix, 3 for verdict FAIL."""
    words = list(arguments)
    name = next((one for one in (" ".join(words[:2]), *words[:1]) if one in COMMANDS), "")
    given = words[len(name.split()) :]
    below = [one for one in COMMANDS if words and one.startswith(f"{words[0]} ")]
    if name and "--version" not in given:
        module, function = HOMES.get(name, (name, "run"))
        home = f"v2hdm.cli.{module}"
        return COMMANDS[name].guard(lambda: getattr(importlib.import_module(home), function)(given))
    if "--version" in (given if name else words[:1]):
        return _LIST.guard(lambda: print(version_line()))
    if not words or words[0] in ("-h", "--help") or (below and words[1:2] in ([], ["-h"], ["--help"])):
        return _LIST.guard(lambda: print(_list(below or list(COMMANDS))))
    return _fail(f"v2hdm {' '.join(words[: 2 if below else 1])}: no such command; v2hdm --help lists them")


_LIST = Command("v2hdm", "List the commands.", None, "interrupted")


def _list(names: Sequence[str]) -> str:
    width = max(map(len, names))
    lines = [f"  {name:{width}}  {COMMANDS[name].says}" for name in names]
    return "\n".join(["Usage: v2hdm COMMAND ...; v2hdm COMMAND --help explains a command.", "", *lines])


class _Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def error(self, message: str) -> NoReturn:
        sys.exit(_fail(f"{message}; see {self.prog} --help"))


def parser_of(name: str) -> argparse.ArgumentParser:
    """The beginning of a command's parser of arguments."""
    return _Parser(prog=COMMANDS[name].name, description=COMMANDS[name].says)


def add_drive(parser: argparse.ArgumentParser, result: str) -> None:
    """Add the arguments of commands that read a drive; ``result`` ends the name of the default folder."""
    parser.add_argument("drive", type=Path, help="a drive folder or a bag; see docs/drive-format.md")
    parser.add_argument("--camera", action="append", default=[], metavar="NAME", help="only this; repeatable")
    parser.add_argument("--format", default="auto", metavar="NAME", help="folder, kitti, bag (default: auto)")
    parser.add_argument("--output", type=Path, metavar="DIR", help=f"default: outputs/<drive>-{result}")
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="processes (default: all cores)")


def drive_of(parsed: argparse.Namespace) -> Drive:
    """Read the drive of :func:`add_drive`; ``parsed.workers``, if 0, becomes the number of cores."""
    import cv2

    from v2hdm.io.drive import ReadOptions, read_drive
    from v2hdm.settings import check_workers

    check_workers(parsed.workers)
    parsed.workers = parsed.workers or os.cpu_count() or 1
    logging.basicConfig(format="%(message)s")
    logging.getLogger("v2hdm.io").setLevel(logging.INFO)  # an import may take minutes, and says so
    cv2.setNumThreads(1)
    return read_drive(parsed.drive, ReadOptions(format=parsed.format, cameras=parsed.camera))


@contextmanager
def result_of(folder: Path, made: str, settings: Mapping[str, object]) -> Iterator[Path]:
    """The unfinished folder of a command's results, with the settings that they were made of."""
    from v2hdm.store.names import CONFIG
    from v2hdm.store.results import result_folder

    with result_folder(folder, "--output", made) as unfinished:
        (unfinished / CONFIG).write_text(json.dumps(settings) + "\n", encoding="utf-8")
        yield unfinished


def steps_of(task: str) -> Steps:
    """Progress of a task as lines on stderr."""
    return partial(progress_lines(partial(print, file=patient(sys.stderr), flush=True)), task)


def exit_code(verdict: Verdict) -> int:
    """3 for FAIL, 0 for PASS and WARN."""
    return EXIT_FAILED_VERDICT if verdict.status.value == "FAIL" else 0


def _leave_stdout() -> None:
    """Keep Python from failing once more at its end, where nothing can be printed."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123


def _fail(message: str) -> int:
    print(f"error: {one_line(message)}", file=sys.stderr)
    return EXIT_USER_ERROR


_ONE_PRESS_S = 2.0


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
    parts = [f"v2hdm {__version__}"]
    for packages in (("torch",), ("onnxruntime", "onnxruntime-gpu"), ("numba",)):
        found = []
        for name in packages:
            with suppress(metadata.PackageNotFoundError):
                found.append(f"{name} {metadata.version(name)}")
        parts += found or [f"no {packages[0]}"]
    manifest = Path(__file__).parents[1] / "detection" / "weights" / "manifest.json"
    try:
        network = json.loads(manifest.read_text(encoding="utf-8"))["files"]["default.onnx"]["sha256"]
        parts.append(f"weights {network[:8]}")
    except (OSError, ValueError, KeyError, TypeError):
        parts.append("no weights")
    return ", ".join(parts)
