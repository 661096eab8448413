"""Errors, as one small family.

Every error a user can cause is a :class:`V2hdmError`: its message is one line that says what is
wrong, where, and what to do about it. Commands print that line and exit with code 2; anything
else that is raised is a bug of ours and keeps its traceback.
"""

from __future__ import annotations

import importlib
import re
from types import ModuleType

_LOGIN = re.compile(r"(?P<scheme>[a-z][a-z0-9+.-]{1,20}):/+(?P<login>[^\s'\"<>]*)@", re.IGNORECASE)
_QUERY = re.compile(
    r"([a-z][a-z0-9+.-]{1,20}:/+[^\s'\"<>?#]*[?#])[^\s'\"<>]*[^\s'\"<>:;,.)\]]", re.IGNORECASE
)
_AZURE = ("abfs", "abfss")  # whose URLs name a container where others have a login
_MASK = "***"
_MOST_MASKED = 10_000  # characters of a message that are searched for secrets; its middle is cut beyond


def masked(text: str) -> str:
    """A text without the logins, passwords and tokens of its URLs, including URLs taken for paths."""

    def without_login(url: re.Match[str]) -> str:
        if url["scheme"].lower() in _AZURE and ":" not in url["login"]:
            return url[0]
        return url[0].removesuffix(f"{url['login']}@") + f"{_MASK}@"

    return _QUERY.sub(rf"\1{_MASK}", _LOGIN.sub(without_login, text)) if ":/" in text else text


class V2hdmError(Exception):
    """Root of all errors that a user can cause and mend; its message is bounded, and no secret."""

    def __init__(self, message: str = "") -> None:
        super().__init__(bounded(masked(bounded(message, _MOST_MASKED))))


class ConfigError(V2hdmError):
    """A configuration value is unknown, missing or out of range."""


class DriveError(V2hdmError):
    """A drive on disk (images, poses, calibration) is missing, damaged or inconsistent."""


class MapFileError(V2hdmError):
    """A map or calibration file is missing, damaged or not of its documented format."""


class DetectorError(V2hdmError):
    """A detector model cannot be loaded or does not fit the images it is given."""


class MappingError(V2hdmError):
    """A drive was read but no map can be made from it."""


class WorkerError(V2hdmError):
    """A process that did part of the work died."""


class AdjustError(V2hdmError):
    """A bundle adjustment problem is malformed: the message names the offending item."""


MOST_DIGITS = 64  # of a whole number; doubles end at 309 digits, and nothing here counts beyond 2**64
_SHORT = 60  # letters of a value that an error shows; chosen
_FEW = 4  # entries of a list that an error shows in full; chosen
_MOST_LETTERS = 1200  # of a message: two paths of the longest that a system knows as text, and what is said
REASON_LETTERS = 300  # of what a library or a process says of its failure; chosen
EXIT_USER_ERROR = 2  # exit code of a command after a mistake of the user's
EXIT_FAILED_VERDICT = 3  # exit code of a command whose verdict is FAIL

# From what torch, onnxruntime, OpenCV and the loader of libraries say of it, none by a MemoryError.
_NO_MEMORY = ("bad_alloc", "llocate memory", "ailed to allocate", "map segment", "nsufficient memory")


def describe(error: BaseException) -> str | None:
    """An error as one line for the user; None for a bug."""
    if isinstance(error, V2hdmError):
        return str(error)
    if isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY):
        return "not enough memory; process less at once, or with fewer workers"
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop"):  # pathlib's, to Python 3.12
        return f"{error}; fix or remove the link"
    if isinstance(error, UnicodeEncodeError):  # no file's content, for readers refuse halves of letters
        return f"{error.object[max(error.start - 40, 0) : error.end]}: a name that is not UTF-8; rename it"
    # Disks that are full, gone or read-only can fail any call.
    if isinstance(error, OSError) and not isinstance(error, ConnectionError):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror or error}; free space or check the disk, then start again"
    return None


def shown(content: object) -> str:
    """User input as a short piece of one line; texts are quoted."""
    if content is None:
        return "nothing"
    if isinstance(content, bool):
        return str(content).lower()
    if isinstance(content, dict):
        return "a mapping with " + shown(next(iter(content))) if content else "an empty mapping"
    if isinstance(content, list | tuple):
        if 1 < len(content) <= _FEW and not any(isinstance(part, dict | list | tuple) for part in content):
            return f"[{', '.join(map(shown, content))}]"
        return f"a list of {len(content)}" if len(content) != 1 else "a list of one"
    if isinstance(content, int) and abs(content) >= 10**MOST_DIGITS:
        return "a number with very many digits"
    letters = str(content)[: _SHORT + 1]
    text = "".join(letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in letters)
    if len(text) > _SHORT:
        text = f"{text[: _SHORT - 3]}..."
    return f"'{text}'" if isinstance(content, str) else text


def bounded(message: str, most: int = _MOST_LETTERS) -> str:
    """``message`` of ``most`` letters: without its middle, for cause and remedy are at its ends."""
    return message if len(message) <= most else f"{message[: 2 * most // 3]} ... {message[-most // 3 :]}"


def one_line(message: str) -> str:
    """A message with text from untrusted files: nothing in it ends the line or moves the cursor.

    What its URLs hold of passwords is :func:`masked`.
    """
    line = " ".join(bounded(masked(bounded(message, _MOST_MASKED))).split())
    return line if line.isprintable() else "".join(c if c.isprintable() else "?" for c in line)


def need(module: str, extra: str, purpose: str, error: type[V2hdmError]) -> ModuleType:
    """Import the optional ``module``; if it is missing, raise ``error``, which names its ``extra``."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as missing:
        if missing.name is None or missing.name.split(".")[0] != module.split(".")[0]:
            raise
    raise error(
        f"{purpose} needs {module.split('.')[0]}: install the {extra} extra, pip install 'v2hdm[{extra}]'"
    )
