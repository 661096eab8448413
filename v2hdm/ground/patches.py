"""Ground patches common to two images: rectified, matched, and mapped back to raw pixels."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from v2hdm.geometry.planar import inside_convex
from v2hdm.geometry.rigid import ground_in_vehicle
from v2hdm.ground.model import Mount
from v2hdm.ground.motion import Motion
from v2hdm.ground.prior import Observations
from v2hdm.records import BoolArray, Drive, FloatArray, IntArray
from v2hdm.safe.pixels import read_pixels

ImageArray = NDArray[np.uint8]
Float32Array = NDArray[np.float32]

STRIP_M = 2.0  # half width of the strip about the driven path that counts as road
_PATCH_M = 0.9  # side of a patch, m
_STEP_M = 0.6  # spacing of the patches, m, which leaves an overlap of a third

_LEAST_CORRELATION = 0.5  # least normalised cross-correlation of two patches of the same ground
_LEAST_ROUNDNESS = 0.1  # ratio of a peak's curvatures; below, the patch is an edge that slides along itself
_LEAST_LEAD = 0.1  # least lead of the best peak over another one in the search window
_PEAK_CELLS = 3  # half width of a peak, grid cells

# Standard deviation, m, of the high-pass filter: highlights, shadows and wet sheen are wider, and move with
# the light or the camera rather than the ground.
_COARSEST_M = 0.1
_LEAST_CONTRAST = 1.0  # grey levels; below is the noise of an even surface
_ALL = 0.9999  # mean of flags that are all set, up to rounding
_HOMOGRAPHY_PX = 2.0  # inlier threshold of a pair's plane; kerbs, shadows and moving things are off it
_LEAST_OF_A_PAIR = 8  # least number of matches of a pair: twice the four of a homography
_AROUND_M = 2.0  # search margin around a region, m: the spacing of neighbouring images

# What moves less than this between images far apart is bonnet, shadow of the vehicle, or dirt on the lens.
_STILL_PX = 1.5


@dataclass(frozen=True)
class View:
    """One image of a pair: ``grey`` (H, W), the camera and the vehicle's pose (4, 4)."""

    grey: ImageArray
    mount: Mount
    map_from_vehicle: FloatArray

    def pixels(self, ground_map: FloatArray) -> FloatArray:
        """Raw pixels (N, 2) of ground points (N, 2) of the map, nan outside the image."""
        return self.mount.project_ground(ground_map, self.map_from_vehicle)


@dataclass(frozen=True)
class Matches:
    """Matches of one pair: raw pixels (N, 2) in both images, and the number of patches sought."""

    first_px: FloatArray
    second_px: FloatArray
    sought: int

    @classmethod
    def none_of(cls, sought: int) -> Matches:
        """No matches."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), sought)

    def __len__(self) -> int:
        return len(self.first_px)


@dataclass(frozen=True)
class Sheet:
    """A rectangle of ground: ``corner_map`` (2,), unit ``axes`` (2, 2) as rows, and a grid of ``shape``."""

    corner_map: FloatArray
    axes: FloatArray
    grid_m: float
    shape: tuple[int, int]

    @classmethod
    def around(
        cls, points_map: FloatArray, pose: FloatArray, margin: int, grid_m: float
    ) -> tuple[Sheet, IntArray]:
        """A sheet around points (N, 2) with a ``margin`` of cells, and their nearest cells (N, 2) in it.

        Rows run ahead and columns to the left of a pose (4, 4).
        """
        forward = pose[:2, 0] / np.linalg.norm(pose[:2, 0])
        axes = np.array([forward, [-forward[1], forward[0]]])
        along = points_map @ axes.T
        low = along.min(axis=0)
        cells = np.round((along - low) / grid_m).astype(np.int64) + margin
        rows, columns = cells.max(axis=0) + margin + 1
        return cls((low - margin * grid_m) @ axes, axes, grid_m, (int(rows), int(columns))), cells

    def points(self) -> FloatArray:
        """All grid points (rows * columns, 2) in the map."""
        rows, columns = self.shape
        ahead, left = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        return self.at(np.column_stack([ahead.ravel(), left.ravel()]))

    def at(self, cells: FloatArray | IntArray) -> FloatArray:
        """Map points (N, 2) of grid positions (N, 2): row, column."""
        return np.asarray(self.corner_map + self.grid_m * np.asarray(cells, dtype=np.float64) @ self.axes)

    def resample(self, view: View) -> tuple[Float32Array, BoolArray]:
        """The rectified ground (rows, columns) of ``view``, float32, and a mask of its pixels in view.

        Each value is the mean over its cell's extent in the image, a pixel at least: single pixels of a cell
        that covers many are another sample of the texture in every image.
        """
        px = view.pixels(self.points()).reshape((*self.shape, 2))
        extent_px = np.abs(np.gradient(px, axis=0)) + np.abs(np.gradient(px, axis=1))
        in_view = ~np.isnan(extent_px[..., 0] + extent_px[..., 1])
        px[~in_view] = px[in_view][:1].sum(axis=0)  # of any, as all are looked up
        extent_px[~in_view] = 0.0
        return box_means(view.grey, px, np.maximum(extent_px, 1.0)), in_view

    def texture(self, view: View) -> tuple[Float32Array, BoolArray]:
        """:meth:`resample`, high-pass filtered to the ground's texture."""
        grey, in_view = self.resample(view)
        return grey - cv2.GaussianBlur(grey, (0, 0), _COARSEST_M / self.grid_m), in_view


