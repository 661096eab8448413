"""Results at an object store: put there file by file, and whole from the moment when their list is there.

The list, ``.v2hdm-results.jsonl``, names our objects with their hashes and versions.
While a result is put or replaced there is none, but ``.v2hdm-unfinished.jsonl``, which says what was ours and
what will be: by the two a later process tells our objects from those of others, which it never touches.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from v2hdm.errors import ConfigError
from v2hdm.store.listing import LIST
from v2hdm.store.objects.bucket import Bucket, Thing
from v2hdm.store.objects.lease import LEASES, Lease, held

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
    """A place to write single objects to; ``tell`` is that of :func:`v2hdm.store.objects.lease.held`.

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
