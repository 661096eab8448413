"""What looks at parts of an image save on the vehicle, and what they cost in accuracy.

    python -m tests.benchmarks.live_regions DRIVE --images 160 --every-full 1 5 [--seconds 60]

DRIVE is a rendered drive of ``v2hdm map +run=port2`` (its ``cache``), which has the truth. Its images are
given to the detector and the localiser, with the map of the truth, an odometry that is off by half a percent
and .006 deg/s, and calibrations stated to 5 mm and .03 deg. For each ``--every-full``: errors of the tracked
poses, what was found, CPU time of an image in the detector, of looks at parts alone, and in the localiser.

With ``--seconds`` the command ``v2hdm localize --live`` itself then runs for so long on images that are
written at 10 Hz, and the age of an image when its pose was written is printed: on a machine that others use
it says little.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import cv2
import numpy as np

from v2hdm.detection.camera import camera_from_calibration
from v2hdm.detection.detector import Detector
from v2hdm.detection.road import RoadDetector
from v2hdm.geometry.planar import wrapped
from v2hdm.geometry.rigid import heading_rad
from v2hdm.io.calibration.writing import write_calibration
from v2hdm.io.drive import read_drive
from v2hdm.io.drive.truth import read_truth
from v2hdm.io.maps.geojson import write_geojson
from v2hdm.localization.localizer import Localizer, Status
from v2hdm.localization.motion import Motion
from v2hdm.localization.places import rough_position
from v2hdm.localization.seeing import Look
from v2hdm.records import Calibration, Drive, FloatArray, Truth

_SCALE, _BIAS_RAD_S = 1.005, 1e-4  # stated over true speed, and the bias of the yaw rate
_MOUNT = np.diag(np.square([*(3 * [0.005]), *(3 * [np.deg2rad(0.03)])]))  # stated covariance of a calibration
_SAMPLES = 5  # of the odometry between two images
_RATE_HZ = 10.0


class Ride(NamedTuple):
    """A rendered drive as a vehicle has it: images in the order of their times, and its odometry."""

    drive: Drive
    truth: Truth
    images: list[int]
    stamp_s: FloatArray  # (M,) the moments
    map_from_vehicle: FloatArray  # (M, 4, 4)
    calibrations: dict[str, Calibration]

    def motion(self, moment: int, stamp_s: FloatArray) -> list[Motion]:
        """The odometry's samples up to a moment, if the moments were at ``stamp_s`` (M,)."""
        if moment == 0:
            return []
        place = self.map_from_vehicle[:, :2, 3]
        heading = np.unwrap(np.asarray(heading_rad(self.map_from_vehicle)))
        speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / np.diff(stamp_s)
        rate = np.diff(heading) / np.diff(stamp_s)
        # What an odometry says is of its sample's time, not the mean since the last image.
        middle_s = (stamp_s[:-1] + stamp_s[1:]) / 2
        times = np.linspace(stamp_s[moment - 1], stamp_s[moment], _SAMPLES + 1)[1:]
        speeds = _SCALE * np.interp(times, middle_s, speed)
        rates = np.interp(times, middle_s, rate) + _BIAS_RAD_S
        return [
            Motion(*sample) for sample in zip(times.tolist(), speeds.tolist(), rates.tolist(), strict=True)
        ]


def ride_of(folder: Path, images: int) -> Ride:
    """The first images of a rendered drive."""
    drive = read_drive(folder)
    truth = read_truth(drive)
    order = sorted(range(len(drive.images)), key=lambda i: drive.images[i].stamp_s)[:images]
    stamps = np.array([drive.images[i].stamp_s for i in order])
    stamp_s, first = np.unique(stamps, return_index=True)
    calibrations = {
        name: Calibration(camera.info, truth.cam_from_vehicle[name], _MOUNT)
        for name, camera in drive.cameras.items()
    }
    poses = truth.map_from_vehicle[order][first]
    return Ride(drive, truth, order, stamp_s, poses, calibrations)


def followed(ride: Ride, every_full: int, roads: dict[str, RoadDetector]) -> str:
    """Localise through a ride; the figures as one line."""
    begin = ride.map_from_vehicle[0]
    start = rough_position(*begin[:2, 3].tolist(), float(np.degrees(heading_rad(begin))))
    localizer = Localizer(ride.truth.map, ride.calibrations, start, every_full=every_full)
    moment = 0
    errors, found, detected_s, parts_s, localised_s = [], [], [], [], []
    for i in ride.images:
        image = ride.drive.images[i]
        while ride.stamp_s[moment] < image.stamp_s:
            moment += 1
            localizer.update([], ride.motion(moment, ride.stamp_s))
        pixels = np.asarray(cv2.imread(str(image.path)))
        times = [time.process_time()]
        regions_px = localizer.regions(image.camera, image.stamp_s)
        times.append(time.process_time())
        road = roads[image.camera].detect(pixels, regions_px=regions_px)
        times.append(time.process_time())
        pose = localizer.update([Look.of(image.camera, image.stamp_s, road)])
        times.append(time.process_time())
        asked_s, look_s, update_s = np.diff(times).tolist()
        detected_s.append(look_s)
        localised_s.append(asked_s + update_s)
        if regions_px is not None:
            parts_s.append(look_s)
        found.append(len(road.markings))
        if pose.status == Status.TRACKING and pose.map_from_vehicle is not None:
            true = ride.truth.map_from_vehicle[i]
            off = true[:2, :2].T @ (pose.map_from_vehicle[:2, 3] - true[:2, 3])
            errors.append([*off, float(wrapped(heading_rad(pose.map_from_vehicle) - heading_rad(true)))])
    rmse = np.sqrt((np.array(errors) ** 2).mean(axis=0)) * [100, 100, np.degrees(1)]
    parts = f", {1e3 * np.median(parts_s):.0f} (median) of {len(parts_s)} in parts" if parts_s else ""
    return (
        f"every {every_full}: tracked {len(errors)} of {len(ride.images)}, along {rmse[0]:.2f} cm, lateral "
        f"{rmse[1]:.2f} cm, heading {rmse[2]:.3f} deg, {np.mean(found):.1f} markings an image; CPU, ms: "
        f"detector {1e3 * np.mean(detected_s):.0f} (mean){parts}, localiser {1e3 * np.mean(localised_s):.0f}"
    )