class _Edge(NamedTuple):
    """Edges (R, C) of boxes along one axis of a table: the cell that each lies in, and how far."""

    cell: IntArray
    into: FloatArray

    @classmethod
    def at(cls, edge_px: FloatArray, last: int) -> _Edge:
        """The edges at ``edge_px``, up to the end of the ``last`` cell."""
        cell = np.minimum(edge_px.astype(np.intp), last)
        return cls(cell, edge_px - cell)


def _looked_up(table: FloatArray, down: _Edge, across: _Edge) -> FloatArray:
    """Bilinear values (R, C) of a table.

    ``cv2.remap`` rounds places to 1/32 px, so that poses a nanometre apart gave a mounting 0.1 sigma apart.
    """
    values = table.ravel()
    place = down.cell * table.shape[1] + across.cell
    remainder = 1 - across.into
    upper = values.take(place) * remainder + values.take(place + 1) * across.into
    place += table.shape[1]
    lower = values.take(place) * remainder + values.take(place + 1) * across.into
    return np.asarray(upper * (1 - down.into) + lower * down.into)


def box_means(grey: ImageArray, centres_px: FloatArray, extent_px: FloatArray) -> Float32Array:
    """Mean grey values (R, C) of boxes with ``centres_px`` and ``extent_px`` (R, C, 2), cut at the border.

    Boxes of one pixel interpolate linearly. From a summed-area table (Crow, SIGGRAPH 1984).
    """
    edges = []
    for axis, size in ((0, grey.shape[1]), (1, grey.shape[0])):
        half = extent_px[..., axis] / 2
        for edge in (centres_px[..., axis] + 0.5 - half, centres_px[..., axis] + 0.5 + half):
            edges.append(np.clip(edge, 0, size))
    left, right, top, bottom = edges
    corner_u = int(left.min())
    corner_v = int(top.min())
    used = grey[corner_v : int(np.ceil(bottom.max())), corner_u : int(np.ceil(right.max()))]
    table = np.asarray(cv2.integral(used, sdepth=cv2.CV_64F), dtype=np.float64)
    columns = [_Edge.at(u - corner_u, table.shape[1] - 2) for u in (right, left)]
    rows = [_Edge.at(v - corner_v, table.shape[0] - 2) for v in (bottom, top)]
    lower_right, lower_left, upper_right, upper_left = (
        _looked_up(table, down, across) for down in rows for across in columns
    )
    total = lower_right - lower_left - upper_right + upper_left
    area = np.maximum((right - left) * (bottom - top), 1 / 32**2)  # none beyond the border
    return np.asarray(total / area, dtype=np.float32)


def patch_centres(
    poses: tuple[FloatArray, FloatArray], roi_vehicle: FloatArray, path_map: FloatArray
) -> FloatArray:
    """Centres (N, 2) in the map of patches within the region at both poses and near the driven path.

    Their lattice is aligned with the first pose.
    """
    first_pose = poses[0]
    lattice = _lattice(roi_vehicle)
    centres = lattice @ first_pose[:2, :2].T + first_pose[:2, 3]
    inside = np.ones(len(centres), dtype=np.bool_)
    for pose in poses:
        inside &= inside_convex(roi_vehicle, ground_in_vehicle(pose, centres))
    centres = centres[inside]
    if not len(centres):
        return centres
    low = centres.min(axis=0) - STRIP_M
    high = centres.max(axis=0) + STRIP_M
    nearby_map = path_map[((path_map >= low) & (path_map <= high)).all(axis=1)]
    distance_m = np.linalg.norm(centres[:, None] - nearby_map[None], axis=2)
    return np.asarray(centres[distance_m.min(axis=1, initial=np.inf) <= STRIP_M])


def _lattice(roi_vehicle: FloatArray) -> FloatArray:
    """Lattice points (N, 2) of patches over the bounding rectangle of a region."""
    low = roi_vehicle.min(axis=0)
    high = roi_vehicle.max(axis=0)
    ahead, left = np.meshgrid(np.arange(low[0], high[0], _STEP_M), np.arange(low[1], high[1], _STEP_M))
    return np.column_stack([ahead.ravel(), left.ravel()])


