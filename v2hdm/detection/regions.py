"""The network on parts of an image, where somebody knows that markings are: a tracked map, for one.

What is learnt in this way is the same as of a whole image, but for markings that a part cuts, which are left
out, and for all that lies elsewhere.
"""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.network import (
    GRID_PX,
    OVERLAP_PX,
    Network,
    NetworkOutput,
    as_seen_from,
    run_twice,
    seam_row,
)
from v2hdm.records import FloatArray, IntArray

NO_PAINT = -20.0  # log odds of paint where nobody looks
_MERGED = 1.3  # area of a box around two over that of both, up to which one look at it costs less than two
_AROUND_PX = 16  # surroundings of a region, px, that are looked at, too
_TRUSTED_PX = 8  # of these what lies nearer to their border, px, has not its own surroundings


def run_in_regions(
    network: Network,
    image_bgr: np.ndarray,
    camera: RoadCamera,
    regions_px: FloatArray,
    mirrored: bool = False,
) -> NetworkOutput:
    """Run the network around regions (R, 4) of left, top, right and bottom px; elsewhere is no paint."""
    info = network.info
    top = camera.far_row
    band = image_bgr[top:]
    height = -(-band.shape[0] // info.multiple) * info.multiple
    width = -(-band.shape[1] // info.multiple) * info.multiple
    paint = np.full((height // info.paint_stride, width // info.paint_stride), NO_PAINT, dtype=np.float32)
    size = (len(info.classes), height // info.kind_stride, width // info.kind_stride)
    kinds = np.zeros(size, dtype=np.float32)
    is_seen = np.zeros(paint.shape, dtype=np.uint8)
    run = partial(run_twice, network) if mirrored else network.run
    seam = seam_row(network, camera, top)
    for is_fine in (True, False) if seam is not None else (True,):
        scale = 1 if is_fine else 2
        first, last = (0, band.shape[0] if seam is None else seam) if is_fine else (seam or 0, band.shape[0])
        grid = scale * max(GRID_PX, info.multiple)
        for box in merged(_boxes(regions_px - [0, top, 0, top], (first, last), band.shape[1], grid)):
            left, upper, right, lower = box.tolist()
            part = band[upper:lower, left:right]
            if scale > 1:
                part = cv2.resize(part, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            output = run(part)
            trusted = _trusted(box, (first, last), band.shape)
            _paste(paint[None], output.paint[None], box, trusted, info.paint_stride, scale)
            _paste(kinds, output.kinds, box, trusted, info.kind_stride, scale)
            left, upper, right, lower = (trusted // info.paint_stride).tolist()
            is_seen[upper:lower, left:right] = 1
    _erase_cut(paint, is_seen)
    rows = -(-band.shape[0] // info.paint_stride)
    columns = -(-band.shape[1] // info.paint_stride)
    kind_rows, kind_columns = (-(-length // info.kind_stride) for length in band.shape[:2])
    kinds = as_seen_from(camera, kinds[:, :kind_rows, :kind_columns], info.classes)
    paint = paint[:rows, :columns]
    return NetworkOutput.of(paint, kinds, [], info.classes, info.paint_stride, top, info.catalogue)


def _boxes(regions_px: FloatArray, rows: tuple[int, int], width: int, grid: int) -> IntArray:
    """Boxes (N, 4) around the parts of regions in some rows of the band, on a grid from where these begin."""
    first, last = rows
    is_there = (regions_px[:, 3] > first) & (regions_px[:, 1] < last)
    is_there &= (regions_px[:, 2] > 0) & (regions_px[:, 0] < width)
    around = regions_px[is_there] + _AROUND_PX * np.array([-1, -1, 1, 1])
    # Coarse rows begin above the seam, so that either resolution has its surroundings there.
    begin = max(first - OVERLAP_PX, 0) if first else 0
    end = last + OVERLAP_PX
    low = np.floor((around[:, :2] - [0, begin]) / grid) * grid + [0, begin]
    high = np.ceil((around[:, 2:] - [0, begin]) / grid) * grid + [0, begin]
    low = np.maximum(low, [0, begin])
    high = np.minimum(high, [width, end])
    return np.concatenate([low, high], axis=1).astype(np.int64)


def merged(boxes: IntArray) -> IntArray:
    """Boxes (N, 4) after joining those that overlap or nearly do."""
    left = boxes.tolist()
    out: list[list[int]] = []
    while left:
        box = left.pop()
        for other in left:
            union = [
                min(box[0], other[0]),
                min(box[1], other[1]),
                max(box[2], other[2]),
                max(box[3], other[3]),
            ]
            if _area(union) <= _MERGED * (_area(box) + _area(other)):
                left.remove(other)
                left.append(union)
                break
        else:
            out.append(box)
    return np.array(out, dtype=np.int64).reshape(-1, 4)


def _area(box: list[int]) -> int:
    return (box[2] - box[0]) * (box[3] - box[1])


def _trusted(box: IntArray, rows: tuple[int, int], shape: tuple[int, ...]) -> IntArray:
    """The part of a box that has its surroundings, within some rows of a band of a shape."""
    inner = box + _TRUSTED_PX * np.array([1, 1, -1, -1])
    at_border = np.array([box[0] <= 0, box[1] <= 0, box[2] >= shape[1], box[3] >= shape[0]])
    inner = np.where(at_border, box, inner)
    inner[1] = max(inner[1], rows[0])
    inner[3] = min(inner[3], rows[1])
    return np.asarray(inner)


def _paste(
    planes: np.ndarray, part: np.ndarray, box: IntArray, trusted: IntArray, stride: int, scale: int
) -> None:
    """Put the trusted elements of planes (K, h, w) of a box, reduced by ``scale``, in their place."""
    left, upper, right, lower = (trusted // stride).tolist()
    if right <= left or lower <= upper:
        return
    begin_column, begin_row = (box[:2] // stride).tolist()
    rows = slice(upper - begin_row, lower - begin_row)
    columns = slice(left - begin_column, right - begin_column)
    for whole, plane in zip(planes, part, strict=True):
        enlarged = plane
        if scale > 1:
            enlarged = cv2.resize(plane, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        whole[upper:lower, left:right] = enlarged[rows, columns]


def _erase_cut(paint: np.ndarray, is_seen: np.ndarray) -> None:
    """Take pieces of paint (h, w) away that reach to where nobody has looked: nobody knows how they go on."""
    inner = cv2.erode(is_seen, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    edge = (is_seen > 0) & (inner == 0)
    _, pieces = cv2.connectedComponents((paint > 0).view(np.uint8), connectivity=8, ltype=cv2.CV_16U)
    is_cut = np.zeros(int(pieces.max()) + 1, dtype=bool)
    is_cut[pieces[edge]] = True
    is_cut[0] = False
    paint[is_cut[pieces]] = NO_PAINT
