"""Folders of results: each belongs to one process at a time, and only what is ours is ever replaced.

A folder that we wrote holds a list of our files, ``.v2hdm-results.jsonl``, with their hashes and what made
them, such as ``v2hdm map of /data/monday``. Only a rerun of the same replaces them. Files that are not
on the list are the user's and stay through a rerun; where a file on it was changed, the rerun is refused.
The process that writes holds a lock beside the folder, which its end releases, whatever ends it.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from v2hdm.errors import ConfigError
from v2hdm.store.files import file_digest, observed_writes, refuse_url, whole_file
from v2hdm.store.folders import HOST, bring_over, remove_empty, take_lock
from v2hdm.store.inputs import LIST, refuse_input

_log = logging.getLogger(__name__)

_HEAD = {"about": "files that v2hdm wrote here; a rerun replaces these and no others"}
WriteFile = Callable[[str, bytes], None]  # called with a name and the content
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EFBIG)  # the disk is at fault


class _Target:
    """A folder of results, and the option of the command that names it in errors."""

    def __init__(self, shown: Path, option: str) -> None:
        """Resolve ``shown``; refuse anything but a folder before any work."""
        refuse_url(shown)
        self.shown = shown
        self.option = option
        try:
            self.path = shown.resolve()
        except (OSError, RuntimeError, ValueError):
            raise ConfigError(f"output folder {shown}: is a broken link; give another {option}") from None
        if self.path.exists() and not self.path.is_dir():
            raise ConfigError(f"output folder {shown} is a file; give another {option}")

    def hidden(self, kind: str) -> Path:
        """A hidden path beside the folder."""
        return self.path.with_name(f".{self.path.name}.{kind}")

    @contextmanager
    def explained(self, only: tuple[int, ...] = ()) -> Iterator[None]:
        """Turn an OSError, of the numbers ``only`` if given, into one line on the output folder."""
        try:
            yield
        except OSError as failure:
            if only and failure.errno not in only:
                raise
            raise ConfigError(
                f"output folder {self.shown} cannot be written: {failure.strerror}; nothing new is left: "
                f"free space or give another {self.option}"
            ) from None

    def listed(self, maker: str | None = None) -> dict[str, list[str]] | None:
        """Digests of our files by name, of one ``maker`` if given; None if empty, else ConfigError."""
        if not self.path.exists() or not any(self.path.iterdir()):
            return None
        if not (self.path / LIST).is_file():
            raise ConfigError(
                f"output folder {self.shown} holds files that V2HDM did not write: give another {self.option}"
            )
        head = self.read_list()[0]
        if maker not in (None, head):
            creator = head or "an earlier version"
            raise ConfigError(
                f"output folder {self.shown} holds a result of {creator}, not of {maker}: move it, or give "
                f"another {self.option}"
            )
        return self.digests(maker)

    def digests(self, maker: str | None) -> dict[str, list[str]]:
        """Digests on the folder's list by file name, only of those of one ``maker`` where it is given."""
        head, entries = self.read_list()
        digests_of_name: dict[str, list[str]] = {}
        for entry in entries:
            if maker in (None, entry.get("made", head)):
                digests_of_name.setdefault(entry["file"], []).append(entry["sha256"])
        return digests_of_name

    def read_list(self) -> tuple[str, list[dict[str, str]]]:
        """Read the folder's maker and the entries of its list; nothing where there is no list."""
        if not (self.path / LIST).is_file():
            return "", []
        try:
            head, *lines = map(json.loads, (self.path / LIST).read_text(encoding="utf-8").splitlines())
            entries = [{key: str(line[key]) for key in line.keys() | {"file", "sha256"}} for line in lines]
            return str(head.get("made", "")), entries
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
            raise ConfigError(f"{self.shown / LIST}: is damaged; give another {self.option}") from None

    @contextmanager
    def parents(self) -> Iterator[None]:
        """Make the folders above the result's; those that end up empty are removed again."""
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
        """Hold the folder's lock, a file beside it, until the block or the process ends."""
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
        """Tidy up after a killed process: drop its unfinished work and put an earlier result back."""
        for left in (unfinished, previous):
            if left.exists() and not (left / LIST).is_file() and any(left.iterdir()):
                raise ConfigError(f"{left}: was not written by V2HDM; move it, or give another {self.option}")
        if previous.exists() and not self.path.exists():
            previous.replace(self.path)
        if previous.exists():
            _remove_previous(previous, self.path, _Target(previous, self.option).listed() or {})
        if unfinished.exists():
            shutil.rmtree(unfinished)


