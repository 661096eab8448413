"""From a map and a drive to where the vehicle was, and how far the recorded poses are from that."""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.errors import MapFileError
from v2hdm.geometry.ipm import project_ground
from v2hdm.geometry.rigid import heading_rad
from v2hdm.io.calibration.document import trusted_calibrations
from v2hdm.io.drive import ReadOptions, read_drive
from v2hdm.io.drive.tum import write_tum
from v2hdm.io.maps.geojson import read_geojson
from v2hdm.localization.figure import save_errors
from v2hdm.localization.match import Markings, Seen, locate
from v2hdm.localization.motion import State, predict, start
from v2hdm.mapping.sightings.table import Sightings, collect_sightings
from v2hdm.records import Calibration, Drive, FloatArray, HdMap, ImageDetections, Trajectory
from v2hdm.report.outputs import result_folder, write_json
from v2hdm.settings import check_workers

START_SIGMA_M, START_SIGMA_RAD = 0.5, float(np.deg2rad(3.0))
"""How well the first pose is known: a coordinate of a place that RTK has once fixed, and a compass."""

LOST_M = 0.3
"""With a larger standard deviation of the place the vehicle does not know where it is: half a dash's gap."""

LEAST_MATCHED = 0.5
"""Share of the detections that a map of the site explains at least: one explained .86, another site's .04."""

IN_VIEW_M = 15.0
"""A marking is in view whose corners are all in an image and no farther from the camera."""


@dataclass(frozen=True)
class Localised:
    """F frames: ``states`` after each, the markings ``matched`` (F,), and which have one ``in_view`` (F,).

    ``detections`` counts those of all frames. ``shared`` (3,) are the variances of ahead, left and heading
    that map and calibration have in common for all frames.
    """

    stamp_s: FloatArray
    recorded: FloatArray
    states: tuple[State, ...]
    matched: np.ndarray
    in_view: np.ndarray
    shared: FloatArray
    detections: int

    @property
    def known(self) -> np.ndarray:
        """In which frames (F,) the vehicle knows where it is."""
        return np.array([state.sigma_m < LOST_M for state in self.states])

    @property
    def error(self) -> FloatArray:
        """Estimate less recorded pose (F, 3): ahead, m, to the left, m, and heading, rad."""
        estimate = np.stack([state.map_from_vehicle for state in self.states])
        off = estimate[:, :2, 3] - self.recorded[:, :2, 3]
        heading = heading_rad(self.recorded)
        turn = (heading_rad(estimate) - heading + np.pi) % (2 * np.pi) - np.pi
        ahead = off[:, 0] * np.cos(heading) + off[:, 1] * np.sin(heading)
        left = off[:, 1] * np.cos(heading) - off[:, 0] * np.sin(heading)
        return np.column_stack([ahead, left, turn])

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (F, 3) of ahead, left and heading, the map's own shift included."""
        out = []
        for state in self.states:
            c, s = np.cos(state.mean[2]), np.sin(state.mean[2])
            turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            variance = np.diag(turn @ state.covariance[:3, :3] @ turn.T)
            out.append(np.sqrt(variance + self.shared))
        return np.stack(out)

    def figures(self) -> dict[str, float | int]:
        """What the door reports, over the frames with a marking in view."""
        kept = self.in_view & self.known
        error = self.error[kept]
        return {
            "frames": len(self.states),
            "frames_with_a_marking_in_view": int(self.in_view.sum()),
            "localised_share": float(kept.sum() / max(self.in_view.sum(), 1)),
            "position_rmse_m": float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean()))
            if len(error)
            else np.nan,
            "heading_rmse_deg": float(np.degrees(np.sqrt((error[:, 2] ** 2).mean())))
            if len(error)
            else np.nan,
            "worst_position_m": float(np.hypot(*error[:, :2].T).max()) if len(error) else np.nan,
            "median_sigma_m": float(np.median(np.hypot(*self.sigma[:, :2].T))),
            "detections": self.detections,
            "matched_share": float(self.matched.sum() / max(self.detections, 1)),
        }


def localise(
    drive: Drive,
    detections: Sequence[ImageDetections],
    hd_map: HdMap,
    calibrations: Mapping[str, Calibration],
) -> Localised:
    """Follow the vehicle through a drive by the map's markings; of the recorded poses only the first is used.

    Raises:
        MappingError: the images hold no marking.
    """
    names = [name for name in drive.cameras if name in calibrations]
    sightings = collect_sightings(drive, detections, names)
    attitude_rad = drive.pose_noise.roll_pitch_rad
    markings = Markings(hd_map)
    state = start(sightings.map_from_vehicle[0], START_SIGMA_M, START_SIGMA_RAD, attitude_rad)
    states, matched = [], []
    for frame, stamp_s in enumerate(sightings.stamp_s):
        if frame:
            state = predict(state, float(stamp_s - sightings.stamp_s[frame - 1]), attitude_rad)
        state, found = locate(state, _seen(drive, sightings, frame, names, calibrations), markings)
        states.append(state)
        matched.append(len(found))
    return Localised(
        sightings.stamp_s,
        sightings.map_from_vehicle,
        tuple(states),
        np.array(matched),
        _in_view(drive, sightings, hd_map, calibrations),
        np.array([markings.shared_m2, markings.shared_m2, _yaw_variance(calibrations)]),
        len(sightings),
    )