def match_pair(first: View, second: View, centres_map: FloatArray, search_m: float, grid_m: float) -> Matches:
    """Match patches at ``centres_map`` (N, 2) of the first image in the second, within ``search_m``."""
    half = round(_PATCH_M / 2 / grid_m)
    reach = max(round(search_m / grid_m), _PEAK_CELLS)
    sheet, cells = Sheet.around(centres_map, first.map_from_vehicle, half + reach + 1, grid_m)
    first_grey, first_mask = sheet.texture(first)
    second_grey, second_mask = sheet.texture(second)
    wide = half + reach
    rows, columns = cells.T
    in_first = (_mean(first_mask, half) > _ALL)[rows, columns]
    in_view = in_first & (_mean(second_mask, half) > _ALL)[rows, columns]
    is_rough = (_mean(first_grey * first_grey, half) > _LEAST_CONTRAST**2)[rows, columns]
    search_in_view = (_mean(second_mask, wide) > _ALL)[rows, columns]
    peaks = []
    for number in np.flatnonzero(in_view & is_rough & search_in_view).tolist():
        row, column = cells[number]
        patch = np.s_[row - half : row + half + 1, column - half : column + half + 1]
        search = np.s_[row - wide : row + wide + 1, column - wide : column + wide + 1]
        score = cv2.matchTemplate(second_grey[search], first_grey[patch], cv2.TM_CCOEFF_NORMED)
        peak = _peak(np.asarray(score, np.float32))
        if peak is not None:
            peaks.append((number, *peak))
    sought = int(in_view.sum())
    if len(peaks) < _LEAST_OF_A_PAIR:
        return Matches.none_of(sought)
    table = np.array(peaks)
    matched = cells[table[:, 0].astype(np.int64)]
    first_px = first.pixels(sheet.at(matched))
    second_px = second.pixels(sheet.at(matched + table[:, 1:3] - reach))
    return _on_one_plane(Matches(first_px, second_px, sought))


def match_anywhere(first: View, second: View, roi_vehicle: FloatArray, grid_m: float) -> Matches:
    """Match patches of a region of the first image anywhere in the second, without a pose.

    The mounting rectifies the ground; both views are at the same pose.
    """
    centres = _lattice(roi_vehicle)
    centres = centres[inside_convex(roi_vehicle, centres)]
    if not len(centres):
        return Matches.none_of(0)
    half = round(_PATCH_M / 2 / grid_m)
    wide = round(_AROUND_M / grid_m)
    sheet, cells = Sheet.around(centres, first.map_from_vehicle, half + wide, grid_m)
    first_grey, first_mask = sheet.texture(first)
    second_grey, second_mask = sheet.texture(second)
    second_grey[~second_mask] = 0.0
    peaks = []
    in_view = cells[(_mean(first_mask, half) > _ALL)[cells[:, 0], cells[:, 1]]]
    for row, column in in_view.tolist():
        patch = first_grey[row - half : row + half + 1, column - half : column + half + 1]
        score = cv2.matchTemplate(second_grey, patch, cv2.TM_CCOEFF_NORMED)
        peak = _peak(np.asarray(score, np.float32))
        if peak is not None:
            peaks.append((row, column, *peak))
    if len(peaks) < _LEAST_OF_A_PAIR:
        return Matches.none_of(len(in_view))
    table = np.array(peaks)
    first_px = first.pixels(sheet.at(table[:, :2]))
    second_px = second.pixels(sheet.at(table[:, 2:4] + half))
    moving = np.linalg.norm(second_px - first_px, axis=1) > _STILL_PX
    return _on_one_plane(Matches(first_px[moving], second_px[moving], len(in_view)))


def _mean(values: Float32Array | BoolArray, half: int) -> Float32Array:
    """Means over squares of ``2 half + 1`` cells."""
    return np.asarray(cv2.blur(values.astype(np.float32), (2 * half + 1, 2 * half + 1)))


