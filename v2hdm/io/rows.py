"""Rows of CSV files: their names of columns, and the cells below these."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

from v2hdm.errors import DriveError, one_line
from v2hdm.store.files import read_text


class Table(NamedTuple):
    """A CSV file: the names in its first line, and the cells of each further line with its number."""

    header: list[str]
    rows: list[tuple[int, list[str]]]


def read_rows(path: Path, separators: str, thing: str) -> Table:
    """The names and the cells of a CSV file, each row as long as the line of names.

    The first of ``separators`` in the line of names separates cells, else blanks do; ``#`` begins a comment.
    """
    text = read_text(path, DriveError)
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    lines = [*lines[:1], *(line for line in lines[1:] if not line[1].lstrip().startswith("#"))]
    if len(lines) < 2:
        raise DriveError(f"{path}: has no {thing}; expected a line of column names and one line per {thing}")
    title = lines[0][1].lstrip("\ufeff# ")
    separator = next((mark for mark in separators if mark in title), None)

    def split(line: str) -> list[str]:
        if separator is None:
            cells = line.split()
        else:
            cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
        return [one_line(cell) for cell in cells]

    try:
        header = split(title)
        rows = [(number, split(line)) for number, line in lines[1:]]
    except csv.Error as failure:
        raise DriveError(f"{path}: is not a table ({failure}); fix its quotes or its longest cell") from None
    for number, cells in rows:
        if len(cells) != len(header):
            problem = f"{len(cells)} cells under {len(header)} columns"
            raise DriveError(f"{path}: line {number}: {problem}; fix that line")
    return Table(header, rows)