def _yaw_variance(calibrations: Mapping[str, Calibration]) -> float:
    """Variance, rad^2, of the cameras' common turn about the vertical: that of their mean."""
    up = [one.cam_from_vehicle[:3, 2] for one in calibrations.values()]
    of_each = [
        0.0 if one.covariance is None else float(axis @ one.covariance[3:, 3:] @ axis)
        for axis, one in zip(up, calibrations.values(), strict=True)
    ]
    return float(np.mean(of_each))


def _seen(
    drive: Drive, sightings: Sightings, frame: int, names: list[str], calibrations: Mapping[str, Calibration]
) -> list[Seen]:
    rows = np.flatnonzero(sightings.frame == frame)
    informs = sightings.informs
    return [
        Seen(
            sightings.kinds[sightings.kind[row]],
            drive.cameras[names[sightings.camera[row]]].info.intrinsic,
            calibrations[names[sightings.camera[row]]].cam_from_vehicle,
            sightings.corners_pinhole_px[row],
            sightings.covariance_px[row],
            informs[row],
        )
        for row in rows.tolist()
    ]


def _in_view(
    drive: Drive, sightings: Sightings, hd_map: HdMap, calibrations: Mapping[str, Calibration]
) -> np.ndarray:
    """In which frames (F,) a whole marking of the map is near and within an image, by the recorded poses."""
    corners = np.stack([marking.corners_map for marking in hd_map.markings])
    out = np.zeros(len(sightings.stamp_s), dtype=bool)
    times = {stamp: frame for frame, stamp in enumerate(sightings.stamp_s.tolist())}
    for image in drive.images:
        if image.camera not in calibrations:
            continue
        info = drive.cameras[image.camera].info
        cam_from_map = calibrations[image.camera].cam_from_vehicle @ np.linalg.inv(image.map_from_vehicle)
        pixels, depth_m = project_ground(info.intrinsic, cam_from_map, corners.reshape(-1, 2))
        inside = (pixels >= 0) & (pixels < [info.width, info.height])
        near = inside.all(axis=1) & (depth_m > 0) & (depth_m < IN_VIEW_M)
        out[times[image.taken_s]] |= bool(near.reshape(-1, 4).all(axis=1).any())
    return out


def localise_drive(parsed: argparse.Namespace) -> bool:
    """Localise a drive in a map, print the figures and write them with poses and picture.

    Args:
        parsed: the arguments of :mod:`v2hdm.cli.localize`.

    Returns:
        Whether the map explains the drive.

    Raises:
        V2hdmError: map, calibrations or drive cannot be read or do not belong together.
    """
    check_workers(parsed.workers)
    logging.basicConfig(format="%(message)s")
    cv2.setNumThreads(1)
    hd_map = read_geojson(parsed.map / "map.geojson" if parsed.map.is_dir() else parsed.map)
    calibrations = trusted_calibrations(parsed.map if parsed.map.is_dir() else parsed.map.parent)
    drive = read_drive(parsed.drive, ReadOptions(format=parsed.format, cameras=parsed.camera))
    check_together(hd_map, calibrations, drive)
    folder = parsed.output or Path("outputs") / f"{drive.name}-localized"
    with result_folder(folder, "--output") as unfinished:
        detections = detect_all(
            drive, DetectorOptions.for_mapping(), parsed.workers or os.cpu_count() or 1, _tell
        )
        found = localise(drive, detections, hd_map, calibrations)
        figures = found.figures()
        settings = {"map": str(parsed.map), "drive": str(parsed.drive), "cameras": list(drive.cameras)}
        (unfinished / "config.yaml").write_text(json.dumps(settings) + "\n", encoding="utf-8")
        write_json(unfinished / "localization.json", figures)
        poses = np.stack([state.map_from_vehicle for state in found.states])
        write_tum(Trajectory(found.stamp_s, poses), unfinished / "localized.tum")
        noise = drive.pose_noise
        recorded = [noise.position_m, noise.position_m, noise.heading_rad]
        sigma = np.hypot(found.sigma, recorded)
        save_errors(unfinished / "errors.png", found.stamp_s, found.error, sigma, found.known)
    print(
        f"{figures['localised_share']:.1%} of {figures['frames_with_a_marking_in_view']} frames with a "
        f"marking in view localised; position {100 * figures['position_rmse_m']:.1f} cm, heading "
        f"{figures['heading_rmse_deg']:.2f} deg from the recorded poses (RMSE)"
    )
    explained = float(figures["matched_share"]) >= LEAST_MATCHED
    if not explained:
        print(
            f"FAIL: the map explains {figures['matched_share']:.0%} of the detections, so that the figures "
            "above cannot be relied on: is it of this site, as it is painted today, and does the drive begin "
            "where its first pose says?"
        )
    print(f"results in {folder}")
    return explained


def check_together(hd_map: HdMap, calibrations: Mapping[str, Calibration], drive: Drive) -> None:
    """Refuse a map without markings, without a calibration of the drive's cameras, or of another frame."""
    if not hd_map.markings:
        raise MapFileError("the map has no markings; nothing can be localised in it")
    if not set(drive.cameras) & set(calibrations):
        raise MapFileError(
            f"drive {drive.name} has the cameras {', '.join(drive.cameras)}, the map was made with "
            f"{', '.join(calibrations)}; no camera is calibrated"
        )
    if hd_map.origin != drive.origin:
        raise MapFileError(
            f"the map's origin is {hd_map.origin} and that of drive {drive.name} {drive.origin}: their "
            "coordinates differ; bring the drive's poses into the map's frame"
        )


def _tell(done: int, total: int) -> None:
    if done == total or done % 50 == 0:
        print(f"looked at {done} of {total} images", file=sys.stderr, flush=True)
