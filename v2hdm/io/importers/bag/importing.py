"""A bag's streams as entries of the cache: one pass over the bag for all that are not there yet."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from v2hdm.io.importers.bag.reading import bag_files, open_bag
from v2hdm.io.importers.bag.streams import Stream
from v2hdm.store.folders import (
    begin_entry,
    cannot_write,
    drop_entry,
    entry_folder,
    finish_entry,
    is_whole,
)

_log = logging.getLogger(__name__)


def import_streams(path: Path, streams: Sequence[Stream], cache: Path) -> list[Path]:
    """The folders of ``streams`` of the bag at ``path``, imported now unless they were before.

    Raises:
        DriveError: the bag is damaged, lacks a topic, or the cache cannot be written.
    """
    files = bag_files(path)
    folders = [entry_folder(cache, files, stream.label, stream.settings) for stream in streams]
    missing = {
        folder: stream for folder, stream in zip(folders, streams, strict=True) if not is_whole(folder)
    }
    if not missing:
        return folders
    size_mb = sum(file.stat().st_size for file in files) / 1e6
    labels = ", ".join(stream.label for stream in missing.values())
    _log.info("%s: importing %s from %.0f MB into %s, once", path, labels, size_mb, cache)
    try:
        with open_bag(path) as bag:
            takers: dict[str, list[Stream]] = defaultdict(list)
            for folder, stream in missing.items():
                for topic in stream.topics(bag):
                    takers[topic].append(stream)
                stream.begin(begin_entry(folder))
            for message in bag.messages(takers):
                for stream in takers[message.topic]:
                    stream.take(message)
            for folder, stream in missing.items():
                stream.finish()
                stream.close()
                finish_entry(folder)
    except OSError as failure:
        raise cannot_write(cache, failure) from None
    finally:
        for folder, stream in missing.items():
            stream.close()
            drop_entry(folder)
    return folders
