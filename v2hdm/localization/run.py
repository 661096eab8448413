"""From a map and a drive to where the vehicle was, and how far the recorded poses are from that."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from v2hdm.association.ground import easy_views, views_of
from v2hdm.association.sightings import Rig, Sightings, check_detections, collect_sightings
from v2hdm.detection.batch import detect_all
from v2hdm.detection.options import DetectorOptions
from v2hdm.doors import checked
from v2hdm.errors import MapFileError
from v2hdm.executor import open_executor
from v2hdm.geometry.planar import wrapped
from v2hdm.geometry.rigid import heading_rad
from v2hdm.io.detections import detections_of
from v2hdm.io.drive import as_drive
from v2hdm.io.trajectory import write_tum
from v2hdm.localization.filter import Markings, Sighting, State, locate, predict, start
from v2hdm.records import (
    BoolArray,
    Calibration,
    Drive,
    FloatArray,
    HDMap,
    ImageDetections,
    IntArray,
    Trajectory,
)
from v2hdm.report import style
from v2hdm.settings import Processes
from v2hdm.store.files import write_json

_START_SIGMA_M = 0.5  # standard deviation, m, of a coordinate of the first pose: a place that RTK once fixed
_START_SIGMA_RAD = float(np.deg2rad(3.0))  # standard deviation, rad, of the first heading: a compass
# With a larger standard deviation of the place the vehicle does not know where it is: half a dash's gap.
_LOST_M = 0.3
# Least share of the detections that a map of the site explains: one explained 0.86, another site's 0.04.
_LEAST_MATCHED = 0.5
_IN_VIEW_M = 15.0  # largest distance, m, from the camera of the corners of a marking that counts as in view

_PANELS = (("ahead", 100.0, "cm"), ("to the left", 100.0, "cm"), ("heading", float(np.degrees(1.0)), "deg"))
"""Panels of the errors' picture: title, units per metre or radian, and unit."""

_KNOWN = "#0072b2"
_LOST = "#d55e00"
_BAND = "#bbbbbb"


@dataclass(frozen=True)
class Localised:
    """A vehicle followed through F frames."""

    stamp_s: FloatArray  # (F,) time of each frame
    recorded: FloatArray  # (F, 4, 4) ``map_from_vehicle`` as recorded
    states: tuple[State, ...]  # after each frame
    matched: IntArray  # (F,) markings matched
    in_view: BoolArray  # (F,) whether a marking was in view
    # (3,) variances of ahead, left and heading that map and calibration share among all frames
    shared: FloatArray
    detections: int  # number of all frames together

    @property
    def poses(self) -> Trajectory:
        """The localised ``map_from_vehicle`` (F, 4, 4) over time."""
        return Trajectory(self.stamp_s, np.stack([state.map_from_vehicle for state in self.states]))

    @property
    def known(self) -> BoolArray:
        """In which frames (F,) the vehicle knows where it is."""
        return np.array([state.sigma_m < _LOST_M for state in self.states])

    @property
    def error(self) -> FloatArray:
        """Estimate less recorded pose (F, 3): ahead, m, to the left, m, and heading, rad."""
        estimate = self.poses.map_from_vehicle
        off = estimate[:, :2, 3] - self.recorded[:, :2, 3]
        heading = heading_rad(self.recorded)
        turn = wrapped(heading_rad(estimate) - heading)
        ahead = off[:, 0] * np.cos(heading) + off[:, 1] * np.sin(heading)
        left = off[:, 1] * np.cos(heading) - off[:, 0] * np.sin(heading)
        return np.column_stack([ahead, left, turn])

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations (F, 3) of ahead, left and heading, the map's own shift included."""
        sigmas = []
        for state in self.states:
            c = np.cos(state.mean[2])
            s = np.sin(state.mean[2])
            turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            sigmas.append(np.sqrt(np.diag(turn @ state.covariance[:3, :3] @ turn.T) + self.shared))
        return np.stack(sigmas)

    @property
    def explained(self) -> bool:
        """Whether the map explains the drive; where it does not, no figure can be relied on."""
        return bool(self.matched.sum() / max(self.detections, 1) >= _LEAST_MATCHED)

    def figures(self) -> dict[str, float | int]:
        """The figures of ``localization.json``, errors over the frames with a marking in view."""
        is_localised = self.in_view & self.known
        error = self.error[is_localised] if is_localised.any() else np.full((1, 3), np.nan)
        sigma = self.sigma
        return {
            "frames": len(self.states),
            "frames_with_a_marking_in_view": int(self.in_view.sum()),
            "localised_share": float(is_localised.sum() / max(self.in_view.sum(), 1)),
            "position_rmse_m": float(np.sqrt((error[:, :2] ** 2).sum(axis=1).mean())),
            "heading_rmse_deg": float(np.degrees(np.sqrt((error[:, 2] ** 2).mean()))),
            "worst_position_m": float(np.hypot(error[:, 0], error[:, 1]).max()),
            "median_sigma_m": float(np.median(np.hypot(sigma[:, 0], sigma[:, 1]))),
            "detections": self.detections,
            "matched_share": float(self.matched.sum() / max(self.detections, 1)),
        }


