"""One image through the network: far ground at full resolution, near ground at half of it.

A metre of ground near the vehicle fills so many pixels that half of them, in each direction, show all that
the network needs; corners are refined on the image itself afterwards. Looking twice costs half as much.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.network import Network, NetworkOutput
from v2hdm.records import SEEN_ACROSS, FloatArray

_OVERLAP_PX = 64
"""By how much the two parts overlap, so that either has its surroundings where they are joined."""

_GRID_PX = 16
"""Where the parts are joined is on the grid of all outputs; the network's own multiple may be larger."""

_MIRRORED = np.array([1.0, -1.0], dtype=np.float32)[:, None, None]
"""What a lane's answer (2, h, w), log odds and offset, becomes in the mirror."""

_LEAST_LOG_ODDS = -3.0
"""Crossings of lanes' lines less likely than this are left out; unlikely ones help to follow a known line."""


@dataclass(frozen=True)
class AnchorRow:
    """The crossings of lanes' lines on one image row ``v_px``: columns (N,) px and log odds (N,)."""

    v_px: float
    u_px: FloatArray
    odds: FloatArray


@dataclass(frozen=True)
class Sight:
    """What the network says of the camera's band of rows.

    ``paint`` (h, w) and ``kinds`` (K, h', w') are as in :class:`NetworkOutput`; ``anchors`` from near to far.
    """

    paint: np.ndarray
    kinds: np.ndarray
    anchors: list[AnchorRow]

    @cached_property
    def kind_scale(self) -> float:
        """Elements of ``paint`` per element of ``kinds``, in each direction."""
        return float(self.paint.shape[1] / self.kinds.shape[2])


def look(network: Network, image_bgr: np.ndarray, view: CameraView, mirrored: bool = False) -> Sight:
    """Run the network on the rows of an image (H, W, 3) that show ground in reach.

    ``mirrored`` asks it of the mirror image, too, and takes the mean of both answers.
    """
    top = view.far_row
    band = image_bgr[top:]
    ask = _answer_twice if mirrored else _answer
    seam = _seam_row(network, view)
    if seam is None:
        output = ask(network, band)
        kinds = _as_driven(output.kinds, network, view)
        return Sight(output.paint, kinds, _anchor_rows(output.lanes, network, top, 1))
    far = ask(network, band[: seam + _OVERLAP_PX])
    near_top = seam - _OVERLAP_PX
    half = cv2.resize(band[near_top:], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    near = ask(network, half)
    far_rows = [row for row in _anchor_rows(far.lanes, network, top, 1) if row.v_px < top + seam]
    near_rows = _anchor_rows(near.lanes, network, top + near_top, 2)
    near_rows = [row for row in near_rows if row.v_px >= top + seam]
    paint = _joined(far.paint[None], near.paint[None], seam, near_top, network.info.paint_stride)
    kinds = _joined(far.kinds, near.kinds, seam, near_top, network.info.kind_stride)
    return Sight(paint[0], _as_driven(kinds, network, view), near_rows + far_rows)


def _as_driven(kinds: np.ndarray, network: Network, view: CameraView) -> np.ndarray:
    """Logits (K, h, w) of the classes, of stripes by how they lie to the vehicle's way, not to the view.

    Seen from the side a dash lies across the view, as a stop line does seen from the front, and the other way
    round. The network knows of the view alone.
    """
    names = list(network.info.classes)
    if not view.aside or not set(SEEN_ACROSS) <= set(names):
        return kinds
    order = [names.index(SEEN_ACROSS.get(name, name)) for name in names]
    return kinds[order]


def _answer(network: Network, image_bgr: np.ndarray) -> NetworkOutput:
    return network.run(image_bgr)


def _answer_twice(network: Network, image_bgr: np.ndarray) -> NetworkOutput:
    """The mean of what the network says of an image (H, W, 3) and of its mirror image."""
    width, info = image_bgr.shape[1], network.info
    # Only whole elements have mirror images on the same grid.
    padded = cv2.copyMakeBorder(image_bgr, 0, 0, 0, -width % info.multiple, cv2.BORDER_REPLICATE)
    one, other = network.run(padded), network.run(np.ascontiguousarray(padded[:, ::-1]))
    paint = (one.paint + other.paint[:, ::-1]) / 2
    kinds = (one.kinds + other.kinds[..., ::-1]) / 2
    (odds, offset), (odds_too, offset_too) = one.lanes, other.lanes[..., ::-1] * _MIRRORED
    # Where a line crosses a cell only that answer knows that sees it cross.
    weight = 1 / (1 + np.exp(np.clip(odds_too - odds, -30, 30)))
    lanes = np.stack([(odds + odds_too) / 2, weight * offset + (1 - weight) * offset_too])
    columns = [-(-width // stride) for stride in (info.paint_stride, info.kind_stride, info.lane_stride)]
    return NetworkOutput(*(a[..., :n] for a, n in zip((paint, kinds, lanes), columns, strict=True)))


def _seam_row(network: Network, view: CameraView) -> int | None:
    """Row of the band from which half the resolution will do; None if that saves nothing."""
    grid = max(_GRID_PX, network.info.multiple)
    height = view.info.height - view.far_row
    if view.fine_row is None or view.info.width % (2 * grid) or height % grid:
        return None
    seam = -(-max(view.fine_row - view.far_row, 0) // grid) * grid
    seam += (height - seam) % (2 * grid)
    worth = height - seam >= 3 * _OVERLAP_PX
    return seam if worth and seam >= _OVERLAP_PX else None


def _joined(far: np.ndarray, near: np.ndarray, seam: int, near_top: int, stride: int) -> np.ndarray:
    """Planes (K, h, w), ``stride`` px per element: far ones above the seam, near ones, doubled, below it."""
    first, overlap = seam // stride, (seam - near_top) // stride
    height = first - overlap + 2 * near.shape[1]
    joined = np.empty((len(far), height, 2 * near.shape[2]), dtype=np.float32)
    joined[:, :first] = far[:, :first]
    for whole, plane in zip(joined, near, strict=True):
        doubled = cv2.resize(plane, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        whole[first:] = doubled[overlap:]
    return joined


def _anchor_rows(lanes: np.ndarray, network: Network, top_px: int, scale: int) -> list[AnchorRow]:
    """Peaks along each row of ``lanes`` (2, h, w), near to far, of an image reduced by ``scale``."""
    odds, offset = lanes
    peak = odds > _LEAST_LOG_ODDS
    peak[:, 1:] &= odds[:, 1:] >= odds[:, :-1]
    peak[:, :-1] &= odds[:, :-1] > odds[:, 1:]
    i, j = np.nonzero(peak)
    stride = network.info.lane_stride
    u = stride * (j + np.clip(offset[i, j], -0.5, 0.5) + 0.5) - 0.5
    v = stride * np.arange(len(odds)) + (stride - 1) / 2
    # Pixel p of the reduced image is centred on scale * p + (scale - 1) / 2 of the image.
    u, v = scale * u + (scale - 1) / 2, scale * v + (scale - 1) / 2 + top_px
    found = odds[i, j].astype(np.float64)
    bounds = np.searchsorted(i, np.arange(len(odds) + 1))
    return [
        AnchorRow(float(v[row]), u[part], found[part])
        for row in range(len(odds) - 1, -1, -1)
        if (part := slice(bounds[row], bounds[row + 1])).stop > part.start
    ]
