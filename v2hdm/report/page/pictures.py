"""Small pictures of the map's features and of excluded candidates, cut from the drive's images."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypedDict

import numpy as np

from v2hdm.detection.frames import read_image
from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.lens import distort_points
from v2hdm.io.metrics import Number
from v2hdm.records import FloatArray, Image
from v2hdm.report.page.embedding import json_text
from v2hdm.report.page.facts import Facts, cams_from_map
from v2hdm.report.page.layers import jpeg, jpeg_of, rounded, shrunk
from v2hdm.store.files import take_typed
from v2hdm.store.names import overlay_file

BUDGET_BYTES = 8_000_000  # limit of all pictures, as text in the page
PAGE_BYTES = 15_000_000  # size below which a report stays, as long as its map alone leaves room; chosen
_REST_BYTES = 2_000_000  # size of what is in a page beside map and pictures: half of that on rendered ports
PER_CAMERA = 2  # pictures per marking and camera: the nearest, and one from the middle of its sightings
_USUAL_BYTES = 5_000  # usual size of a picture, to estimate how many fit
_LONGEST_PX = 320  # longer side of a picture at most
_LEAST_PX = 96  # least side of a cut, px of the image
_MARGIN = 0.45  # margin around a marking, relative to its size
_QUALITY = 72  # quality of a picture's JPEG, of 100

_NEAR_M = 3.0  # least depth at which a feature other than a marking is pictured
_FAR_M = 14.0  # largest depth at which a feature other than a marking is pictured


@dataclass(frozen=True)
class Cut:
    """A cut of an image for the feature ``key``; ``rank`` 0 is its best."""

    key: str
    rank: int
    image: str
    row: int
    shape_map: FloatArray  # (N, 2)
    seen_px: FloatArray  # (M, 2) detected corners, recorded px


def room_for_pictures(map_data: dict[str, Any]) -> int:
    """The bytes that a page's map leaves for pictures."""
    room = PAGE_BYTES - _REST_BYTES - len(json_text(map_data))
    return min(max(room, 0), BUDGET_BYTES)


