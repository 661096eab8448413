"""The mosaic of the ground, where ``v2hdm mosaic`` has put one into the folder (docs/mosaic.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from v2hdm.errors import MapFileError
from v2hdm.report.page.coding import as_base64, jpeg
from v2hdm.store.files import load_json, take_array, take_mapping, take_text

EXTENT, COMPARISON = "mosaic.json", "mosaic_before_after.png"

LARGEST_BYTES = 3_500_000
"""Of the mosaic, as text in the page."""

_QUALITY = 72
_COMPARISON_WIDTH_PX = 1400


@dataclass(frozen=True)
class GroundPage:
    """The same ground before and after the optimisation (JPEG in base64), and what to see in it."""

    picture: str
    caption: str


def mosaic_layer(folder: Path) -> dict[str, Any] | None:
    """The mosaic for the map: WebP in base64 and its bounds (west, south, east, north), m; None without one.

    Raises:
        MapFileError: ``mosaic.json`` is damaged, or the picture that it names is missing.
    """
    if not (folder / EXTENT).is_file():
        return None
    content = load_json(folder / EXTENT, MapFileError)
    where = f"{folder / EXTENT}"
    bounds = take_array(content.get("bounds_m"), (4,), f"{where}: bounds_m", MapFileError)
    path = folder / Path(take_text(content.get("image"), f"{where}: image", MapFileError)).name
    coded = path.read_bytes() if path.is_file() else b""
    if path.suffix == ".webp" and 0 < len(as_base64(coded)) <= LARGEST_BYTES:
        text = as_base64(coded)
    else:
        pixels = cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_UNCHANGED) if coded else None
        if pixels is None:
            raise MapFileError(f"{path}: no picture that can be read; make the mosaic again")
        text = _small_enough(pixels)
    return {"src": text, "type": "image/webp", "bounds": bounds.tolist()}


def _small_enough(pixels: np.ndarray) -> str:
    """A picture in base64, as large as its budget allows."""
    while True:
        coded = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()
        text = as_base64(coded)
        if len(text) <= LARGEST_BYTES:
            return text
        factor = 0.9 * float(np.sqrt(LARGEST_BYTES / len(text)))
        size = (max(1, round(pixels.shape[1] * factor)), max(1, round(pixels.shape[0] * factor)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)


def ground_page(folder: Path) -> GroundPage | None:
    """The comparison, with its sharpness; None where the folder has none."""
    path = folder / COMPARISON
    pixels = cv2.imread(str(path)) if path.is_file() else None
    if pixels is None:
        return None
    factor = min(1.0, _COMPARISON_WIDTH_PX / pixels.shape[1])
    size = (round(pixels.shape[1] * factor), round(pixels.shape[0] * factor))
    shown = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    told: Mapping[str, Any] = {}
    if (folder / EXTENT).is_file():
        content = load_json(folder / EXTENT, MapFileError)
        told = take_mapping(content.get("sharpness", {}), f"{folder / EXTENT}: sharpness", MapFileError)
    caption = "All images laid on the ground, by the initial and by the optimised calibration and poses."
    if told.get("edges"):
        before, after = (100 * float(told[f"edge_width_{one}_m"]) for one in ("before", "after"))
        caption += (
            f" Paint edges are {before:.1f} cm wide before and {after:.1f} cm after: "
            f"{float(told['after_over_before']):.1f} times as sharp (median of {told['edges']} sides)."
        )
    return GroundPage(jpeg(shown, 84), caption)
