"""How much of what is detected in the single images of a real drive lies on paint, given where paint is.

    python -m tests.benchmarks.lane_paint --drive DRIVE --drawn FILE [--off FOLDER] [--network-alone]

FILE is a reference as :mod:`tests.benchmarks.real_draw` draws it, of all paint in reach of the images. Each
image is looked at alone, with the camera and the pose that the drive states. Counted are the pieces of
``lane_line`` and ``lane_dash``: a piece lies on paint if half of its points lie on drawn paint, within
{NEAR_M:g} m. Then, by class, the markings, and how many of them reach no paint of their class. So that
silence does not pass for sight, drawn paint of lanes that an image shows within {REACH_M:g} m is counted,
too, and how much of it has a piece on it. ``--off`` writes the pictures of what lies on no paint;
with ``--network-alone`` nothing but the network tells paint from bare ground.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks.real_reference import Painted, Reference, read_reference
from v2hdm.catalogue import SHIPPED
from v2hdm.detection import detector as detecting
from v2hdm.detection.camera import RoadCamera
from v2hdm.detection.detector import Detector
from v2hdm.detection.frames import read_image
from v2hdm.detection.options import DetectorOptions
from v2hdm.io.drive import read_drive
from v2hdm.records import BoolArray, FloatArray, Image, LaneDetection, MarkingDetection

NEAR_M = 0.15  # a point this near to drawn paint lies on it, m: the drawing and the poses err by as much
REACH_M = 20.0  # distance, m, within which drawn paint should be seen
ON_SHARE = 0.5  # share of a piece's points on paint from which the piece is
_BORDER_PX = 10  # paint this near to the image's border need not be seen, px
_AROUND_PX = 120  # surroundings of a piece in its picture, px


def on_paint(points_map: FloatArray, markings: Sequence[Painted]) -> BoolArray:
    """Which points (N, 2) lie on one of the markings, or nearer than :data:`NEAR_M`."""
    on = np.zeros(len(points_map), dtype=np.bool_)
    for marking in markings:
        ring = marking.polygon_map.astype(np.float32)
        distances_m = [cv2.pointPolygonTest(ring, point, True) for point in points_map.tolist()]
        on |= np.array(distances_m) > -NEAR_M
    return on


class Tally:
    """Counts over the images of a drive."""

    def __init__(self, reference: Reference) -> None:
        lanes = set(SHIPPED.lane_paint)
        self._paint = [marking for marking in reference.markings if not marking.optional]
        self._lanes = [marking for marking in self._paint if marking.kind in lanes]
        self._of_kind = reference.markings
        self.pieces: Counter[str] = Counter()
        self.on: Counter[str] = Counter()
        self.markings: Counter[str] = Counter()
        self.true: Counter[str] = Counter()
        self.shown = 0
        self.covered = 0

    def add(self, image: Image, camera: RoadCamera, lanes: Sequence[LaneDetection]) -> list[LaneDetection]:
        """Count the pieces of one image; returns those on no paint."""
        off = []
        ground = [np.empty((0, 2))]
        for lane in lanes:
            if lane.kind not in SHIPPED.lane_paint:
                continue
            points_map = _in_map(lane.points_px, camera, image)
            is_on = bool(on_paint(points_map, self._paint).mean() >= ON_SHARE)
            self.pieces[lane.kind] += 1
            self.on[lane.kind] += is_on
            if is_on:
                ground.append(points_map)
            else:
                off.append(lane)
        self._add_shown(image, camera, np.concatenate(ground))
        return off

    def add_markings(self, image: Image, camera: RoadCamera, markings: Sequence[MarkingDetection]) -> None:
        """Count the markings of one image."""
        for marking in markings:
            shape_px = marking.outline_px if len(marking.outline_px) else marking.corners_px
            of_kind = [painted for painted in self._of_kind if painted.kind == marking.kind]
            self.markings[marking.kind] += 1
            self.true[marking.kind] += bool(on_paint(_in_map(shape_px, camera, image), of_kind).any())

    def _add_shown(self, image: Image, camera: RoadCamera, pieces_map: FloatArray) -> None:
        """Count the drawn paint of lanes that an image shows whole, and what of it has a piece on it."""
        for painted in self._lanes:
            vehicle_from_map = np.linalg.inv(image.map_from_vehicle)
            ring = painted.polygon_map @ vehicle_from_map[:2, :2].T + vehicle_from_map[:2, 3]
            ahead = ring[:, 0] > camera.foot_vehicle[0]
            if not (ahead & (camera.range_m(ring) < REACH_M)).all():
                continue
            if not camera.inside(camera.project(ring), _BORDER_PX).all():
                continue
            self.shown += 1
            self.covered += bool(on_paint(pieces_map, [painted]).any())

    def lines(self) -> list[str]:
        """The figures."""
        said = [
            f"{kind}: {self.pieces[kind]} pieces, {self.on[kind]} on paint "
            f"({self.on[kind] / max(self.pieces[kind], 1):.3f})"
            for kind in SHIPPED.lane_paint
        ]
        said += [
            f"{kind}: {count} markings, {count - self.true[kind]} on no paint of theirs"
            for kind, count in sorted(self.markings.items())
        ]
        return [*said, f"paint of lanes shown: {self.shown}, with a piece on it {self.covered}"]


def _in_map(points_px: FloatArray, camera: RoadCamera, image: Image) -> FloatArray:
    ground = camera.unproject(points_px)
    ground = ground[np.isfinite(ground).all(axis=1)]
    return np.asarray(ground @ image.map_from_vehicle[:2, :2].T + image.map_from_vehicle[:2, 3])


def _picture(pixels: np.ndarray, lane: LaneDetection) -> np.ndarray:
    """The surroundings of a piece, plain and with the piece drawn on it."""
    drawn = pixels.copy()
    cv2.polylines(drawn, [np.round(lane.points_px).astype(np.int32)], False, (0, 255, 0), 1, cv2.LINE_AA)
    u, v = lane.points_px.mean(axis=0).astype(int).tolist()
    rows = slice(max(v - _AROUND_PX, 0), v + _AROUND_PX)
    columns = slice(max(u - _AROUND_PX, 0), u + _AROUND_PX)
    return np.hstack([pixels[rows, columns], drawn[rows, columns]])


def main() -> None:
    """Print the figures."""
    about = (__doc__ or "").format(NEAR_M=NEAR_M, REACH_M=REACH_M)
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--drive", type=Path, required=True)
    parser.add_argument("--drawn", type=Path, required=True)
    parser.add_argument("--off", type=Path, help="folder for pictures of what lies on no paint")
    parser.add_argument("--network-alone", action="store_true")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    if parsed.network_alone:
        detecting.painted = lambda pieces, image_bgr, camera: list(pieces)
    drive = read_drive(parsed.drive)
    route_map = np.array([image.map_from_vehicle[:2, 3] for image in drive.images])
    tally = Tally(read_reference(parsed.drawn, route_map))
    detector = Detector.load(options=DetectorOptions())
    for number, image in enumerate(drive.images):
        camera = drive.cameras[image.camera]
        pixels = read_image(image, camera)
        markings, lanes = detector.detect(pixels, camera)
        road_camera = detector.road_camera(camera)
        off = tally.add(image, road_camera, lanes)
        tally.add_markings(image, road_camera, markings)
        if parsed.off is not None:
            parsed.off.mkdir(parents=True, exist_ok=True)
            for index, lane in enumerate(off):
                cv2.imwrite(str(parsed.off / f"{number:04d}_{index}_{lane.kind}.png"), _picture(pixels, lane))
    print("\n".join(tally.lines()))


if __name__ == "__main__":
    main()
