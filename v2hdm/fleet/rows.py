"""The table of verdicts: a row a drive, in the terminal, as CSV and as JSON."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from v2hdm.errors import EXIT_FAILED_VERDICT, EXIT_USER_ERROR, one_line

ERROR = "ERROR"
"""Status of a drive of which there is no result."""


@dataclass(frozen=True)
class Row:
    """What became of one drive.

    Attributes:
        drive: name of the run.
        status: of the verdict, or :data:`ERROR`.
        says: the worst finding, or what went wrong, in one line.
        images, markings, minutes: how large it was, what is on its map, and how long it took.
        kept: whether an earlier result was found that was made of the same.
        folder: of the result, or its URL; empty without one.
        source: the run file, or those of a site.
    """

    drive: str
    status: str
    says: str
    images: int | None
    markings: int | None
    minutes: float | None
    kept: bool
    folder: str
    source: str

    @classmethod
    def of_error(cls, drive: str, source: str, message: str) -> Row:
        """The row of a drive that gave no result."""
        return cls(drive, ERROR, one_line(message), None, None, None, False, "", source)

    @classmethod
    def of_result(cls, drive: str, source: str, place: str, metrics: Mapping[str, Any], kept: bool) -> Row:
        """The row of a finished run, from its ``metrics.json``."""
        verdict = metrics["verdict"]
        raised = verdict["findings"]
        says = f"{raised[0]['check']} ({raised[0]['about']}): {raised[0]['says']}" if raised else ""
        sets = list(metrics["results"].values())
        markings = int(sets[-1]["Opt"]["markings"]) if sets else None
        minutes = round(sum(metrics.get("seconds", {}).values()) / 60, 3)
        images = int(metrics["drive"]["images"])
        status = str(verdict["status"])
        where = (place, source)
        return cls(drive, status, one_line(says), images, markings, minutes, kept, *where)


def as_csv(rows: Sequence[Row]) -> bytes:
    """The rows as a spreadsheet."""
    out = io.StringIO()
    writer = csv.DictWriter(out, [one.name for one in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return out.getvalue().encode()


def as_json(rows: Sequence[Row]) -> bytes:
    """The rows as JSON."""
    return (json.dumps({"drives": [asdict(row) for row in rows]}, indent=2) + "\n").encode()


def exit_code(rows: Sequence[Row]) -> int:
    """2 where a drive gave no result, else 3 where a verdict is FAIL, else 0."""
    found = {row.status for row in rows}
    return EXIT_USER_ERROR if ERROR in found else EXIT_FAILED_VERDICT if "FAIL" in found else 0
