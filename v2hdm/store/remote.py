"""Folders at object stores, by URL: objects are read, written whole, created once, listed and removed.

A put replaces an object at once or not at all, and an object can be created once; nothing else is asked of a
store. Whatever fails there is one line. A drive at a store is downloaded once.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

from v2hdm.errors import ConfigError, DriveError
from v2hdm.extras import need
from v2hdm.store.folders import begin_entry, cannot_write, drop_entry, finish_entry, is_whole, note_use

_Answer = TypeVar("_Answer")
Report = Callable[[int, int], None]
"""Called as ``report(done, total)`` with numbers of objects."""

_log = logging.getLogger(__name__)

_MEMORY = "memory"
"""A store that is gone with its process: for tests."""

_PACKAGES = {
    "s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs",
    "abfs": "adlfs", "abfss": "adlfs", "az": "adlfs",
    _MEMORY: "fsspec",
}  # fmt: skip
"""Protocols of stores that replace an object at once, and the package that speaks each."""

_NOTHING = ".v2hdm-nothing"
"""A prefix that nobody writes to: cheap to list."""

_WAITS_S = (1.0, 4.0)
"""Between the tries of a call that may work the next time, beside those that the packages make themselves."""

_AT_ONCE = 32
"""Objects of one call, downloaded side by side."""

_FINAL = (errno.EINVAL, errno.EPERM, errno.ENAMETOOLONG, errno.EMSGSIZE)
_TOKENS = ("ETag", "etag", "md5Hash", "modified", "created")
_TIMES = ("LastModified", "last_modified", "updated", "modified", "created")
_MESSAGE_LETTERS = 200


def is_url(place: str) -> bool:
    """Whether a place is named by a URL."""
    return "://" in place


def place_of(text: str, option: str) -> Path | RemoteFolder:
    """The folder or the store that the setting ``option`` names; ``file://`` names a folder.

    Raises:
        ConfigError: it is no place that we can write to.
    """
    if not is_url(text):
        return Path(text)
    protocol, rest = text.split("://", 1)
    if protocol != "file":
        return RemoteFolder.at(text, option)
    if not rest.startswith("/"):
        raise ConfigError(f"{option} {text}: a folder is named as in file:///data/results")
    return Path(unquote(rest))


@dataclass(frozen=True)
class RemoteFile:
    """An object as it is listed: bytes, a token that changes with it, when it was written (s since 1970)."""

    size: int
    token: str
    written_s: float


class RemoteFolder:
    """The objects below one URL, by what their names are there.

    Every call is tried again where that may help, and raises a :class:`ConfigError` that names the URL.
    """

    def __init__(self, files: Any, root: str, url: str, option: str) -> None:
        """``files`` is the file system of fsspec, ``root`` the path of ``url`` there."""
        self._files, self._root, self.url, self._option = files, root.rstrip("/"), url.rstrip("/"), option

    @classmethod
    def at(cls, url: str, option: str) -> RemoteFolder:
        """The objects below a URL.

        Raises:
            ConfigError: it names no store that we know, or what speaks to it is not installed.
        """
        protocol, rest = url.split("://", 1)
        if protocol not in _PACKAGES:
            known = ", ".join(f"{one}://" for one in _PACKAGES if one != _MEMORY)
            raise ConfigError(f"{option} {url}: is at no store that we write to; choose a folder or {known}")
        parts = rest.rstrip("/").split("/")
        if ":" in parts[0]:
            raise ConfigError(
                f"{option} {protocol}://...: holds what is no name of a bucket; credentials belong where "
                f"{_PACKAGES[protocol]} looks for them, not into a URL"
            )
        if not all(parts) or {".", ".."} & set(parts) or any(c in "?#*[" or not c.isprintable() for c in url):
            raise ConfigError(f"{option} {url}: is no place at a store; write it as in s3://bucket/results")
        fsspec = need("fsspec", "map", f"{option} {url}", ConfigError)
        try:
            files, root = fsspec.core.url_to_fs(url, use_listings_cache=False)
        except ImportError:
            raise ConfigError(f"{option} {url}: needs {_PACKAGES[protocol]}, pip install it") from None
        except Exception as failure:  # of whatever package speaks to the store
            raise ConfigError(f"{option} {url}: cannot be opened ({_first_line(failure)})") from None
        return cls(files, root, url, option)

    def __str__(self) -> str:
        return self.url

    def check(self) -> None:
        """Ask once, so that what is wrong is reported before any work: as :meth:`listed`."""
        self._in_bucket("", lambda: self._find(f"{self._root}/{_NOTHING}"))

    def below(self, name: str) -> RemoteFolder:
        """The objects whose names begin with ``name`` and a slash."""
        return RemoteFolder(self._files, f"{self._root}/{name}", f"{self.url}/{name}", self._option)

    def read(self, name: str) -> bytes | None:
        """The content of an object; None where there is none."""
        try:
            data: bytes = self._call(name, lambda: self._files.cat_file(f"{self._root}/{name}"))
        except FileNotFoundError:
            return None
        return data

    def fetch(self, places: Mapping[str, Path]) -> None:
        """Copy objects, by name, to files.

        Raises:
            ConfigError: one is not there, or the store failed.
        """
        for path in places.values():
            path.parent.mkdir(parents=True, exist_ok=True)
        names = [f"{self._root}/{name}" for name in places]
        try:
            self._call("", lambda: self._files.get(names, [str(path) for path in places.values()]))
        except FileNotFoundError as failure:
            raise ConfigError(
                f"{self.url}: {_first_line(failure)} went while it was copied; start again"
            ) from None

    def write(self, name: str, content: bytes | Path) -> None:
        """Put an object, given as bytes or as a file, in whatever one of that name has been."""
        self._in_bucket(name, lambda: self._put(name, content, "overwrite"))

    def create(self, name: str, content: bytes | Path) -> bool:
        """Put an object where there is none of that name; whether there was none.

        Where an earlier try may have worked whose answer was lost, the object there is compared.
        """
        try:
            self._in_bucket(name, lambda: self._put(name, content, "create"))
        except FileExistsError:
            return self.read(name) == (content if isinstance(content, bytes) else content.read_bytes())
        return True

    def listed(self) -> dict[str, RemoteFile]:
        """All objects, by name.

        Raises:
            ConfigError: there is no such bucket, or it cannot be listed.
        """
        begin = f"{self._root}/"
        found = self._in_bucket("", lambda: self._find(self._root))
        return {name[len(begin) :]: _listed(one) for name, one in found.items() if name.startswith(begin)}

    def remove(self, name: str) -> None:
        """Remove an object, if it is there."""
        try:
            self._call(name, lambda: self._rm(f"{self._root}/{name}"))
        except FileNotFoundError:
            return

    def _put(self, name: str, content: bytes | Path, mode: str) -> None:
        path = f"{self._root}/{name}"
        if isinstance(content, bytes):
            self._files.pipe_file(path, content, mode=mode)
        else:
            self._files.put_file(str(content), path, mode=mode)

    def _rm(self, path: str) -> None:
        try:
            self._files.rm_file(path)
        except KeyError:  # of the store in memory
            raise FileNotFoundError(path) from None

    def _find(self, path: str) -> dict[str, Any]:
        self._files.invalidate_cache()
        found: dict[str, Any] = self._files.find(path, detail=True)
        return found

    def _in_bucket(self, name: str, work: Callable[[], _Answer]) -> _Answer:
        try:
            return self._call(name, work)
        except FileNotFoundError:
            raise ConfigError(
                f"{self.url}: no such bucket or container; make it, or give another {self._option}"
            ) from None

    def _call(self, name: str, work: Callable[[], _Answer]) -> _Answer:
        where = f"{self.url}/{name}" if name else self.url
        for wait_s in (*_WAITS_S, None):
            try:
                return work()
            except (FileNotFoundError, FileExistsError):
                raise
            except Exception as failure:  # each package has errors of its own
                refused = isinstance(failure, PermissionError) or "Credential" in type(failure).__name__
                final = refused or (isinstance(failure, OSError) and failure.errno in _FINAL)
                if wait_s is None or final:
                    advice = f"check the network and start again, or give another {self._option}"
                    if refused:
                        advice = "check the credentials, as the package that speaks to the store takes them"
                    raise ConfigError(f"{where}: does not work ({_first_line(failure)}); {advice}") from None
                _log.warning("%s: %s; trying again in %g s", where, _first_line(failure), wait_s)
                time.sleep(wait_s)
        raise AssertionError


def _first_line(failure: Exception) -> str:
    return " ".join(str(failure).split())[:_MESSAGE_LETTERS] or type(failure).__name__


def _listed(about: dict[str, Any]) -> RemoteFile:
    token = next((str(about[key]) for key in _TOKENS if about.get(key) is not None), "")
    written = next((about[key] for key in _TIMES if about.get(key) is not None), 0.0)
    if isinstance(written, str):
        written = datetime.fromisoformat(written)
    written_s = written.timestamp() if isinstance(written, datetime) else float(written)
    return RemoteFile(int(about["size"]), token.strip('"'), written_s)


def download(drive: RemoteFolder, cache: Path, report: Report) -> Path:
    """The folder in ``cache`` that holds what is below a URL now, copied once for each content it has had.

    Raises:
        DriveError: there is no drive, a name of it leads out of its folder, or the copy cannot be written.
        ConfigError: the store failed.
    """
    there = {name: one for name, one in drive.listed().items() if not name.endswith("/")}
    if not there:
        raise DriveError(f"{drive}: no such drive; give the URL of a drive's folder")
    wrong = next((name for name in there if {"", ".", ".."} & set(name.split("/")) or "\\" in name), None)
    if wrong is not None:
        raise DriveError(f"{drive}: the name {wrong!r} is none of a file in a folder; rename the object")
    called, names = drive.url.rsplit("/", 1)[-1], sorted(there)
    versions = [(name, there[name].size, there[name].token) for name in names]
    digest = hashlib.sha256(json.dumps([drive.url, versions]).encode()).hexdigest()
    entry = cache / f"{called}-{digest[:12]}"
    if is_whole(entry):
        note_use(entry)
        return entry / called
    size_mb = sum(one.size for one in there.values()) / 1e6
    _log.info("%s: copying %d objects of %.1f MB to %s", drive, len(there), size_mb, entry)
    partial = begin_entry(entry) / called
    try:
        for begin in range(0, len(names), _AT_ONCE):
            some = names[begin : begin + _AT_ONCE]
            drive.fetch({name: partial / name for name in some})
            for name in some:
                if (partial / name).stat().st_size != there[name].size:
                    raise DriveError(f"{drive}/{name}: changes while it is copied; start again")
            report(begin + len(some), len(names))
        finish_entry(entry)
    except OSError as failure:
        raise cannot_write(entry, failure) from None
    finally:
        drop_entry(entry)
    return entry / called