@checked
def localize(
    hd_map: HDMap,
    drive: Drive | str | Path,
    calibrations: Mapping[str, Calibration],
    *,
    detections: Sequence[ImageDetections] | None = None,
    workers: Processes = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Localised:
    """Follow the vehicle through a drive by a map's markings; only the first recorded pose is used.

    Args:
        hd_map: in the frame of the drive's poses.
        drive: the drive, or its folder.
        calibrations: of its cameras, by name, as a result has them.
        detections: of the drive's images, made here if not given.
        workers: processes that detect; 0 takes one per core.
        progress: called as ``progress(done, total)`` images.

    Returns:
        ``states`` at ``stamp_s`` (F,), ``error`` against the recorded poses and ``sigma`` (F, 3): ahead, m,
        to the left, m, and heading, rad.

    Raises:
        MapFileError: map, calibrations and drive do not belong together.
        MappingError: the images hold no marking.

    >>> localised = localize(result.map, port, result.calibrations, detections=result.detections)
    >>> localised.error.shape == localised.sigma.shape == (len(localised.stamp_s), 3)
    True
    """
    drive = as_drive(drive)
    check_together(hd_map, calibrations, drive)
    if detections is None and not drive.has_pictures:
        detections = detections_of(drive)
    if detections is None:
        report = progress or (lambda done, total: None)
        with open_executor(workers) as executor:
            detections = detect_all(drive, DetectorOptions.for_mapping(), executor, report)
    check_detections(drive, detections)
    names = [name for name in drive.cameras if name in calibrations]
    sightings = collect_sightings(drive, detections, names)
    markings = Markings(hd_map)
    states, matched = _follow(drive, sightings, names, calibrations, markings)
    # The cameras' common turn about the vertical is that of their mean.
    yaw_rad2 = [_yaw_variance(calibration) for calibration in calibrations.values()]
    return Localised(
        stamp_s=sightings.stamp_s,
        recorded=sightings.map_from_vehicle,
        states=states,
        matched=matched,
        in_view=_in_view(drive, sightings, hd_map, calibrations),
        shared=np.array([markings.shared_m2, markings.shared_m2, np.mean(yaw_rad2)]),
        detections=len(sightings),
    )


def _follow(
    drive: Drive,
    sightings: Sightings,
    names: list[str],
    calibrations: Mapping[str, Calibration],
    markings: Markings,
) -> tuple[tuple[State, ...], IntArray]:
    """The vehicle after each of F frames, and the number of markings matched in each (F,)."""
    attitude_rad = drive.pose_noise.roll_pitch_rad
    state = start(sightings.map_from_vehicle[0], _START_SIGMA_M, _START_SIGMA_RAD, attitude_rad)
    states = []
    matched = []
    for frame, stamp_s in enumerate(sightings.stamp_s):
        if frame:
            state = predict(state, float(stamp_s - sightings.stamp_s[frame - 1]), attitude_rad)
        sighted = _sightings_of(drive, sightings, frame, names, calibrations)
        state, markings_of_frame = locate(state, sighted, markings)
        states.append(state)
        matched.append(len(markings_of_frame))
    return tuple(states), np.array(matched)


def _yaw_variance(calibration: Calibration) -> float:
    """Variance, rad^2, of a camera's turn about the vertical; 0 if unknown."""
    if calibration.covariance is None:
        return 0.0
    up = calibration.cam_from_vehicle[:3, 2]
    return float(up @ calibration.covariance[3:, 3:] @ up)


def check_together(hd_map: HDMap, calibrations: Mapping[str, Calibration], drive: Drive) -> None:
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


def _sightings_of(
    drive: Drive, sightings: Sightings, frame: int, names: list[str], calibrations: Mapping[str, Calibration]
) -> list[Sighting]:
    """The detections of one frame."""
    informs = sightings.informs
    detections = []
    for row in np.flatnonzero(sightings.frame == frame).tolist():
        camera = names[sightings.camera[row]]
        detections.append(
            Sighting(
                kind=sightings.kinds[sightings.kind[row]],
                intrinsic=drive.cameras[camera].info.intrinsic,
                cam_from_vehicle=calibrations[camera].cam_from_vehicle,
                corners_px=sightings.corners_pinhole_px[row],
                covariance_px=sightings.covariance_px[row],
                informs=informs[row],
            )
        )
    return detections


def _in_view(
    drive: Drive, sightings: Sightings, hd_map: HDMap, calibrations: Mapping[str, Calibration]
) -> BoolArray:
    """In which frames (F,) a whole marking of the map is near and within an image, by the recorded poses."""
    cameras = [drive.cameras[name] for name in sightings.cameras]
    extrinsics = np.stack([calibrations[name].cam_from_vehicle for name in sightings.cameras])
    rig = Rig(np.stack([camera.info.intrinsic for camera in cameras]), extrinsics, sightings.map_from_vehicle)
    views = views_of(drive, sightings.cameras)
    corners_map = np.stack([marking.corners_map for marking in hd_map.markings])
    _, image = easy_views(views, rig, cameras, corners_map, _IN_VIEW_M)
    return np.isin(np.arange(len(sightings.stamp_s)), views.frame[np.isin(views.image, image)])


def write_localised(localised: Localised, drive: Drive, folder: Path) -> None:
    """Write figures, poses and the errors' picture: two-sigma bands, crosses where the vehicle is lost."""
    write_json(folder / "localization.json", localised.figures())
    write_tum(localised.poses, folder / "localized.tum")
    noise = drive.pose_noise
    sigma = np.hypot(localised.sigma, [noise.position_m, noise.position_m, noise.heading_rad])
    time_s = localised.stamp_s - localised.stamp_s[0]
    error = localised.error
    is_known = localised.known
    with style.figure(folder / "errors.png", 9, 6) as figure:
        axes = figure.subplots(3, 1, sharex=True)
        for k, (axis, (name, factor, unit)) in enumerate(zip(axes, _PANELS, strict=True)):
            band = 2 * factor * sigma[:, k]
            axis.fill_between(time_s, -band, band, color=_BAND, alpha=0.6, lw=0, label="two sigmas, of both")
            axis.plot(
                time_s[is_known], factor * error[is_known, k], ".", ms=3, color=_KNOWN, label="localised"
            )
            if not is_known.all():
                axis.plot(
                    time_s[~is_known], factor * error[~is_known, k], "x", ms=4, color=_LOST, label="lost"
                )
            limit = 1.2 * float(np.percentile(np.abs(factor * error[:, k]), 99)) + 1e-9
            limit = max(limit, 2 * float(np.median(band)))
            axis.set_ylim(-limit, limit)
            axis.set_ylabel(f"{name}, {unit}")
            axis.grid(alpha=0.3)
        axes[0].legend(loc="upper right", ncols=3, fontsize=8)
        axes[0].set_title("Localised pose minus recorded pose")
        axes[-1].set_xlabel("time, s")


def summary_lines(localised: Localised) -> list[str]:
    """The figures for a terminal, with a FAIL where the map does not explain the drive."""
    figures = localised.figures()
    lines = [
        f"{100 * figures['localised_share']:.1f} % of {figures['frames_with_a_marking_in_view']} frames with "
        f"a marking in view localised; position {100 * figures['position_rmse_m']:.1f} cm, heading "
        f"{figures['heading_rmse_deg']:.2f} deg from the recorded poses (RMSE)"
    ]
    if not localised.explained:
        share = f"{100 * figures['matched_share']:.0f} %"
        lines.append(
            f"FAIL: the map explains {share} of the detections, so that the figures above cannot be relied "
            "on: is it of this site, as painted today, and is the first pose right?"
        )
    return lines
