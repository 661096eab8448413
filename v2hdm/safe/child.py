"""Work on files from outside in a process of its own, with limits on its memory, its time and its files.

Decoders of bags, videos and rasters are libraries of others, which a few bytes can make ask for all of the
memory or work for ever. Here they take what :class:`Limits` allow, or end in one line of the caller's error.

The child is the fork of an interpreter that imports only the modules of such work: no ``__main__`` is run
again, so scripts without a guard, notebooks and worker processes may all call this. That interpreter, the
fork server, waits for further jobs until its parent ends: to start it is slow, and it takes 60 MB. It never
opens a file from outside. The child's answer is JSON, never an object. The caller makes the folders that the
child writes into, and so removes them if it dies; the child ends with its parent.

Where forks are not safe (macOS) or unknown (Windows), each job has an interpreter that ends with it. Systems
without ``resource`` (Windows) have the process and its end, but no limits.
"""

from __future__ import annotations

import atexit
import errno
import importlib
import json
import logging
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO, Any, ClassVar, NamedTuple, Never

from v2hdm import errors
from v2hdm.errors import REASON_LETTERS, V2hdmError, bounded, describe, one_line
from v2hdm.settings import THREAD_VARIABLES

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_START = "import sys; sys.path[:] = {path!r}; from v2hdm.safe.child import _serve; _serve()"
_TEMPORARY = ("TMPDIR", "TEMP", "TMP")  # variables that name the folder of temporary files
# Whether a child is a fork: elsewhere than on Linux, libraries of the system may not work in forks.
_FORKS = sys.platform == "linux"
_SPARE_BYTES = 2_000_000_000  # memory and largest file of work on the smallest input; chosen
_TIMES = 10  # growth of the memory limit and of the largest file per byte of input
_STEP_S = 20.0  # processor time of a step of work on the smallest input; chosen
_STEP_S_PER_MB = 1.0  # growth of that limit with the input, s/MB: indexing a bag is one step


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
    work: Callable[..., Any],
    *arguments: Any,
    limits: Limits,
    where: str,
    error: type[V2hdmError],
    libraries: Sequence[str] = (),
) -> Any:
    """The answer of ``work``, a function of a module, in a process of its own: None or plain values of JSON.

    Its log lines are this process's. An error that a user can mend and an OSError are raised here as they
    were there; whatever else ends the child, such as a limit, becomes one line of ``error`` that begins
    with ``where``. Within a child the work is done in place. ``libraries`` are modules that the work imports
    where it needs them: the fork server has them ready.
    """
    if _Child.step_s is not None:
        return work(*arguments)
    with TemporaryDirectory(prefix="v2hdm-") as scratch:
        variables = dict.fromkeys(THREAD_VARIABLES, "1") | dict.fromkeys(_TEMPORARY, scratch)
        job = _Job(work.__qualname__, arguments, limits, dict(os.environ | variables), _working_folder())
        ending = _ForkServer.idle().outcome_of((work.__module__, *libraries), job)
    if ending.answer is None:
        _refuse_death(ending.code, ending.said, limits, where, error)
    if ending.said:
        print(ending.said, file=sys.stderr)  # what libraries print: no line of it is ours
    return _outcome_of(ending.answer, limits, where, error)


class _Job(NamedTuple):
    """Work for a child: a function's module and name, and the parent's settings."""

    function: str
    arguments: tuple[Any, ...]
    limits: Limits
    environment: dict[str, str]
    folder: str | None  # that its parent works in


class _Ending(NamedTuple):
    """A child's answer, None where it died without one, its exit code, and what was printed in it."""

    answer: list[Any] | None
    code: int
    said: str


def _working_folder() -> str | None:
    try:
        return str(Path.cwd())
    except FileNotFoundError:  # somebody has removed it
        return None