def paced(ride: Ride, every_full: int, seconds: float) -> str:
    """Run the command on images that come at 10 Hz; the ages of poses as one line."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "result").mkdir()
        write_geojson(ride.truth.map, folder / "result" / "map.geojson")
        for camera, calibration in ride.calibrations.items():
            write_calibration(calibration, folder / "result" / f"calibration_{camera}.yaml")
            (folder / camera).mkdir()
        begin = ride.map_from_vehicle[0]
        start = [*begin[:2, 3].tolist(), float(np.degrees(heading_rad(begin)))]
        command = [sys.executable, "-m", "v2hdm", "localize", str(folder / "result"), "--live"]
        command += [
            part for camera in ride.calibrations for part in ("--images", f"{camera}={folder / camera}")
        ]
        command += [
            "--motion",
            "-",
            "--every-full",
            str(every_full),
            "--start",
            *(f"{value:.4f}" for value in start),
        ]
        pipe = subprocess.PIPE
        ages_s: list[float] = []
        statuses: list[str] = []
        with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:

            def follow() -> None:
                assert process.stdout is not None
                for line in process.stdout:
                    record = json.loads(line)
                    ages_s.append(time.time() - record["stamp_s"])
                    statuses.append(record["status"])

            threading.Thread(target=follow, daemon=True).start()
            _write(ride, folder, process, seconds)
            process.terminate()
        tracked_s = [age for age, status in zip(ages_s, statuses, strict=True) if status == "tracking"]
    if not tracked_s:
        return f"every {every_full}, at 10 Hz: no pose was tracked ({len(ages_s)} lines)"
    p50, p99, most = np.percentile(tracked_s, [50, 99, 100]) * 1e3
    return (
        f"every {every_full}, at 10 Hz, load {os.getloadavg()[0]:.1f} of {os.cpu_count()} cores: "
        f"{len(tracked_s)} tracked poses of {len(ages_s)}; age, ms: {p50:.0f} (median), {p99:.0f} (99 %), "
        f"{most:.0f} (most)"
    )


def _write(ride: Ride, folder: Path, process: subprocess.Popen[str], seconds: float) -> None:
    """Write images and odometry as they come; the first moment lasts until the processes have started."""
    assert process.stdin is not None
    by_moment: dict[float, list[int]] = {}
    for i in ride.images:
        by_moment.setdefault(ride.drive.images[i].stamp_s, []).append(i)
    moments = list(by_moment.values())
    begin_s = time.time()
    stamp_s = begin_s + np.arange(len(moments)) / _RATE_HZ
    for moment, images in enumerate(moments):
        if time.time() - begin_s > seconds:
            return
        time.sleep(max(float(stamp_s[moment]) - time.time(), 0.0))
        for sample in ride.motion(moment, stamp_s):
            print(json.dumps(dict(zip(Motion._fields, sample, strict=True))), file=process.stdin)
        process.stdin.flush()
        for i in images:
            image = ride.drive.images[i]
            partial = folder / image.camera / "partial"
            shutil.copyfile(image.path, partial)
            # Exposed when it was due, however late this process was to write it.
            os.utime(partial, (float(stamp_s[moment]), float(stamp_s[moment])))
            partial.replace(folder / image.camera / f"{moment:06d}.jpg")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark and print its lines."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("drive", type=Path, help="a rendered drive with its truth")
    parser.add_argument("--images", type=int, default=160, help="of all cameras together")
    parser.add_argument("--every-full", type=int, nargs="+", default=[1, 5])
    parser.add_argument("--seconds", type=float, default=0.0, help="of the command itself, at 10 Hz")
    parsed = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    ride = ride_of(parsed.drive, parsed.images)
    detector = Detector.load()
    roads = {
        name: RoadDetector(detector, camera_from_calibration(calibration), calibration)
        for name, calibration in ride.calibrations.items()
    }
    for every_full in parsed.every_full:
        print(followed(ride, every_full, roads), flush=True)
        if parsed.seconds:
            print(paced(ride, every_full, parsed.seconds), flush=True)


if __name__ == "__main__":
    main()
