"""Folders of results: each belongs to one process at a time, and only what is ours is ever replaced.

A folder that we wrote holds a list of our files with their hashes, ``.v2hdm-results.jsonl``. Files that are
not on the list are the user's and stay through a rerun; where a file on it was changed, the rerun is refused.
A lock beside the folder is held by the process that writes and released by its end, whatever ends it.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from v2hdm.errors import ConfigError
from v2hdm.store.files import file_digest, observed_writes, refuse_url, whole_file
from v2hdm.store.folders import remove_empty
from v2hdm.store.inputs import LIST
from v2hdm.store.lock import HOST, take_lock

_log = logging.getLogger(__name__)

_HEAD = {"about": "files that v2hdm wrote here; a rerun replaces these and no others"}
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG)  # the disk is at fault


class _Target:
    """A folder of results, and the option that errors name it by."""

    def __init__(self, shown: Path, option: str) -> None:
        """Where ``shown`` leads; a folder that cannot be put aside is refused before any work."""
        refuse_url(shown)
        self.shown, self.option = shown, option
        try:
            self.path = shown.resolve()
        except (OSError, RuntimeError, ValueError):
            raise ConfigError(f"output folder {shown}: leads nowhere; give another {option}") from None
        if self.path.is_mount():
            raise ConfigError(f"output folder {shown} is a disk of its own; give a folder within it")
        if self.path.exists() and not self.path.is_dir():
            raise ConfigError(f"output folder {shown} is a file; give another {option}")

    def hidden(self, kind: str) -> Path:
        """A name beside it."""
        return self.path.with_name(f".{self.path.name}.{kind}")

    @contextmanager
    def explained(self, only: tuple[int, ...] = ()) -> Iterator[None]:
        """Make of an OSError, perhaps only of some kinds, the output folder's in one line."""
        try:
            yield
        except OSError as failure:
            if only and failure.errno not in only:
                raise
            raise ConfigError(
                f"output folder {self.shown} cannot be written: {failure.strerror}; nothing new is left: "
                f"free space or give another {self.option}"
            ) from None

    def listed(self) -> dict[str, list[str]] | None:
        """Digests of our files by name, the last one last; None if it is empty, an error if not ours."""
        if not self.path.exists() or not any(self.path.iterdir()):
            return None
        if not (self.path / LIST).is_file():
            raise ConfigError(
                f"output folder {self.shown} holds files that are no results of ours: give another "
                f"{self.option}"
            )
        listed: dict[str, list[str]] = {}
        try:
            for line in (self.path / LIST).read_text(encoding="utf-8").splitlines()[1:]:
                entry = json.loads(line)
                listed.setdefault(str(entry["file"]), []).append(str(entry["sha256"]))
        except (ValueError, TypeError, LookupError, RecursionError):
            raise ConfigError(f"{self.shown / LIST}: is damaged; give another {self.option}") from None
        return listed

    @contextmanager
    def parents(self) -> Iterator[None]:
        """Make the folders that it is to lie in; those that end up empty go again."""
        missing = [parent for parent in self.path.parents if not parent.exists()]
        with self.explained():
            self.path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield
        finally:
            for parent in missing:
                with suppress(OSError):
                    parent.rmdir()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold its lock, a file beside it, until the block or the process ends."""
        path = self.hidden("lock")
        with self.explained():
            while True:
                stream = path.open("a+", encoding="utf-8")
                if not take_lock(stream):
                    stream.seek(0)
                    holder = stream.read(200).strip()
                    stream.close()
                    raise ConfigError(
                        f"output folder {self.shown} is being written by {holder or 'another process'}; wait "
                        f"for it, or give another {self.option}"
                    )
                # The last holder may have removed the file between our opening and locking it.
                with suppress(OSError):
                    if os.path.samestat(os.fstat(stream.fileno()), path.stat()):
                        break
                stream.close()
        try:
            with self.explained():
                stream.truncate(0)
                stream.write(f"process {os.getpid()} on {HOST}\n")
                stream.flush()
            yield
        finally:
            path.unlink(missing_ok=True)
            with suppress(OSError):
                stream.close()

    def recover(self, unfinished: Path, previous: Path) -> None:
        """Tidy up after a process that was killed: its work is dropped, an earlier result put back."""
        for left in (unfinished, previous):
            if left.exists() and not (left / LIST).is_file() and any(left.iterdir()):
                raise ConfigError(f"{left}: is in our way, not ours; move it, or give another {self.option}")
        if previous.exists() and not self.path.exists():
            previous.replace(self.path)
        for left in (unfinished, previous):
            if left.exists():
                shutil.rmtree(left)

    def bring_over(self, new: Path, ours: set[str]) -> None:
        """Give what the user has put into the earlier result to the ``new`` one as well."""
        for root, folders, files in os.walk(self.path):
            here = Path(root)
            links = [name for name in folders if (here / name).is_symlink()]
            all_there = map(here.joinpath, (*files, *links))
            theirs = [path for path in all_there if path.relative_to(self.path).as_posix() not in ours]
            if theirs or not (files or folders):
                (new / here.relative_to(self.path)).mkdir(parents=True, exist_ok=True)
            for path in theirs:
                place = new / path.relative_to(self.path)
                while place.exists() or place.is_symlink():
                    place = place.with_name(f"{place.stem}.kept{place.suffix}")
                    _log.warning("%s is not ours; it is kept as %s", path, place.name)
                try:
                    os.link(path, place, follow_symlinks=False)
                except OSError:  # a file system without links
                    shutil.copy2(path, place, follow_symlinks=False)


@contextmanager
def result_folder(folder: Path, option: str = "output=") -> Iterator[Path]:
    """A hidden folder beside ``folder`` to write into, which takes its place when the block succeeds.

    An earlier result stays untouched until then; after an error nothing new is left. Files of the user's in
    an earlier result are kept. Raises ConfigError, which names the ``option`` of the folder, where it cannot
    be written, holds something that is no earlier result of ours, or another process is writing it.
    """
    with _locked(folder, option) as there:
        target, unfinished, previous = there.path, there.hidden("part"), there.hidden("previous")
        with there.explained():
            there.recover(unfinished, previous)
            listed = there.listed()
            for name, digests in (listed or {}).items():
                if (target / name).is_file() and file_digest(target / name) not in digests:
                    raise ConfigError(
                        f"{folder / name}: was changed after we wrote it: move it, or give another {option}"
                    )
            unfinished.mkdir()
            _write_list(unfinished, [])
        try:
            with there.explained(_FULL):
                yield unfinished
            with there.explained():
                files = sorted(path for path in unfinished.rglob("*") if path.is_file() and path.name != LIST)
                _write_list(unfinished, files)
                if listed is not None:
                    there.bring_over(unfinished, {LIST, *listed})
                    target.replace(previous)
                elif target.exists():
                    target.rmdir()
                unfinished.replace(target)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
            if target.exists():
                shutil.rmtree(previous, ignore_errors=True)


@contextmanager
def added_to(folder: Path, option: str) -> Iterator[Path]:
    """A finished result to write further files into, each listed before it is there.

    Raises ConfigError where the folder is no result of ours, a file that is to be replaced in it is not ours,
    it cannot be written, or another process is writing it.
    """
    with _locked(folder, option) as there:
        with there.explained():
            if there.listed() is None:
                raise ConfigError(f"{folder}: is no result of ours; give another {option}")
        with listed_files(folder, option):
            yield there.path


@contextmanager
def listed_files(folder: Path, option: str) -> Iterator[None]:
    """Within, each file that is written whole into a folder of ours is put on its list before it is there.

    Listed first, a file is ours whenever the work is cut off; its content before stays ours as well. Raises
    ConfigError where a file that is to be replaced is not ours, or the folder cannot be written.
    """
    there = _Target(folder, option)
    ours = there.listed() or {}

    def list_file(partial: Path, path: Path) -> None:
        if not (place := path.resolve()).is_relative_to(there.path):
            return
        name = place.relative_to(there.path).as_posix()
        if path.exists() and file_digest(path) not in ours.get(name, ()):
            raise ConfigError(f"{folder / name}: is no file of ours; move it, or give another {option}")
        digest = file_digest(partial)
        _append(there.path / LIST, json.dumps({"file": name, "sha256": digest}) + "\n")
        ours.setdefault(name, []).append(digest)

    with there.explained(_FULL), observed_writes(list_file):
        yield


@dataclass(frozen=True)
class GrowingFolder:
    """A folder whose files are written one by one, each at once."""

    _there: _Target

    def write(self, name: str, data: bytes) -> None:
        """Write the file ``name``; raises ConfigError where that is not ours or cannot be."""
        with self._there.explained(), whole_file(self._there.path / name) as partial:
            partial.write_bytes(data)


@contextmanager
def growing_folder(folder: Path, option: str) -> Iterator[GrowingFolder]:
    """``folder`` to write single files into, each listed first; errors as :func:`result_folder`."""
    with _locked(folder, option) as there:
        target = there.path
        with there.explained():
            is_new = there.listed() is None
            target.mkdir(exist_ok=True)
            if is_new:
                _write_list(target, [])
        try:
            with listed_files(folder, option):
                yield GrowingFolder(there)
        finally:
            if is_new and not any((target / name).is_file() for name in files_of_result(target)):
                (target / LIST).unlink(missing_ok=True)
                with suppress(OSError):
                    target.rmdir()


@contextmanager
def _locked(folder: Path, option: str) -> Iterator[_Target]:
    there = _Target(folder, option)
    with there.parents(), there.locked():
        yield there


@contextmanager
def locked_folder(folder: Path, option: str = "output=") -> Iterator[Path]:
    """Where ``folder`` leads, which no other process of ours writes within this block.

    Raises ConfigError where one does already, which it names, or the folder is nothing that can be replaced.
    """
    with _locked(folder, option) as there:
        yield there.path


def files_of_result(folder: Path) -> dict[str, str]:
    """SHA-256 of our files in a result folder by their names; none where it is no result.

    Raises ConfigError where its list is damaged.
    """
    return {name: digests[-1] for name, digests in (_Target(folder, "output=").listed() or {}).items()}


def is_whole(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether a result folder holds these files of ours, unchanged, and none is missing."""
    return bool(files) and all(
        (folder / name).is_file() and file_digest(folder / name) == digest for name, digest in files.items()
    )


def drop_result(folder: Path) -> None:
    """Remove our files from a result folder, and the folders that are empty then."""
    with suppress(OSError, ConfigError):
        for name in [*files_of_result(folder), LIST]:
            (folder / name).unlink(missing_ok=True)
        remove_empty(folder)


def _write_list(folder: Path, files: list[Path]) -> None:
    entries = [{"file": path.relative_to(folder).as_posix(), "sha256": file_digest(path)} for path in files]
    text = "".join(json.dumps(entry) + "\n" for entry in [_HEAD, *entries])
    (folder / LIST).write_text(text, encoding="utf-8")


def _append(path: Path, line: str) -> None:
    """Append a line, or nothing: half of one would damage the list."""
    size = path.stat().st_size
    try:
        with path.open("ab", buffering=0) as stream:
            data = line.encode()
            if stream.write(data) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    except OSError:
        os.truncate(path, size)
        raise
