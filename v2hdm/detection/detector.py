"""The detector: an image in, markings with sub-pixel corners and lanes out."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.catalogue import PAINT_CLASSES, SYMBOL, Catalogue
from v2hdm.detection.areas import find_areas
from v2hdm.detection.arrows import arrow_probability, features_of
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.classifier import Readings, find_markings, reading_steps
from v2hdm.detection.crosswalks import find_crosswalks
from v2hdm.detection.lanes.bare import painted
from v2hdm.detection.lanes.curves import LaneImage
from v2hdm.detection.lanes.lines import find_boundaries, trace_lanes
from v2hdm.detection.network import Network, NetworkOutput, run_on_road, steps_on_road
from v2hdm.detection.options import DetectorOptions
from v2hdm.detection.quads.blobs import find_blobs
from v2hdm.detection.quads.outline import on_edges, outline_polygon
from v2hdm.detection.quads.propose import Proposal, Proposals, propose
from v2hdm.detection.regions import NO_PAINT, run_in_regions
from v2hdm.detection.steps import Steps, last, timed
from v2hdm.detection.stopwatch import lap
from v2hdm.detection.weights import NETWORK_FILE, check_weights
from v2hdm.doors import checked
from v2hdm.errors import DetectorError
from v2hdm.geometry.planar import following
from v2hdm.native import tell_missing
from v2hdm.records import ARROW, BoolArray, Camera, FloatArray, LaneDetection, MarkingDetection
from v2hdm.safe.texts import shown

_log = logging.getLogger(__name__)

Markings = tuple[MarkingDetection, ...]

_LEAST_NAMED = 0.3  # share named a symbol below which nothing is one: few true arrows are below 0.7
_PART_SHARE = 0.5  # share of an area in a marking from which it is a part of that; chosen


class Looked(NamedTuple):
    """The detections of one image: markings, lanes, and the pieces of its paint, of any class."""

    markings: Markings
    lanes: tuple[LaneDetection, ...]
    pieces: Sequence[Proposal]


class Detector:
    """Finds markings and lanes in single images.

    A detector holds an onnxruntime session and per-camera tables; use one per process.

    >>> detector = Detector.load()
    >>> markings, lanes = detector.detect(cv2.imread(str(port.images[6].path)), port.cameras["front"])
    >>> markings[0].corners_px.shape, markings[0].covariance_px.shape
    ((4, 2), (8, 8))
    """

    @checked
    def __init__(self, network: Network, options: DetectorOptions, catalogue: Catalogue | None = None):
        self.network = network
        self.options = options
        self.catalogue = catalogue or network.info.catalogue
        # By name, with the first row that shows ground within ``max_range_m``.
        self._cameras: dict[str, tuple[RoadCamera, int]] = {}

    @classmethod
    @checked
    def load(cls, path: str | Path | None = None, options: DetectorOptions | None = None) -> Detector:
        """Load a model: ``path``, else ``options.model``, else the shipped one.

        Raises DetectorError where the model cannot be used, or the shipped files do not belong together.
        """
        options = options or DetectorOptions()
        tell_missing()
        check_weights()
        path = path if path is not None else options.model
        network = Network(None if path is None else Path(path), options.threads, options.device)
        _tell_lacking(network.path, tuple(name for name in PAINT_CLASSES if name not in network.info.classes))
        return cls(network, options)

    @checked
    def detect(
        self, image_bgr: np.ndarray, camera: Camera, has_boundaries: bool = True
    ) -> tuple[tuple[MarkingDetection, ...], tuple[LaneDetection, ...]]:
        """Find the markings and lanes of one image (H, W, 3) uint8 BGR.

        Without ``has_boundaries``, of lanes only their paint. Raises DetectorError where the image is not of
        that form or not of the camera's size.
        """
        return self.detect_in(self.run_network(image_bgr, camera), image_bgr, camera, has_boundaries)

    def detect_in(
        self, output: NetworkOutput, image_bgr: np.ndarray, camera: Camera, has_boundaries: bool = True
    ) -> tuple[tuple[MarkingDetection, ...], tuple[LaneDetection, ...]]:
        """Find the markings and lanes of an image from the network's output."""
        looked = last(self.steps_in(output, image_bgr, camera, has_boundaries))
        return looked.markings, looked.lanes

    def steps(self, image_bgr: np.ndarray, camera: Camera, has_boundaries: bool = True) -> Steps[Looked]:
        """As :meth:`detect`, in steps between which something else may be done."""
        output = yield from self._network_steps(image_bgr, camera)
        yield
        return (yield from self.steps_in(output, image_bgr, camera, has_boundaries))

    def steps_in(
        self, output: NetworkOutput, image_bgr: np.ndarray, camera: Camera, has_boundaries: bool = True
    ) -> Steps[Looked]:
        """As :meth:`steps`, from the network's output on the image."""
        with lap("propose"):
            proposals = self.propose(output, camera)
        yield
        with lap("lanes"):
            image = self.lane_image(proposals, image_bgr)
            lanes = (*image.paint, *(find_boundaries(image) if has_boundaries else ()))
        yield
        readings = yield from timed("fit", self._reading_steps(image_bgr, proposals))
        yield
        with lap("judge"):
            quads = find_markings(readings, proposals.camera, self.options)
        markings = _likelier(quads, self._symbols(image_bgr, proposals))
        with lap("areas"):
            crosswalks = [crosswalk for crosswalk, _ in find_crosswalks(markings, proposals.camera)]
            areas = _of_several(self._areas(proposals), (*markings, *crosswalks))
        return Looked((*_not_of(areas, markings), *areas), lanes, proposals.pieces)

    @checked
    def detect_in_regions(
        self, image_bgr: np.ndarray, camera: Camera, regions_px: FloatArray
    ) -> tuple[MarkingDetection, ...]:
        """Find the markings with corners that lie whole in regions (R, 4): left, top, right, bottom, px.

        It costs less than :meth:`detect`, but looks for no lanes, symbols and areas; raises as that.
        """
        road_camera = self.road_camera(camera)
        _check_image(image_bgr, camera)
        regions_px = np.asarray(regions_px, dtype=np.float64).reshape(-1, 4)
        with lap("net"):
            output = run_in_regions(self.network, image_bgr, road_camera, regions_px, self.options.mirrored)
        with lap("propose"):
            everywhere = self.propose(_without_vehicle(output, camera), camera)
            proposals = replace(everywhere, pieces=_in_regions(everywhere.pieces, regions_px))
        with lap("fit"):
            readings = self.read(image_bgr, proposals)
        with lap("judge"):
            return tuple(find_markings(readings, proposals.camera, self.options))

    def run_network(self, image_bgr: np.ndarray, camera: Camera, top: int | None = None) -> NetworkOutput:
        """Run the network on an image, without the vehicle's own parts; raises as :meth:`detect`.

        It looks from the row ``top`` on, see :func:`v2hdm.detection.network.run_on_road`.
        """
        return last(self._network_steps(image_bgr, camera, top))

    def _network_steps(
        self, image_bgr: np.ndarray, camera: Camera, top: int | None = None
    ) -> Steps[NetworkOutput]:
        """As :meth:`run_network`, in steps."""
        road_camera = self.road_camera(camera)
        _check_image(image_bgr, camera)
        steps = steps_on_road(self.network, image_bgr, road_camera, self.options.mirrored, top)
        output = yield from timed("net", steps)
        return _without_vehicle(output, camera)

    def propose(self, output: NetworkOutput, camera: Camera) -> Proposals:
        """The pieces of paint of one image, each with the classes that it may be of."""
        road_camera = self.road_camera(camera)
        reach_px = self._cameras[camera.info.name][1]
        blobs, owner = find_blobs(output, reach_px, self.catalogue)
        reach_m = road_camera.perhaps_m(self.options.max_range_m)
        pieces = propose(blobs, road_camera, self.catalogue, reach_m)
        return Proposals(road_camera, output, pieces, owner)

    def lane_image(self, proposals: Proposals, image_bgr: np.ndarray) -> LaneImage:
        """An image in which boundaries of lanes are looked for: row anchors and centre lines of paint."""
        pieces = self.lane_pieces(proposals)
        return LaneImage(
            camera=proposals.camera,
            rows=proposals.output.anchors,
            paint=painted(pieces, image_bgr, proposals.camera),
            output=proposals.output,
            paint_step_m=self.options.lane_step_m,
            row_step_px=self.network.info.lane_stride,
        )

    def lane_pieces(self, proposals: Proposals) -> list[LaneDetection]:
        """Centre lines of the lane paint that the network finds."""
        lane_classes = set(self.catalogue.lane_paint)
        paint = [
            (piece, score)
            for piece in proposals.pieces
            if piece.blob.traced and piece.kind in lane_classes and not piece.blob.touches_symbol
            if (score := piece.score_of(lane_classes)) >= self.options.min_score
        ]
        reach_m = proposals.camera.perhaps_m(self.options.max_range_m)
        return trace_lanes(paint, proposals.camera, self.options.lane_step_m, reach_m)

    def read(self, image_bgr: np.ndarray, proposals: Proposals) -> Readings | None:
        """Fit an image's proposals, and gather the evidence for each; None where there is none."""
        return last(self._reading_steps(image_bgr, proposals))

    def _reading_steps(self, image_bgr: np.ndarray, proposals: Proposals) -> Steps[Readings | None]:
        """As :meth:`read`, in steps."""
        return reading_steps(image_bgr, proposals, self.catalogue, self.options.blur_px)

    def markings_paint(self, image_bgr: np.ndarray, camera: Camera) -> BoolArray:
        """Where (h, w) the network sees paint of markings, from the camera's ``far_row`` on."""
        output = run_on_road(self.network, image_bgr, self.road_camera(camera))
        lanes = np.isin(output.classes, self.catalogue.lane_paint)
        lead = output.kinds[~lanes].max(axis=0) - output.kinds[lanes].max(axis=0)
        size = (output.paint.shape[1], output.paint.shape[0])
        return np.asarray((output.paint > 0) & (cv2.resize(lead, size, interpolation=cv2.INTER_LINEAR) > 0))

    def road_camera(self, camera: Camera) -> RoadCamera:
        """The tables of a camera, built at its first use."""
        road_camera, _ = self._cameras.get(camera.info.name, (None, 0))
        if road_camera is None or road_camera.camera is not camera:
            lens = None if road_camera is None else road_camera.lens
            road_camera = RoadCamera(camera, self.network.info.multiple, lens)
            reach_px = road_camera.first_row_within(road_camera.perhaps_m(self.options.max_range_m))
            self._cameras[camera.info.name] = (road_camera, reach_px)
        return road_camera

    def _areas(self, proposals: Proposals) -> list[MarkingDetection]:
        """The areas of an image, such as words."""
        camera = proposals.camera
        reach_px = self._cameras[camera.info.name][1]
        options = self.options
        return find_areas(
            proposals.output, camera, self.catalogue, reach_px, options.min_score, options.max_range_m
        )

    def _symbols(self, image_bgr: np.ndarray, proposals: Proposals) -> list[MarkingDetection]:
        """Markings within range with an outline but no four corners; of a piece and its parts only one."""
        names = self.catalogue.of_family(SYMBOL)
        symbols = []
        parts_until = 0
        reach_m = proposals.camera.perhaps_m(self.options.max_range_m)
        for piece in proposals.pieces:
            if not names or piece.index < parts_until:
                continue
            kind = piece.symbol_kind(names)
            score = piece.symbol_score(kind)
            if score < _LEAST_NAMED:
                continue
            range_m = proposals.camera.range_m(piece.outline_vehicle.mean(axis=0))
            if not range_m <= reach_m:  # nan is not
                continue
            after = piece.index + 1 + piece.blob.parts
            if kind == ARROW:
                score = arrow_probability(score, features_of(piece, proposals.camera))
            if score < self.options.min_score:
                continue
            parts = [part for part in proposals.pieces if piece.index < part.index < after]
            if piece.is_one_symbol(parts, self.catalogue):
                outline_px, outline_seen = on_edges(outline_polygon(piece.blob), image_bgr)
                symbol = MarkingDetection(
                    kind=kind,
                    score=score,
                    corners_px=np.full((4, 2), np.nan),
                    covariance_px=np.full((8, 8), np.nan),
                    corner_valid=np.zeros(4, dtype=np.bool_),
                    outline_px=outline_px,
                    outline_seen=outline_seen,
                )
                symbols.append(symbol)
                parts_until = after
        return symbols