def pictures(facts: Facts, most_bytes: int) -> dict[str, list[dict[str, Any]]]:
    """Pictures by feature, best first: keys ``m`` or ``s`` and the id, ``x`` and an excluded one's number.

    As text they take ``most_bytes``.

    Each has ``src`` (JPEG in base64), ``size``, ``camera``, ``image``, ``t`` (s), the projected shape
    (``map``) and the detected corners (``seen``), in px of the picture. Empty without the drive; raises
    DriveError for an unreadable image.
    """
    if facts.drive is None or not facts.drive.has_pictures:
        return {}
    if facts.residuals is None or facts.route is None or facts.hd_map is None:
        return {}
    images = {facts.drive.name_of(image.path): image for image in facts.drive.images}
    calibrations = {name: camera.calibration for name, camera in facts.cameras.items()}
    cam_from_map = cams_from_map(facts.residuals, facts.route, calibrations)
    cuts = [*_of_markings(facts)]
    for symbol in facts.hd_map.symbols:
        cuts += _of_place(facts, cam_from_map, f"s{symbol.id}", symbol.outline_map)
    for number, candidate in enumerate(facts.excluded):
        cuts += _of_place(facts, cam_from_map, f"x{number}", candidate.position_map[None])
    cuts = [cut for cut in cuts if cut.image in images]
    by_image: dict[str, list[Cut]] = {}
    for cut in sorted(cuts, key=lambda cut: cut.rank)[: most_bytes // _USUAL_BYTES]:
        by_image.setdefault(cut.image, []).append(cut)
    cameras = facts.drive.cameras

    def drawn_from(name: str) -> list[tuple[Cut, dict[str, Any]]]:
        """The pictures that an image gives."""
        pixels = read_image(images[name], cameras[images[name].camera])
        cut_outs = [
            (cut, cut_out(pixels, facts, images[name], cam_from_map[cut.row], cut)) for cut in by_image[name]
        ]
        return [(cut, {**picture, "image": name}) for cut, picture in cut_outs if picture is not None]

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        drawn = [pair for pairs in threads.map(drawn_from, by_image) for pair in pairs]
    # The best picture of every feature first, then the second best, up to the limit.
    out: dict[str, list[dict[str, Any]]] = {}
    spent = 0
    for cut, picture in sorted(drawn, key=lambda pair: pair[0].rank):
        spent += len(picture["src"])
        if spent > most_bytes:
            break
        out.setdefault(cut.key, []).append(picture)
    return out


Place = tuple[Number, Number]


class Picture(TypedDict):
    """One picture in the page, as :func:`pictures` makes it."""

    src: str
    size: tuple[int, int]
    camera: str
    image: str
    t: Number
    map: list[Place]
    seen: list[Place]


def earlier_pictures(content: object) -> dict[str, list[dict[str, Any]]]:
    """The pictures of an earlier report; none where somebody has made something else of them."""
    try:
        pictures: dict[str, list[dict[str, Any]]] = take_typed(
            content, dict[str, list[Picture]], "pictures", MapFileError
        )
    except MapFileError:
        return {}
    return pictures


def _of_markings(facts: Facts) -> Iterable[Cut]:
    """Cuts of the markings' sightings: nearest first, alternating cameras."""
    residuals = facts.residuals
    assert residuals is not None
    assert facts.hd_map is not None
    infos = {name: camera.calibration.info for name, camera in facts.cameras.items()}
    corners = {marking.id: marking.corners_map for marking in facts.hd_map.markings}
    pairs = np.stack([residuals.marking, residuals.row_image], axis=1)
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    starts = np.flatnonzero(np.r_[True, (np.diff(pairs[order], axis=0) != 0).any(axis=1)])
    # By marking and camera: the sightings' sizes, their rows, and the corners that were detected, px.
    sightings_of: dict[int, dict[str, list[tuple[float, int, FloatArray]]]] = {}
    for rows in np.split(order, starts[1:]):
        marking, row = pairs[rows[0]].tolist()
        camera = residuals.camera[row]
        if marking not in corners or camera not in infos:
            continue
        points = residuals.observed_px[rows[residuals.is_point[rows]]]
        if len(points) < 2:
            continue
        seen_px = distort_points(infos[camera], points)
        size = float(np.ptp(seen_px, axis=0).prod()) * len(points)
        sightings_of.setdefault(marking, {}).setdefault(camera, []).append((size, row, seen_px))
    for marking, by_camera in sightings_of.items():
        for number, sightings in enumerate(by_camera.values()):
            ranked = sorted(sightings, key=lambda sighting: -sighting[0])
            chosen = [ranked[0], ranked[len(ranked) // 2]][: min(PER_CAMERA, len(ranked))]
            for step, (_, row, seen_px) in enumerate(chosen):
                rank = step * len(by_camera) + number
                yield Cut(f"m{marking}", rank, residuals.image[row], row, corners[marking], seen_px)


def _of_place(facts: Facts, cam_from_map: FloatArray, key: str, shape_map: FloatArray) -> Iterable[Cut]:
    """Cuts of a place from near, one per camera, occluded or not."""
    residuals = facts.residuals
    assert residuals is not None
    centre = shape_map.mean(axis=0)
    rank = 0
    for name, camera_facts in facts.cameras.items():
        rows = np.flatnonzero([camera == name for camera in residuals.camera])
        info = camera_facts.calibration.info
        px, depth_m = project_ground(info.intrinsic, cam_from_map[rows], centre[None])
        size = np.array([info.width, info.height])
        inside = ((px[:, 0] > 0.05 * size) & (px[:, 0] < size - 0.05 * size)).all(axis=1)
        in_range = inside & (depth_m[:, 0] > _NEAR_M) & (depth_m[:, 0] < _FAR_M)
        if in_range.any():
            best = rows[in_range][np.argmin(depth_m[in_range, 0])]
            yield Cut(key, rank, residuals.image[best], int(best), shape_map, np.empty((0, 2)))
            rank += 1


def cut_out(
    pixels: np.ndarray, facts: Facts, image: Image, cam_from_map: FloatArray, cut: Cut
) -> dict[str, Any] | None:
    """The smallest useful cut around a feature; None if it is out of the image."""
    info = facts.cameras[image.camera].calibration.info
    shape_map = cut.shape_map
    if facts.surface is not None and facts.residuals is not None and facts.route is not None:
        frame = int(facts.route.frames_of(facts.residuals)[cut.row])
        shape_map = facts.surface.on_plane(shape_map, cam_from_map, frame)
    px, depth_m = project_ground(info.intrinsic, cam_from_map, shape_map)
    if not (depth_m > 0).all():
        return None
    shape_px = distort_points(info, px)
    shown = np.concatenate([shape_px, cut.seen_px])
    low = shown.min(axis=0)
    high = shown.max(axis=0)
    half = np.maximum((0.5 + _MARGIN) * (high - low), _LEAST_PX / 2)
    # An aspect ratio of at most 3, so that pictures in a row look alike.
    half = np.maximum(half, half[::-1] / 3)
    middle = 0.5 * (low + high)
    first = np.clip(np.floor(middle - half), 0, [info.width - 1, info.height - 1]).astype(int)
    last = np.clip(np.ceil(middle + half), 1, [info.width, info.height]).astype(int)
    if (last - first).min() < 16:
        return None
    piece = pixels[first[1] : last[1], first[0] : last[0]]
    factor = min(1.0, _LONGEST_PX / max(piece.shape[:2]))
    if factor < 1.0:
        piece = shrunk(piece, factor)
    return {
        "src": jpeg(piece, _QUALITY),
        "size": [piece.shape[1], piece.shape[0]],
        "camera": image.camera,
        "t": round(float(image.stamp_s), 3),
        # Pixel centres are at integers in the image, at halves in SVG.
        "map": rounded((shape_px - first + 0.5) * factor, 1),
        "seen": rounded((cut.seen_px - first + 0.5) * factor, 1),
    }


def overlays(facts: Facts) -> Mapping[str, str]:
    """The folder's ``overlay_<camera>.png`` by camera, as JPEG in base64."""
    jpegs = {name: jpeg_of(facts.folder / overlay_file(name), 1200, 82) for name in facts.cameras}
    return {name: picture for name, picture in jpegs.items() if picture is not None}
