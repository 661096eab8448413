"""The figures of one drive: every method's map against the truth, and how far single sightings are off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from v2hdm.association.sightings import Sightings, collect_sightings
from v2hdm.errors import MappingError
from v2hdm.experiment.plan import OURS, RECIPES
from v2hdm.geometry.ipm import (
    apply_in_front,
    facing_ipm,
    flat_motion,
    ground_from_pinhole_px,
    pinhole_px_from_ground,
    project_ground,
)
from v2hdm.geometry.rigid import camera_centre, inverse
from v2hdm.mapping.methods import NAIVE_IPMS
from v2hdm.mapping.results import MethodResult
from v2hdm.records import DIAMOND, Drive, FloatArray, HdMap, ImageDetections, IntArray, Marking, Truth
from v2hdm.report.metrics import corner_errors, marking_metrics, match_markings, rms
from v2hdm.report.terminal import METHODS

ROWS: tuple[str, ...] = (
    *METHODS,
    *(f"{method}, {recipe}" for recipe in RECIPES if recipe != OURS for method in ("Opt", "ONI")),
)
"""Rows of the tables: the paper's four methods, then ours under other recipes."""


@dataclass(frozen=True)
class Row:
    """One method on one set of cameras of one drive; lengths in m, nan where nothing matched.

    ``recall`` is that of the diamonds driven past, of all markings where there are none. ``spread_m`` is the
    root mean square distance of the error vectors from their mean. ``shared`` counts the markings that every
    method of this camera set has mapped, ``shared_rmse_m`` is of those alone.
    """

    markings: int
    recall: float
    false_markings: int
    rmse_m: float
    bias_m: float
    spread_m: float
    shared: int
    shared_rmse_m: float


@dataclass(frozen=True)
class Matched:
    """Markings of a map with a true counterpart: ``true`` (M,) indexes it, ``mapped`` (M,) the map.

    ``errors_m`` (M, 4, 2) are the error vectors of their corners, in the order in which the vehicle passed
    them.
    """

    true: IntArray
    mapped: IntArray
    errors_m: FloatArray


@dataclass(frozen=True)
class Measured:
    """The figures of one drive: by camera set, then by row."""

    port: str
    seed: int | None
    started_from: str
    rows: Mapping[str, Mapping[str, Row]]
    matched: Mapping[str, Mapping[str, Matched]]
    extrinsics: Mapping[str, Any]
    failures: tuple[tuple[str, str, str], ...]

    @property
    def title(self) -> str:
        """The drive in words."""
        return self.port if self.seed is None else f"{self.port} seed {self.seed}"


def markings_of(plain: Mapping[str, Any]) -> tuple[Marking, ...]:
    """The markings of a map in a drive's record."""
    corners = np.array(plain["corners"], dtype=np.float64).reshape(-1, 4, 2)
    return tuple(
        Marking(kind, own, sightings)
        for kind, own, sightings in zip(plain["kinds"], corners, plain["sightings"], strict=True)
    )


def measure(record: Mapping[str, Any]) -> Measured:
    """The figures of a drive's record."""
    true = markings_of(record["truth"])
    truth = Truth(HdMap(true), {}, np.empty((0, 4, 4)), np.empty((0, len(true))), (), {})
    passed = _passed(true, np.array(record["route"], dtype=np.float64))
    rows: dict[str, Mapping[str, Row]] = {}
    matched: dict[str, Mapping[str, Matched]] = {}
    for cameras, plain_maps in record["maps"].items():
        maps = {row: HdMap(markings_of(plain_maps[row])) for row in ROWS if row in plain_maps}
        found = {row: _matched(hd_map, true, passed) for row, hd_map in maps.items()}
        shared = set(range(len(true))).intersection(*(one.true.tolist() for one in found.values()))
        expected = np.array(record["expected"][cameras], dtype=np.bool_)
        rows[cameras] = {row: _row(maps[row], truth, expected, found[row], shared) for row in maps}
        matched[cameras] = found
    started = " and ".join(sorted({camera["initial_ipm"] for camera in record["cameras"].values()}))
    failures = tuple((recipe, cameras, text) for recipe, cameras, text in record["failures"])
    return Measured(record["port"], record["seed"], started, rows, matched, record["extrinsics"], failures)


def _passed(true: tuple[Marking, ...], route_map: FloatArray) -> IntArray:
    """For every true marking the point of the route nearest to it, the first where there are several."""
    if not true:
        return np.empty(0, dtype=np.int64)
    centres = np.array([marking.corners_map.mean(axis=0) for marking in true])
    away_m = np.linalg.norm(centres[:, None] - route_map[None], axis=2)
    return np.asarray(away_m.argmin(axis=1))


def _matched(hd_map: HdMap, true: tuple[Marking, ...], passed: IntArray) -> Matched:
    mapped, other = (np.array(i, dtype=np.int64) for i in match_markings(hd_map.markings, true))
    order = np.argsort(passed[other], kind="stable")
    mapped, other = mapped[order], other[order]
    errors = corner_errors([hd_map.markings[m] for m in mapped], [true[t] for t in other])
    return Matched(other, mapped, errors.reshape(-1, 4, 2))


