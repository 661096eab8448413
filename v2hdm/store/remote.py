"""Folders at object stores, by URL: a finished result is uploaded, its list last.

A store must replace an object at once or not at all, and let an object be created only once; we rely on
nothing else. Whatever fails there becomes an error of one line.

The list, ``.v2hdm-results.jsonl``, names our objects with their hashes and versions. During an upload there
is ``.v2hdm-unfinished.jsonl`` instead, which names its writer, the objects that were ours and those that will
be. From these lists we tell our objects from those of others, which are never touched. A second writer is
refused.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from v2hdm.errors import REASON_LETTERS, ConfigError, bounded, need, one_line
from v2hdm.store.files import file_digest
from v2hdm.store.inputs import LIST

Report = Callable[[int, int], None]  # called as report(done, total) with numbers of objects
_log = logging.getLogger(__name__)

_MEMORY = "memory"  # a store that is gone with its process: for tests

_PACKAGES = {
    "s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs",
    "abfs": "adlfs", "abfss": "adlfs", "az": "adlfs",
    _MEMORY: "fsspec",
}  # fmt: skip
"""Protocols of stores that replace an object at once, and the package that speaks each."""

_TOKENS = ("ETag", "etag", "md5Hash", "modified", "created")
"""Keys of a listing whose value changes with the object, the surest first."""


UNFINISHED = ".v2hdm-unfinished.jsonl"
_ABOUT = {"about": "objects that v2hdm wrote here; a rerun replaces these and no others"}


def is_url(place: str) -> bool:
    """Whether a place is named by a URL."""
    return "://" in place


def place_of(text: str, option: str) -> Path | RemoteFolder:
    """The folder or the store that the setting ``option`` names; raises ConfigError as a store does."""
    return RemoteFolder.at(text, option) if is_url(text) else Path(text)


@dataclass(frozen=True)
class RemoteFile:
    """An object as a store lists it."""

    size: int  # bytes
    token: str  # changes with the object; empty where the store names none


class RemoteFolder:
    """The objects below one URL, by name; a failure is a :class:`ConfigError` that names the URL."""

    def __init__(self, files: Any, root: str, url: str, option: str) -> None:
        """``files`` is the file system of fsspec, ``root`` the path of ``url`` there."""
        self._files = files
        self._root = root.rstrip("/")
        self.url = url.rstrip("/")
        self._option = option

    @classmethod
    def at(cls, url: str, option: str) -> RemoteFolder:
        """The objects below a URL; ConfigError where it names no store, or its package is missing."""
        protocol, path = url.split("://", 1)
        if protocol not in _PACKAGES:
            schemes = ", ".join(f"{scheme}://" for scheme in _PACKAGES if scheme != _MEMORY)
            raise ConfigError(f"{option} {url}: is not in a supported store; choose a folder or {schemes}")
        parts = path.rstrip("/").split("/")
        if ":" in parts[0] or ("@" in parts[0] and not protocol.startswith("abfs")):
            raise ConfigError(
                f"{option} {protocol}://...: is not a bucket name; credentials belong where "
                f"{_PACKAGES[protocol]} looks for them, not into a URL"
            )
        is_plain = all(letter.isprintable() and letter not in "?#*[" for letter in url)
        if not is_plain or not all(parts) or {".", ".."} & set(parts):
            raise ConfigError(f"{option} {url}: is not a path in a store; write it like s3://bucket/results")
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

    def below(self, name: str) -> RemoteFolder:
        """The objects whose names begin with ``name`` and a slash."""
        return RemoteFolder(self._files, f"{self._root}/{name}", f"{self.url}/{name}", self._option)

    def read(self, name: str) -> bytes | None:
        """The content of an object; None where there is none."""
        with suppress(FileNotFoundError), self._asked(name):
            data: bytes = self._files.cat_file(f"{self._root}/{name}")
            return data
        return None

    def write(self, name: str, content: bytes | Path) -> None:
        """Put an object, given as bytes or as a file, in place of any other of that name."""
        self._put(name, content, "overwrite")

    def create(self, name: str, content: bytes | Path) -> bool:
        """Put an object where there was none of that name, or the same, put by an earlier try; else False."""
        try:
            self._put(name, content, "create")
        except FileExistsError:
            return self.read(name) == (content if isinstance(content, bytes) else content.read_bytes())
        return True

    def _put(self, name: str, content: bytes | Path, mode: str) -> None:
        with self._asked(name, in_bucket=True):
            if isinstance(content, bytes):
                self._files.pipe_file(f"{self._root}/{name}", content, mode=mode)
            else:
                self._files.put_file(str(content), f"{self._root}/{name}", mode=mode)

    def listed(self) -> dict[str, RemoteFile]:
        """All objects, by name; raises ConfigError where there is no such bucket."""
        with self._asked(in_bucket=True):
            self._files.invalidate_cache()
            objects = self._files.find(self._root, detail=True)
        listed = {}
        for path, about in objects.items():
            if path.startswith(f"{self._root}/"):
                token = next((str(about[key]) for key in _TOKENS if about.get(key) is not None), "")
                listed[path[len(self._root) + 1 :]] = RemoteFile(int(about["size"]), token.strip('"'))
        return listed

    def remove(self, name: str) -> None:
        """Remove an object if it exists."""
        with self._asked(name), suppress(FileNotFoundError, KeyError):  # the latter of the store in memory
            self._files.rm_file(f"{self._root}/{name}")

    @contextmanager
    def _asked(self, name: str = "", in_bucket: bool = False) -> Iterator[None]:
        """Turn errors within into one line, except that an object exists or is missing."""
        try:
            yield
        except FileExistsError:
            raise
        except FileNotFoundError:
            if not in_bucket:
                raise
            raise ConfigError(f"{self.url}: no such bucket; create it or change {self._option}") from None
        except Exception as failure:  # each package has errors of its own
            advice = f"check the network and start again, or give another {self._option}"
            if isinstance(failure, PermissionError) or "Credential" in type(failure).__name__:
                advice = "check the credentials of the store's package"
            where = f"{self.url}/{name}" if name else self.url
            raise ConfigError(f"{where}: failed ({_first_line(failure)}); {advice}") from None


def _first_line(failure: Exception) -> str:
    return bounded(one_line(str(failure)), REASON_LETTERS) or type(failure).__name__


@dataclass(frozen=True)
class _Entry:
    """A line of a list: an object of ours; ``token`` is empty where it may not have been put."""

    file: str
    sha256: str
    size: int
    token: str = ""

    @classmethod
    def of(cls, name: str, content: bytes | Path) -> _Entry:
        if isinstance(content, bytes):
            return cls(name, _digest(content), len(content))
        return cls(name, file_digest(content), content.stat().st_size)

    def is_of(self, listed: RemoteFile, place: RemoteFolder) -> bool:
        """Whether an object there is this one: by its token, else by its content."""
        if listed.size != self.size:
            return False
        has_its_token = bool(self.token) and listed.token == self.token
        return has_its_token or _digest(place.read(self.file) or b"") == self.sha256


def is_whole_at(place: RemoteFolder) -> bool:
    """Whether a store holds a finished result with all its objects unchanged."""
    listing = place.read(LIST)
    if listing is None:
        return False
    objects = place.listed()
    (_, entries) = _entries(place, LIST, listing)
    return bool(entries) and all(
        entry.file in objects and objects[entry.file] == RemoteFile(entry.size, entry.token)
        for entry in entries
    )


def refuse_upload(place: RemoteFolder, writer: str) -> dict[str, _Entry]:
    """Our objects at a place, by name; ConfigError where ``writer`` may not put a result there."""
    objects = place.listed()
    names = [name for name in (LIST, UNFINISHED) if name in objects]
    lists = {name: _entries(place, name, place.read(name)) for name in names}
    if objects and not lists:
        raise ConfigError(f"{place} holds objects that are not results of V2HDM: give another place")
    holder = lists[UNFINISHED][0] if UNFINISHED in lists else writer
    if holder not in ("", writer):
        raise ConfigError(
            f"{place} is being written by {holder}, or was when it stopped; wait for it, start it "
            f"there again, or, where it is dead, remove {UNFINISHED}"
        )
    entries = [entry for _, listed in lists.values() for entry in listed]
    ours: dict[str, _Entry] = {}
    for name in {entry.file for entry in entries} & set(objects):
        entries_of_name = (entry for entry in entries if entry.file == name)
        mine = next((entry for entry in entries_of_name if entry.is_of(objects[name], place)), None)
        if mine is None:
            raise ConfigError(f"{place}/{name}: was changed after we wrote it: move it or give another place")
        ours[name] = mine
    return ours


def upload(place: RemoteFolder, contents: Mapping[str, bytes | Path], writer: str, report: Report) -> None:
    """Put a result in the place of an earlier one, which goes first.

    ``contents`` are objects by name, as bytes or as files. The same ``writer`` may go on after it was
    stopped, another is refused. Raises ConfigError as :func:`refuse_upload`, or where a name is taken.
    """
    new = {name: _Entry.of(name, content) for name, content in contents.items()}
    listing = place.read(LIST)
    ours = refuse_upload(place, writer)
    for name in sorted(set(new) & set(place.listed()) - set(ours)):
        raise _foreign(place, name)
    unfinished = _listing([*ours.values(), *new.values()], writer)
    if not place.create(UNFINISHED, unfinished):
        refuse_upload(place, writer)  # where another has begun just now
        place.write(UNFINISHED, unfinished)
    if place.read(LIST) != listing:
        place.remove(UNFINISHED)
        raise ConfigError(f"{place}: another process has just put a result there; start again")
    for name in (LIST, *ours):
        place.remove(name)
    for number, (name, content) in enumerate(contents.items()):
        report(number, len(contents))
        if not place.create(name, content):
            raise _foreign(place, name)
    objects = place.listed()
    uploaded = []
    for name, entry in new.items():
        if name not in objects or objects[name].size != entry.size:
            raise ConfigError(f"{place}/{name}: differs from what was uploaded; start again")
        uploaded.append(replace(entry, token=objects[name].token))
    place.write(LIST, _listing(uploaded))
    place.remove(UNFINISHED)
    report(len(contents), len(contents))


def contents_of(folder: Path) -> dict[str, bytes | Path]:
    """The files of a result folder but its list, by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / LIST)
    return {path.relative_to(folder).as_posix(): path for path in files}


def _entries(place: RemoteFolder, name: str, listing: bytes | None) -> tuple[str, list[_Entry]]:
    """The writer that a list names, empty where it names none, and its entries."""
    try:
        head, *lines = [json.loads(line) for line in (listing or b"{}").decode().splitlines()]
        return str(head.get("writer", "")), [
            _Entry(str(line["file"]), str(line["sha256"]), int(line["size"]), str(line["token"]))
            for line in lines
        ]
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise ConfigError(f"{place}/{name}: is damaged; give another place") from None


def _listing(entries: Iterable[_Entry], writer: str = "") -> bytes:
    head = _ABOUT | ({"writer": writer} if writer else {})
    return "".join(json.dumps(line) + "\n" for line in [head, *map(asdict, entries)]).encode()


def _foreign(place: RemoteFolder, name: str) -> ConfigError:
    return ConfigError(f"{place}/{name}: was not written by V2HDM; move it, or give another place")


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
