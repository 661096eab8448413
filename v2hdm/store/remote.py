"""Objects below a URL: read, written whole, created once, listed, removed; what fails is told in one line.

One writer at a time at a place of a store, which has no locks that a death releases.

Who writes holds a lease: an object that can be created once, called by a number, and
beside it a beat that it changes every few seconds. Who finds a lease watches its beat: where it changes, the
holder is alive and the place is refused; where it has been silent for long, by the watcher's own clock, the
next number is created, which only one can. The highest number holds.

Results at an object store: put there file by file, and whole from the moment when their list is there.

The list, ``.v2hdm-results.jsonl``, names our objects with their hashes and versions.
While a result is put or replaced there is none, but ``.v2hdm-unfinished.jsonl``, which says what was ours and
what will be: by the two a later process tells our objects from those of others, which it never touches.

A drive at an object store, copied into the cache, once for each content that it has had.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

from v2hdm.errors import ConfigError, DriveError
from v2hdm.extras import need
from v2hdm.store.folders import begin_entry, cannot_write, drop_entry, finish_entry, is_whole, note_use
from v2hdm.store.inputs import LIST

_Answer = TypeVar("_Answer")
_log = logging.getLogger(__name__)

_MEMORY = "memory"
"""A store that is gone with its process: for tests."""

_PACKAGES = {
    "s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs",
    "abfs": "adlfs", "abfss": "adlfs", "az": "adlfs",
    _MEMORY: "fsspec",
}  # fmt: skip
"""Protocols of stores that replace an object at once, and the package that speaks each."""

_FOLDER = "file"
_NOTHING = ".v2hdm-nothing"
"""A prefix that nobody writes to: cheap to list."""

_WAITS_S = (1.0, 4.0)
"""Between the tries of a call that may work the next time, beside those that the packages make themselves."""

_FINAL = (errno.EINVAL, errno.EPERM, errno.ENAMETOOLONG, errno.EMSGSIZE)
_TOKENS = ("ETag", "etag", "md5Hash", "modified", "created")
_TIMES = ("LastModified", "last_modified", "updated", "modified", "created")
_MESSAGE_LETTERS = 200


def is_url(place: str) -> bool:
    """Whether a place is named by a URL."""
    return "://" in place


def place_of(text: str, option: str) -> Path | Bucket:
    """The folder or the store that a user's setting names; ``file://`` names a folder.

    Args:
        text: of the setting.
        option: which names it, for errors.

    Raises:
        ConfigError: it is no place that we can write to.
    """
    if not is_url(text):
        return Path(text)
    protocol, rest = text.split("://", 1)
    if protocol == _FOLDER:
        if not rest.startswith("/"):
            raise ConfigError(f"{option} {text}: a folder is named as in file:///data/results")
        return Path(unquote(rest))
    return Bucket.at(text, option)


@dataclass(frozen=True)
class Thing:
    """An object as it is listed: bytes, a token that changes with it, when it was written (s since 1970)."""

    size: int
    token: str
    written_s: float


class Bucket:
    """The objects below one URL, by what their names are there.

    Every call is tried again where that may help, and raises a :class:`ConfigError` that names the URL.
    """

    def __init__(self, files: Any, root: str, url: str, option: str) -> None:
        """``files`` is the file system of fsspec, ``root`` the path of ``url`` there."""
        self._files, self._root, self.url, self._option = files, root.rstrip("/"), url.rstrip("/"), option

    @classmethod
    def at(cls, url: str, option: str) -> Bucket:
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
        """Ask once, so that what is wrong is told before any work.

        Raises:
            ConfigError: there is no such bucket, or it cannot be listed.
        """
        try:
            self._call("", lambda: self._find(f"{self._root}/{_NOTHING}"))
        except FileNotFoundError:
            raise self._no_bucket() from None

    def below(self, name: str) -> Bucket:
        """The objects whose names begin with ``name`` and a slash."""
        return Bucket(self._files, f"{self._root}/{name}", f"{self.url}/{name}", self._option)

    def read(self, name: str) -> bytes | None:
        """What an object holds; None where there is none."""
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
        try:
            self._call(name, lambda: self._put(name, content, "overwrite"))
        except FileNotFoundError:
            raise self._no_bucket() from None

    def create(self, name: str, content: bytes | Path) -> bool:
        """Put an object where there is none of that name; whether there was none.

        Where an earlier try may have worked whose answer was lost, the object there is compared.
        """
        try:
            self._call(name, lambda: self._put(name, content, "create"))
        except FileExistsError:
            return self.read(name) == (content if isinstance(content, bytes) else content.read_bytes())
        except FileNotFoundError:
            raise self._no_bucket() from None
        return True

    def listed(self) -> dict[str, Thing]:
        """All objects, by name.

        Raises:
            ConfigError: there is no such bucket, or it cannot be listed.
        """
        begin = f"{self._root}/"
        try:
            found = self._call("", lambda: self._find(self._root))
        except FileNotFoundError:
            raise self._no_bucket() from None
        return {name[len(begin) :]: _thing(about) for name, about in found.items() if name.startswith(begin)}

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

    def _call(self, name: str, work: Callable[[], _Answer]) -> _Answer:
        for wait_s in (*_WAITS_S, None):
            try:
                return work()
            except (FileNotFoundError, FileExistsError):
                raise
            except Exception as failure:  # each package has errors of its own
                if wait_s is None or _is_final(failure):
                    raise self._told(name, failure) from None
                _log.warning("%s: %s; trying again in %g s", self._named(name), _first_line(failure), wait_s)
                time.sleep(wait_s)
        raise AssertionError

    def _told(self, name: str, failure: Exception) -> ConfigError:
        if isinstance(failure, PermissionError) or "Credential" in type(failure).__name__:
            advice = "check the credentials, as the package that speaks to the store takes them"
        else:
            advice = f"check the network and start again, or give another {self._option}"
        return ConfigError(f"{self._named(name)}: does not work ({_first_line(failure)}); {advice}")

    def _named(self, name: str) -> str:
        return f"{self.url}/{name}" if name else self.url

    def _no_bucket(self) -> ConfigError:
        return ConfigError(
            f"{self.url}: no such bucket or container; make it, or give another {self._option}"
        )


def _is_final(failure: Exception) -> bool:
    """Whether another try is in vain."""
    if isinstance(failure, PermissionError) or "Credential" in type(failure).__name__:
        return True
    return isinstance(failure, OSError) and failure.errno in _FINAL


def _first_line(failure: Exception) -> str:
    return " ".join(str(failure).split())[:_MESSAGE_LETTERS] or type(failure).__name__


def _thing(about: dict[str, Any]) -> Thing:
    token = next((str(about[key]) for key in _TOKENS if about.get(key) is not None), "")
    written = next((about[key] for key in _TIMES if about.get(key) is not None), 0.0)
    return Thing(int(about["size"]), token.strip('"'), _seconds(written))


def _seconds(time_: object) -> float:
    if isinstance(time_, str):
        time_ = datetime.fromisoformat(time_)
    if isinstance(time_, datetime):
        return time_.timestamp()
    return float(time_) if isinstance(time_, int | float) else 0.0


_log = logging.getLogger(__name__)

LEASES = ".v2hdm-leases"
"""Prefix of leases."""

BEAT_S = 10.0
"""Between two beats."""

SILENT_S = 60.0
"""A holder that has not beaten for so long is taken for dead."""

_TRIES = 5


class Lease:
    """A lease that this process holds."""

    def __init__(self, objects: Bucket, number: int, secret: str, shown: str) -> None:
        self._objects, self._number, self._secret, self._shown = objects, number, secret, shown
        self._ended = threading.Event()
        self._beats = 0
        self._checked_s = _clocks()
        self._thread = threading.Thread(target=self._keep_beating, name="v2hdm-lease", daemon=True)
        self._beat()
        self._thread.start()

    def still(self) -> None:
        """:meth:`check`, where that was long ago; before each of many puts."""
        if max(now - before for now, before in zip(_clocks(), self._checked_s, strict=True)) > SILENT_S / 2:
            self.check()

    def check(self) -> None:
        """Refuse to go on where another process has taken over, as after minutes without a network.

        Raises:
            ConfigError: it has.
        """
        self._checked_s = _clocks()
        numbers = _numbers(self._objects)
        if (
            not numbers
            or max(numbers) != self._number
            or _told(self._objects, self._number)[0] != self._secret
        ):
            raise ConfigError(
                f"{self._shown}: another process has taken over, since nothing was heard of this one for "
                f"{SILENT_S:g} s; nothing more is written there"
            )

    def end(self) -> None:
        """Give it up."""
        self._ended.set()
        self._thread.join()
        with suppress(ConfigError):
            self._objects.remove(_beat_of(self._secret))
            if _told(self._objects, self._number)[0] == self._secret:
                self._objects.remove(str(self._number))

    def _keep_beating(self) -> None:
        while not self._ended.wait(BEAT_S):
            with suppress(ConfigError):  # the next beat may get through
                self._beat()

    def _beat(self) -> None:
        self._beats += 1
        self._objects.write(_beat_of(self._secret), str(self._beats).encode())


@contextmanager
def held(place: Bucket, objects: Bucket, tell: Callable[[int, int], None]) -> Iterator[Lease]:
    """Hold the lease of a place.

    Args:
        place: which nobody else writes meanwhile.
        objects: those of its lease.
        tell: called as ``tell(passed, of)`` with seconds while it listens whether a holder lives.

    Raises:
        ConfigError: another process holds it and is alive; the message names it.
    """
    shown = str(place)
    for _ in range(_TRIES):
        numbers = _numbers(objects)
        if numbers and _is_alive(objects, max(numbers), shown, tell):
            continue  # it was given up meanwhile
        number, secret = max(numbers, default=0) + 1, secrets.token_hex(8)
        if not objects.create(str(number), _holder(secret)):
            continue
        lease = Lease(objects, number, secret, shown)
        try:
            lease.check()
            for left in numbers:
                objects.remove(_beat_of(_told(objects, left)[0]))
                objects.remove(str(left))
            yield lease
        finally:
            lease.end()
        return
    raise ConfigError(f"{shown}: other processes are about to write there; wait for them")


def _is_alive(objects: Bucket, number: int, shown: str, tell: Callable[[int, int], None]) -> bool:
    """False where the holder of a lease has been silent for long, True where it gave the lease up.

    Raises:
        ConfigError: it beats.
    """
    secret, holder = _told(objects, number)
    first = objects.read(_beat_of(secret))
    began_s = time.monotonic()
    _log.info("%s: %s was writing it; listening for %g s whether it lives", shown, holder, SILENT_S)
    while (passed_s := time.monotonic() - began_s) < SILENT_S:
        if objects.read(str(number)) is None:
            return True
        if objects.read(_beat_of(secret)) != first:
            raise ConfigError(f"{shown} is being written by {holder}; wait for it, or give another place")
        tell(int(passed_s), int(SILENT_S))
        time.sleep(BEAT_S / 5)
    return False


def _holder(secret: str) -> bytes:
    host = os.uname().nodename if hasattr(os, "uname") else "this host"
    return json.dumps({"secret": secret, "holder": f"process {os.getpid()} on {host}"}).encode()


def _told(objects: Bucket, number: int) -> tuple[str, str]:
    """Secret and name of a lease's holder; empty where it is gone or no lease."""
    try:
        told = json.loads(objects.read(str(number)) or b"{}")
        return str(told["secret"]), str(told["holder"])
    except (ValueError, LookupError, TypeError, RecursionError):
        return "", "another process"


