"""How well bare ground tells a mounting: rendered drives, guesses disturbed, against truth.

``python -m tests.benchmarks.ground_extrinsic --drives FOLDER... [--off DEG]`` disturbs each camera's guess by
up to DEG in roll, pitch and yaw and estimates it from bare ground. It prints each error, the root mean
squares, the normalised squared error (1 for honest sigmas) and the processor time a camera. With ``--faults``
it adds the parameter that the ground finds under each of a few faults, one at a time.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from v2hdm.geometry.ipm import ipm_from_extrinsic
from v2hdm.geometry.rigid import rotation_from_vector
from v2hdm.ground.estimate import estimate_ground
from v2hdm.ground.model import guessed_mount
from v2hdm.ground.results import GroundOptions
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.records import Calibration, Camera, Drive, FloatArray, Trajectory

UNITS = ("roll deg", "pitch deg", "yaw deg", "height cm")


def disturbed(camera: Camera, off_deg: FloatArray) -> Camera:
    """The camera with its guess turned about its own centre by a rotation vector in its own axes."""
    guess = guessed_mount(camera)
    turned = replace(
        guess,
        vehicle_from_cam_rotation=guess.vehicle_from_cam_rotation @ rotation_from_vector(np.deg2rad(off_deg)),
    )
    ipm = ipm_from_extrinsic(camera.info, turned.cam_from_vehicle)
    return replace(camera, ipm={"estimated": ipm}, initial_ipm="estimated")


def errors(calibration: Calibration, true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors (4,) of roll, pitch, yaw (deg) and height (cm) in vehicle axes, and their covariance (4, 4)."""
    matrix = calibration.cam_from_vehicle
    turn = np.rad2deg(cv2.Rodrigues(matrix[:3, :3].T @ true[:3, :3])[0].ravel())
    centres = [-m[:3, :3].T @ m[:3, 3] for m in (matrix, true)]
    jacobian = np.zeros((4, 6))
    jacobian[:3, 3:] = -np.rad2deg(matrix[:3, :3].T)
    jacobian[3, :3] = -100 * matrix[:3, :3].T[2]
    assert calibration.covariance is not None
    return np.append(turn, 100 * (centres[0] - centres[1])[2]), jacobian @ calibration.covariance @ jacobian.T


def late(drive: Drive, clock_s: float) -> Drive:
    """The drive with stamps that are ``clock_s`` too early: images are that much later than they say."""
    assert drive.trajectory is not None
    moved = Trajectory(drive.trajectory.stamp_s + clock_s, drive.trajectory.map_from_vehicle)
    inside = [i for i in drive.images if moved.stamp_s[0] < i.stamp_s < moved.stamp_s[-1]]
    return replace(drive, trajectory=moved, images=tuple(inside))


def steeper(drive: Drive, grade: float) -> Drive:
    """The drive with poses that rise by ``grade`` along x of the map."""
    assert drive.trajectory is not None
    poses = drive.trajectory.map_from_vehicle.copy()
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1))])
    poses[:, 2, 3] += grade * (path - path.mean())
    return replace(drive, trajectory=Trajectory(drive.trajectory.stamp_s, poses))


def with_info(drive: Drive, camera: str, focal: float = 1.0, pinhole: bool = False) -> Drive:
    """The drive with a focal length that is too large by a factor, or without its lens' distortion."""
    old = drive.cameras[camera]
    intrinsic = old.info.intrinsic.copy()
    intrinsic[0, 0] *= focal
    intrinsic[1, 1] *= focal
    distortion = (0.0,) * len(old.info.distortion) if pinhole else old.info.distortion
    guess = guessed_mount(old).cam_from_vehicle
    info = replace(old.info, intrinsic=intrinsic, distortion=distortion)
    ipm = {"estimated": ipm_from_extrinsic(info, guess)}
    changed = replace(old, info=info, ipm=ipm, initial_ipm="estimated")
    return replace(drive, cameras={**drive.cameras, camera: changed})


def print_faults(drive: Drive, camera: str) -> None:
    """The estimate of the parameter that belongs to each fault."""
    faults = {
        "clean": (drive, "clock_s"),
        "clock -30 ms": (late(drive, 0.03), "clock_s"),
        "clock +60 ms": (late(drive, -0.06), "clock_s"),
        "clock -120 ms": (late(drive, 0.12), "clock_s"),
        "fx +5 %": (with_info(drive, camera, focal=1.05), "focal_scale"),
        "no distortion": (with_info(drive, camera, pinhole=True), "distortion_k1"),
        "grade .3 %": (steeper(drive, 0.003), "grade"),
    }
    for name, (faulty, parameter) in faults.items():
        estimate = estimate_ground(faulty, camera)
        fitted = estimate.parameters.get(parameter)
        value = (
            "none"
            if fitted is None
            else f"{fitted.value:+.4f} +- {fitted.sigma:.4f} told {fitted.observable}"
        )
        print(f"  {name:<14} {parameter:<14} {value}, residual {estimate.median_residual:.2f}", flush=True)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=Path, nargs="+", required=True)
    parser.add_argument("--off", type=float, default=10.0, help="largest disturbance of a guess, deg")
    parser.add_argument("--faults", action="store_true")
    parsed = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(17)
    all_errors, squared, seconds, count = [], [], [], 0
    for folder in parsed.drives:
        drive = read_drive(folder)
        truth = read_truth(drive)
        for name, camera in drive.cameras.items():
            off = rng.uniform(-parsed.off, parsed.off, 3)
            turned = replace(drive, cameras={**drive.cameras, name: disturbed(camera, off)})
            count += 1
            began = time.process_time()
            estimate = estimate_ground(turned, name, GroundOptions())
            seconds.append(time.process_time() - began)
            if estimate.calibration is None:
                print(
                    f"{folder.name} {name}: {estimate.status.value}, guess off by {off.round(1)}", flush=True
                )
                continue
            error, covariance = errors(estimate.calibration, truth.cam_from_vehicle[name])
            all_errors.append(error)
            squared.append(float(error @ np.linalg.solve(covariance, error)) / len(error))
            print(f"{folder.name} {name}: guess off by {off.round(1)}, error {error.round(3)}", flush=True)
            if parsed.faults:
                print_faults(drive, name)
    rms = np.sqrt(np.mean(np.square(all_errors), axis=0))
    print("rms " + ", ".join(f"{unit} {value:.3f}" for unit, value in zip(UNITS, rms, strict=True)))
    print(f"normalised squared error {np.mean(squared):.2f}; found {len(all_errors)} of {count}")
    print(f"{np.mean(seconds):.1f} s of processor a camera")


if __name__ == "__main__":
    main()