def _is_ours(folder: Path, ours: Mapping[str, Sequence[str]], name: str) -> bool:
    path = folder / name
    is_listed_file = name in ours and path.is_file() and not path.is_symlink()
    return name == LIST or (is_listed_file and file_digest(path) in ours[name])


def _remove_previous(previous: Path, new: Path, ours: Mapping[str, Sequence[str]]) -> None:
    """Remove a result that a ``new`` one has replaced; the user's files in it are given to the new one."""
    bring_over(previous, new, partial(_is_ours, previous, ours))
    for path in [below for below in previous.rglob("*") if below.is_symlink() or not below.is_dir()]:
        name = path.relative_to(previous).as_posix()
        if name == LIST or name in ours or os.path.lexists(new / name):
            path.unlink()
    remove_empty(previous)


@contextmanager
def result_folder(folder: Path, option: str = "output=", maker: str = "") -> Iterator[Path]:
    """A hidden folder beside ``folder`` to write into, which takes its place when the block succeeds.

    ``maker`` says what makes the result, of what. An earlier result of the same maker stays untouched until
    then; after an error nothing new is left. What the user, or another command, has put into it is kept.
    Raises ConfigError, which names the ``option`` of the folder, where it cannot be written, holds anything
    else or an input, or another process is writing it.
    """
    with _locked(folder, option) as output:
        target = output.path
        unfinished = output.hidden("part")
        previous = output.hidden("previous")
        with output.explained():
            output.recover(unfinished, previous)
            listed = output.listed(maker)
            for name, digests in (listed or {}).items():
                refuse_input(target / name)
                if (target / name).is_file() and file_digest(target / name) not in digests:
                    raise ConfigError(
                        f"{folder / name}: was changed after we wrote it: move it, or give another {option}"
                    )
        try:
            with output.explained():
                unfinished.mkdir()
                _write_list(unfinished, maker)
            with output.explained(_FULL):
                yield unfinished
            with output.explained():
                files = sorted(path for path in unfinished.rglob("*") if path.is_file() and path.name != LIST)
                _write_list(unfinished, maker, files)
                if listed is not None:
                    for name in listed:
                        refuse_input(target / name)
                    _report_dropped(folder, listed, unfinished)
                    bring_over(target, unfinished, partial(_is_ours, target, listed))
                    others = [entry for entry in output.read_list()[1] if entry.get("made", maker) != maker]
                    for entry in others:
                        if (unfinished / entry["file"]).is_file():
                            _append(unfinished / LIST, json.dumps(entry) + "\n")
                    target.replace(previous)
                elif target.exists():
                    target.rmdir()
                unfinished.replace(target)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
            if previous.exists() and not target.exists():
                previous.replace(target)
            elif previous.exists():
                with suppress(OSError):  # the next run goes on with it
                    _remove_previous(previous, target, listed or {})


def _report_dropped(folder: Path, listed: Mapping[str, object], new: Path) -> None:
    """Warn of files of the earlier result, such as its mosaic, that the new one does not have."""
    if dropped := [name for name in listed if (folder / name).is_file() and not (new / name).exists()]:
        _log.warning("%s: removed with the earlier result: %s", folder, ", ".join(sorted(dropped)))


@contextmanager
def added_to(folder: Path, option: str) -> Iterator[Path]:
    """A finished result to write further files into, each listed before it is there; else ConfigError."""
    with _locked(folder, option) as output:
        with output.explained():
            if output.listed() is None:
                raise ConfigError(f"{folder}: is not a result of V2HDM; give another {option}")
            maker = output.read_list()[0]
        with listed_files(folder, option, maker):
            yield output.path