def _clocks() -> tuple[float, float]:
    """Two clocks: one may stand still while a machine is suspended, the other may be set."""
    return time.monotonic(), time.time()


def _beat_of(secret: str) -> str:
    return f"beat-{secret}"


def _numbers(objects: Bucket) -> list[int]:
    return [int(name) for name in objects.listed() if name.isdecimal()]


UNFINISHED = ".v2hdm-unfinished.jsonl"
_ABOUT = {"about": "objects that v2hdm wrote here; a rerun replaces these and no others"}


@dataclass(frozen=True)
class _Entry:
    """What is known of an object of ours; ``token`` is empty where it may not have been put."""

    file: str
    sha256: str
    size: int
    token: str = ""

    def is_of(self, thing: Thing, objects: Bucket) -> bool:
        """Whether an object there is this one: by its token, else by its content."""
        if thing.size != self.size:
            return False
        if self.token and thing.token == self.token:
            return True
        return _digest(objects.read(self.file) or b"") == self.sha256


class ResultObjects:
    """A result below a URL."""

    def __init__(self, objects: Bucket) -> None:
        self.objects = objects

    def leased(self, beside: Bucket, tell: Callable[[int, int], None]) -> AbstractContextManager[Lease]:
        """The lease of the result, which is kept ``beside`` it; ``tell`` as for :func:`held`."""
        name = self.objects.url.rsplit("/", 1)[-1]
        return held(self.objects, beside.below(f"{LEASES}/{name}"), tell)

    def is_whole(self) -> bool:
        """Whether there is a finished result whose objects are all there as they were put."""
        listing = self.objects.read(LIST)
        if listing is None:
            return False
        things = self.objects.listed()
        entries = self._entries(LIST, listing)
        return bool(entries) and all(
            one.file in things and (one.size, one.token) == (things[one.file].size, things[one.file].token)
            for one in entries
        )

    def ours(self) -> dict[str, _Entry]:
        """Our objects that are there.

        Raises:
            ConfigError: there are objects and none is ours, or one of ours was changed.
        """
        things = self.objects.listed()
        listings = {name: self.objects.read(name) for name in (LIST, UNFINISHED) if name in things}
        if things and not listings:
            raise ConfigError(f"{self.objects} holds objects that are no results of ours: give another place")
        entries = [
            one for name, listing in listings.items() if listing for one in self._entries(name, listing)
        ]
        found: dict[str, _Entry] = {}
        for name in {one.file for one in entries} & set(things):
            known = (one for one in entries if one.file == name)
            mine = next((one for one in known if one.is_of(things[name], self.objects)), None)
            if mine is None:
                raise ConfigError(
                    f"{self.objects}/{name}: was changed after we wrote it and is not replaced; move it, or "
                    "give another place"
                )
            found[name] = mine
        return found

    def put(
        self, contents: Mapping[str, bytes | Path], lease: Lease, tell: Callable[[int, int], None]
    ) -> None:
        """Put a result in the place of an earlier one, whose objects that stay the same stay.

        Args:
            contents: of objects by their names, as bytes or as files.
            lease: of the place.
            tell: called as ``tell(done, total)`` with numbers of objects.

        Raises:
            ConfigError: as :meth:`ours`; another's object has a name of ours; or the store failed.
        """
        new = {name: _entry(name, content) for name, content in contents.items()}
        ours = self.ours()
        there = self.objects.listed()
        for name in sorted(set(new) & set(there) - set(ours)):
            raise self._foreign(name)
        lease.check()
        self.objects.write(UNFINISHED, _listing([*ours.values(), *new.values()]))
        self.objects.remove(LIST)
        for name in sorted(set(ours) - set(new)):
            self.objects.remove(name)
        for number, (name, content) in enumerate(contents.items()):
            tell(number, len(contents))
            lease.still()
            if name not in ours:
                if not self.objects.create(name, content):
                    raise self._foreign(name)
            elif ours[name].sha256 != new[name].sha256:
                self.objects.write(name, content)
        lease.check()
        self.objects.write(LIST, _listing(self._as_put(new)))
        self.objects.remove(UNFINISHED)
        tell(len(contents), len(contents))

    def _as_put(self, new: Mapping[str, _Entry]) -> Iterator[_Entry]:
        there = self.objects.listed()
        for name, one in new.items():
            if name not in there or there[name].size != one.size:
                raise ConfigError(f"{self.objects}/{name}: is not there as it was put; start again")
            yield _Entry(name, one.sha256, one.size, there[name].token)

    def _foreign(self, name: str) -> ConfigError:
        return ConfigError(f"{self.objects}/{name}: is no object of ours; move it, or give another place")

    def _entries(self, name: str, listing: bytes) -> list[_Entry]:
        try:
            lines = [json.loads(line) for line in listing.decode().splitlines()[1:]]
            return [
                _Entry(str(one["file"]), str(one["sha256"]), int(one["size"]), str(one["token"]))
                for one in lines
            ]
        except (ValueError, TypeError, LookupError, RecursionError):
            raise ConfigError(f"{self.objects}/{name}: is damaged; give another place") from None


