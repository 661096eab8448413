"""The detector: an image in, markings with sub-pixel corners and lanes out."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from v2hdm.detection.camera.view import CameraView
from v2hdm.detection.corners.evidence import Claim
from v2hdm.detection.corners.foreground import Foreground
from v2hdm.detection.corners.quad import is_convex
from v2hdm.detection.corners.refine import QuadStart, fit_markings
from v2hdm.detection.lanes.centre_lines import LanePaint, trace_lanes
from v2hdm.detection.lanes.lines import link_anchors
from v2hdm.detection.network import Network
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.paint.blobs import Blob, find_blobs, outline_polygon
from v2hdm.detection.paint.plausible import (
    SYMBOLS,
    Heads,
    Piece,
    cornered_kind,
    head_of,
    may_be_head,
    plausible_kind,
    rival_kinds,
    unlikely_kinds,
)
from v2hdm.detection.paint.starts import starting_corners
from v2hdm.detection.sight import look
from v2hdm.detection.stopwatch import lap
from v2hdm.errors import DetectorError
from v2hdm.records import (
    DIAMOND,
    LANE_CLASSES,
    LANE_DASH,
    LANE_LINE,
    OTHER_PAINT,
    OUTLINED_CLASSES,
    Camera,
    FloatArray,
    LaneDetection,
    MarkingDetection,
)

_LEAST_SCORE = 0.3
"""A blob of a lesser score is nothing. What may be a quadrilateral is then judged by all evidence; of lanes
and symbols there is no more, so they need ``DetectorOptions.min_score``."""

_LEAST_COVER = 0.6
_LEAST_COVER_OF_SYMBOL = 0.8
_LEAST_COVER_OF_UNLIKELY = 0.9
"""A blob that shares less than this with the best quadrilateral around it is none, the more so if the network
takes it for an arrow or a chevron, and most of all if it is tried against what the network says."""


@dataclass(frozen=True)
class _Candidate:
    blob: Blob
    piece: Piece
    index: int
    kind: str
    score: float
    outline_pinhole_px: FloatArray
    outline_vehicle: FloatArray
    at_head: bool
    """Whether it may be the shaft of an arrow, parted from its head by wear."""


class Detector:
    """Finds markings and lanes in single images.

    A detector holds an onnxruntime session and per-camera tables; use one per process.
    """

    def __init__(self, network: Network, options: DetectorOptions):
        self.network = network
        self.options = options
        self._views: dict[str, CameraView] = {}
        self._reach_px: dict[str, int] = {}

    @classmethod
    def load(cls, path: str | Path | None = None, options: DetectorOptions | None = None) -> Detector:
        """Load a model: ``path``, else ``options.model``, else the one that is shipped.

        Raises:
            DetectorError: the model cannot be used.
        """
        options = options or DetectorOptions()
        path = path if path is not None else options.model
        return cls(Network(None if path is None else Path(path), options.threads), options)

    def detect(
        self, image_bgr: np.ndarray, camera: Camera
    ) -> tuple[tuple[MarkingDetection, ...], tuple[LaneDetection, ...]]:
        """Find the markings and lanes of one image (H, W, 3) uint8 BGR.

        Raises:
            DetectorError: the image is not of that form or not of the camera's size.
        """
        view = self.view(camera)
        _check_image(image_bgr, camera)
        info = self.network.info
        with lap("net"):
            sight = look(self.network, image_bgr, view, self.options.mirrored)
        with lap("blobs"):
            reach_px = self._reach_px[camera.info.name]
            blobs, owner = find_blobs(sight, info.classes, info.paint_stride, view.far_row, reach_px)
            candidates = self._candidates(blobs, view)
        foreground = Foreground(
            sight.paint, owner, info.paint_stride, view.far_row, sight.kinds, info.classes
        )
        with lap("lanes"):
            lanes = trace_lanes(
                self._lane_paint(candidates), view, self.options.lane_step_m, self.options.max_range_m
            )
            lanes += link_anchors(
                sight.anchors, view, lanes, self.options.lane_step_m, foreground, info.lane_stride
            )
        with lap("corners"):
            starts = self._starts(candidates, view)
            markings = fit_markings(image_bgr, view, starts, foreground, self.options)
            symbols = [self._symbol(c, view) for c in candidates]
            markings += [s for s in symbols if s is not None and not _is_among(s, markings)]
        return tuple(markings), tuple(lanes)

    def view(self, camera: Camera) -> CameraView:
        """The tables of a camera, built at its first use."""
        view = self._views.get(camera.info.name)
        if view is None or view.camera is not camera:
            view = CameraView(camera, self.network.info.multiple)
            self._views[camera.info.name] = view
            self._reach_px[camera.info.name] = view.first_row_within(self.options.max_range_m)
        return view

    def _candidates(self, blobs: list[Blob], view: CameraView) -> list[_Candidate]:
        if not blobs:
            return []
        outlines = view.undistort(np.concatenate([blob.outline_px for blob in blobs]))
        on_ground = view.ground(outlines)
        ends = np.cumsum([0, *(len(blob.outline_px) for blob in blobs)]).tolist()
        parts = [slice(begin, end) for begin, end in pairwise(ends)]
        heads = Heads({k: on_ground[parts[k]] for k, blob in enumerate(blobs) if may_be_head(blob)})
        have_shafts = set()
        candidates = []
        for index, (blob, part) in enumerate(zip(blobs, parts, strict=True)):
            piece = Piece.of(blob, on_ground[part], view)
            # What is of no class's size may be a quadrilateral all the same.
            found = plausible_kind(piece) or (OTHER_PAINT, sum(blob.class_score.values()))
            if found[1] < _LEAST_SCORE:
                continue
            head = head_of(on_ground[part], heads) if found[0] == LANE_DASH else None
            have_shafts.add(head)
            candidates.append(
                _Candidate(blob, piece, index, *found, outlines[part], on_ground[part], head is not None)
            )
        # With a shaft it is the head of an arrow, even if it looks more like the diamonds around.
        return [c for c in candidates if c.kind != DIAMOND or c.index not in have_shafts]

    def _lane_paint(self, candidates: list[_Candidate]) -> list[LanePaint]:
        return [
            LanePaint(c.blob, c.kind, c.score)
            for c in candidates
            # Else it is the shaft of an arrow, the stroke of a letter.
            if c.kind in LANE_CLASSES
            and c.score >= self.options.min_score
            and not (c.kind == LANE_DASH and (c.blob.touches_symbol or c.at_head))
        ]

    def _starts(self, candidates: list[_Candidate], view: CameraView) -> list[QuadStart]:
        """The quadrilaterals to start the corner fit from, of the blobs that are one within range."""
        starts = []
        for c in candidates:
            kinds, least = _tried_as(c)
            if not kinds:
                continue
            paint_px2 = c.blob.cells * self.network.info.paint_stride**2
            start = starting_corners(kinds[0], c.outline_pinhole_px, c.outline_vehicle, paint_px2, view)
            if start is not None and start[1] >= least:
                claims = {name: _claim(c, name) for name in kinds}
                starts.append(QuadStart(claims, start[0], c.index, c.outline_pinhole_px))
        if not starts:
            return []
        corners = np.stack([start.corners_pinhole_px for start in starts])
        ground = view.ground(corners.reshape(-1, 2)).reshape(corners.shape)
        usable = is_convex(corners) & np.isfinite(ground).all(axis=(1, 2))
        usable &= view.range_m(ground.mean(axis=1)) <= self.options.max_range_m
        return [start for start, use in zip(starts, usable, strict=True) if use]

    def _symbol(self, candidate: _Candidate, view: CameraView) -> MarkingDetection | None:
        """A marking that has an outline but no four corners, within range."""
        if candidate.kind not in OUTLINED_CLASSES or candidate.score < self.options.min_score:
            return None
        ground = candidate.outline_vehicle
        if not np.isfinite(ground).all() or view.range_m(ground.mean(axis=0)) > self.options.max_range_m:
            return None
        nothing = np.full((4, 2), np.nan), np.full((8, 8), np.nan), np.zeros(4, dtype=np.bool_)
        return MarkingDetection(candidate.kind, candidate.score, *nothing, outline_polygon(candidate.blob))


def _tried_as(candidate: _Candidate) -> tuple[list[str], float]:
    """The classes as which a candidate is tried as a quadrilateral, and how much of that it has to fill."""
    kind = cornered_kind(candidate.piece, candidate.kind)
    if kind is None:
        return unlikely_kinds(candidate.piece), _LEAST_COVER_OF_UNLIKELY
    least = _LEAST_COVER if candidate.kind not in OUTLINED_CLASSES else _LEAST_COVER_OF_SYMBOL
    return [kind, *rival_kinds(candidate.piece, kind)], least


def _is_among(symbol: MarkingDetection, quads: list[MarkingDetection]) -> bool:
    """Whether a symbol is the same paint as one of the quadrilaterals."""
    centres = [quad.corners_px.mean(axis=0) for quad in quads]
    polygon = symbol.outline_px.astype(np.float32)
    return any(cv2.pointPolygonTest(polygon, centre.tolist(), False) > 0 for centre in centres)


def _claim(candidate: _Candidate, kind: str) -> Claim:
    """What the network says of a candidate's being of a class."""
    scores = candidate.blob.class_score
    certainty = sum(scores.values())
    share = {name: score / max(certainty, 1e-9) for name, score in scores.items()}
    return Claim(
        certainty,
        share.get(kind, 0.0),
        line_share=share.get(LANE_LINE, 0.0),
        symbol_share=sum(share.get(name, 0.0) for name in SYMBOLS),
        touches_symbol=candidate.blob.touches_symbol,
        at_head=candidate.at_head,
        possible_share=candidate.piece.share_among_possible(kind),
    )


def _check_image(image_bgr: np.ndarray, camera: Camera) -> None:
    expected = (camera.info.height, camera.info.width, 3)
    if image_bgr.dtype != np.uint8 or image_bgr.shape != expected:
        raise DetectorError(
            f"camera {camera.info.name!r}: got an image {image_bgr.shape} {image_bgr.dtype}, its camera_info "
            f"says {expected} uint8; mend the camera_info or pick the images that belong to it"
        )