class _ForkServer:
    """An interpreter that does one job after another, each in a fork; used by one thread at a time."""

    _waiting: ClassVar[list[_ForkServer]] = []

    def __init__(self, conditions: tuple[Any, ...]) -> None:
        self._conditions = conditions
        self._printed = TemporaryFile()  # noqa: SIM115  # closed with the process
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._printed,
            env=os.environ | dict.fromkeys(THREAD_VARIABLES, "1"),
            start_new_session=True,  # Ctrl-C reaches this process alone, which ends the child
        )

    @classmethod
    def idle(cls) -> _ForkServer:
        """A child started under the present settings: a waiting one, or a new one."""
        now = _conditions()
        while True:
            try:
                server = cls._waiting.pop()
            except IndexError:
                return cls(now)
            if server._conditions == now and server._process.poll() is None:
                return server
            server.end()

    def outcome_of(self, modules: Sequence[str], job: _Job) -> _Ending:
        """How a child ends that does a job of the first of ``modules``; its log lines are this process's."""
        job_bytes = pickle.dumps((modules, pickle.dumps(job)))
        self._printed.seek(0)  # the child's place in the file, too
        self._printed.truncate()
        code = None
        try:
            assert self._process.stdin is not None
            assert self._process.stdout is not None
            with suppress(BrokenPipeError):  # it has died, as its answer says
                self._process.stdin.write(len(job_bytes).to_bytes(8, "big") + job_bytes)
                self._process.stdin.flush()
            answer, code = _answer(self._process.stdout)
            self._printed.seek(0)
            said = self._printed.read(1 << 20).decode("utf-8", "replace").rstrip()
        finally:
            if code is None:
                self.end()
            else:
                self._waiting.append(self)
        return _Ending(answer, self._process.returncode if code is None else code, said)

    def end(self) -> None:
        """End the process, and the child that may be at work."""
        if self._process.returncode is None and hasattr(os, "killpg"):
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        self._close()

    def forget(self) -> None:
        """End this fork and leave the work to the process that started it."""
        self._process.returncode = 0
        self._close()

    def _close(self) -> None:
        for stream in (self._process.stdin, self._process.stdout, self._printed):
            assert stream is not None
            with suppress(BrokenPipeError):
                stream.close()

    @classmethod
    def all_waiting(cls, leave: Callable[[_ForkServer], None]) -> None:
        """Leave all that wait."""
        while cls._waiting:
            leave(cls._waiting.pop())


def _conditions() -> tuple[Any, ...]:
    """The search path and limits that an interpreter has from its parent for good."""
    names = () if resource is None else [name for name in dir(resource) if name.startswith("RLIMIT_")]
    return tuple(sys.path), *(resource.getrlimit(getattr(resource, name)) for name in names)


atexit.register(_ForkServer.all_waiting, _ForkServer.end)
if _FORKS:
    os.register_at_fork(after_in_child=partial(_ForkServer.all_waiting, _ForkServer.forget))


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


def _answer(stream: IO[bytes]) -> tuple[list[Any] | None, int | None]:
    """A child's answer, None where it died without one, and its exit code, None where its server ends, too.

    The child's log lines are logged on the way.
    """
    answer = None
    for line in stream:
        try:
            message = json.loads(line)
        except ValueError:  # it died while it wrote this
            continue
        if message[0] == "ended":
            return answer, int(message[1])
        if message[0] != "log":
            answer = list(message)
            continue
        _, name, level, text = message
        logger = logging.getLogger(name)
        if logger.isEnabledFor(level):
            logger.handle(logger.makeRecord(name, level, __file__, 0, text, (), None))
    return answer, None


def _refuse_death(code: int, said: str, limits: Limits, where: str, error: type[V2hdmError]) -> Never:
    """Raise the error of a child that died without an answer; ``code`` is its exit code or minus a signal."""
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
    """Do one job after another: what each is comes from stdin, and messages go where stdout went."""
    pipe = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no message
    while size := _read(8):
        modules, job = pickle.loads(_read(int.from_bytes(size, "big")))  # our own parent's
        for module in modules:
            with suppress(Exception):  # the child tells what it needs and cannot have
                importlib.import_module(module)
        if not _FORKS:
            _work(pipe, modules[0], job)
        child = os.fork()
        if not child:
            _work(pipe, modules[0], job)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        try:
            pipe.write(b"\n")  # the child may have died within a line
            _send(pipe, ("ended", code))
        except BrokenPipeError:
            break
    os._exit(0)


def _work(pipe: IO[bytes], module: str, job_bytes: bytes) -> Never:
    """Do one job, and end."""
    tempfile.tempdir = None
    threading.Thread(target=_end_with_parent, daemon=True).start()
    logging.basicConfig(handlers=[_Forward(pipe)], level=logging.WARNING)
    logging.getLogger("v2hdm").setLevel(logging.INFO)
    try:
        message = _outcome(module, job_bytes)
    except MemoryError:
        message = ("memory",)
    _send(pipe, message)
    sys.stderr.flush()
    os._exit(0)  # no clean-up: threads of libraries might hang


def _read(size: int) -> bytes:
    parts = []
    while size and (part := os.read(0, size)):
        parts.append(part)
        size -= len(part)
    return b"".join(parts)


def _outcome(module: str, job_bytes: bytes) -> tuple[Any, ...]:
    try:
        work_module = importlib.import_module(module)
        job = pickle.loads(job_bytes)
        os.environ.clear()
        os.environ.update(job.environment)
        if job.folder is not None:
            os.chdir(job.folder)
        _begin(job.limits)
        return "done", getattr(work_module, job.function)(*job.arguments)
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
