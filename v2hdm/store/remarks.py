"""Warnings of an import, kept in its folder and told again whenever the import is used.

An import is made once; what was left out of it, or looked damaged, concerns every later reading as well.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from v2hdm.errors import one_line

_FILE = "warnings.txt"
_log = logging.getLogger(__name__)


class Keeper(logging.Handler):
    """Keeps warnings in the import that is worked on: its ``folder``, and ``where`` its source is named.

    Another drive may use the import under another name, so that the name of the source is not kept.
    """

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._folder: Path | None = None
        self._where = ""

    def turn_to(self, folder: Path, where: str) -> None:
        """Keep the warnings that come from now on in ``folder``."""
        self._folder = folder
        self._where = where

    def emit(self, record: logging.LogRecord) -> None:
        """Add a line to the folder's warnings."""
        if self._folder is not None:
            words = one_line(record.getMessage())
            with (self._folder / _FILE).open("a", encoding="utf-8") as file:
                file.write(f"{words.removeprefix(one_line(self._where)).removeprefix(': ')}\n")


@contextmanager
def keeping_warnings() -> Iterator[Keeper]:
    """Keep our warnings meanwhile, by a keeper that is told of which import they are."""
    keeper = Keeper()
    logger = logging.getLogger("v2hdm")
    logger.addHandler(keeper)
    try:
        yield keeper
    finally:
        logger.removeHandler(keeper)


def tell_again(folder: Path, where: str) -> None:
    """Log the warnings of an import that was made before; its source is named ``where`` now."""
    path = folder / _FILE
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            _log.warning("%s: %s", where, line)