def _peak(score: Float32Array) -> tuple[float, float] | None:
    """Row and column of the best match, refined by a paraboloid; None if ambiguous."""
    _, best, _, (column, row) = cv2.minMaxLoc(score)
    rows, columns = score.shape
    if best < _LEAST_CORRELATION or not (0 < row < rows - 1 and 0 < column < columns - 1):
        return None
    around = score[row - 1 : row + 2, column - 1 : column + 2].astype(np.float64)
    slope = np.array([around[2, 1] - around[0, 1], around[1, 2] - around[1, 0]]) / 2
    rr = around[2, 1] - 2 * around[1, 1] + around[0, 1]
    cc = around[1, 2] - 2 * around[1, 1] + around[1, 0]
    rc = (around[2, 2] - around[2, 0] - around[0, 2] + around[0, 0]) / 4
    trace = (rr + cc) / 2
    spread = np.hypot((rr - cc) / 2, rc)
    if trace + spread >= 0 or trace + spread > _LEAST_ROUNDNESS * (trace - spread):
        return None
    determinant = rr * cc - rc * rc
    down = -(cc * slope[0] - rc * slope[1]) / determinant
    right = -(rr * slope[1] - rc * slope[0]) / determinant
    if abs(down) > 1 or abs(right) > 1:
        return None
    other_score = score.copy()
    top = max(row - _PEAK_CELLS, 0)
    left = max(column - _PEAK_CELLS, 0)
    other_score[top : row + _PEAK_CELLS + 1, left : column + _PEAK_CELLS + 1] = -1
    if other_score.max() > best - _LEAST_LEAD:
        return None
    return row + float(down), column + float(right)


def _on_one_plane(matches: Matches) -> Matches:
    """The inliers of one homography between the images: a plane seen twice."""
    in_images = ~(np.isnan(matches.first_px) | np.isnan(matches.second_px)).any(axis=1)
    first = matches.first_px[in_images]
    second = matches.second_px[in_images]
    if len(first) < _LEAST_OF_A_PAIR:
        return Matches.none_of(matches.sought)
    _, inlier = cv2.findHomography(first, second, cv2.RANSAC, _HOMOGRAPHY_PX)
    if inlier is None or inlier.sum() < _LEAST_OF_A_PAIR:
        return Matches.none_of(matches.sought)
    keep = inlier.ravel().astype(np.bool_)
    return Matches(first[keep], second[keep], matches.sought)


@dataclass(frozen=True)
class Round:
    """Matches of all pairs of one round; ``share`` is the matched fraction of the patches in view."""

    observations: Observations
    sought: int
    share: float

    def __len__(self) -> int:
        return len(self.observations.first)


class Matcher:
    """Matches ground between images of one camera; images are read once and cached."""

    def __init__(self, drive: Drive, camera: str, motion: Motion):
        self._drive = drive
        self._image = motion.image
        self._roi = np.asarray(drive.cameras[camera].roi_vehicle, dtype=np.float64)
        self._path = motion.course_map()
        self._grey: dict[int, ImageArray] = {}

    def under(self, motion: Motion, turned: bool = False) -> Matcher:
        """The same images under another reading of the poses, the region ``turned`` to the other end."""
        other = copy(self)
        other._path = motion.course_map()
        other._roi = -self._roi if turned else self._roi
        return other

    def match(
        self, mount: Mount, poses: FloatArray, pairs: IntArray, search_m: float, grid_m: float
    ) -> Round:
        """Match every pair (P, 2) of rows of ``poses`` on a grid rectified with ``mount``."""
        of_pair: list[Matches] = []
        for first, second in pairs.tolist():
            centres = patch_centres((poses[first], poses[second]), self._roi, self._path)
            first_view = View(self._read(first), mount, poses[first])
            second_view = View(self._read(second), mount, poses[second])
            matches = Matches.none_of(0)
            if len(centres):
                matches = match_pair(first_view, second_view, centres, search_m, grid_m)
            of_pair.append(matches)
        pair = np.repeat(np.arange(len(pairs)), [len(matches) for matches in of_pair])
        sought = sum(matches.sought for matches in of_pair)
        first_px = np.concatenate([np.empty((0, 2)), *(matches.first_px for matches in of_pair)])
        second_px = np.concatenate([np.empty((0, 2)), *(matches.second_px for matches in of_pair)])
        observations = Observations(pairs[pair, 0], pairs[pair, 1], first_px, second_px, pair)
        return Round(observations, sought, len(pair) / sought if sought else 0.0)

    def match_anywhere(self, mount: Mount, pairs: IntArray, grid_m: float) -> list[Matches]:
        """Patches of the first images matched anywhere in the second, by pair (P, 2)."""
        views = [[View(self._read(row), mount, np.eye(4)) for row in pair] for pair in pairs.tolist()]
        return [match_anywhere(first, second, self._roi, grid_m) for first, second in views]

    def _read(self, row: int) -> ImageArray:
        """Grey values of the image at a row of the motion."""
        if row not in self._grey:
            self._grey[row] = read_grey(str(self._drive.images[int(self._image[row])].path))
        return self._grey[row]


def read_grey(path: str) -> ImageArray:
    """The image file at ``path`` as grey values (H, W), uint8; raises DriveError if unreadable."""
    # Decoding JPEG as grey yields its luma, a level or two off the grey of the same pixels in PNG.
    return np.asarray(cv2.cvtColor(read_pixels(Path(path), cv2.IMREAD_COLOR), cv2.COLOR_BGR2GRAY))
