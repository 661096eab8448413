"""SQLite files of few bytes and many rows."""

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

_CELLS, _INTERIOR = 300, 5


def list_again(path: Path, table: str) -> None:
    """Let a table have its rows 90,000 times: its page lists one page 300 times, and that does so as well.

    With 18 such levels no query would end; see https://www.sqlite.org/fileformat.html, 1.6.
    """
    with closing(sqlite3.connect(path)) as data:
        ((root,),) = data.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", [table])
        ((size,),) = data.execute("PRAGMA page_size")
    content = bytearray(path.read_bytes())
    begin, last = (root - 1) * size, len(content) // size + 1
    content += content[begin : begin + size] + _listing(last, size)
    content[begin : begin + size] = _listing(last + 1, size)
    struct.pack_into(">I", content, 28, last + 1)
    content[92:96] = content[24:28]
    path.write_bytes(content)


def _listing(child: int, size: int) -> bytes:
    """An interior page whose cells lead to one child."""
    begin = size - 5 * _CELLS
    starts = struct.pack(f">{_CELLS}H", *range(begin, size, 5))
    page = struct.pack(">BHHHBI", _INTERIOR, 0, _CELLS, begin, 0, child) + starts
    return page.ljust(begin, b"\0") + struct.pack(">IB", child, 1) * _CELLS