def _row(
    hd_map: HdMap, truth: Truth, expected: np.ndarray, matched: Matched, shared: set[int]
) -> Row:  # fmt: skip
    overall = marking_metrics(hd_map, truth, expected)
    diamonds = marking_metrics(hd_map, truth, expected, DIAMOND)
    errors = matched.errors_m.reshape(-1, 2)
    of_shared = matched.errors_m[np.isin(matched.true, list(shared))].reshape(-1, 2)
    return Row(
        markings=overall.markings,
        recall=diamonds.recall if diamonds.expected else overall.recall,
        false_markings=overall.false_markings,
        rmse_m=overall.corner_rmse_m,
        bias_m=overall.corner_bias_m,
        spread_m=rms(errors - errors.mean(axis=0)) if len(errors) else float("nan"),
        shared=len(shared),
        shared_rmse_m=rms(of_shared),
    )


SAME_SHARE = 0.5  # a sighting is of the marking whose image lies within this share of its own diameter of it
CELLS = (8, 5)  # cells of a field of residuals, across and down the image
RANGE_STEP_M = 1.0  # width of a bin of ranges
_FARTHEST_M = 22.0
_FEWEST = 20  # corners below which neither a cell nor a bin has figures


def residuals(
    drive: Drive,
    detections: Sequence[ImageDetections],
    methods: Mapping[str, MethodResult],
    truth: Truth,
) -> dict[str, Any]:
    """By camera ``field`` and ``range`` of a camera set's results, as plain content.

    ``field`` holds for ``before`` and ``after`` the median residual (px) of detected corners against the
    optimised map, by cell of the image: before under the first IPM and the recorded poses, after under
    the optimised extrinsic and the adjusted poses. ``range`` holds by method quartiles of the distance
    (m) between corners of single sightings, laid on the ground, and the true ones. ``drive`` is as it was
    described; ``Opt`` is among the ``methods``.
    """
    best = methods["Opt"]
    out: dict[str, Any] = {}
    for name in best.cameras:
        try:
            sightings = collect_sightings(drive, detections, (name,))
        except MappingError:
            continue  # a camera that saw nothing has no residuals
        seen = _Seen.of(drive, sightings, name, best)
        field, ranges = _field(drive, seen, name, best), _by_range(drive, seen, name, methods, truth)
        out[name] = {"field": field, "range": ranges}
    return out


def _adjusted(drive: Drive, image: int, best: MethodResult) -> FloatArray:
    one = drive.images[image]
    return one.map_from_vehicle if best.poses is None else best.poses.of_image(one)


@dataclass(frozen=True)
class _Seen:
    """N sightings that were recognised in the map, by where the optimised calibration sees its markings.

    ``marking`` (N,) indexes the map, ``corners_map`` (N, 4, 2) are its corners in the order of
    ``corners_px`` (N, 4, 2), those of the images ``image``.
    """

    image: list[int]
    marking: IntArray
    corners_map: FloatArray
    corners_px: FloatArray

    @classmethod
    def of(cls, drive: Drive, sightings: Sightings, name: str, best: MethodResult) -> _Seen:
        calibration, markings = best.calibrations[name], best.hd_map.markings
        found: list[tuple[int, int, FloatArray]] = []
        corners = np.array([marking.corners_map for marking in markings]).reshape(-1, 4, 2)
        kinds = np.array([marking.kind for marking in markings])
        whole = sightings.valid.all(axis=1)
        for image in np.unique(sightings.image):
            cam_from_map = calibration.cam_from_vehicle @ inverse(_adjusted(drive, int(image), best))
            places, depth = project_ground(calibration.info.intrinsic, cam_from_map, corners.reshape(-1, 2))
            places, ahead = places.reshape(-1, 4, 2), (depth.reshape(-1, 4) > 0).all(axis=1)
            for row in np.flatnonzero((sightings.image == image) & whole):
                corners_px = sightings.corners_pinhole_px[row]
                alike = np.flatnonzero(ahead & (kinds == sightings.kinds[sightings.kind[row]]))
                if not len(alike):
                    continue
                distance = np.linalg.norm(places[alike].mean(axis=1) - corners_px.mean(axis=0), axis=1)
                marking = int(alike[distance.argmin()])
                if distance.min() <= SAME_SHARE * np.linalg.norm(np.ptp(corners_px, axis=0)):
                    off = [((np.roll(places[marking], -s, axis=0) - corners_px) ** 2).sum() for s in range(4)]
                    turned = np.roll(corners[marking], -int(np.argmin(off)), axis=0)
                    found.append((int(row), marking, turned))
        rows = [row for row, _, _ in found]
        return cls(
            sightings.image[rows].tolist(),
            np.array([marking for _, marking, _ in found], np.int64),
            np.array([turned for _, _, turned in found]).reshape(-1, 4, 2),
            sightings.corners_pinhole_px[rows],
        )