class GrowingObjects:
    """A place whose objects are written one by one, each at once."""

    def __init__(self, objects: Bucket, ours: dict[str, list[str]], lease: Lease) -> None:
        self._objects, self._ours, self._lease = objects, ours, lease

    def write(self, name: str, data: bytes) -> None:
        """Put the object ``name``.

        Raises:
            ConfigError: there is one of this name that is not ours, or the store failed.
        """
        there, digest = self._objects.read(name), _digest(data)
        if there is not None and _digest(there) not in self._ours.get(name, ()):
            raise ConfigError(f"{self._objects}/{name}: is no object of ours; give another place")
        self._lease.check()
        self._ours[name] = [*([] if there is None else [_digest(there)]), digest]
        entries = [_Entry(one, digest, 0) for one, known in self._ours.items() for digest in known]
        self._objects.write(LIST, _listing(entries))
        self._objects.write(name, data)


@contextmanager
def growing_objects(objects: Bucket, tell: Callable[[int, int], None]) -> Iterator[GrowingObjects]:
    """A place to write single objects to; ``tell`` is that of :func:`v2hdm.store.remote.held`.

    Raises:
        ConfigError: it holds something that is not ours, another process is writing it, or the store failed.
    """
    with held(objects, objects.below(LEASES), tell) as lease:
        listing = objects.read(LIST)
        if listing is None and any(not name.startswith(LEASES) for name in objects.listed()):
            raise ConfigError(f"{objects} holds objects that are no results of ours: give another place")
        known: dict[str, list[str]] = {}
        for one in ResultObjects(objects)._entries(LIST, listing or b""):
            known.setdefault(one.file, []).append(one.sha256)
        yield GrowingObjects(objects, known, lease)


