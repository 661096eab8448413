"""The subject of a document: the survey, the drive and its receiver, and the coordinates, as rows of text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import NamedTuple

from v2hdm.report.page.facts import Facts
from v2hdm.report.page.reference import NOT_STATED, Reference

_FIRST_DATE_S = 6e8  # times that are later count from 1970, as of images; earlier ones from anything
_LAST_DATE_S = 4.1e9  # in the year 2099; later ones are in other units


class Row(NamedTuple):
    """A line of the document's head: its name and what is stated."""

    name: str
    text: str


class Identity(NamedTuple):
    """The rows of the document's head, by what they are about."""

    survey: tuple[Row, ...]
    system: tuple[Row, ...]
    ground: tuple[Row, ...]


def identity_of(facts: Facts, reference: Reference) -> Identity:
    """All fields; a field that nobody has stated reads so."""
    job = facts.job.job
    survey = (
        Row("Site", job.site or NOT_STATED),
        Row("Client", job.client or NOT_STATED),
        Row("Operator", job.operator or NOT_STATED),
        Row("Date of the drive", drive_date(facts)),
        Row("Receiver", job.receiver or NOT_STATED),
        Row("RTK-fixed positions", _fixed(facts)),
    )
    system = (
        Row("Horizontal CRS", reference.horizontal),
        Row("Vertical CRS", reference.vertical),
        Row("Datum", reference.datum),
        Row("Epoch", reference.epoch),
        Row("Geoid model", reference.geoid),
    )
    return Identity(survey, system, _ground(facts))


def drive_date(facts: Facts) -> str:
    """The days and hours of the drive by its images' stamps, UTC, never those of the mapping."""
    spans = facts.occasion.sessions_s
    if not spans:
        return f"{NOT_STATED}: this result keeps no times of its drive"
    if not all(_FIRST_DATE_S < stamp_s < _LAST_DATE_S for span in spans for stamp_s in span):
        first_s, last_s = spans[0]
        return f"{NOT_STATED}: the drive's times are not dates, but {first_s:.1f} s to {last_s:.1f} s"
    return "; ".join(_day(first_s, last_s) for first_s, last_s in spans)


def _day(first_s: float, last_s: float) -> str:
    first, last = (datetime.fromtimestamp(stamp_s, tz=UTC) for stamp_s in (first_s, last_s))
    ends = f"{last:%H:%M}" if first.date() == last.date() else f"{last:%Y-%m-%d %H:%M}"
    return f"{first:%Y-%m-%d}, {first:%H:%M} to {ends} UTC"


def _fixed(facts: Facts) -> str:
    reception = facts.reception
    if reception is None or reception.rtk_fixed is None or not reception.positions:
        return f"{NOT_STATED}: the recorded poses say nothing of their fix"
    share = 100 * reception.rtk_fixed / reception.positions
    # What is not all never reads so.
    digits = next(
        (n for n in (1, 2, 3) if reception.rtk_fixed == reception.positions or round(share, n) < 100), 3
    )
    return f"{share:.{digits}f} % of {reception.positions:,} recorded while images were taken"


def _ground(facts: Facts) -> tuple[Row, ...]:
    coverage = facts.coverage
    if coverage is None:
        unknown = f"{NOT_STATED}: make the report again with the drive (--drive)"
        return (Row("Ground sample distance", unknown), Row("Area", unknown))
    sample_m = coverage.sample_of_covered_m()
    distance = NOT_STATED
    if math.isfinite(sample_m):
        distance = (
            f"{1000 * sample_m:.0f} mm (median over the covered ground, each place by its finest image)"
        )
    area = f"{coverage.covered_m2:,.0f} m² covered by three images or more, {coverage.seen_m2:,.0f} m² seen"
    return (Row("Ground sample distance", distance), Row("Area", area))


def method_words(facts: Facts, reference: Reference) -> str:
    """The method, in one paragraph."""
    cameras = _listed(list(facts.cameras))
    way = "" if facts.route is None else f" along {facts.route.way_m[-1]:.0f} m"
    rig = f"{_count(len(facts.cameras), 'calibrated camera')} ({cameras})"
    frame = "those of the map" if reference.grid.is_local else f"in {reference.grid.crs}"
    sentences = [
        f"A vehicle with a satellite receiver and {rig} drove{way} through the site and took "
        f"{facts.occasion.images:,} images.",
        "A neural network found the paint in each image, and the corners of each marking were fitted to its "
        "edges, each with a covariance.",
        "One least-squares adjustment of all images then estimated the corners of all markings, the mounting "
        "of each camera and the errors of the recorded poses, with the covariance of each.",
        "A candidate is in the map if, from image to image, it moves as paint on the ground does, with a "
        "probability of 90 % or more.",
        f"Coordinates are {frame}.",
    ]
    if facts.check_points:
        sentences.append("Surveyed check points, which no estimate has used, test the result.")
    return " ".join(sentences)


def _listed(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)


_WORDS: Mapping[int, str] = {1: "one", 2: "two", 3: "three", 4: "four", 5: "five", 6: "six"}
"""Numbers that are written as words in the text of a document."""


def _count(number: int, what: str) -> str:
    return f"{_WORDS.get(number, str(number))} {what}{'' if number == 1 else 's'}"
