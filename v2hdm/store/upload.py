"""Results at an object store: put there file by file, and whole from the moment when their list is there.

The list, ``.v2hdm-results.jsonl``, names our objects with their hashes and versions. During an upload there
is ``.v2hdm-unfinished.jsonl`` instead, which names its writer, what was ours and what will be: by the two our
objects are known from those of others, which are never touched, and a second writer is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from v2hdm.errors import ConfigError
from v2hdm.store.files import file_digest
from v2hdm.store.inputs import LIST
from v2hdm.store.remote import RemoteFile, RemoteFolder, Report

UNFINISHED = ".v2hdm-unfinished.jsonl"
_ABOUT = {"about": "objects that v2hdm wrote here; a rerun replaces these and no others"}


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

    def is_of(self, there: RemoteFile, place: RemoteFolder) -> bool:
        """Whether an object there is this one: by its token, else by its content."""
        known = self.token and there.token == self.token
        return there.size == self.size and (known or _digest(place.read(self.file) or b"") == self.sha256)


def is_whole_at(place: RemoteFolder) -> bool:
    """Whether there is a finished result at a store whose objects are all there as they were put."""
    listing = place.read(LIST)
    if listing is None:
        return False
    there, (_, entries) = place.listed(), _entries(place, LIST, listing)
    return bool(entries) and all(
        one.file in there and (one.size, one.token) == (there[one.file].size, there[one.file].token)
        for one in entries
    )


def refuse_upload(place: RemoteFolder, writer: str) -> dict[str, _Entry]:
    """Our objects that are at a place where ``writer`` may put a result.

    Raises:
        ConfigError: there are objects and none is ours, one of ours was changed, another writer has begun to
            put a result there, or the store failed.
    """
    there = place.listed()
    found = {name: _entries(place, name, place.read(name)) for name in (LIST, UNFINISHED) if name in there}
    if there and not found:
        raise ConfigError(f"{place} holds objects that are no results of ours: give another place")
    if UNFINISHED in found and found[UNFINISHED][0] not in ("", writer):
        raise _of_another(place, found[UNFINISHED][0])
    entries = [one for _, listed in found.values() for one in listed]
    ours: dict[str, _Entry] = {}
    for name in {one.file for one in entries} & set(there):
        known = (one for one in entries if one.file == name)
        mine = next((one for one in known if one.is_of(there[name], place)), None)
        if mine is None:
            raise ConfigError(
                f"{place}/{name}: was changed after we wrote it and is not replaced; move it, or "
                "give another place"
            )
        ours[name] = mine
    return ours


def upload(place: RemoteFolder, contents: Mapping[str, bytes | Path], writer: str, report: Report) -> None:
    """Put a result in the place of an earlier one, whose objects that stay the same stay.

    Args:
        place: of the result.
        contents: of objects by their names, as bytes or as files.
        writer: who puts it; the same one may go on after it was stopped, another is refused.
        report: called as it goes on.

    Raises:
        ConfigError: as :func:`refuse_upload`; or another's object has a name of ours.
    """
    new = {name: _Entry.of(name, content) for name, content in contents.items()}
    listing, ours = place.read(LIST), refuse_upload(place, writer)
    for name in sorted(set(new) & set(place.listed()) - set(ours)):
        raise _foreign(place, name)
    begun = _listing([*ours.values(), *new.values()], writer)
    if not place.create(UNFINISHED, begun):
        holder, _ = _entries(place, UNFINISHED, place.read(UNFINISHED))
        if holder not in ("", writer):
            raise _of_another(place, holder)
        place.write(UNFINISHED, begun)
    if place.read(LIST) != listing:
        place.remove(UNFINISHED)
        raise ConfigError(f"{place}: another process has just put a result there; start again")
    place.remove(LIST)
    for name in sorted(set(ours) - set(new)):
        place.remove(name)
    for number, (name, content) in enumerate(contents.items()):
        report(number, len(contents))
        if name in ours and ours[name].sha256 != new[name].sha256:
            place.write(name, content)
        elif name not in ours and not place.create(name, content):
            raise _foreign(place, name)
    there, put = place.listed(), []
    for name, one in new.items():
        if name not in there or there[name].size != one.size:
            raise ConfigError(f"{place}/{name}: is not there as it was put; start again")
        put.append(replace(one, token=there[name].token))
    place.write(LIST, _listing(put))
    place.remove(UNFINISHED)
    report(len(contents), len(contents))


def contents_of(folder: Path) -> dict[str, bytes | Path]:
    """The files of a result folder but its list, by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / LIST)
    return {path.relative_to(folder).as_posix(): path for path in files}


class RemoteTable:
    """A place at a store whose objects are written one by one, each at once and listed before.

    Raises:
        ConfigError: the place holds something that is not ours, or the store failed.
    """

    def __init__(self, place: RemoteFolder) -> None:
        self._place, listing = place, place.read(LIST)
        if listing is None and place.listed():
            raise ConfigError(f"{place} holds objects that are no results of ours: give another place")
        self._ours: dict[str, list[str]] = {}
        for one in _entries(place, LIST, listing)[1]:
            self._ours.setdefault(one.file, []).append(one.sha256)

    def write(self, name: str, data: bytes) -> None:
        """Put the object ``name``.

        Raises:
            ConfigError: there is one of this name that is not ours, or another process writes it.
        """
        there, digest = self._place.read(name), _digest(data)
        before = [] if there is None else [_digest(there)]
        if not set(before) <= set(self._ours.get(name, ())):
            raise _foreign(self._place, name)
        self._ours[name] = [*before, digest]
        entries = [_Entry(one, digest, 0) for one, known in self._ours.items() for digest in known]
        self._place.write(LIST, _listing(entries))
        self._place.write(name, data)


def _entries(place: RemoteFolder, name: str, listing: bytes | None) -> tuple[str, list[_Entry]]:
    """The writer that a list names, empty where it names none, and its entries."""
    try:
        head, *lines = [json.loads(line) for line in (listing or b"{}").decode().splitlines()]
        return str(head.get("writer", "")), [
            _Entry(str(one["file"]), str(one["sha256"]), int(one["size"]), str(one["token"])) for one in lines
        ]
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
        raise ConfigError(f"{place}/{name}: is damaged; give another place") from None


def _listing(entries: Iterable[_Entry], writer: str = "") -> bytes:
    head = _ABOUT | ({"writer": writer} if writer else {})
    return "".join(json.dumps(one) + "\n" for one in [head, *map(asdict, entries)]).encode()


def _foreign(place: RemoteFolder, name: str) -> ConfigError:
    return ConfigError(f"{place}/{name}: is no object of ours; move it, or give another place")


def _of_another(place: RemoteFolder, writer: str) -> ConfigError:
    return ConfigError(
        f"{place} is being written by {writer}, or was when that was stopped; wait for it, start it there "
        f"again, or, where it is dead, remove {UNFINISHED}"
    )


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