def _in_regions(pieces: Sequence[Proposal], regions_px: FloatArray) -> list[Proposal]:
    """The pieces of paint whose middle lies in one of some regions (R, 4)."""
    middles = np.array([piece.blob.outline_px.mean(axis=0) for piece in pieces]).reshape(-1, 1, 2)
    is_inside = (middles > regions_px[:, :2]) & (middles < regions_px[:, 2:])
    is_in = np.asarray(np.any(is_inside.all(axis=2), axis=1))
    return [piece for piece, is_kept in zip(pieces, is_in.tolist(), strict=True) if is_kept]


def _without_vehicle(output: NetworkOutput, camera: Camera) -> NetworkOutput:
    """The network's output on an image, without the vehicle's own parts."""
    mask = camera.own_vehicle
    if mask is None:
        return output
    # The pixel in the middle of each element of paint.
    stride = output.stride
    rows = output.top + stride * np.arange(output.paint.shape[0]) + stride // 2
    columns = stride * np.arange(output.paint.shape[1]) + stride // 2
    rows = np.minimum(rows, mask.shape[0] - 1)
    columns = np.minimum(columns, mask.shape[1] - 1)
    paint = np.where(mask[np.ix_(rows, columns)], np.float32(NO_PAINT), output.paint)
    return replace(output, paint=paint)