def contents_of(folder: Path, without: str) -> dict[str, bytes | Path]:
    """The files of a result folder but its list, by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    names = {path.relative_to(folder).as_posix(): path for path in files}
    return {name: path for name, path in names.items() if name != without}


def _entry(name: str, content: bytes | Path) -> _Entry:
    if isinstance(content, bytes):
        return _Entry(name, _digest(content), len(content))
    with content.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return _Entry(name, digest, content.stat().st_size)


def _listing(entries: Iterable[_Entry]) -> bytes:
    return "".join(json.dumps(one) + "\n" for one in [_ABOUT, *map(asdict, entries)]).encode()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


_log = logging.getLogger(__name__)

_AT_ONCE = 32
"""Objects of one call, fetched side by side."""


def mirrored(objects: Bucket, cache: Path, tell: Callable[[int, int], None]) -> Path:
    """The folder in ``cache`` that holds what is below a URL now.

    Args:
        objects: of the drive's folder.
        cache: folder of this machine.
        tell: called as ``tell(done, total)`` with numbers of objects.

    Raises:
        DriveError: there is no drive, a name of it leads out of its folder, or the copy cannot be written.
        ConfigError: the store failed.
    """
    things = {name: one for name, one in objects.listed().items() if not name.endswith("/")}
    if not things:
        raise DriveError(f"{objects}: no such drive; give the URL of a drive's folder")
    wrong = next((name for name in things if {"", ".", ".."} & set(name.split("/")) or "\\" in name), None)
    if wrong is not None:
        raise DriveError(f"{objects}: the name {wrong!r} is none of a file in a folder; rename the object")
    called = objects.url.rsplit("/", 1)[-1]
    versions = sorted((name, one.size, one.token) for name, one in things.items())
    content = hashlib.sha256(json.dumps([objects.url, versions]).encode()).hexdigest()
    entry = cache / f"{called}-{content[:12]}"
    if is_whole(entry):
        note_use(entry)
        return entry / called
    _log.info("%s: copying %d objects of %.1f MB to %s", objects, len(things), _megabytes(things), entry)
    partial = begin_entry(entry) / called
    try:
        names = sorted(things)
        for begin in range(0, len(names), _AT_ONCE):
            some = names[begin : begin + _AT_ONCE]
            objects.fetch({name: partial / name for name in some})
            changed = next((one for one in some if (partial / one).stat().st_size != things[one].size), None)
            if changed is not None:
                raise DriveError(f"{objects}/{changed}: changes while it is copied; start again")
            tell(begin + len(some), len(names))
        finish_entry(entry)
    except OSError as failure:
        raise cannot_write(entry, failure) from None
    finally:
        drop_entry(entry)
    return entry / called


def _megabytes(things: dict[str, Thing]) -> float:
    return sum(one.size for one in things.values()) / 1e6
