"""Validation of SQLite files from outside: pages that name one again and again make any number of rows."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

_STEPS = 10  # of SQLite's machine that a query may take by byte of its file: a row takes 4 to 16
_SPARE_STEPS = 1_000_000  # steps that any query may take beyond those


def limit_steps(data: Any, path: Path) -> None:
    """Limit the time of a connection's queries (sqlite3 or apsw) by the bytes of the file ``path``."""
    data.set_progress_handler(lambda: True, _STEPS * path.stat().st_size + _SPARE_STEPS)


@contextmanager
def opened(path: Path, how: str) -> Iterator[sqlite3.Connection]:
    """Open the file at ``path`` for reading; ``how`` holds SQLite's own options."""
    with closing(sqlite3.connect(f"{path.resolve().as_uri()}?{how}", uri=True)) as data:
        limit_steps(data, path)
        yield data


def rows_of(data: sqlite3.Connection, path: Path, table: str) -> Iterator[dict[str, Any]]:
    """The rows of a table; raises sqlite3.Error where they have more bytes than the file and its journal."""
    files = (path, path.with_name(f"{path.name}-wal"))
    spare_bytes = sum(file.stat().st_size for file in files if file.is_file())
    cursor = data.cursor()
    for row in cursor.execute(f'SELECT * FROM "{table}"'):
        spare_bytes -= sum(len(value) for value in row if isinstance(value, str | bytes)) + 1
        if spare_bytes < 0:
            raise sqlite3.DatabaseError("it has more rows than bytes")
        yield dict(zip((name for name, *_ in cursor.description), row, strict=True))
