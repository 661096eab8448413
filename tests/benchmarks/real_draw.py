"""Draw the reference of :mod:`tests.benchmarks.real_drive` from above.

    python -m tests.benchmarks.real_draw --drive DRIVE --tiles FOLDER [--drawn FILE --output FILE]

The road is stitched from all images into tiles, pictures from above with the way along the driven path (m,
to the right) and the offset to its left (m, upwards) at their margins. Mark in them what is painted and run
it again with ``--drawn``, a file of :func:`~tests.benchmarks.real_reference.read_reference` with a
``polygon_road`` for each. Every camera is then moved until the drawing lies on the paint of its image, see
:mod:`tests.benchmarks.real_align`; what belongs to another road or is optional moves none. Written are the
same reference with these cameras, and the tiles again, sharper and drawn over: where something is out of
place, mend the drawing and repeat. Each point of a tile is taken from one image, so that an edge with a
step in it tells that two cameras disagree.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from tests.benchmarks.real_align import align
from tests.benchmarks.real_drive import views_of_images
from tests.benchmarks.real_reference import Reference, Route, read_reference
from tests.benchmarks.real_view import View
from v2hdm.detection.frames import read_image
from v2hdm.io.drive import ReadOptions
from v2hdm.pipeline.map_drive import map_drive
from v2hdm.records import FloatArray
from v2hdm.store.files import replace_text

TILE_M = 20.0
RESOLUTION_M = 0.02

_NEAREST_M, _FARTHEST_M = 4.0, 30.0
_RED, _YELLOW = (0, 0, 255), (0, 255, 255)


@dataclass(frozen=True)
class Tile:
    """A stretch of road from above, ``way_m`` and ``offset_m`` (least, largest) along and left of a route."""

    way_m: tuple[float, float]
    offset_m: tuple[float, float]
    resolution_m: float = RESOLUTION_M

    def points_road(self) -> FloatArray:
        """(way, offset) (H, W, 2) of its pixels: the way to the right, the left upwards."""
        way = np.arange(self.way_m[0], self.way_m[1], self.resolution_m)
        offset = np.arange(self.offset_m[1], self.offset_m[0], -self.resolution_m)
        return np.stack(np.meshgrid(way, offset), axis=-1)

    def pixels(self, points_road: FloatArray) -> FloatArray:
        """Pixels (N, 2) of points (way, offset) (N, 2)."""
        from_corner = (points_road - [self.way_m[0], self.offset_m[1]]) / self.resolution_m
        return np.asarray(from_corner * [1.0, -1.0])


def stitch(tile: Tile, route: Route, views: Sequence[View], images: Sequence[np.ndarray]) -> np.ndarray:
    """The picture (H, W, 3) uint8 of a tile, each place from the nearest image that shows it, else black."""
    points_road = tile.points_road()
    points_map = route.at(points_road.reshape(-1, 2))
    picture = np.zeros((*points_road.shape[:2], 3), dtype=np.uint8)
    nearest = np.full(len(points_map), _FARTHEST_M)
    for view, image in zip(views, images, strict=True):
        ranges_m = view.ranges_m(points_map)
        at = view.project(points_map)
        limit = np.array([view.info.width, view.info.height]) - 1
        is_nearest = ((at >= 0) & (at <= limit)).all(axis=1) & (ranges_m > _NEAREST_M) & (ranges_m < nearest)
        if not is_nearest.any():
            continue
        nearest[is_nearest] = ranges_m[is_nearest]
        u, v = np.moveaxis(np.where(is_nearest[:, None], at, -1.0).astype(np.float32), 1, 0)
        shown = cv2.remap(image, u.reshape(picture.shape[:2]), v.reshape(picture.shape[:2]), cv2.INTER_LINEAR)
        mask = is_nearest.reshape(picture.shape[:2])
        picture[mask] = shown[mask]
    return picture


def label(picture: np.ndarray, tile: Tile, route: Route, polygons_map: Sequence[FloatArray]) -> np.ndarray:
    """A tile's picture with polygons (N, 2) m on it and a mark at every metre of its margins."""
    canvas = picture.copy()
    for polygon in polygons_map:
        outline = np.round(tile.pixels(route.along(polygon)) * 16).astype(np.int32)
        cv2.polylines(canvas, [outline], True, _RED, 1, cv2.LINE_AA, 4)
    for axis, (low, high) in enumerate((tile.way_m, tile.offset_m)):
        for metre in range(int(np.ceil(low)), int(np.floor(high)) + 1):
            place = np.array([tile.way_m[0], tile.offset_m[1]])
            place[axis] = metre
            x, y = (int(c) for c in np.round(tile.pixels(place[None])[0]))
            cv2.line(canvas, (x, y), (x + 6 * axis, y + 6 * (1 - axis)), _YELLOW)
            if metre % 5 == 0 or axis == 1:
                cv2.putText(canvas, str(metre), (x + 8, y + 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _YELLOW)
    return canvas


def _align_all(reference: Reference, views: Sequence[View], images: Sequence[np.ndarray]) -> list[View]:
    """Every image's camera where the reference lies on its paint; prints how it went."""
    polygons = [p.polygon_map for p in reference.markings if not (p.other_road or p.optional)]
    aligned = []
    for index, (view, image) in enumerate(zip(views, images, strict=True)):
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        alignment = align(view, grey, polygons, reference.hidden.get(index, []))
        turn, shift = np.round(np.degrees(alignment.motion[:3]), 2), np.round(alignment.motion[3:], 3)
        print(f"image {index}: {alignment.edges} edges, {alignment.spread_px:.2f} px; {turn} deg, {shift} m")
        aligned.append(alignment.view)
    return aligned


def main() -> None:
    """Write the tiles and, if something is drawn, the reference."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--drive", type=Path, required=True)
    parser.add_argument("--camera", help="the camera to look through, if the drive has several")
    parser.add_argument("--tiles", type=Path, required=True, help="folder for the pictures")
    parser.add_argument(
        "--sides", type=float, nargs=2, default=(-6.0, 6.0), help="least and largest offset, m"
    )
    parser.add_argument("--drawn", type=Path)
    parser.add_argument("--output", type=Path, help="where the reference goes that --drawn becomes")
    parsed = parser.parse_args()
    if (parsed.drawn is None) != (parsed.output is None):
        parser.error("--drawn and --output belong together")
    cv2.setNumThreads(1)
    result = map_drive(parsed.drive, reading=ReadOptions(cameras=[parsed.camera] if parsed.camera else []))
    drive = result.drive
    views = views_of_images(result)
    images = [read_image(image, drive.cameras[image.camera]) for image in drive.images]
    route_map = np.array([image.map_from_vehicle[:2, 3] for image in drive.images])
    polygons: list[FloatArray] = []
    if parsed.drawn is not None:
        reference = read_reference(parsed.drawn, route_map)
        polygons = [p.polygon_map for p in reference.markings]
        views = _align_all(reference, views, images)
        content = json.loads(parsed.drawn.read_text(encoding="utf-8"))
        content["cam_from_map"] = [
            {"image": i, "matrix": v.cam_from_map.tolist()} for i, v in enumerate(views)
        ]
        replace_text(parsed.output, json.dumps(content))
    route = Route(route_map)
    parsed.tiles.mkdir(parents=True, exist_ok=True)
    for start in np.arange(0.0, route.way[-1], TILE_M):
        tile = Tile((float(start), float(start) + TILE_M), (parsed.sides[0], parsed.sides[1]))
        picture = stitch(tile, route, views, images)
        if picture.any():
            cv2.imwrite(
                str(parsed.tiles / f"way_{int(start):04d}.png"), label(picture, tile, route, polygons)
            )


if __name__ == "__main__":
    main()
