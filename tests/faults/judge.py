"""The judge of a bad input: what the door may do with it, and what it may not.

A case makes a folder of inputs and names a door with its arguments. The judge runs that door, as a rule in
this process, and asserts its exit code, exactly one line of error without a traceback, that every file that
was there is what it was, that nothing new is left, and that it ended in time.
"""

import contextlib
import hashlib
import importlib
import inspect
import io
import logging
import os
import re
import resource
import signal
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from v2hdm.cli.main import run as run_command

LONGEST_S = 60  # of its own time, whatever else the machine does
LONGEST_WAIT_S = 5 * LONGEST_S
DATE = re.compile(rb"\d{4}-\d\d-\d\dT[\d:.]+Z")
HYDRA_DOORS = (
    "v2hdm map",
    "v2hdm experiment",
    "train.__main__",
    "train.areas.__main__",
    "train.score",
    "export.__main__",
)

Prepare = Callable[[Path], None]
Ran = tuple[int | str, str, str]
"""The end of a door: its exit code, or the name of what it raised, and its stderr and stdout."""


@dataclass(frozen=True)
class Case:
    """One bad input or situation.

    Attributes:
        name: says what is wrong.
        door: the command, or else the module whose ``main`` is run.
        arguments: of its command line.
        prepare: makes the inputs in the folder that the door is run in.
        says: what the line of error has in it, a regular expression.
        code: exit code.
        leaves: pattern of new files that may stay.
        disk_bytes: the largest file that can be written, as on a disk that is full; None for any.
        tells: whether the line may also be a warning or a finding, where the input can be worked on.
    """

    name: str
    door: str
    arguments: Sequence[str]
    prepare: Prepare
    says: str
    code: int = 2
    leaves: str = r"(?!)"
    disk_bytes: int | None = None
    tells: bool = False


@dataclass(frozen=True)
class Outcome:
    """The outcome of a door's run."""

    code: int | str
    error: str
    output: str
    before: dict[str, str]
    after: dict[str, str]

    def faults(self, case: Case) -> list[str]:
        """Forbidden acts of the door."""
        lines = [line for line in self.error.splitlines() if line.startswith("error: ")]
        defects = []
        if self.code != case.code:
            defects.append(f"exit code {self.code}, not {case.code}")
        if "Traceback" in self.error or "Error:" in self.error.replace("error:", ""):
            defects.append("a traceback")
        if case.code == 2 and len(lines) != 1:
            defects.append(f"{len(lines)} lines of error")
        text = f"{self.error}\n{self.output}" if case.tells else "\n".join(lines)
        if not re.search(case.says, text):
            defects.append(f"does not say {case.says!r}")
        if re.search(r"<class |object at 0x|None\b|\bdtype|array\(", "\n".join(lines)):
            defects.append("speaks Python")
        changed = [name for name, digest in self.before.items() if self.after.get(name) != digest]
        if changed:
            defects.append(f"changed or removed {changed}")
        new = [name for name in self.after if name not in self.before and not re.search(case.leaves, name)]
        if new:
            defects.append(f"left {new}")
        return defects


def judge(case: Case, folder: Path, run: Callable[[Case], Ran] | None = None) -> Outcome:
    """Run a case in an empty ``folder``; ``run`` takes the place of running its door in this process."""
    here = folder / "work" / "here"
    here.mkdir(parents=True)
    (folder / "precious.txt").write_text("not ours")
    (here / "precious.txt").write_text("not ours")
    case.prepare(here)
    return judge_again(case, folder, run)


def judge_again(case: Case, folder: Path, run: Callable[[Case], Ran] | None = None) -> Outcome:
    """Run a case in a ``folder`` as it is, after :func:`judge`."""
    before = state_of(folder)
    with _in_folder(folder / "work" / "here"):
        code, error, output = (run or run_here)(case)
    return Outcome(code, error, output, before, state_of(folder))


class TookTooLongError(BaseException):
    """A door did not end."""


def run_here(case: Case) -> Ran:
    """Run the door of a case in this process and in this folder."""
    error, output = io.StringIO(), io.StringIO()
    logger = logging.getLogger()
    handlers, level = list(logger.handlers), logger.level
    code: int | str
    with pytest.MonkeyPatch.context() as patch, _in_time(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.setattr(sys, "argv", [case.door, *case.arguments])
        patch.setattr(sys, "stderr", error)
        patch.setattr(sys, "stdout", output)
        logger.handlers = []
        with full_disk(case.disk_bytes):
            try:
                program, *words = case.door.split()
                if words:
                    code = run_command([*words, *case.arguments])
                else:
                    main = importlib.import_module(program).main
                    code = main(list(case.arguments)) if inspect.signature(main).parameters else main()
            except SystemExit as exit_:
                code = exit_.code if isinstance(exit_.code, int | str) else 0
            except BaseException as failure:
                code = type(failure).__name__
                error.write(traceback.format_exc())
    logger.handlers = handlers
    logger.setLevel(level)
    return code, error.getvalue(), output.getvalue()


@contextlib.contextmanager
def _in_folder(folder: Path) -> Iterator[None]:
    folder_before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(folder_before)


@contextlib.contextmanager
def _in_time() -> Iterator[None]:
    def stop(*_: object) -> None:
        raise TookTooLongError

    limits = (
        (signal.SIGALRM, signal.ITIMER_REAL, LONGEST_WAIT_S),
        (signal.SIGPROF, signal.ITIMER_PROF, LONGEST_S),
    )
    handlers = {number: signal.signal(number, stop) for number, _, _ in limits}
    for _, timer, most_s in limits:
        signal.setitimer(timer, most_s)
    try:
        yield
    finally:
        for number, timer, _ in limits:
            signal.setitimer(timer, 0)
            signal.signal(number, handlers[number])


@contextlib.contextmanager
def full_disk(most: int | None) -> Iterator[None]:
    """Files end at ``most`` bytes: the kernel refuses what is written beyond."""
    if most is None:
        yield
        return
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def state_of(folder: Path) -> dict[str, str]:
    """Kind and content of everything in a folder."""
    states = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            states[name] = f"link {path.readlink()}"
        elif path.is_dir():
            states[name] = "folder"
        elif path.is_file():
            data = path.read_bytes()
            # A GeoPackage must have the date on which it was written.
            data = DATE.sub(b"", data) if path.suffix == ".gpkg" else data
            states[name] = hashlib.sha256(data).hexdigest()
        else:
            states[name] = "special"
    return states