def _field(drive: Drive, seen: _Seen, name: str, best: MethodResult) -> dict[str, Any]:
    camera, found = drive.cameras[name], best.calibrations[name]
    first = np.linalg.inv(facing_ipm(camera.ipm[camera.initial_ipm], camera.roi_vehicle.mean(axis=0)))
    size = (camera.info.width, camera.info.height)
    out: dict[str, Any] = {"size_px": size}
    for when, homographies in (
        ("before", [first @ flat_motion(inverse(drive.images[i].map_from_vehicle)) for i in seen.image]),
        (
            "after",
            [
                pinhole_px_from_ground(
                    camera.info.intrinsic, found.cam_from_vehicle @ inverse(_adjusted(drive, i, best))
                )
                for i in seen.image
            ],
        ),
    ):
        projected = apply_in_front(np.array(homographies).reshape(-1, 3, 3), seen.corners_map)
        out[when] = _cells(seen.corners_px, projected, size)
    return out


def _cells(observed_px: FloatArray, projected_px: FloatArray, size: tuple[int, int]) -> dict[str, Any]:
    """Median residual (detected minus projected) by cell, None where there are too few; median length of all.

    A median, for single corners are off by many pixels: cut by shadows, or of another marking.
    """
    place, residual = observed_px.reshape(-1, 2), (observed_px - projected_px).reshape(-1, 2)
    keep = np.isfinite(residual).all(axis=1) & (place >= 0).all(axis=1) & (place < size).all(axis=1)
    place, residual = place[keep], residual[keep]
    cell = (place * CELLS / size).astype(np.int64)
    number = cell[:, 1] * CELLS[0] + cell[:, 0]
    median: list[list[float] | None] = []
    for index in range(CELLS[0] * CELLS[1]):
        own = number == index
        median.append(np.median(residual[own], axis=0).tolist() if own.sum() >= _FEWEST else None)
    length = float(np.median(np.linalg.norm(residual, axis=1))) if len(residual) else None
    return {"median_px": median, "length_px": length, "corners": len(residual)}


def _by_range(
    drive: Drive, seen: _Seen, name: str, methods: Mapping[str, MethodResult], truth: Truth
) -> dict[str, Any]:
    """Quartiles of the distance (m) of single sightings' corners to the true ones, by method."""
    camera, best = drive.cameras[name], methods["Opt"]
    true_of = dict(zip(*match_markings(best.hd_map.markings, truth.map.markings), strict=True))
    known = np.flatnonzero(np.isin(seen.marking, list(true_of)))
    if not len(known):
        return {}
    corners = []
    for k in known:
        # Corners begin where they lie nearest to those of the sighting.
        true = truth.map.markings[true_of[int(seen.marking[k])]].corners_map
        turned = np.stack([np.roll(true, shift, axis=0) for shift in range(4)])
        corners.append(turned[((turned - seen.corners_map[k]) ** 2).sum(axis=(1, 2)).argmin()])
    images = [seen.image[k] for k in known]
    recorded = flat_motion(np.array([drive.images[image].map_from_vehicle for image in images]))
    vehicle_from_map = inverse(np.array([_adjusted(drive, image, best) for image in images]))
    found, intrinsic = best.calibrations[name].cam_from_vehicle, camera.info.intrinsic
    side = camera.roi_vehicle.mean(axis=0)
    grounds = {
        "ONI": recorded @ ground_from_pinhole_px(intrinsic, found),
        "Opt": ground_from_pinhole_px(intrinsic, found @ vehicle_from_map),
    }
    for method, ipm in NAIVE_IPMS.items():
        if method in methods and ipm in camera.ipm:
            grounds[method] = recorded @ facing_ipm(camera.ipm[ipm], side)
    true_pose = truth.map_from_vehicle[images]
    camera_map = (true_pose @ np.append(camera_centre(truth.cam_from_vehicle[name]), 1.0))[:, :2]
    range_m = np.linalg.norm(np.array(corners) - camera_map[:, None], axis=2).ravel()
    out = {}
    for method in METHODS:
        if method in grounds:
            on_ground = apply_in_front(grounds[method], seen.corners_px[known])
            out[method] = _quartiles(range_m, np.linalg.norm(on_ground - corners, axis=2).ravel())
    return out


def _quartiles(range_m: FloatArray, error_m: FloatArray) -> list[list[float]]:
    """Middle of the bin (m), quartiles of the error (m), corners; for bins that hold enough."""
    out = []
    for low in np.arange(0.0, _FARTHEST_M, RANGE_STEP_M):
        own = (range_m >= low) & (range_m < low + RANGE_STEP_M) & np.isfinite(error_m)
        if own.sum() >= _FEWEST:
            quartiles = np.percentile(error_m[own], [25, 50, 75])
            out.append([float(low + RANGE_STEP_M / 2), *map(float, quartiles), float(own.sum())])
    return out
