"""Whether the ground shows paint where a design has a shape: from the mosaic in a folder of results.

The contrast to the ground around a place tells, as :mod:`v2hdm.site.contrast` has it. What something hid is
not in the mosaic, or looks like neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit

from v2hdm.densities import log_normal_density
from v2hdm.errors import MapFileError
from v2hdm.records import FloatArray
from v2hdm.safe.pixels import read_pixels
from v2hdm.site.contrast import places_aside, samples_of, usual_contrast
from v2hdm.store.files import load_json, take_array, take_number
from v2hdm.store.names import MOSAIC_EXTENT, MOSAIC_PICTURE

_BESIDE_M = (0.15, 0.3)  # distances, m, from an outline at which the ground around it is sampled
_SEEN_SHARE = 0.98  # least share of the samples that the mosaic must show
_CLEAR_M = 0.6  # least distance, m, of bare ground from corners of all known paint
_FEWEST = 8  # places from which the contrast of paint, or of bare ground, is learned
_STRANGE_SHARE = 0.05  # share of places, bare or painted, that look like something else
_STRANGE_SIGMA = 0.5  # standard deviation of their contrast, log ratio of grey values


@dataclass(frozen=True)
class Mosaic:
    """The ground from above: ``grey`` (H, W), ``is_seen`` (H, W), the first row's and column's corner, m."""

    grey: NDArray[np.uint8]
    is_seen: NDArray[np.bool_]
    west_m: float
    north_m: float
    resolution_m: float

    def contrasts(self, corners_map: FloatArray) -> FloatArray:
        """Log ratio (N,) of grey values inside outlines (N, 4, 2) and around them, nan if not all seen."""
        return np.array([self._contrast(corners) for corners in corners_map], dtype=np.float64)

    def _contrast(self, corners: FloatArray) -> float:
        samples = samples_of(corners, _BESIDE_M)
        inside = self._sampled(samples.inside)
        around = self._sampled(samples.beside)
        if min(np.isfinite(inside).mean(), np.isfinite(around).mean()) < _SEEN_SHARE:
            return float("nan")
        return float(np.log((np.nanmedian(inside) + 1) / (np.nanmedian(around) + 1)))

    def _sampled(self, points_map: FloatArray) -> FloatArray:
        """Grey values (N,) at points (N, 2), nan where the mosaic has none."""
        column = np.floor((points_map[:, 0] - self.west_m) / self.resolution_m).astype(np.int64)
        row = np.floor((self.north_m - points_map[:, 1]) / self.resolution_m).astype(np.int64)
        height, width = self.grey.shape
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        row, column = (np.clip(index, 0, most - 1) for index, most in ((row, height), (column, width)))
        is_seen = inside & (self.is_seen[row, column])
        return np.where(is_seen, self.grey[row, column].astype(np.float64), np.nan)


def read_mosaic(folder: Path) -> Mosaic | None:
    """The mosaic of a result folder, or None; raises MapFileError if its extent is damaged."""
    extent = folder / MOSAIC_EXTENT
    picture = folder / MOSAIC_PICTURE
    if not extent.is_file() or not picture.is_file():
        return None
    content = load_json(extent, MapFileError)
    west_m, _, _, north_m = take_array(content.get("bounds_m"), (4,), f"{extent}: bounds_m", MapFileError)
    resolution_m = take_number(content.get("resolution_m"), f"{extent}: resolution_m", MapFileError)
    if resolution_m <= 0:
        raise MapFileError(f"{extent}: resolution_m is not positive; run v2hdm mosaic again")
    pixels = read_pixels(picture, cv2.IMREAD_UNCHANGED)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise MapFileError(f"{picture}: is not a coloured picture; run v2hdm mosaic again")
    grey = np.asarray(cv2.cvtColor(pixels[..., :3], cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    opaque = np.full(grey.shape, 255, dtype=np.uint8)
    alpha = np.asarray(pixels[..., 3] if pixels.shape[2] == 4 else opaque, dtype=np.uint8)
    return Mosaic(grey, alpha > 0, float(west_m), float(north_m), resolution_m)


def bare_probabilities(
    mosaic: Mosaic, kinds: Sequence[str], places: FloatArray, painted: Mapping[str, FloatArray]
) -> FloatArray:
    """The probability (N,) that places (N, 4, 2) of some classes are bare, nan where none can be told.

    ``painted`` holds the corners (M, 4, 2) of the map's markings by class.
    """
    everything = np.concatenate([*painted.values(), np.zeros((0, 4, 2))])
    paint = cKDTree(np.concatenate([everything, places]).reshape(-1, 2))
    aside = np.concatenate([places_aside(corners) for corners in painted.values()])
    is_clear = paint.query(aside.reshape(-1, 2))[0].reshape(-1, 4).min(axis=1) > _CLEAR_M
    of_bare = _known(mosaic.contrasts(aside[is_clear]))
    out = np.full(len(places), np.nan)
    for kind in sorted(set(kinds)):
        of_paint = _known(mosaic.contrasts(painted.get(kind, everything)))
        if min(len(of_paint), len(of_bare)) < _FEWEST:
            continue
        rows = np.flatnonzero(np.array(kinds) == kind)
        contrast = mosaic.contrasts(places[rows])
        is_known = np.isfinite(contrast)
        odds = _log_density(contrast[is_known], of_bare) - _log_density(contrast[is_known], of_paint)
        out[rows[is_known]] = expit(odds)
    return out


def _known(contrast: FloatArray) -> FloatArray:
    return contrast[np.isfinite(contrast)]


def _log_density(contrast: FloatArray, sample: FloatArray) -> FloatArray:
    """Log density (N,) of contrasts like those of a sample (M,), or of something else."""
    usual = np.log1p(-_STRANGE_SHARE) + log_normal_density(contrast, *usual_contrast(sample))
    return np.asarray(
        np.logaddexp(usual, np.log(_STRANGE_SHARE) + log_normal_density(contrast, 0.0, _STRANGE_SIGMA))
    )
