"""Work on files from outside in a process of its own, with limits on its memory, its time and its files.

Decoders of bags, videos and rasters are libraries of others, which a few bytes can make ask for all of the
memory or work for ever. Here they take what :class:`Limits` allow, or end in one line of the caller's error.

The child is an interpreter that imports only the module of its work: no ``__main__`` is run again, so scripts
without a guard, notebooks and worker processes may all call this. Its answer is JSON, never an object. The
caller makes the folders that the child writes into, and so removes them if it dies; the child ends with its
parent.

Systems without ``resource`` (Windows) have the process and its end, but no limits.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, Never

from v2hdm import errors
from v2hdm.errors import REASON_LETTERS, V2hdmError, bounded, describe, one_line
from v2hdm.settings import THREAD_VARIABLES

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_START = "import sys; sys.path[:] = {path!r}; from v2hdm.safe.child import _serve; _serve()"
_TEMPORARY = ("TMPDIR", "TEMP", "TMP")  # variables that name the folder of temporary files
_SPARE_BYTES = 2_000_000_000  # memory and largest file of work on the smallest input; chosen
_TIMES = 10  # by which memory and largest file grow with the input's bytes
_STEP_S = 20.0  # processor time of a step of work on the smallest input; chosen
_STEP_S_PER_MB = 1.0  # by which that grows with the input: the index of a bag is one step


@dataclass(frozen=True)
class Limits:
    """Limits of a child."""

    memory_bytes: int  # beyond what it has when its work begins
    file_bytes: int  # of each file that it writes
    step_s: float  # processor time until it first calls :func:`next_step`, and between two calls

    @classmethod
    def of(cls, files: Iterable[Path]) -> Limits:
        """The limits of work on some files, by their size; those of the smallest where there are none."""
        size = sum(file.stat().st_size for file in files if file.is_file())
        most = _SPARE_BYTES + _TIMES * size
        return cls(most, most, _STEP_S + _STEP_S_PER_MB * size / 1e6)


def in_child(
    work: Callable[..., Any], *arguments: Any, limits: Limits, where: str, error: type[V2hdmError]
) -> Any:
    """The answer of ``work``, a function of a module, in a process of its own: None or plain values of JSON.

    Its log lines are this process's. An error that a user can mend and an OSError are raised here as they
    were there; whatever else ends the child, such as a limit, becomes one line of ``error`` that begins
    with ``where``. Within a child the work is done in place.
    """
    if _Child.step_s is not None:
        return work(*arguments)
    job = pickle.dumps((f"{work.__module__}:{work.__qualname__}", arguments, limits))
    variables = dict.fromkeys(THREAD_VARIABLES, "1")
    with TemporaryDirectory(prefix="v2hdm-") as scratch, (Path(scratch) / "stderr").open("w+b") as printed:
        variables |= dict.fromkeys(_TEMPORARY, scratch)
        child = subprocess.Popen(
            [sys.executable, "-c", _START.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=printed,
            env=os.environ | variables,
            start_new_session=True,  # Ctrl-C reaches this process alone, which ends the child
        )
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            with suppress(BrokenPipeError):  # it has died, as its answer says
                child.stdin.write(len(job).to_bytes(8, "big") + job)
                child.stdin.flush()
            answer = _answer(child.stdout)
        finally:
            child.kill()
            child.wait()
            child.stdout.close()
            with suppress(BrokenPipeError):
                child.stdin.close()
        said = _said(printed)
    if answer is None:
        _refuse_death(child.returncode, said, limits, where, error)
    if said:
        print(said, file=sys.stderr)  # what libraries print: no line of it is ours
    return _outcome_of(answer, limits, where, error)


def _outcome_of(answer: Sequence[Any], limits: Limits, where: str, error: type[V2hdmError]) -> Any:
    """The result that a child has answered with; raises the error that it has failed of."""
    kind, *content = answer
    if kind == "done":
        return content[0]
    if kind == "refused":
        name, message = content
        refusal = getattr(errors, name, error)
        raise (refusal if issubclass(refusal, V2hdmError) else error)(message)
    if kind == "failed":
        number, reason, name = content
        if number == errno.EFBIG and not _is_limited("RLIMIT_FSIZE"):
            most = f"{limits.file_bytes / 1e9:.1f} GB"
            raise error(f"{where}: becomes a file of more than {most}; it is damaged, or a trap")
        raise OSError(number, reason, name)
    if kind == "memory":
        if _is_limited("RLIMIT_AS"):
            raise MemoryError
        most = f"{limits.memory_bytes / 1e9:.1f} GB"
        raise error(f"{where}: takes more than {most} of memory; it is damaged, or a trap")
    raise RuntimeError(f"{where}: in the process that reads it:\n{content[0]}")


def next_step() -> None:
    """Begin another step of a child's work, which may take as long as each; nothing in other processes."""
    if _Child.step_s is not None:
        _limit("RLIMIT_CPU", time.process_time() + _Child.step_s)