@contextmanager
def listed_files(folder: Path, option: str, maker: str) -> Iterator[Callable[[Path], object]]:
    """Within, each file that is written whole into a folder is put on its list before it is there.

    Listed first, a file is ours whenever the work is cut off; its content before stays ours as well. Yields a
    check of one file, for work that writes several or none. It and the writing raise ConfigError where a file
    to be replaced is not of the same ``maker``, or the folder cannot be written.
    """
    output = _Target(folder, option)
    ours = output.digests(maker)
    others = {} if output.read_list()[0] == maker else {"made": maker}

    def name_of(path: Path) -> str | None:
        """The file's name in the folder, None outside of it; refuses what must not be replaced."""
        absolute = Path(os.path.abspath(path))  # noqa: PTH100  # links stay
        roots = (Path(os.path.abspath(root)) for root in (folder, output.path))  # noqa: PTH100
        if not any(absolute.is_relative_to(root) for root in roots):
            return None
        place = path.parent.resolve() / path.name
        if path.is_symlink() or not place.is_relative_to(output.path):
            raise ConfigError(f"{path}: a link is not replaced; move it, or give another {option}")
        name = place.relative_to(output.path).as_posix()
        if path.exists() and file_digest(path) not in ours.get(name, ()):
            owner = f"not an unchanged result of {maker}" if maker else "not a file of V2HDM"
            raise ConfigError(f"{folder / name}: is {owner}; move it, or give another {option}")
        return name

    def list_file(new: Path, path: Path) -> None:
        name = name_of(path)
        if name is None:
            return
        digest = file_digest(new)
        if not (output.path / LIST).exists():
            _write_list(output.path, maker)
        entry = {"file": name, "sha256": digest, **others}
        _append(output.path / LIST, json.dumps(entry) + "\n")
        ours.setdefault(name, []).append(digest)

    with output.explained(_FULL), observed_writes(list_file):
        yield name_of


@contextmanager
def growing_folder(folder: Path, option: str, maker: str = "") -> Iterator[WriteFile]:
    """Yield a writer of named files into ``folder``, each listed first; errors as :func:`listed_files`."""
    with _locked(folder, option) as output:
        target = output.path

        def write(name: str, data: bytes) -> None:
            with output.explained(), whole_file(target / name) as partial:
                partial.write_bytes(data)

        with output.explained():
            is_new = output.listed() is None
            target.mkdir(exist_ok=True)
            if is_new:
                _write_list(target, maker)
        try:
            with listed_files(folder, option, maker):
                yield write
        finally:
            if is_new and not any((target / name).is_file() for name in files_of_result(target)):
                (target / LIST).unlink(missing_ok=True)
                with suppress(OSError):
                    target.rmdir()


@contextmanager
def _locked(folder: Path, option: str) -> Iterator[_Target]:
    output = _Target(folder, option)
    if output.path.is_mount():
        raise ConfigError(f"output folder {folder} is a mount point; give a folder within it")
    with output.parents(), output.locked():
        yield output


@contextmanager
def locked_folder(folder: Path, option: str = "output=") -> Iterator[Path]:
    """The resolved ``folder``, locked against our other processes within this block; else ConfigError."""
    with _locked(folder, option) as output:
        yield output.path


def files_of_result(folder: Path) -> dict[str, str]:
    """SHA-256 of our files in a result folder by name, if any; ConfigError where its list is damaged."""
    return {name: digests[-1] for name, digests in (_Target(folder, "output=").listed() or {}).items()}


def is_whole(folder: Path, files: Mapping[str, str]) -> bool:
    """Whether a result folder holds all of these files, unchanged."""
    return bool(files) and all(
        (folder / name).is_file() and file_digest(folder / name) == digest for name, digest in files.items()
    )


def drop_result(folder: Path) -> None:
    """Remove our files from a result folder, and the folders that are empty then."""
    with suppress(OSError, ConfigError):
        for name in [*files_of_result(folder), LIST]:
            (folder / name).unlink(missing_ok=True)
        remove_empty(folder)


def _write_list(folder: Path, maker: str, files: Sequence[Path] = ()) -> None:
    entries = [{"file": path.relative_to(folder).as_posix(), "sha256": file_digest(path)} for path in files]
    text = "".join(json.dumps(entry) + "\n" for entry in [_HEAD | {"made": maker}, *entries])
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