def _of_several(areas: Sequence[MarkingDetection], markings: Markings) -> list[MarkingDetection]:
    """The areas that lie in no marking: a part of an arrow, and bars, are no word, whatever names them so."""
    shapes = [marking.outline_px if len(marking.outline_px) else marking.corners_px for marking in markings]
    hulls = [cv2.convexHull(shape_px.astype(np.float32)) for shape_px in shapes]

    def is_part(area: MarkingDetection) -> bool:
        outline = area.outline_px.astype(np.float32)
        common_px2 = [cv2.intersectConvexConvex(outline, hull)[0] for hull in hulls]
        return max(common_px2, default=0.0) > _PART_SHARE * cv2.contourArea(outline)

    return [area for area in areas if not is_part(area)]


def _not_of(areas: Sequence[MarkingDetection], markings: Markings) -> Markings:
    """The markings that are no piece of an area; a marking inside a likelier area, as a letter is, is one."""
    hulls = [(area.outline_px.astype(np.float32), area.score) for area in areas]

    def is_piece(marking: MarkingDetection) -> bool:
        shape_px = marking.outline_px if len(marking.outline_px) else marking.corners_px
        centre = shape_px.mean(axis=0).tolist()
        return any(
            score > marking.score and cv2.pointPolygonTest(hull, centre, False) > 0 for hull, score in hulls
        )

    return tuple(marking for marking in markings if not is_piece(marking))