def _answer(stream: IO[bytes]) -> list[Any] | None:
    """The last message of a child, None where it died without one; its log lines are logged on the way."""
    for line in stream:
        message = json.loads(line)
        if message[0] != "log":
            return list(message)
        _, name, level, text = message
        logger = logging.getLogger(name)
        if logger.isEnabledFor(level):
            logger.handle(logger.makeRecord(name, level, __file__, 0, text, (), None))
    return None


def _said(printed: IO[bytes]) -> str:
    printed.seek(0)
    return printed.read(1 << 20).decode("utf-8", "replace").rstrip()


def _refuse_death(code: int, said: str, limits: Limits, where: str, error: type[V2hdmError]) -> Never:
    """Raise what a child died of that has given no answer; ``code`` is its exit code or minus a signal."""
    if resource is not None and code == -signal.SIGXCPU:
        most = f"{limits.step_s:.0f} s of a processor"
        raise error(f"{where}: takes more than {most} for one piece; it is damaged, or a trap")
    if _is_limited("RLIMIT_AS"):  # by whoever started us: libraries die of it without a word
        raise MemoryError
    last_words = said.splitlines()[-1] if said else "without a word"
    reason = bounded(one_line(last_words), REASON_LETTERS)
    ending = f"signal {-code}" if code < 0 else f"exit code {code}"
    raise error(f"{where}: the process that reads it ended by {ending} ({reason}); copy it again")


def _is_limited(name: str) -> bool:
    """Whether this process itself has a limit."""
    return resource is not None and resource.getrlimit(getattr(resource, name))[0] != resource.RLIM_INFINITY


class _Child:
    """A child's knowledge of itself; ``step_s`` is None in any other process."""

    step_s: float | None = None


class _Forward(logging.Handler):
    """Sends log lines to the parent."""

    def __init__(self, pipe: IO[bytes]) -> None:
        super().__init__()
        self._pipe = pipe

    def emit(self, record: logging.LogRecord) -> None:
        _send(self._pipe, ("log", record.name, record.levelno, record.getMessage()))


def _send(pipe: IO[bytes], message: tuple[Any, ...]) -> None:
    pipe.write(json.dumps(message).encode() + b"\n")
    pipe.flush()


def _serve() -> None:
    """Do one job: what it is comes from stdin, and messages go where stdout went."""
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no message
    job = _read(int.from_bytes(_read(8), "big"))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.basicConfig(handlers=[_Forward(pipe)], level=logging.WARNING)
    logging.getLogger("v2hdm").setLevel(logging.INFO)
    try:
        message = _outcome(job)
    except MemoryError:
        message = ("memory",)
    _send(pipe, message)
    sys.stderr.flush()
    os._exit(0)  # nothing here is worth tidying: threads of libraries might hang


def _read(size: int) -> bytes:
    parts = []
    while size and (part := os.read(0, size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _outcome(job: bytes) -> tuple[Any, ...]:
    try:
        name, arguments, limits = pickle.loads(job)  # our own parent's
        module, function = name.split(":")
        __import__(module)
        work = getattr(sys.modules[module], function)
        _begin(limits)
        return "done", work(*arguments)
    except V2hdmError as refusal:
        return "refused", type(refusal).__name__, str(refusal)
    except OSError as failure:
        name = failure.filename and str(failure.filename)
        return "failed", failure.errno, failure.strerror or str(failure), name
    except Exception as failure:
        if describe(failure) == describe(MemoryError()):
            return ("memory",)
        return "bug", traceback.format_exc()


def _begin(limits: Limits) -> None:
    """Take no more than ``limits`` from here on."""
    _Child.step_s = limits.step_s
    _limit("RLIMIT_CORE", 0)
    _limit("RLIMIT_FSIZE", limits.file_bytes)
    statm = Path("/proc/self/statm")
    baseline_bytes = int(statm.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE") if statm.is_file() else 0
    _limit("RLIMIT_AS", baseline_bytes + limits.memory_bytes)
    next_step()


def _limit(name: str, most: float) -> None:
    """Lower a limit of this process, or raise it up to what its parent has."""
    if resource is None:
        return
    kind = getattr(resource, name)
    _, hard = _inherited.setdefault(name, resource.getrlimit(kind))
    finite = [limit for limit in _inherited[name] if limit != resource.RLIM_INFINITY]
    soft = min([int(most) + 1, *finite])
    with suppress(ValueError, OSError):  # a system that cannot
        resource.setrlimit(kind, (soft, hard))


_inherited: dict[str, tuple[int, int]] = {}
"""Soft and hard limits that this process began with, by name."""


def _end_with_parent() -> None:
    """End when the other end of stdin does, and take the temporary files along."""
    while os.read(0, 1):
        pass
    shutil.rmtree(os.environ[_TEMPORARY[0]], ignore_errors=True)
    os._exit(1)
