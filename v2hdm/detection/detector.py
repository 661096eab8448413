"""The detector: an image in, markings with sub-pixel corners and lanes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from v2hdm.catalogue import SYMBOL, Catalogue
from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.lanes.centre_lines import LanePaint, trace_lanes
from v2hdm.detection.lanes.lines import link_anchors
from v2hdm.detection.markings.blobs import find_blobs, outline_polygon
from v2hdm.detection.markings.find import Readings, find_markings, read_markings
from v2hdm.detection.markings.foreground import Foreground
from v2hdm.detection.markings.propose import Proposal, propose
from v2hdm.detection.network import Network
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.sight import Sight, look
from v2hdm.detection.stopwatch import lap
from v2hdm.detection.weights import check_weights
from v2hdm.errors import DetectorError
from v2hdm.io.texts import shown
from v2hdm.records import BoolArray, Camera, LaneDetection, MarkingDetection

_NO_PAINT = -20.0
"""Log odds of paint where the vehicle itself is."""


@dataclass(frozen=True)
class Seen:
    """One image between network and judge: what the network says of it, and what is proposed."""

    view: CameraView
    sight: Sight
    proposals: Sequence[Proposal]
    foreground: Foreground


class Detector:
    """Finds markings and lanes in single images.

    A detector holds an onnxruntime session and per-camera tables; use one per process.

    >>> detector = Detector.load()
    >>> markings, lanes = detector.detect(cv2.imread(str(port.images[6].path)), port.cameras["front"])
    >>> markings[0].corners_px.shape, markings[0].covariance_px.shape
    ((4, 2), (8, 8))
    """

    def __init__(self, network: Network, options: DetectorOptions, catalogue: Catalogue | None = None):
        self.network = network
        self.options = options
        self.catalogue = catalogue or network.info.catalogue
        self._lane_classes = set(self.catalogue.lane_paint)
        self._views: dict[str, CameraView] = {}
        self._reach_px: dict[str, int] = {}

    @classmethod
    def load(cls, path: str | Path | None = None, options: DetectorOptions | None = None) -> Detector:
        """Load a model: ``path``, else ``options.model``, else the one that is shipped.

        Raises:
            DetectorError: the model cannot be used, or the shipped files do not belong together.
        """
        options = options or DetectorOptions()
        check_weights()
        path = path if path is not None else options.model
        return cls(Network(None if path is None else Path(path), options.threads, options.device), options)

    def detect(
        self, image_bgr: np.ndarray, camera: Camera
    ) -> tuple[tuple[MarkingDetection, ...], tuple[LaneDetection, ...]]:
        """Find the markings and lanes of one image (H, W, 3) uint8 BGR.

        Raises:
            DetectorError: the image is not of that form or not of the camera's size.
        """
        seen = self.see(image_bgr, camera)
        with lap("lanes"):
            lanes = self._lanes(seen)
        with lap("fit"):
            readings = self.read(image_bgr, seen)
        with lap("judge"):
            markings = find_markings(readings, seen.view, self.options)
        symbols = [
            self._symbol(proposal, seen.view) for proposal in seen.proposals if not proposal.blob.parts
        ]
        markings += [s for s in symbols if s is not None and not _is_among(s, markings)]
        return tuple(markings), tuple(lanes)

    def see(self, image_bgr: np.ndarray, camera: Camera) -> Seen:
        """Run the network on one image and propose markings.

        Raises:
            DetectorError: the image is not of that form or not of the camera's size.
        """
        view = self.view(camera)
        _check_image(image_bgr, camera)
        info = self.network.info
        with lap("net"):
            sight = look(self.network, image_bgr, view, self.options.mirrored)
        sight = self._without_own_vehicle(sight, view)
        with lap("propose"):
            reach_px = self._reach_px[camera.info.name]
            blobs, owner = find_blobs(
                sight, info.classes, info.paint_stride, view.far_row, reach_px, self.catalogue
            )
            proposals = propose(blobs, view, self.catalogue, self.options.max_range_m)
        foreground = Foreground(
            sight.paint, owner, info.paint_stride, view.far_row, sight.kinds, info.classes
        )
        return Seen(view, sight, proposals, foreground)

    def markings_paint(self, image_bgr: np.ndarray, camera: Camera) -> BoolArray:
        """Where (h, w) the network sees paint of markings, not of lanes, a cell every ``paint_stride`` px.

        The first row of cells is at the image row ``view(camera).far_row``.
        """
        view, info = self.view(camera), self.network.info
        sight = look(self.network, image_bgr, view)
        lanes = [name in self._lane_classes for name in info.classes]
        lead = sight.kinds[~np.array(lanes)].max(axis=0) - sight.kinds[np.array(lanes)].max(axis=0)
        size = sight.paint.shape[1], sight.paint.shape[0]
        return np.asarray((sight.paint > 0) & (cv2.resize(lead, size, interpolation=cv2.INTER_LINEAR) > 0))

    def _without_own_vehicle(self, sight: Sight, view: CameraView) -> Sight:
        """What the network says, but of the vehicle itself."""
        mask = view.camera.own_vehicle
        if mask is None:
            return sight
        rows, columns = (
            np.minimum(stride * np.arange(count) + stride // 2 + first, last - 1)
            for stride, count, first, last in (
                (self.network.info.paint_stride, sight.paint.shape[0], view.far_row, mask.shape[0]),
                (self.network.info.paint_stride, sight.paint.shape[1], 0, mask.shape[1]),
            )
        )
        return replace(sight, paint=np.where(mask[np.ix_(rows, columns)], np.float32(_NO_PAINT), sight.paint))

    def read(self, image_bgr: np.ndarray, seen: Seen) -> Readings | None:
        """Fit an image's proposals, and gather the evidence for each; None where there is none."""
        return read_markings(
            image_bgr, seen.view, seen.proposals, seen.foreground, self.catalogue, self.options.blur_px
        )

    def view(self, camera: Camera) -> CameraView:
        """The tables of a camera, built at its first use."""
        view = self._views.get(camera.info.name)
        if view is None or view.camera is not camera:
            view = CameraView(camera, self.network.info.multiple)
            self._views[camera.info.name] = view
            self._reach_px[camera.info.name] = view.first_row_within(self.options.max_range_m)
        return view

    def _lanes(self, seen: Seen) -> list[LaneDetection]:
        step_m, view = self.options.lane_step_m, seen.view
        lanes = trace_lanes(self._lane_paint(seen.proposals), view, step_m, self.options.max_range_m)
        stride = self.network.info.lane_stride
        return lanes + link_anchors(seen.sight.anchors, view, lanes, step_m, seen.foreground, stride)

    def _lane_paint(self, proposals: Sequence[Proposal]) -> list[LanePaint]:
        found = []
        for proposal in proposals:
            if not proposal.blob.traced:
                continue
            own = sum(proposal.blob.class_score.get(name, 0.0) for name in self._lane_classes)
            is_lane = proposal.kind in self._lane_classes and own >= self.options.min_score
            if is_lane and not proposal.blob.touches_symbol:
                found.append(LanePaint(proposal.blob, proposal.kind, own))
        return found

    def _symbol(self, proposal: Proposal, view: CameraView) -> MarkingDetection | None:
        """A marking that has an outline but no four corners, within range."""
        kind = proposal.kind
        score = proposal.blob.class_score.get(kind, 0.0)
        if self.catalogue.classes[kind].family != SYMBOL or score < self.options.min_score:
            return None
        ground = proposal.outline_vehicle
        if not np.isfinite(ground).all() or view.range_m(ground.mean(axis=0)) > self.options.max_range_m:
            return None
        nothing = np.full((4, 2), np.nan), np.full((8, 8), np.nan), np.zeros(4, dtype=np.bool_)
        return MarkingDetection(kind, score, *nothing, outline_polygon(proposal.blob))


def _is_among(symbol: MarkingDetection, quads: Sequence[MarkingDetection]) -> bool:
    """Whether a symbol is the same paint as one of the quadrilaterals."""
    centres = [quad.corners_px.mean(axis=0) for quad in quads]
    polygon = symbol.outline_px.astype(np.float32)
    return any(cv2.pointPolygonTest(polygon, centre.tolist(), False) > 0 for centre in centres)


def _check_image(image_bgr: np.ndarray, camera: Camera) -> None:
    expected = (camera.info.height, camera.info.width, 3)
    if not isinstance(image_bgr, np.ndarray):
        raise DetectorError(
            f"camera '{camera.info.name}': got no image but {shown(image_bgr)}; cv2.imread gives None where "
            "there is no file"
        )
    if image_bgr.dtype != np.uint8 or image_bgr.shape != expected:
        raise DetectorError(
            f"camera '{camera.info.name}': got an image {image_bgr.shape} {image_bgr.dtype}, its camera_info "
            f"says {expected} uint8; mend the camera_info or pick the images that belong to it"
        )