@cache
def _tell_lacking(path: Path, names: tuple[str, ...]) -> None:
    """Say once which of our classes a network was trained without; of the shipped one, see its model card."""
    if names:
        level = logging.DEBUG if path == NETWORK_FILE else logging.WARNING
        _log.log(level, "%s does not know %s: none of these will be found", path, ", ".join(names))


def _likelier(quads: Sequence[MarkingDetection], symbols: Sequence[MarkingDetection]) -> Markings:
    """Quadrilaterals and symbols of one image: where one lies in the other, the one of the higher score.

    A quadrilateral lies in a symbol that covers its centre and most of its longer middle line: a stop line
    that an arrow crosses does not.
    """
    if not symbols:
        return tuple(quads)
    left_out: set[int] = set()
    likelier_symbols = []
    middle_lines = _on_middle_lines(np.array([quad.corners_px for quad in quads]).reshape(-1, 4, 2))
    for symbol in symbols:
        polygon = symbol.outline_px.astype(np.float32)
        on_it = [k for k, points in enumerate(middle_lines) if _covers(polygon, points)]
        if all(quads[k].score < symbol.score for k in on_it):
            left_out.update(on_it)
            likelier_symbols.append(symbol)
    return (*(quad for k, quad in enumerate(quads) if k not in left_out), *likelier_symbols)


def _on_middle_lines(corners_px: FloatArray) -> FloatArray:
    """Points (M, 5, 2) along most of the longer middle lines of quadrilaterals, their centres the third."""
    sides = (corners_px + following(corners_px)) / 2
    across = sides[:, 2:] - sides[:, :2]
    longer = np.linalg.norm(across, axis=2).argmax(axis=1)
    way = across[np.arange(len(across)), longer][:, None]
    return np.asarray(corners_px.mean(axis=1)[:, None] + np.linspace(-0.4, 0.4, 5)[:, None] * way)


def _covers(polygon: np.ndarray, points: FloatArray) -> bool:
    """Whether a polygon (N, 2) float32 holds the middle and most of points (M, 2)."""
    if not cv2.pointPolygonTest(polygon, points[len(points) // 2].tolist(), False) > 0:
        return False
    inside = [cv2.pointPolygonTest(polygon, point, False) > 0 for point in points.tolist()]
    return 2 * sum(inside) > len(inside)


def _check_image(image_bgr: np.ndarray, camera: Camera) -> None:
    expected = (camera.info.height, camera.info.width, 3)
    problem = None
    if not isinstance(image_bgr, np.ndarray):
        problem = f"not an image but {shown(image_bgr)}; cv2.imread gives None if the file is missing"
    elif image_bgr.dtype != np.uint8 or image_bgr.shape != expected:
        problem = f"an image {image_bgr.shape} {image_bgr.dtype}, its camera_info says {expected} uint8; "
        problem += "fix the camera_info or pick the images that belong to it"
    if problem:
        raise DetectorError(f"camera '{camera.info.name}': got {problem}")
