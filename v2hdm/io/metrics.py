"""The figures of a result read again: ``metrics.json``, in which every key that anything reads has its type.

Figures that do not exist, such as the recall of a map without truth, are left out of the file.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Required, TypedDict

import msgspec

from v2hdm.errors import MapFileError
from v2hdm.store.files import load_json, take_typed
from v2hdm.store.names import METRICS

_LARGEST = sys.float_info.max  # what is beyond it is infinite, and nothing is not a number
Number = Annotated[float, msgspec.Meta(ge=-_LARGEST, le=_LARGEST)]
"""A finite number."""

_Shift = tuple[Number | None, Number | None] | None
_Corners = list[tuple[Number, Number]] | None


class Finding(TypedDict, total=False):
    """A finding of the verdict."""

    check: Required[str]
    status: Required[str]
    says: Required[str]
    about: Required[str]
    value: Number | None
    limit: Number | None
    unit: str


class StatedVerdict(TypedDict, total=False):
    """The verdict, with its findings apart; ``untold`` is what older results call ``unobservable``."""

    status: str
    headline: str | None
    findings: list[Finding] | None
    unobservable: list[Finding] | None
    untold: list[Finding] | None
    passed: list[Finding] | None


class Suspect(TypedDict):
    """A marking that may be none, with the probabilities of tests for that."""

    marking: int
    p: Number
    p_shape: Number
    p_residuals: Number
    p_sightings: Number
    disputed: Number


class LaneFigures(TypedDict, total=False):
    """The layer of the lane lines of a map."""

    length_m: Number


class MethodFigures(TypedDict, total=False):
    """The figures of one method with one set of cameras, of which each may be missing."""

    markings: int
    false_markings: Number
    recall: Number
    corner_rmse_m: Number
    corner_bias_m: Number
    median_sigma_m: Number
    reprojection_rmse_px: Number
    initial_reprojection_rmse_px: Number | None
    lanes: LaneFigures
    by_class: dict[str, dict[str, Any]]
    areas: dict[str, dict[str, Any]]
    suspicious: list[Suspect] | None


ListedChange = TypedDict(
    "ListedChange",
    {
        "id": int, "class": str, "fate": str, "shift_m": _Shift, "shift_sigma_m": _Shift,
        "probability": Number, "views": int, "found": int,
        "before_map": _Corners, "after_map": _Corners,
    },
)  # fmt: skip
"""A marking that has changed since an earlier map."""


class StatedChanges(TypedDict, total=False):
    """The changes since an earlier map."""

    listed: list[ListedChange] | None


class CheckFigures(TypedDict, total=False):
    """A survey's check points against the map."""

    compared: int
    rmse_m: Number


class ExtrinsicFigures(TypedDict, total=False):
    """The place of a camera beside the one that was stated before."""

    certainty: str | None
    x_change_m: Number | None
    y_change_m: Number | None
    z_change_m: Number | None
    roll_change_deg: Number | None
    pitch_change_deg: Number | None
    yaw_change_deg: Number | None


class StatedReception(TypedDict):
    """The quality of the positions, as their source states it."""

    positions: int
    rtk_fixed: int | None
    geoid_m: Number | None


class StatedDrive(TypedDict, total=False):
    """The drive, beside the settings that it was read with."""

    name: str
    paths: list[str] | None
    images: int
    images_sha256: str
    sessions_s: list[tuple[Number, Number]] | None
    reception: StatedReception | None


class Metrics(TypedDict, total=False):
    """The content of ``metrics.json`` as far as it is read: ``results`` by camera set, then by method."""

    name: str
    date: str
    version: str
    drive: StatedDrive | None
    versions: dict[str, str] | None
    verdict: StatedVerdict | None
    results: dict[str, dict[str, MethodFigures]] | None
    extrinsics: dict[str, ExtrinsicFigures] | None
    changes: StatedChanges | None
    check_points: CheckFigures | None
    seconds: dict[str, Number] | None


def read_metrics(folder: Path) -> Metrics:
    """The figures of the result in ``folder``; MapFileError where it is none, or a value has another type."""
    if not (folder / METRICS).is_file():
        raise MapFileError(f"{folder}: has no {METRICS}; give the result folder of v2hdm map")
    path = folder / METRICS
    metrics: Metrics = take_typed(load_json(path, MapFileError), Metrics, str(path), MapFileError)
    return metrics
