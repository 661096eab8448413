"""Lanes labelled in the format of the TuSimple benchmark: one JSON object a line and image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from train.config import LabelError
from train.labels_image import LabelledImage
from v2hdm.records import FloatArray
from v2hdm.safe.texts import parse_json, read_text, shown

_KEYS = ("raw_file", "lanes", "h_samples")
_LEAST_POINTS = 2  # least number of points of a lane's line


def read_tusimple(path: Path, images: Path) -> list[LabelledImage]:
    """Every image of a TuSimple file; a lane is its columns at the rows ``h_samples``, negative for none.

    Args:
        path: the file.
        images: the folder that its ``raw_file`` entries start from.

    Raises:
        LabelError: the file is missing or damaged.
    """
    labelled = [
        _image(line, f"{path}: line {number}", images)
        for number, line in enumerate(read_text(path, LabelError).splitlines(), start=1)
        if line.strip()
    ]
    if not labelled:
        raise LabelError(f"{path}: has no images; give another file")
    return labelled


def _image(line: str, where: str, images: Path) -> LabelledImage:
    entry = parse_json(line, where, LabelError)
    missing = [key for key in _KEYS if not isinstance(entry, dict) or key not in entry]
    if missing:
        raise LabelError(f"{where}: has no {shown(missing[0])}; it takes {', '.join(_KEYS)}")
    rows = _numbers(entry["h_samples"], f"{where}: h_samples")
    if not isinstance(entry["lanes"], list):
        raise LabelError(f"{where}: lanes is no list; give one list of columns a lane")
    lanes = []
    for number, columns in enumerate(entry["lanes"]):
        u = _numbers(columns, f"{where}: lane {number}")
        if len(u) != len(rows):
            raise LabelError(
                f"{where}: lane {number} has {len(u)} columns for {len(rows)} h_samples; give one a row"
            )
        lane_px = np.column_stack([u, rows])[u >= 0]
        if len(lane_px) >= _LEAST_POINTS:
            lanes.append(lane_px[np.argsort(-lane_px[:, 1])])  # the nearest is the lowest
    return LabelledImage(where, images / str(entry["raw_file"]), lanes_px=tuple(lanes))


def _numbers(content: Any, where: str) -> FloatArray:
    try:
        numbers = np.array(content, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if numbers.ndim != 1 or not np.isfinite(numbers).all():
        raise LabelError(f"{where}: is no list of numbers; mend it")
    return numbers
